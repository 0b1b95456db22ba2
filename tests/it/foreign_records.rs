// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a disk may hold beside a recording's own records, and what a file may claim that it cannot hold.

use crate::recording::{end, frame, header, options, trigger};
use crate::recording_damage::as_recording;
use fourdbody::base::ids::TriggerIndex;
use fourdbody::record::recover::{Recovery, recover};
use fourdbody::record::verify::{Report, Severity, verify};
use fourdbody::record::{ClockSample, GapCause, NodeEvent, Recording, SessionReader};
use std::ops::Range;
use std::path::Path;

const CAMERAS: [&str; 2] = ["h0_up", "h0_low"];
const CHUNK: u8 = 6;

fn event(n: u64) -> NodeEvent {
    let (host_time_ns, kind, message) = (trigger(n).host_time_ns, "camera_silent".to_owned(), n.to_string());
    NodeEvent { host_time_ns, kind, camera: None, trigger: None, message }
}

/// A session of one segment; the pixels tell it from others.
fn segment(session_id: &str, pixels: usize, triggers: u64, events: u64) -> Vec<u8> {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("node-a");
    let mut header = header("a", &CAMERAS, Some(triggers));
    (header.rig_text, header.session_id) = ("rig".to_owned(), session_id.to_owned());
    let mut recording = Recording::create(&path, header, options(1 << 30)).expect("created");
    for index in 0..triggers {
        recording.trigger(&trigger(index)).expect("recorded");
        let at = trigger(index).host_time_ns;
        let sample =
            ClockSample { camera: None, host_send_ns: at, host_receive_ns: at + 9, device_time_ns: 7 };
        recording.clock_sample(&sample).expect("recorded");
        for (number, camera) in CAMERAS.iter().enumerate() {
            let (meta, message) = frame(camera, number + pixels, index);
            recording.frame(number, &meta, &message).expect("recorded");
        }
        if index == triggers / 2 {
            (0..events).for_each(|n| recording.event(&event(n)).expect("recorded"));
        }
    }
    recording.finish(end(triggers)).expect("finished");
    std::fs::read(path.join("segment-000.mcap")).expect("one segment")
}

/// Where the chunks' records are, in a file known to be good.
fn chunks(bytes: &[u8]) -> Vec<Range<usize>> {
    let (mut found, mut at) = (Vec::new(), 8);
    while at + 9 <= bytes.len() - 8 {
        let length = u64::from_le_bytes(bytes[at + 1..at + 9].try_into().expect("8 bytes")) as usize;
        if bytes[at] == CHUNK {
            found.push(at..at + 9 + length);
        }
        at += 9 + length;
    }
    found
}

fn results(bytes: &[u8], dir: &Path) -> (Report, Recovery) {
    let path = as_recording(dir, bytes);
    let report = verify(&path, &|_, _| ()).expect("readable");
    let recovery = recover(&path, &dir.join("out"), &|_, _| ()).expect("recovered");
    (report, recovery)
}

#[test]
fn a_whole_chunk_of_another_session_is_never_passed_on() {
    let (own, other) = (segment("5f0c", 0, 16, 0), segment("77e1", 5, 16, 0));
    let (places, theirs) = (chunks(&own), chunks(&other));
    let mut tried = 0;
    let last = places.len() - 1;
    for (place, there) in places[..last].iter().zip(&theirs).filter(|(place, there)| {
        // The first holds schemas and channels, which are the same in both. The last holds the index, which only repeats what
        // the records say: nothing is passed on from one that they contradict.
        place.len() == there.len() && own[(*place).clone()] != other[(*there).clone()]
    }) {
        tried += 1;
        let dir = tempfile::tempdir().expect("a temporary directory");
        let mut bytes = own.clone();
        bytes[place.clone()].copy_from_slice(&other[there.clone()]);
        let (report, recovery) = results(&bytes, dir.path());
        assert_eq!(report.worst, Some(Severity::Corrupt));
        let named = report.findings.iter().any(|finding| finding.message.contains("another session"));
        assert!(named, "{place:?}: {:?}", report.findings);
        assert!(!recovery.lossless(), "{place:?}: {recovery:?}");
        let damage = &recovery.recordings[0].damage;
        assert!(damage.iter().any(|one| one.reason.contains("another session")), "{damage:?}");
        let again = verify(&dir.path().join("out"), &|_, _| ()).expect("readable");
        assert_ne!(again.worst, Some(Severity::Corrupt), "{:?}", again.findings);
        let reader = SessionReader::open(&dir.path().join("out")).expect("readable");
        let recording = &reader.recordings()[0];
        for (camera, index) in (0..2).flat_map(|camera| (0..16).map(move |index| (camera, index))) {
            let outcome = recording.frame(camera, TriggerIndex(index)).expect("an outcome");
            let foreign =
                outcome.is_ok_and(|found| found.image.as_slice() != crate::recording::pixels(camera, index));
            assert!(!foreign, "camera {camera} trigger {index}");
        }
    }
    assert!(tried >= 4, "{tried} chunks");
}

