// SPDX-License-Identifier: MIT OR Apache-2.0
//! Devices that fail in the middle of a session: what is lost is accounted for, the rest is right, and what comes back
//! goes on at the right trigger.

use crate::lab::{
    NodeProcess, WORDS, capture_whole, fourdbody, laboratory, laboratory_of, options, small_rig,
    start_capture, start_laboratory, start_nodes, text_of,
};
use fourdbody::base::ids::TriggerIndex;
use fourdbody::data::FrameSource;
use fourdbody::record::{GapCause, SessionReader};
use fourdbody_simulator::gige::TestImages;
use std::path::Path;
use std::process::{Child, Command, Output};

/// Waits until `more` triggers have been reported to this node.
fn wait_triggers(node: &mut NodeProcess, more: u64) {
    let now = node.client.status().ok().and_then(|s| s.session).map_or(0, |s| s.triggers);
    node.wait_until("more triggers", |status| {
        status.session.as_ref().is_some_and(|s| s.triggers >= now + more && s.outcome.is_none())
    });
}

fn stop(capture: Child) -> Output {
    let sent =
        Command::new("kill").args(["-INT", &capture.id().to_string()]).status().expect("kill is installed");
    assert!(sent.success());
    capture.wait_with_output().expect("it ends")
}

fn verify(session: &Path) -> Output {
    fourdbody(&["verify", &session.display().to_string()])
}

/// Every recorded frame shows the camera and the trigger that it is recorded under; gaps per camera, by trigger.
pub(crate) fn check_frames(session: &Path) -> Vec<Vec<(u64, GapCause)>> {
    let reader = SessionReader::open(session).expect("readable");
    let mut gaps = Vec::new();
    for (number, camera) in (1..).zip(reader.cameras()) {
        let mut missing = Vec::new();
        for trigger in reader.triggers() {
            match reader.recorded_frame(camera, TriggerIndex(trigger)).expect("intact") {
                Err(cause) => missing.push((trigger, cause)),
                Ok(frame) => {
                    let stamp = TestImages::identify(frame.image.as_slice(), frame.image.width());
                    let stamp = stamp.expect("a test image");
                    assert_eq!(
                        (stamp.camera, u64::from(stamp.instant)),
                        (number, trigger),
                        "{camera} {trigger}"
                    );
                }
            }
        }
        gaps.push(missing);
    }
    gaps
}

fn events(session: &Path, kind: &str) -> usize {
    let reader = SessionReader::open(session).expect("readable");
    reader.recordings().iter().flat_map(|r| &r.events).filter(|event| event.kind == kind).count()
}

#[test]
fn cameras_that_are_unplugged_come_back_into_the_session() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let mut laboratory = laboratory(dir.path(), 20.0);
    let mut nodes = start_nodes(&laboratory);
    let capture = start_capture(&laboratory, "unplugged");
    wait_triggers(&mut nodes[0], 10);
    // One camera of node a, two of node b.
    for camera in [1, 4, 6] {
        laboratory.unplug(camera);
    }
    nodes[0].wait_until("one lost", |s| s.cameras.iter().filter(|c| c.problem.is_some()).count() == 1);
    nodes[1].wait_until("two lost", |s| s.cameras.iter().filter(|c| c.problem.is_some()).count() == 2);
    for camera in [1, 4, 6] {
        laboratory.plug(camera).expect("its address is free");
    }
    for node in &mut nodes {
        node.wait_until("all back", |s| s.cameras.iter().all(|c| c.problem.is_none()));
        wait_triggers(node, 20);
    }
    let output = stop(capture);
    assert_eq!(output.status.code(), Some(3), "{}", text_of(&output));

    let session = dir.path().join("sessions/unplugged");
    let verified = verify(&session);
    assert_eq!(verified.status.code(), Some(3), "{}", text_of(&verified));
    let gaps = check_frames(&session);
    for (camera, gaps) in gaps.iter().enumerate() {
        if ![1, 4, 6].contains(&camera) {
            assert_eq!(gaps, &[], "camera {camera}");
            continue;
        }
        let (first, last) = (gaps.first().expect("a gap").0, gaps.last().expect("a gap").0);
        assert!(first >= 9, "camera {camera} was there at the beginning: {gaps:?}");
        assert_eq!(gaps.len() as u64, last - first + 1, "camera {camera}: one hole: {gaps:?}");
        let unplugged = gaps.iter().filter(|(_, cause)| *cause == GapCause::Unplugged).count();
        assert!(unplugged + 2 >= gaps.len(), "camera {camera}: but for a frame that was under way: {gaps:?}");
    }
    assert_eq!((events(&session, "camera_lost"), events(&session, "camera_back")), (3, 3));
    assert!(events(&session, "camera_silent") >= 3);
}

