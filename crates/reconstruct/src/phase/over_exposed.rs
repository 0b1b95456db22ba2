// SPDX-License-Identifier: MIT OR Apache-2.0
//! Phase of windows that hold over-exposed pixels: least squares on the pixels that are not.
//!
//! An over-exposed pixel shows that there is much light, and not how much. The formula of [`super::demodulate`] needs
//! all of a period; the model behind it does not. For each pixel whose window has no whole period of good pixels
//!
//! ```text
//! I(x) = a + b x / P + c cos(2 pi x / P) + s sin(2 pi x / P)
//! ```
//!
//! is fitted to the good pixels within one period to each side, near ones with more weight than far ones.

use crate::kernels::pixel_runs::Run;
use crate::kernels::subpixel::{self, LANES, Lanes, PAD};
use std::f32::consts::TAU;

/// A fit of four numbers needs this many pixels.
const MIN_PIXELS: f32 = 6.0;

/// Pixels that leave less than this share of a number's variance do not decide it: digits of a float are lost.
const LEAST_SPREAD: f32 = 1e-6;

/// The light of a row with padding: 0 and a weight of 0 where a pixel is over-exposed or no part of the object.
#[derive(Debug, Default)]
pub(crate) struct GoodPixels {
    light: Vec<f32>,
    weight: Vec<f32>,
}

/// What is subtracted from the light before it is squared, DN: fewer digits are lost.
const MIDDLE_DN: f32 = 128.0;

impl GoodPixels {
    /// Takes a run of the object in a row of this width, of which `good` are not over-exposed.
    #[inline(always)]
    fn set(&mut self, row: &[u8], run: &Run, good: &[Run]) {
        subpixel::reserve(&mut self.light, row.len());
        subpixel::reserve(&mut self.weight, row.len());
        // Blocks look beyond the run, but at no other one.
        let around = run.start()..run.end() + 2 * PAD + LANES;
        self.light[around.clone()].fill(0.0);
        self.weight[around].fill(0.0);
        for part in good {
            for u in part.columns() {
                self.light[PAD + u] = f32::from(row[u]) - MIDDLE_DN;
                self.weight[PAD + u] = 1.0;
            }
        }
    }

    /// Whether a pixel of the run that a block's windows may see is over-exposed.
    #[inline(always)]
    fn is_over_exposed(&self, first: usize, run: &Run) -> bool {
        let seen = first.max(run.start() + PAD)..(first + LANES + 2 * PAD).min(run.end() + PAD);
        self.weight[seen].contains(&0.0)
    }
}

/// Fits the pixels of a row's runs whose windows have over-exposed pixels. `good`: the runs without these.
/// `each` gets the column, and c, s, mean and misfit as [`super::demodulate::demodulate_row`] has them, of every pixel
/// that has a fit, whether it needs one or not.
#[inline(always)]
pub(crate) fn fit_row(
    image: &[u8],
    (runs, good): (&[Run], &[Run]),
    period: &[f32],
    sign: f32,
    pixels: &mut GoodPixels,
    mut each: impl FnMut(usize, [f32; 4]),
) {
    let mut left = good;
    for run in runs {
        let parts;
        (parts, left) = left.split_at(left.iter().take_while(|part| part.end() <= run.end()).count());
        if parts == [*run] {
            continue;
        }
        pixels.set(image, run, parts);
        for first in run.columns().step_by(LANES).filter(|&first| pixels.is_over_exposed(first, run)) {
            let count = LANES.min(run.end() - first);
            let [c, s, mean, misfit] = fit_block(pixels, first, &subpixel::load(period, first), run);
            for i in (0..count).filter(|&i| mean[i] > 0.0) {
                each(first + i, [c[i], sign * s[i], mean[i], misfit[i]]);
            }
        }
    }
}

