// SPDX-License-Identifier: MIT OR Apache-2.0
//! Where the panel's rows are.
//!
//! Fringes give the panel's column of a point only. A projector that is adjusted to columns keeps its rows where the
//! rig file had them: no column depends on its place along its rows, or on focal length and principal point along them.
//! No point of a cloud depends on these either. But the marker's dashes lie on rows, and give them modulo the dashes'
//! period. The geometry's row `v` at distance `z` is too large, to first order in all three, by
//!
//! ```text
//! a + b v + c / z
//! ```
//!
//! It is fitted to the dashes on the board, in stretches of two (`reconstruct::marker::epipolar_check`), as a
//! correction that is kept beside the geometry. With it the dashes of a photograph show whether it belongs to the
//! calibration.

use super::marker_check::ridges;
use super::observed::{Position, RidgePixel, View};
use super::rigging::HeadResult;
use crate::base::image::Plane;
use crate::data::{Calibration, PanelRows};
use crate::reconstruct::marker::epipolar_check::{Crossing, Stretch, stretches_of};
use crate::reconstruct::triangulate::camera_projector::CameraProjector;
use crate::reconstruct::triangulate::triangulator::Triangulator;
use nalgebra::{Matrix3, Vector3};
use std::f64::consts::TAU;

/// Fewest stretches that three numbers are taken from.
const LEAST_STRETCHES: usize = 30;

/// Share of the stretches that must agree with the three numbers.
const LEAST_AGREEING: f64 = 0.8;
/// A stretch agrees when its rows are within this, px of the panel.
const AGREE_PX: f64 = 0.5;

/// Values tried for `b`: steps to each side, and their size, px per panel height. A step moves a row by 2 px at most, a
/// quarter of the dashes' period.
const SCALES: (i32, f64) = (6, 2.0);
/// Values tried for `c`: steps to each side, and their size, px m. A step moves a row by 2 px at most, too.
const NEARNESSES: (i32, f64) = (8, 4.0);

/// Rounds in which the fit leaves out what it does not explain.
const ROUNDS: usize = 5;

/// The ridges of the markers on the board, between its circles, from row to row.
pub(super) fn ridge(
    view: &View,
    image: &Plane<u8>,
    phase: &Plane<f32>,
    pair: &CameraProjector,
) -> Vec<RidgePixel> {
    let half = (pair.period_px / 2.0).round() as usize;
    let mut ridge = Vec::new();
    for columns in ridges(view, phase, pair) {
        for (v, u) in columns.into_iter().enumerate() {
            let Some(u) = u else { continue };
            let Some(light) = image.row(v).get(u.saturating_sub(half)..=u + half) else { continue };
            let light = light.iter().map(|x| f64::from(*x)).sum::<f64>() / light.len() as f64;
            ridge.push(RidgePixel { u, v, light });
        }
    }
    ridge
}

/// One stretch of dashes: where the geometry has it, and how far off that is.
#[derive(Debug, Clone, Copy)]
struct Seen {
    /// The terms of a, b and c: 1, the geometry's row, and 1 / distance.
    terms: Vector3<f64>,
    /// How much too large the geometry's row is, px, modulo the dashes' period.
    excess: f64,
}

/// Finds the panel's rows of the heads of `result`, which were adjusted as `heads`. A head whose dashes do not agree on
/// them keeps none.
pub(super) fn find_rows(
    result: &mut Calibration,
    nominal: &Calibration,
    heads: &[HeadResult],
    positions: &[Position],
) {
    let found: Vec<Option<PanelRows>> = heads
        .iter()
        .enumerate()
        .map(|(kept, adjusted)| {
            let head = result.heads.get(kept)?;
            let mut seen = Vec::new();
            let cameras = head.cameras.iter().zip(nominal.cameras_of(adjusted.head)).enumerate();
            for (number, (camera, view)) in cameras {
                let triangulator = Triangulator::new(CameraProjector::new(head, camera, result).ok()?);
                // Where the marker was misread, other fringes were taken for it.
                let is_misread =
                    |place: usize| adjusted.misread.iter().any(|m| (m.camera, m.position) == (number, place));
                let read = positions.iter().enumerate().filter(|(place, _)| !is_misread(*place));
                let views = read.filter_map(|(_, position)| position.views.get(view)?.as_ref());
                views.for_each(|view| see(view, &triangulator, &mut seen));
            }
            fit(&seen, result.pattern.marker_period_px, head.projector.height)
        })
        .collect();
    for (head, rows) in result.heads.iter_mut().zip(found) {
        head.rows = rows;
    }
}

/// The dashes of a view.
fn see(view: &View, triangulator: &Triangulator, seen: &mut Vec<Seen>) {
    let Some(phase) = &view.phase else { return };
    let period = triangulator.pair().pattern.marker_period_px;
    let crossing = |pixel: &RidgePixel| {
        let phase = f64::from(phase.plane.at(pixel.u, pixel.v));
        let (row, distance) = triangulator.panel_row(pixel.u, pixel.v, phase)?;
        Some(Crossing { v: pixel.v, row, distance, light: pixel.light })
    };
    let crossings: Vec<Crossing> = view.ridge.iter().filter_map(crossing).collect();
    for stretch in stretches_of(&crossings, period) {
        let Some(dashes) = Stretch::of(stretch, period).filter(Stretch::is_clear) else { continue };
        let Crossing { row, distance, .. } = stretch[stretch.len() / 2];
        let terms = Vector3::new(1.0, row, 1.0 / distance);
        seen.push(Seen { terms, excess: dashes.offset / TAU * period });
    }
}

