// SPDX-License-Identifier: MIT OR Apache-2.0
//! Moves that are known are found again, from the exact phases of a ball.

use super::history::Verdict;
use super::motion::{Motion, USUAL};
use super::{Drift, Judged, Kind, Move, estimate};
use crate::config::Rig;
use crate::data::{Calibration, PhaseMap, Run, STEPS_PER_FRINGE};
use crate::geometry::Device;
use nalgebra::{Point3, Vector3};
use std::f64::consts::TAU;
use std::path::Path;

const CENTRE: [f64; 3] = [0.05, -0.1, 1.05];
const RADIUS_M: f64 = 0.45;

/// The shipped rig with a third of the columns and rows.
fn rig() -> Calibration {
    let rig =
        Rig::load(Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../config/rig.toml"))).expect("valid");
    let mut calibration = Calibration::nominal(&rig);
    for camera in calibration.heads.iter_mut().flat_map(|head| &mut head.cameras) {
        let device = &mut camera.device;
        (device.width, device.height) = (device.width / 3, device.height / 3);
        let lens = &mut device.lens;
        (lens.fx, lens.fy) = (lens.fx / 3.0, lens.fy / 3.0);
        (lens.cx, lens.cy) = ((lens.cx + 0.5) / 3.0 - 0.5, (lens.cy + 0.5) / 3.0 - 0.5);
    }
    calibration
}

/// Where a line of sight meets the ball.
fn on_ball(camera: &Device, u: usize, v: usize) -> Option<Point3<f64>> {
    let ray = camera.ray(u as f64, v as f64)?;
    let from = ray.origin - Point3::from(CENTRE);
    let half = from.dot(&ray.direction);
    let under = half * half - from.norm_squared() + RADIUS_M * RADIUS_M;
    (under > 0.0).then(|| ray.at(-half - under.sqrt()))
}

/// What the cameras of a rig that stands so see of it.
fn photographed(rig: &Calibration) -> Vec<(usize, PhaseMap)> {
    let maps = rig.cameras().map(|(head, camera)| {
        let device = &camera.device;
        let mut map = PhaseMap { frame: [device.width as u16, device.height as u16], ..PhaseMap::default() };
        for v in 0..device.height {
            let seen = |u: usize| {
                let point = on_ball(device, u, v)?;
                let towards = head.projector.centre() - point;
                let lit = towards.dot(&(point - Point3::from(CENTRE))) > 0.1 * RADIUS_M * towards.norm();
                lit.then(|| head.projector.project(&point)).flatten()
            };
            let row: Vec<Option<[f64; 2]>> = (0..device.width).map(seen).collect();
            let first = row.iter().position(Option::is_some);
            let Some((first, last)) = first.zip(row.iter().rposition(Option::is_some)) else { continue };
            assert!(row[first..=last].iter().all(Option::is_some));
            map.runs.push(Run { row: v as u16, first: first as u16, length: (last - first + 1) as u16 });
            map.phase.extend(row.iter().flatten().map(|[column, _]| {
                (rig.pattern.phase(*column) / TAU * f64::from(STEPS_PER_FRINGE)).round() as i32
            }));
        }
        map
    });
    maps.enumerate().collect()
}

/// The rig with each of its devices moved: cameras first.
fn with_motions(rig: &Calibration, motions: &[Motion]) -> Calibration {
    drift(Vec::new(), motions.to_vec()).corrected(rig, "nothing")
}

fn drift(devices: Vec<Move>, motions: Vec<Motion>) -> Drift {
    let held_back = Judged::default();
    Drift {
        devices,
        sightings: 1000,
        differ_rad: [0.01; 2],
        held_back,
        motions,
        started_rad: 0.0,
        changed: 0.0,
    }
}

/// What was found, in a few lines.
fn told(drift: &Drift) -> String {
    let Drift { devices, differ_rad, sightings, held_back, .. } = drift;
    let devices: Vec<String> = devices.iter().map(ToString::to_string).collect();
    format!("{sightings} places, {differ_rad:.4?} rad, {held_back:?}\n{}", devices.join("\n"))
}

fn seen(rig: &Calibration) -> impl Iterator<Item = Vec<(usize, PhaseMap)>> {
    std::iter::once(photographed(rig))
}

#[test]
fn turns_of_all_devices_are_found_where_they_matter() {
    let rig = rig();
    let count = rig.cameras().count() + rig.heads.len();
    for size_deg in [0.003, 0.02] {
        let turn = |i: usize| {
            let axis =
                Vector3::new((i * 7 % 5) as f64 - 2.0, (i * 3 % 7) as f64 - 3.0, (i * 5 % 3) as f64 - 1.0);
            Motion { turn: axis.normalize() * f64::to_radians(size_deg), ..Motion::default() }
        };
        let turned: Vec<Motion> = (0..count).map(turn).collect();
        let true_rig = with_motions(&rig, &turned);
        let drift = estimate(&rig, None, seen(&true_rig)).expect("enough places");
        assert!(
            drift.differ_rad[1] <= 0.011 && drift.differ_rad[0] > 2.0 * drift.differ_rad[1],
            "{}",
            told(&drift)
        );
        assert!(drift.no_better().is_none(), "{}", told(&drift));
        let again = estimate(&drift.corrected(&rig, "ball"), None, seen(&true_rig)).expect("enough places");
        assert!(again.differ_rad[0] <= 0.011, "{}", told(&again));
    }
}

/// What one change is called.
#[track_caller]
fn assert_named(motions: &[(usize, Motion)], device: &str, kind: Kind) {
    let rig = rig();
    let mut all = vec![Motion::default(); rig.cameras().count() + rig.heads.len()];
    motions.iter().for_each(|&(i, motion)| all[i] = motion);
    let drift = estimate(&rig, None, seen(&with_motions(&rig, &all))).expect("enough places");
    let named: Vec<&Move> = drift.devices.iter().filter(|x| !x.kinds.is_empty()).collect();
    assert!(drift.devices.iter().any(|x| x.device == device && x.kinds == [kind]), "{}", told(&drift));
    assert_eq!(named.len(), 1, "{}", told(&drift));
    assert!(drift.no_better().is_none(), "{}", told(&drift));
}

#[test]
fn what_one_device_did_is_called_so() {
    let turn = Motion { turn: Vector3::new(0.6, 0.8, 0.0) * USUAL[0] * 2.0, ..Motion::default() };
    let focal = Motion { focal: 5e-4, ..Motion::default() };
    assert_named(&[(2, turn)], "camera h1_up", Kind::Turn);
    assert_named(&[(8, turn)], "projector h0", Kind::Turn);
    assert_named(&[(5, focal)], "camera h2_low", Kind::FocalLength);
}

#[test]
fn a_rig_that_stands_is_said_to_stand() {
    let rig = rig();
    let drift = estimate(&rig, None, seen(&rig)).expect("enough places");
    assert!(drift.devices.iter().all(|device| device.kinds.is_empty()), "{}", told(&drift));
    assert!(drift.no_better().is_some_and(|reason| reason.contains("no move")));
    let origin = drift.corrected(&rig, "walk-01").origin;
    assert!(origin.starts_with(&rig.origin) && origin.ends_with("walk-01"), "{origin}");
    assert!(Motion::default().apply(&rig.heads[0].projector) == rig.heads[0].projector);
    assert!(
        estimate(&rig, None, std::iter::empty()).is_err_and(|e| e.contains("500")),
        "nothing is not a rig that stands"
    );
}

#[test]
fn a_verdict_is_said_only_of_what_is_known_of_every_device() {
    let of = |moved: &[(f64, f64)]| {
        let device = |(i, &(at_body_mm, at_body_sigma_mm)): (usize, &(f64, f64))| Move {
            device: format!("camera c{i}"),
            kinds: vec![Kind::Turn],
            turn_deg: [0.0; 3],
            sigma_deg: [0.0; 3],
            angle_deg: 0.0,
            shift_mm: [0.0; 3],
            shift_sigma_mm: [0.0; 3],
            focal_percent: 0.0,
            focal_sigma_percent: 0.0,
            at_body_mm,
            at_body_sigma_mm,
        };
        drift(moved.iter().enumerate().map(device).collect(), Vec::new())
    };
    for (moved, verdict, said) in [
        (&[(0.03, 0.02), (0.02, 0.02)][..], Verdict::Stands, "camera c0"),
        (&[(0.03, 0.02), (0.14, 0.02)], Verdict::Turned, "camera c1"),
        // More than it may, but not surely.
        (&[(0.25, 0.08), (0.01, 0.02)], Verdict::Turned, "camera c0"),
        (
            &[(0.25, 0.02), (0.31, 0.02)],
            Verdict::CalibrateAgain,
            "camera c1 has turned by 0.000 degree, 0.31 (+- 0.02) mm at the body (1 more by less)",
        ),
        // Nothing has seen it.
        (&[(0.03, 0.02), (0.0, 0.35)], Verdict::NotKnown, "of camera c1"),
        (&[(0.31, 0.02), (0.0, 0.35)], Verdict::CalibrateAgain, "camera c0"),
    ] {
        let (found, words) = of(moved).verdict(0.2);
        assert_eq!(found, verdict, "{words}");
        assert!(words.contains(said), "{words}");
    }
}
