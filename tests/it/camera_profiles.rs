// SPDX-License-Identifier: MIT OR Apache-2.0
//! Node files' words on real nodes and simulated cameras: what is said is set, what the last user left is mended, and
//! what cannot be is refused with all reasons at once; the state that a recording holds.

use crate::lab::{
    SIZE, assert_contains, capture_whole, fourdbody, laboratory, options, say, small_rig, start_laboratory,
    start_nodes, text_of,
};
use crate::matrix::{judge, without_user_sets};
use crate::profiles::tables;
use crate::session_faults::check_frames;
use fourdbody::camera::{AravisCameras, Camera, CameraBackend, CameraError, Wishes};
use fourdbody::config::{FeatureSetting, FeatureValue, NodeConfig};
use fourdbody::data::FrameSource;
use fourdbody::record::SessionReader;
use fourdbody_simulator::gige::{Habits, Make};
use fourdbody_simulator::laboratory::{Laboratory, LaboratoryOptions};
use serde_json::Value;
use std::path::Path;
use std::process::Output;
use std::sync::Arc;
use std::time::{Duration, Instant};

fn capture(laboratory: &Laboratory, name: &str) -> Output {
    capture_whole(laboratory, name, 12, &[])
}

fn json(output: &Output) -> Value {
    serde_json::from_slice(&output.stdout).unwrap_or_else(|e| panic!("{e}: {}", text_of(output)))
}

/// The first camera of a laboratory, as its node's file has it.
fn first_camera(laboratory: &Laboratory) -> (Box<dyn Camera>, Wishes) {
    let config = NodeConfig::load(&laboratory.nodes[0].path).expect("a node file");
    let camera = AravisCameras.open(&config.cameras[0].address).expect("free");
    (camera, Wishes::of(&config, &config.cameras[0]))
}

#[test]
fn what_is_said_is_set_and_the_whole_state_is_recorded() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = laboratory(dir.path(), 20.0);
    say(&laboratory.nodes[0].path, "h0_low", "exposure_us = 700.0");
    // Left over: another trigger is on, and the exposure is long.
    let (mut camera, mut wishes) = first_camera(&laboratory);
    let text = |text: &str| FeatureValue::Text(text.to_owned());
    let set = |feature: &str, value| FeatureSetting { feature: feature.to_owned(), value };
    wishes.raw = vec![
        set("TriggerSelector", text("AcquisitionStart")),
        set("TriggerMode", text("On")),
        set("ExposureTime", FeatureValue::Float(9000.0)),
        set("ExposureMode", text("TriggerWidth")),
        set("AcquisitionFrameRateEnable", FeatureValue::Flag(true)),
    ];
    let refused = camera.set_up(&wishes).expect_err("two triggers");
    assert!(matches!(refused, CameraError::SetUp { .. }), "{refused}");
    assert_eq!(camera.state().expect("read")["ExposureMode"], "TriggerWidth");
    drop(camera);
    let mut nodes = start_nodes(&laboratory);
    let captured = capture(&laboratory, "words");
    assert_eq!(captured.status.code(), Some(0), "{}", text_of(&captured));
    nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
    drop(nodes);
    let session = dir.path().join("sessions/words");
    assert!(check_frames(&session).iter().all(Vec::is_empty));
    let reader = SessionReader::open(&session).expect("readable");
    let cameras = &reader.recordings()[0].header.cameras;
    let exposures: Vec<&str> = cameras.iter().map(|camera| camera.state["ExposureTime"].as_str()).collect();
    assert_eq!(exposures[1], "700");
    assert_ne!(exposures[0], "9000");
    let has = |feature: &str| cameras[0].state[feature].as_str();
    assert_eq!(
        (has("TriggerMode"), has("TriggerSource"), has("TriggerSelector")),
        ("On", "Line0", "FrameStart")
    );
    assert_eq!((has("ExposureMode"), has("AcquisitionFrameRateEnable")), ("Timed", "false"));
    assert!(cameras[0].state.len() > 40, "{} features", cameras[0].state.len());

    // What was recorded is what is there, and what a session differs in is told.
    // The node was killed: its cameras are free when its heartbeats time out.
    let deadline = Instant::now() + Duration::from_secs(30);
    let address = laboratory.cameras[1].address().to_string();
    let mut dumped = fourdbody(&["cameras", "dump", &address, "--json"]);
    while dumped.status.code() == Some(5) && Instant::now() < deadline {
        dumped = fourdbody(&["cameras", "dump", &address, "--json"]);
    }
    assert_eq!(dumped.status.code(), Some(0), "{}", text_of(&dumped));
    assert_eq!(json(&dumped)["cameras"][&address]["state"]["ExposureTime"], "700");
    let file = dir.path().join("dump.json");
    let config = laboratory.nodes[0].path.display().to_string();
    let dumped = fourdbody(&["cameras", "dump", "--config", &config, "--json"]);
    std::fs::write(&file, &dumped.stdout).expect("writable");
    let (mut camera, mut wishes) = first_camera(&laboratory);
    let set = camera.set_up(&wishes).expect("set up");
    assert_eq!(camera.changed(&set.watched).expect("read"), []);
    wishes.words.exposure_us = Some(500.0);
    camera.set_up(&wishes).expect("set up");
    let changed = camera.changed(&set.watched).expect("read");
    assert_eq!(changed, [("ExposureTime".to_owned(), "1000".to_owned(), "500".to_owned())]);
    drop(camera);
    let changed = dir.path().join("changed.json");
    let dumped = fourdbody(&["cameras", "dump", "--config", &config, "--json"]);
    std::fs::write(&changed, &dumped.stdout).expect("writable");
    let [file, changed] = [file, changed].map(|path| path.display().to_string());
    let diff = json(&fourdbody(&["cameras", "diff", "--json", &file, &changed]));
    let of_first = diff["cameras"]["h0_up"].as_array().expect("differences");
    assert!(of_first.iter().any(|d| d["feature"] == "ExposureTime" && d["b"] == "500"), "{diff:#}");
    let none = diff["cameras"]["h0_low"].as_array().expect("differences");
    assert!(!none.iter().any(|d| d["feature"] == "ExposureTime"), "{diff:#}");
    let diff = fourdbody(&["cameras", "diff", &session.display().to_string(), &changed]);
    assert_eq!(diff.status.code(), Some(0), "{}", text_of(&diff));
    assert_contains(&text_of(&diff), &["h0_up", "ExposureTime", "-> 500"]);
    let nothing = fourdbody(&["cameras", "diff", "/nonexistent", &changed]);
    assert_eq!(nothing.status.code(), Some(2), "{}", text_of(&nothing));
}

