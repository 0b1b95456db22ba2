// SPDX-License-Identifier: MIT OR Apache-2.0
//! Reconstruction of bad photographs: each is refused with a reason or gives fewer points; never a panic, and never a
//! plausible wrong cloud.
//!
//! The photographs are of one ball with the marker on it, made by direct formula (`analytic_scene`), so that every point can
//! be held against the truth: a wrong fringe order is tens of millimetres off.

use crate::analytic_scene::{pair_of, photograph, sphere};
use crate::back_end::Frames;
use crate::frame_set::{self, Photograph};
use fourdbody::base::ids::CameraId;
use fourdbody::base::image::{Mono8, Plane};
use fourdbody::batch::run::{self, Format, Plan};
use fourdbody::data::{Calibration, PanelRows};
use fourdbody::reconstruct::outcome::{Outcome, Reconstruction};
use fourdbody::reconstruct::pipeline::{Method, Pipeline};
use fourdbody::reconstruct::triangulate::camera_projector::CameraProjector;
use fourdbody::reconstruct::triangulate::triangulator::Triangulator;
use nalgebra::Point3;
use std::sync::OnceLock;

/// Changes a calibration so that it is unusable.
type Spoil = fn(&mut Calibration);

const RADIUS_M: f64 = 0.20;
/// Further from the ball than this is wrong, m.
const WRONG_M: f64 = 0.005;

fn centre() -> Point3<f64> {
    Point3::new(0.05, -0.02, 1.03)
}

fn pair() -> CameraProjector {
    pair_of(0, 0, None)
}

/// The good photograph by camera 0 of head 0, and the number of points that it gives.
fn good() -> &'static (Plane<u8>, usize) {
    static GOOD: OnceLock<(Plane<u8>, usize)> = OnceLock::new();
    GOOD.get_or_init(|| {
        let image = photograph(&pair(), sphere(centre(), RADIUS_M));
        let found = reconstruct(&image);
        assert_eq!(found.outcome, Outcome::Cloud);
        (image, found.cloud.len())
    })
}

fn reconstruct(image: &Plane<u8>) -> Reconstruction {
    Pipeline::new(Triangulator::new(pair()), Method::Joint, false).run(Mono8::from(image))
}

/// Points that are not on the ball.
fn wrong(found: &Reconstruction) -> usize {
    let off = |p: &[f32; 3]| ((Point3::from(*p).cast::<f64>() - centre()).norm() - RADIUS_M).abs();
    found.cloud.position_m.iter().filter(|p| off(p) > WRONG_M).count()
}

/// Changes each pixel of the good photograph.
fn changed(change: impl Fn(usize, usize, u8) -> u8) -> Plane<u8> {
    let mut image = good().0.clone();
    for v in 0..image.height() {
        for (u, pixel) in image.row_mut(v).iter_mut().enumerate() {
            *pixel = change(u, v, *pixel);
        }
    }
    image
}

/// Asserts that the frame was refused with a reason.
fn assert_refused(name: &str, found: &Reconstruction) {
    let Outcome::Refused(reason) = &found.outcome else {
        panic!("{name}: {} points, {} wrong", found.cloud.len(), wrong(found));
    };
    println!("{name}: refused, {reason}");
    assert!(!reason.is_empty() && found.cloud.is_empty(), "{name}");
}

/// Fewer points than the good photograph's (at least `least` of them as a share), nearly none of them wrong.
fn assert_fewer(name: &str, found: &Reconstruction, least: f64) {
    let share = found.cloud.len() as f64 / good().1 as f64;
    println!("{name}: {:.1} % of the points, {} wrong, {:?}", 100.0 * share, wrong(found), found.outcome);
    assert!((least..1.0).contains(&share), "{name}: {share}");
    assert!(wrong(found) * 1000 <= found.cloud.len(), "{name}: {} of {}", wrong(found), found.cloud.len());
}

