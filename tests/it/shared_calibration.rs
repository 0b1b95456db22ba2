//! The calibration on the shared photographs of a board, scored against their truth. Skipped, with a printed
//! reason, where the data are not at hand.

use crate::shared_scene::{device_of, scene};
use fourdbody::calibrate::{Board, Ellipse, find_spots, identify, image_of_circle};
use fourdbody::geometry::{Device, Lens};
use fourdbody::image::{Mono8, read_png_grey};
use nalgebra::{Matrix3, Vector3};
use serde_json::Value;
use std::path::Path;

/// The shared board as a board file.
fn board() -> Board {
    Board::load(&Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/it/data/shared-board.toml"))
        .expect("a good file")
}

fn json(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).expect("readable")).expect("JSON")
}

fn vector(value: &Value) -> Vector3<f64> {
    Vector3::from_fn(|i, _| value[i].as_f64().expect("a number"))
}

/// Where the outline's centre of a circle must be seen: points of the circle's image, distorted, and the ellipse
/// through them.
fn expected_centre(device: &Device, columns: &Matrix3<f64>, radius: f64) -> [f64; 2] {
    let ideal = image_of_circle(columns, radius).expect("an ellipse");
    let lens: &Lens = &device.lens;
    let points: Vec<[f64; 2]> = (0..32)
        .map(|i| ideal.at(f64::from(i) * std::f64::consts::TAU / 32.0))
        .map(|[x, y]| lens.distort(x, y).expect("inside"))
        .collect();
    Ellipse::fit(&points).expect("an ellipse").centre
}

#[test]
fn circle_centres_agree_with_the_truth_of_the_shared_images() {
    let Some(scene) = scene() else { return };
    let board = board();
    let poses = json(&scene.join("calibration/poses.json"));
    let mut errors = Vec::new();
    for pose in poses["poses"].as_array().expect("poses") {
        if pose["light"] != "white" {
            continue;
        }
        for (camera, truth) in pose["cameras"].as_object().expect("cameras") {
            let device = device_of(&scene, camera);
            let path = scene
                .join(format!("calibration/{camera}/{:06}.png", pose["trigger"].as_u64().expect("a number")));
            let image = read_png_grey(&path).expect("a PNG");
            let spots = find_spots(Mono8::from(&image));
            let found = match identify(&spots, &board) {
                Ok(found) => found,
                Err(error) => panic!("{camera} {}: {} spots, {error}", pose["position"], spots.len()),
            };
            // x_world = R^T x_board + t.
            let rotation =
                Matrix3::from_fn(|r, c| truth["board_R"][r][c].as_f64().expect("a number")).transpose();
            let place = vector(&truth["board_t"]);
            let world_from_device = device.world_from_device.isometry();
            let into = |v: Vector3<f64>| world_from_device.rotation.inverse() * v;
            let mut worst: f64 = 0.0;
            for sighting in &found {
                let circle = board.circles()[sighting.circle];
                let centre = rotation * Vector3::from(circle.centre_m) + place;
                let local = world_from_device.inverse_transform_point(&centre.into()).coords;
                let columns = Matrix3::from_columns(&[
                    into(rotation * Vector3::x()),
                    into(rotation * Vector3::y()),
                    local,
                ]);
                let expected = expected_centre(&device, &columns, circle.radius_m);
                let [u, v] = sighting.spot.ellipse.centre;
                let error = ((u - expected[0]).powi(2) + (v - expected[1]).powi(2)).sqrt();
                worst = worst.max(error);
                errors.push(error);
            }
            println!(
                "{camera} {}: {} of {} spots named, worst {worst:.3} px",
                pose["position"],
                found.len(),
                spots.len()
            );
        }
    }
    let rms = (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64 / 2.0).sqrt();
    errors.sort_by(f64::total_cmp);
    println!(
        "{} circles, rms {rms:.4} px per axis, p99 {:.4}, worst {:.3}",
        errors.len(),
        errors[errors.len() * 99 / 100],
        errors[errors.len() - 1]
    );
    assert!(rms < 0.05, "{rms} px");
}