#[test]
fn a_lost_camera_ends_the_session_where_that_is_configured() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let mut laboratory = laboratory(dir.path(), 20.0);
    for node in &laboratory.nodes {
        let text = std::fs::read_to_string(&node.path).expect("written by the laboratory");
        let text = text.replace("[acquisition]\n", "[acquisition]\non_camera_lost = \"abort\"\n");
        std::fs::write(&node.path, text).expect("writable");
    }
    let mut nodes = start_nodes(&laboratory);
    let capture = start_capture(&laboratory, "aborted");
    wait_triggers(&mut nodes[0], 10);
    laboratory.unplug(2);
    let output = capture.wait_with_output().expect("it ends by itself");
    assert_eq!(output.status.code(), Some(3), "{}", text_of(&output));
    assert!(text_of(&output).contains("h1_up"), "the culprit is named: {}", text_of(&output));
    let session = dir.path().join("sessions/aborted");
    let verified = verify(&session);
    assert_eq!(verified.status.code(), Some(3), "{}", text_of(&verified));
    let gaps = check_frames(&session);
    let whole = |gaps: &[(u64, GapCause)]| gaps.is_empty();
    assert!(gaps.iter().enumerate().all(|(camera, gaps)| (camera == 2) != whole(gaps)), "{gaps:?}");
}

/// The session has ended before Aravis gives the camera up (2.5 s after it is asked); the recording says so all the same.
#[test]
fn a_camera_lost_at_the_very_end_is_named() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let mut laboratory = laboratory_of(dir.path(), 100.0, (64, 48), 1);
    let mut nodes = start_nodes(&laboratory);
    let capture = start_capture(&laboratory, "at-the-end");
    wait_triggers(&mut nodes[0], 10);
    laboratory.unplug(3);
    wait_triggers(&mut nodes[0], 10);
    let output = stop(capture);
    assert_eq!(output.status.code(), Some(3), "{}", text_of(&output));
    assert_eq!(events(&dir.path().join("sessions/at-the-end"), "camera_lost"), 1, "{}", nodes[0].log());
}

#[test]
fn a_link_that_is_lost_on_one_node_is_taken_up_again() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = laboratory(dir.path(), 20.0);
    let mut nodes = start_nodes(&laboratory);
    let capture = start_capture(&laboratory, "relinked");
    wait_triggers(&mut nodes[0], 10);
    laboratory.hsu.set_plugged(1, false);
    nodes[1].wait_until("link lost", |s| s.hsu.problem.is_some());
    wait_triggers(&mut nodes[0], 10);
    laboratory.hsu.set_plugged(1, true);
    nodes[1].wait_until("link back", |s| s.hsu.problem.is_none());
    wait_triggers(&mut nodes[1], 20);
    let output = stop(capture);
    assert_eq!(output.status.code(), Some(0), "{}", text_of(&output));
    let session = dir.path().join("sessions/relinked");
    let verified = verify(&session);
    assert_eq!(verified.status.code(), Some(0), "{}", text_of(&verified));
    assert!(check_frames(&session).iter().all(Vec::is_empty));
    let reader = SessionReader::open(&session).expect("readable");
    for recording in reader.recordings() {
        let triggers = recording.triggers.len() as u64;
        assert_eq!(triggers, reader.triggers().end, "every trigger's time was asked for");
    }
    assert_eq!((events(&session, "hsu_link_lost"), events(&session, "hsu_link_back")), (1, 1));
}

