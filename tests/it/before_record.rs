// SPDX-License-Identifier: MIT OR Apache-2.0
//! Seconds before Record, with the real daemons: what is recorded begins in the past, and is verified as any session.

use crate::lab::{self, NodeProcess, fourdbody, text_of};
use fourdbody::base::ids::TriggerIndex;
use fourdbody::capture::participant::Participant;
use fourdbody::control::request::{KeepRequest, Phase};
use fourdbody::control::status::{NodeStatus, path};
use fourdbody::record::{
    ENVELOPE_CAPACITY, FrameMeta, GapCause, Recording, RecordingReader, SessionEnd, SessionReader,
    WriterOptions, write_envelope,
};
use fourdbody_simulator::laboratory::Laboratory;
use std::io::Write;
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::time::Duration;

const RATE_HZ: f64 = 20.0;
/// Triggers of two seconds at [`RATE_HZ`].
const BEFORE: u64 = 40;
/// With the second that is held beyond what is asked for.
const HELD: u64 = 60;
const PATIENCE: Duration = Duration::from_secs(20);

/// A capture that holds two seconds; Enter is a line written to it.
fn holding(laboratory: &Laboratory, name: &str, nodes: &mut [NodeProcess], triggers: &str) -> Child {
    let capture = Command::new(lab::FOURDBODY)
        .args(["capture", "--nodes", &laboratory.urls(), "--name", name, "--pre-trigger", "2"])
        .args(["--triggers", triggers])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("it starts");
    // Longer than what is held, so that the oldest gives way.
    for node in nodes {
        node.wait_until("holding", |status| {
            let held = status.session.as_ref().and_then(|session| session.held);
            status.phase == Phase::Holding && held.is_some_and(|held| held.end > HELD + 15)
        });
    }
    capture
}

fn press(capture: &mut Child) {
    capture.stdin.as_mut().expect("its input").write_all(b"\n").expect("Enter");
}

fn interrupt(capture: &Child) {
    let kill = Command::new("kill").args(["-INT", &capture.id().to_string()]).status();
    assert!(kill.expect("kill").success());
}

/// Its input stays open: the end of it would be a stop.
fn ended(mut capture: Child) -> Output {
    let input = capture.stdin.take();
    let ended = capture.wait_with_output().expect("it ends");
    drop(input);
    ended
}

fn verify_code(path: &Path) -> Option<i32> {
    let verified = fourdbody(&["verify", &path.display().to_string()]);
    println!("{}", text_of(&verified));
    verified.status.code()
}

/// Writes a recording once more; the first camera's frames stand so many triggers later than they were.
fn copied(from: &RecordingReader, dir: &Path, late: u64) {
    let header = from.header.clone();
    let options = WriterOptions { reserve_bytes: 0, ..WriterOptions::default() };
    let mut to = Recording::create(dir, header, options).expect("created");
    from.events.iter().for_each(|event| to.event(event).expect("written"));
    from.clock_samples.iter().for_each(|sample| to.clock_sample(sample).expect("written"));
    let end = from.triggers.len() as u64 - late;
    for (&index, row) in from.triggers.range(..TriggerIndex(end)) {
        to.trigger(row).expect("written");
        for (camera, described) in from.header.cameras.iter().enumerate() {
            let source = index.0.checked_sub(if camera == 0 { late } else { 0 });
            let Some(source) = source else {
                to.gap(camera, index, GapCause::MissingPackets).expect("written");
                continue;
            };
            let Ok(frame) = from.frame(camera, TriggerIndex(source)).expect("readable") else {
                to.gap(camera, index, GapCause::MissingPackets).expect("written");
                continue;
            };
            let meta = FrameMeta { trigger: index, ..frame.meta };
            let mut message = vec![0; ENVELOPE_CAPACITY];
            let envelope = write_envelope(&mut message, &described.id, &meta).expect("room enough");
            let mut message = message.split_off(ENVELOPE_CAPACITY - envelope);
            message.extend_from_slice(frame.image.as_slice());
            to.frame(camera, &meta, &message).expect("written");
        }
    }
    let end =
        SessionEnd { triggers_emitted: Some(end), aborted: None, absent: GapCause::Unknown, host_time_ns: 0 };
    to.finish(end).expect("finished");
}

#[test]
fn the_recording_begins_before_record_and_is_verified_as_any() {
    let dir = tempfile::tempdir().expect("a directory");
    let laboratory = lab::laboratory(dir.path(), RATE_HZ);
    let mut nodes = lab::start_nodes(&laboratory);
    let mut capture = holding(&laboratory, "jump", &mut nodes, "30");
    for node in &mut nodes {
        let session = node.client.status().expect("answers").session.expect("a session");
        let held = session.held.expect("frames are held");
        assert_eq!((held.end - held.oldest, held.asked), (HELD, BEFORE), "at its bound, and no more");
        assert_eq!((session.triggers, session.ring_frames), (0, 0));
        assert!(session.cameras.iter().all(|camera| camera.frames == 0 && camera.gaps == 0));
    }
    press(&mut capture);
    let captured = ended(capture);
    assert!(captured.status.success(), "{}", text_of(&captured));

    let session = dir.path().join("sessions/jump");
    let verified = fourdbody(&["verify", &session.display().to_string()]);
    assert_eq!(verified.status.code(), Some(0), "{}", text_of(&verified));
    let reader = SessionReader::open(&session).expect("a session");
    for recording in reader.recordings() {
        let pressed = recording.events.iter().find(|event| event.kind == "record_pressed").expect("told");
        assert_eq!(pressed.trigger, Some(TriggerIndex(BEFORE - 1)));
        let rows = &recording.triggers;
        assert_eq!(rows.keys().next(), Some(&TriggerIndex(0)));
        // 30 behind Record, and what came until the stop was carried out.
        assert!(rows.len() as u64 >= BEFORE + 30, "{} triggers", rows.len());
    }
    // The warm-up's witness reaches across what was not recorded: a camera whose every frame stands under the next trigger
    // shows no wrong step anywhere.
    let honest = dir.path().join("honest");
    copied(&reader.recordings()[0], &honest, 0);
    assert_eq!(verify_code(&honest), Some(0));
    let forged = dir.path().join("forged");
    copied(&reader.recordings()[0], &forged, 1);
    assert_eq!(verify_code(&forged), Some(4));
    let first = |place: usize| reader.recordings()[place].triggers[&TriggerIndex(0)].hsu_time_ns;
    assert_eq!(first(0), first(1), "the same instant on both nodes");
    nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
}

