// SPDX-License-Identifier: MIT OR Apache-2.0
//! The calibration on the shared photographs of a board, scored against their truth. Skipped, with a printed
//! reason, where the data are not at hand.

use crate::shared_scene::{calibration, device_of, scene};
use fourdbody::base::image::{Mono8, read_png_grey};
use fourdbody::batch::png_source::PngSource;
use fourdbody::calibrate::{Board, Ellipse, find_spots, identify, image_of_circle, run, views};
use fourdbody::data::Calibration;
use fourdbody::geometry::{Device, Lens};
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
                Err(error) => panic!("{camera} {}: {} spots, {error:?}", pose["position"], spots.len()),
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
    assert!(rms < 0.02, "{rms} px");
}

/// The shared rig as a laboratory knows it before it calibrates: right to a per cent and a centimetre, without
/// distortion.
fn nominal(scene: &Path) -> Calibration {
    let mut nominal = calibration(scene);
    nominal.heads.truncate(2);
    let mut sign = 1.0;
    for head in &mut nominal.heads {
        let devices = head.cameras.iter_mut().map(|c| &mut c.device).chain([&mut head.projector]);
        for device in devices {
            sign = -sign;
            device.lens.fx = (device.lens.fx * (1.0 + 0.01 * sign)).round();
            device.lens.fy = device.lens.fx;
            device.lens.cx = (device.width as f64 - 1.0) / 2.0;
            device.lens.cy = (device.height as f64 - 1.0) / 2.0;
            device.lens.distortion = [0.0; 5];
            let pose = device.world_from_device.isometry();
            let turn = nalgebra::UnitQuaternion::from_scaled_axis(Vector3::new(0.01, -0.008, 0.006) * sign);
            let shift = Vector3::new(0.01, -0.01, 0.008) * sign;
            let moved = nalgebra::Isometry3::from_parts(
                (pose.translation.vector + shift).into(),
                turn * pose.rotation,
            );
            device.world_from_device = fourdbody::geometry::Pose::new(moved);
        }
    }
    nominal
}

#[test]
fn two_heads_are_calibrated_from_the_shared_photographs() {
    let Some(scene) = scene() else { return };
    let (board, nominal, truth) = (board(), nominal(&scene), calibration(&scene));
    let ids: Vec<_> = nominal.cameras().map(|(_, camera)| camera.id.clone()).collect();
    let source = PngSource::open(&scene.join("calibration"), &ids).expect("images");
    let (positions, findings) = views::look(&source, &nominal, &board).expect("usable");
    assert!(findings.is_empty(), "{findings:?}");
    assert_eq!(positions.len(), 9);
    let views = positions.iter().flat_map(|p| &p.views).flatten();
    let phases = views.filter_map(|view| view.phase.as_ref());
    assert_eq!(
        phases.filter(|phase| phase.marker).count(),
        36,
        "each view has a phase, and shows its marker"
    );
    let outcome = run::solve(positions, findings, &nominal, &board, &run::Options::default());
    let outcome = outcome.unwrap_or_else(|e| panic!("{e}"));
    assert!(outcome.findings.is_empty(), "{:?}", outcome.findings);
    let heads = &outcome.heads;
    for head in heads {
        println!(
            "head {}: chi {:.3}, {} circles, {} phases",
            head.head,
            head.all.chi,
            head.circles,
            head.observations.len() - head.circles
        );
    }
    let together = &outcome.together;
    println!("chi {:.3}, {:?}, {:?}", together.all.chi, together.links, together.world);
    let found = &outcome.calibration;
    for head in &found.heads {
        let rows = head.rows.expect("the marker's dashes tell the panel's rows");
        println!("{}: {rows:?}", head.id);
        assert!(rows.rms_px < 0.1, "{rows:?}");
    }
    let mut devices = together.all.device_sigma.iter();
    for (head, truth) in found.heads.iter().zip(&truth.heads) {
        for (camera, truth) in head.cameras.iter().zip(&truth.cameras) {
            let sigma = devices.next().expect("one each");
            let (lens, true_lens) = (&camera.device.lens, &truth.device.lens);
            println!(
                "{}: fx off {:.3} px (stated {:.3}), cx off {:.3} ({:.3}), k1 off {:.5} ({:.5})",
                camera.id,
                lens.fx - true_lens.fx,
                sigma[0],
                lens.cx - true_lens.cx,
                sigma[2],
                lens.distortion[0] - true_lens.distortion[0],
                sigma[4]
            );
            assert!((lens.fx - true_lens.fx).abs() < 0.06, "{lens:?} {true_lens:?}");
        }
        println!(
            "projector fx off {:.3} cx off {:.3}",
            head.projector.lens.fx - truth.projector.lens.fx,
            head.projector.lens.cx - truth.projector.lens.cx
        );
        devices.next();
    }
    // The world is where the cameras fit the wrong rig best: compare poses relative to the first camera.
    let relative = |c: &Calibration, head: usize, camera: usize| {
        let first = c.heads[0].cameras[0].device.world_from_device.isometry().inverse();
        first * c.heads[head].cameras[camera].device.world_from_device.isometry()
    };
    for (head, camera) in [(0, 1), (1, 0), (1, 1)] {
        let off = relative(&truth, head, camera).inverse() * relative(found, head, camera);
        println!(
            "head {head} camera {camera}: {:.4} mm, {:.6} deg",
            off.translation.vector.norm() * 1e3,
            off.rotation.angle().to_degrees()
        );
        assert!(off.translation.vector.norm() < 7e-5, "{off}");
    }
}
