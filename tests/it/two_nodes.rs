// SPDX-License-Identifier: MIT OR Apache-2.0
//! Captures that a node runs for both, and what becomes of a session when the other node dies (docs/design/operation.md).

use crate::lab::{NodeProcess, assert_contains, capture_whole, fourdbody, laboratory, start_nodes, text_of};
use fourdbody::control::client::NodeClient;
use fourdbody::control::request::Phase;
use fourdbody::control::status::{AbortReason, Outcome, path};
use fourdbody_simulator::laboratory::Laboratory;
use serde_json::{Value, json};
use std::time::{Duration, Instant};

const PATIENCE: Duration = Duration::from_secs(90);

fn begin(client: &NodeClient, series: &Value) {
    client.post(path::CAPTURE, series, PATIENCE).expect("it begins");
}

/// What the node says of its capture once this holds.
fn capture_that(client: &NodeClient, what: &str, holds: impl Fn(&Value) -> bool) -> Value {
    let deadline = Instant::now() + PATIENCE;
    loop {
        let state: Value = client.get(path::CAPTURE).expect("the node answers");
        if holds(&state) {
            return state;
        }
        assert!(Instant::now() < deadline, "never {what}: {state:#}");
        std::thread::sleep(Duration::from_millis(20));
    }
}

fn ended(client: &NodeClient) -> Value {
    capture_that(client, "ended", |state| state["running"] == false)
}

fn recording(client: &NodeClient) {
    capture_that(client, "recording", |state| {
        state["stage"]["stage"] == "recording" && state["stage"]["triggers"].as_u64() > Some(3)
    });
}

/// The reason why a node's last session ended early.
fn reason_of(node: &mut NodeProcess) -> String {
    let status = node.wait_until("idle with a verdict", |status| {
        let outcome = status.session.as_ref().and_then(|session| session.outcome.as_ref());
        status.phase == Phase::Idle && outcome.is_some()
    });
    match status.session.and_then(|session| session.outcome) {
        Some(Outcome::Recorded(verdict)) => verdict["aborted"].as_str().unwrap_or("complete").to_owned(),
        other => panic!("{other:?}"),
    }
}

fn restart(laboratory: &Laboratory, place: usize) -> NodeProcess {
    let node = &laboratory.nodes[place];
    NodeProcess::start(&node.path, node.port)
}

/// A session as any other, from the command line.
fn the_next_session_works(laboratory: &Laboratory, name: &str) {
    let captured = capture_whole(laboratory, name, 6, &[]);
    assert_eq!(captured.status.code(), Some(0), "{}", text_of(&captured));
}

#[test]
fn half_a_rig_is_asked_for_by_name_and_is_never_called_complete() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = laboratory(dir.path(), 20.0);
    let mut nodes = start_nodes(&laboratory);
    let url = nodes[0].client.url().to_owned();
    let mut capture = |name: &str, options: &[&str]| {
        let args = [&["capture", "--nodes", &url, "--triggers", "6", "--name", name], options].concat();
        let done = fourdbody(&args);
        nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
        done
    };
    let refused = capture("half", &[]);
    assert_eq!(refused.status.code(), Some(2), "{}", text_of(&refused));
    assert_contains(&text_of(&refused), &["node b, which does not take part", "--nodes", "--partial"]);
    let session = dir.path().join("sessions/half");
    assert!(!session.exists(), "nothing is left behind");

    let part = capture("half", &["--partial"]);
    assert_eq!(part.status.code(), Some(0), "{}", text_of(&part));
    assert_contains(
        &text_of(&part),
        &["session half: partial", "partial: node b took no part", "node a: complete"],
    );
    let verified = fourdbody(&["verify", &session.display().to_string()]);
    assert_eq!(verified.status.code(), Some(0), "{}", text_of(&verified));
    assert_contains(&text_of(&verified), &["node b", "does not take part"]);
    let told = capture("told", &["--partial", "--json"]);
    let json: Value = serde_json::from_slice(&told.stdout).expect("JSON");
    assert_eq!((&json["verdict"], &json["not_asked"]), (&"partial".into(), &json!(["b"])));
    // Nothing is lost in a dry run; it says what it was of.
    let dry = capture("dry", &["--dry-run"]);
    assert_eq!(dry.status.code(), Some(0), "{}", text_of(&dry));
    assert_contains(&text_of(&dry), &["dry run dry: partial", "node b took no part"]);
    // Whole is whole.
    the_next_session_works(&laboratory, "whole");
}

