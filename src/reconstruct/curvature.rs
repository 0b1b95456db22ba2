//! Bias of the phase where the surface is curved within a window.
//!
//! The seven-point formula gives the mean phase over one period P, and the mean over rows that over some rows.
//! Where the phase bends, `phi'' != 0`, a mean is not the value in the middle. For `cos(phi + 2 pi x / P + phi''
//! x^2 / 2)` the formula is off by `phi'' P^2 / 4 (0.176 - 0.037 cos 2 phi)` to first order, the mean of n rows
//! by `phi_vv (n^2 - 1) / 24`: on a fore-arm 0.1 mm, the larger part of the error that is left there. Both second
//! derivatives are taken from the absolute phase itself over a wider base and the bias is taken off.

use super::demodulate::Phasors;
use super::simd;
use super::support::{Support, known_part};
use crate::image::Plane;
use std::cell::RefCell;

/// Mean and ripple of the formula's bias, per second difference over half a period to each side.
const MEAN: f32 = 0.176;
const RIPPLE: f32 = 0.037;

/// Bends per half period beyond this are steps between surfaces, rad.
const MAX_BEND: f32 = 0.8;

/// Pixels of more misfit than this are no support: their phase is biased by something else.
const MAX_MISFIT: f32 = 0.15;

/// Second differences up to this, rad DN, divided by the amplitude, are noise: what is above counts. Otherwise
/// planes would be rougher by a tenth.
const NOISE_RAD_DN: f32 = 1.0;

/// Rows to each side over which the second difference along the column is taken, and its largest value, rad.
const REACH_ROWS: usize = 6;
const MAX_BEND_ROWS: f32 = 1.0;

/// Columns beyond the ends of a row that may be asked for; no period is longer.
const PAD: usize = 64;

thread_local! {
    static SUPPORT: RefCell<Support> = RefCell::default();
}

/// Takes the bias off `absolute` (NaN: unknown). Phasors are means of `rows` rows, of `marker_rows` where `zone`
/// is not zero.
pub fn correct(
    absolute: &mut Plane<f32>,
    phasors: &Phasors,
    period: &Plane<f32>,
    zone: &Plane<u8>,
    (rows, marker_rows): (f32, f32),
) {
    let per_bend = |rows: f32| (rows * rows - 1.0) / 24.0 / (REACH_ROWS * REACH_ROWS) as f32;
    let weight = [per_bend(rows), per_bend(marker_rows)];
    SUPPORT.with_borrow_mut(|support| {
        simd::dispatch(
            #[inline(always)]
            || {
                support.begin(absolute, REACH_ROWS, PAD);
                for v in 0..absolute.height() {
                    // What may support: the phase where it is known and looks like a fringe.
                    support.advance(v, absolute, |v, u| !(phasors.misfit.row(v)[u] > MAX_MISFIT));
                    let phase = absolute.row_mut(v);
                    let part = known_part(phase);
                    let (first, end) = (part.start, part.end);
                    correct_row(
                        &mut phase[part.clone()],
                        [0, REACH_ROWS, 2 * REACH_ROWS]
                            .map(|below| &support.row(v, below)[first..end + 2 * PAD]),
                        [phasors.c.row(v), phasors.s.row(v), period.row(v)].map(|row| &row[part.clone()]),
                        &zone.row(v)[part.clone()],
                        weight,
                    );
                }
            },
        );
    });
}

