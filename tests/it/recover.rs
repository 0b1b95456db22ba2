// SPDX-License-Identifier: MIT OR Apache-2.0
//! `recover`: what is whole is saved, what is not is named, and nothing wrong is passed on.

use crate::lab::fourdbody;
use crate::recording::{end, frame, header, options, pixels, quick_dir, record, trigger};
use crate::recording_damage::{as_recording, one_segment, record_ends};
use fourdbody::base::ids::{CameraId, NodeId, TriggerIndex};
use fourdbody::record::recover::{RecoverError, Recovery, recover};
use fourdbody::record::verify::{Severity, verify};
use fourdbody::record::{
    ClockSample, GapCause, NodeEvent, Recording, RecordingReader, SessionReader, Status, interrupted,
    node_dir,
};
use proptest::prelude::*;
use std::path::{Path, PathBuf};

const CAMERAS: [&str; 2] = ["h0_up", "h0_low"];
const TRIGGERS: u64 = 9;

fn run(path: &Path, out: &Path) -> Result<Recovery, RecoverError> {
    recover(path, out, &|_, _| ())
}

/// Recovers, and checks what holds for every result: verified without anything corrupt, and every frame is the one
/// that was recorded. Returns the frames of each camera.
fn checked(path: &Path, out: &Path) -> Option<(Recovery, Vec<Vec<u64>>)> {
    let recovery = match run(path, out) {
        Ok(recovery) => recovery,
        Err(RecoverError::Unusable { .. } | RecoverError::NotFound(_)) => {
            assert!(!out.exists(), "nothing half-made is left");
            return None;
        }
        Err(other) => panic!("{other}"),
    };
    let report = verify(out, &|_, _| ()).expect("readable");
    assert_ne!(report.worst, Some(Severity::Corrupt), "{:#?}\n{recovery:#?}", report.findings);
    let reader = SessionReader::open(out).expect("readable");
    let frames = reader.recordings().iter().flat_map(frames_of).collect();
    Some((recovery, frames))
}

fn frames_of(recording: &RecordingReader) -> Vec<Vec<u64>> {
    let of_camera = |camera: usize| {
        let id = recording.header.cameras[camera].id.as_str();
        // A header that was made anew may have them in another order.
        let number = CAMERAS.iter().position(|known| *known == id).unwrap_or(camera);
        let whole = |index: &u64| match recording.frame(camera, TriggerIndex(*index)).expect("an outcome") {
            Ok(frame) => {
                assert_eq!(frame.image.as_slice(), pixels(number, *index), "camera {camera} trigger {index}");
                true
            }
            Err(_) => false,
        };
        (0..recording.triggers_end()).filter(whole).collect()
    };
    (0..recording.header.cameras.len()).map(of_camera).collect()
}

fn cause(path: &Path, camera: &str, index: u64) -> Option<GapCause> {
    let reader = SessionReader::open(path).expect("readable");
    reader.recorded_frame(&CameraId::from(camera), TriggerIndex(index)).expect("an outcome").err()
}

fn sample(n: u64) -> ClockSample {
    let (host_send_ns, host_receive_ns) = (trigger(n).host_time_ns, trigger(n).host_time_ns + 900);
    ClockSample { camera: None, host_send_ns, host_receive_ns, device_time_ns: 7 * n }
}

fn event(n: u64) -> NodeEvent {
    let (host_time_ns, kind, message) = (trigger(n).host_time_ns, "camera_lost".to_owned(), n.to_string());
    NodeEvent { host_time_ns, kind, camera: None, trigger: None, message }
}

/// Files below a directory with their bytes.
fn bytes_below(dir: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(dir).expect("a directory") {
        let path = entry.expect("an entry").path();
        if path.is_dir() {
            files.extend(bytes_below(&path));
        } else {
            let bytes = std::fs::read(&path).expect("readable");
            files.push((path, bytes));
        }
    }
    files.sort();
    files
}