/// Cameras of three makes, each left by somebody: told is what was mended and rounded, and every frame is right.
#[test]
fn cameras_of_other_makes_are_set_and_what_was_left_is_told() {
    let Some(tables) = tables() else { return };
    let dir = tempfile::tempdir().expect("a temporary directory");
    let file = |name: &str| tables.join(format!("{name}.json"));
    let make = |file: &Path, left: &[(&str, &str)]| {
        let load = Make::load(file).expect("a table");
        let left = left.iter().try_fold(load, |make, (feature, value)| make.left_over(feature, value));
        Arc::new(left.expect("it has these features"))
    };
    // One that has no settings of delivery must be mended feature by feature.
    let bare = without_user_sets(&file("flir_bfs_pge_88s6m"), dir.path());
    let makes = [
        (
            "h0_up",
            "Line1",
            make(
                &file("basler_aca1920_25gm"),
                &[("TriggerMode[AcquisitionStart]", "On"), ("GainAuto", "Continuous")],
            ),
        ),
        (
            "h0_low",
            "Line1",
            make(&file("avt_mako_g507b"), &[("ExposureAuto", "Continuous"), ("ReverseX", "true")]),
        ),
        (
            "h1_up",
            "Line0",
            make(
                &bare,
                &[("GammaEnable", "true"), ("ReverseX", "true"), ("AcquisitionFrameRateEnable", "true")],
            ),
        ),
    ];
    let step = Habits { exposure_step: Duration::from_micros(35), ..Habits::default() };
    let options = LaboratoryOptions {
        makes: makes.iter().map(|(id, _, make)| ((*id).to_owned(), Arc::clone(make))).collect(),
        habits: [("h0_up".to_owned(), step)].into(),
        make_words: false,
        ..options(small_rig(20.0), dir.path())
    };
    let laboratory = start_laboratory(&options);
    for (id, line, _) in &makes {
        say(&laboratory.nodes[0].path, id, &format!("trigger_line = {line:?}"));
        say(&laboratory.nodes[0].path, id, "exposure_us = 1000.0");
    }
    let mut nodes = start_nodes(&laboratory);
    let captured = capture(&laboratory, "makes");
    assert_eq!(captured.status.code(), Some(0), "{}", text_of(&captured));
    nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
    let reader = SessionReader::open(&dir.path().join("sessions/makes")).expect("readable");
    for (number, camera) in (1..).zip(reader.cameras()).take(makes.len()) {
        // The simulator exposes those of other makes for as long as they are set.
        let (wrong, gaps) = judge(&reader, camera, number, SIZE);
        assert_eq!((wrong, gaps), (None, Vec::new()), "{camera}");
    }
    let events = &reader.recordings()[0].events;
    let told = |camera: &str| -> String {
        let of = events.iter().filter(|event| {
            event.kind == "camera_setting" && event.camera.as_ref().is_some_and(|id| id.as_str() == camera)
        });
        of.map(|event| format!("{}\n", event.message)).collect()
    };
    assert_contains(&told("h0_up"), &["exposure_us = 1000: the camera takes 1015 us (ExposureTimeAbs 1015)"]);
    assert_contains(
        &told("h1_up"),
        &[
            "GammaEnable was true and is set to false",
            "ReverseX was true",
            "AcquisitionFrameRateEnable was true",
        ],
    );
}