/// The node that gave up never learns how many triggers there were; what it has not is loss all the same, and said to be.
#[test]
fn a_lost_link_ends_the_session_where_that_is_configured() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = laboratory(dir.path(), 20.0);
    let path = &laboratory.nodes[1].path;
    let text = std::fs::read_to_string(path).expect("written by the laboratory");
    let text = text.replace("[acquisition]\n", "[acquisition]\non_link_lost = \"abort\"\n");
    std::fs::write(path, text).expect("writable");
    let mut nodes = start_nodes(&laboratory);
    let capture = start_capture(&laboratory, "unlinked");
    wait_triggers(&mut nodes[0], 10);
    laboratory.hsu.set_plugged(1, false);
    let output = capture.wait_with_output().expect("it ends by itself");
    assert_eq!(output.status.code(), Some(3), "{}", text_of(&output));
    let session = dir.path().join("sessions/unlinked");
    let verified = verify(&session);
    println!("{}", text_of(&verified));
    assert_eq!(verified.status.code(), Some(3), "{}", text_of(&verified));
    assert!(check_frames(&session)[..4].iter().all(Vec::is_empty), "node a has its link");
}

#[test]
fn an_hsu_that_restarts_ends_the_session_with_what_was_recorded() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = laboratory(dir.path(), 20.0);
    let mut nodes = start_nodes(&laboratory);
    let capture = start_capture(&laboratory, "restarted");
    wait_triggers(&mut nodes[0], 10);
    laboratory.hsu.power_cycle();
    let output = capture.wait_with_output().expect("it ends by itself");
    assert_eq!(output.status.code(), Some(3), "{}", text_of(&output));
    let session = dir.path().join("sessions/restarted");
    let verified = verify(&session);
    assert!(matches!(verified.status.code(), Some(0 | 3)), "{}", text_of(&verified));
    assert!(check_frames(&session).iter().all(|gaps| gaps.len() <= 2));
    // The next session works.
    nodes.iter_mut().for_each(|node| drop(node.wait_ready()));
    let next = capture_whole(&laboratory, "next", 5, &[]);
    assert_eq!(next.status.code(), Some(0), "{}", text_of(&next));
}

#[test]
fn a_camera_that_runs_by_itself_is_refused() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = laboratory(dir.path(), 20.0);
    let path = &laboratory.nodes[0].path;
    let text = std::fs::read_to_string(path).expect("written by the laboratory");
    // The first camera of the file.
    let off = "left_to_settings = [\"trigger_line\"]\nsettings = [[\"TriggerMode\", \"Off\"]]\n";
    std::fs::write(path, text.replacen(WORDS, off, 1)).expect("writable");
    let _nodes = start_nodes(&laboratory);
    let output = fourdbody(&["capture", "--nodes", &laboratory.urls(), "--triggers", "5", "--name", "free"]);
    assert_eq!(output.status.code(), Some(5), "{}", text_of(&output));
    let text = text_of(&output);
    assert!(text.contains("h0_up") && text.contains("TriggerMode"), "{text}");
    assert!(!dir.path().join("sessions/free").exists(), "no trigger, no file");
}

pub fn signal(node: &NodeProcess, signal: libc::c_int) {
    let pid = libc::pid_t::try_from(node.pid()).expect("a process id");
    // SAFETY: the process is a child that has not been waited for: the id is its own.
    assert_eq!(unsafe { libc::kill(pid, signal) }, 0);
}

