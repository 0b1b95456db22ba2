// SPDX-License-Identifier: MIT OR Apache-2.0
//! Bias of the seven-point formula where the reflected light changes across the fringes.
//!
//! On a body the light falls off towards every outline, so that over one period P it is not constant. For
//! `I(x) = (1 + q x / P) (a + b cos(phi + 2 pi x / P))`, where `q` is the relative change over one period, the
//! sums of [`super::demodulate`] become, to first order in `q`,
//!
//! ```text
//! S = 6 b sin phi - q (2 / sqrt(3) a + sqrt(3) / 6 b cos phi)
//! C = 6 b cos phi + q sqrt(3) / 6 b sin phi
//! ```
//!
//! which is up to `0.24 q` rad: on a fore-arm tenths of a millimetre. `q` is known from the light of the windows
//! half a period before and after, whose ripple with the phase is in step and cancels; so the bias is taken off.
//!
//! A step of colour is no gradient. Where only one of the two neighbouring windows crosses a step, the pixel's own
//! does not: the limiter of [`slope`] then finds nothing to correct. Where its own does, the first order is not
//! enough: the misfit of the fringe model is large, and [`crate::refine::albedo_edges`] corrects or drops the pixel.

use crate::kernels::pixel_runs::Run;
use crate::kernels::subpixel::{self, LANES, Lanes, PAD, Periods};
use std::ops::Range;

/// `2 / sqrt(3)`: what a gradient of the light adds to S, per mean light.
const FROM_MEAN: f32 = 1.154_700_5;

/// `sqrt(3) / 36`: by how much a gradient turns (C, S), rad.
const TURN: f32 = 0.048_112_52;

/// The mean of seven samples ripples with the phase by this share of `q b sin phi`, oppositely in windows half a
/// period apart; relative to `q / 2`.
const RIPPLE: f32 = 0.468;

/// The limiter: the slope is at most this many times the smaller of the two one-sided ones ..
const MAX_STEEPENING: f32 = 4.0;

/// .. and what noise and ripple leave of it, relative to the light.
const SLOPE_FLOOR: f32 = 0.02;

/// Steeper light than this (relative change over a period) is not corrected further.
const MAX_CHANGE: f32 = 1.0;

/// Memory for the light of a row whose runs span these columns: nowhere known yet.
#[inline(always)]
pub(crate) fn clear_light(light: &mut Vec<f32>, width: usize, span: Range<usize>) {
    subpixel::reserve(light, width);
    light[span.start..span.end + 2 * PAD + LANES].fill(f32::NAN);
}

/// Keeps a block's mean light for [`correct_row`], which must not use it where it is not positive: there it is unknown.
#[inline(always)]
pub(crate) fn keep_light(light: &mut [f32], first: usize, mean: &Lanes) {
    let mut known = [f32::NAN; LANES];
    for i in 0..LANES {
        known[i] = if mean[i] > 0.0 { mean[i] } else { f32::NAN };
    }
    subpixel::put(light, PAD + first, &known);
}

/// Forgets the light of some columns: where the marker changes it, it is not used.
#[inline(always)]
pub(crate) fn skip_light(light: &mut [f32], columns: Range<usize>) {
    light[PAD + columns.start..PAD + columns.end].fill(f32::NAN);
}

/// Takes the first-order bias off the phasors of a row's runs but those whose `light` is not known. `sign` is that of
/// the phase along the columns. All rows have room for a block behind their ends.
#[inline(always)]
pub(crate) fn correct_row(
    [c, s]: [&[f32]; 2],
    light: &[f32],
    period: &[f32],
    runs: &[Run],
    sign: f32,
    [out_c, out_s]: [&mut [f32]; 2],
) {
    for run in runs {
        for first in run.columns().step_by(LANES) {
            let period = subpixel::load(period, first);
            let phasor = [subpixel::chunk(c, first), subpixel::chunk(s, first)];
            let block = correct_block(phasor, light, first, &period, sign);
            subpixel::put(out_c, first, &block[0]);
            subpixel::put(out_s, first, &block[1]);
        }
    }
}

/// C and S of a block without the bias. `light` is NaN where it is not known or must not be used.
#[inline(always)]
fn correct_block([c, s]: [&Lanes; 2], light: &[f32], first: usize, period: &Lanes, sign: f32) -> [Lanes; 2] {
    let periods = Periods::new(period);
    let after = subpixel::between(light, first, &periods, 0.5, 0.0);
    let before = subpixel::between(light, first, &periods, -0.5, 0.0);
    let light: &Lanes = subpixel::chunk(&light[PAD..], first);
    let mut out = [[0f32; LANES]; 2];
    for i in 0..LANES {
        // The formula's own S: the phasor's imaginary part carries the sign of the phase.
        let [cos, sin] = correct_one(c[i], s[i] * sign, [before[i], light[i], after[i]]);
        out[0][i] = cos;
        out[1][i] = sign * sin;
    }
    out
}

