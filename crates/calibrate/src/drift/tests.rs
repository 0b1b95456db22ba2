// SPDX-License-Identifier: MIT OR Apache-2.0
//! Turns that are known are found again, from the exact phases of a ball.

use super::history::Verdict;
use super::{Drift, Turn, estimate, turned};
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

/// The rig with each of its devices turned: cameras first.
fn with_turns(rig: &Calibration, turns: &[Vector3<f64>]) -> Calibration {
    let devices = turns.iter().map(|turn| super::Turn {
        device: String::new(),
        turn_deg: turn.map(f64::to_degrees).into(),
        sigma_deg: [0.0; 3],
        angle_deg: 0.0,
        at_body_mm: 0.0,
        at_body_sigma_mm: 0.0,
    });
    Drift { devices: devices.collect(), sightings: 0, differ_rad: [0.0; 2] }.corrected(rig, "nothing")
}

#[test]
fn known_turns_are_found_where_they_matter() {
    let rig = rig();
    let count = rig.cameras().count() + rig.heads.len();
    for size_deg in [0.003, 0.02] {
        let turn = |i: usize| {
            let axis =
                Vector3::new((i * 7 % 5) as f64 - 2.0, (i * 3 % 7) as f64 - 3.0, (i * 5 % 3) as f64 - 1.0);
            axis.normalize() * f64::to_radians(size_deg)
        };
        let turns: Vec<Vector3<f64>> = (0..count).map(turn).collect();
        let seen = photographed(&with_turns(&rig, &turns));
        let drift = estimate(&rig, std::iter::once(seen)).expect("enough places");
        assert!(drift.differ_rad[1] <= 0.011 && drift.differ_rad[0] > 2.0 * drift.differ_rad[1], "{drift:?}");
        // A turn that a ball does not determine (about the line to it, for instance) moves nothing there.
        let found = drift.devices.iter().map(|device| Vector3::from(device.turn_deg.map(f64::to_radians)));
        for ((found, turn), device) in found.zip(&turns).zip(&drift.devices) {
            let off = (found - turn).norm().to_degrees();
            let sigma = Vector3::from(device.sigma_deg).norm();
            assert!(off < 0.003 || off < 3.0 * sigma, "{}: off by {off}, sigma {sigma}", device.device);
        }
        let seen = photographed(&with_turns(&rig, &turns));
        let again = estimate(&drift.corrected(&rig, "ball"), std::iter::once(seen)).expect("enough places");
        assert!(again.differ_rad[0] <= 0.011, "{again:?}");
    }
}

#[test]
fn a_rig_that_stands_is_said_to_stand() {
    let rig = rig();
    let drift = estimate(&rig, std::iter::once(photographed(&rig))).expect("enough places");
    for device in &drift.devices {
        for (turn, sigma) in device.turn_deg.iter().zip(device.sigma_deg) {
            assert!(turn.abs() < 0.001 + sigma, "{device:?}");
        }
    }
    let origin = drift.corrected(&rig, "walk-01").origin;
    assert!(origin.starts_with(&rig.origin) && origin.ends_with("walk-01"), "{origin}");
    assert!(turned(&rig.heads[0].projector, &Vector3::zeros()) == rig.heads[0].projector);
    assert!(
        estimate(&rig, std::iter::empty()).is_err_and(|e| e.contains("500")),
        "nothing is not a rig that stands"
    );
}

#[test]
fn a_verdict_is_said_only_of_what_is_known_of_every_device() {
    let drift = |moved: &[(f64, f64)]| Drift {
        devices: moved
            .iter()
            .enumerate()
            .map(|(i, &(at_body_mm, at_body_sigma_mm))| Turn {
                device: format!("camera c{i}"),
                turn_deg: [0.0; 3],
                sigma_deg: [0.0; 3],
                angle_deg: 0.0,
                at_body_mm,
                at_body_sigma_mm,
            })
            .collect(),
        sightings: 1000,
        differ_rad: [0.01; 2],
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
        let (found, words) = drift(moved).verdict(0.2);
        assert_eq!(found, verdict, "{words}");
        assert!(words.contains(said), "{words}");
    }
}