#[test]
fn a_node_that_stood_still_gives_up_whole_frame_sets() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = laboratory(dir.path(), 50.0);
    let mut nodes = start_nodes(&laboratory);
    let capture = start_capture(&laboratory, "paused");
    wait_triggers(&mut nodes[0], 20);
    signal(&nodes[0], libc::SIGSTOP);
    std::thread::sleep(std::time::Duration::from_millis(300));
    signal(&nodes[0], libc::SIGCONT);
    wait_triggers(&mut nodes[0], 40);
    let output = stop(capture);
    let session = dir.path().join("sessions/paused");
    let gaps = check_frames(&session);
    for camera in 1..4 {
        assert_eq!(gaps[camera], gaps[0], "sets are given up whole: {}", text_of(&output));
    }
    assert!(gaps[0].iter().all(|(_, cause)| *cause == GapCause::NodePaused), "{:?}", gaps[0]);
    assert!(gaps[4..].iter().all(Vec::is_empty), "the other node ran: {gaps:?}");
    assert!(events(&session, "node_paused") >= 1);
    let expected = if gaps[0].is_empty() { 0 } else { 3 };
    assert_eq!(output.status.code(), Some(expected), "{}", text_of(&output));
}

/// From the middle of the warm-up until some triggers are fired.
#[test]
fn a_node_that_stood_still_before_trigger_0_says_so_and_gives_up_whole_frame_sets() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let rig = small_rig(50.0).replace("warm_up_triggers = 8 ", "warm_up_triggers = 40 ");
    let laboratory = start_laboratory(&options(rig, dir.path()));
    let mut nodes = start_nodes(&laboratory);
    let capture = start_capture(&laboratory, "early");
    while laboratory.hsu.fired() < 20 {
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    signal(&nodes[0], libc::SIGSTOP);
    while laboratory.hsu.fired() < 50 {
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    signal(&nodes[0], libc::SIGCONT);
    wait_triggers(&mut nodes[0], 40);
    let output = stop(capture);
    let session = dir.path().join("sessions/early");
    let gaps = check_frames(&session);
    assert!(events(&session, "node_paused") >= 1, "{}", text_of(&output));
    let paused = |camera: &Vec<(u64, GapCause)>| -> Vec<u64> {
        camera
            .iter()
            .filter(|(_, cause)| *cause == GapCause::NodePaused)
            .map(|(trigger, _)| *trigger)
            .collect()
    };
    for camera in 1..4 {
        assert_eq!(paused(&gaps[camera]), paused(&gaps[0]), "sets are given up whole: {gaps:?}");
    }
    assert!(gaps[4..].iter().all(Vec::is_empty), "the other node ran: {gaps:?}");
}

#[test]
fn what_a_stalled_node_had_written_is_told() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = laboratory(dir.path(), 20.0);
    let mut nodes = start_nodes(&laboratory);
    let capture = start_capture(&laboratory, "stalled");
    wait_triggers(&mut nodes[1], 10);
    signal(&nodes[1], libc::SIGSTOP);
    let output = capture.wait_with_output().expect("it gives the node up");
    signal(&nodes[1], libc::SIGCONT);
    let text = text_of(&output);
    assert!(!text.contains("nothing recorded"), "{text}");
    assert!(text.contains("at the last status") && text.contains("fourdbody recover"), "{text}");
}

#[test]
fn a_limit_on_file_sizes_is_not_a_full_disk() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = laboratory(dir.path(), 20.0);
    let mut nodes = start_nodes(&laboratory);
    let capture = start_capture(&laboratory, "limited");
    wait_triggers(&mut nodes[0], 5);
    let limit = libc::rlimit { rlim_cur: 256 << 10, rlim_max: 256 << 10 };
    let pid = libc::pid_t::try_from(nodes[0].pid()).expect("a process id");
    // SAFETY: `limit` lives for the duration of the call, and nothing is asked back.
    let code = unsafe { libc::prlimit(pid, libc::RLIMIT_FSIZE, &limit, std::ptr::null_mut()) };
    assert_eq!(code, 0);
    let output = capture.wait_with_output().expect("it ends by itself");
    let text = format!("{}{}", text_of(&output), nodes[0].log());
    assert!(text.contains("a file may not grow") && text.contains("LimitFSIZE"), "{text}");
    assert_eq!(output.status.code(), Some(3), "{text}");
}
