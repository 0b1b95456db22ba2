// SPDX-License-Identifier: MIT OR Apache-2.0
//! Bias of the phase where the surface is curved within a window.
//!
//! The seven-point formula gives the mean phase over one period P, and the mean over rows that over some rows.
//! Where the phase bends, `phi'' != 0`, a mean is not the value in the middle. For `cos(phi + 2 pi x / P + phi''
//! x^2 / 2)` the formula is off by `phi'' P^2 / 4 (0.176 - 0.037 cos 2 phi)` to first order, the mean of n rows
//! by `phi_vv (n^2 - 1) / 24`: on a fore-arm 0.1 mm, the larger part of the error that is left there. Both second
//! derivatives are taken from the absolute phase itself over a wider base and the bias is taken off.

use super::FrameMaps;
use crate::base::image::Plane;
use crate::kernels::fast_round::whole;
use crate::kernels::pixel_runs::Run;
use crate::kernels::row_support::Support;
use crate::kernels::subpixel::{self, LANES, Lanes};
use crate::kernels::{fast_atan2, simd};
use crate::phase::window_quality::{self, LEAST_AMPLITUDE_DN};

/// Mean of the formula's bias, per second difference over half a period to each side.
const MEAN: f32 = 0.176;

/// Ripple of that bias with `cos 2 phi`.
const RIPPLE: f32 = 0.037;

/// Bends per half period beyond this are steps between surfaces, rad.
const MAX_BEND: f32 = 0.8;

/// Pixels of more misfit than this are no support: their phase is biased by something else.
const MAX_MISFIT: f32 = 0.15;

/// Second differences up to this, rad DN, divided by the amplitude, are noise: what is above counts. Otherwise
/// planes would be rougher by a tenth.
const NOISE_RAD_DN: f32 = 1.0;

/// Rows to each side over which the second difference along the column is taken.
const REACH_ROWS: usize = 6;

/// Second differences along the column beyond this are steps between surfaces, rad.
const MAX_BEND_ROWS: f32 = 1.0;

/// Columns beyond the ends of a row that can be read; no period is longer.
const PAD: usize = 64;

/// Takes the bias off `absolute`, which is known within `runs` only (NaN: unknown). Phases are means of `rows` rows, of
/// `marker_rows` where `zone` is not zero.
pub fn correct(
    absolute: &mut Plane<f32>,
    FrameMaps { runs, windows, period, zone, .. }: FrameMaps<'_>,
    (rows, marker_rows): (f32, f32),
) {
    let per_bend = |rows: f32| (rows * rows - 1.0) / 24.0 / (REACH_ROWS * REACH_ROWS) as f32;
    let weight = [per_bend(rows), per_bend(marker_rows)];
    let reach = REACH_ROWS;
    let mut support = Support::default();
    simd::dispatch(
        #[inline(always)]
        || {
            support.begin(absolute, reach, PAD);
            for v in 0..absolute.height() {
                // What may support: the phase where it is known and looks like a fringe.
                support.advance(
                    v,
                    absolute,
                    runs,
                    #[inline(always)]
                    |v, run, phase, to| {
                        let misfit = &windows.misfit.row(v)[run.columns()];
                        for ((to, &phase), &misfit) in to.iter_mut().zip(phase).zip(misfit) {
                            *to = if misfit > MAX_MISFIT { f32::NAN } else { phase };
                        }
                    },
                );
                let rows = (windows.strength.row(v), period.row(v));
                let support = [0, reach, 2 * reach].map(|below| support.row(v, below));
                for run in runs.row(v) {
                    correct_run(absolute.row_mut(v), run, support, rows, zone.row(v), weight);
                }
            }
        },
    );
}

