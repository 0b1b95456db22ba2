// SPDX-License-Identifier: MIT OR Apache-2.0
//! A reconstructed session in the console's player: in a real browser, for clients of ill will, and beside a capture.

use crate::api_node::{ApiNode, Reply};
use crate::browser::Browser;
use crate::lab::{assert_contains, start_nodes, text_of};
use crate::reused::{BALL, Place, json, reconstruct, repeat, run};
use fourdbody::worker::state::{Job, Stage};
use hyper::{Method, StatusCode};
use serde_json::{Value, json};
use std::path::Path;
use std::time::{Duration, Instant};

/// The triggers that have a cloud.
const TRIGGERS: [u64; 8] = [0, 1, 2, 3, 7, 8, 9, 10];
/// Triggers whose frames were refused.
const HOLES: std::ops::Range<u64> = 4..7;
const WHY: &str = "the marker <b>is away";

/// A ball, recorded by node `a` in `sessions` and reconstructed in `results` as a worker leaves it; named `walk`.
fn lay_out(sessions: &Path, results: &Path) {
    let place = Place::new();
    let (session, out) = (sessions.join("walk"), results.join("walk"));
    std::fs::create_dir_all(sessions).expect("writable");
    let images = place.path("images");
    let imported =
        run(&["import"], &[("--rig", &place.path("rig.toml")), ("--images", &images), ("--out", &session)]);
    assert_eq!(imported.status.code(), Some(0), "{}", text_of(&imported));
    let made = reconstruct(&place, &session, &out, &[]);
    assert_eq!(made.status.code(), Some(0), "{}", text_of(&made));
    repeat(&out, 1..=TRIGGERS[7]);
    let mut summary = json(&out.join("summary.json"));
    for told in summary["triggers"].as_array_mut().expect("triggers") {
        let trigger = told["trigger"].as_u64().expect("a trigger");
        if HOLES.contains(&trigger) {
            for frame in told["frames"].as_array_mut().expect("frames") {
                (frame["outcome"], frame["reason"], frame["points"]) =
                    (json!("refused"), json!(WHY), json!(0));
            }
            std::fs::remove_file(out.join(format!("merged/{trigger:06}.ply"))).expect("there");
        }
    }
    let session_id = summary["session"]["id"].as_str().expect("an id").to_owned();
    std::fs::write(out.join("summary.json"), summary.to_string()).expect("writable");
    let job = Job {
        session: "walk".to_owned(),
        session_id,
        stage: Stage::Done,
        done: 8,
        of: 11,
        ended_ns: 1,
        ..Job::default()
    };
    job.store(results).expect("writable");
}

/// A node without devices beside results of a worker.
fn node(api: &str) -> ApiNode {
    let dir = tempfile::tempdir().expect("a temporary directory");
    for (name, role) in crate::api_node::BEARERS {
        crate::api_node::new_token(dir.path(), name, role, false);
    }
    lay_out(&dir.path().join("sessions"), &dir.path().join("results"));
    ApiNode::start_in(dir, api)
}

/// Frame sets are made when nobody else wants a processor, which beside other tests may take long.
const PATIENCE: Duration = Duration::from_secs(240);

/// Repeats until it holds: a node looks at results every few seconds.
fn soon(what: &str, holds: impl Fn() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !holds() {
        assert!(Instant::now() < deadline, "never {what}");
        std::thread::sleep(Duration::from_millis(100));
    }
}

const INDEX: &str = "GET /api/v1/sessions/walk/frame-sets";

