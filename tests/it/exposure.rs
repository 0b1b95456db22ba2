// SPDX-License-Identifier: MIT OR Apache-2.0
//! Exposure and gain set between sessions, over the API and from the page: read back, recorded, checked by the session,
//! refused where they cannot be, and gone with the node's process. Half a minute.

use crate::browser::Browser;
use crate::lab::{NodeProcess, capture_whole, laboratory, start_nodes, text_of};
use fourdbody::api::AuditLine;
use fourdbody::control::status::NodeStatus;
use fourdbody::record::SessionReader;
use fourdbody_simulator::laboratory::Laboratory;
use hyper::{Method, StatusCode};
use serde_json::{Value, json};
use std::path::Path;
use std::time::Duration;

fn expose(node: &NodeProcess, path: &str, request: &Value) -> (StatusCode, Value) {
    let body = Some(request.to_string().into_bytes());
    let answer = node.client.ask(Method::POST, path, body, Duration::from_secs(60)).expect("an answer");
    (answer.status, serde_json::from_slice(&answer.body).expect("JSON"))
}

/// What the cameras took, as {camera, feature, value}.
fn taken(set: &Value) -> Vec<(String, String, f64)> {
    let text = |value: &Value| value.as_str().expect("text").to_owned();
    let mut taken = Vec::new();
    for camera in set["cameras"].as_array().expect("cameras") {
        for setting in camera["taken"].as_array().expect("settings") {
            if let Some(actual) = setting["actual"].as_f64() {
                taken.push((text(&camera["id"]), text(&setting["feature"]), actual));
            }
        }
    }
    taken
}

/// Exposure of each camera of the first node, and whether it is not as in its file.
fn asked(status: &NodeStatus) -> Vec<(f64, bool)> {
    let now = status.cameras.iter().map(|camera| camera.exposure.clone().expect("known"));
    now.map(|now| (now.exposure_us.expect("a word"), now.differs)).collect()
}

fn recorded(dir: &Path, session: &str, camera: &str) -> (Value, String) {
    let reader = SessionReader::open(&dir.join("sessions").join(session)).expect("recorded");
    let mut cameras = reader.recordings().iter().flat_map(|recording| &recording.header.cameras);
    let header = cameras.find(|header| header.id.as_str() == camera).expect("there");
    let exposure = header.settings.iter().find(|setting| setting.feature == "ExposureTime").expect("set");
    (serde_json::to_value(&exposure.value).expect("JSON"), header.state["ExposureTime"].to_string())
}

fn capture(laboratory: &Laboratory, name: &str) {
    let captured = capture_whole(laboratory, name, 12, &[]);
    assert_eq!(captured.status.code(), Some(0), "{}", text_of(&captured));
}

#[test]
fn exposure_and_gain_are_set_between_sessions_and_hold_until_the_node_ends() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = laboratory(dir.path(), 20.0);
    let mut nodes = start_nodes(&laboratory);
    let both = json!({ "heads": ["h0", "h2"], "exposure_us": 1600.0, "gain_db": 3.0 });
    for (path, cameras) in
        [("/api/v1/exposure", ["h0_up", "h0_low"]), ("/api/v1/peers/b/exposure", ["h2_up", "h2_low"])]
    {
        let (status, set) = expose(&nodes[0], path, &both);
        assert_eq!(status, StatusCode::OK, "{set}");
        let expected = cameras.iter().flat_map(|id| {
            [("ExposureTime", 1600.0), ("Gain", 3.0)].map(|(name, x)| ((*id).to_owned(), name.to_owned(), x))
        });
        assert_eq!(taken(&set), expected.collect::<Vec<_>>(), "{set}");
    }
    what_cannot_be_is_refused_and_changes_nothing(&nodes[0]);
    capture(&laboratory, "longer");
    for (camera, us) in [("h0_low", 1600.0), ("h2_up", 1600.0), ("h1_up", 1000.0)] {
        let (exposure, state) = recorded(dir.path(), "longer", camera);
        assert_eq!(exposure.as_f64(), Some(us), "{camera}");
        assert!(state.contains(&us.to_string()), "{camera}: {state}");
    }
    who_set_what_is_in_both_audit_logs(dir.path());
    the_page_sets_it_and_the_preview_goes_on(&laboratory, &mut nodes);
    nodes[0].kill();
    nodes[0] = NodeProcess::start(&laboratory.nodes[0].path, laboratory.nodes[0].port);
    assert_eq!(asked(&nodes[0].wait_ready()), [(1000.0, false); 4], "the node file holds");
    capture(&laboratory, "as-in-the-file");
    assert_eq!(recorded(dir.path(), "as-in-the-file", "h0_low").0.as_f64(), Some(1000.0));
}

