// SPDX-License-Identifier: MIT OR Apache-2.0
//! `validate plane|distance|spacing|girth|truth` as scripts see them: exit codes, JSON keys, what is said of missing and
//! damaged files. On clouds of known shape, so that the figures are known, too.

use crate::board_photographs::{Scene, flat};
use fourdbody::base::image::write_png_grey;
use fourdbody::config::Rig;
use fourdbody::data::{Calibration, Cloud};
use fourdbody::formats::ply;
use fourdbody_simulator::cache::{CachedImages, Manifest};
use fourdbody_simulator::scenario::{Light, Scenario};
use fourdbody_simulator::sequence::{Changes, Run};
use serde_json::Value;
use std::f64::consts::TAU;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn file(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(name)
}

pub fn text(path: &Path) -> &str {
    path.to_str().expect("UTF-8")
}

pub fn fourdbody(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_fourdbody")).args(args).output().expect("the program runs")
}

/// Runs a command with this exit code and gives what it wrote on standard error.
pub fn fails(code: i32, args: &[&str]) -> String {
    let output = fourdbody(args);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(code), "{args:?}: {said}");
    said
}

/// Runs a command with --json and this exit code and gives its one JSON object.
pub fn json(code: i32, args: &[&str]) -> Value {
    let output = fourdbody(&[args, &["--json"]].concat());
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(code), "{args:?}: {said}");
    serde_json::from_slice(&output.stdout).unwrap_or_else(|e| panic!("{args:?}: not one JSON object: {e}"))
}

pub fn number(value: &Value, pointer: &str) -> f64 {
    value
        .pointer(pointer)
        .and_then(Value::as_f64)
        .unwrap_or_else(|| panic!("no number at {pointer}: {value:#}"))
}

/// Clouds under `dir` as `reconstruct` lays them out.
fn save(dir: &Path, name: &str, cloud: &Cloud) {
    let path = dir.join(name);
    std::fs::create_dir_all(path.parent().expect("a folder")).expect("writable");
    ply::save(&path, cloud, &[]).expect("writable");
}

/// The nominal calibration of the shipped rig.
fn calibration(dir: &Path) -> PathBuf {
    let path = dir.join("calibration.json");
    let rig = Rig::load(&file("config/rig.toml")).expect("the shipped rig");
    Calibration::nominal(&rig).save(&path).expect("writable");
    path
}

/// A plate of 0.6 x 0.4 m before head h0, a point every 2 mm, waves of `waves_m` RMS on it.
fn plate(waves_m: f64) -> Cloud {
    let mut cloud = Cloud::default();
    for (v, u) in (0..201u16).flat_map(|v| (0..301u16).map(move |u| (v, u))) {
        let wave = 2f64.sqrt() * waves_m * (TAU * f64::from(u) / 7.3).sin();
        let position = [0.3 + wave, -0.2 + 0.002 * f64::from(v), 1.3 - 0.002 * f64::from(u)];
        cloud.position_m.push(position.map(|x| x as f32));
        cloud.normal.push([1.0, 0.0, 0.0]);
        cloud.intensity.push(0.5);
        cloud.pixel.push([u, v]);
    }
    cloud
}

/// A ball of 0.15 m radius around (0, 0, 1), seen from all sides, merged.
fn ball() -> Cloud {
    let mut cloud = Cloud::default();
    let (rows, columns) = (150, 471);
    for row in 1..rows {
        let polar = TAU / 2.0 * f64::from(row) / f64::from(rows);
        for column in 0..columns {
            let turn = TAU * f64::from(column) / f64::from(columns);
            let normal = [polar.sin() * turn.cos(), polar.sin() * turn.sin(), polar.cos()];
            cloud.position_m.push([0, 1, 2].map(|i| ([0.0, 0.0, 1.0][i] + 0.15 * normal[i]) as f32));
            cloud.normal.push(normal.map(|x| x as f32));
            cloud.intensity.push(0.5);
            cloud.pixel.push([column as u16, row as u16]);
            cloud.camera.push(0);
        }
    }
    cloud
}

