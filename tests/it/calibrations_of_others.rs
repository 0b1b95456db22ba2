// SPDX-License-Identifier: MIT OR Apache-2.0
//! `calibration import`: what OpenCV's `projectPoints` makes of a stereo calibration is what ours makes of it, however it
//! was kept; and what we have no lens for is refused by its name.

use crate::lab::{assert_contains, fourdbody, text_of};
use crate::third_party_mcap::python;
use fourdbody::calibrate::foreign::device_mut;
use fourdbody::data::Calibration;
use nalgebra::Point3;
use std::path::Path;
use std::process::Command;

/// A camera and its projector, somewhere in the world.
const RIG: &str = r#"
format = 1
name = "bench"
trigger_rate_hz = 20.0
[volume]
min_m = [-0.2, 0.5, -0.2]
max_m = [0.2, 0.9, 0.2]
[pattern]
period_px = 16.0
marker_index = 40
marker = "zero_mean"
marker_strength = 0.3
marker_period_px = 16.0
low = 0.0
high = 1.0
gamma = 1.0
[board]
width_m = 0.3
height_m = 0.4
pitch_m = 0.03
columns = 8
rows = 11
radius_m = 0.005
large_radius_m = 0.008
large = [[2, 5], [3, 5], [2, 7], [5, 5], [6, 2]]
[[head]]
id = "h0"
channel = "R"
delay_us = 200.0
exposure_us = 1000.0
[head.projector]
width = 1280
height = 800
focal_px = 2500.0
position_m = [0.3, 0.1, 0.0]
look_at_m = [0.1, 0.9, 0.2]
roll_deg = 0.0
[[head.camera]]
id = "eye"
node = "a"
width = 1920
height = 1200
focal_px = 1750.0
position_m = [0.1, 0.1, 0.2]
look_at_m = [0.2, 0.9, 0.1]
roll_deg = 10.0
"#;

/// A directory with the files of `third_party_calibrations.py`; nothing without these programs.
fn place() -> Option<tempfile::TempDir> {
    let dir = tempfile::tempdir().expect("a temporary directory");
    std::fs::write(dir.path().join("bench.toml"), RIG).expect("written");
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/it/third_party_calibrations.py");
    let made = Command::new(python()?).arg(script).arg(dir.path()).output().expect("Python runs");
    let problem = String::from_utf8_lossy(&made.stderr);
    if problem.contains("ModuleNotFoundError") {
        println!("skipped: {problem} (`make test` installs it into tests/.venv)");
        return None;
    }
    assert!(made.status.success(), "{problem}");
    Some(dir)
}

/// Exit code and text of an import of some files.
fn import(dir: &Path, files: &[&str], more: &[&str]) -> (Option<i32>, String) {
    let at = |name: &str| dir.join(name).to_str().expect("UTF-8").to_owned();
    let files: Vec<String> = files.iter().map(|file| at(file)).collect();
    let mut args = vec!["calibration", "import", "--from"];
    args.extend(files.iter().map(String::as_str));
    let (rig, out) = (at("bench.toml"), at("calibration.json"));
    let _ = std::fs::remove_file(&out);
    args.extend(["--rig", &rig, "--out", &out]);
    let output = fourdbody(&[&args, more].concat());
    (output.status.code(), text_of(&output))
}

/// The largest distance, px, between OpenCV's pixels and those of two devices of the imported calibration.
fn off(dir: &Path, names: &[&str]) -> f64 {
    let mut calibration = Calibration::load(&dir.join("calibration.json")).expect("a calibration");
    let text = std::fs::read(dir.join("points.json")).expect("written");
    let all: serde_json::Value = serde_json::from_slice(&text).expect("JSON");
    let list = |key: &str| -> Vec<Vec<f64>> { serde_json::from_value(all[key].clone()).expect("numbers") };
    let world_from_first = device_mut(&mut calibration, names[0]).expect("it is there").world_from_device;
    let mut most: f64 = 0.0;
    for (name, pixels) in names.iter().zip([list("first"), list("second")]) {
        let device = device_mut(&mut calibration, name).expect("it is there");
        for (point, pixel) in list("points").iter().zip(pixels) {
            let world = world_from_first.isometry() * (Point3::new(point[0], point[1], point[2]) / 1e3);
            let [u, v] = device.project(&world).expect("seen");
            most = most.max((u - pixel[0]).hypot(v - pixel[1]));
        }
    }
    most
}

#[test]
fn pixels_are_those_of_opencv_however_its_calibration_was_kept() {
    let Some(dir) = place() else { return };
    let unit = ["--unit-mm", "1"];
    for files in [
        &["stereo.yml"][..],
        &["stereo4.yml"],
        &["stereo.xml"],
        &["stereo.json"],
        &["stereo.npz"],
        &["pair.yaml"],
        &["intrinsics.yml", "extrinsics.yml"],
        &["matlab.json"],
        &["matlab_old.json"],
        &["anipose.toml"],
        &["caliscope.toml"],
    ] {
        let stated = files[0].starts_with("matlab");
        let (code, text) = import(dir.path(), files, if stated { &[] } else { &unit });
        assert_eq!(code, Some(0), "{files:?}: {text}");
        assert_contains(&text, &["h0", "109.5 mm from the first"]);
        let off = off(dir.path(), &["eye", "h0"]);
        assert!(off < 1e-6, "{files:?}: {off} px");
    }
    let (code, text) = import(dir.path(), &["stereo.yml"], &[]);
    assert_eq!(code, Some(2), "{text}");
    assert_contains(&text, &["expected the unit of the translation: --unit-mm 1"]);
    let (code, text) = import(dir.path(), &["stereo.yml"], &["--unit-mm", "1000", "--devices", "h0,eye"]);
    assert_eq!(code, Some(0), "{text}");
    assert!(off(dir.path(), &["eye", "h0"]) > 10.0);
    let (code, text) = import(dir.path(), &["single.npz"], &[]);
    assert_eq!(code, Some(0), "{text}");
    assert!(off(dir.path(), &["eye"]) < 0.01, "in 32 bits");
    let (code, text) = import(dir.path(), &["rational_zero.yml"], &[]);
    assert_eq!(code, Some(0), "{text}");
}

