// SPDX-License-Identifier: MIT OR Apache-2.0
//! Recordings: what is written is read back, and what is broken is found.

use fourdbody::base::ids::{BlockId, CameraId, NodeId, SessionName, TriggerIndex};
use fourdbody::data::{Frame, FrameSource};
use fourdbody::record::envelope::pixels_crc;
use fourdbody::record::{
    CameraHeader, ClockSample, ENVELOPE_CAPACITY, FrameMeta, GapCause, HsuIdentity, NodeEvent, Recording,
    RecordingHeader, SessionEnd, SessionReader, Status, TriggerRecord, WarmUp, WriterOptions, node_dir,
    write_envelope,
};
use hsu_firmware_proto::PAUSE_BEFORE;
use std::path::Path;

const WIDTH: u32 = 40;
const HEIGHT: u32 = 30;
const PERIOD_NS: u64 = 8_333_333;
const START_NS: u64 = 1_790_000_000_000_000_000;
/// The clocks of the HSU and of all cameras at trigger 0.
const HSU_NS: u64 = 10_000_005_000;
const CAMERA_NS: u64 = 7_000_001_000;

/// Memory, where the system has such a place: hundreds of recordings that are synced take their time on a disk.
pub fn quick_dir() -> tempfile::TempDir {
    tempfile::tempdir_in("/dev/shm").or_else(|_| tempfile::tempdir()).expect("a temporary directory")
}

/// A header of cameras that the shipped rig has on this node.
pub fn header(node: &str, cameras: &[&str], triggers: Option<u64>) -> RecordingHeader {
    let camera = |id: &&str| CameraHeader {
        id: CameraId::from(*id),
        width: WIDTH,
        height: HEIGHT,
        device: "test".to_owned(),
        pixel_format: String::new(),
        settings: Vec::new(),
        state: std::collections::BTreeMap::new(),
    };
    RecordingHeader {
        session: SessionName::from("walk-01"),
        session_id: "5f0c".to_owned(),
        node: NodeId::from(node),
        rig_text: std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("config/rig.toml"))
            .expect("config/rig.toml is in the repository"),
        cameras: cameras.iter().map(camera).collect(),
        hsu: Some(HsuIdentity { uid: "hsu-1".to_owned(), firmware: "1.0".to_owned(), protocol: 1 }),
        expected_triggers: triggers,
        trigger_rate_hz: 120.0,
        host_clock: "CLOCK_REALTIME".to_owned(),
        created_ns: START_NS,
        software: "test".to_owned(),
        subject: Some("s-17".to_owned()),
        note: None,
    }
}

pub fn pixels(camera: usize, trigger: u64) -> Vec<u8> {
    (0..WIDTH * HEIGHT).map(|i| (i as u64 * 7 + trigger * 13 + camera as u64 * 101) as u8).collect()
}

/// A frame as the acquisition hands it over: description and message.
pub fn frame(camera: &str, number: usize, trigger: u64) -> (FrameMeta, Vec<u8>) {
    let pixels = pixels(number, trigger);
    let meta = FrameMeta {
        trigger: TriggerIndex(trigger),
        // Eight of the warm-up came before it.
        block: BlockId(trigger + 9),
        camera_time_ns: CAMERA_NS + trigger * PERIOD_NS,
        host_time_ns: START_NS + trigger * PERIOD_NS,
        width: WIDTH,
        height: HEIGHT,
        pixels_crc: pixels_crc(&pixels),
    };
    let mut buffer = vec![0; ENVELOPE_CAPACITY];
    buffer.extend_from_slice(&pixels);
    let envelope = write_envelope(&mut buffer[..ENVELOPE_CAPACITY], &CameraId::from(camera), &meta);
    (meta, buffer.split_off(ENVELOPE_CAPACITY - envelope.expect("room enough")))
}

pub fn trigger(index: u64) -> TriggerRecord {
    TriggerRecord {
        index: TriggerIndex(index),
        hsu_time_ns: HSU_NS + index * PERIOD_NS,
        flags: 0,
        host_time_ns: START_NS + index * PERIOD_NS,
    }
}

pub fn end(triggers: u64) -> SessionEnd {
    SessionEnd {
        triggers_emitted: Some(triggers),
        aborted: None,
        absent: GapCause::Timeout,
        host_time_ns: START_NS + triggers * PERIOD_NS,
    }
}

pub fn options(segment_bytes: u64) -> WriterOptions {
    WriterOptions { segment_bytes, reserve_bytes: 0, ..WriterOptions::default() }
}