#[test]
fn plane_tells_the_waves_of_a_plate_and_exits_4_where_there_is_no_plane() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (out, calibration) = (dir.path().join("out"), calibration(dir.path()));
    save(&out, "clouds/h0_up_000000.ply", &plate(1e-4));
    save(&out, "clouds/h0_low_000000.ply", &plate(1e-4));
    let args = ["validate", "plane", "--clouds", text(&out), "--calibration", text(&calibration)];
    let report = json(0, &args);
    assert!((number(&report, "/rms_mm") - 0.1).abs() < 0.003, "{report:#}");
    assert_eq!((number(&report, "/per_head/0/trigger"), &report["per_head"][0]["head"]), (0.0, &"h0".into()));
    assert_eq!(report["per_camera"].as_array().map(Vec::len), Some(2));
    for key in ["points", "robust_mm", "p95_mm", "left_out", "edge", "rms_with_edge_mm", "used_share"] {
        assert!(report["per_camera"][0][key].is_number(), "{key}: {report:#}");
    }
    let table = fourdbody(&args);
    assert!(String::from_utf8_lossy(&table.stdout).contains("mean of heads and triggers: 0.1"), "{table:?}");

    save(&out, "clouds/h2_up_000000.ply", &Cloud::default());
    let report = json(4, &args);
    assert!((number(&report, "/rms_mm") - 0.1).abs() < 0.003, "what is there is still told: {report:#}");
    assert!(fails(4, &args).contains("h2_up 0: no plane"));
}

#[test]
fn a_cloud_that_is_damaged_exits_4_and_files_that_are_missing_exit_2() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (out, calibration) = (dir.path().join("out"), calibration(dir.path()));
    let (nothing, board) = (dir.path().join("nothing"), file("config/board.toml"));
    save(&out, "clouds/h0_up_000000.ply", &plate(0.0));
    save(&out, "merged/000000.ply", &ball());
    let (out, calibration, nothing, board) = (text(&out), text(&calibration), text(&nothing), text(&board));
    let commands: [&[&str]; 5] = [
        &["plane", "--calibration", calibration],
        &["distance", "--board", board],
        &["spacing"],
        &["girth", "--at", "x=1.0"],
        &["truth", "--sphere", "0,0,1,0.15"],
    ];
    for command in commands {
        let said = fails(2, &[&["validate"], command, &["--clouds", nothing]].concat());
        assert!(said.contains(nothing) && said.contains("fourdbody reconstruct"), "{command:?}: {said}");
    }
    let missing: [&[&str]; 6] = [
        &["plane", "--calibration", nothing],
        &["plane", "--calibration", calibration, "--board", nothing],
        &["distance", "--board", nothing],
        &["distance", "--board", board, "--calibration", calibration, "--session", nothing],
        &["truth", "--mesh", nothing],
        &["truth", "--truth", nothing, "--calibration", calibration],
    ];
    for command in missing {
        let said = fails(2, &[&["validate"], command, &["--clouds", out]].concat());
        assert!(said.contains(nothing), "{command:?}: {said}");
    }
    // Usage: nothing to compare with, a pair that is none, a photograph without calibration.
    assert!(fails(2, &["validate", "truth", "--clouds", out]).contains("--sphere"));
    assert!(fails(2, &["validate", "girth", "--clouds", out, "--at", "waist"]).contains("NAME=NUMBER"));
    fails(2, &["validate", "truth", "--clouds", out, "--sphere", "0,0,1,-1"]);
    fails(2, &["validate", "distance", "--clouds", out, "--board", board, "--session", out]);

    for name in ["clouds/h0_up_000000.ply", "merged/000000.ply"] {
        let path = Path::new(out).join(name);
        let bytes = std::fs::read(&path).expect("readable");
        std::fs::write(&path, &bytes[..bytes.len() - 5]).expect("writable");
    }
    for command in commands {
        let said = fails(4, &[&["validate"], command, &["--clouds", out]].concat());
        assert!(said.contains("00000.ply"), "{command:?}: {said}");
    }
}