/// Takes the bias off a run. `support`: that of the rows above, here and below, with [`PAD`] columns before them.
#[inline(always)]
fn correct_run(
    phase: &mut [f32],
    run: &Run,
    [above, row, below]: [&[f32]; 3],
    (strength, period): (&[u16], &[f32]),
    zone: &[u8],
    weight: [f32; 2],
) {
    for first in run.columns().step_by(LANES) {
        let count = LANES.min(run.end() - first);
        let x = subpixel::load(phase, first);
        let (strength, period) = (subpixel::load(strength, first), subpixel::load(period, first));
        let (above, below) = (subpixel::load(above, first + PAD), subpixel::load(below, first + PAD));
        let marked = subpixel::load(zone, first);
        // A second difference does not contain the slope, so that distances in whole columns suffice.
        let k = all_columns(&period, count);
        let Beside { before, behind, share } = beside(row, first + PAD, &k, 1);
        let (mut wide, mut bias) = ([0f32; LANES], [0f32; LANES]);
        let (mut noises, mut per_bends) = ([0f32; LANES], [0f32; LANES]);
        let mut steep = 0u32;
        for i in 0..LANES {
            wide[i] = before[i] - 2.0 * x[i] + behind[i];
            let stretch = period[i] * share[i];
            let (noise, per_bend) = noise_and_bias(strength[i], x[i]);
            let smooth = wide[i].abs() < 4.0 * MAX_BEND;
            let bend = if smooth { shrunk(wide[i] * stretch * stretch, noise) / 4.0 } else { 0.0 };
            let along = above[i] - 2.0 * x[i] + below[i];
            let factor = if marked[i] != 0 { weight[1] } else { weight[0] };
            let along = if along.abs() < MAX_BEND_ROWS { factor * shrunk(along, noise) } else { 0.0 };
            bias[i] = per_bend * bend + along;
            (noises[i], per_bends[i]) = (noise, per_bend);
            steep |= u32::from(!smooth & !x[i].is_nan());
        }
        if steep != 0 {
            let bends = bends_beside(row, first + PAD, &x, &period, count);
            for i in 0..LANES {
                let with_bend = bias[i] + per_bends[i] * shrunk(bends[i], noises[i]);
                bias[i] = if wide[i].abs() < 4.0 * MAX_BEND { bias[i] } else { with_bend };
            }
        }
        let mut out = [0f32; LANES];
        for i in 0..LANES {
            out[i] = x[i] - bias[i];
        }
        subpixel::store(phase, first, count, &out);
    }
}

/// Noise of a phase, rad, and the formula's bias per bend.
#[inline(always)]
fn noise_and_bias(strength: u16, phase: f32) -> (f32, f32) {
    let amplitude = window_quality::amplitude(strength);
    let noise = NOISE_RAD_DN / if amplitude < LEAST_AMPLITUDE_DN { LEAST_AMPLITUDE_DN } else { amplitude };
    (noise, MEAN - RIPPLE * fast_atan2::cos_of_double(phase))
}

/// What lies some columns before and behind each pixel of a block.
struct Beside {
    before: Lanes,
    behind: Lanes,
    /// One over the number of these columns.
    share: Lanes,
}

/// The values `times` times `k` columns before and behind each pixel of a block.
#[inline(always)]
fn beside(row: &[f32], first: usize, k: &[u32; LANES], times: usize) -> Beside {
    // A bit for each number there is: most blocks have one or two, and hardly any more than four.
    let mut numbers = 0u64;
    for &k in k {
        numbers |= 1 << (k - 1);
    }
    let least = numbers.trailing_zeros() + 1;
    let at = least as usize * times;
    let mut before = subpixel::load(row, first - at);
    let mut behind = subpixel::load(row, first + at);
    let mut share = [1.0 / least as f32; LANES];
    numbers &= numbers - 1;
    while numbers != 0 {
        let number = numbers.trailing_zeros() + 1;
        numbers &= numbers - 1;
        let at = number as usize * times;
        let other = (subpixel::load(row, first - at), subpixel::load(row, first + at));
        let other_share = 1.0 / number as f32;
        for i in 0..LANES {
            let is_other = if k[i] == number { u32::MAX } else { 0 };
            before[i] = subpixel::choose(before[i], other.0[i], is_other);
            behind[i] = subpixel::choose(behind[i], other.1[i], is_other);
            share[i] = subpixel::choose(share[i], other_share, is_other);
        }
    }
    Beside { before, behind, share }
}

/// The first `count` periods of a block in whole columns. Lanes behind them belong to no pixel; they repeat the first
/// one.
#[inline(always)]
fn all_columns(period: &Lanes, count: usize) -> [u32; LANES] {
    let (first, count) = (period[0], count as i32);
    let mut k = [0u32; LANES];
    for i in 0..LANES {
        k[i] = columns(if (i as i32) < count { period[i] } else { first }) as u32;
    }
    k
}

/// A period in whole columns.
#[inline(always)]
fn columns(period: f32) -> i32 {
    // At least 1, also for NaN and for an unknown period.
    let period = if period > 1.0 { period } else { 1.0 };
    let period = if period < PAD as f32 { period } else { PAD as f32 };
    whole(period)
}

