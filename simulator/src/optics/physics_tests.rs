// SPDX-License-Identifier: MIT OR Apache-2.0
//! The simulated light against geometry and radiometry computed another way.

use super::{Irradiance, Studio};
use crate::scenario::{Light, Scenario};
use crate::scene::mannequin::Mannequin;
use crate::scene::motion::Motion;
use crate::scene::{MeshSolid, Rectangle, Scene, Solid, Sphere};
use crate::true_rig::{smaller_jitter, smaller_rig, true_calibration};
use fourdbody::config::Rig;
use fourdbody::data::Calibration;
use nalgebra::{Isometry3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};
use std::path::Path;

const CLEAN: &str = "prnu = 0\nvignetting = 0\nblack_level = 0\nfloor_albedo = 0\ncurtain_albedo = 0\n\
                     camera_blur_px = 0\n";

fn studio(divisor: usize, optics: &str) -> (Rig, Calibration, Studio) {
    let config = Path::new(env!("CARGO_MANIFEST_DIR")).join("../config");
    let text = format!(
        "format = 1\nname = \"test\"\nseed = 3\nrig = \"rig.toml\"\ninstants = 1\nlight = [\"fringes\", \"white\"]\n\
         [subject]\nkind = \"sphere\"\ncentre_m = [0, 0, 1]\nradius_m = 0.15\n[optics]\n{optics}"
    );
    let scenario = Scenario::from_table(&text.parse().expect("TOML"), &config).expect("valid");
    let mut rig = Rig::load(&scenario.rig).expect("valid");
    // One head is enough here.
    rig.heads.truncate(1);
    let rig = smaller_rig(&rig, divisor);
    let truth = true_calibration(&rig, &smaller_jitter(&scenario.geometry, divisor), scenario.seed);
    let studio = Studio::new(&scenario, &truth);
    (rig, truth, studio)
}

fn light(studio: &Studio, light: Light, scene: &Scene) -> Irradiance {
    let mut memory = studio.memory(0);
    studio.add_moment(0, light, scene, 1.0, &mut memory);
    memory
}

/// A plate at `centre` whose face looks at `target`.
fn plate(centre: [f64; 3], target: &Point3<f64>, half_m: f64) -> Rectangle {
    let centre = Point3::from(centre);
    let rotation = Rotation3::face_towards(&(target - centre), &Vector3::z());
    let rotation = UnitQuaternion::from_rotation_matrix(&rotation);
    let pose = Isometry3::from_parts(Translation3::from(centre.coords), rotation);
    Rectangle { world_from_board: pose, half_m: [half_m; 2], back: 0.05, circles: None }
}

#[test]
fn truth_lies_on_the_surface_and_projects_to_its_phase() {
    let (rig, truth, studio) = studio(8, CLEAN);
    let body = Mannequin::new(Motion::ArmRaise, 0.2, [0.0; 2], 0.0);
    let scene = Scene::of(Solid::Mesh(MeshSolid::new(body.mesh(0.008, 0.0))));
    let seen = studio.truth(0, &scene, &rig.pattern);
    let (camera, projector) = (&truth.heads[0].cameras[0].device, &truth.heads[0].projector);
    let (mut lit, mut far) = (0, 0);
    for v in 0..camera.height {
        for u in 0..camera.width {
            let z = f64::from(seen.depth.at(u, v));
            if !z.is_finite() {
                continue;
            }
            let [x, y] = camera.lens.undistort(u as f64, v as f64).expect("in the image");
            let point = camera.world_from_device.isometry() * Point3::new(x * z, y * z, z);
            // Facets of 8 mm lie a little inside the exact skin, most on fingers, and outside in hollows.
            let inside = -body.field(&point);
            assert!((-6e-4..3e-3).contains(&inside), "({u}, {v}): {inside}");
            far += usize::from(inside > 5e-4);
            let phase = projector.project(&point).map(|[pu, _]| rig.pattern.phase(pu)).expect("in front");
            assert!((f64::from(seen.phase.at(u, v)) - phase).abs() < 1e-3, "({u}, {v})");
            lit += usize::from(seen.lit.at(u, v));
        }
    }
    assert!((3500..8000).contains(&lit), "{lit} lit pixels");
    assert!(far * 50 < lit, "{far} of {lit} pixels more than half a millimetre inside the skin");
}