/// c, s (of a phase that grows with the column), mean and misfit of a block's pixels; 0 where there is no fit.
#[inline(always)]
fn fit_block(pixels: &GoodPixels, first: usize, period: &Lanes, run: &Run) -> [Lanes; 4] {
    let mut longest = 0f32;
    let [mut per_period, mut turn_c, mut turn_s] = [[0f32; LANES]; 3];
    for i in 0..LANES {
        let known = period[i] > 0.0 && period[i] < (PAD - 1) as f32;
        longest = if known { longest.max(period[i]) } else { longest };
        per_period[i] = if known { 1.0 / period[i] } else { 1.0 };
        (turn_s[i], turn_c[i]) = sin_cos(TAU * per_period[i]);
    }
    let mut sums = Sums::default();
    let (mut cos, mut sin) = ([1f32; LANES], [0f32; LANES]);
    for distance in 0..=longest as usize {
        for i in 0..LANES {
            let x = distance as f32 * per_period[i];
            let near = if x < 1.0 { 1.0 - x * x } else { 0.0 };
            let taper = near * near;
            let at = first + PAD + i;
            sums.add(i, pixels, at + distance, [taper, x, cos[i], sin[i]]);
            if distance > 0 {
                sums.add(i, pixels, at - distance, [taper, -x, cos[i], -sin[i]]);
            }
            (cos[i], sin[i]) =
                (cos[i] * turn_c[i] - sin[i] * turn_s[i], sin[i] * turn_c[i] + cos[i] * turn_s[i]);
        }
    }
    let mut out = [[0f32; LANES]; 4];
    for i in 0..LANES {
        let (half, u) = (period[i] * 0.5, (first + i) as f32);
        let inside = half > 0.0 && u - half >= run.start() as f32 && u + half <= (run.end() - 1) as f32;
        let [c, s, mean, misfit] = sums.solve(i);
        let known = inside && sums.pixels[i] >= MIN_PIXELS && mean > 0.0;
        for (out, value) in out.iter_mut().zip([6.0 * c, -6.0 * s, mean, misfit]) {
            out[i] = if known { value } else { 0.0 };
        }
    }
    out
}

/// Sine and cosine of an angle of up to 1.3 rad: those of a library differ from machine to machine in the last bit.
#[inline(always)]
fn sin_cos(x: f32) -> (f32, f32) {
    let square = x * x;
    let (mut sin, mut cos) = (1.0, 1.0);
    for k in [5.0f32, 4.0, 3.0, 2.0, 1.0] {
        sin = 1.0 - square / (2.0 * k * (2.0 * k + 1.0)) * sin;
        cos = 1.0 - square / (2.0 * k * (2.0 * k - 1.0)) * cos;
    }
    (x * sin, cos)
}

/// Weighted sums of the products of 1, x, cosine, sine and light.
#[derive(Default)]
struct Sums {
    pixels: Lanes,
    n: Lanes,
    x: Lanes,
    c: Lanes,
    s: Lanes,
    i: Lanes,
    xx: Lanes,
    xc: Lanes,
    xs: Lanes,
    xi: Lanes,
    cc: Lanes,
    cs: Lanes,
    ci: Lanes,
    si: Lanes,
    ii: Lanes,
}

impl Sums {
    #[inline(always)]
    fn add(&mut self, i: usize, pixels: &GoodPixels, at: usize, [taper, x, c, s]: [f32; 4]) {
        let light = pixels.light[at];
        let good = if taper > 0.0 { pixels.weight[at] } else { 0.0 };
        let w = taper * good;
        let (wx, wc, ws, wi) = (w * x, w * c, w * s, w * light);
        self.pixels[i] += good;
        self.n[i] += w;
        self.x[i] += wx;
        self.c[i] += wc;
        self.s[i] += ws;
        self.i[i] += wi;
        self.xx[i] += wx * x;
        self.xc[i] += wx * c;
        self.xs[i] += wx * s;
        self.xi[i] += wx * light;
        self.cc[i] += wc * c;
        self.cs[i] += wc * s;
        self.ci[i] += wc * light;
        self.si[i] += ws * light;
        self.ii[i] += wi * light;
    }

    /// Cosine and sine of the fringe, the mean light over a period, and the misfit; 0 where the pixels do not decide.
    #[inline(always)]
    fn solve(&self, i: usize) -> [f32; 4] {
        let n = 1.0 / self.n[i];
        // Without the offset ..
        let (mx, mc, ms, mi) = (self.x[i] * n, self.c[i] * n, self.s[i] * n, self.i[i] * n);
        let xx = self.xx[i] - self.x[i] * mx;
        let (xc, xs, xi) =
            (self.xc[i] - self.x[i] * mc, self.xs[i] - self.x[i] * ms, self.xi[i] - self.x[i] * mi);
        let (cc, cs, ci) =
            (self.cc[i] - self.c[i] * mc, self.cs[i] - self.c[i] * ms, self.ci[i] - self.c[i] * mi);
        // The squares of cosine and sine sum up to 1.
        let ss = self.n[i] - self.cc[i] - self.s[i] * ms;
        let (si, ii) = (self.si[i] - self.s[i] * mi, self.ii[i] - self.i[i] * mi);
        // .. and without the slope.
        let x = 1.0 / xx;
        let (kc, ks, ki) = (xc * x, xs * x, xi * x);
        let (cc, cs, ci) = (cc - xc * kc, cs - xc * ks, ci - xc * ki);
        let (ss, si, ii) = (ss - xs * ks, si - xs * ki, ii - xi * ki);
        let det = cc * ss - cs * cs;
        let (c, s) = ((ss * ci - cs * si) / det, (cc * si - cs * ci) / det);
        let slope = ki - kc * c - ks * s;
        let mean = mi - mx * slope - mc * c - ms * s + MIDDLE_DN;
        let power = c * c + s * s;
        let rest = (ii - ci * c - si * s).max(0.0) * n;
        let spare = self.pixels[i] / (self.pixels[i] - 4.0).max(1.0);
        let misfit = (rest * spare / power).sqrt();
        let defined = xx > LEAST_SPREAD && det > LEAST_SPREAD * cc * ss;
        if defined { [c, s, mean, misfit] } else { [0.0; 4] }
    }
}

