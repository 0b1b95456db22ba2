// SPDX-License-Identifier: MIT OR Apache-2.0
//! Recordings that were cut, flipped or scrambled: nothing is lost that is whole, nothing wrong is accepted.

use crate::lab::assert_contains;
use crate::recording::{end, frame, header, options, pixels, record, trigger};
use fourdbody::base::ids::{CameraId, NodeId, TriggerIndex};
use fourdbody::record::verify::{Severity, verify};
use fourdbody::record::{ClockSample, GapCause, Recording, SessionReader, Verdict, node_dir};
use proptest::prelude::*;
use std::path::{Path, PathBuf};

const TRIGGERS: u64 = 9;
const CAMERAS: [&str; 2] = ["h0_up", "h0_low"];

/// A finished recording of one segment, as bytes.
pub fn one_segment(triggers: u64) -> Vec<u8> {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("node-a");
    let mut header = header("a", &CAMERAS, Some(triggers));
    // The rig would be most of the file.
    header.rig_text = "rig".to_owned();
    let mut recording = Recording::create(&path, header, options(1 << 30)).expect("created");
    for index in 0..triggers {
        recording.trigger(&trigger(index)).expect("recorded");
        for (number, camera) in CAMERAS.iter().enumerate() {
            let (meta, message) = frame(camera, number, index);
            recording.frame(number, &meta, &message).expect("recorded");
        }
    }
    recording.finish(end(triggers)).expect("finished");
    std::fs::read(path.join("segment-000.mcap")).expect("one segment")
}

/// A recording's directory with these bytes as its only segment.
pub fn as_recording(dir: &Path, bytes: &[u8]) -> PathBuf {
    let path = dir.join("node-a");
    std::fs::create_dir_all(&path).expect("a directory");
    let segment = path.join("segment-000.mcap");
    // ext4 flushes a file that is truncated and written again, which would be most of the test's time.
    let _ = std::fs::remove_file(&segment);
    std::fs::write(&segment, bytes).expect("a segment");
    path
}

/// Ends of all records, those inside chunks included; and the ends of the frames among them. Walks as the
/// specification says, on a file known to be good.
pub fn record_ends(bytes: &[u8]) -> (Vec<usize>, Vec<usize>) {
    const MESSAGE: u8 = 5;
    const CHUNK: u8 = 6;
    let (mut ends, mut frames, mut position) = (vec![8], Vec::new(), 8);
    while position + 9 <= bytes.len() - 8 {
        let length =
            u64::from_le_bytes(bytes[position + 1..position + 9].try_into().expect("8 bytes")) as usize;
        let body = position + 9;
        match bytes[position] {
            // Times, size, checksum, empty compression, size.
            CHUNK => position = body + 8 + 8 + 8 + 4 + 4 + 8,
            opcode => {
                position = body + length;
                if opcode == MESSAGE && length > 1200 {
                    frames.push(position);
                }
            }
        }
        ends.push(position);
    }
    (ends, frames)
}

/// Frames that can be read, each one checked against what was recorded.
fn readable_frames(path: &Path) -> usize {
    let count = |reader: &SessionReader| {
        let recording = &reader.recordings()[0];
        let places = (0..CAMERAS.len()).flat_map(|c| (0..TRIGGERS).map(move |i| (c, i)));
        let read = places.filter(|&(camera, index)| match recording.frame(camera, TriggerIndex(index)) {
            Ok(Ok(frame)) => {
                assert_eq!(frame.image.as_slice(), pixels(camera, index), "camera {camera} trigger {index}");
                true
            }
            _ => false,
        });
        read.count()
    };
    if let Ok(reader) = SessionReader::open_frames(path) {
        count(&reader);
    }
    SessionReader::open(path).map_or(0, |reader| count(&reader))
}

