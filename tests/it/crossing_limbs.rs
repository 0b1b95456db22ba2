// SPDX-License-Identifier: MIT OR Apache-2.0
//! Fringe orders where a limb crosses the trunk little more than half a fringe before it, along the fringes: a bar before
//! a post, seen by all cameras of the shipped rig, rendered here by direct formula with the shadows that one throws on the
//! other.

use crate::frame_set::{self, Photograph};
use fourdbody::base::image::Plane;
use fourdbody::config::Rig;
use fourdbody::data::Calibration;
use fourdbody::geometry::pattern::Marker;
use fourdbody::geometry::{Pose, Ray};
use fourdbody::reconstruct::outcome::Reconstruction;
use fourdbody::reconstruct::triangulate::camera_projector::CameraProjector;
use nalgebra::{Point3, Unit, UnitQuaternion, Vector3};
use std::path::Path;

/// A round bar with flat ends.
struct Bar {
    middle: Point3<f64>,
    along: Unit<Vector3<f64>>,
    half_m: f64,
    radius_m: f64,
}

impl Bar {
    /// Distance along a ray to its first hit, m, and the normal there.
    fn hit(&self, ray: &Ray) -> Option<(f64, Vector3<f64>)> {
        let across = |x: Vector3<f64>| x - self.along.into_inner() * x.dot(&self.along);
        let (from, step) = (across(ray.origin - self.middle), across(ray.direction.into_inner()));
        let (a, b, c) = (step.norm_squared(), from.dot(&step), from.norm_squared() - self.radius_m.powi(2));
        let root = b * b - a * c;
        let distance = (-b - root.max(0.0).sqrt()) / a;
        let point = ray.at(distance) - self.middle;
        (root > 0.0 && point.dot(&self.along).abs() < self.half_m)
            .then(|| (distance, across(point) / self.radius_m))
    }

    /// Distance of a point from its round surface, m.
    fn distance(&self, point: &Point3<f64>) -> f64 {
        let p = point - self.middle;
        let beyond = (p.dot(&self.along).abs() - self.half_m).max(0.0);
        ((p - self.along.into_inner() * p.dot(&self.along)).norm() - self.radius_m).abs().max(beyond)
    }
}

fn first_hit(bars: &[Bar], ray: &Ray) -> Option<(f64, Vector3<f64>)> {
    bars.iter().filter_map(|bar| bar.hit(ray)).min_by(|a, b| a.0.total_cmp(&b.0))
}

fn photograph(pair: &CameraProjector, bars: &[Bar]) -> Plane<u8> {
    let (w, h) = (pair.camera.width, pair.camera.height);
    let mut image = Plane::filled(w, h, 2u8);
    let source = pair.projector.centre();
    let light = |u: usize, v: usize| {
        let ray = pair.camera.ray(u as f64, v as f64)?;
        let (distance, normal) = first_hit(bars, &ray)?;
        let point = ray.at(distance);
        let towards = Unit::new_normalize(point - source);
        let (reached, _) = first_hit(bars, &Ray { origin: source, direction: towards })?;
        let panel = pair.projector.project(&point).filter(|p| pair.projector.contains(*p))?;
        let slope = -towards.dot(&normal);
        let lit = slope > 0.0 && reached > (point - source).norm() - 0.002;
        lit.then(|| slope * pair.pattern.light(panel[0], panel[1]))
    };
    // Where the bars can be seen, and nothing else, is looked at.
    let corners = [-0.36, 0.36].iter().flat_map(|x| [-0.36, 0.36].map(|y| (*x, y)));
    let corners = corners.flat_map(|(x, y)| [0.6, 1.4].map(|z| Point3::new(x, y, z)));
    let seen: Vec<[f64; 2]> = corners.filter_map(|x| pair.camera.project(&x)).collect();
    let range = |i: usize, size: usize| {
        let ends = seen.iter().fold((f64::MAX, f64::MIN), |x, p| (x.0.min(p[i]), x.1.max(p[i])));
        (ends.0.max(0.0) as usize)..(ends.1.max(0.0) as usize).min(size)
    };
    for v in range(1, h) {
        for u in range(0, w) {
            if let Some(light) = light(u, v) {
                image.set(u, v, (2.0 + 180.0 * light).round() as u8);
            }
        }
    }
    image
}