#[test]
fn spacing_girth_and_a_sphere_are_those_of_the_ball() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let out = dir.path().join("out");
    save(&out, "clouds/h0_up_000003.ply", &plate(0.0));
    save(&out, "merged/000003.ply", &ball());
    let out = text(&out);
    let spacing = json(0, &["validate", "spacing", "--clouds", out]);
    assert!((number(&spacing, "/spacing_cloud_mm") - 2.0).abs() < 0.01, "{spacing:#}");
    for key in ["/spacing_merged_mm", "/spacing_merged_nearest_mm", "/spacing_merged_density_mm"] {
        assert!((0.5..4.0).contains(&number(&spacing, key)), "{key}: {spacing:#}");
    }

    let girth = ["validate", "girth", "--clouds", out, "--at", "equator=1.0", "--known", "equator=942.478"];
    let found = json(0, &girth);
    assert!(number(&found, "/girths/0/difference_mm").abs() < 0.05, "{found:#}");
    assert!(
        number(&found, "/mean_mm") == number(&found, "/max_mm") && found["girths"][0]["name"] == "equator"
    );
    let above = fails(4, &["validate", "girth", "--clouds", out, "--at", "crown=1.7"]);
    assert!(above.contains("crown") && above.contains("1.7 m"), "{above}");
    let unasked = [&girth[..], &["--known", "knee=300"]].concat();
    assert!(fails(2, &unasked).contains("--known knee: no loop has this name; found equator"));

    let truth = json(0, &["validate", "truth", "--clouds", out, "--sphere", "0,0,1,0.149"]);
    assert!((number(&truth, "/merged/mean_mm") - 1.0).abs() < 0.001, "{truth:#}");
    assert!((number(&truth, "/merged/fitted/radius_error_mm") - 1.0).abs() < 0.001, "{truth:#}");
    assert!(number(&truth, "/cameras/h0_up/gross_share") > 0.9, "a plate is no ball: {truth:#}");
}

#[test]
fn distance_says_why_nothing_was_measured() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let out = dir.path().join("out");
    save(&out, "clouds/h0_up_000000.ply", &plate(0.0));
    let board = file("config/board.toml");
    let report = json(4, &["validate", "distance", "--clouds", text(&out), "--board", text(&board)]);
    assert_eq!(report["missing"][0]["head"], "h0", "{report:#}");
    assert!(report["missing"][0]["reason"].is_string() && report["rms_mm"].is_null(), "{report:#}");
}

/// The board of our own light before one head at full size, reconstructed with the true rig.
#[test]
fn plane_and_distance_measure_the_board() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let [images, out, calibration] = ["images", "out", "calibration.json"].map(|name| dir.path().join(name));
    let scene = Scene::new(7, 1);
    scene.truth.save(&calibration).expect("writable");
    let photographs = scene.photograph(flat(0.2, 6.0, 4.0, 0.0), Light::Fringes, 0);
    for ((_, camera), photograph) in scene.rig().cameras().zip(&photographs) {
        let folder = images.join(camera.id.as_str());
        std::fs::create_dir_all(&folder).expect("writable");
        write_png_grey(&folder.join("000000.png"), photograph.into()).expect("writable");
    }
    let board = file("config/board.toml");
    let [images, out, calibration, board] = [&images, &out, &calibration, &board].map(|path| text(path));
    let made = fourdbody(&["reconstruct", images, "--calibration", calibration, "--out", out]);
    assert_eq!(made.status.code(), Some(0), "{}", String::from_utf8_lossy(&made.stderr));

    let shared = ["--clouds", out, "--calibration", calibration, "--board", board];
    let plane = json(0, &[&["validate", "plane"], &shared[..]].concat());
    assert!(number(&plane, "/rms_mm") < 0.12 && number(&plane, "/per_head/0/robust_mm") < 0.06, "{plane:#}");
    assert_eq!(plane["per_head"][0]["found_by"], "circles", "{plane:#}");
    // At the corners the light is 35 DN: a few points more or less at a dark circle's edge move what their intensities
    // say by half a millimetre. Photographs have every pixel.
    let photographs = ("photographs", &["--session", images][..], 0.05);
    for (from, more, most_mm) in [photographs, ("intensities and pattern", &[], 0.35)] {
        let distance = json(0, &[&["validate", "distance"], &shared[..], more].concat());
        assert!(number(&distance, "/rms_mm") < most_mm, "{distance:#}");
        assert_eq!((&distance["edges_from"], &distance["missing"]), (&from.into(), &serde_json::json!([])));
        for key in ["error_mm", "edges_mm", "diagonal_mm", "ends"] {
            assert_eq!(distance["per_head"][0][key].as_array().map(Vec::len), Some(2), "{key}: {distance:#}");
        }
    }
}

