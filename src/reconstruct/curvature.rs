//! Bias of the phase where the surface is curved within a window.
//!
//! The seven-point formula gives the mean phase over one period P, and the mean over rows that over some rows.
//! Where the phase bends, `phi'' != 0`, a mean is not the value in the middle. For `cos(phi + 2 pi x / P + phi''
//! x^2 / 2)` the formula is off by `phi'' P^2 / 4 (0.176 - 0.037 cos 2 phi)` to first order, the mean of n rows
//! by `phi_vv (n^2 - 1) / 24`: on a fore-arm 0.1 mm, the larger part of the error that is left there. Both second
//! derivatives are taken from the absolute phase itself over a wider base and the bias is taken off.

use super::demodulate::Phasors;
use crate::image::Plane;

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

/// Takes the bias off `absolute` (NaN: unknown). Phasors are means of `rows` rows, of `marker_rows` where `zone`
/// is not zero.
pub fn correct(
    absolute: &mut Plane<f32>,
    phasors: &Phasors,
    period: &Plane<f32>,
    zone: &Plane<u8>,
    (rows, marker_rows): (f32, f32),
) {
    // What may support: the phase where it is known and looks like a fringe.
    let mut support = absolute.clone();
    for (x, misfit) in support.as_mut_slice().iter_mut().zip(phasors.misfit.as_slice()) {
        if *misfit > MAX_MISFIT {
            *x = f32::NAN;
        }
    }
    let per_bend = |rows: f32| (rows * rows - 1.0) / 24.0 / (REACH_ROWS * REACH_ROWS) as f32;
    let weight = [per_bend(rows), per_bend(marker_rows)];
    for v in 0..absolute.height() {
        let row = support.row(v);
        let above = v.checked_sub(REACH_ROWS).map(|above| support.row(above));
        let below = (v + REACH_ROWS < support.height()).then(|| support.row(v + REACH_ROWS));
        let columns = above.zip(below);
        let (c, s) = (phasors.c.row(v), phasors.s.row(v));
        let (period, zone) = (period.row(v), zone.row(v));
        for (u, phase) in absolute.row_mut(v).iter_mut().enumerate() {
            if phase.is_nan() {
                continue;
            }
            let power = c[u] * c[u] + s[u] * s[u];
            let noise = 6.0 * NOISE_RAD_DN / power.sqrt().max(3.0);
            // cos 2 phi = cos^2 - sin^2.
            let per_bend = MEAN - RIPPLE * (c[u] * c[u] - s[u] * s[u]) / power.max(1.0);
            let mut bias = per_bend * bend_across(row, u, *phase, period[u], noise);
            if let Some((above, below)) = columns {
                let bend = above[u] - 2.0 * *phase + below[u];
                if bend.abs() < MAX_BEND_ROWS {
                    bias += weight[usize::from(zone[u] != 0)] * shrunk(bend, noise);
                }
            }
            *phase -= bias;
        }
    }
}

/// Second difference of the phase over half a period to each side, less the noise: measured over a whole period
/// where that is possible, else over half a period, else beside the pixel; 0 where it is not known.
fn bend_across(row: &[f32], u: usize, phase: f32, period: f32, noise: f32) -> f32 {
    let at = |x: f32| phase_at(row, u as f32 + x);
    let far = (at(-period), at(period));
    let wide = far.0 - 2.0 * phase + far.1;
    if wide.abs() < 4.0 * MAX_BEND {
        return shrunk(wide, noise) / 4.0;
    }
    let near = (at(-period / 2.0), at(period / 2.0));
    let narrow = [near.0 - 2.0 * phase + near.1, phase - 2.0 * near.1 + far.1, phase - 2.0 * near.0 + far.0];
    narrow.into_iter().find(|bend| bend.abs() < MAX_BEND).map_or(0.0, |bend| shrunk(bend, noise))
}

/// Phase at column `x`, interpolated; NaN where one of its neighbours is unknown.
fn phase_at(row: &[f32], x: f32) -> f32 {
    if x < 0.0 {
        return f32::NAN;
    }
    let i = x as usize;
    match (row.get(i), row.get(i + 1)) {
        (Some(a), Some(b)) => a + (x - i as f32) * (b - a),
        _ => f32::NAN,
    }
}

/// `x` nearer to 0 by `noise`.
fn shrunk(x: f32, noise: f32) -> f32 {
    x.signum() * (x.abs() - noise).max(0.0)
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