/// The chunk is skipped as a private record: nothing else tells that it was there.
#[test]
fn a_lost_chunk_without_frames_is_missed() {
    let mut bytes = segment("5f0c", 0, 4, 20_000);
    let largest = chunks(&bytes).into_iter().max_by_key(ExactSizeIterator::len).expect("chunks");
    assert!(largest.len() > 1 << 20, "events alone: {largest:?}");
    bytes[largest.start] = 0x80;
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (report, recovery) = results(&bytes, dir.path());
    let told = report.findings.iter().any(|finding| finding.message.contains("small records are missing"));
    assert!(told, "{:?}", report.findings);
    assert!(!recovery.lossless() && recovery.recordings[0].records_lost > 1000, "{recovery:?}");
    assert_eq!(recovery.recordings[0].verdict.frames(), 8, "no frame was in it");
}

/// A gap record far behind everything else asked for a record of every trigger before it.
#[test]
fn what_is_written_stays_within_what_was_read() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("node-a");
    let mut recording =
        Recording::create(&path, header("a", &CAMERAS, None), options(1 << 30)).expect("created");
    for index in 0..3 {
        let (meta, message) = frame(CAMERAS[0], 0, index);
        recording.frame(0, &meta, &message).expect("recorded");
    }
    recording.gap(0, TriggerIndex(16_000_000), GapCause::Timeout).expect("recorded");
    recording.tick().expect("kept");
    drop(recording);
    let out = dir.path().join("out");
    let recovery = recover(&path, &out, &|_, _| ()).expect("recovered");
    let bytes: u64 = std::fs::read_dir(&out)
        .expect("a directory")
        .map(|entry| entry.and_then(|entry| entry.metadata()).map_or(0, |metadata| metadata.len()))
        .sum();
    assert!(bytes < 40 << 20, "{bytes} bytes of a file of kilobytes");
    assert!(!recovery.lossless(), "{recovery:?}");
    assert_eq!(recovery.recordings[0].verdict.frames(), 3);
}

/// Envelopes with right checksums, each of which claims all that follows as its pixels.
#[test]
fn envelopes_that_overlap_cost_no_more_than_their_bytes() {
    const CLAIMED: u32 = 6 << 20;
    let mut bytes = segment("5f0c", 0, 4, 0);
    let data_end = chunks(&bytes).last().expect("chunks").end;
    bytes.truncate(data_end);
    let (mut meta, _) = frame(CAMERAS[0], 0, 9);
    (meta.width, meta.height) = (CLAIMED, 1);
    let mut envelope = vec![0; 256];
    let camera = fourdbody::base::ids::CameraId::from(CAMERAS[0]);
    let length = fourdbody::record::write_envelope(&mut envelope, &camera, &meta).expect("room enough");
    let envelope = envelope.split_off(256 - length);
    // A record that cannot be, so that what follows is looked through.
    bytes.push(0x7f);
    while bytes.len() < data_end + 2 * CLAIMED as usize {
        bytes.extend_from_slice(&envelope);
    }
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = as_recording(dir.path(), &bytes);
    let recovery = recover(&path, &dir.path().join("out"), &|_, _| ()).expect("recovered");
    assert_eq!(recovery.recordings[0].verdict.frames(), 8, "what is whole is saved");
    assert!(!recovery.lossless());
}