#[test]
fn what_no_lens_of_ours_is_and_what_is_no_calibration_is_named() {
    let Some(dir) = place() else { return };
    std::fs::write(dir.path().join("stereo.mat"), b"MATLAB 5.0 MAT-file, written by").expect("written");
    std::fs::write(dir.path().join("other.yml"), "a: 1\nb: [1, 2]\n").expect("written");
    std::fs::write(dir.path().join("deep.yml"), "a: ".to_owned() + &"[".repeat(100_000)).expect("written");
    std::fs::write(dir.path().join("dashes.yml"), "- ".repeat(100_000)).expect("written");
    let steps: String = (0..20_000).map(|i| " ".repeat(i % 4000) + "a:\n").collect();
    std::fs::write(dir.path().join("steps.yml"), steps).expect("written");
    std::fs::write(dir.path().join("bomb.yml"), "a: &a [1]\nb: [*a, *a]\n").expect("written");
    for (file, words) in [
        ("rational.yml", "found the rational model (k4, k5, k6)"),
        ("tilted.yml", "found the tilted sensor model"),
        ("skew.yml", "expected a camera matrix without skew"),
        ("fisheye.yml", "found fisheye_model: 1"),
        ("fisheye.toml", "cam_0: expected radial and tangential distortion, found fisheye = true"),
        ("ros.yaml", "found distortion_model: equidistant"),
        ("mirrored.yml", "expected a rotation"),
        ("sized.yml", "eye: expected 1920 x 1200 pixels as in the rig, found 640 x 480"),
        ("stereo.mat", "jsonencode(toStruct(stereoParams))"),
        ("other.yml", "found a, b; rename them"),
        ("points.json", "under their usual names"),
        ("deep.yml", "more than 32 deep"),
        ("dashes.yml", "more than 32 deep"),
        ("steps.yml", "more than 32 deep"),
        ("bomb.yml", "an alias (*), which is not read"),
        ("none.yml", "No such file"),
    ] {
        let (code, text) = import(dir.path(), &[file], &["--unit-mm", "1"]);
        assert_eq!(code, Some(2), "{file}: {text}");
        assert_contains(&text, &[file, words]);
        assert!(!dir.path().join("calibration.json").exists(), "{file}");
    }
    let (code, text) = import(dir.path(), &["stereo.yml"], &["--unit-mm", "1", "--devices", "eye,left"]);
    assert_eq!(code, Some(2), "{text}");
    assert_contains(&text, &["expected a camera or a head of the rig (eye, h0), found left"]);
    let (code, text) = import(dir.path(), &["stereo.yml"], &["--unit-mm", "1", "--devices", "eye"]);
    assert_eq!(code, Some(2), "{text}");
    assert_contains(
        &text,
        &["expected a name for each of the 2 devices in the file (K1, D1; K2, D2), found 1"],
    );
}

/// Every device of a scene is where the scene has it in the world.
#[test]
fn a_scene_needs_neither_unit_nor_names() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    std::fs::write(dir.path().join("bench.toml"), RIG).expect("written");
    // It looks along the world's y, with z up, from half a metre before the origin.
    let device = |width: u32, height: u32, x: f64| {
        format!(
            r#""width": {width}, "height": {height}, "fx": 2000.0, "fy": 2000.0, "cx": 600.0, "cy": 400.0,
            "dist": [0.0, 0.0, 0.0, 0.0, 0.0], "R": [[1, 0, 0], [0, 0, -1], [0, 1, 0]], "t": [{x}, 0.0, 0.5]"#
        )
    };
    let scene = format!(
        r#"{{"heads": [{{"id": 0, "channel": "R", "projector": {{{}}}, "cameras": [{{"name": "eye", {}}}]}}]}}"#,
        device(1280, 800, 0.1),
        device(1920, 1200, 0.0)
    );
    std::fs::write(dir.path().join("scene.json"), scene).expect("written");
    let (code, text) = import(dir.path(), &["scene.json"], &[]);
    assert_eq!(code, Some(0), "{text}");
    let calibration = Calibration::load(&dir.path().join("calibration.json")).expect("a calibration");
    let head = &calibration.heads[0];
    let point = Point3::new(0.05, 0.5, -0.1);
    for (device, x) in [(&head.cameras[0].device, 0.0), (&head.projector, 0.1)] {
        let [u, v] = device.project(&point).expect("seen");
        let expected = [600.0 + 2000.0 * (0.05 + x), 400.0 + 2000.0 * 0.1];
        assert!((u - expected[0]).abs() < 1e-9 && (v - expected[1]).abs() < 1e-9, "{u} {v} {expected:?}");
    }
}