/// What comes before the triggers: readings of all clocks, and a warm-up with its rhythm.
pub fn begin(recording: &mut Recording, header: &RecordingHeader) {
    let devices = header.cameras.iter().map(|camera| (Some(camera.id.clone()), CAMERA_NS));
    let devices: Vec<_> = std::iter::once((None, HSU_NS)).chain(devices).collect();
    for (camera, device_ns) in &devices {
        for before_ns in (1..=4).map(|n| 400_000_000 - n * 20_000_000) {
            let (camera, device_time_ns) = (camera.clone(), device_ns - before_ns);
            let host_send_ns = START_NS - before_ns - 50_000;
            let host_receive_ns = host_send_ns + 100_000;
            let sample = ClockSample { camera, host_send_ns, host_receive_ns, device_time_ns };
            recording.clock_sample(&sample).expect("recorded");
        }
    }
    let mut before_ns = 0;
    let mut times = Vec::new();
    for number in (-8..0i64).rev() {
        // The pause before the trigger behind it.
        let pause = if PAUSE_BEFORE.contains(&(number + 1)) { PERIOD_NS / 2 } else { 0 };
        before_ns += PERIOD_NS + pause;
        times.push((number, before_ns));
    }
    for (number, before_ns) in times.into_iter().rev() {
        let host_time_ns = START_NS - before_ns;
        for (camera, device_ns) in &devices {
            let sample = match camera {
                None => WarmUp::Trigger { number, hsu_time_ns: device_ns - before_ns },
                Some(_) => WarmUp::Frame {
                    block: (number + 9) as u64,
                    camera_time_ns: device_ns - before_ns,
                    host_time_ns,
                },
            };
            recording.event(&sample.event(camera.clone(), host_time_ns)).expect("recorded");
        }
    }
}

/// Records `triggers` triggers of these cameras; `missing` become gaps.
pub fn record(dir: &Path, header: RecordingHeader, triggers: u64, missing: &[(usize, u64)]) {
    let mut recording = Recording::create(dir, header.clone(), options(60_000)).expect("a new recording");
    begin(&mut recording, &header);
    for index in 0..triggers {
        recording.trigger(&trigger(index)).expect("recorded");
        for (number, camera) in header.cameras.iter().enumerate() {
            if missing.contains(&(number, index)) {
                recording.gap(number, TriggerIndex(index), GapCause::MissingPackets).expect("recorded");
            } else {
                let (meta, message) = frame(camera.id.as_str(), number, index);
                recording.frame(number, &meta, &message).expect("recorded");
            }
        }
    }
    recording.finish(end(triggers)).expect("finished");
}

#[test]
fn a_session_of_two_nodes_reads_back() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let session = dir.path().join("walk-01");
    record(
        &node_dir(&session, &NodeId::from("b")),
        header("b", &["h2_up", "h2_low"], Some(50)),
        50,
        &[(1, 7)],
    );
    record(&node_dir(&session, &NodeId::from("a")), header("a", &["h0_up", "h0_low"], Some(50)), 50, &[]);
    for reader in [SessionReader::open(&session), SessionReader::open_frames(&session)] {
        let reader = reader.expect("a session");
        assert_eq!(reader.triggers(), 0..50);
        check_two_nodes(&reader);
    }
    let reader = SessionReader::open(&session).expect("a session");
    let [a, _] = reader.recordings() else { panic!("two recordings") };
    assert_eq!(a.triggers.len(), 50);
}

fn check_two_nodes(reader: &SessionReader) {
    let names: Vec<&str> = reader.cameras().iter().map(CameraId::as_str).collect();
    assert_eq!(names, ["h0_up", "h0_low", "h2_up", "h2_low"], "in the rig's order");
    assert!(reader.recordings().iter().all(|r| r.segments.len() > 1 && r.problems.is_empty()));
    for (camera, number) in [("h0_up", 0), ("h0_low", 1), ("h2_up", 0), ("h2_low", 1)] {
        for index in 0..50 {
            match reader.frame(&CameraId::from(camera), TriggerIndex(index)).expect("an outcome") {
                Frame::Owned(image) => {
                    assert_eq!(image.as_slice(), pixels(number, index), "{camera} {index}")
                }
                Frame::Gap(cause) => {
                    assert_eq!((camera, index, cause.as_str()), ("h2_low", 7, "missing_packets"));
                }
                Frame::Image(_) => panic!("a recording's frames are read into memory of their own"),
            }
        }
    }
    let [a, b] = reader.recordings() else { panic!("two recordings") };
    assert_eq!(a.header, header("a", &["h0_up", "h0_low"], Some(50)));
    let verdict = a.verdict.as_ref().expect("stored");
    assert_eq!((verdict.status, verdict.frames(), verdict.gaps()), (Status::Complete, 100, 0));
    let verdict = b.verdict.as_ref().expect("stored");
    assert_eq!((verdict.status, verdict.frames(), verdict.gaps()), (Status::Incomplete, 99, 1));
}

