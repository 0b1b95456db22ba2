// SPDX-License-Identifier: MIT OR Apache-2.0
//! The light of a session in the console and the API: whether its calibration held, in words. A quarter of a minute.

use crate::browser::Browser;
use crate::lab::{NodeProcess, SIZE, options, small_rig, start, start_nodes};
use fourdbody::base::time::host_time_ns;
use fourdbody::calibrate::drift::history::{Checked, History, Verdict};
use fourdbody::worker::state::{Activity, OWN_DIR, WorkerState};
use hyper::{Method, StatusCode};
use serde_json::{Value, json};
use std::time::{Duration, Instant};

fn capture(node: &mut NodeProcess, name: &str) -> String {
    let wish = json!({ "wish": { "name": name, "duration_s": 0.5 } });
    node.client.post("/api/v1/capture", &wish, Duration::from_secs(30)).expect("it begins");
    let deadline = Instant::now() + Duration::from_secs(60);
    loop {
        let listed: Value = node.client.get(&format!("/api/v1/sessions/{name}")).unwrap_or_default();
        if let Some(id) = listed["session_id"].as_str().filter(|_| !listed["verdict"].is_null()) {
            return id.to_owned();
        }
        assert!(Instant::now() < deadline, "never recorded: {listed}");
        std::thread::sleep(Duration::from_millis(100));
    }
}

#[test]
fn a_session_has_a_light_with_words() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let results = dir.path().join("results");
    let laboratory = start(&options(small_rig(20.0), dir.path()), SIZE);
    let file = &laboratory.nodes[0].path;
    let text = std::fs::read_to_string(file).expect("a node file");
    std::fs::write(file, format!("{text}\n[worker]\nresults = \"{}\"\n", results.display()))
        .expect("writable");
    let mut nodes = start_nodes(&laboratory);
    let session_id = capture(&mut nodes[0], "walk");
    let lights =
        |node: &NodeProcess| -> Value { node.client.get("/api/v1/calibration-lights").expect("an answer") };
    let alone = lights(&nodes[1]);
    assert_eq!((&alone["worker"], &alone["sessions"]), (&json!(false), &json!([])), "{alone}");
    assert!(alone["otherwise"].as_str().is_some_and(|said| said.contains("names no worker")), "{alone}");

    let plot = |node: &NodeProcess, path: &str| {
        node.client.ask(Method::GET, path, None, Duration::from_secs(10)).expect("an answer")
    };
    assert_eq!(plot(&nodes[0], "/api/v1/calibration-lights/plot").status, StatusCode::NOT_FOUND);
    let browser = Browser::start();
    if let Some(browser) = &browser {
        browser.open(&format!("http://127.0.0.1:{}/", laboratory.nodes[0].port));
        browser.wait_text("verdict-light", "no worker has run");
        assert_eq!(browser.run("return document.getElementById('verdict-light').className"), "light grey");
    }
    let state =
        WorkerState { activity: Activity::Idle, written_ns: host_time_ns(), ..WorkerState::default() };
    std::fs::create_dir_all(results.join(OWN_DIR)).expect("writable");
    state.store(&results).expect("writable");
    if let Some(browser) = &browser {
        browser.wait_text("verdict-light", "not checked yet");
    }
    let verdicts = [
        (Verdict::Turned, "amber", "a device has moved a little"),
        (Verdict::CalibrateAgain, "red", "calibrate again"),
        (Verdict::NotKnown, "grey", "not checked"),
        (Verdict::Stands, "green", "OK, nothing has moved"),
    ];
    for (verdict, light, word) in verdicts {
        let said = format!("said of {light} <b>");
        let checked = Checked {
            recorded_ns: 1,
            session: "walk".to_owned(),
            session_id: session_id.clone(),
            calibration_sha256: "c0".to_owned(),
            verdict,
            said: said.clone(),
            most_mm: 0.2,
            devices: Vec::new(),
        };
        History::open(&results.join(OWN_DIR)).expect("writable").add(checked).expect("writable");
        let expected = json!([{ "session": "walk", "session_id": session_id, "light": light, "said": said }]);
        let deadline = Instant::now() + Duration::from_secs(30);
        while lights(&nodes[0])["sessions"] != expected {
            assert!(Instant::now() < deadline, "never {expected}: {}", lights(&nodes[0]));
            std::thread::sleep(Duration::from_millis(100));
        }
        // The other node passes it on.
        let passed: Value = nodes[1].client.get("/api/v1/peers/a/calibration-lights").expect("an answer");
        assert_eq!(passed["sessions"], expected);
        let Some(browser) = &browser else { continue };
        browser.wait_text("verdict-light", &format!("calibration, walk: {word} ({said})"));
        let shown = format!(
            "return document.getElementById('verdict-light').className === 'light {light}' &&
                document.querySelector('[data-name=\"walk\"] .light.{light}').textContent.startsWith('calibration: {word}')"
        );
        browser.wait(light, &shown);
        browser.keep(&format!("light-{light}"));
    }
    for (node, path) in
        [(0, "/api/v1/calibration-lights/plot"), (1, "/api/v1/peers/a/calibration-lights/plot")]
    {
        let answer = plot(&nodes[node], path);
        assert_eq!(answer.status, StatusCode::OK, "{path}");
        assert_eq!(answer.content_type.expect("stated"), "image/svg+xml");
        assert!(answer.body.starts_with(b"<svg ") && answer.body.ends_with(b"</svg>\n"), "{path}");
    }
    if let Some(browser) = &browser {
        let href = "return document.getElementById('calibration-plot').href";
        let href = browser.run(href).as_str().expect("a link").to_owned();
        browser.open(&href);
        browser.wait(
            "drawn",
            "return document.querySelector('title')?.textContent.startsWith('How far each device')",
        );
    }
    if browser.is_none() {
        println!("the page was not looked at: no browser (Debian packages chromium and chromium-driver)");
    }
}
