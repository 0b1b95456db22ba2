// SPDX-License-Identifier: MIT OR Apache-2.0
//! The documents of docs/reference against real files: readers made from these alone (`scripts/readers`) find in a
//! recording, a phase map, a calibration and a result what this program has there.

use crate::analytic_scene::{photograph, sphere};
use crate::lab::text_of;
use crate::recording::{frame, header, record, trigger};
use crate::reused::{BALL, Place, reconstruct};
use crate::third_party_mcap::python;
use fourdbody::base::image::{Mono8, write_png_grey};
use fourdbody::config::Rig;
use fourdbody::data::{Calibration, PanelRows};
use fourdbody::reconstruct::triangulate::camera_projector::CameraProjector;
use nalgebra::Point3;
use serde_json::{Value, json};
use std::path::Path;
use std::process::Command;

/// What `reference.py` prints for these arguments; `None`, with a printed reason, where there is no Python for it.
fn read_by_reference(what: &str, paths: &[&Path]) -> Option<Value> {
    let Some(python) = python() else {
        println!("skipped: no Python with the `mcap` package (`make test` installs it into tests/.venv)");
        return None;
    };
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/it/reference.py");
    // Without `-B` it would leave compiled files beside the readers.
    let output =
        Command::new(python).arg("-B").arg(script).arg(what).args(paths).output().expect("Python runs");
    let text = text_of(&output);
    if text.contains("ModuleNotFoundError") {
        println!("skipped: {text}");
        return None;
    }
    assert!(output.status.success(), "{what}: {text}");
    Some(serde_json::from_slice(&output.stdout).expect("JSON"))
}

/// All copies of a file that have a changed bit, or are cut, are refused.
fn damage_is_refused(file: &Path, scratch: &Path) {
    std::fs::create_dir_all(scratch).expect("writable");
    let Some(found) = read_by_reference("damaged", &[file, scratch]) else { return };
    assert_eq!(found["refused"], found["copies"], "{}", file.display());
    assert!(found["copies"].as_u64() > Some(8), "{found}");
}

#[test]
fn frames_gaps_and_clocks_of_a_recording_are_found_by_its_document() {
    const CAMERAS: [&str; 2] = ["h0_up", "h0_low"];
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (triggers, missing) = (50, [(1, 7), (0, 49)]);
    let path = dir.path().join("walk-01/node-a");
    record(&path, header("a", &CAMERAS, Some(triggers)), triggers, &missing);
    assert!(path.read_dir().expect("a directory").count() > 1, "one segment alone shows too little");
    let Some(mut found) = read_by_reference("recording", &[&path]) else { return };

    let (mut frames, mut gaps) = (Vec::new(), Vec::new());
    for index in 0..triggers {
        for (number, camera) in CAMERAS.into_iter().enumerate() {
            if missing.contains(&(number, index)) {
                gaps.push(json!([camera, index, "missing_packets"]));
                continue;
            }
            let (meta, _) = frame(camera, number, index);
            let clocks = (meta.block.0, meta.camera_time_ns, meta.host_time_ns);
            let hsu_time_ns = trigger(index).hsu_time_ns;
            frames.push(json!([
                camera,
                index,
                clocks.0,
                clocks.1,
                clocks.2,
                meta.height,
                meta.width,
                meta.pixels_crc,
                hsu_time_ns
            ]));
        }
    }
    // Around a split the order of the files is not that of the triggers.
    let place = |frame: &Value| (frame[1].as_u64(), CAMERAS.iter().position(|camera| frame[0] == *camera));
    found["frames"].as_array_mut().expect("a list").sort_by_key(place);
    found["gaps"].as_array_mut().expect("a list").sort_by_key(place);
    assert_eq!(found["frames"], Value::Array(frames));
    assert_eq!(found["gaps"], Value::Array(gaps));
    assert_eq!(found["status"], "incomplete");

    let short = dir.path().join("walk-02/node-a");
    record(&short, header("a", &CAMERAS, Some(6)), 6, &[(1, 4)]);
    damage_is_refused(&short.join("segment-000.mcap"), &dir.path().join("scratch"));
}