#[test]
fn cut_anywhere_all_frames_before_the_cut_are_read() {
    let bytes = one_segment(TRIGGERS);
    let (ends, frames) = record_ends(&bytes);
    assert_eq!(frames.len() as u64, TRIGGERS * CAMERAS.len() as u64);
    let dir = tempfile::tempdir().expect("a temporary directory");
    let near = ends.iter().flat_map(|&end| [end - 1, end, end + 1]);
    for cut in near.chain((0..bytes.len()).step_by(101)).filter(|cut| *cut < bytes.len()) {
        for zeros in [0, 1500] {
            let mut cut_bytes = bytes[..cut].to_vec();
            cut_bytes.resize(cut + zeros, 0);
            let path = as_recording(dir.path(), &cut_bytes);
            let expected = frames.iter().filter(|&&end| end <= cut).count();
            let found = readable_frames(&path);
            // Zeros may complete a frame whose last pixels are zero anyway; they never make a wrong one.
            assert!(
                found == expected || (zeros > 0 && found == expected + 1),
                "cut at {cut}: {found}, expected {expected}"
            );
            let corrupt = match verify(&path, &|_, _| ()) {
                Ok(report) => report.worst == Some(Severity::Corrupt),
                Err(_) => true,
            };
            assert!(corrupt, "a cut at {cut} of {} must be found", bytes.len());
        }
    }
}