#[test]
fn a_node_runs_takes_and_dry_runs_for_whoever_asks() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = laboratory(dir.path(), 20.0);
    let mut nodes = start_nodes(&laboratory);
    let [a, b] = &mut nodes[..] else { panic!("two nodes") };
    let client = &b.client;
    begin(client, &json!({ "wish": { "name": "dry", "triggers": 5, "dry_run": true } }));
    // Nobody looks meanwhile: the browser may be gone.
    let dry = ended(client);
    assert_eq!(dry["takes"][0]["verdict"], "complete", "{dry:#}");
    let frames = |take: &Value| -> u64 {
        let cameras = take["nodes"].as_array().into_iter().flatten();
        let cameras = cameras.flat_map(|node| node["session"]["cameras"].as_array().into_iter().flatten());
        cameras.filter_map(|camera| camera["frames"].as_u64()).sum()
    };
    assert_eq!(frames(&dry["takes"][0]), 40);
    assert!(!dir.path().join("sessions/dry").exists(), "a dry run writes nothing");

    let series = json!({ "wish": { "name": "walk", "triggers": 6, "countdown_s": 1 }, "takes": 2 });
    begin(client, &series);
    let refused = client.post(path::CAPTURE, &series, PATIENCE).expect_err("one at a time");
    assert!(refused.message.contains("under way"), "{refused:?}");
    // Which of two is first, a busy host may decide: here it is this one.
    a.wait_until("a take", |status| status.session.as_ref().is_some_and(|s| s.name == "walk-01"));
    let elsewhere = a.client.post(path::CAPTURE, &json!({ "wish": { "triggers": 2 } }), PATIENCE);
    elsewhere.expect("the other node finds out that they are busy");
    assert!(ended(&a.client)["fault"]["message"].as_str().is_some_and(|m| m.contains("busy")));
    let walked = ended(client);
    let takes: Vec<(&str, &str)> = walked["takes"]
        .as_array()
        .into_iter()
        .flatten()
        .filter_map(|take| Some((take["name"].as_str()?, take["verdict"].as_str()?)))
        .collect();
    assert_eq!(takes, [("walk-01", "complete"), ("walk-02", "complete")], "{walked:#}");
    for name in ["walk-01", "walk-02"] {
        let verified = fourdbody(&["verify", &dir.path().join("sessions").join(name).display().to_string()]);
        assert_eq!(verified.status.code(), Some(0), "{}", text_of(&verified));
    }
    a_name_that_is_taken(client);
    a_stop_before_take_two(client);
    for name in ["walk-03", "walk-04", "pair-01"] {
        std::fs::remove_dir_all(dir.path().join("sessions").join(name)).expect("recorded");
    }
    let listed: Value = client.get(path::SESSIONS).expect("a list");
    let names: Vec<&str> =
        listed.as_array().into_iter().flatten().filter_map(|entry| entry["name"].as_str()).collect();
    assert_eq!(names, ["walk-02", "walk-01"]);
}

/// Refused as it stands; numbered where that is asked for, and the numbers go on with the takes.
fn a_name_that_is_taken(client: &NodeClient) {
    begin(client, &json!({ "wish": { "name": "walk-01", "triggers": 4 } }));
    assert_contains(&ended(client)["fault"]["message"].to_string(), &["walk-01"]);
    begin(client, &json!({ "wish": { "name": "walk", "triggers": 4 }, "takes": 2, "number": true }));
    let numbered = ended(client);
    let takes = numbered["takes"].as_array().into_iter().flatten();
    let names: Vec<&str> = takes.filter_map(|take| take["name"].as_str()).collect();
    assert_eq!((names.as_slice(), &numbered["fault"]), (["walk-03", "walk-04"].as_slice(), &Value::Null));
}