#[cfg(test)]
mod tests {
    use super::{GoodPixels, Run, fit_row, sin_cos};
    use crate::kernels::pixel_runs::runs_of;
    use crate::mask::SATURATED;
    use proptest::prelude::{ProptestConfig, prop_assert, proptest};
    use std::f32::consts::TAU;

    const WIDTH: usize = 120;

    /// The phase errors, rad, of the pixels of a row that have a fit, and the number of those without although their
    /// window lies within the row.
    fn errors(period: f32, start: f32, sign: f32, light: impl Fn(usize, f32) -> f32) -> (Vec<f32>, usize) {
        let phase = |u: usize| start + sign * TAU * u as f32 / period;
        let row: Vec<u8> =
            (0..WIDTH).map(|u| light(u, phase(u).cos()).round().clamp(0.0, 255.0) as u8).collect();
        let is_good: Vec<u8> = row.iter().map(|&x| u8::from(x < SATURATED)).collect();
        let mut good = Vec::new();
        runs_of(&is_good, |first, end| good.push(Run::new(first, end)));
        let mut errors = Vec::new();
        let runs = (&[Run::new(0, WIDTH)][..], &good[..]);
        fit_row(&row, runs, &[period; WIDTH], sign, &mut GoodPixels::default(), |u, [c, s, mean, misfit]| {
            assert!(mean > 0.0 && misfit < 1.0, "{u}: {mean} {misfit}");
            let off = s.atan2(c) - phase(u);
            errors.push((off - TAU * (off / TAU).round()).abs());
        });
        let within = WIDTH - 2 * (period / 2.0).ceil() as usize;
        let unknown = within.saturating_sub(errors.len());
        (errors, unknown)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(256))]
        #[test]
        fn a_fringe_that_is_cut_has_the_phase_of_the_whole(
            period in 8.0f32..18.0,
            start in 0.0f32..TAU,
            amplitude in 170.0f32..260.0,
            change in -0.002f32..0.002,
            up in proptest::bool::ANY,
        ) {
            let sign = if up { 1.0 } else { -1.0 };
            let light = |u: usize, cos: f32| (1.0 + change * (u as f32 - 60.0)) * amplitude * (1.0 + 0.9 * cos);
            let (errors, unknown) = errors(period, start, sign, light);
            // At 260 DN half of each period is cut: of the shortest ones too few pixels are left here and there. Rounding leaves
            // some hundredths of a radian.
            prop_assert!(10 * unknown <= errors.len(), "{} and {unknown}", errors.len());
            let worst = errors.iter().copied().fold(0.0, f32::max);
            prop_assert!(worst < 0.08, "{worst}");
        }
    }

    #[test]
    fn sine_and_cosine_are_those_of_the_library() {
        for k in 0..=1300 {
            let x = k as f32 * 1e-3;
            let (sin, cos) = sin_cos(x);
            assert!((sin - x.sin()).abs() < 2e-7 && (cos - x.cos()).abs() < 2e-7, "{x}: {sin} {cos}");
        }
    }

    #[test]
    fn light_that_is_cut_everywhere_has_no_phase() {
        let (errors, _) = errors(11.0, 0.3, 1.0, |_, cos| 2000.0 * (1.5 + cos));
        assert!(errors.is_empty());
    }

    #[test]
    fn nothing_is_fitted_where_nothing_is_cut() {
        let (errors, _) = errors(11.0, 0.3, 1.0, |_, cos| 100.0 * (1.1 + cos));
        assert!(errors.is_empty());
    }
}
