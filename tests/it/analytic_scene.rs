// SPDX-License-Identifier: MIT OR Apache-2.0
//! The pipeline on a sphere and a wall that are rendered here by direct formula, through the shipped rig.

use crate::frame_set::{self, Photograph};
use fourdbody::base::image::{Mono8, Plane};
use fourdbody::config::Rig;
use fourdbody::data::{Calibration, PanelRows};
use fourdbody::geometry::Ray;
use fourdbody::geometry::pattern::{Marker, Pattern};
use fourdbody::reconstruct::outcome::{Outcome, Reconstruction};
use fourdbody::reconstruct::pipeline::{Method, Pipeline};
use fourdbody::reconstruct::triangulate::camera_projector::CameraProjector;
use fourdbody::reconstruct::triangulate::triangulator::Triangulator;
use nalgebra::{Point3, Vector3};
use std::path::Path;

/// First hit of a ray: the point and its outward normal.
pub type Hit = Option<(Point3<f64>, Vector3<f64>)>;

fn pair(marker: Option<Marker>) -> CameraProjector {
    pair_of(0, 0, marker)
}

/// A camera of the shipped rig, distortion added to the projectors.
pub fn pair_of(head: usize, camera: usize, marker: Option<Marker>) -> CameraProjector {
    pair_with((head, camera), |pattern| pattern.marker = marker.unwrap_or(pattern.marker))
}

fn pair_with((head, camera): (usize, usize), change: impl FnOnce(&mut Pattern)) -> CameraProjector {
    pair_of_rig((head, camera), |rig| change(&mut rig.pattern))
}

fn pair_of_rig((head, camera): (usize, usize), change: impl FnOnce(&mut Rig)) -> CameraProjector {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/rig.toml");
    let mut rig = Rig::load(&path).expect("the shipped rig");
    change(&mut rig);
    let mut calibration = Calibration::nominal(&rig);
    calibration.heads[head].projector.lens.distortion = [-0.035, 0.02, 0.0, 0.0, 0.0];
    calibration.heads[head].rows = Some(PanelRows::exact());
    let head = &calibration.heads[head];
    CameraProjector::new(head, &head.cameras[camera], &calibration).expect("a usable pair")
}

/// Photographs a convex surface; every second of the projector's pixels is not modelled, its light is a
/// continuous function of place.
pub fn photograph(pair: &CameraProjector, surface: impl Fn(&Ray) -> Hit) -> Plane<u8> {
    photograph_painted(pair, surface, |_| 1.0, &[0.0])
}

/// The same of a surface whose reflectance depends on the place; the light of a pixel is the mean at `offsets`
/// from its centre, both ways.
fn photograph_painted(
    pair: &CameraProjector,
    surface: impl Fn(&Ray) -> Hit,
    paint: impl Fn(&Point3<f64>) -> f64,
    offsets: &[f64],
) -> Plane<u8> {
    let mut image = Plane::filled(pair.camera.width, pair.camera.height, 2u8);
    let centre = pair.projector.centre();
    let light = |u: f64, v: f64| {
        let (point, normal) = surface(&pair.camera.ray(u, v)?)?;
        let light = (centre - point).normalize().dot(&normal);
        let panel = pair.projector.project(&point).filter(|p| pair.projector.contains(*p))?;
        (light > 0.0).then(|| light * paint(&point) * pair.pattern.light(panel[0], panel[1]))
    };
    let samples: Vec<(f64, f64)> =
        offsets.iter().flat_map(|y| offsets.iter().map(move |x| (*x, *y))).collect();
    for v in 250..950 {
        for u in 300..1700 {
            let sum: f64 = samples.iter().filter_map(|(x, y)| light(u as f64 + x, v as f64 + y)).sum();
            image.set(u, v, (2.0 + 180.0 * sum / samples.len() as f64).round() as u8);
        }
    }
    image
}

/// Where a ray meets a ball; the ball's centre and radius in metres.
pub fn sphere(centre: Point3<f64>, radius: f64) -> impl Fn(&Ray) -> Hit {
    move |ray| {
        let along = (centre - ray.origin).dot(&ray.direction);
        let nearest = (ray.at(along) - centre).norm_squared();
        let half = (radius * radius - nearest).max(0.0).sqrt();
        (half > 0.0).then(|| {
            let point = ray.at(along - half);
            (point, (point - centre) / radius)
        })
    }
}

