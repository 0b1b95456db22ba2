// SPDX-License-Identifier: MIT OR Apache-2.0
//! The operator's console in a real browser, served by real nodes in front of the simulator.

use crate::analytic_scene::{photograph, sphere};
use crate::api_node::new_token;
use crate::browser::Browser;
use crate::lab::{NodeProcess, options, rig_of};
use fourdbody::base::image::Plane;
use fourdbody::control::client::{Credentials, NodeClient};
use fourdbody::data::Calibration;
use fourdbody::reconstruct::triangulate::camera_projector::CameraProjector;
use fourdbody_simulator::images::ImageSource;
use fourdbody_simulator::laboratory::{Laboratory, LaboratoryOptions};
use nalgebra::Point3;
use serde_json::Value;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// A camera that sends one photograph again and again.
pub struct Still(pub Plane<u8>);

impl ImageSource for Still {
    fn size(&self) -> (usize, usize) {
        (self.0.width(), self.0.height())
    }

    fn pixels(&self, _: i64) -> &[u8] {
        self.0.as_slice()
    }
}

/// Eight cameras around a ball, tokens for everybody, nodes that know each other and take quick looks.
fn laboratory(dir: &Path) -> Laboratory {
    let rig_text = rig_of(5.0, (1920, 1200));
    let rig = fourdbody::config::Rig::from_table(&rig_text.parse().expect("TOML")).expect("a rig");
    let calibration = Calibration::nominal(&rig);
    let file = dir.join("calibration.json");
    calibration.save(&file).expect("writable");
    let mut cameras = calibration.heads.iter().flat_map(|head| head.cameras.iter().map(move |c| (head, c)));
    let options = LaboratoryOptions { calibration: Some(file), ..options(rig_text, dir) };
    let options = LaboratoryOptions { socket: fourdbody::config::SocketMode::Standard, ..options };
    let laboratory = Laboratory::start(&options, |_| {
        let (head, camera) = cameras.next().expect("eight cameras");
        let pair = CameraProjector::new(head, camera, &calibration).expect("a usable pair");
        Arc::new(Still(photograph(&pair, sphere(Point3::new(0.0, 0.0, 1.03), 0.25)))) as _
    });
    let laboratory = laboratory.expect("the laboratory starts");
    for (name, role) in [("otto", "operate"), ("peer", "peer")] {
        new_token(dir, name, role, false);
    }
    for node in &laboratory.nodes {
        let text = std::fs::read_to_string(&node.path).expect("written");
        let text = text.replace("[api]\n", "[api]\ntokens = \"tokens\"\n");
        let text = text.replace("[[api.peers]]\n", "[[api.peers]]\ntoken_file = \"peer.token\"\n");
        std::fs::write(&node.path, text).expect("writable");
    }
    laboratory
}

fn start_nodes(laboratory: &Laboratory, dir: &Path) -> Vec<NodeProcess> {
    let start = |node: &fourdbody_simulator::laboratory::NodeFile| {
        let mut process = NodeProcess::start(&node.path, node.port);
        let credentials = Credentials { token_file: Some(dir.join("otto.token")), ca: None };
        process.client =
            NodeClient::with(&format!("http://127.0.0.1:{}", node.port), &credentials).expect("a client");
        process
    };
    let mut nodes: Vec<NodeProcess> = laboratory.nodes.iter().map(start).collect();
    nodes.iter_mut().for_each(|node| drop(node.wait_ready()));
    nodes
}

/// What every camera's box says of the newest picture.
const TRIGGERS: &str = "return JSON.stringify([...document.querySelectorAll('.camera')].map((box) =>
    [box.querySelector('img').naturalWidth, box.dataset.trigger]))";

#[test]
fn an_operator_sees_what_happens() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let Some(browser) = Browser::start() else {
        println!("skipped: no browser (Debian packages chromium and chromium-driver)");
        return;
    };
    let mut laboratory = laboratory(dir.path());
    let mut nodes = start_nodes(&laboratory, dir.path());
    browser.open(&format!("http://127.0.0.1:{}/", laboratory.nodes[0].port));
    browser.resize((1920, 1080), false);
    log_in(&browser, dir.path());
    let has_body = watch_previews(&browser);
    a_camera_is_unplugged(&browser, &mut laboratory, has_body);
    laboratory.plug(3).expect("the camera starts");
    browser.wait("no camera in trouble", "return document.querySelectorAll('.camera.bad').length === 0");
    nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
    a_complete_session_is_looked_at(&browser);
    browser.wait(
        "both sessions listed",
        "const rows = document.getElementById('session-rows').innerText;
         return /INCOMPLETE\\s+broken/.test(rows) && /\\bCOMPLETE\\s+whole/.test(rows)",
    );
    log_out_and_in(&browser, dir.path());
    nodes[0].kill();
    browser.wait("told that the node is gone", "return !document.getElementById('gone').hidden");
    browser.wait_word("NO ANSWER");
    browser.wait("nothing can be begun", "return document.getElementById('start').disabled");
    browser.keep("node-gone");
}