#[test]
fn a_good_session_gives_an_equal_one_and_is_not_touched() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (session, out) = (dir.path().join("walk-01"), dir.path().join("copies/walk-01"));
    record(
        &node_dir(&session, &NodeId::from("b")),
        header("b", &["h2_up"], Some(40)),
        40,
        &[(0, 3), (0, 39)],
    );
    let mut recording = Recording::create(
        &node_dir(&session, &NodeId::from("a")),
        header("a", &CAMERAS, Some(40)),
        options(60_000),
    )
    .expect("created");
    for index in 0..40 {
        recording.trigger(&trigger(index)).expect("recorded");
        recording.clock_sample(&sample(index)).expect("recorded");
        for (number, camera) in CAMERAS.iter().enumerate() {
            let (meta, message) = frame(camera, number, index);
            recording.frame(number, &meta, &message).expect("recorded");
            if index == 20 {
                // A second outcome is refused, noted and counted.
                recording.frame(number, &meta, &message).expect("noted");
                recording.event(&event(index)).expect("recorded");
            }
        }
    }
    recording.finish(end(40)).expect("finished");
    let before = bytes_below(&session);

    let (recovery, _) = checked(&session, &out).expect("recovered");
    assert!(recovery.lossless(), "{recovery:#?}");
    assert!(bytes_below(&session) == before, "the source was touched");
    let (source, copy) =
        (SessionReader::open(&session).expect("good"), SessionReader::open(&out).expect("good"));
    for (source, copy) in source.recordings().iter().zip(copy.recordings()) {
        assert_eq!(source.header, copy.header);
        assert_eq!(source.verdict, copy.verdict);
        assert_eq!(source.triggers, copy.triggers);
        assert_eq!(source.clock_samples, copy.clock_samples);
        let (marks, events): (Vec<_>, Vec<_>) =
            copy.events.iter().cloned().partition(|e| e.kind == "recovered");
        assert_eq!((source.events.clone(), marks.len()), (events, 1));
        assert!(marks[0].message.contains(&source.path.display().to_string()), "{}", marks[0].message);
        for camera in 0..source.header.cameras.len() {
            for index in (0..40).map(TriggerIndex) {
                let meta =
                    |r: &RecordingReader| r.frame(camera, index).expect("an outcome").map(|frame| frame.meta);
                assert_eq!(meta(source), meta(copy));
            }
        }
    }
    assert!(matches!(run(&session, &out), Err(RecoverError::Exists { .. })), "never overwritten");
}

#[test]
fn an_interrupted_recording_is_completed_up_to_the_last_trigger_that_anything_knows() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (path, out) = (dir.path().join("node-a"), dir.path().join("out"));
    let mut recording =
        Recording::create(&path, header("a", &CAMERAS, Some(500)), options(1 << 30)).expect("created");
    for index in 0..12 {
        recording.trigger(&trigger(index)).expect("recorded");
        for (number, camera) in CAMERAS.iter().enumerate() {
            match (number, index) {
                (0, 5) => recording.gap(0, TriggerIndex(5), GapCause::MissingPackets).expect("recorded"),
                // One camera is behind when it happens.
                (1, 8..) => {}
                _ => {
                    let (meta, message) = frame(camera, number, index);
                    recording.frame(number, &meta, &message).expect("recorded");
                }
            }
        }
    }
    recording.trigger(&trigger(13)).expect("recorded");
    recording.tick().expect("synced");
    // As a kill does: nothing more is written.
    std::mem::forget(recording);
    std::thread::sleep(std::time::Duration::from_millis(100));

    let (recovery, frames) = checked(&path, &out).expect("recovered");
    let recovered = &recovery.recordings[0];
    assert!(recovered.interrupted && recovered.damage.is_empty() && !recovery.lossless(), "{recovery:#?}");
    let verdict = &recovered.verdict;
    assert_eq!((verdict.status, verdict.triggers_expected), (Status::Aborted, Some(500)));
    let reason = verdict.aborted.as_deref().expect("a reason");
    assert!(reason.contains("interrupted") && reason.contains(&path.display().to_string()), "{reason}");
    assert_eq!(cause(&out, "h0_up", 5), Some(GapCause::MissingPackets), "a known gap keeps its cause");
    assert!(frames[0].len() >= 4 && frames[1].len() <= 8);
    for (camera, name) in CAMERAS.iter().enumerate() {
        let after = frames[camera].last().map_or(0, |last| last + 1);
        for index in after..verdict.triggers {
            assert_eq!(cause(&out, name, index), Some(GapCause::Aborted), "{name} {index}");
        }
    }
}