fn reconstruct(pair: CameraProjector, image: &Plane<u8>) -> Reconstruction {
    Pipeline::new(Triangulator::new(pair), Method::Joint, false).run(Mono8::from(image))
}

#[test]
fn a_sphere_with_the_marker_on_it_is_measured() {
    for marker in [Marker::ZeroMean { amplitude: 0.3 }, Marker::Darkened { depth: 0.8 }] {
        let pair = pair(Some(marker));
        let centre = Point3::new(0.05, -0.02, 1.03);
        let image = photograph(&pair, sphere(centre, 0.20));
        let camera = pair.camera.centre();
        let found = reconstruct(pair, &image);
        assert_eq!(found.outcome, Outcome::Cloud, "{marker:?}");
        assert!(found.cloud.len() > 50_000, "{} points", found.cloud.len());
        let mut errors = Vec::new();
        for (p, n) in found.cloud.position_m.iter().zip(&found.cloud.normal) {
            let (p, n) = (Point3::from(*p).cast::<f64>(), Vector3::from(*n).cast::<f64>());
            errors.push(((p - centre).norm() - 0.20).abs());
            assert!((n.norm() - 1.0).abs() < 1e-5 && n.dot(&(camera - p)) > 0.0);
        }
        errors.sort_by(f64::total_cmp);
        let quantile = |q: f64| errors[(q * (errors.len() - 1) as f64) as usize];
        assert!(quantile(0.5) < 0.00015 && quantile(0.95) < 0.0006, "{} {}", quantile(0.5), quantile(0.95));
        // A wrong order would be 40 mm off.
        assert!(quantile(1.0) < 0.010, "{}", quantile(1.0));
    }
}

#[test]
fn normals_of_a_wall_are_those_of_the_wall() {
    let pair = pair(None);
    let normal = Vector3::new(0.9, 0.2, 0.1).normalize();
    let image = photograph(&pair, |ray: &Ray| {
        let distance = (Point3::new(0.0, 0.0, 1.0) - ray.origin).dot(&normal) / ray.direction.dot(&normal);
        let point = ray.at(distance);
        (distance > 0.0 && (point.z - 1.0).abs() < 0.3 && point.y.abs() < 0.3).then_some((point, normal))
    });
    let found = reconstruct(pair, &image);
    let cosines: Vec<f32> =
        found.cloud.normal.iter().map(|n| normal.cast::<f32>().dot(&Vector3::from(*n))).collect();
    assert!(cosines.len() > 100_000, "{} points", cosines.len());
    let good = cosines.iter().filter(|&&c| c > 0.995).count();
    assert!(good * 100 > cosines.len() * 97, "{good} of {}", cosines.len());
}

/// A board of black discs, as the calibration uses it: the discs' edges must not bend the plane. Without
/// the corrections of `reconstruct/refine` (`albedo_edges.rs`) the RMS here is seven times as much.
#[test]
fn a_board_with_black_discs_is_flat_up_to_their_edges() {
    let pair = pair(None);
    let normal = Vector3::new(0.85, 0.4, 0.15).normalize();
    let origin = Point3::new(0.0, 0.0, 1.0);
    let (across, up) = (normal.cross(&Vector3::z()).normalize(), normal.cross(&Vector3::z()).cross(&normal));
    let place = |point: &Point3<f64>| ((point - origin).dot(&across), (point - origin).dot(&up.normalize()));
    let wall = |ray: &Ray| {
        let distance = (origin - ray.origin).dot(&normal) / ray.direction.dot(&normal);
        let point = ray.at(distance);
        let (x, y) = place(&point);
        (distance > 0.0 && x.abs() < 0.25 && y.abs() < 0.25).then_some((point, normal))
    };
    let disc = |point: &Point3<f64>| {
        let (x, y) = place(point);
        let (x, y) = ((x + 0.5).rem_euclid(0.1) - 0.05, (y + 0.5).rem_euclid(0.1) - 0.05);
        if x.hypot(y) < 0.015 { 0.05 } else { 1.0 }
    };
    let image = photograph_painted(&pair, wall, disc, &[-0.6, -0.2, 0.2, 0.6]);
    let found = reconstruct(pair, &image);
    let off: Vec<f64> =
        found.cloud.position_m.iter().map(|p| (Point3::from(*p).cast() - origin).dot(&normal)).collect();
    let rms = (off.iter().map(|x| x * x).sum::<f64>() / off.len() as f64).sqrt();
    let far = off.iter().filter(|x| x.abs() > 0.001).count();
    println!("{} points, rms {:.4} mm, {far} further than 1 mm", off.len(), rms * 1e3);
    assert!(off.len() > 100_000, "{} points", off.len());
    assert!(rms < 0.00008, "{rms} m");
    assert!(far * 1000 < off.len(), "{far} of {}", off.len());
}