fn log_in(browser: &Browser, dir: &Path) {
    browser.wait("asked for a token", "return !document.getElementById('login').hidden");
    browser.type_in("token", "wrong");
    browser.run("document.querySelector('#login button').click()");
    browser.wait_text("login-problem", "does not know the token");
    let told = browser.text("login-problem");
    assert!(!told.contains("Authorization") && !told.contains("Bearer"), "a header is no help: {told}");
    browser.keep("login");
    enter_token(browser, dir);
    assert_eq!(browser.text("who"), "otto (operate)");
    assert_eq!(browser.run("return document.cookie"), "", "no script may read the login");
    browser.wait("READY", NO_BROKEN_PICTURE);
}

/// Where a camera has no picture yet there is no icon of a broken one.
const NO_BROKEN_PICTURE: &str = "const boxes = [...document.querySelectorAll('.camera')];
    return boxes.length === 8 && boxes.every((box) => box.querySelector('img').naturalWidth > 0 || box.querySelector('img').hidden)";

fn enter_token(browser: &Browser, dir: &Path) {
    let secret = std::fs::read_to_string(dir.join("otto.token")).expect("written");
    browser.type_in("token", secret.trim());
    browser.run("document.querySelector('#login button').click()");
    browser.wait("logged in", "return !document.getElementById('console').hidden");
    browser.wait_word("READY");
}

/// After a logout the cookie opens nothing.
fn log_out_and_in(browser: &Browser, dir: &Path) {
    browser.run("document.getElementById('logout').click()");
    browser.wait("asked for a token again", "return !document.getElementById('login').hidden");
    let status = "return (async () => (await fetch('/api/v1/status')).status)()";
    assert_eq!(browser.run(status), 401, "the cookie is worth nothing any more");
    enter_token(browser, dir);
}

/// Eight pictures, upright, that change without a press; a key stops them, and starts them again. Whether there is a live
/// body, too.
fn watch_previews(browser: &Browser) -> bool {
    let all = "return document.querySelectorAll('.camera').length === 8 && [...document.querySelectorAll('.camera img')]
        .every((picture) => picture.naturalWidth === 300 && picture.naturalHeight === 480)";
    browser.wait("eight pictures", all);
    let first = browser.run(TRIGGERS);
    browser.wait("pictures that move", &format!("{TRIGGERS} !== {first}"));
    let good = "return document.querySelectorAll('.camera[data-sign=\"good\"]').length === 8";
    browser.wait("light that is good in every camera", good);
    browser.run("document.querySelector('#camera-h0_up .frame').click()");
    browser.wait(
        "the figures behind the sign",
        "return /stripes\\s+\\d+ DN/.test(document.getElementById('large').innerText)",
    );
    let sharp = "const square = document.getElementById('large-pixels'); return !square.hidden && square.naturalWidth === 240";
    browser.wait("a square in full size", sharp);
    let places = || {
        browser.run("const mark = document.getElementById('large-mark').style; return [mark.left, mark.top]")
    };
    browser.drag("large-box", (60, 40));
    let clicked = places();
    browser.press("\u{E012}");
    assert_ne!(clicked, places(), "an arrow key moves the square");
    browser.keep("camera");
    browser.press("\u{E00C}");
    let has_body = a_live_body_is_shown(browser);
    assert!(
        browser.text("word").starts_with("READY") && browser.text("detail").contains("nothing is recorded")
    );
    browser.keep("ready");
    browser.press("p");
    browser
        .wait("pictures that stand still", "return document.querySelectorAll('.camera.live').length === 0");
    assert_eq!(browser.run("return document.getElementById('look').ariaPressed"), "false");
    browser.press("p");
    browser.wait("pictures again", "return document.querySelectorAll('.camera.live').length === 8");
    has_body
}

