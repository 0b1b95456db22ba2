//! Absolute phase Fm: which of the unwrapped pixels are good enough to become points.
//!
//! A demodulation window that crosses a depth step mixes two surfaces; its phase is neither's. Such pixels are
//! dropped with a margin: completeness may suffer, truth may not.

use super::demodulate::Phasors;
use crate::image::Plane;
use std::f32::consts::TAU;

/// Settings of the selection.
#[derive(Debug, Clone, Copy)]
pub struct Settings {
    /// Neighbours whose absolute phases differ by more than the carrier and this are on a step, rad.
    pub step_rad: f32,
    /// Least fringe amplitude, DN.
    pub min_amplitude: f32,
    /// Largest misfit of the fringe model (see [`Phasors::misfit`]).
    pub max_misfit: f32,
    /// Rows beside a step that are dropped with it.
    pub step_rows: usize,
}

impl Default for Settings {
    fn default() -> Self {
        Self { step_rad: 1.2, min_amplitude: 1.5, max_misfit: 0.6, step_rows: 1 }
    }
}

/// Drops pixels that are faint, do not look like a fringe, or lie near a depth step; `absolute` becomes NaN
/// there. Returns how many were dropped.
pub fn select(
    absolute: &mut Plane<f32>,
    period: &Plane<f32>,
    phasors: &Phasors,
    sign: f32,
    settings: &Settings,
) -> usize {
    let near_step = steps(absolute, period, sign, settings);
    let (c, s, misfit) = (phasors.c.as_slice(), phasors.s.as_slice(), phasors.misfit.as_slice());
    let least = 6.0 * settings.min_amplitude;
    let mut dropped = 0;
    for (i, phase) in absolute.as_mut_slice().iter_mut().enumerate() {
        let good = c[i] * c[i] + s[i] * s[i] >= least * least
            && misfit[i] <= settings.max_misfit
            && near_step.as_slice()[i] == 0;
        if !good && !phase.is_nan() {
            *phase = f32::NAN;
            dropped += 1;
        }
    }
    dropped
}

/// 1 within half a period along the row, or some rows, of a pair of neighbours on different surfaces.
fn steps(absolute: &Plane<f32>, period: &Plane<f32>, sign: f32, settings: &Settings) -> Plane<u8> {
    let (w, h) = (absolute.width(), absolute.height());
    let mut near = Plane::filled(w, h, 0u8);
    let mut mark = |u: usize, v: usize| {
        let reach = (period.at(u, v) / 2.0).ceil() as usize;
        for row in v.saturating_sub(settings.step_rows)..(v + settings.step_rows + 1).min(h) {
            near.row_mut(row)[u.saturating_sub(reach)..(u + reach + 1).min(w)].fill(1);
        }
    };
    for v in 0..h {
        let (row, p) = (absolute.row(v), period.row(v));
        for u in 0..w.saturating_sub(1) {
            let carrier = sign * 2.0 * TAU / (p[u] + p[u + 1]);
            if (row[u + 1] - row[u] - carrier).abs() > settings.step_rad {
                mark(u, v);
                mark(u + 1, v);
            }
        }
        if v + 1 < h {
            for (u, (a, b)) in row.iter().zip(absolute.row(v + 1)).enumerate() {
                if (b - a).abs() > settings.step_rad {
                    mark(u, v);
                    mark(u, v + 1);
                }
            }
        }
    }
    near
}

/// Equation 5: the whole turns, in rad, that bring the marker's median phase to fringe `marker_index`.
pub fn shift_of_median(median: f32, marker_index: u32) -> f32 {
    TAU * (marker_index as f32 - ((median + TAU / 2.0) / TAU).floor())
}

#[cfg(test)]
mod tests {
    use super::shift_of_median;
    use proptest::prelude::{prop_assert, proptest};
    use std::f32::consts::{FRAC_PI_2, PI, TAU};

    proptest! {
        #[test]
        fn equation_5_puts_the_marker_where_it_belongs(order in -40i32..40, core in -FRAC_PI_2..FRAC_PI_2) {
            let median = TAU * order as f32 + core;
            let absolute = median + shift_of_median(median, 80);
            prop_assert!((absolute - TAU * 80.0).abs() < PI, "{absolute}");
        }
    }
}