#[test]
fn small_records_read_back_and_every_segment_stands_alone() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("node-a");
    let mut recording =
        Recording::create(&path, header("a", &["h0_up"], None), options(20_000)).expect("a new recording");
    let sample = ClockSample {
        camera: None,
        host_send_ns: START_NS,
        host_receive_ns: START_NS + 9,
        device_time_ns: 4,
    };
    let event = NodeEvent {
        host_time_ns: START_NS,
        kind: "camera_lost".to_owned(),
        camera: Some(CameraId::from("h0_up")),
        trigger: None,
        message: "no packets for 25 ms".to_owned(),
    };
    recording.clock_sample(&sample).expect("recorded");
    recording.event(&event).expect("recorded");
    for index in 0..60 {
        let (meta, message) = frame("h0_up", 0, index);
        recording.frame(0, &meta, &message).expect("recorded");
        let (index, hsu_time_ns) = (TriggerIndex(index), 8_333_333 * index);
        let row = TriggerRecord { index, hsu_time_ns, flags: 0, host_time_ns: START_NS + hsu_time_ns };
        recording.trigger(&row).expect("recorded");
    }
    let verdict = recording.finish(end(60)).expect("finished");
    assert_eq!(verdict.status, Status::Complete);
    let reader = SessionReader::open(&path).expect("a recording");
    let recording = &reader.recordings()[0];
    assert_eq!(recording.clock_samples, [sample]);
    assert_eq!(recording.events, [event]);
    assert!(recording.segments.len() >= 3);
    let mut next = 0;
    for segment in &recording.segments {
        assert_eq!(segment.first_trigger, next);
        let alone = SessionReader::open(&segment.path).expect("understandable alone");
        assert_eq!(alone.recordings()[0].header, recording.header);
        assert_eq!(alone.rig().expect("the rig").cameras().count(), 8);
        let last = next..segment.end_trigger.unwrap_or(60);
        assert_eq!(alone.triggers().start, last.start);
        for index in last.clone() {
            let frame = alone.frame(&CameraId::from("h0_up"), TriggerIndex(index)).expect("an outcome");
            assert!(matches!(frame, Frame::Owned(image) if image.as_slice() == pixels(0, index)));
        }
        next = last.end;
    }
    assert_eq!(next, 60);
}

/// The HSU's rhythm, put on the host's clock by the report that was held up least; a row that nobody has by its neighbour's.
#[test]
fn triggers_have_the_hsus_times_on_the_hosts_clock() {
    for rate_hz in [20.0, 60.0, 120.0] {
        let dir = tempfile::tempdir().expect("a temporary directory");
        // Its clock is 20 ppm fast, and trigger 4 was late.
        let period_ns = 1e9 / rate_hz * (1.0 + 20e-6);
        let hsu_ns =
            |index: u64| 7_000 + (index as f64 * period_ns) as u64 + if index == 4 { 300_000 } else { 0 };
        let held_up_ns = |index: u64| if index == 5 { 40_000 } else { 90_000 + index * 37 % 11 * 1_000_000 };
        for (node, cameras, missing) in [("a", ["h0_up"], 9), ("b", ["h2_up"], 40)] {
            let header = RecordingHeader { trigger_rate_hz: rate_hz, ..header(node, &cameras, Some(12)) };
            let path = node_dir(dir.path(), &NodeId::from(node));
            let mut recording = Recording::create(&path, header, options(20_000)).expect("a new recording");
            for index in 0..12 {
                let (meta, message) = frame(cameras[0], 0, index);
                recording.frame(0, &meta, &message).expect("recorded");
                let host_time_ns = START_NS + hsu_ns(index) + held_up_ns(index);
                let (index, hsu_time_ns) = (TriggerIndex(index), hsu_ns(index));
                if index.0 != missing && index.0 != 11 {
                    let row = TriggerRecord { index, hsu_time_ns, flags: 0, host_time_ns };
                    recording.trigger(&row).expect("recorded");
                }
            }
            recording.finish(end(12)).expect("finished");
        }
        for reader in [
            SessionReader::open(dir.path()),
            SessionReader::open_frames(dir.path()),
            SessionReader::open_timed(dir.path()),
        ] {
            let reader = reader.expect("a session");
            assert!(
                reader
                    .time_base()
                    .is_some_and(|base| base.contains("node a") && base.contains("CLOCK_REALTIME (UTC)"))
            );
            for index in 0..12 {
                let found = reader.trigger_time_ns(TriggerIndex(index)).expect("a time");
                let off = found.abs_diff(START_NS + hsu_ns(index) + 40_000);
                // One after the last row: by the nominal period.
                assert!(
                    off <= if index == 11 { 2_000 } else { 1 },
                    "{rate_hz} Hz, trigger {index}: {off} ns"
                );
            }
        }
    }
}