#[test]
fn an_interrupted_node_learns_the_end_of_the_session_from_the_other() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (session, whole) = (dir.path().join("walk-01"), dir.path().join("whole"));
    let [a, b] = ["a", "b"].map(|node| node_dir(&session, &NodeId::from(node)));
    record(&a, header("a", &["h0_up", "h0_low", "h1_up", "h1_low"], Some(60)), 60, &[]);
    record(&b, header("b", &["h2_up"], Some(60)), 60, &[]);
    let segments = std::fs::read_dir(&a).expect("a directory").count();
    assert!(segments > 3, "{segments} segments");
    for number in [segments - 2, segments - 1] {
        std::fs::remove_file(a.join(format!("segment-{number:03}.mcap"))).expect("there");
    }
    let (recovery, frames) = checked(&session, &whole).expect("recovered");
    assert!(frames[0].len() < 60 && frames[4].len() == 60);
    assert!(recovery.recordings.iter().all(|r| r.verdict.triggers == 60));
    assert_eq!(recovery.recordings[0].verdict.triggers_emitted, Some(60));
    assert_eq!(cause(&whole, "h0_up", 59), Some(GapCause::Aborted));

    // The same when only the interrupted one is given, and it lies beside the other.
    let (recovery, _) = checked(&a, &dir.path().join("one")).expect("recovered");
    assert_eq!(recovery.recordings[0].verdict.triggers, 60);
}

#[test]
fn a_missing_segment_in_the_middle_is_damage_and_a_lone_one_a_fragment() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("node-a");
    record(&path, header("a", &CAMERAS, Some(60)), 60, &[]);
    let (_, lone) = checked(&path.join("segment-001.mcap"), &dir.path().join("lone")).expect("recovered");
    let first = lone[0][0];
    assert!(first > 0);
    assert_eq!(cause(&dir.path().join("lone"), "h0_up", first - 1), Some(GapCause::NotRecorded));
    std::fs::remove_file(path.join("segment-001.mcap")).expect("there");
    let (recovery, frames) = checked(&path, &dir.path().join("out")).expect("recovered");
    assert!(recovery.recordings[0].damage.iter().any(|d| d.reason.contains("segment-001.mcap is missing")));
    assert_eq!(frames[0].len() + lone[0].len(), 60);
    assert_eq!(cause(&dir.path().join("out"), "h0_up", first), Some(GapCause::Damaged));
    assert!(!recovery.recordings[0].interrupted);
}

#[test]
fn cut_anywhere_all_frames_before_the_cut_are_saved() {
    let bytes = one_segment(TRIGGERS);
    let (ends, frames) = record_ends(&bytes);
    let dir = quick_dir();
    let near = ends.iter().flat_map(|&end| [end - 1, end, end + 1]);
    for (n, cut) in near.chain((0..bytes.len()).step_by(977)).filter(|cut| *cut < bytes.len()).enumerate() {
        let zeros = [0, 1500][n % 2];
        let mut cut_bytes = bytes[..cut].to_vec();
        cut_bytes.resize(cut + zeros, 0);
        let path = as_recording(dir.path(), &cut_bytes);
        let out = dir.path().join(format!("out-{n}"));
        let expected = frames.iter().filter(|&&end| end <= cut).count();
        let saved = checked(&path, &out).map_or(0, |(_, frames)| frames.iter().map(Vec::len).sum());
        // Zeros may complete a frame whose last pixels are zero anyway.
        let range = expected..=expected + usize::from(zeros > 0);
        assert!(range.contains(&saved), "cut at {cut}: {saved} frames, expected {expected}");
        let _ = std::fs::remove_dir_all(&out);
    }
}

/// A flip in any byte of a closed recording costs the one frame that it is in, or small records, or nothing.
#[test]
fn a_flip_anywhere_costs_one_frame_at_most() {
    let bytes = one_segment(TRIGGERS);
    let (_, frames) = record_ends(&bytes);
    let dir = quick_dir();
    let all = (TRIGGERS * CAMERAS.len() as u64) as usize;
    let structure = (0..bytes.len()).filter(|at| !frames.iter().any(|end| (end - 1100..*end).contains(at)));
    let some_pixels = (0..bytes.len()).step_by(397);
    for (n, position) in structure.chain(some_pixels).enumerate().filter(|(n, _)| n % 3 == 0) {
        let mut flipped = bytes.clone();
        flipped[position] ^= 1 << (position * 5 % 8);
        let path = as_recording(dir.path(), &flipped);
        let out = dir.path().join(format!("out-{n}"));
        let Some((recovery, found)) = checked(&path, &out) else {
            panic!("nothing recovered after a flip in byte {position} of {}", bytes.len());
        };
        let found: usize = found.iter().map(Vec::len).sum();
        assert!(found + 1 >= all, "a flip in byte {position} cost {} frames\n{recovery:#?}", all - found);
        assert!(!recovery.lossless() || found == all);
        let _ = std::fs::remove_dir_all(&out);
    }
}

