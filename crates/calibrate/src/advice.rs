// SPDX-License-Identifier: MIT OR Apache-2.0
//! Advice for the operator: what to do better next time, derived from how a calibration went.

use super::findings::Kind;
use super::run::{Outcome, seen_positions, with_first_device};
use crate::data::Calibration;
use nalgebra::Vector3;
use std::collections::BTreeSet;

/// Cells that the image is divided into to measure coverage, along u and v.
pub const CELLS: [usize; 2] = [8, 5];
/// Share of the cells in which each camera should have seen circles: lenses are extrapolated elsewhere.
const COVERED: f64 = 0.75;
/// Largest angle between two positions that is good, degrees: it separates focal length from distance.
const TILT_DEG: f64 = 35.0;
/// Standard deviation of a focal length that is good, as a share of it.
const FOCAL: f64 = 3e-4;
/// Distance of two heads on their common positions that is good, mm rms.
const LINK_MM: f64 = 0.3;
/// Positions that neighbouring heads should have in common: one bad position then shows.
const COMMON: usize = 2;
/// Difference between the measured gamma and the one that the pattern undoes, above which there is advice.
const GAMMA: f64 = 0.05;

/// How many circles each cell of the image had in all positions, row after row.
pub fn coverage(outcome: &Outcome, device: usize, size: (usize, usize)) -> Vec<usize> {
    let mut cells = vec![0; CELLS[0] * CELLS[1]];
    for o in outcome.together.observations.iter().filter(|o| o.device == device) {
        let cell = |x: f64, side: usize, n: usize| {
            ((x + 0.5) / side as f64 * n as f64).clamp(0.0, n as f64 - 1.0) as usize
        };
        let (u, v) = (cell(o.measured[0], size.0, CELLS[0]), cell(o.measured[1], size.1, CELLS[1]));
        cells[v * CELLS[0] + u] += 1;
    }
    cells
}

/// Advice, most important first; empty when there is none to give.
pub fn advice(outcome: &Outcome) -> Vec<String> {
    let calibration = &outcome.calibration;
    let mut advice = of_cameras(outcome, calibration);
    advice.extend(of_heads(outcome, calibration));
    advice.extend(of_links(outcome, calibration));
    let moved: BTreeSet<usize> =
        outcome.findings.iter().filter(|f| f.kind == Kind::Moved).filter_map(|f| f.position).collect();
    if !moved.is_empty() {
        advice.push(format!(
            "hold the board still from the white frame to the fringes: it moved in {} positions",
            moved.len()
        ));
    }
    advice
}

fn of_cameras(outcome: &Outcome, calibration: &Calibration) -> Vec<String> {
    let mut advice = Vec::new();
    for ((head, first), result) in with_first_device(&calibration.heads).zip(&outcome.heads) {
        for (device, camera) in (first..).zip(&head.cameras) {
            let (boards, all) =
                (seen_positions(&outcome.together.observations, device), result.positions.len());
            if boards < all {
                advice.push(format!(
                    "camera {} saw the board in {boards} of {all} positions: place it where both cameras of {} see it",
                    camera.id, head.id
                ));
            }
            let cells = coverage(outcome, device, (camera.device.width, camera.device.height));
            let empty = cells.iter().filter(|n| **n == 0).count();
            if (empty as f64) > (1.0 - COVERED) * cells.len() as f64 {
                advice.push(format!(
                    "camera {}: circles in {} of {} parts of its image only: bring the board to {}",
                    camera.id,
                    cells.len() - empty,
                    cells.len(),
                    emptiest_side(&cells)
                ));
            }
        }
    }
    advice
}

type IsAtSide<'a> = &'a dyn Fn(usize, usize) -> bool;

fn emptiest_side(cells: &[usize]) -> &'static str {
    let empty = |is: IsAtSide<'_>| {
        let places = (0..cells.len()).filter(|i| is(i % CELLS[0], i / CELLS[0]));
        let (n, empty) = places.fold((0, 0), |(n, empty), i| (n + 1, empty + usize::from(cells[i] == 0)));
        empty as f64 / n.max(1) as f64
    };
    let sides: [(&str, IsAtSide<'_>); 4] = [
        ("the image's first columns", &|u, _| u < 2),
        ("the image's last columns", &|u, _| u >= CELLS[0] - 2),
        ("the image's first rows", &|_, v| v == 0),
        ("the image's last rows", &|_, v| v == CELLS[1] - 1),
    ];
    let most = sides.iter().max_by(|a, b| empty(a.1).total_cmp(&empty(b.1)));
    most.map_or("the edges", |(name, _)| name)
}

fn of_heads(outcome: &Outcome, calibration: &Calibration) -> Vec<String> {
    let mut advice = Vec::new();
    for (head, result) in calibration.heads.iter().zip(&outcome.heads) {
        let normals: Vec<Vector3<f64>> =
            result.all.model.boards.iter().map(|b| b.rotation * Vector3::z()).collect();
        let angles = normals.iter().flat_map(|a| normals.iter().map(move |b| a.angle(b).to_degrees()));
        let most = angles.fold(0.0, f64::max);
        if most < TILT_DEG {
            advice.push(format!(
                "head {}: tilt the board more: positions differ by at most {most:.0} degrees, {TILT_DEG:.0} or more are good",
                head.id
            ));
        }
        for (d, (device, sigma)) in result.all.model.devices.iter().zip(&result.all.device_sigma).enumerate()
        {
            let share = sigma[0] / device.lens.fx;
            if share > FOCAL {
                let name = head.cameras.get(d).map_or("its projector".to_owned(), |c| c.id.to_string());
                advice.push(format!(
                    "head {}: more positions are needed: the focal length of {name} is known to {:.2} per mille, {:.1} is good",
                    head.id,
                    share * 1e3,
                    FOCAL * 1e3
                ));
            }
        }
    }
    let responses = calibration.quality.iter().flat_map(|quality| &quality.responses);
    for (head, response) in responses {
        let off = (response.gamma - calibration.pattern.gamma).abs();
        if off > GAMMA && off > 3.0 * response.sigma {
            advice.push(format!(
                "head {head}: its projector's gamma is {:.2}, the pattern undoes {:.2}: set pattern.gamma in the rig file, or write its image with `fourdbody pattern --gamma {:.2}`",
                response.gamma, calibration.pattern.gamma, response.gamma
            ));
        }
    }
    advice
}

fn of_links(outcome: &Outcome, calibration: &Calibration) -> Vec<String> {
    let Some(quality) = &calibration.quality else { return Vec::new() };
    let name = |place: usize| {
        let found = outcome.heads.iter().position(|h| h.head == place);
        found.and_then(|i| calibration.heads.get(i)).map_or("?".to_owned(), |h| h.id.to_string())
    };
    let mut advice = Vec::new();
    for link in &quality.links {
        let [a, b] = link.heads.map(name);
        if link.positions < COMMON {
            advice.push(format!("heads {a} and {b} share {} position only: show both more", link.positions));
        }
        if link.rms_mm > LINK_MM {
            advice.push(format!(
                "heads {a} and {b} differ by {:.2} mm on what both saw, {LINK_MM} is good: more common positions, nearer to both",
                link.rms_mm
            ));
        }
    }
    advice
}
