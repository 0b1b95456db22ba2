// SPDX-License-Identifier: MIT OR Apache-2.0
//! `info` answers what a researcher asks of a recording, of a whole one and of one that is not.

use crate::lab::{assert_contains, fourdbody, text_of};
use crate::recording::{end, frame, header, options, trigger};
use fourdbody::base::ids::{CameraId, NodeId, TriggerIndex};
use fourdbody::config::{FeatureSetting, FeatureValue};
use fourdbody::record::recover::recover;
use fourdbody::record::{ClockSample, GapCause, NodeEvent, Recording, node_dir};
use serde_json::Value;
use std::path::Path;

const TRIGGERS: u64 = 120;
/// The camera's clock runs this much faster than the host's, parts per million.
const SKEW_PPM: f64 = 40.0;
const CAMERA_AHEAD_NS: u64 = 5_000_000_000;

/// Runs `info`; returns exit code, text and JSON.
fn info(path: &Path) -> (i32, String, Value) {
    let path = path.display().to_string();
    let run = |arguments: &[&str]| {
        let output = fourdbody(arguments);
        (output.status.code().expect("an exit code"), text_of(&output))
    };
    let (code, text) = run(&["info", &path]);
    let (json_code, json) = run(&["info", "--json", &path]);
    assert_eq!(code, json_code);
    (code, text, serde_json::from_str(&json).unwrap_or(Value::Null))
}

/// A recording with everything that a node writes.
fn record(session: &Path, node: &str, cameras: &[&str]) {
    let mut header = header(node, cameras, Some(TRIGGERS));
    header.note = Some("slow walk".to_owned());
    for camera in &mut header.cameras {
        camera.settings = vec![
            FeatureSetting { feature: "ExposureTime".to_owned(), value: FeatureValue::Float(800.0) },
            FeatureSetting { feature: "TriggerMode".to_owned(), value: FeatureValue::Text("On".to_owned()) },
        ];
    }
    let path = node_dir(session, &NodeId::from(node));
    let mut recording = Recording::create(&path, header, options(90_000)).expect("created");
    for index in 0..TRIGGERS {
        let row = trigger(index);
        recording.trigger(&row).expect("recorded");
        let since = row.host_time_ns - trigger(0).host_time_ns;
        let camera_ns = CAMERA_AHEAD_NS + since + (since as f64 * SKEW_PPM * 1e-6) as u64;
        let devices = [(None, row.hsu_time_ns), (Some(cameras[0]), camera_ns)];
        for (device, device_time_ns) in devices {
            let sample = ClockSample {
                camera: device.map(CameraId::from),
                host_send_ns: row.host_time_ns - 50_000,
                host_receive_ns: row.host_time_ns + 50_000,
                device_time_ns,
            };
            recording.clock_sample(&sample).expect("recorded");
        }
        if index >= 60 && index % 20 == 0 {
            let event = NodeEvent {
                host_time_ns: row.host_time_ns,
                kind: "camera_lost".to_owned(),
                camera: Some(CameraId::from(cameras[0])),
                trigger: Some(TriggerIndex(index)),
                message: "no packets for 25 ms".to_owned(),
            };
            recording.event(&event).expect("recorded");
        }
        for (number, camera) in cameras.iter().enumerate() {
            if number == 0 && (60..63).contains(&index) {
                recording.gap(0, TriggerIndex(index), GapCause::Unplugged).expect("recorded");
            } else {
                let (meta, message) = frame(camera, number, index);
                recording.frame(number, &meta, &message).expect("recorded");
            }
        }
    }
    recording.finish(end(TRIGGERS)).expect("finished");
}

fn both(session: &Path) {
    record(session, "a", &["h0_up", "h0_low"]);
    record(session, "b", &["h2_up", "h2_low"]);
}

