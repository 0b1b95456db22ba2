//! The pipeline on the shared rendered scene, scored against its ground truth. Skipped, with a printed
//! reason, where the data are not at hand.

use fourdbody::calibrate::{CalibratedCamera, CalibratedHead, Calibration};
use fourdbody::config::{Channel, Rig};
use fourdbody::geometry::{Device, Lens, Pose};
use fourdbody::ids::{CameraId, HeadId};
use fourdbody::image::{Mono8, read_png_grey};
use fourdbody::pattern::{Marker, Pattern};
use fourdbody::reconstruct::pair::Pair;
use fourdbody::reconstruct::pipeline::{Method, Outcome, Pipeline, Reconstruction};
use fourdbody::reconstruct::triangulate::Triangulator;
use fourdbody::validate::truth::{Reference, Score, Tally, Truth};
use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
use serde_json::Value;
use std::path::{Path, PathBuf};

/// The shared scene's directory, or `None` with the reason printed.
pub fn scene() -> Option<PathBuf> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let places = ["../shared/data/scene", "../../shared/data/scene"];
    let found = places.iter().map(|place| root.join(place)).find(|path| path.join("rig.json").exists());
    if found.is_none() {
        println!("skipped: the shared scene is not beside the project ({places:?})");
    }
    found
}

fn number(value: &Value) -> f64 {
    value.as_f64().expect("a number")
}

fn device(value: &Value) -> Device {
    let get = |key: &str| number(&value[key]);
    let rotation = Matrix3::from_fn(|r, c| number(&value["R"][r][c]));
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
    let translation = Translation3::from(Vector3::from_fn(|i, _| number(&value["t"][i])));
    Device {
        width: get("width") as usize,
        height: get("height") as usize,
        lens: Lens {
            fx: get("fx"),
            fy: get("fy"),
            cx: get("cx"),
            cy: get("cy"),
            distortion: std::array::from_fn(|i| number(&value["dist"][i])),
        },
        world_from_device: Pose::new(Isometry3::from_parts(translation, rotation).inverse()),
    }
}

/// The scene's rig as a calibration.
pub fn calibration(scene: &Path) -> Calibration {
    let text = std::fs::read_to_string(scene.join("rig.json")).expect("rig.json");
    let rig: Value = serde_json::from_str(&text).expect("JSON");
    let heads = rig["heads"].as_array().expect("heads").iter().map(|head| CalibratedHead {
        id: HeadId(format!("h{}", head["id"])),
        channel: match head["channel"].as_str() {
            Some("R") => Channel::R,
            Some("G") => Channel::G,
            _ => Channel::B,
        },
        projector: device(&head["projector"]),
        cameras: head["cameras"]
            .as_array()
            .expect("cameras")
            .iter()
            .map(|camera| CalibratedCamera {
                id: CameraId::from(camera["name"].as_str().expect("a name")),
                device: device(camera),
            })
            .collect(),
    });
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/rig.toml");
    let mut shipped = Rig::load(&shipped).expect("the shipped rig");
    let pattern = &rig["pattern"];
    shipped.pattern = Pattern {
        period_px: number(&pattern["period_px"]),
        marker_index: number(&pattern["marker_index"]) as u32,
        marker: Marker::Darkened { depth: number(&pattern["marker_depth"]) },
        marker_period_px: number(&pattern["marker_period_px"]),
        low: number(&pattern["low"]),
        high: number(&pattern["high"]),
        gamma: number(&pattern["gamma"]),
    };
    Calibration::new(&shipped, "rig.json of the shared scene".to_owned(), heads.collect())
}

fn reconstruct(scene: &Path, set: &str, camera: &str, method: Method) -> Reconstruction {
    let calibration = calibration(scene);
    let (head, calibrated) = calibration.camera(&CameraId::from(camera)).expect("in the rig");
    let pair = Pair::new(head, calibrated, &calibration).expect("a usable pair");
    let image = read_png_grey(&scene.join(set).join(camera).join("000000.png")).expect("an image");
    let keep = std::env::var_os("DUMP_MAPS");
    let found = Pipeline::new(Triangulator::new(pair), method, keep.is_some()).run(Mono8::from(&image));
    if let (Some(dir), Some(maps)) = (keep, &found.maps) {
        fourdbody::reconstruct::dump::write(&Path::new(&dir).join(set), camera, maps).expect("writable");
    }
    found
}

fn score(scene: &Path, camera: &str, method: Method) -> (Reconstruction, Score) {
    let calibration = calibration(scene);
    let (head, calibrated) = calibration.camera(&CameraId::from(camera)).expect("in the rig");
    let found = reconstruct(scene, "body_arms_raised", camera, method);
    let path = scene.join(format!("body_arms_raised/truth/{camera}_000000.npz"));
    let truth = Truth::load(&path, &calibrated.device).expect("truth");
    let reference =
        Reference { camera: &calibrated.device, projector: &head.projector, pattern: &calibration.pattern };
    let mut tally = Tally::default();
    tally.add(&found.cloud, |_| true, &truth, reference);
    let score = tally.score();
    (found, score)
}

/// Writes the scene's rig as a calibration file, for the command line: `CALIBRATION_OUT=FILE`.
#[test]
#[ignore = "a converter, for development"]
fn write_calibration() {
    let Some(scene) = scene() else { return };
    let out = std::env::var_os("CALIBRATION_OUT").expect("CALIBRATION_OUT=FILE");
    calibration(&scene).save(Path::new(&out)).expect("writable");
}

#[test]
#[ignore = "all eight cameras: for development"]
fn all_cameras_scored() {
    let Some(scene) = scene() else { return };
    for camera in ["h0_low", "h0_up", "h1_low", "h1_up", "h2_low", "h2_up", "h3_low", "h3_up"] {
        let (found, score) = score(&scene, camera, Method::Anchored);
        println!(
            "{camera}: {} points rms {:.3} right {:.3} p95 {:.3} robust {:.3} wrong {:.3}% (off {:.3}%) complete {:.2}% | {:?}",
            score.points,
            score.rms_mm,
            score.rms_right_order_mm,
            score.p95_mm,
            score.robust_mm,
            100.0 * score.wrong_order_share,
            100.0 * score.off_surface_share,
            100.0 * score.completeness_of_lit,
            found.counts,
        );
        let stages: Vec<_> =
            found.stages.iter().map(|(s, t)| format!("{s} {:.1}", t.as_secs_f64() * 1e3)).collect();
        println!("    {}", stages.join(" "));
    }
    for camera in ["h0_low", "h0_up", "h1_low", "h1_up", "h2_low", "h2_up", "h3_low", "h3_up"] {
        let found = reconstruct(&scene, "sphere", camera, Method::Anchored);
        println!("sphere {camera}: {:?} {} {:?}", found.outcome, found.cloud.len(), found.counts);
    }
    let _ = Outcome::Cloud;
}