fn what_cannot_be_is_refused_and_changes_nothing(node: &NodeProcess) {
    let cases = [
        (json!({ "heads": ["h0"], "exposure_us": 60_000.0 }), "ends within the trigger period"),
        (json!({ "heads": ["h0"], "exposure_us": 0.0 }), "ends within the trigger period"),
        (json!({ "heads": ["h0", "h9"], "exposure_us": 900.0 }), "found \"h9\""),
        (json!({ "heads": [], "exposure_us": 900.0 }), "found none"),
        (json!({ "heads": ["h0"] }), "found neither"),
        (json!({ "heads": ["h0"], "gain_db": -1.0 }), "expected a gain"),
        // The rig has nothing against it, the camera has.
        (json!({ "heads": ["h1", "h0"], "gain_db": 99.0 }), "nothing was changed"),
    ];
    for (request, why) in cases {
        let (status, fault) = expose(node, "/api/v1/exposure", &request);
        assert_eq!(status, StatusCode::CONFLICT, "{request}: {fault}");
        assert!(fault["message"].as_str().is_some_and(|message| message.contains(why)), "{request}: {fault}");
    }
    let status = node.client.status().expect("an answer");
    assert_eq!(asked(&status), [(1600.0, true), (1600.0, true), (1000.0, false), (1000.0, false)]);
    let begun = json!({ "wish": { "name": "busy", "dry_run": true }, "takes": 1 });
    node.client.post("/api/v1/capture", &begun, Duration::from_secs(30)).expect("it begins");
    while node.client.status().is_ok_and(|status| status.session.is_none_or(|session| session.triggers == 0))
    {
        std::thread::sleep(Duration::from_millis(20));
    }
    let (status, fault) = expose(node, "/api/v1/exposure", &json!({ "heads": ["h0"], "exposure_us": 900.0 }));
    assert_eq!(status, StatusCode::CONFLICT, "{fault}");
    assert!(fault["message"].as_str().is_some_and(|message| message.contains("in a session (Running)")));
    node.client.post("/api/v1/capture/stop", &json!({}), Duration::from_secs(30)).expect("told");
    while node.client.get::<Value>("/api/v1/capture").is_ok_and(|capture| capture["running"] == true) {
        std::thread::sleep(Duration::from_millis(20));
    }
}

const LIVE: &str = "return document.querySelectorAll('.camera.live').length === 8";

fn who_set_what_is_in_both_audit_logs(dir: &Path) {
    for (node, request) in [("a", "POST /api/v1/exposure"), ("b", "POST /api/v1/exposure")] {
        let text = std::fs::read_to_string(dir.join(format!("audit-{node}.jsonl"))).expect("a log");
        let lines = text.lines().map(|line| serde_json::from_str::<AuditLine>(line).expect("a line"));
        let line = lines.into_iter().find(|line| line.what == request && line.status == 200);
        let line = serde_json::to_string(&line.expect("in the log")).expect("JSON");
        assert!(line.contains("1600"), "{line}");
        assert_eq!(line.contains("on_behalf_of"), node == "b", "{line}");
    }
}

fn the_page_sets_it_and_the_preview_goes_on(laboratory: &Laboratory, nodes: &mut [NodeProcess]) {
    let Some(browser) = Browser::start() else {
        println!("the page was not looked at: no browser (Debian packages chromium and chromium-driver)");
        return;
    };
    browser.open(&format!("http://127.0.0.1:{}/", laboratory.nodes[0].port));
    browser.wait_word("READY");
    browser.wait("live pictures", LIVE);
    browser.press("e");
    let row = "const row = document.querySelector('[data-head=\"h3\"]');";
    browser.wait("four heads", "return document.querySelectorAll('#exposure-heads form').length === 4");
    browser.keep("exposure");
    let advised = format!(
        "{row} row.querySelector('button').click(); const us = Number(row.querySelector('input').value); return us > 100 && us < 1000"
    );
    browser.wait("less, as the pictures are saturated", &advised);
    let set = |us: &str| {
        browser.run(&format!(
            "{row} row.querySelector('input').value = {us:?}; row.querySelector('input').dispatchEvent(new Event('input'));
             row.querySelector('.go').click()"
        ));
    };
    set("70000");
    browser.wait_text("exposure-said", "node b: head h3: expected an exposure");
    set("1250");
    browser.wait_text("exposure-said", "h3_low: set to 1250 us, 0 dB (ExposureTime 1250, Gain 0");
    browser.wait_text("exposure-said", "To keep it, write into the node file");
    browser.wait(
        "shown as another than the file's",
        &format!("{row} return row.textContent.includes('1250 us') && row.textContent.includes('not as in the node file')"),
    );
    browser.keep("exposure-set");
    for (size, phone) in [((1366, 768), false), ((390, 844), true), ((1920, 1080), false)] {
        browser.resize(size, phone);
        let whole = "const box = document.getElementById('exposure').getBoundingClientRect();
            const cut = [...document.querySelectorAll('#exposure button, #exposure .facts')].filter((e) => e.scrollWidth > e.clientWidth + 1);
            return box.left >= 0 && box.right <= innerWidth && box.top >= 0 && box.bottom <= innerHeight && cut.length === 0";
        browser.wait(&format!("seen whole at {size:?}"), whole);
    }
    browser.run("document.getElementById('exposure-close').click()");
    browser.wait("live pictures again", LIVE);
    let now = asked(&nodes[1].wait_idle());
    assert_eq!(now, [(1600.0, true), (1600.0, true), (1250.0, true), (1250.0, true)]);
    nodes[0].wait_idle();
}
