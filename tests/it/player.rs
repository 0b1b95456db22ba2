// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody report --play` in a real browser: frame sets are played, scrubbed, coloured and measured.

use crate::browser::Browser;
use crate::lab::text_of;
use crate::reused::{BALL, Place, reconstruct, repeat, run};
use serde_json::{Value, json};

/// Triggers with a cloud: some are missing, then they come one after the other.
const TRIGGERS: [u64; 30] = [
    0, 3, 4, 5, 8, 30, 31, 32, 33, 34, 35, 36, 37, 38, 39, 40, 41, 42, 43, 44, 45, 46, 47, 48, 49, 50, 51,
    52, 53, 54,
];

#[test]
fn a_page_plays_what_was_reconstructed() {
    let place = Place::new();
    let (session, out, page) = (place.session("ball"), place.path("out"), place.path("page.html"));
    let made = reconstruct(&place, &session, &out, &[]);
    assert_eq!(made.status.code(), Some(0), "{}", text_of(&made));
    repeat(&out, TRIGGERS.into_iter().skip(1));
    let report = |options: &[&str]| {
        let words = [&["report", "--play"], options].concat();
        run(&words, &[("", &session), ("--clouds", &out), ("--out", &page)])
    };
    // Five megabytes for thirty frame sets: 14,563 points each.
    let told = report(&["--json", "--play-mib", "5"]);
    assert_eq!(told.status.code(), Some(0), "{}", text_of(&told));
    let told: Value = serde_json::from_slice(&told.stdout).expect("JSON");
    assert_eq!(told["bytes"], std::fs::metadata(&page).expect("written").len());
    let text = std::fs::read_to_string(&page).expect("written");
    assert!(!text.contains("http://") && !text.contains("https://"), "the page needs the network");

    let Some(browser) = Browser::start() else {
        println!("skipped: there is no chromedriver");
        return;
    };
    browser.open(&format!("file://{}", page.display()));
    let shown =
        |trigger: u64| format!("return document.getElementById('player').dataset.trigger === '{trigger}'");
    browser.wait("the first cloud", &shown(0));
    let points = browser.run("return player.view.points").as_u64().expect("a number");
    assert!((7_000..=14_563).contains(&points), "{points} points");

    // To the end of it, at its own speed: what was not ready in time is left out, the last is not.
    browser.run("player.speed.value = '1'; player.button.click()");
    browser.wait("the last cloud", &shown(54));
    browser.wait("the end", "return player.button.textContent === 'Play'");

    // On a machine that is slow to unpack, what comes late is seen late, not left out for what comes later still.
    browser.run(
        "const get = player.get.bind(player);
         player.get = (place) => get(place)?.then((points) => new Promise((done) => setTimeout(() => done(points), 60)));
         window.seen = new Set();
         const show = player.show.bind(player);
         player.show = (place, points) => { if (player.playing) seen.add(place); show(place, points); };
         player.seek(4)",
    );
    browser.wait("the place to begin", &shown(8));
    browser.run("player.speed.value = '0.5'; player.button.click()");
    browser.wait("the last cloud again", &shown(54));
    let seen = browser.run("delete player.get; delete player.show; return seen.size");
    assert!(seen.as_u64() > Some(3), "only {seen} clouds were seen");

    // By hand, with the mouse and with keys.
    browser.run("player.place.value = '2'; player.place.dispatchEvent(new Event('input'))");
    browser.wait("the chosen cloud", &shown(4));
    browser.run("player.view.canvas.focus()");
    browser.press(".");
    browser.wait("the next cloud", &shown(5));
    browser.press(",");
    browser.wait("the one before", &shown(4));

    // A point under the mouse lies on the ball; two of them have a distance.
    let ([x, y, z], radius) = BALL;
    let under = browser.run(
        "const c = player.view.canvas; return player.view.pointAt(c.clientWidth / 2, c.clientHeight / 2)",
    );
    let at: Vec<f64> = serde_json::from_value(under).expect("a point in the middle");
    let off = ((at[0] - x).powi(2) + (at[1] - y).powi(2) + (at[2] - z).powi(2)).sqrt() - radius;
    assert!(off.abs() < 1e-3, "{off} m off the ball");
    let click = "const { canvas } = player.view;
        const at = (x) => player.pick(player.view.pointAt(canvas.clientWidth / 2 + x, canvas.clientHeight / 2));
        at(-20); at(20); return player.distance.textContent";
    let distance = browser.run(click);
    let millimetres: f64 =
        distance.as_str().and_then(|told| told.split(' ').next()?.parse().ok()).expect("a distance");
    assert!(millimetres > 1.0 && millimetres < 400.0, "{distance}");
    browser.wait("two marks", "return document.querySelectorAll('.picked:not([hidden])').length === 2");

    // Other colours are another picture.
    let picture = "player.view.draw(); return player.view.canvas.toDataURL()";
    let mut pictures = Vec::new();
    for colour in ["intensity", "normals", "uncertainty"] {
        browser.run(&format!(
            "player.colour.value = '{colour}'; player.colour.dispatchEvent(new Event('change'))"
        ));
        browser.wait("drawn", "return !player.view.waiting");
        pictures.push(browser.run(picture));
    }
    browser.keep("player");
    pictures.dedup();
    assert_eq!(pictures.len(), 3);
    assert_ne!(pictures[0], json!("data:,"));
}