/// The three numbers on which most of what was seen agrees.
fn fit(seen: &[Seen], period: f64, height: usize) -> Option<PanelRows> {
    if seen.len() < LEAST_STRETCHES {
        return None;
    }
    // The excess is known modulo the period. A trial is right when it leaves all stretches with one phase.
    let steps = |(n, step): (i32, f64)| (-n..=n).map(move |i| f64::from(i) * step);
    let mut best = (0.0, Vector3::zeros());
    for scale in steps(SCALES).map(|x| x / height.max(1) as f64) {
        for nearness in steps(NEARNESSES) {
            let tried = Vector3::new(0.0, scale, nearness);
            let sum = seen.iter().fold([0.0; 2], |[c, s], x| {
                let (sin, cos) = (TAU * (x.excess - x.terms.dot(&tried)) / period).sin_cos();
                [c + cos, s + sin]
            });
            let length = sum[0].hypot(sum[1]);
            if length > best.0 {
                let offset = sum[1].atan2(sum[0]) / TAU * period;
                best = (length, Vector3::new(offset, scale, nearness));
            }
        }
    }
    let mut excess = best.1;
    let left = |x: &Seen, excess: &Vector3<f64>| {
        let left = x.excess - x.terms.dot(excess);
        left - period * (left / period).round()
    };
    // Loosely known (20 px over the panel, 30 px m, against 0.1 px a stretch): where the board was at one distance
    // only, numbers must not run away.
    let prior =
        Matrix3::from_diagonal(&Vector3::new(1e-6, (height as f64 / 20.0).powi(2), 1.0 / 900.0)) * 0.01;
    for round in 0..ROUNDS {
        let near = if round == 0 { period / 2.0 } else { 2.0 * AGREE_PX };
        let (mut normal, mut right) = (prior, -(prior * excess));
        for x in seen.iter().filter(|x| left(x, &excess).abs() <= near) {
            normal += x.terms * x.terms.transpose();
            right += x.terms * left(x, &excess);
        }
        excess += normal.cholesky()?.solve(&right);
    }
    let agreeing: Vec<f64> =
        seen.iter().map(|x| left(x, &excess)).filter(|left| left.abs() <= AGREE_PX).collect();
    if (agreeing.len() as f64) < LEAST_AGREEING * seen.len() as f64 {
        return None;
    }
    let rms_px = (agreeing.iter().map(|x| x * x).sum::<f64>() / agreeing.len() as f64).sqrt();
    Some(PanelRows { excess: excess.into(), rms_px })
}

#[cfg(test)]
mod tests {
    use super::{Seen, fit};
    use crate::data::PanelRows;
    use nalgebra::Vector3;
    use proptest::prelude::{ProptestConfig, prop_assert, proptest};

    const PERIOD: f64 = 8.0;
    const HEIGHT: usize = 800;

    /// A number from -0.5 to 0.5 that depends on another alone.
    fn noise(i: usize) -> f64 {
        let mixed = (i as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        ((mixed ^ (mixed >> 29)).wrapping_mul(0xbf58_476d_1ce4_e5b9) >> 40) as f64 / (1u64 << 24) as f64 - 0.5
    }

    /// Stretches over the panel at six places of the board, of which one in ten is something else.
    fn seen(excess: [f64; 3], others: usize) -> Vec<Seen> {
        let stretch = |i: usize| {
            let (row, distance) = (40.0 + 720.0 * (i % 23) as f64 / 22.0, 1.7 + 0.2 * (i % 6) as f64);
            let terms = Vector3::new(1.0, row, 1.0 / distance);
            let is_other = i.is_multiple_of(others);
            let excess = terms.dot(&Vector3::from(excess)) + noise(i) * if is_other { PERIOD } else { 0.1 };
            Seen { terms, excess: excess - PERIOD * (excess / PERIOD).round() }
        };
        (1..=138).map(stretch).collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn rows_are_found_modulo_the_dashes_period(
            offset in -30.0f64..30.0, scale in -0.012f64..0.012, nearness in -26.0f64..26.0,
        ) {
            let excess = [offset, scale, nearness];
            let found = fit(&seen(excess, 10), PERIOD, HEIGHT).expect("they agree");
            let truth = PanelRows { excess, rms_px: 0.0 };
            prop_assert!(found.rms_px < 0.1, "{found:?}");
            for (row, distance) in [(100.0, 1.8), (400.0, 2.2), (700.0, 2.6)] {
                let off = found.of(row, distance) - truth.of(row, distance);
                let off = off - PERIOD * (off / PERIOD).round();
                prop_assert!(off.abs() < 0.1, "{off} px at row {row}, {distance} m: {found:?}");
            }
        }
    }

    #[test]
    fn rows_that_dashes_do_not_tell_are_not_known() {
        let excess = [1.0, 0.002, 3.0];
        assert_eq!(fit(&seen(excess, 2), PERIOD, HEIGHT), None, "half of them are something else");
        assert_eq!(fit(&seen(excess, 10)[..20], PERIOD, HEIGHT), None, "too few");
        assert_eq!(fit(&[], PERIOD, HEIGHT), None);
    }
}
