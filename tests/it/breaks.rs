// SPDX-License-Identifier: MIT OR Apache-2.0
//! Sessions that end otherwise than planned: every outcome is accounted for, and nothing hangs.

use crate::lab::{NodeProcess, fourdbody, laboratory, start_capture, start_nodes, text_of};
use fourdbody_simulator::laboratory::Laboratory;
use std::path::Path;
use std::process::{Child, Command, Output};

/// A capture until stopped, and waits until its train runs.
fn running_capture(laboratory: &Laboratory, nodes: &mut [NodeProcess], name: &str) -> Child {
    let child = start_capture(laboratory, name);
    for node in nodes {
        node.wait_until("ten triggers", |status| {
            status
                .session
                .as_ref()
                .is_some_and(|s| s.name == name && s.triggers >= 10 && s.cameras.iter().all(|c| c.frames > 5))
        });
    }
    child
}

fn signal(signal: &str, pid: u32) {
    let sent = Command::new("kill").args([signal, &pid.to_string()]).status().expect("kill is installed");
    assert!(sent.success());
}

fn verify(dir: &Path, name: &str) -> Output {
    fourdbody(&["verify", &dir.join("sessions").join(name).display().to_string()])
}

#[test]
fn ctrl_c_ends_a_session_that_runs_until_stopped() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = laboratory(dir.path(), 20.0);
    let mut nodes = start_nodes(&laboratory);
    let capture = running_capture(&laboratory, &mut nodes, "stopped");
    signal("-INT", capture.id());
    let output = capture.wait_with_output().expect("it ends");
    assert_eq!(output.status.code(), Some(0), "{}", text_of(&output));
    assert!(text_of(&output).contains("session stopped: complete"), "{}", text_of(&output));
    let verified = verify(dir.path(), "stopped");
    assert_eq!(verified.status.code(), Some(0), "{}", text_of(&verified));
}

#[test]
fn a_node_that_is_killed_loses_at_most_its_last_chunks_and_the_other_ends_accounted() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = laboratory(dir.path(), 20.0);
    let mut nodes = start_nodes(&laboratory);
    let capture = running_capture(&laboratory, &mut nodes, "killed");
    signal("-KILL", nodes[0].pid());
    let output = capture.wait_with_output().expect("it ends");
    assert_eq!(output.status.code(), Some(3), "{}", text_of(&output));
    nodes[1].wait_idle();

    let survivor = fourdbody(&["verify", &dir.path().join("sessions/killed/node-b").display().to_string()]);
    assert!(matches!(survivor.status.code(), Some(0 | 3)), "{}", text_of(&survivor));
    // The dead node's recording is unfinished, but what was flushed is there and intact.
    let dead = dir.path().join("sessions/killed/node-a");
    let unfinished = fourdbody(&["verify", &dead.display().to_string()]);
    assert_eq!(unfinished.status.code(), Some(4), "{}", text_of(&unfinished));
    let reader = fourdbody::record::SessionReader::open(&dead).expect("readable");
    use fourdbody::data::{Frame, FrameSource};
    let images = reader.triggers().flat_map(|t| reader.cameras().iter().map(move |c| (c.clone(), t)));
    let images: Vec<_> = images.collect();
    let intact = images.iter().filter(|(camera, trigger)| {
        matches!(reader.frame(camera, fourdbody::base::ids::TriggerIndex(*trigger)), Ok(Frame::Owned(_)))
    });
    assert!(intact.count() >= 4, "some of the first frames must have reached the disk");
}

#[test]
fn a_node_that_is_told_to_shut_down_answers_until_its_verdict_was_read() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = laboratory(dir.path(), 20.0);
    let mut nodes = start_nodes(&laboratory);
    let capture = running_capture(&laboratory, &mut nodes, "terminated");
    signal("-TERM", nodes[0].pid());
    let output = capture.wait_with_output().expect("it ends");
    let text = text_of(&output);
    assert!(text.contains("the node was shut down"), "{text}");
    assert!(!text.contains("does not answer"), "the verdict of node a was not read: {text}");
    assert!(!output.status.success(), "{text}");
    nodes[0].wait_exit();
    nodes[1].wait_idle();
    let verified = verify(dir.path(), "terminated");
    assert!(matches!(verified.status.code(), Some(0 | 3)), "{}", text_of(&verified));
}

#[test]
fn what_the_system_refuses_is_told_by_status_and_recording() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = laboratory(dir.path(), 20.0);
    for node in &laboratory.nodes {
        let text = std::fs::read_to_string(&node.path).expect("the node file");
        // No kernel that this runs on has so many cores.
        std::fs::write(&node.path, format!("{text}\n[realtime]\ncpus = [1023]\n")).expect("written");
    }
    let mut nodes = start_nodes(&laboratory);
    let urls = laboratory.urls();
    let output = fourdbody(&["capture", "--nodes", &urls, "--triggers", "10", "--name", "refused"]);
    assert!(text_of(&output).contains("session refused"), "{}", text_of(&output));
    let status = nodes[0].wait_idle();
    let refused: Vec<_> = status.warnings.iter().filter(|text| text.contains("1023")).collect();
    assert_eq!(refused.len(), 1, "one warning for all threads: {:?}", status.warnings);
    assert!(text_of(&fourdbody(&["status", "--nodes", &urls])).contains("warning: cores [1023] refused"));

    // Depends on the limits that the test runs with: status and recording must agree.
    let unlocked = status.warnings.iter().filter(|text| text.contains("RLIMIT_MEMLOCK")).count();
    let scan = |node: &str, kind: &str| {
        let segments =
            std::fs::read_dir(dir.path().join("sessions/refused").join(node)).expect("a recording");
        let files = segments.map(|entry| std::fs::read(entry.expect("an entry").path()).unwrap_or_default());
        let count = |bytes: Vec<u8>| bytes.windows(kind.len()).filter(|w| *w == kind.as_bytes()).count();
        files.map(count).sum::<usize>()
    };
    for node in ["node-a", "node-b"] {
        assert_eq!(scan(node, "realtime_refused"), 1, "one event in the recording of {node}");
        assert_eq!(scan(node, "memory_not_locked"), unlocked, "{node}: {:?}", status.warnings);
    }
}