#[test]
fn every_flipped_byte_is_found() {
    let bytes = one_segment(2);
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = as_recording(dir.path(), &bytes);
    // It has no warm-up.
    let worst = verify(&path, &|_, _| ()).expect("readable").worst;
    assert_eq!(worst, Some(Severity::Unconfirmed));
    // One bit of each byte; all of them where that is asked for.
    let all = crate::crash::number("FOURDBODY_ALL_BITS", 0) > 0;
    let bits = |position: usize| if all { 0..8 } else { position * 5 % 8..position * 5 % 8 + 1 };
    for (position, bit) in
        (0..bytes.len()).flat_map(|position| bits(position).map(move |bit| (position, bit)))
    {
        let mut flipped = bytes.clone();
        flipped[position] ^= 1 << bit;
        as_recording(dir.path(), &flipped);
        let found = match verify(&path, &|_, _| ()) {
            Ok(report) => report.worst == Some(Severity::Corrupt),
            Err(_) => true,
        };
        assert!(found, "the flip of bit {bit} in byte {position} of {} was not found", bytes.len());
        if position % 16 == 0 {
            readable_frames(&path);
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn scrambled_files_never_panic(
        edits in prop::collection::vec((any::<prop::sample::Index>(), 0usize..40, prop::collection::vec(any::<u8>(), 0..40)), 1..6),
        seed_bytes in prop::collection::vec(any::<u8>(), 0..300),
        fresh: bool,
    ) {
        thread_local!(static GOOD: Vec<u8> = one_segment(TRIGGERS));
        let mut bytes = if fresh { seed_bytes } else { GOOD.with(Clone::clone) };
        for (at, removed, inserted) in edits {
            if !bytes.is_empty() {
                let at = at.index(bytes.len());
                let end = (at + removed).min(bytes.len());
                bytes.splice(at..end, inserted);
            }
        }
        let dir = tempfile::tempdir().expect("a temporary directory");
        let path = as_recording(dir.path(), &bytes);
        readable_frames(&path);
        let _ = verify(&path, &|_, _| ());
    }
}

/// Verifies after `spoil` has had its way with a session of two nodes, and returns all findings as text.
fn findings(spoil: impl Fn(&Path)) -> (Option<Severity>, String) {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let session = dir.path().join("walk-01");
    record(&node_dir(&session, &NodeId::from("a")), header("a", &CAMERAS, Some(60)), 60, &[]);
    record(&node_dir(&session, &NodeId::from("b")), header("b", &["h2_up", "h2_low"], Some(60)), 60, &[]);
    spoil(&session);
    let report = verify(&session, &|_, _| ()).expect("readable");
    let lines: Vec<String> = report.findings.iter().map(ToString::to_string).collect();
    (report.worst, lines.join("\n"))
}

#[test]
fn a_good_session_has_no_findings() {
    assert_eq!(findings(|_| ()), (None, String::new()));
}

#[test]
fn a_missing_segment_is_named() {
    let (worst, text) = findings(|session| {
        std::fs::remove_file(session.join("node-a/segment-001.mcap")).expect("there");
    });
    assert_eq!(worst, Some(Severity::Corrupt));
    assert!(text.contains("node a") && text.contains("segment 1 here: it is missing"), "{text}");
    assert!(text.contains("camera h0_up triggers") && text.contains("neither a frame nor a gap"), "{text}");
}

#[test]
fn nodes_that_disagree_are_named() {
    let (worst, text) = findings(|session| {
        let path = session.join("node-b");
        std::fs::remove_dir_all(&path).expect("there");
        let mut other = header("b", &["h2_up", "h0_low"], Some(61));
        other.session_id = "another".to_owned();
        record(&path, other, 61, &[]);
    });
    assert_eq!(worst, Some(Severity::Corrupt));
    assert_contains(
        &text,
        &["session's id is another", "HSU's trigger count is 61", "camera h0_low: is recorded on node a"],
    );
}

#[test]
fn gaps_are_loss_with_camera_trigger_and_cause() {
    let (worst, text) = findings(|session| {
        let path = session.join("node-b");
        std::fs::remove_dir_all(&path).expect("there");
        record(&path, header("b", &["h2_up", "h2_low"], Some(60)), 60, &[(0, 7), (1, 20), (1, 21), (1, 22)]);
    });
    assert_eq!(worst, Some(Severity::Loss));
    assert_eq!(
        text,
        "loss: node b camera h2_up trigger 7: gap: missing_packets\n\
         loss: node b camera h2_low triggers 20 to 22: gap: missing_packets"
    );
}

/// Frames of one trigger recorded under another's index: counts are right, identity is not.
#[test]
fn a_shifted_camera_contradicts_the_hsu() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("node-a");
    let mut recording =
        Recording::create(&path, header("a", &["h0_up"], Some(30)), options(1 << 30)).expect("created");
    for index in 0..30 {
        recording.trigger(&trigger(index)).expect("recorded");
        let (mut meta, _) = frame("h0_up", 0, index);
        // From trigger 10 on, the camera's clock says that each frame is that of the next trigger.
        meta.camera_time_ns += if index < 10 { 0 } else { 8_333_333 };
        let mut message = vec![0; 256];
        let length = fourdbody::record::write_envelope(&mut message, &CameraId::from("h0_up"), &meta);
        let mut message = message.split_off(256 - length.expect("room enough"));
        message.extend_from_slice(&pixels(0, index));
        recording.frame(0, &meta, &message).expect("recorded");
    }
    recording.finish(end(30)).expect("finished");
    let report = verify(&path, &|_, _| ()).expect("readable");
    assert_eq!(report.worst, Some(Severity::Corrupt));
    assert!(
        report.findings.iter().any(|f| f.triggers == Some((10, 29)) && f.message.contains("not the frames"))
    );
}

#[test]
fn a_verdict_that_does_not_follow_from_the_records_is_found() {
    let bytes = one_segment(TRIGGERS);
    let text = String::from_utf8_lossy(&bytes).into_owned();
    let stored = format!("\"frames\":{TRIGGERS},");
    assert_eq!(text.matches(&stored).count(), CAMERAS.len());
    // Same length, so that the file stays well-formed; the checksums are found wrong as well.
    let at = bytes.windows(stored.len()).position(|w| w == stored.as_bytes()).expect("stored");
    let mut edited = bytes.clone();
    edited[at + stored.len() - 2] -= 1;
    let dir = tempfile::tempdir().expect("a temporary directory");
    let report = verify(&as_recording(dir.path(), &edited), &|_, _| ()).expect("readable");
    assert!(report.findings.iter().any(|f| f.message.contains("stored verdict differs from the records")));
    let counted: &Verdict = &report.recordings[0].verdict;
    assert_eq!(counted.frames(), TRIGGERS * CAMERAS.len() as u64);
}

#[test]
fn an_aborted_session_is_loss_with_its_reason() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("node-a");
    let header = header("a", &CAMERAS, Some(60));
    let mut recording = Recording::create(&path, header, options(1 << 30)).expect("created");
    for index in 0..10 {
        recording.trigger(&trigger(index)).expect("recorded");
        let (meta, message) = frame("h0_up", 0, index);
        recording.frame(0, &meta, &message).expect("recorded");
    }
    let mut end = end(10);
    (end.absent, end.aborted) = (GapCause::Aborted, Some("camera h0_low is gone".to_owned()));
    let verdict = recording.finish(end).expect("finished");
    let report = verify(&path, &|_, _| ()).expect("readable");
    assert_eq!(report.worst, Some(Severity::Loss));
    assert_eq!(report.recordings[0].verdict, verdict);
    assert!(report.findings.iter().any(|f| f.message.contains("camera h0_low is gone")));
}