#[test]
fn a_sphere_beside_the_marker_is_refused() {
    let pair = pair(None);
    let image = photograph(&pair, sphere(Point3::new(0.0, 0.0, 1.45), 0.20));
    let found = reconstruct(pair, &image);
    assert!(matches!(found.outcome, Outcome::Refused(_)), "{} points", found.cloud.len());
    assert!(found.cloud.is_empty() && found.counts.refused > 30_000, "{:?}", found.counts);
}

/// A wall that lies in a volume of less than a fringe, far from the marker. As deep as two fringes it is refused, and
/// none of it is taken for something within that it is not in.
#[test]
fn a_shallow_volume_needs_no_marker() {
    let in_volume = |x: [f64; 2]| {
        pair_of_rig((0, 0), |rig| {
            rig.pattern.marker = Marker::ZeroMean { amplitude: 0.0 };
            (rig.volume_min_m, rig.volume_max_m) = ([x[0], -0.3, 1.25], [x[1], 0.3, 1.65]);
        })
    };
    let normal = Vector3::new(1.0, 0.05, -0.03).normalize();
    let middle = Point3::new(0.0, 0.0, 1.45);
    let wall = |normal: Vector3<f64>| {
        move |ray: &Ray| {
            let point = ray.at((middle - ray.origin).dot(&normal) / ray.direction.dot(&normal));
            (point.y.abs() < 0.15 && (point.z - 1.45).abs() < 0.15).then_some((point, normal))
        }
    };
    let pair = in_volume([-0.015, 0.015]);
    assert!(pair.is_shallow && !in_volume([-0.05, 0.05]).is_shallow && !self::pair(None).is_shallow);
    let image = photograph(&pair, wall(normal));
    let flat = photograph(&pair, wall(Vector3::x()));
    let found = reconstruct(pair, &image);
    assert_eq!(found.outcome, Outcome::Cloud, "{:?}", found.counts);
    assert!(found.counts.marker == 0 && found.cloud.len() > 40_000, "{} points", found.cloud.len());
    let off =
        found.cloud.position_m.iter().map(|p| (Point3::from(*p).cast::<f64>() - middle).dot(&normal).abs());
    let mut off: Vec<f64> = off.collect();
    off.sort_by(f64::total_cmp);
    assert!(off[off.len() / 2] < 0.0003 && off[off.len() - 1] < 0.005, "{:?}", off.last());
    let found = reconstruct(in_volume([-0.05, 0.05]), &image);
    assert!(matches!(found.outcome, Outcome::Refused(_)), "{} points", found.cloud.len());
    // A seventh of a fringe outside.
    for volume in [[0.006, 0.036], [-0.036, -0.006]] {
        let outside = reconstruct(in_volume(volume), &flat);
        assert!(outside.cloud.len() < 50, "{} points", outside.cloud.len());
    }
    // A small volume that only cuts what a marker names.
    let with_marker = pair_of_rig((0, 0), |rig| {
        (rig.volume_min_m, rig.volume_max_m) = ([-0.015, -0.3, 1.25], [0.015, 0.3, 1.65]);
    });
    assert!(!with_marker.is_shallow);
    assert!(reconstruct(with_marker, &image).cloud.is_empty());
}