#[test]
fn a_take_is_played_in_the_console() {
    let Some(browser) = Browser::start() else {
        println!("skipped: no browser (Debian packages chromium and chromium-driver)");
        return;
    };
    let node = node("listen = \"127.0.0.1:PORT\"\n");
    let address = format!("http://127.0.0.1:{}", node.port);
    browser.open(&format!("{address}/"));
    let button = "document.querySelector('[aria-label=\"play walk\"]')";
    browser.wait("a button that plays", &format!("return Boolean({button} && !{button}.disabled)"));
    browser.keep("play-button");
    // It opens a page of its own: this one goes there.
    browser.run(&format!("window.open = (page) => location.assign(page); {button}.click()"));
    let shown =
        |trigger: u64| format!("return document.getElementById('player')?.dataset.trigger === '{trigger}'");
    browser.wait("the first cloud", &shown(0));
    assert_eq!(browser.text("title"), "walk");
    let points = browser.run("return Number(document.getElementById('played').dataset.points)");
    assert!(points.as_u64().is_some_and(|points| (20_000..=40_000).contains(&points)), "{points}");
    browser.wait("all of it", "return document.getElementById('player').dataset.kept === '8'");

    let seek = |place: u64| {
        browser.run(&format!(
            "const slider = document.querySelector('#player input[type=range]');
             slider.value = '{place}'; slider.dispatchEvent(new Event('input'))"
        ));
        browser.wait("where the slider is", &shown(place));
    };
    let told = || browser.run("return document.querySelector('.controls output').textContent");
    // Refused frame sets are holes, which say why; nothing is shown there.
    assert_eq!(browser.run("return document.querySelectorAll('.holes i').length"), 1);
    seek(5);
    assert_contains(told().as_str().unwrap_or_default(), &["trigger 5", "no cloud (refused", WHY]);
    assert_eq!(browser.run("return document.getElementById('played').dataset.points"), "0");
    seek(9);
    assert_eq!(told(), format!("trigger 9, {:.3} s", 9.0 / 120.0));
    browser.run("document.getElementById('played').focus()");
    browser.press(",");
    browser.wait("the one before", &shown(8));

    // Other colours are another picture.
    let picture =
        "const done = await new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));
        return document.getElementById('played').toDataURL()";
    let mut pictures = Vec::new();
    for colour in ["intensity", "normals", "uncertainty"] {
        browser.run(&format!(
            "const colour = document.querySelectorAll('#player select')[1];
             colour.value = '{colour}'; colour.dispatchEvent(new Event('change'))"
        ));
        pictures.push(browser.run(&format!("return (async () => {{ {picture} }})()")));
    }
    pictures.dedup();
    assert_eq!(pictures.len(), 3);

    // Two clicks on the ball have a distance, no longer than the ball is wide.
    browser.click("played", (-30, 0));
    browser.click("played", (30, 0));
    let distance = browser.run("return document.querySelector('#player p output').textContent");
    let millimetres = distance.as_str().and_then(|told| told.split(' ').next()?.parse::<f64>().ok());
    assert!(millimetres.is_some_and(|mm| mm > 1.0 && mm < 2000.0 * BALL.1), "{distance}");
    browser.keep("playing");

    // To its end at a sixteenth: every frame set is shown.
    browser.run(
        "window.seen = new Set();
         const root = document.getElementById('player');
         new MutationObserver(() => seen.add(root.dataset.trigger)).observe(root, { attributeFilter: ['data-trigger'] });
         const speed = document.querySelector('#player select');
         speed.value = '0.0625'; speed.dispatchEvent(new Event('change'));
         const slider = document.querySelector('#player input[type=range]');
         slider.value = '0'; slider.dispatchEvent(new Event('input'));
         document.querySelector('.controls button').click()",
    );
    browser.wait("the last cloud", &shown(10));
    browser.wait("the end", "return document.querySelector('.controls button').textContent === 'Play'");
    let seen = browser.run("return seen.size");
    assert!(seen.as_u64() >= Some(6), "{seen} frame sets were seen");

    // What is not there is told, and nothing else.
    browser.open(&format!("{address}/play.html?session=..%2Fwalk"));
    browser.wait_text("player-state", "cannot be played");
    browser.open(&format!("{address}/play.html?session=walk&node=b"));
    browser.wait_text("player-state", "no node");
    assert!(!node.log().contains("panicked"), "{}", node.log());
}

#[test]
fn clients_of_ill_will_and_results_that_are_damaged_are_refused() {
    let node = node("listen = \"127.0.0.1:PORT\"\ntokens = \"tokens\"\n");
    let ask = |line: &str| {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let reply = node.send(Some("vera"), line, &[], "");
            if reply.status != 503 || Instant::now() > deadline {
                return reply;
            }
        }
    };
    soon("played", || ask(INDEX).status == 200);
    let described: Value = serde_json::from_str(&ask(INDEX).body).expect("JSON");
    assert_eq!(described["runs"], json!([[0, 3], [7, 10]]));
    assert_eq!(described["holes"], json!([{ "first": 4, "last": 6, "why": format!("refused: {WHY}") }]));
    let playable: Value = serde_json::from_str(&ask("GET /api/v1/playable").body).expect("JSON");
    assert_eq!(playable["sessions"][0]["session"], "walk");

    let set = |trigger: &str| ask(&format!("{INDEX}/{trigger}"));
    for (trigger, status) in [
        ("5", 404),
        ("11", 404),
        ("18446744073709551615", 404),
        ("18446744073709551616", 400),
        ("-1", 400),
        ("0x1", 400),
        ("1%0a2", 400),
        ("..%2f..%2fjob.json", 400),
    ] {
        let reply = set(trigger);
        assert_eq!(reply.status, status, "{trigger}: {reply:?}");
    }
    for name in
        ["..", "%2e%2e", "..%2fwalk", "walk%2f..%2fwalk", ".worker", "none", "walk%00", "-rf", "%2ftmp"]
    {
        let reply = ask(&format!("GET /api/v1/sessions/{name}/frame-sets"));
        assert_eq!(reply.status, 404, "{name}: {reply:?}");
    }
    assert_eq!(node.send(None, INDEX, &[], "").status, 401);
    let delete = node.send(Some("otto"), &INDEX.replace("GET", "DELETE"), &["content-length: 0"], "");
    assert_eq!(delete.status, 405, "{delete:?}");

    // Many at once: made one after the other, and who is too much is told so.
    let node = &node;
    let statuses: Vec<u16> = std::thread::scope(|scope| {
        let asked: Vec<_> = (0..28)
            .map(|i| {
                scope.spawn(move || {
                    node.send(Some("otto"), &format!("{INDEX}/{}", TRIGGERS[i % 8]), &[], "").status
                })
            })
            .collect();
        asked.into_iter().map(|one| one.join().expect("an answer")).collect()
    });
    assert!(statuses.iter().all(|status| matches!(status, 200 | 429 | 503)), "{statuses:?}");
    assert!(statuses.contains(&200), "{statuses:?}");

    // One file is damaged: that frame set is refused with its name, others are made. What was made before is another result.
    let out = node.file("results/walk");
    let damaged = out.join("merged/000002.ply");
    let bytes = std::fs::read(&damaged).expect("there");
    std::fs::write(&damaged, &bytes[..bytes.len() / 2]).expect("writable");
    let again = |ended_ns: u64| {
        let mut job = Job::load(&node.file("results"), "walk").expect("there");
        job.ended_ns = ended_ns;
        job.store(&node.file("results")).expect("writable");
    };
    again(22);
    let told =
        |reply: &Reply| serde_json::from_str::<Value>(&reply.body).unwrap_or_default()["message"].to_string();
    soon("refused", || set("2").status == 404);
    assert_contains(&told(&set("2")), &["000002.ply"]);
    assert_eq!(set("3").status, 200);

    // The results are half there, are none, and have gone.
    let summary = out.join("summary.json");
    let text = std::fs::read(&summary).expect("there");
    std::fs::write(&summary, &text[..text.len() / 2]).expect("writable");
    again(333);
    soon("told", || ask(INDEX).status == 500);
    assert_contains(&told(&ask(INDEX)), &["summary.json"]);
    std::fs::write(&summary, &text).expect("writable");
    std::fs::remove_dir_all(out.join("merged")).expect("there");
    std::fs::write(out.join("merged"), "no directory").expect("writable");
    std::fs::remove_dir_all(out.join("clouds")).expect("there");
    again(4444);
    soon("told", || ask(INDEX).status == 500);
    std::fs::remove_dir_all(&out).expect("there");
    soon("not found", || ask(INDEX).status == 404);
    assert_eq!(ask("GET /api/v1/status").status, 200);
    assert!(!node.log().contains("panicked"), "{}", node.log());
}