/// A recording with exchanges with both clocks; the camera's frames are exposed `late_ns` after their triggers.
fn with_exchanges(dir: &Path, node: &str, camera: &str, late_ns: u64, hsu_step_ns: u64) {
    const HOST_NS: u64 = 1_790_000_000_000_000_000;
    const CAMERA_BEHIND_HSU_NS: u64 = 3_000_000_000;
    let path = node_dir(dir, &NodeId::from(node));
    let mut recording =
        Recording::create(&path, header(node, &[camera], Some(60)), options(1 << 30)).expect("created");
    for index in 0..60 {
        let mut row = trigger(index);
        row.hsu_time_ns += 10_000_000_000 + hsu_step_ns;
        let host = HOST_NS + row.hsu_time_ns - hsu_step_ns;
        row.host_time_ns = host + 300_000;
        recording.trigger(&row).expect("recorded");
        for (device, clock_ns) in
            [(None, row.hsu_time_ns), (Some(camera), row.hsu_time_ns - CAMERA_BEHIND_HSU_NS)]
        {
            let sample = ClockSample {
                camera: device.map(CameraId::from),
                host_send_ns: host - 100_000,
                host_receive_ns: host + 100_000,
                device_time_ns: clock_ns,
            };
            recording.clock_sample(&sample).expect("recorded");
        }
        let (mut meta, _) = frame(camera, 0, index);
        meta.camera_time_ns = row.hsu_time_ns - CAMERA_BEHIND_HSU_NS + late_ns;
        meta.host_time_ns = host + late_ns + 500_000;
        let mut message = vec![0; 256];
        let length = fourdbody::record::write_envelope(&mut message, &CameraId::from(camera), &meta);
        let mut message = message.split_off(256 - length.expect("room enough"));
        message.extend_from_slice(&pixels(0, index));
        recording.frame(0, &meta, &message).expect("recorded");
    }
    recording.finish(end(60)).expect("finished");
}

/// Every step from frame to frame is right, and yet every frame is that of the next trigger.
#[test]
fn a_camera_that_is_one_trigger_off_from_the_start_contradicts_the_exchanges() {
    for (late_ns, worst) in [(300_000, Severity::Unconfirmed), (8_333_333, Severity::Corrupt)] {
        let dir = tempfile::tempdir().expect("a temporary directory");
        with_exchanges(dir.path(), "a", "h0_up", late_ns, 0);
        let report = verify(dir.path(), &|_, _| ()).expect("readable");
        // Without a warm-up its place rests on an assumption.
        assert_eq!(report.worst, Some(worst), "{late_ns} ns: {:?}", report.findings);
        let named = report.findings.iter().any(|f| f.message.contains("ms after their triggers"));
        assert_eq!(named, worst == Severity::Corrupt, "{:?}", report.findings);
    }
}

#[test]
fn trigger_tables_that_differ_between_nodes_are_found() {
    for (step_ns, worst) in [(0, Severity::Unconfirmed), (8_333_333, Severity::Corrupt)] {
        let dir = tempfile::tempdir().expect("a temporary directory");
        with_exchanges(dir.path(), "a", "h0_up", 0, 0);
        with_exchanges(dir.path(), "b", "h2_up", 0, step_ns);
        let report = verify(dir.path(), &|_, _| ()).expect("readable");
        assert_eq!(report.worst, Some(worst), "{:?}", report.findings);
        let named = report.findings.iter().any(|f| {
            f.node == "b"
                && f.triggers == Some((0, 59))
                && f.message.contains("another HSU time than on node a")
        });
        assert_eq!(named, worst == Severity::Corrupt, "{:?}", report.findings);
    }
}

#[test]
fn a_node_whose_recording_is_missing_is_named() {
    let (worst, text) = findings(|session| std::fs::remove_dir_all(session.join("node-b")).expect("there"));
    assert_eq!(worst, None, "each PC has its own node's recording only");
    assert_eq!(text, "note: node b: its recording is not here; agreement was not checked");
}