#[test]
fn a_plate_in_white_light_is_lambertian_with_distance_squared() {
    let (_, truth, studio) = studio(8, CLEAN);
    let lamp = truth.heads[0].projector.centre();
    for (centre, aim) in [([0.5, 0.0, 1.0], [2.4, 0.0, 1.05]), ([-0.4, 0.1, 1.1], [2.4, 2.0, 1.3])] {
        let plate = plate(centre, &Point3::from(aim), 0.2);
        let normal = plate.world_from_board * Vector3::z();
        let centre = Point3::from(centre);
        let [u, v] = truth.heads[0].cameras[0].device.project(&centre).expect("in view");
        let memory = light(&studio, Light::White, &Scene::of(Solid::Rectangle(plate)));
        let found = f64::from(memory.light.at(u.round() as usize, v.round() as usize));
        let way = lamp - centre;
        let expected = 200.0 * (2.2 / way.norm()).powi(2) * way.normalize().dot(&normal);
        assert!((found / expected - 1.0).abs() < 0.01, "{found} expected {expected}");
    }
}

#[test]
fn bright_ridges_lie_where_the_geometry_says() {
    let (rig, truth, studio) = studio(4, CLEAN);
    let plate = plate([0.0, 0.0, 1.0], &truth.heads[0].projector.centre(), 0.5);
    let scene = Scene::of(Solid::Rectangle(plate));
    let memory = light(&studio, Light::Fringes, &scene);
    let seen = studio.truth(0, &scene, &rig.pattern);
    let (mut count, mut sum, mut most) = (0, 0.0, 0f64);
    for v in (100..200).step_by(7) {
        let row = memory.light.row(v);
        for u in 4..row.len() - 4 {
            let [a, b, c] = [row[u - 1], row[u], row[u + 1]].map(f64::from);
            let phase = |u: usize| f64::from(seen.phase.at(u, v));
            let order = (phase(u) / std::f64::consts::TAU).round();
            let marker = (order - f64::from(rig.pattern.marker_index)).abs() < 1.5;
            let ridge = b > 30.0 && b > a && b >= c;
            let interior = phase(u - 4).is_finite() && phase(u + 4).is_finite();
            if marker || !ridge || !interior {
                continue;
            }
            let peak = 0.5 * (a - c) / (a - 2.0 * b + c);
            let slope = (phase(u + 1) - phase(u - 1)) / 2.0;
            let off = phase(u) + slope * peak - order * std::f64::consts::TAU;
            (count, sum, most) = (count + 1, sum + off, most.max(off.abs()));
        }
    }
    assert!(count > 200, "{count} ridges");
    // A parabola through three samples of a cosine of 10 px is not exact, but it is not biased.
    assert!(
        (sum / f64::from(count)).abs() < 0.01 && most < 0.15,
        "mean {} most {most}",
        sum / f64::from(count)
    );
}

#[test]
fn a_ball_before_a_plate_casts_its_shadow() {
    let (rig, truth, studio) = studio(4, CLEAN);
    let lamp = truth.heads[0].projector.centre();
    let plate = plate([-0.2, 0.0, 1.0], &lamp, 0.6);
    let ball = Sphere { centre: Point3::new(0.3, 0.05, 1.05), radius: 0.12 };
    let scene = Scene { solids: vec![Solid::Rectangle(plate.clone()), Solid::Sphere(ball)] };
    let memory = light(&studio, Light::White, &scene);
    let seen = studio.truth(0, &scene, &rig.pattern);
    let camera = &truth.heads[0].cameras[0].device;
    let (mut dark, mut bright) = (0, 0);
    for v in 0..camera.height {
        for u in 0..camera.width {
            let z = f64::from(seen.depth.at(u, v));
            if !z.is_finite() {
                continue;
            }
            let [x, y] = camera.lens.undistort(u as f64, v as f64).expect("in the image");
            let point = camera.world_from_device.isometry() * Point3::new(x * z, y * z, z);
            let on_plate = plate.world_from_board.inverse_transform_point(&point).z.abs() < 1e-4;
            // How far the ball's centre is from the way of the light.
            let way = (point - lamp).normalize();
            let passing = (ball.centre - lamp - way * (ball.centre - lamp).dot(&way)).norm();
            if !on_plate || (passing - ball.radius).abs() < 0.01 {
                continue;
            }
            let behind = passing < ball.radius;
            assert_eq!(seen.lit.at(u, v), !behind, "({u}, {v})");
            let edge = (-1i32..=1).any(|d| {
                let beside = (v as i32 + d).clamp(0, camera.height as i32 - 1) as usize;
                (f64::from(seen.depth.at(u, beside)) - z).abs() > 0.01
                    || (f64::from(
                        seen.depth.at((u as i32 + d).clamp(0, camera.width as i32 - 1) as usize, v),
                    ) - z)
                        .abs()
                        > 0.01
            });
            let value = memory.light.at(u, v);
            assert!(edge || (value < 1e-6) == behind, "({u}, {v}): {value}");
            if behind { dark += 1 } else { bright += 1 }
        }
    }
    assert!(dark > 500 && bright > 5000, "{dark} {bright}");
}

