// SPDX-License-Identifier: MIT OR Apache-2.0
//! The HSU's input lines: a session that a hand switch starts, its edges in both recordings and in a table, and the output
//! that tells other devices.

use crate::lab::{self, assert_contains, fourdbody, text_of};
use fourdbody::export::inputs;
use fourdbody::record::{InputEdge, SessionReader};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

const TRIGGERS: u64 = 40;

#[test]
fn a_hand_switch_starts_a_session_and_its_edges_are_recorded() {
    let dir = tempfile::tempdir().expect("a directory");
    let laboratory = lab::laboratory(dir.path(), 20.0);
    let mut nodes = lab::start_nodes(&laboratory);
    let capture = Command::new(lab::FOURDBODY)
        .args(["capture", "--nodes", &laboratory.urls(), "--name", "switch", "--start-on", "2", "--json"])
        .args(["--triggers", &TRIGGERS.to_string()])
        .stdout(Stdio::piped())
        .spawn()
        .expect("it starts");
    nodes.iter_mut().for_each(|node| {
        node.wait_until("ready", |status| status.phase == fourdbody::control::request::Phase::Ready);
    });
    // Another line, and the wrong edge, start nothing; both are recorded.
    let hsu = &laboratory.hsu;
    hsu.input(5, true);
    hsu.input(2, false);
    std::thread::sleep(Duration::from_millis(500));
    assert_eq!((hsu.fired(), hsu.output()), (0, (false, 0)));
    // The start request may still be on its way; a switch that is pressed too early is pressed again.
    let deadline = Instant::now() + Duration::from_secs(30);
    while hsu.fired() == 0 {
        assert!(Instant::now() < deadline, "the switch starts nothing");
        hsu.input(2, true);
        std::thread::sleep(Duration::from_millis(300));
    }
    while !hsu.output().0 {
        assert!(Instant::now() < deadline, "the output stays low");
        std::thread::sleep(Duration::from_millis(5));
    }
    hsu.input(7, true);
    let captured = capture.wait_with_output().expect("it ends");
    assert!(captured.status.success(), "{}", text_of(&captured));
    assert_eq!(hsu.output(), (false, 1), "high once, and low at the end");

    let session = dir.path().join("sessions/switch");
    assert_eq!(fourdbody(&["verify", &session.display().to_string()]).status.code(), Some(0));
    let reader = SessionReader::open(&session).expect("a session");
    let of = |place: usize| -> Vec<InputEdge> {
        reader.recordings()[place].events.iter().filter_map(InputEdge::of).collect()
    };
    assert_eq!(of(0), of(1), "both nodes heard the same");
    let edges: Vec<_> = inputs::edges(&reader).into_values().collect();
    let seen: Vec<(u8, bool)> = edges.iter().map(|edge| (edge.line, edge.rising)).collect();
    assert_eq!(seen[..3], [(5, true), (2, false), (2, true)]);
    assert_eq!(seen.last(), Some(&(7, true)));

    let out = dir.path().join("table");
    let exported = fourdbody(&[
        "export",
        &session.display().to_string(),
        "--to",
        "csv",
        "--out",
        &out.display().to_string(),
    ]);
    assert_contains(&text_of(&exported), &["inputs.csv", "edges of the HSU's inputs"]);
    let table = std::fs::read_to_string(out.join("inputs.csv")).expect("a table");
    let rows: Vec<Vec<&str>> = table.lines().map(|line| line.split(',').collect()).collect();
    assert_eq!((rows.len(), rows[1][4]), (edges.len() + 1, ""), "before the first trigger there is none");
    let last = rows.last().expect("a row");
    let (trigger, after_ns): (u64, u64) = (last[4].parse().expect("a trigger"), last[5].parse().expect("ns"));
    let row = &reader.recordings()[0].triggers[&fourdbody::base::ids::TriggerIndex(trigger)];
    assert_eq!(row.hsu_time_ns + after_ns, edges.last().expect("an edge").hsu_time_ns);
}

#[test]
fn a_session_that_waits_for_an_edge_can_be_stopped_and_leaves_nothing() {
    let dir = tempfile::tempdir().expect("a directory");
    let laboratory = lab::laboratory(dir.path(), 20.0);
    let mut nodes = lab::start_nodes(&laboratory);
    let capture = Command::new(lab::FOURDBODY)
        .args(["capture", "--nodes", &laboratory.urls(), "--name", "never", "--start-on", "0:falling"])
        .args(["--triggers", "5"])
        .stderr(Stdio::piped())
        .spawn()
        .expect("it starts");
    nodes.iter_mut().for_each(|node| {
        node.wait_until("ready", |status| status.phase == fourdbody::control::request::Phase::Ready);
    });
    std::thread::sleep(Duration::from_millis(500));
    let interrupted = Command::new("kill").args(["-INT", &capture.id().to_string()]).status();
    assert!(interrupted.expect("kill").success());
    let ended = capture.wait_with_output().expect("it ends");
    assert_eq!(ended.status.code(), Some(1), "{}", text_of(&ended));
    assert!(!dir.path().join("sessions/never").exists());
    // The unit is free for the next session, which an edge does not start.
    nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
    laboratory.hsu.input(0, false);
    assert_eq!(laboratory.hsu.fired(), 0);
    let next = lab::capture_whole(&laboratory, "next", 5, &[]);
    assert!(next.status.success(), "{}", text_of(&next));
}