/// C and S (the formula's own, of a phase that grows with the column) without the bias, from the light half a period
/// before, here, and behind; NaN where it is unknown.
#[inline(always)]
pub(crate) fn correct_one(cos: f32, sin: f32, [before, light, after]: [f32; 3]) -> [f32; 2] {
    let per_light = 1.0 / light;
    let ripple = (RIPPLE / 6.0 * sin * per_light).clamp(-RIPPLE, RIPPLE);
    // One quotient for both sides: over `1 + ripple` and over `1 - ripple`.
    let scale = 1.0 / (1.0 - ripple * ripple);
    let after = (after - light) * ((1.0 - ripple) * scale);
    let before = (light - before) * ((1.0 + ripple) * scale);
    let change = slope(before, after, SLOPE_FLOOR * light);
    let q = (change * per_light).clamp(-MAX_CHANGE, MAX_CHANGE);
    // NaN: its light is unknown, or that on both sides.
    let known = !q.is_nan();
    [
        if known { cos - q * TURN * sin } else { cos },
        if known { sin + q * (FROM_MEAN * light + TURN * cos) } else { sin },
    ]
}

/// Change over one period from the changes over the half periods before and after. Their sum, but limited by the
/// smaller one: a step of colour that only one of them has seen is not in the pixel's own window. Where there is
/// only one (the other is NaN), twice that; NaN where there is none.
#[inline(always)]
fn slope(before: f32, after: f32, floor: f32) -> f32 {
    let sum = before + after;
    let (low, high) = if before < after { (before, after) } else { (after, before) };
    let smaller = if sum < 0.0 { -high } else { low };
    let steepened = MAX_STEEPENING * smaller;
    let limit = if steepened > 0.0 { steepened } else { 0.0 } + floor;
    let limited = if sum > limit { limit } else { sum };
    let limited = if limited < -limit { -limit } else { limited };
    if before.is_nan() {
        2.0 * after
    } else if after.is_nan() {
        2.0 * before
    } else {
        limited
    }
}

#[cfg(test)]
mod tests {
    use super::slope;
    use crate::base::image::{Mono8, Plane};
    use crate::phase::demodulate::Gains;
    use crate::phase::for_tests::{Phasors, correct_shading, demodulate, wrapped};
    use proptest::prelude::{ProptestConfig, prop_assert, proptest};
    use std::f32::consts::TAU;

    const WIDTH: usize = 120;

    /// Largest error of the wrapped phase within `columns`, rad, as it is and corrected, of a fringe under
    /// `light(column)`.
    fn worst(
        period: f32,
        sign: f32,
        columns: std::ops::Range<usize>,
        light: impl Fn(f32) -> f32,
    ) -> [f32; 2] {
        let phase = |u: usize| sign * TAU * u as f32 / period;
        let mut image = Plane::filled(WIDTH, 1, 0u8);
        for u in 0..WIDTH {
            let value = light(u as f32) * (0.55 + 0.45 * phase(u).cos());
            image.set(u, 0, value.round().clamp(0.0, 255.0) as u8);
        }
        let (mask, periods) = (Plane::filled(WIDTH, 1, 1u8), Plane::filled(WIDTH, 1, period));
        let mut phasors = demodulate(Mono8::from(&image), &mask, &periods, &Gains::new(), sign);
        let error = |found: &Plane<f32>| {
            let off = |u: usize| (found.at(u, 0) - phase(u)).sin().abs();
            columns.clone().map(off).fold(0.0, f32::max)
        };
        let before = error(&wrapped(&phasors));
        correct_shading(&mut phasors, &periods, &Plane::filled(WIDTH, 1, 0), sign);
        [before, error(&wrapped(&phasors))]
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn a_gradient_of_light_costs_little(
            period in 7.0f32..16.0,
            change in 0.18f32..0.35,
            up in proptest::bool::ANY,
            rising in proptest::bool::ANY,
        ) {
            let (sign, change) = (if up { 1.0 } else { -1.0 }, if rising { change } else { -change });
            let light = |u: f32| 110.0 * (change * (u - 60.0) / period).exp().clamp(0.3, 2.0);
            let [before, after] = worst(period, sign, 50..70, light);
            // Rounding and interpolation leave up to 0.02 rad to one row, half of what 0.16 costs; from 0.18 on,
            // 600,000 cases keep these bounds (the worst that was seen: 0.49 of before, 0.0314 rad, 0.044 rad before).
            prop_assert!(before > 0.04 && after < 0.5 * before && after < 0.032, "{before} {after}");
        }
    }