/// What was recorded before is what counts; that the rest did not come is said, and is no failure.
fn a_stop_before_take_two(client: &NodeClient) {
    begin(client, &json!({ "wish": { "name": "pair", "triggers": 4, "countdown_s": 5 }, "takes": 2 }));
    let second = |state: &Value| state["take"] == 2 && state["stage"]["stage"] == "counting_down";
    capture_that(client, "counting down to take 2", second);
    client.post(path::CAPTURE_STOP, &(), PATIENCE).expect("stopped");
    let pair = ended(client);
    assert_eq!(
        (&pair["fault"], &pair["takes"][0]["verdict"]),
        (&Value::Null, &"complete".into()),
        "{pair:#}"
    );
    assert_contains(&pair["stopped"].to_string(), &["take 2 of 2", "before it recorded anything"]);
}

#[test]
fn a_countdown_can_be_stopped_and_a_session_aborted_at_any_node() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = laboratory(dir.path(), 20.0);
    let mut nodes = start_nodes(&laboratory);
    begin(&nodes[0].client, &json!({ "wish": { "name": "early", "countdown_s": 60 } }));
    capture_that(&nodes[0].client, "counting", |state| state["stage"]["stage"] == "counting_down");
    nodes[0].client.post(path::CAPTURE_STOP, &(), PATIENCE).expect("stopped");
    let early = ended(&nodes[0].client);
    assert_contains(&early["fault"]["message"].to_string(), &["before the start", "nothing was recorded"]);
    nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
    assert!(!dir.path().join("sessions/early").exists());

    begin(&nodes[0].client, &json!({ "wish": { "name": "given-up" } }));
    recording(&nodes[0].client);
    let reason = AbortReason { reason: Some("the subject sneezed".to_owned()) };
    nodes[0].client.post(path::CAPTURE_ABORT, &reason, PATIENCE).expect("aborted");
    assert_eq!(ended(&nodes[0].client)["takes"][0]["verdict"], "aborted");
    // The node that is told second may have closed by then: the train has ended, and it has all of it.
    let reasons: Vec<String> = nodes.iter_mut().map(reason_of).collect();
    assert!(reasons.iter().any(|reason| reason.contains("sneezed")), "{reasons:?}");

    // Begun at one node, stopped at the other.
    begin(&nodes[0].client, &json!({ "wish": { "name": "elsewhere" } }));
    recording(&nodes[0].client);
    nodes[1].client.post(path::CAPTURE_STOP, &(), PATIENCE).expect("stopped");
    assert_eq!(ended(&nodes[0].client)["takes"][0]["verdict"], "complete");
    the_next_session_works(&laboratory, "after");
}

/// The coordinating node is killed: the other finds out that it was restarted.
#[test]
fn a_node_that_was_restarted_ends_the_session_of_the_other() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = laboratory(dir.path(), 20.0);
    let mut nodes = start_nodes(&laboratory);
    begin(&nodes[0].client, &json!({ "wish": { "name": "broken" } }));
    recording(&nodes[0].client);
    nodes[0].kill();
    nodes[0] = restart(&laboratory, 0);
    let reason = reason_of(&mut nodes[1]);
    // On a busy host it may be back too late to say so itself.
    let told = ["left the session", "has not answered"].iter().any(|why| reason.contains(why));
    assert!(reason.contains("node a") && told, "{reason}");
    let found = nodes[0].wait_ready();
    assert!(
        found.interrupted.iter().any(|left| left.session.as_str() == "broken"),
        "{:?}",
        found.interrupted
    );
    the_next_session_works(&laboratory, "after");
}

/// The same, but it stays dead.
#[test]
fn a_node_that_stays_dead_ends_the_session_of_the_other() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = laboratory(dir.path(), 20.0);
    let mut nodes = start_nodes(&laboratory);
    begin(&nodes[0].client, &json!({ "wish": { "name": "broken" } }));
    recording(&nodes[0].client);
    nodes[0].kill();
    let reason = reason_of(&mut nodes[1]);
    assert!(reason.contains("node a has not answered"), "{reason}");
    nodes[0] = restart(&laboratory, 0);
    nodes.iter_mut().for_each(|node| drop(node.wait_ready()));
    the_next_session_works(&laboratory, "after");
}