/// A number from 0 to 255 that depends on the pixel alone.
fn noise(u: usize, v: usize) -> u8 {
    let mixed =
        (u as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ (v as u64).wrapping_mul(0xc2b2_ae3d_27d4_eb4f);
    (mixed.wrapping_mul(0xff51_afd7_ed55_8ccd) >> 56) as u8
}

/// Box means over `2 reach + 1` px each way, twice.
fn blurred(reach: usize) -> Plane<u8> {
    let mut image = good().0.clone();
    let (w, h) = (image.width(), image.height());
    for _ in 0..2 {
        let across = image.clone();
        for v in 0..h {
            let row = across.row(v);
            for u in reach..w - reach {
                let sum: usize = row[u - reach..=u + reach].iter().map(|x| usize::from(*x)).sum();
                image.set(u, v, (sum / (2 * reach + 1)) as u8);
            }
        }
        let along = image.clone();
        for v in reach..h - reach {
            for u in 0..w {
                let sum: usize = (v - reach..=v + reach).map(|y| usize::from(along.at(u, y))).sum();
                image.set(u, v, (sum / (2 * reach + 1)) as u8);
            }
        }
    }
    image
}

/// Photographs in which nothing is to be seen.
fn that_show_nothing() -> [(&'static str, Plane<u8>); 6] {
    [
        ("empty", changed(|_, _, _| 0)),
        ("grey", changed(|_, _, _| 90)),
        ("white", changed(|_, _, _| 255)),
        ("noise", changed(|u, v, _| noise(u, v))),
        ("dark", changed(|_, _, x| x / 40)),
        ("all saturated", changed(|_, _, x| x.saturating_mul(60))),
    ]
}

#[test]
fn frames_that_show_nothing_are_refused() {
    for (name, image) in that_show_nothing() {
        assert_refused(name, &reconstruct(&image));
    }
}

#[test]
fn frames_of_another_size_are_refused() {
    for size in [(0, 0), (1, 1), (1200, 1920), (1921, 1200)] {
        assert_refused("another size", &reconstruct(&Plane::filled(size.0, size.1, 100)));
    }
}

#[test]
fn saturated_and_faint_frames_lose_points_only() {
    // Nothing of a fringe is left whole.
    assert_refused("saturated on the ridges", &reconstruct(&changed(|_, _, x| x.saturating_mul(2))));
    assert_fewer("a twelfth of the light", &reconstruct(&changed(|_, _, x| x / 12)), 0.3);
}

#[test]
fn blurred_frames_lose_points_or_are_refused() {
    assert_fewer("a little out of focus", &reconstruct(&blurred(1)), 0.5);
    assert_refused("out of focus", &reconstruct(&blurred(3)));
    // Less than a fringe is left of the fringes.
    assert_refused("far out of focus", &reconstruct(&blurred(12)));
}

#[test]
fn a_frame_that_ends_early_keeps_what_the_marker_reaches() {
    // What a receiver leaves of a frame that lost its last packets.
    assert_fewer(
        "the lower rows missing",
        &reconstruct(&changed(|_, v, x| if v < 620 { x } else { 0 })),
        0.2,
    );
    let marker = marker_column();
    let found = reconstruct(&changed(|u, _, x| if u + 30 < marker { x } else { 0 }));
    assert_refused("cut before the marker", &found);
    println!("the marker is at column {marker}");
}

/// A column on the marker, from the panel column that the ball's middle sees.
fn marker_column() -> usize {
    let pair = pair();
    let wanted = f64::from(pair.pattern.marker_index) * pair.pattern.period_px - 0.5;
    let seen = |u: usize| {
        let ray = pair.camera.ray(u as f64, 600.0)?;
        let (point, _) = sphere(centre(), RADIUS_M)(&ray)?;
        Some((pair.projector.project(&point)?[0] - wanted).abs())
    };
    (300..1700).filter_map(|u| Some((u, seen(u)?))).min_by(|a, b| a.1.total_cmp(&b.1)).expect("on the ball").0
}

#[test]
fn light_without_pattern_is_refused() {
    let mut white = pair();
    (white.pattern.low, white.pattern.high) = (1.0, 1.0);
    white.pattern.marker = fourdbody::geometry::pattern::Marker::Darkened { depth: 0.0 };
    assert_refused("white light", &reconstruct(&photograph(&white, sphere(centre(), RADIUS_M))));
    let mut unmarked = pair();
    unmarked.pattern.marker_index = 100_000;
    assert_refused("no marker", &reconstruct(&photograph(&unmarked, sphere(centre(), RADIUS_M))));
}

/// What camera 0 of head 0 sees when another head's projector lights the ball.
fn lit_by(head: usize) -> Plane<u8> {
    let mut pair = pair();
    pair.projector = pair_of(head, 0, None).projector;
    photograph(&pair, sphere(centre(), RADIUS_M))
}

#[test]
fn crosstalk_of_a_neighbour_makes_no_wrong_points() {
    let other = lit_by(1);
    for percent in [2u32, 5, 10] {
        let image = changed(|u, v, x| x.saturating_add((u32::from(other.at(u, v)) * percent / 100) as u8));
        let found = reconstruct(&image);
        let share = found.cloud.len() as f64 / good().1 as f64;
        println!("{percent} % crosstalk: {:.1} % of the points, {} wrong", 100.0 * share, wrong(&found));
        assert!(share > 0.98, "{percent} %: {share}");
        assert!(wrong(&found) * 1000 <= found.cloud.len(), "{percent} %: {} wrong", wrong(&found));
    }
}

#[test]
fn numbers_that_are_none_in_a_calibration_are_refused() {
    let calibration = nominal();
    let broken: [(&str, Spoil); 6] = [
        ("focal length", |c| c.heads[0].cameras[0].device.lens.fx = f64::NAN),
        ("principal point", |c| c.heads[0].cameras[0].device.lens.cx = f64::INFINITY),
        ("distortion", |c| c.heads[0].cameras[0].device.lens.distortion[1] = f64::NAN),
        ("projector", |c| c.heads[0].projector.lens.fy = f64::NAN),
        ("period", |c| c.pattern.period_px = f64::NAN),
        ("volume", |c| c.volume_max_m[2] = f64::NAN),
    ];
    for (name, spoil) in broken {
        let mut spoilt = calibration.clone();
        spoil(&mut spoilt);
        let dir = tempfile::tempdir().expect("a temporary directory");
        let path = dir.path().join("calibration.json");
        // JSON has no such number: it becomes `null`, or cannot be written.
        let refused_by_file = spoilt.save(&path).is_err() || Calibration::load(&path).is_err();
        assert!(refused_by_file, "{name}: the file is accepted");
        // In memory, too, nothing comes of it.
        let head = &spoilt.heads[0];
        match CameraProjector::new(head, &head.cameras[0], &spoilt) {
            Err(reason) => println!("{name}: {reason}"),
            Ok(pair) => {
                let run =
                    Pipeline::new(Triangulator::new(pair), Method::Joint, false).run(Mono8::from(&good().0));
                assert_refused(name, &run);
            }
        }
    }
}

fn nominal() -> Calibration {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("config/rig.toml");
    Calibration::nominal(&fourdbody::config::Rig::load(&path).expect("the shipped rig"))
}

/// The marker's dashes tell whose calibration and whose light it is: not where the fringes are, but where the marker is on the
/// panel along itself.
#[test]
fn the_calibration_of_another_camera_or_head_is_refused() {
    let image = &good().0;
    let by = |pair: CameraProjector, image: &Plane<u8>| {
        Pipeline::new(Triangulator::new(pair), Method::Joint, false).run(Mono8::from(image))
    };
    assert_refused("the other camera of the head", &by(pair_of(0, 1, None), image));
    assert_refused("light of the neighbouring head", &by(pair(), &lit_by(1)));
    assert_refused("light of the head behind", &by(pair(), &lit_by(2)));
}

/// What becomes of a pixel's light.
type Light = fn(u8) -> u8;

/// Head, and camera in it.
type Place = (usize, usize);

/// What becomes of these photographs of the ball, each by a camera (head, number) and taken for one, and why what is refused is.
fn of_cameras(photographs: &[(Place, Place)]) -> Vec<(usize, Option<String>)> {
    let mut calibration = nominal();
    calibration.heads.iter_mut().for_each(|head| head.rows = Some(PanelRows::exact()));
    let id = |(head, camera): Place| calibration.heads[head].cameras[camera].id.clone();
    let frames = photographs.iter().map(|&((head, camera), taken_for)| {
        (id(taken_for), Some(photograph(&pair_of(head, camera, None), sphere(centre(), RADIUS_M))))
    });
    let mut cameras: Vec<CameraId> = photographs.iter().map(|(_, taken_for)| id(*taken_for)).collect();
    cameras.sort_by_key(|camera| calibration.cameras().position(|(_, x)| x.id == *camera));
    let source = Frames(frames.collect(), cameras.clone());
    let dir = tempfile::tempdir().expect("a temporary directory");
    let plan = Plan {
        out: dir.path().to_owned(),
        triggers: 0..1,
        cameras,
        formats: vec![Format::Ply],
        discard: true,
        ..Plan::default()
    };
    let (summary, _) = run::run(&source, &calibration, &plan, run::to_the_end).expect("runs");
    let frames = &summary.triggers[0].frames;
    frames.iter().for_each(|x| println!("{}: {} points, {:?}", x.camera, x.points, x.reason));
    frames.iter().map(|x| (x.points, x.reason.clone())).collect()
}

#[test]
fn a_camera_that_is_taken_for_another_spoils_nothing_and_most_of_them_spoil_all() {
    let (up, low, beside) = ((0, 0), (0, 1), (1, 0));
    let right = of_cameras(&[(up, up), (low, low), (beside, beside)]);
    assert!(right.iter().all(|(points, reason)| *points > 10_000 && reason.is_none()));
    // One of three: it is refused, and the others are what they are without it.
    let one = of_cameras(&[(low, up), (low, low), (beside, beside)]);
    assert!(one[0].0 == 0 && one[0].1.as_ref().is_some_and(|reason| reason.contains("dashes")), "{one:?}");
    assert_eq!(one[1..], of_cameras(&[(low, low), (beside, beside)]));
    // One of the two of a head: nobody confirms the other.
    let alone = of_cameras(&[(low, up), (low, low)]);
    assert!(
        alone[1].0 == 0 && alone[1].1.as_ref().is_some_and(|reason| reason.contains("too few places")),
        "{alone:?}"
    );
    // Two of three: the third agrees by chance, as far as can be known.
    let most = of_cameras(&[(low, up), (up, low), (beside, beside)]);
    assert!(most.iter().all(|(points, reason)| *points == 0 && reason.is_some()), "{most:?}");
    assert!(most[2].1.as_ref().is_some_and(|reason| reason.contains("most other cameras")), "{most:?}");
}

/// What is wrong with one camera's light must not be taken for what it sees: neither over-exposed nor dark is background.
/// Without it the others have 22,138 and 20,610 points.
#[test]
fn a_spoilt_frame_spoils_no_other() {
    let places: [Place; 3] = [(0, 0), (0, 1), (1, 0)];
    let photographs = places.map(|(head, camera)| {
        let pair = pair_of(head, camera, None);
        Photograph { head, image: photograph(&pair, sphere(centre(), RADIUS_M)), pair }
    });
    // What is left to the head's other camera and to the neighbour, about 1 in 100 less than was measured.
    let spoils: [(&str, Light, [usize; 2]); 6] = [
        ("good", |x| x, [75_600, 24_400]),
        ("no light", |_| 0, [21_900, 20_400]),
        ("over-exposed", |x| x.saturating_mul(60), [21_900, 20_400]),
        ("saturated", |x| x.saturating_mul(4), [24_000, 25_100]),
        ("saturated on the ridges", |x| x.saturating_mul(2), [75_600, 24_800]),
        ("a twelfth of the light", |x| x / 12, [75_600, 20_400]),
    ];
    for (name, spoil, least) in spoils {
        let mut spoilt = photographs.clone();
        spoilt[0].image.as_mut_slice().iter_mut().for_each(|x| *x = spoil(*x));
        let found = frame_set::clouds(&spoilt);
        let points: Vec<usize> = found.iter().map(|x| x.cloud.len()).collect();
        let counts = &found[0].counts;
        println!("{name}: {points:?}, phase on {} of {} px", counts.phase, counts.object);
        let off: Vec<usize> = found.iter().map(wrong).collect();
        assert!(off == [0; 3], "{name}: {off:?} wrong");
        assert!((1..).zip(least).all(|(camera, least)| points[camera] >= least), "{name}: {points:?}");
    }
}

/// Stages work in memory that other frames have used, and look beside the object: there must be nothing of theirs.
#[test]
fn a_frame_is_what_it_is_after_any_other() {
    // Phases everywhere; and a ball with a hole that is wider than any stage looks, whose rows end here and there by turns.
    let mut everywhere = Plane::filled(pair().camera.width, pair().camera.height, 0u8);
    for v in 0..everywhere.height() {
        for (u, pixel) in everywhere.row_mut(v).iter_mut().enumerate() {
            *pixel = (120.0 + 90.0 * (u as f32 * 0.57).cos()) as u8;
        }
    }
    let [u, v] = pair().camera.project(&centre()).expect("in view").map(|x| x as usize);
    let holed = changed(|x, y, light| match light {
        _ if x.abs_diff(u) < 90 && y.abs_diff(v) < 60 => 255,
        _ if y / 20 % 2 == 0 && x.abs_diff(u) > 120 => 0,
        _ => light,
    });
    let all = || {
        let places: [Place; 2] = [(0, 0), (0, 1)];
        let photographs = places.map(|(head, camera)| {
            let pair = pair_of(head, camera, None);
            let image =
                if camera == 0 { holed.clone() } else { photograph(&pair, sphere(centre(), RADIUS_M)) };
            Photograph { head, image, pair }
        });
        let found = frame_set::clouds(&photographs);
        found.into_iter().map(|x| (x.phase, x.cloud.position_m, x.cloud.normal)).collect::<Vec<_>>()
    };
    let first = all();
    assert!(first.iter().all(|(_, points, _)| points.len() > 10_000));
    let pipeline = Pipeline::new(Triangulator::new(pair()), Method::Joint, false);
    (0..4).for_each(|_| assert!(pipeline.run(Mono8::from(&everywhere)).cloud.is_empty()));
    assert!(first == all());
}
