// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a node counts, against what it recorded; and how that is judged.

use crate::lab::{fourdbody, laboratory, start_nodes, text_of};
use fourdbody::control::client::NodeClient;
use fourdbody::control::status::{Devices, Fitness, Health, Metrics, Settings, path};
use fourdbody::telemetry::exposition::text;
use fourdbody::telemetry::{Family, Grade, thresholds};
use std::time::{Duration, Instant};

const TRIGGERS: u64 = 30;

fn families(client: &NodeClient) -> Vec<Family> {
    client.get::<Metrics>(path::METRICS_JSON).expect("metrics").families
}

/// The numbers of a family, in their order.
fn numbers(families: &[Family], name: &str) -> Vec<f64> {
    let family = families.iter().find(|family| family.name == name);
    family.unwrap_or_else(|| panic!("no {name}")).samples.iter().map(|sample| sample.value).collect()
}

fn grades(client: &NodeClient) -> Vec<(String, Grade)> {
    let status = client.status().expect("a status");
    status.judgements.into_iter().map(|judged| (judged.name, judged.grade)).collect()
}

#[test]
fn what_is_counted_is_what_was_recorded() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let mut laboratory = laboratory(dir.path(), 20.0);
    let mut nodes = start_nodes(&laboratory);
    let client = nodes[0].client.clone();
    let before: Settings = client.get(path::SETTINGS).expect("settings");
    assert!(before.cameras.iter().all(|camera| camera.read_back.is_none() && camera.size == [320, 200]));
    let triggers = TRIGGERS.to_string();
    let output =
        fourdbody(&["capture", "--nodes", &laboratory.urls(), "--triggers", &triggers, "--name", "counted"]);
    assert_eq!(output.status.code(), Some(0), "{}", text_of(&output));
    nodes.iter_mut().for_each(|node| drop(node.wait_idle()));

    let counted = families(&client);
    crate::monitoring::assert_all_are_told(&counted);
    let cameras = before.cameras.len();
    assert_eq!(numbers(&counted, "fourdbody_frames_written_total"), vec![TRIGGERS as f64; cameras]);
    assert_eq!(numbers(&counted, "fourdbody_triggers_total"), [TRIGGERS as f64]);
    let gaps = numbers(&counted, "fourdbody_gaps_total");
    assert!(gaps.len() > 10 * cameras && gaps.iter().all(|count| *count == 0.0), "{gaps:?}");
    let bytes = numbers(&counted, "fourdbody_written_bytes_total")[0];
    let images = (TRIGGERS as usize * cameras * 320 * 200) as f64;
    assert!((images..images * 1.1).contains(&bytes), "{bytes} bytes for {images} of images");
    let stages = numbers(&counted, "fourdbody_latency_seconds");
    assert_eq!(stages.len(), 5);
    // Warm-up frames are matched and not recorded; what is durable may be told after the end.
    assert!(stages.iter().all(|count| *count >= (TRIGGERS as usize * cameras) as f64), "{stages:?}");
    for turns in ["node", "recorder", "writer"] {
        assert!(numbers(&counted, &format!("fourdbody_{turns}_turns_total"))[0] > 10.0, "{turns}");
    }
    let plain =
        client.ask(hyper::Method::GET, path::METRICS, None, Duration::from_secs(10)).expect("metrics");
    let plain = String::from_utf8_lossy(&plain.body).into_owned();
    // The same numbers in both forms, but for what goes on.
    let still = |text: &str| -> Vec<String> {
        let moving = ["node_turns", "disk_", "packets"];
        text.lines()
            .filter(|line| !moving.iter().any(|word| line.contains(word)))
            .map(str::to_owned)
            .collect()
    };
    assert_eq!(still(&plain), still(&text(&counted)));

    let judged = grades(&client);
    // Those of pictures come after those of a node.
    let names = thresholds::ALL.iter().map(|threshold| threshold.name);
    let names: Vec<&str> = names.take_while(|name| *name != thresholds::SATURATED.name).collect();
    assert_eq!(names.last(), Some(&"durable_p99"));
    assert_eq!(judged.iter().map(|(name, _)| name.as_str()).collect::<Vec<_>>(), names);
    let of = |judged: &[(String, Grade)], name: &str| {
        judged.iter().find(|(n, _)| n == name).map(|(_, grade)| *grade)
    };
    for name in ["cameras_missing", "hsu_missing", "frames_missing"] {
        assert_eq!(of(&judged, name), Some(Grade::Good), "{judged:?}");
    }
    let after: Settings = client.get(path::SETTINGS).expect("settings");
    let read_back = after.cameras[0].read_back.as_ref().expect("read back");
    for feature in ["ExposureTime", "TriggerMode", "TriggerSource", "PixelFormat"] {
        assert!(read_back.iter().any(|setting| setting.feature == feature), "{read_back:?}");
    }
    assert_eq!(after.cameras[0].configured[0].feature, "trigger_line");
    assert!(client.get::<Health>(path::HEALTH).expect("healthy").healthy);
    assert_eq!(client.get::<Fitness>(path::FITNESS).expect("fit"), Fitness { fit: true, reasons: vec![] });
    let shown = text_of(&fourdbody(&["status", "--nodes", &laboratory.urls()]));
    assert!(shown.contains("good frames_missing") && shown.contains("durable_p99"), "{shown}");

    // A camera that is pulled out is bad, and named.
    drop(laboratory.cameras.remove(0));
    let deadline = Instant::now() + Duration::from_secs(60);
    while of(&grades(&client), "cameras_missing") != Some(Grade::Bad) {
        assert!(Instant::now() < deadline, "{:?}", client.status());
        std::thread::sleep(Duration::from_millis(200));
    }
    let devices: Devices = client.get(path::DEVICES).expect("devices");
    assert!(devices.cameras[0].problem.is_some() && devices.cameras[1].problem.is_none());
    let health = client.ask(hyper::Method::GET, path::HEALTH, None, Duration::from_secs(10)).expect("health");
    let told: Health = serde_json::from_slice(&health.body).expect("health");
    assert_eq!((health.status.as_u16(), told.healthy), (503, false));
    assert!(told.reasons[0].contains(devices.cameras[0].id.as_str()), "{told:?}");
    let open = client.ask(hyper::Method::GET, path::FITNESS, None, Duration::from_secs(10)).expect("fitness");
    let told: Fitness = serde_json::from_slice(&open.body).expect("fitness");
    assert_eq!((open.status.as_u16(), told.fit), (503, false));
    assert_eq!(told.reasons, ["1 of 4 cameras cannot be used"]);
}