    /// One pixel by the definition: the light half a period to each side, each side that is known.
    fn plain(mean: &[f32], skip: &[u8], period: f32, u: usize, phasor: [f32; 2]) -> [f32; 2] {
        let light_at = |x: f32| {
            let i = if x < 0.0 { return None } else { x as usize };
            let (a, b) = (*mean.get(i)?, *mean.get(i + 1)?);
            let known = a > 0.0 && b > 0.0 && skip[i] == 0 && skip[i + 1] == 0;
            known.then_some(a + (x - i as f32) * (b - a))
        };
        let (light, [cos, sin]) = (mean[u], phasor);
        let ripple = super::RIPPLE * (sin / (6.0 * light)).clamp(-1.0, 1.0);
        let after = light_at(u as f32 + period / 2.0).map(|x| (x - light) / (1.0 + ripple));
        let before = light_at(u as f32 - period / 2.0).map(|x| (light - x) / (1.0 - ripple));
        let change = match (before, after) {
            (Some(a), Some(b)) => {
                let smaller = if a + b < 0.0 { -a.max(b) } else { a.min(b) };
                let limit = (4.0 * smaller).max(0.0) + 0.02 * light;
                (a + b).clamp(-limit, limit)
            }
            (Some(one), None) | (None, Some(one)) => 2.0 * one,
            (None, None) => return phasor,
        };
        if light <= 0.0 || skip[u] != 0 {
            return phasor;
        }
        let q = (change / light).clamp(-1.0, 1.0);
        [cos - q * super::TURN * sin, sin + q * (super::FROM_MEAN * light + super::TURN * cos)]
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn blocks_of_pixels_are_corrected_as_pixels_alone(
            values in proptest::collection::vec(-1.0f32..1.0, 3 * WIDTH),
            start in 5.0f32..24.0,
            step in -0.1f32..0.1,
            dark in 0.0f32..0.1,
        ) {
            let plane = |i: usize, scale: f32, offset: f32| {
                let data = values[i * WIDTH..(i + 1) * WIDTH].iter().map(|x| x * scale + offset);
                Plane::from_vec(WIDTH, 1, data.collect()).expect("a row")
            };
            let mut mean = plane(2, 60.0, 61.0);
            let mut skip = Plane::filled(WIDTH, 1, 0u8);
            for (u, &x) in values[..WIDTH].iter().enumerate() {
                mean.set(u, 0, if x.abs() < dark { 0.0 } else { mean.at(u, 0) });
                skip.set(u, 0, u8::from(x > 1.0 - dark));
            }
            // Half a period that ends on a column is between two pairs of columns: rounding decides.
            let between = |p: f32| if (0.5 * p - (0.5 * p).round()).abs() < 1e-3 { p + 0.01 } else { p };
            let period = (0..WIDTH).map(|u| between((start + step * u as f32).max(5.0))).collect();
            let period = Plane::from_vec(WIDTH, 1, period).expect("a row");
            let mut phasors = Phasors { c: plane(0, 100.0, 0.0), s: plane(1, 100.0, 0.0), misfit: mean.clone(), mean };
            let expected: Vec<_> = (0..WIDTH)
                .map(|u| {
                    let phasor = [phasors.c.at(u, 0), phasors.s.at(u, 0)];
                    plain(phasors.mean.row(0), skip.row(0), period.at(u, 0), u, phasor)
                })
                .collect();
            correct_shading(&mut phasors, &period, &skip, 1.0);
            for (u, [c, s]) in expected.into_iter().enumerate() {
                let error = (phasors.c.at(u, 0) - c).abs().max((phasors.s.at(u, 0) - s).abs());
                prop_assert!(error < 0.02, "{error} at {u}");
            }
        }
    }

    #[test]
    fn the_bias_under_a_steep_gradient_goes() {
        // 30 % over a period of 11 px, up to the mask's end.
        let light = |u: f32| 60.0 + 1.7 * u;
        let [before, after] = worst(11.0, 1.0, 6..40, light);
        assert!(before > 0.05 && after < 0.025, "{before} {after}");
    }

    #[test]
    fn a_step_of_colour_beside_the_window_moves_nothing() {
        let light = |u: f32| if u < 60.0 { 200.0 } else { 60.0 };
        // The windows of these columns end before the step, those of half a period further do not.
        let [before, after] = worst(10.0, 1.0, 49..55, light);
        assert!(before < 0.012 && after < 0.018, "{before} {after}");
    }

    #[test]
    fn slopes_are_limited_by_the_smaller_side() {
        assert_eq!(slope(2.0, 3.0, 0.1), 5.0);
        assert_eq!(slope(-2.0, -3.0, 0.1), -5.0);
        assert_eq!(slope(0.0, 30.0, 0.1), 0.1);
        assert_eq!(slope(-30.0, 1.0, 0.1), -0.1);
        assert_eq!(slope(f32::NAN, 3.0, 0.1), 6.0);
        assert!(slope(f32::NAN, f32::NAN, 0.1).is_nan());
    }
}