/// Of all cameras. Bodies are made at the lowest priority: where other programs leave too little for that, the page has to
/// name it. Whether there is a body.
fn a_live_body_is_shown(browser: &Browser) -> bool {
    let body = "const canvas = document.getElementById('live-canvas');
        return document.getElementById('live-body').className === '' && canvas.dataset.cameras === '8' && Number(canvas.dataset.points) > 5000";
    let begin = Instant::now();
    while browser.run(body) != true {
        let said = browser.text("live-detail");
        if begin.elapsed() > Duration::from_secs(60)
            && ["has no time for it", "4 of 8 cameras"].iter().any(|named| said.contains(named))
        {
            println!("this host is too busy for a live body of both nodes: {said}");
            return false;
        }
        assert!(begin.elapsed() < Duration::from_secs(120), "no live body, and no reason: {said}");
        std::thread::sleep(Duration::from_millis(50));
    }
    browser.wait_text("live-detail", "8 of 8 cameras");
    wait_for_new_body(browser);
    true
}

fn wait_for_new_body(browser: &Browser) {
    let number = browser.run("return document.getElementById('live-canvas').dataset.number");
    let moved = format!("return document.getElementById('live-canvas').dataset.number !== {number}");
    browser.wait("a live body that goes on", &moved);
}

fn a_camera_is_unplugged(browser: &Browser, laboratory: &mut Laboratory, has_body: bool) {
    browser.type_in("name", "broken");
    browser.type_in("seconds", "");
    browser.press("r");
    browser.wait_word("RECORDING");
    browser.wait("triggers", "return parseFloat(document.getElementById('clock').textContent) > 0.5");
    // Triggers are counted anew in each session, and the page stays open.
    if has_body {
        wait_for_new_body(browser);
    }
    browser.keep("recording");
    laboratory.unplug(3);
    let took = browser.wait(
        "told of the camera",
        "return document.getElementById('detail').textContent.includes('h1_low') &&
            document.getElementById('camera-h1_low').classList.contains('bad')",
    );
    println!("the page named the unplugged camera after {} ms", took.as_millis());
    browser.keep("unplugged");
    browser.press("s");
    browser.wait_verdict("INCOMPLETE");
    let detail = browser.text("verdict-detail");
    assert!(detail.contains("h1_low") && detail.contains("unplugged"), "{detail}");
    browser.keep("incomplete");
}

fn a_complete_session_is_looked_at(browser: &Browser) {
    browser.type_in("name", "whole");
    browser.type_in("seconds", "1");
    browser.press("r");
    browser.wait_verdict("COMPLETE");
    let shown = "return Number(document.getElementById('cloud-canvas').dataset.points ?? 0) > 10000";
    browser.wait("a cloud", shown);
    let drawn = || browser.run("return document.getElementById('cloud-canvas').toDataURL()");
    // A busy page draws some time after it has the key.
    let turned = |before: &Value, by: &str| {
        let begin = Instant::now();
        loop {
            let now = drawn();
            if now != *before {
                return now;
            }
            let shown = browser.run(
                "return [document.getElementById('body').dataset.shows, document.activeElement.outerHTML]",
            );
            assert!(begin.elapsed() < Duration::from_secs(30), "{by} does not turn it: {shown}");
        }
    };
    let before = drawn();
    browser.drag("cloud-canvas", (120, 30));
    turned(&before, "the mouse");
    // All that the mouse did is drawn.
    let before = std::iter::successors(Some(drawn()), |last| Some(drawn()).filter(|now| now != last)).last();
    browser.press("\u{E012}");
    let before = turned(&before.expect("a picture"), "an arrow key without a click first");
    browser.press("4");
    turned(&before, "the key of the view from above");
    browser.press("1");
    browser.keep("complete");
    // Keep changes no note, also where the list does not have the take now.
    browser.run(
        "const note = document.querySelector('[data-name=\"whole\"] input');
         note.value = 'left arm'; note.dispatchEvent(new Event('change'))",
    );
    let search = |text: &str| {
        browser.type_in("search", text);
        browser.run("document.getElementById('search').dispatchEvent(new Event('input'))");
    };
    search("left arm");
    browser.wait(
        "the note is kept",
        "return document.querySelectorAll('#session-rows > [data-name]').length === 1",
    );
    search("nothing of this name");
    browser.wait(
        "a list without the take",
        "return document.querySelectorAll('#session-rows > [data-name]').length === 0",
    );
    browser.run("document.getElementById('keep').click()");
    search("left arm");
    browser.wait("the take is called good", "return document.querySelector('[data-name=\"whole\"] [aria-pressed=\"true\"]')?.textContent === 'Good'");
    assert_eq!(browser.run("return document.getElementById('body').dataset.shows"), "live");
    assert_eq!(browser.run("return document.querySelector('[data-name=\"whole\"] input').value"), "left arm");
    search("");
}