/// Cameras whose trigger or exposure no rule knows: `settings` stand for those words, and all else is as for others.
#[test]
fn what_no_rule_knows_is_left_to_settings() {
    let Some(tables) = tables() else { return };
    let dir = tempfile::tempdir().expect("a temporary directory");
    let load = |name: &str| Arc::new(Make::load(&tables.join(format!("{name}.json"))).expect("a table"));
    let makes = [("h0_up", "pco1600"), ("h0_low", "jai_rm_6740ge")];
    let options = LaboratoryOptions {
        makes: makes.iter().map(|(id, name)| ((*id).to_owned(), load(name))).collect(),
        make_words: false,
        ..options(small_rig(20.0), dir.path())
    };
    let laboratory = start_laboratory(&options);
    let file = &laboratory.nodes[0].path;
    say(file, "h0_up", "trigger_line = \"ExtTrig\"");
    say(file, "h0_up", "left_to_settings = [\"trigger_edge\"]");
    say(file, "h0_up", "settings = [[\"TriggerActivation\", \"None\"]]");
    say(file, "h0_low", "left_to_settings = [\"trigger_line\", \"exposure_us\"]");
    say(file, "h0_low", "settings = [[\"ExposureMode\", \"AsyncProgrammable\"]]");
    let mut nodes = start_nodes(&laboratory);
    let captured = capture(&laboratory, "settings");
    assert_eq!(captured.status.code(), Some(0), "{}", text_of(&captured));
    nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
    let reader = SessionReader::open(&dir.path().join("sessions/settings")).expect("readable");
    for (number, camera) in (1..).zip(reader.cameras()).take(makes.len()) {
        let (wrong, gaps) = judge(&reader, camera, number, SIZE);
        assert_eq!((wrong, gaps), (None, Vec::new()), "{camera}");
    }
}

#[test]
fn all_problems_of_all_cameras_are_told_at_once() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = start_laboratory(&options(small_rig(20.0), dir.path()));
    let file = |node: usize| laboratory.nodes[node].path.clone();
    say(&file(0), "h0_up", "trigger_line = \"Line7\"");
    say(&file(0), "h1_up", "gain_db = 90.0");
    say(&file(0), "h1_low", "trigger_edge = \"falling\"");
    say(&file(1), "h2_up", "settings = [[\"BlackLevel\", 4.0], [\"AcquisitionMode\", \"Never\"]]");
    let nodes = start_nodes(&laboratory);
    let refused = capture(&laboratory, "refused");
    let text = text_of(&refused);
    println!("{text}");
    assert_eq!(refused.status.code(), Some(5), "{text}");
    assert_contains(
        &text,
        &[
            "camera h0_up: ",
            "`Line7` is not an entry of TriggerSource: ",
            "set trigger_line = \"Line0\"",
            "camera h1_up: ",
            "requested gain_db = 90",
            "camera h1_low: ",
            "`FallingEdge` is not an entry of TriggerActivation: RisingEdge",
            "camera h2_up: ",
            "feature BlackLevel: requested 4, the camera has no such feature",
            "`Never` is not an entry of AcquisitionMode: ",
        ],
    );
    drop(nodes);
    assert!(!dir.path().join("sessions/refused").exists());
}