/// Takes the bias off a stretch of a row. `support`: that of the rows above, here and below, which begin [`PAD`]
/// columns before it.
#[inline(always)]
fn correct_row(
    phase: &mut [f32],
    support: [&[f32]; 3],
    [c, s, period]: [&[f32]; 3],
    zone: &[u8],
    weight: [f32; 2],
) {
    const LANES: usize = 16;
    let [above, row, below] = support;
    for at in (0..phase.len()).step_by(LANES) {
        let count = LANES.min(phase.len() - at);
        let lanes = |from: &[f32]| {
            let mut to = [0f32; LANES];
            to[..count].copy_from_slice(&from[at..at + count]);
            to
        };
        let (x, c, s, period) = (lanes(phase), lanes(c), lanes(s), lanes(period));
        let (above, below) = (lanes(&above[PAD..]), lanes(&below[PAD..]));
        let (mut wide, mut stretch, mut marked) = ([0f32; LANES], [0f32; LANES], [0f32; LANES]);
        for i in 0..count {
            // The slope along the row has no part in a difference to both sides: whole columns do.
            let k = columns(period[i]);
            wide[i] = row[at + i + PAD - k] - 2.0 * x[i] + row[at + i + PAD + k];
            stretch[i] = period[i] / k as f32;
            marked[i] = f32::from(u8::from(zone[at + i] != 0));
        }
        let mut bias = [0f32; LANES];
        let mut steep = false;
        for i in 0..LANES {
            let power = c[i] * c[i] + s[i] * s[i];
            let noise = 6.0 * NOISE_RAD_DN / power.sqrt().max(3.0);
            // cos 2 phi = cos^2 - sin^2.
            let per_bend = MEAN - RIPPLE * (c[i] * c[i] - s[i] * s[i]) / power.max(1.0);
            let smooth = wide[i].abs() < 4.0 * MAX_BEND;
            let bend = if smooth { shrunk(wide[i] * stretch[i] * stretch[i], noise) / 4.0 } else { 0.0 };
            let along = above[i] - 2.0 * x[i] + below[i];
            let factor = weight[0] + marked[i] * (weight[1] - weight[0]);
            let along = if along.abs() < MAX_BEND_ROWS { factor * shrunk(along, noise) } else { 0.0 };
            bias[i] = per_bend * bend + along;
            steep |= !smooth & !x[i].is_nan();
        }
        if steep {
            for i in (0..count).filter(|&i| !x[i].is_nan() && !(wide[i].abs() < 4.0 * MAX_BEND)) {
                let power = c[i] * c[i] + s[i] * s[i];
                let noise = 6.0 * NOISE_RAD_DN / power.sqrt().max(3.0);
                let per_bend = MEAN - RIPPLE * (c[i] * c[i] - s[i] * s[i]) / power.max(1.0);
                bias[i] += per_bend * bend_beside(row, at + i + PAD, x[i], period[i], noise);
            }
        }
        for (x, bias) in phase[at..at + count].iter_mut().zip(bias) {
            *x -= bias;
        }
    }
}

/// A period in whole columns.
#[inline(always)]
fn columns(period: f32) -> usize {
    // Not 0 for NaN or nothing, either.
    ((period + 0.5) as usize).clamp(1, PAD)
}

/// Second difference of the phase over half a period to each side, less the noise, where that over a whole one is of
/// no use: measured over half a period, else beside the pixel; 0 where it is not known.
fn bend_beside(row: &[f32], at: usize, phase: f32, period: f32, noise: f32) -> f32 {
    let half = columns(period / 2.0).min(PAD / 2);
    let stretch = period / 2.0 / half as f32;
    let x = [at - 2 * half, at - half, at + half, at + 2 * half].map(|at| row[at]);
    let bends = [x[1] - 2.0 * phase + x[2], phase - 2.0 * x[2] + x[3], phase - 2.0 * x[1] + x[0]];
    let bend = bends.into_iter().map(|bend| bend * stretch * stretch).find(|bend| bend.abs() < MAX_BEND);
    bend.map_or(0.0, |bend| shrunk(bend, noise))
}

/// `x` nearer to 0 by `noise`.
#[inline(always)]
fn shrunk(x: f32, noise: f32) -> f32 {
    (x.abs() - noise).max(0.0).copysign(x)
}

#[cfg(test)]
mod tests {
    use super::correct;
    use crate::image::{Mono8, Plane};
    use crate::reconstruct::demodulate::{Gains, ROWS, average_rows, demodulate, wrapped};
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
        correct(&mut absolute, &phasors, &period, &none, (ROWS as f32, 12.0));
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