/// Second differences of the phase over half a period to each side, for where that over a whole one is of no use:
/// measured over half a period, else beside the pixel; 0 where it is not known.
#[inline(always)]
fn bends_beside(row: &[f32], first: usize, phase: &Lanes, period: &Lanes, count: usize) -> Lanes {
    let mut half = *period;
    for half in &mut half {
        *half = (*half / 2.0).min(PAD as f32 / 2.0);
    }
    let half = all_columns(&half, count);
    let (near, far) = (beside(row, first, &half, 1), beside(row, first, &half, 2));
    let mut bends = [0f32; LANES];
    for i in 0..LANES {
        let stretch = period[i] / 2.0 / half[i] as f32;
        let middle = near.before[i] - 2.0 * phase[i] + near.behind[i];
        let behind = phase[i] - 2.0 * near.behind[i] + far.behind[i];
        let before = phase[i] - 2.0 * near.before[i] + far.before[i];
        let (middle, behind, before) =
            (middle * stretch * stretch, behind * stretch * stretch, before * stretch * stretch);
        let bend = if before.abs() < MAX_BEND { before } else { 0.0 };
        let bend = if behind.abs() < MAX_BEND { behind } else { bend };
        bends[i] = if middle.abs() < MAX_BEND { middle } else { bend };
    }
    bends
}

/// `x` moved towards 0 by `noise`, but not beyond.
#[inline(always)]
fn shrunk(x: f32, noise: f32) -> f32 {
    (x.abs() - noise).max(0.0).copysign(x)
}

#[cfg(test)]
mod tests {
    use super::{FrameMaps, correct};
    use crate::base::image::{Mono8, Plane};
    use crate::kernels::pixel_runs::Runs;
    use crate::phase::demodulate::{Gains, ROWS};
    use crate::phase::for_tests::{average_rows, demodulate, windows, wrapped};
    use std::f32::consts::TAU;

    const W: usize = 160;
    const H: usize = 40;

    /// RMS error, rad, in the middle of an image whose phase is `phase`, as it is and corrected.
    fn errors(phase: impl Fn(f32, f32) -> f32) -> [f32; 2] {
        let at = |u: usize, v: usize| phase(u as f32 - 80.0, v as f32 - 20.0);
        let mut image = Plane::filled(W, H, 0u8);
        let mut period = Plane::filled(W, H, 0f32);
        for v in 0..H {
            for u in 0..W {
                image.set(u, v, (120.0 + 100.0 * at(u, v).cos()).round() as u8);
                period.set(u, v, 2.0 * TAU / (at(u + 1, v) - phase(u as f32 - 81.0, v as f32 - 20.0)));
            }
        }
        let none = Plane::filled(W, H, 0u8);
        let mask = Plane::filled(W, H, 1u8);
        let mut phasors = demodulate(Mono8::from(&image), &mask, &period, &Gains::new(), 1.0);
        average_rows(&mut phasors, &none);
        let mut absolute = wrapped(&phasors);
        for v in 0..H {
            for (u, x) in absolute.row_mut(v).iter_mut().enumerate() {
                *x += TAU * ((at(u, v) - *x) / TAU).round();
            }
        }
        let rms = |found: &Plane<f32>| {
            let squares = (12..28).flat_map(|v| (40..120).map(move |u| (u, v)));
            let squares = squares.map(|(u, v)| (found.at(u, v) - at(u, v)).powi(2));
            (squares.sum::<f32>() / 1280.0).sqrt()
        };
        let before = rms(&absolute);
        let runs = Runs::of(&mask);
        let windows = windows(phasors, &runs);
        let maps = FrameMaps { runs: &runs, windows: &windows, period: &period, zone: &none, sign: 1.0 };
        correct(&mut absolute, maps, (ROWS as f32, 12.0));
        [before, rms(&absolute)]
    }

    #[test]
    fn the_bias_of_a_bent_phase_goes() {
        // A fore-arm: the period falls from 14 to 9 px over 80 columns; along the rows it bends as much.
        let bent = |u: f32, v: f32| TAU * u / 11.0 + 0.0015 * u * u + 0.004 * v * v;
        let [before, after] = errors(bent);
        assert!(before > 0.018 && after < 0.006, "{before} {after}");
        let [before, after] = errors(|u, v| TAU * u / 11.0 + 0.05 * v);
        assert!(before < 0.004 && after < 0.004, "{before} {after}");
    }
}
