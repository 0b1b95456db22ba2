// SPDX-License-Identifier: MIT OR Apache-2.0
//! `calibrate` as scripts see it, from image files to `calibration.json`, its report, and clouds made with it.

use crate::board_photographs::{errors, good, scene};
use crate::validate_commands::{fails, fourdbody, json, number, text};
use fourdbody::base::image::write_png_grey;
use fourdbody::data::Calibration;
use fourdbody_simulator::rig_file::to_toml;
use std::path::{Path, PathBuf};

/// A directory with a rig file and the frames of these triggers, as `--session` takes them.
struct Files {
    dir: tempfile::TempDir,
    rig: PathBuf,
    board: PathBuf,
    images: PathBuf,
}

impl Files {
    fn new(triggers: std::ops::Range<u64>) -> Self {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let (rig, images) = (dir.path().join("rig.toml"), dir.path().join("images"));
        std::fs::write(&rig, to_toml(scene().rig())).expect("writable");
        let photographs = good();
        for (camera, (_, known)) in scene().rig().cameras().enumerate() {
            let folder = images.join(known.id.as_str());
            std::fs::create_dir_all(&folder).expect("writable");
            for trigger in triggers.clone() {
                let image = photographs.image(trigger, camera).into();
                write_png_grey(&folder.join(format!("{trigger:06}.png")), image).expect("writable");
            }
        }
        let board = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/board.toml");
        Self { dir, rig, board, images }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    /// `calibrate` of these files to `calibration.json`, with more arguments.
    fn arguments(&self, more: &[&str]) -> Vec<String> {
        let out = self.path("calibration.json");
        let paths =
            [("--rig", &self.rig), ("--board", &self.board), ("--session", &self.images), ("--out", &out)];
        let paths = paths.into_iter().flat_map(|(name, path)| [name.to_owned(), text(path).to_owned()]);
        let more = more.iter().map(|s| (*s).to_owned());
        ["calibrate".to_owned()].into_iter().chain(paths).chain(more).collect()
    }
}

fn words(arguments: &[String]) -> Vec<&str> {
    arguments.iter().map(String::as_str).collect()
}

#[test]
fn photographs_become_a_calibration_a_report_and_flat_boards() {
    let files = Files::new(0..16);
    let report = files.path("report");
    let found = json(0, &words(&files.arguments(&["--report", text(&report), "--upright", "1"])));
    for key in ["calibration", "quality", "findings", "advice", "report"] {
        assert!(!found[key].is_null(), "{key}: {found:#}");
    }
    assert_eq!(found["quality"]["cameras"].as_array().map(Vec::len), Some(2), "{found:#}");
    assert!(number(&found, "/quality/cameras/0/circles_rms_px") < 0.05, "{found:#}");
    assert_eq!(found["quality"]["world"]["vertical_positions"], serde_json::json!([1]), "{found:#}");

    let path = files.path("calibration.json");
    let calibration = Calibration::load(&path).expect("what was written is readable");
    let (focal, place_m) = errors(&calibration, &scene().truth);
    let rows = calibration.heads[0].rows.expect("the dashes tell the panel's rows");
    println!("{rows:?}");
    assert!(rows.rms_px < 0.2, "{rows:?}");
    assert!(focal < 5e-4 && place_m < 5e-4, "focal {focal}, second camera {place_m} m off");
    let page = std::fs::read_to_string(report.join("index.html")).expect("a page");
    for expected in ["h0_up", "h0_low", "<svg", "Standard deviations", "</html>"] {
        assert!(page.contains(expected), "{expected} is missing in the page");
    }

    // Position 1, in fringes, through that calibration.
    let out = files.path("out");
    let images = text(&files.images);
    let made = fourdbody(&[
        "reconstruct",
        images,
        "--calibration",
        text(&path),
        "--out",
        text(&out),
        "--triggers",
        "1..2",
    ]);
    assert_eq!(made.status.code(), Some(0), "{}", String::from_utf8_lossy(&made.stderr));
    let plane = json(0, &["validate", "plane", "--clouds", text(&out), "--calibration", text(&path)]);
    // Fringes of 25 mm and discs of 30 mm at this size: the few per cent of points at the discs make the RMS.
    assert!(number(&plane, "/per_head/0/robust_mm") < 0.12 && number(&plane, "/rms_mm") < 1.0, "{plane:#}");
}

#[test]
fn what_cannot_be_calibrated_leaves_no_file() {
    let files = Files::new(0..4);
    let refused = |code: i32, arguments: &[String]| {
        let said = fails(code, &words(arguments));
        assert!(!files.path("calibration.json").exists(), "{said}");
        said
    };
    let few = refused(1, &files.arguments(&[]));
    assert!(few.contains("2 usable positions of the board that differ, expected at least 6"), "{few}");
    let nothing = text(&files.path("nothing")).to_owned();
    for option in ["--rig", "--board", "--session"] {
        let mut arguments = files.arguments(&[]);
        let value = arguments.iter().position(|a| a == option).expect("given") + 1;
        arguments[value].clone_from(&nothing);
        let said = refused(2, &arguments);
        assert!(said.contains(&nothing), "{option}: {said}");
    }
    // Neither photographs nor a walk; a walk without nodes.
    let without: Vec<String> =
        files.arguments(&[]).into_iter().filter(|a| a != "--session" && *a != text(&files.images)).collect();
    refused(2, &without);
    refused(2, &[without, vec!["--live".to_owned()]].concat());
}

#[test]
fn a_position_that_is_declared_level_must_be_so() {
    let files = Files::new(0..16);
    let said = fails(2, &words(&files.arguments(&["--level", "1"])));
    assert!(said.contains("position 1 was declared level, but is"), "{said}");
    assert!(!files.path("calibration.json").exists());
}
