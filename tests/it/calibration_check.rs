// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody calibration check`, and the worker's, on photographs that are not ours: a rig that stands, and one whose devices have turned.

use crate::lab::{fourdbody, text_of};
use crate::shared_scene::{calibration, scene};
use fourdbody::calibrate::drift::history::{self, Verdict};
use fourdbody::data::Calibration;
use fourdbody::geometry::Pose;
use nalgebra::{UnitQuaternion, Vector3};
use std::path::Path;
use std::process::Command;

/// Exit code, and what is printed of the drift.
fn check(images: &Path, calibration: &Path, corrected: &Path) -> (Option<i32>, serde_json::Value) {
    let ran = Command::new(env!("CARGO_BIN_EXE_fourdbody"))
        .args(["calibration", "check", "--json"])
        .arg(images)
        .arg("--calibration")
        .arg(calibration)
        .arg("--corrected")
        .arg(corrected)
        .arg("--history")
        .arg(calibration.with_file_name("history"))
        .output()
        .expect("the program runs");
    (ran.status.code(), serde_json::from_slice(&ran.stdout).unwrap_or_default())
}

/// Every camera turned by a hundredth of a degree, upper and lower ones against each other.
fn turned(truth: &Calibration) -> Calibration {
    let mut turned = truth.clone();
    for (i, camera) in turned.heads.iter_mut().flat_map(|head| &mut head.cameras).enumerate() {
        let mut pose = *camera.device.world_from_device.isometry();
        let by = f64::to_radians(if i % 2 == 0 { 0.01 } else { -0.01 });
        pose.rotation *= UnitQuaternion::from_scaled_axis(Vector3::y() * by);
        camera.device.world_from_device = Pose::new(pose);
    }
    turned
}

#[test]
fn devices_that_have_turned_are_told_and_their_turns_taken_off() {
    let Some(scene) = scene() else { return };
    let dir = tempfile::tempdir().expect("a temporary directory");
    let [stated, corrected, unused] = ["stated", "corrected", "unused"].map(|name| dir.path().join(name));
    let images = scene.join("throw");
    let truth = calibration(&scene);
    truth.save(&stated).expect("written");
    let (code, found) = check(&images, &stated, &unused);
    assert_eq!((code, &found["stands"]), (Some(0), &true.into()), "{found}");

    let turned = turned(&truth);
    turned.save(&stated).expect("written");
    let (code, found) = check(&images, &stated, &corrected);
    assert_eq!((code, &found["stands"]), (Some(4), &false.into()), "{found}");
    let differ = |i: usize| found["drift"]["differ_rad"][i].as_f64().expect("a number");
    assert!(differ(0) > 4.0 * differ(1), "{found}");
    let devices = found["drift"]["devices"].as_array().expect("a list");
    for (i, device) in devices.iter().take(turned.cameras().count()).enumerate() {
        // What is found takes the turn back.
        let expected = if i % 2 == 0 { -0.01 } else { 0.01 };
        let about_y = device["turn_deg"][1].as_f64().expect("a number");
        assert!((about_y - expected).abs() < 0.003, "{device}");
    }
    assert!(Calibration::load(&corrected).is_ok_and(|x| x.origin.ends_with("throw")));
    let (code, found) = check(&images, &corrected, &unused);
    assert_eq!((code, &found["stands"]), (Some(0), &true.into()), "{found}");
    // All three looks are in the history, by calibration, and each device is in the plot.
    let told = dir.path().join("history");
    let mut verdicts: Vec<(Verdict, usize)> =
        history::load(&told).iter().map(|one| (one.verdict, one.devices.len())).collect();
    verdicts.sort_by_key(|(verdict, _)| *verdict as u8);
    assert_eq!(
        verdicts,
        [(Verdict::Stands, 12), (Verdict::Stands, 12), (Verdict::CalibrateAgain, 12)],
        "{:?}",
        history::load(&told)
    );
    let plot = std::fs::read_to_string(told.join(history::PLOT)).expect("drawn");
    assert!(plot.contains("camera h3_low: ") && plot.contains("projector h3: "), "{plot}");
}

/// A session of the scene with the true calibration, then one after all cameras have turned. Ten seconds.
#[test]
fn the_worker_keeps_what_it_finds_of_every_session() {
    let Some(scene) = scene() else { return };
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = |name: &str| dir.path().join(name);
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/rig.toml");
    let rig = std::fs::read_to_string(shipped).expect("config/rig.toml");
    let rig = rig
        .replace("\"zero_mean\"  ", "\"darkened\"  ")
        .replace("marker_strength = 0.3", "marker_strength = 0.8");
    std::fs::write(path("rig.toml"), rig).expect("writable");
    let node = |name: &str| format!("[[node]]\nname = \"{name}\"\nsessions_dir = \"sessions\"\n");
    let worker = "format = 1\nresults = \"results\"\ncalibration = \"calibration.json\"\n".to_owned();
    let worker = worker + &node("a") + &node("b") + "[work]\nreserve_mib = 1\n";
    std::fs::write(path("worker.toml"), worker).expect("writable");
    let truth = calibration(&scene);
    for (session, calibration) in [("before", truth.clone()), ("after", turned(&truth))] {
        calibration.save(&path("calibration.json")).expect("writable");
        let [rig, images, out, config] =
            [path("rig.toml"), scene.join("throw"), path("sessions").join(session), path("worker.toml")]
                .map(|path| path.display().to_string());
        std::fs::create_dir_all(path("sessions")).expect("writable");
        let imported = fourdbody(&["import", "--rig", &rig, "--images", &images, "--out", &out]);
        assert_eq!(imported.status.code(), Some(0), "{}", text_of(&imported));
        let worked = fourdbody(&["worker", "--config", &config, "--once"]);
        println!("{session}: {}", text_of(&worked));
    }
    let said = history::load(&path("results/.worker"));
    let verdicts: Vec<(&str, Verdict)> = said.iter().map(|one| (one.session.as_str(), one.verdict)).collect();
    assert_eq!(verdicts, [("before", Verdict::Stands), ("after", Verdict::CalibrateAgain)], "{said:#?}");
    assert!(said[1].said.starts_with("calibrate again: camera h"), "{}", said[1].said);
    assert!(said[0].recorded_ns < said[1].recorded_ns);
    assert_ne!(said[0].calibration_sha256, said[1].calibration_sha256);
}