/// A limb before the trunk.
fn bars() -> [Bar; 2] {
    let post =
        Bar { middle: Point3::new(0.0, 0.0, 1.0), along: Vector3::z_axis(), half_m: 0.26, radius_m: 0.11 };
    let limb = Bar {
        middle: Point3::new(0.17, 0.0, 1.0),
        along: Unit::new_normalize(Vector3::new(0.0, 1.0, -0.05)),
        half_m: 0.24,
        radius_m: 0.036,
    };
    [post, limb]
}

/// What all cameras see of them.
fn photographs(marker: Marker) -> Vec<Photograph> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/rig.toml");
    let mut rig = Rig::load(&path).expect("the shipped rig");
    rig.pattern.marker = marker;
    let calibration = Calibration::nominal(&rig);
    let heads = calibration.heads.iter().enumerate();
    let cameras =
        heads.flat_map(|(number, head)| head.cameras.iter().map(move |camera| (number, head, camera)));
    let seen = cameras.map(|(number, head, camera)| {
        let pair = CameraProjector::new(head, camera, &calibration).expect("a usable pair");
        Photograph { head: number, image: photograph(&pair, &bars()), pair }
    });
    seen.collect()
}

/// Points, and those of them that are more than 10 mm off.
fn count(found: &[Reconstruction]) -> [usize; 2] {
    let bars = bars();
    let all = found.iter().flat_map(|x| &x.cloud.position_m);
    let off = |x: &&[f32; 3]| bars.iter().all(|bar| bar.distance(&Point3::from(**x).cast::<f64>()) > 0.010);
    [all.clone().count(), all.filter(off).count()]
}

/// By themselves the cameras have 471,049 points, with the darkened marker 469,338, of which 21,509 are wrong; together they
/// have 521,896 and 522,206 points, 27 and 200 wrong.
#[test]
fn a_bar_along_the_fringes_before_a_post_has_its_own_order() {
    for marker in [Marker::ZeroMean { amplitude: 0.3 }, Marker::Darkened { depth: 0.8 }] {
        let photographs = photographs(marker);
        let [points, wrong] = count(&frame_set::clouds(&photographs));
        let alone: Vec<Reconstruction> = photographs.iter().map(Photograph::cloud).collect();
        let alone = count(&alone);
        println!("{marker:?}: {points} points, {wrong} wrong; alone {alone:?}");
        assert!(wrong * 2000 <= points, "{wrong} of {points} points are wrong");
        assert!(points * 100 >= alone[0] * 109, "{points} points, alone {alone:?}");
    }
}

/// Without the first camera, and with one camera of each head, what is left confirms as before, or is refused.
#[test]
fn fewer_cameras_make_fewer_points_and_no_wrong_ones() {
    let all = photographs(Marker::ZeroMean { amplitude: 0.3 });
    let every_second = |first: usize| (first..all.len()).step_by(2).collect();
    for (set, least) in
        [((1..all.len()).collect(), 510_000), (every_second(0), 280_000), (every_second(1), 295_000)]
    {
        let set: Vec<usize> = set;
        let left: Vec<Photograph> = set.iter().map(|&x| all[x].clone()).collect();
        let [points, wrong] = count(&frame_set::clouds(&left));
        println!("cameras {set:?}: {points} points, {wrong} wrong");
        assert!(
            wrong * 5_000 <= points && points >= least,
            "cameras {set:?}: {points} points, {wrong} wrong"
        );
    }
}

/// A head whose projector turned: its two cameras agree with each other, and other heads' cameras with neither.
#[test]
fn no_points_come_from_a_calibration_whose_projector_has_turned() {
    for degree in [0.03f64, 0.06, 0.1, 0.15, 0.2, 0.3, 0.5] {
        let mut all = photographs(Marker::ZeroMean { amplitude: 0.3 });
        for photograph in all.iter_mut().filter(|x| x.head == 3) {
            let device = &mut photograph.pair.projector.world_from_device;
            let turn = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), degree.to_radians());
            *device = Pose::new(device.isometry() * turn);
        }
        let points: usize = frame_set::clouds(&all).iter().map(|x| x.cloud.position_m.len()).sum();
        assert_eq!(points, 0, "turned by {degree} degree");
    }
}