#[test]
fn bytes_do_not_depend_on_the_number_of_threads() {
    let photograph = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        pool.install(|| {
            let (_, _, studio) = studio(8, "");
            let body = Mannequin::new(Motion::ArmsCrossed, 0.1, [0.0; 2], 0.0).mesh(0.012, 0.04);
            let scene = Scene::of(Solid::Mesh(MeshSolid::new(body)));
            let mut memory = studio.memory(1);
            let mut pixels = vec![0; 240 * 150];
            studio.photograph(1, Light::Fringes, &[scene], 5, &mut memory, &mut pixels);
            pixels
        })
    };
    let one = photograph(1);
    assert!(one == photograph(3));
    assert!(one.iter().filter(|&&value| value > 50).count() > 1000, "there is a picture");
}

#[test]
fn noise_has_the_variance_of_photons_and_readout() {
    let (_, _, studio) = studio(4, "prnu = 0\nelectrons_per_dn = 20\nread_noise_dn = 0.8\n");
    let wall = plate([0.2, 0.0, 1.0], &Point3::new(2.4, 0.0, 1.4), 0.5);
    let scene = [Scene::of(Solid::Rectangle(wall))];
    let mut memory = studio.memory(0);
    let mut shot = |instant| {
        let mut pixels = vec![0u8; 480 * 300];
        studio.photograph(0, Light::White, &scene, instant, &mut memory, &mut pixels);
        pixels
    };
    let (a, b) = (shot(0), shot(1));
    let pairs: Vec<(f64, f64)> =
        a.iter().zip(&b).map(|(&a, &b)| (f64::from(a), f64::from(b))).filter(|(a, _)| *a > 100.0).collect();
    let n = pairs.len() as f64;
    let mean = pairs.iter().map(|(a, b)| (a + b) / 2.0).sum::<f64>() / n;
    let variance = pairs.iter().map(|(a, b)| (a - b).powi(2)).sum::<f64>() / (2.0 * n);
    let expected = (mean - 1.5) / 20.0 + 0.8 * 0.8 + 1.0 / 12.0;
    assert!(
        n > 10_000.0 && (variance / expected - 1.0).abs() < 0.05,
        "{variance} expected {expected}, n {n}"
    );
}

#[test]
fn circles_of_a_frontal_board_have_unbiased_centres() {
    let (rig, truth, studio) = studio(1, &format!("{CLEAN}edge_samples = 8\n"));
    let camera = &truth.heads[0].cameras[0].device;
    // Face on to the camera, so that perspective does not move the centres of the ellipses.
    let axis = camera.world_from_device.isometry().rotation * Vector3::z();
    let centre = camera.centre() + axis * 2.4;
    let blank = plate(centre.coords.into(), &camera.centre(), 0.3);
    let board = Rectangle { circles: Some((rig.board.clone(), 0.05)), ..blank.clone() };
    let with = light(&studio, Light::White, &Scene::of(Solid::Rectangle(board.clone())));
    let without = light(&studio, Light::White, &Scene::of(Solid::Rectangle(blank)));
    let mut offsets = Vec::new();
    for (row, column) in (7..12).flat_map(|row| (5..9).map(move |column| (row, column))) {
        let place =
            |index: usize, count: usize| (index as f64 - (count as f64 - 1.0) / 2.0) * rig.board.pitch_m;
        let (x, y) = (place(column, rig.board.columns), place(row, rig.board.rows));
        let Some([u, v]) = camera.project(&(board.world_from_board * Point3::new(x, y, 0.0))) else {
            continue;
        };
        let (mut sum, mut su, mut sv) = (0.0, 0.0, 0.0);
        for j in v as usize - 28..v as usize + 29 {
            for i in u as usize - 28..u as usize + 29 {
                let black = 1.0 - f64::from(with.light.at(i, j)) / f64::from(without.light.at(i, j));
                (sum, su, sv) = (sum + black, su + black * i as f64, sv + black * j as f64);
            }
        }
        assert!(sum > 300.0, "a circle at ({u}, {v})");
        offsets.push([su / sum - u, sv / sum - v]);
    }
    let n = offsets.len() as f64;
    let mean = [0, 1].map(|k| offsets.iter().map(|o| o[k]).sum::<f64>() / n);
    let most = offsets.iter().map(|o| o[0].hypot(o[1])).fold(0.0, f64::max);
    assert!(n > 10.0 && mean[0].hypot(mean[1]) < 0.01 && most < 0.02, "{n}: mean {mean:?}, most {most}");
}