/// A stop that the operator presses ends the train a second later.
#[test]
fn seconds_after_stop_are_recorded() {
    let dir = tempfile::tempdir().expect("a directory");
    let laboratory = lab::laboratory(dir.path(), RATE_HZ);
    let mut nodes = lab::start_nodes(&laboratory);
    let capture = Command::new(lab::FOURDBODY)
        .args(["capture", "--nodes", &laboratory.urls(), "--name", "tail", "--triggers", "0"])
        .args(["--post-trigger", "1"])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("it starts");
    let recorded = |status: &NodeStatus| status.session.as_ref().map_or(0, |session| session.triggers);
    let before = recorded(&nodes[0].wait_until("recording", |status| recorded(status) > 10));
    interrupt(&capture);
    let captured = ended(capture);
    assert_eq!(captured.status.code(), Some(0), "{}", text_of(&captured));
    let session = SessionReader::open(&dir.path().join("sessions/tail")).expect("a session");
    let triggers = session.recordings()[0].triggers.len() as u64;
    assert!(triggers >= before + RATE_HZ as u64, "{triggers} triggers, {before} before the stop");
    nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
}

#[test]
fn a_node_that_is_killed_behind_record_leaves_what_it_wrote() {
    let dir = tempfile::tempdir().expect("a directory");
    let laboratory = lab::laboratory(dir.path(), RATE_HZ);
    let mut nodes = lab::start_nodes(&laboratory);
    let mut capture = holding(&laboratory, "walk", &mut nodes, "0");
    press(&mut capture);
    nodes.iter_mut().for_each(|node| {
        node.wait_until("recording", |status| status.phase == Phase::Running);
    });
    // A node is killed behind Record: what it wrote is a recording that begins at the same trigger.
    nodes[1].kill();
    let captured = ended(capture);
    assert!(!captured.status.success(), "{}", text_of(&captured));
    let out = dir.path().join("recovered");
    let killed = dir.path().join("sessions/walk/node-b");
    let recovered =
        fourdbody(&["recover", &killed.display().to_string(), "--out", &out.display().to_string()]);
    assert!(matches!(recovered.status.code(), Some(0 | 3)), "{}", text_of(&recovered));
    let session = dir.path().join("sessions/walk/node-a");
    let verified = fourdbody(&["verify", &session.display().to_string()]);
    assert!(matches!(verified.status.code(), Some(0 | 3)), "{}", text_of(&verified));
}

#[test]
fn before_record_a_stop_or_a_killed_node_leaves_nothing_that_looks_like_a_session() {
    let dir = tempfile::tempdir().expect("a directory");
    let laboratory = lab::laboratory(dir.path(), RATE_HZ);
    let mut nodes = lab::start_nodes(&laboratory);
    let capture = holding(&laboratory, "never", &mut nodes, "30");
    // Whoever forges Record: another session, triggers that are not held, an order that cannot be.
    let client = &nodes[0].client;
    let session = client.status().expect("answers").session.expect("a session");
    let held = session.held.expect("frames are held");
    let wrong = [
        KeepRequest { session_id: session.session_id ^ 1, first: held.oldest, pressed: held.end },
        KeepRequest { session_id: session.session_id, first: u64::MAX, pressed: u64::MAX },
        KeepRequest { session_id: session.session_id, first: held.end, pressed: 0 },
    ];
    for request in wrong {
        assert!(client.keep(&request).is_err(), "{request:?}");
    }
    assert_eq!(client.status().expect("answers").phase, Phase::Holding);
    interrupt(&capture);
    let captured = ended(capture);
    assert_eq!(captured.status.code(), Some(1), "{}", text_of(&captured));
    assert!(text_of(&captured).contains("before Record was pressed"), "{}", text_of(&captured));
    assert!(!dir.path().join("sessions/never").exists());
    nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
    assert!(nodes[0].client.post(path::CAPTURE_RECORD, &(), PATIENCE).is_err(), "nothing is held");

    let capture = holding(&laboratory, "killed", &mut nodes, "30");
    nodes[1].kill();
    let captured = ended(capture);
    assert!(!captured.status.success(), "{}", text_of(&captured));
    assert!(!dir.path().join("sessions/killed/node-a").exists(), "the other node lets go, too");
    nodes[0].wait_idle();
    let verified = fourdbody(&["verify", &dir.path().join("sessions/killed").display().to_string()]);
    assert_ne!(verified.status.code(), Some(0), "{}", text_of(&verified));
}