#[test]
fn the_command_exits_by_what_it_saved() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let fourdbody = |args: &[&str]| {
        let output = fourdbody(args);
        (output.status.code(), String::from_utf8_lossy(&output.stdout).into_owned())
    };
    let text = |path: &Path| path.display().to_string();
    let path = dir.path().join("node-a");
    record(&path, header("a", &CAMERAS, Some(20)), 20, &[(1, 3)]);
    let out = |name: &str| text(&dir.path().join(name));
    assert_eq!(fourdbody(&["recover", &text(&path), "--out", &out("good")]).0, Some(0));
    assert_eq!(fourdbody(&["verify", &out("good")]).0, Some(3), "the gap that the source had");
    assert_eq!(fourdbody(&["recover", &text(&path), "--out", &out("good")]).0, Some(2), "exists");

    let segment = path.join("segment-000.mcap");
    let mut bytes = std::fs::read(&segment).expect("readable");
    let (_, frames) = record_ends(&bytes);
    bytes[frames[4] - 5] ^= 4;
    std::fs::write(&segment, &bytes).expect("writable");
    let (code, printed) = fourdbody(&["recover", "--json", &text(&path), "--out", &out("damaged")]);
    assert_eq!(code, Some(3), "{printed}");
    let json: serde_json::Value = serde_json::from_str(&printed).expect("JSON");
    assert_eq!(json["recovery"]["recordings"][0]["added"][0]["cause"], "damaged", "{printed}");
    assert_eq!(fourdbody(&["verify", &out("damaged")]).0, Some(3));

    std::fs::write(&segment, vec![7; 5000]).expect("writable");
    assert_eq!(fourdbody(&["recover", &text(&segment), "--out", &out("none")]).0, Some(4));
    assert_eq!(fourdbody(&["recover", &out("nothing"), "--out", &out("none")]).0, Some(2));
    assert!(!dir.path().join("none").exists());
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(150))]

    #[test]
    fn scrambled_and_cut_files_never_give_a_wrong_frame(
        edits in prop::collection::vec((any::<prop::sample::Index>(), 0usize..40, prop::collection::vec(any::<u8>(), 0..40)), 0..5),
        cut in prop::option::of(any::<prop::sample::Index>()),
        hole in prop::option::of((any::<prop::sample::Index>(), 1usize..6000)),
    ) {
        thread_local!(static GOOD: Vec<u8> = one_segment(TRIGGERS));
        let mut bytes = GOOD.with(Clone::clone);
        for (at, removed, inserted) in edits {
            let at = at.index(bytes.len());
            let end = (at + removed).min(bytes.len());
            bytes.splice(at..end, inserted);
        }
        if let Some((at, length)) = hole {
            // Blocks that a power cut kept from the disk.
            let at = at.index(bytes.len());
            let end = (at + length).min(bytes.len());
            bytes[at..end].fill(0);
        }
        if let Some(cut) = cut {
            bytes.truncate(cut.index(bytes.len()));
        }
        let dir = quick_dir();
        let path = as_recording(dir.path(), &bytes);
        checked(&path, &dir.path().join("out"));
    }
}

#[test]
fn unfinished_recordings_are_found_until_a_finished_copy_is_there() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let sessions = dir.path().join("my sessions");
    let path = node_dir(&sessions.join("walk-01"), &NodeId::from("a"));
    record(&path, header("a", &CAMERAS, Some(20)), 20, &[]);
    record(&node_dir(&sessions.join("walk-02"), &NodeId::from("a")), header("a", &CAMERAS, Some(9)), 9, &[]);
    assert_eq!(interrupted(&sessions), []);
    assert_eq!(interrupted(&dir.path().join("nothing")), []);

    // What a crash leaves: no verdict, and a file that was made ready for the next segment.
    let segment = std::fs::read_dir(&path).expect("a directory").count() - 1;
    let last = path.join(format!("segment-{segment:03}.mcap"));
    let bytes = std::fs::read(&last).expect("readable");
    std::fs::write(&last, &bytes[..bytes.len() - 100]).expect("writable");
    std::fs::write(path.join(format!(".segment-{:03}.mcap.next", segment + 1)), b"").expect("writable");
    // The other session has another id in reality.
    std::fs::remove_dir_all(sessions.join("walk-02")).expect("there");
    let found = interrupted(&sessions);
    let [one] = found.as_slice() else { panic!("{found:?}") };
    assert_eq!((&one.path, one.frames, one.last_trigger), (&path, 40, Some(19)));
    assert!(one.reason.contains("was not closed"), "{}", one.reason);
    let command = one.command();
    let shown = sessions.display();
    assert_eq!(command, format!("fourdbody recover '{shown}/walk-01' --out '{shown}/walk-01-recovered'"));

    checked(&sessions.join("walk-01"), &sessions.join("walk-01-recovered")).expect("recovered");
    assert_eq!(interrupted(&sessions), []);
}