#[test]
fn a_whole_session_is_described() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let session = dir.path().join("walk-01");
    both(&session);
    let (code, text, json) = info(&session);
    assert_eq!(code, 0, "{text}");
    for expected in [
        "session walk-01 of nodes a and b: 4 cameras",
        "session     walk-01 (5f0c)",
        "node        b",
        "subject     s-17",
        "note        slow walk",
        "recorded    2026-09-21 14:13:20 UTC by test",
        "hsu         hsu-1 firmware 1.0 protocol 1",
        "triggers    120 at 120 Hz (0.99 s); 120 requested, the HSU's count is 120",
        "table       120 rows, 120.0000 Hz by the HSU's clock",
        "gap         h0_up: 3 unplugged, the first at trigger 60",
        "settings    all cameras: ExposureTime 800, TriggerMode On",
        "camera_lost  3      60                no packets for 25 ms",
        "disk        reached ",
        "durable",
        "closed",
    ] {
        assert!(text.contains(expected), "{expected:?} missing in\n{text}");
    }
    assert!(!text.contains("MISSING"), "{text}");

    let recording = &json["recordings"][0];
    let camera = &recording["cameras"][0];
    assert_eq!((&camera["id"], &camera["frames"]), (&"h0_up".into(), &117.into()), "{recording:#}");
    assert_eq!((&camera["gaps"]["unplugged"], &camera["first_gaps"]["unplugged"]), (&3.into(), &60.into()));
    assert_eq!((&camera["absent"], &camera["settings"][0]["value"]), (&0.into(), &800.0.into()));
    let [hsu, clock] = recording["clocks"].as_array().expect("clocks").as_slice() else {
        panic!("{:#}", recording["clocks"])
    };
    assert_eq!((&hsu["camera"], &hsu["samples"]), (&Value::Null, &120.into()));
    assert_eq!((&clock["camera"], &clock["round_trip_min_ns"]), (&"h0_up".into(), &100_000.into()));
    // A second of exchanges of 100 us: the skew is hardly known, the offset to the round trip.
    let host = trigger(TRIGGERS - 1).host_time_ns;
    let true_offset = (CAMERA_AHEAD_NS as f64
        + (host - trigger(0).host_time_ns) as f64 * (1.0 + SKEW_PPM * 1e-6))
        - host as f64;
    let offset = clock["offset_ns"].as_i64().expect("a number") as f64;
    let open = clock["uncertainty_ns"].as_f64().expect("a number");
    assert!((offset - true_offset).abs() <= open && open < 200_000.0, "{offset} {true_offset} {open}");
    assert!(clock["residual_ns"].as_f64().expect("a number") < 50_000.0, "{clock:#}");
    assert!(clock["skew_ppm"].as_f64().is_some_and(|ppm| ppm.abs() < 500.0), "{clock:#}");
    let statistics = &recording["write_statistics"];
    assert!(
        ["direct", "page_cache"].contains(&statistics["access"].as_str().unwrap_or_default()),
        "{statistics:#}"
    );
    assert!(statistics["durable"]["p99_us"].is_u64() && statistics["blocks_high_water"].is_u64());
    assert_eq!(recording["event_kinds"][0]["first_trigger"], 60);
    assert_eq!(recording["missing"], serde_json::json!([]));
    let segments = recording["segment_files"].as_array().expect("segments");
    assert!(segments.len() > 2 && segments.iter().all(|segment| segment["closed"] == true));
    assert_eq!(segments[1]["first_trigger"], segments[0]["end_trigger"]);

    // A copy says how the disk kept up with the original, not with the copy.
    let copy = dir.path().join("copy");
    recover(&session, &copy, &|_, _| ()).expect("recovered");
    assert_eq!(info(&copy).2["recordings"][0]["write_statistics"], *statistics);
}

#[test]
fn an_interrupted_and_a_damaged_recording_say_what_is_missing() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let session = dir.path().join("walk-01");
    both(&session);
    let a = session.join("node-a");
    let count = std::fs::read_dir(&a).expect("a directory").count();
    assert!(count > 3, "{count} segments");
    let segment = |number: usize| a.join(format!("segment-{number:03}.mcap"));
    let last = std::fs::read(segment(count - 1)).expect("readable");
    std::fs::write(segment(count - 1), &last[..last.len() / 2]).expect("written");
    let (code, text, json) = info(&session);
    assert_eq!(code, 0, "{text}");
    assert_contains(
        &text,
        &[
            "not closed, usable up to byte",
            "MISSING     the verdict: the recording was not finished",
            "`fourdbody recover` to save the rest",
            "disk        not known",
            "session     walk-01 (5f0c)",
        ],
    );
    let recording = &json["recordings"][0];
    assert_eq!(recording["verdict"], Value::Null);
    assert_eq!(json["recordings"][1]["missing"], serde_json::json!([]), "the other node is whole");

    std::fs::remove_file(segment(1)).expect("there");
    let mut bytes = std::fs::read(segment(2)).expect("readable");
    let middle = bytes.len() / 2;
    bytes[middle..middle + 3000].fill(0);
    std::fs::write(segment(2), bytes).expect("written");
    let (code, text, json) = info(&session);
    assert_eq!(code, 0, "{text}");
    assert_contains(
        &text,
        &[
            "expected segment 1 here: it is missing",
            "MISSING     camera h0_low:",
            "triggers have neither a frame nor a gap record, the first is",
            "rows of the HSU's trigger table",
        ],
    );
    let absent = json["recordings"][0]["cameras"][1]["absent"].as_u64().expect("a number");
    assert!(absent > 0 && absent < TRIGGERS, "{absent}");

    // Nothing of one node can be read: the other one is described all the same.
    for entry in std::fs::read_dir(&a).expect("a directory") {
        std::fs::write(entry.expect("an entry").path(), b"gone").expect("written");
    }
    let (code, text, json) = info(&session);
    assert_eq!(code, 4, "{text}");
    assert!(text.contains("NOT READABLE") && text.contains("node        b"), "{text}");
    assert_eq!(json["unreadable"][0]["node"], "a");
    let (code, text, _) = info(&a);
    assert_eq!(code, 4, "{text}");
    assert!(text.contains("no segment has a readable header"), "{text}");
    assert_eq!(info(&dir.path().join("nothing")).0, 2);
}

#[test]
fn a_single_segment_is_described_alone() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let session = dir.path().join("walk-01");
    record(&session, "a", &["h0_up", "h0_low"]);
    let (code, text, json) = info(&session.join("node-a/segment-001.mcap"));
    assert_eq!(code, 0, "{text}");
    assert!(!text.contains("MISSING"), "{text}");
    assert!(json["first_trigger"].as_u64().is_some_and(|first| first > 0), "{json:#}");
}