#[test]
fn nothing_is_made_while_a_capture_runs_and_another_node_passes_it_on() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = crate::lab::laboratory(dir.path(), 20.0);
    let results = dir.path().join("results");
    lay_out(&dir.path().join("elsewhere"), &results);
    let file = &laboratory.nodes[0].path;
    let text = std::fs::read_to_string(file).expect("a node file");
    std::fs::write(file, format!("{text}\n[worker]\nresults = \"{}\"\n", results.display()))
        .expect("writable");
    let mut nodes = start_nodes(&laboratory);
    let ask = |node: usize, path: &str| {
        nodes[node].client.ask(Method::GET, path, None, Duration::from_secs(30)).expect("an answer")
    };
    let (own, passed) = ("/api/v1/sessions/walk/frame-sets", "/api/v1/peers/a/sessions/walk/frame-sets");
    soon("played", || ask(0, own).status == StatusCode::OK);
    assert_eq!(ask(1, own).status, StatusCode::NOT_FOUND, "node b has no worker");
    let none: Value = serde_json::from_slice(&ask(1, "/api/v1/playable").body).expect("JSON");
    assert_eq!((&none["worker"], &none["sessions"]), (&json!(false), &json!([])));
    assert_eq!(ask(1, "/api/v1/peers/a/playable").body, ask(0, "/api/v1/playable").body);
    assert_eq!(ask(1, passed).body, ask(0, own).body);
    let set = ask(0, &format!("{own}/1"));
    assert_eq!((set.status, set.body.len()), (StatusCode::OK, ask(1, &format!("{passed}/1")).body.len()));

    let wish = json!({ "wish": { "name": "beside", "duration_s": null } });
    nodes[0].client.post("/api/v1/capture", &wish, Duration::from_secs(60)).expect("it begins");
    soon("recording", || {
        nodes[0]
            .client
            .status()
            .is_ok_and(|status| status.session.is_some_and(|session| session.triggers > 5))
    });
    // What was made before is told, nothing new is made.
    assert_eq!(ask(0, &format!("{own}/1")).status, StatusCode::OK);
    for path in [format!("{own}/2"), format!("{own}/3")] {
        let refused = ask(0, &path);
        assert_eq!(refused.status, StatusCode::CONFLICT);
        assert_contains(&String::from_utf8_lossy(&refused.body), &["node a is in a session"]);
    }
    nodes[0].client.post("/api/v1/capture/stop", &json!({}), Duration::from_secs(60)).expect("it ends");
    soon("made again", || ask(0, &format!("{own}/2")).status == StatusCode::OK);
    let verdict = nodes[0].wait_until("a verdict", |status| {
        status.session.as_ref().is_some_and(|session| session.outcome.is_some())
    });
    let verdict = serde_json::to_value(verdict.session.expect("a session").outcome).expect("JSON");
    assert_eq!(verdict["recorded"]["status"], "complete", "{verdict}");
}