/// A ball of our own light before one head at half size, and what the head makes of it.
#[test]
fn truth_scores_what_reconstruct_makes_of_rendered_frames() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (frames, images, out) =
        (dir.path().join("frames"), dir.path().join("images"), dir.path().join("out"));
    let scenario = Scenario::load(&file("config/scenarios/sphere.toml")).expect("a valid scenario");
    let mut rig = Rig::load(&scenario.rig).expect("a valid rig");
    rig.heads.truncate(1);
    let run = Run::new(scenario, &rig, &Changes { size_divisor: 2, ..Changes::default() }).expect("fits");
    run.render(&frames, |_, _| {}).expect("rendered");
    let manifest = Manifest::load(&frames).expect("complete");
    for camera in &manifest.cameras {
        let folder = images.join(camera.id.as_str());
        std::fs::create_dir_all(&folder).expect("writable");
        let images = CachedImages::open(&frames, &manifest, &camera.id).expect("complete");
        write_png_grey(&folder.join("000000.png"), images.image(0).expect("an image")).expect("writable");
    }
    let (calibration, truth) = (frames.join("calibration.json"), frames.join("truth"));
    let (calibration, truth, out) = (text(&calibration), text(&truth), text(&out));
    let made = fourdbody(&["reconstruct", text(&images), "--calibration", calibration, "--out", out]);
    assert_eq!(made.status.code(), Some(0), "{}", String::from_utf8_lossy(&made.stderr));

    let args = ["validate", "truth", "--clouds", out, "--truth", truth, "--calibration", calibration];
    let pictures = dir.path().join("pictures");
    let score = json(0, &[&args[..], &["--pictures", text(&pictures)]].concat());
    assert!(pictures.join("h0_up_000000.png").is_file() && pictures.join("h0_low_000000.png").is_file());
    for part in ["/cameras/h0_up", "/cameras/h0_low", "/directional", "/merged"] {
        let of = |key: &str| number(&score, &format!("{part}/{key}"));
        assert!(of("points") > 3000.0 && of("wrong_order_share") < 0.001, "{part}: {score:#}");
        assert!(of("rms_right_order_mm") < 0.6 && of("robust_mm") < 0.4, "{part}: {score:#}");
        assert!(of("completeness_of_lit") > 0.5, "{part}: {score:#}");
    }
    let solid = json(0, &["validate", "truth", "--clouds", out, "--sphere", "0,0,1,0.15"]);
    assert!(number(&solid, "/merged/rms_mm") < 1.0, "{solid:#}");

    // Of half the rows, with the calibration beside the clouds, and with the one that is given, which is of all rows.
    let half = dir.path().join("half");
    let half = text(&half);
    let binned = ["--calibration", calibration, "--out", half, "--bin-rows", "2"];
    let made = fourdbody(&[&["reconstruct", text(&images)], &binned[..]].concat());
    assert_eq!(made.status.code(), Some(0), "{}", String::from_utf8_lossy(&made.stderr));
    let args_of_half = ["validate", "truth", "--clouds", half, "--truth", truth, "--images", text(&images)];
    let of_half = json(0, &args_of_half);
    assert_eq!(of_half, json(0, &[&args_of_half[..], &["--calibration", calibration]].concat()));
    let of = |score: &Value, key: &str| number(score, &format!("/directional/{key}"));
    for key in ["robust_mm", "completeness_of_lit"] {
        assert!((of(&of_half, key) / of(&score, key) - 1.0).abs() < 0.2, "{key}: {of_half:#} {score:#}");
    }
    assert!((2.0 * of(&of_half, "points") / of(&score, "points") - 1.0).abs() < 0.2, "{of_half:#}");

    // Truth that is not one.
    std::fs::write(Path::new(truth).join("h0_up_000000.npz"), b"not an archive").expect("writable");
    assert!(fails(4, &args).contains("h0_up_000000.npz"));
}