/// Markers 41 fringes apart: each sphere shows another one, and each is where it is.
#[test]
fn several_markers_reach_what_one_does_not() {
    for marker in [Marker::ZeroMean { amplitude: 0.3 }, Marker::Darkened { depth: 0.8 }] {
        for height in [0.45, 1.0, 1.5] {
            let pair = pair_with((0, 0), |pattern| (pattern.marker, pattern.marker_every) = (marker, 41));
            assert_eq!(pair.markers, [39, 80, 121]);
            let centre = Point3::new(0.0, 0.0, height);
            let image = photograph(&pair, sphere(centre, 0.20));
            let found = reconstruct(pair, &image);
            assert!(found.cloud.len() > 40_000, "{marker:?} {height}: {} points", found.cloud.len());
            let off = |p: &[f32; 3]| ((Point3::from(*p).cast() - centre).norm() - 0.20).abs();
            let mut errors: Vec<f64> = found.cloud.position_m.iter().map(off).collect();
            errors.sort_by(f64::total_cmp);
            let (p95, worst) = (errors[errors.len() * 95 / 100], errors[errors.len() - 1]);
            assert!(p95 < 0.0006 && worst < 0.010, "{marker:?} {height}: {p95} {worst}");
        }
    }
}

#[test]
fn an_over_exposed_patch_leaves_a_hole_and_no_wrong_points() {
    let pair = pair(None);
    let centre = Point3::new(0.0, 0.0, 1.0);
    let mut image = photograph(&pair, sphere(centre, 0.20));
    let [u, v] = pair.camera.project(&Point3::new(0.19, 0.0, 1.06)).expect("in view").map(|x| x as usize);
    for row in v - 10..v + 10 {
        image.row_mut(row)[u - 10..u + 10].fill(255);
    }
    let found = reconstruct(pair, &image);
    let inside = |p: &[u16; 2]| usize::from(p[0]).abs_diff(u) < 13 && usize::from(p[1]).abs_diff(v) < 9;
    assert!(found.cloud.len() > 40_000 && !found.cloud.pixel.iter().any(inside));
    let off = |p: &[f32; 3]| (p[0].hypot(p[1]).hypot(p[2] - 1.0) - 0.20).abs();
    assert!(found.cloud.position_m.iter().all(|p| off(p) < 0.010));
}

#[test]
fn an_empty_frame_and_one_of_another_size_are_refused() {
    let black = Plane::filled(1920, 1200, 2u8);
    assert!(matches!(reconstruct(pair(None), &black).outcome, Outcome::Refused(_)));
    let small = Plane::filled(64, 48, 100u8);
    let Outcome::Refused(reason) = reconstruct(pair(None), &small).outcome else { panic!("must be refused") };
    assert!(reason.contains("1920"), "{reason}");
}

/// Two cameras of a head before a plate that faces it, no other head and no marker in view. An error of one fringe in one
/// of them looks right to the other where both lie alike about the projector. Where the lower one lies three fifths as
/// far, it is off there by a third of a period or more: each is a witness for the other.
#[test]
fn a_camera_is_a_witness_for_its_mate_where_it_could_contradict() {
    let plate = |ray: &Ray| {
        let at = ray.at(-ray.origin.x / ray.direction.x);
        (at.y.abs() < 0.15 && (1.3..1.6).contains(&at.z)).then(|| (at, Vector3::x()))
    };
    let clouds = |lower_m: f64| {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/rig.toml");
        let text = std::fs::read_to_string(path).expect("the shipped rig");
        let lower = format!("position_m = [2.4, 0.0, {lower_m}]");
        let text = text.replacen("position_m = [2.4, 0.0, 0.25]", &lower, 1);
        let calibration =
            Calibration::nominal(&Rig::from_table(&text.parse().expect("TOML")).expect("a rig"));
        let head = &calibration.heads[0];
        let photographs = [0, 1].map(|camera| {
            let pair =
                CameraProjector::new(head, &head.cameras[camera], &calibration).expect("a usable pair");
            Photograph { head: 0, image: photograph(&pair, plate), pair }
        });
        frame_set::clouds(&photographs).into_iter().map(|found| found.cloud.position_m)
    };
    for points in clouds(0.25) {
        assert!(points.is_empty(), "nobody could contradict {} points", points.len());
    }
    for points in clouds(0.556) {
        let wrong = points.iter().filter(|p| p[0].abs() > 0.005).count();
        assert!(points.len() > 30_000 && wrong * 1000 < points.len(), "{wrong} of {} wrong", points.len());
    }
}