/// A calibration of the place's rig whose lenses all distort.
fn distorted(place: &Place) -> Calibration {
    let rig = Rig::load(&place.path("rig.toml")).expect("a rig");
    let mut calibration = Calibration::nominal(&rig);
    let head = &mut calibration.heads[0];
    head.projector.lens.distortion = [-0.035, 0.02, 1e-4, -1e-4, 0.0];
    head.rows = Some(PanelRows::exact());
    for (camera, p1) in head.cameras.iter_mut().zip([2e-4, -3e-4]) {
        camera.device.lens.distortion = [-0.095, 0.07, p1, 8e-5, 0.0];
    }
    calibration
}

#[test]
fn points_of_phase_maps_follow_from_their_document() {
    let place = Place::new();
    let calibration = distorted(&place);
    calibration.save(&place.path("calibration.json")).expect("writable");
    let head = &calibration.heads[0];
    for camera in &head.cameras {
        let pair = CameraProjector::new(head, camera, &calibration).expect("a usable pair");
        let image = photograph(&pair, sphere(Point3::from(BALL.0), BALL.1));
        let file = place.path(&format!("images/{}/000000.png", camera.id));
        write_png_grey(&file, Mono8::from(&image)).expect("writable");
    }
    let out = place.path("out");
    let made = reconstruct(&place, &place.session("ball"), &out, &["--format", "phase,ply", "--uncertainty"]);
    assert_eq!(made.status.code(), Some(0), "{}", text_of(&made));

    let Some(found) = read_by_reference("result", &[&out]) else { return };
    println!("{found}");
    let cameras = found.as_object().expect("an object");
    assert_eq!(cameras.len(), head.cameras.len());
    for (camera, found) in cameras {
        let number = |key: &str| found[key].as_f64().expect("a number");
        assert!(
            number("points") > 20_000.0 && number("points") > 0.95 * number("pixels"),
            "{camera}: {found}"
        );
        // Clouds are made with a table, in single precision: by the formula it is off by less than its document states,
        // by the document's table as much as single precision rounds.
        assert!(number("mm") < 0.01 && number("table_mm") < 0.002, "{camera}: {found}");
        assert!(number("intensity") < 1e-6 && number("sigma") < 0.001, "{camera}: {found}");
        assert!(number("back_px") < 1e-6, "{camera}: {found}");
    }
    let scratch = place.path("scratch");
    damage_is_refused(&out.join("phases/h0_up_000000.phase"), &scratch);
    damage_is_refused(&out.join("calibration.json"), &scratch);
}

#[test]
fn pixels_and_lines_of_sight_follow_from_the_document_of_calibrations() {
    let place = Place::new();
    let calibration = distorted(&place);
    let file = place.path("calibration.json");
    calibration.save(&file).expect("writable");
    let Some(found) = read_by_reference("devices", &[&file]) else { return };
    assert_eq!(found.as_object().map(|found| found.len()), Some(calibration.cameras().count()));
    let list = |value: &Value| -> Vec<Vec<f64>> {
        serde_json::from_value(value.clone()).unwrap_or_else(|e| panic!("{value}: {e}"))
    };
    for (_, camera) in calibration.cameras() {
        let found = &found[camera.id.as_str()];
        let (points, pixels) = (list(&found["points"]), list(&found["pixels_of_points"]));
        assert_eq!(points.len(), pixels.len());
        for (point, pixel) in points.iter().zip(&pixels) {
            let expected =
                camera.device.project(&Point3::new(point[0], point[1], point[2])).expect("in front");
            let off = (pixel[0] - expected[0]).abs().max((pixel[1] - expected[1]).abs());
            assert!(off < 1e-8, "{}: {point:?} at {pixel:?}, expected {expected:?}", camera.id);
        }
        let (pixels, sights) = (list(&found["pixels"]), list(&found["sights_of_pixels"]));
        assert_eq!(pixels.len(), sights.len());
        for (pixel, sight) in pixels.iter().zip(&sights) {
            let expected = camera.device.lens.undistort(pixel[0], pixel[1]).expect("a line of sight");
            let off = (sight[0] - expected[0]).abs().max((sight[1] - expected[1]).abs());
            assert!(off < 1e-11, "{}: {pixel:?} sees {sight:?}, expected {expected:?}", camera.id);
        }
    }
}
