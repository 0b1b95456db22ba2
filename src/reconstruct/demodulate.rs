//! Wrapped phase Wm: spatial-carrier phase shifting at the local period (paper, 4.1).
//!
//! The seven-point method is Larkin and Oreb's "6 + 1" formula (Larkin & Oreb, Proc. SPIE 1755, 1992): seven
//! samples 60 degrees apart, disposed symmetrically over exactly one fringe period P, `I_k = I(c + k P / 6)`:
//!
//! ```text
//! S = sqrt(3) (I_-2 + I_-1 - I_1 - I_2) + (I_3 - I_-3) / sqrt(3)
//! C = -I_-3 - I_-2 + I_-1 + 2 I_0 + I_1 - I_2 - I_3
//! W = atan2(S, C),  modulation B = sqrt(S^2 + C^2) / 6
//! ```
//!
//! It is insensitive to a wrong period to first order. Linear interpolation between pixels weakens S and C by
//! different factors that depend on P only: both are divided by them ([`Gains`]).

use super::period::runs;
use crate::image::{Mono8, Plane};
use std::f32::consts::TAU;

/// Rows averaged on each side by [`average_rows`].
const ROWS_EACH_SIDE: usize = 2;

/// Rows that [`average_rows`] takes the mean of.
pub const ROWS: usize = 2 * ROWS_EACH_SIDE + 1;

/// Rows whose misfit exceeds the pixel's own by more than this are left out of the mean.
const MORE_MISFIT: f32 = 0.03;

/// Row phasors must point the same way at least this much for their mean to be taken: |mean| / mean of |.|.
const MIN_COHERENCE: f32 = 0.9;

/// The phasor of each pixel: `c + i s = 6 B exp(i W)`; both zero where it is unknown.
#[derive(Debug)]
pub struct Phasors {
    /// Real part.
    pub c: Plane<f32>,
    /// Imaginary part.
    pub s: Plane<f32>,
    /// Light over the window's one period: the mean, DN.
    pub mean: Plane<f32>,
    /// What the samples have beside offset, slope and fringe: RMS relative to B.
    pub misfit: Plane<f32>,
}

/// Gains of the two sums by period, with linear interpolation of the samples.
#[derive(Debug)]
pub struct Gains(Vec<[f32; 2]>);

const GAIN_STEP_PX: f32 = 1.0 / 32.0;
const GAIN_MAX_PX: f32 = 40.0;

impl Gains {
    /// The table, from the interpolated cosine and sine themselves.
    pub fn new() -> Self {
        let entries = (GAIN_MAX_PX / GAIN_STEP_PX) as usize;
        let gain = |i: usize| {
            let period = (i as f32 * GAIN_STEP_PX).max(2.0);
            let sampled = |phase: f32| {
                let wave = |x: f32| (TAU * x / period + phase).cos();
                let samples = std::array::from_fn(|k| {
                    let x = (k as f32 - 3.0) * period / 6.0;
                    let f = x - x.floor();
                    (1.0 - f) * wave(x.floor()) + f * wave(x.floor() + 1.0)
                });
                sums(&samples)
            };
            let (_, c) = sampled(0.0);
            let (s, _) = sampled(TAU / 4.0);
            [6.0 / s, 6.0 / c]
        };
        Self((0..=entries).map(gain).collect())
    }

    /// Factors for S and C.
    fn at(&self, period: f32) -> [f32; 2] {
        self.0[((period / GAIN_STEP_PX + 0.5) as usize).min(self.0.len() - 1)]
    }
}

impl Default for Gains {
    fn default() -> Self {
        Self::new()
    }
}

/// (S, C) of seven samples.
pub(super) fn sums(i: &[f32; 7]) -> (f32, f32) {
    const ROOT3: f32 = 1.732_050_8;
    let s = ROOT3 * (i[1] + i[2] - i[4] - i[5]) + (i[6] - i[0]) / ROOT3;
    let c = -i[0] - i[1] + i[2] + 2.0 * i[3] + i[4] - i[5] - i[6];
    (s, c)
}

/// Demodulates every mask pixel whose window of one period lies within its run of the mask. `sign` is that of
/// the phase along the columns: the formula alone always yields a phase that grows with the column.
pub fn demodulate(
    image: Mono8<'_>,
    mask: &Plane<u8>,
    period: &Plane<f32>,
    gains: &Gains,
    sign: f32,
) -> Phasors {
    let (w, h) = (image.width(), image.height());
    let blank = || Plane::filled(w, h, 0f32);
    let mut out = Phasors { c: blank(), s: blank(), mean: blank(), misfit: blank() };
    for v in 0..h {
        let row = image.row(v);
        for run in runs(mask.row(v)) {
            for u in run.clone() {
                let p = period.at(u, v);
                let (left, right) = ((u - run.start) as f32, (run.end - 1 - u) as f32);
                if p <= 0.0 || p / 2.0 > left.min(right) {
                    continue;
                }
                let sample = samples(row, u, p);
                let [gain_s, gain_c] = gains.at(p);
                let (s, c) = sums(&sample);
                let (s, c) = (s * gain_s, c * gain_c);
                let (mean, misfit) = remainder(&sample, s / 6.0, c / 6.0);
                out.s.set(u, v, sign * s);
                out.c.set(u, v, c);
                out.mean.set(u, v, mean);
                out.misfit.set(u, v, misfit);
            }
        }
    }
    out
}

/// The seven samples around column `u`, linearly interpolated. The window must lie in the row.
fn samples(row: &[u8], u: usize, period: f32) -> [f32; 7] {
    std::array::from_fn(|k| {
        let x = (u as f32 + (k as f32 - 3.0) * period / 6.0).max(0.0);
        let i = (x as usize).min(row.len() - 1);
        let (a, b) = (f32::from(row[i]), f32::from(row[(i + 1).min(row.len() - 1)]));
        a + (x - i as f32) * (b - a)
    })
}

/// Mean light of the window, and the RMS of what offset, slope and fringe `c cos - s sin` leave, relative to
/// the fringe's amplitude.
fn remainder(samples: &[f32; 7], s: f32, c: f32) -> (f32, f32) {
    // cos and sin of k * 60 degrees, k = -3..3.
    const COS: [f32; 7] = [-1.0, -0.5, 0.5, 1.0, 0.5, -0.5, -1.0];
    const SIN: [f32; 7] = [0.0, -0.866_025_4, -0.866_025_4, 0.0, 0.866_025_4, 0.866_025_4, 0.0];
    let slope = (samples[6] - samples[0]) / 6.0;
    let rest: [f32; 7] =
        std::array::from_fn(|k| samples[k] - c * COS[k] + s * SIN[k] - slope * (k as f32 - 3.0));
    let mean = rest.iter().sum::<f32>() / 7.0;
    let power = rest.iter().map(|x| (x - mean) * (x - mean)).sum::<f32>() / 7.0;
    (mean, (power / (s * s + c * c).max(1e-6)).sqrt())
}

/// Mean phasor of up to five rows; the rows above and below take part in pairs, so that the mean stays centred.
/// A pair takes part where both are known, each as strong as the weaker one (else an edge of colour along the
/// fringe would draw the mean to its bright side), and neither has more misfit than the pixel's own row allows:
/// the window of a row above may touch an edge that this one clears. Averaging along the fringe halves the
/// noise. Pixels with a non-zero `skip` stay as they are, and so do those whose rows disagree.
pub fn average_rows(phasors: &mut Phasors, skip: &Plane<u8>) {
    let (w, h) = (phasors.c.width(), phasors.c.height());
    let (c, s) = (phasors.c.clone(), phasors.s.clone());
    let misfit = &phasors.misfit;
    for v in 1..h.saturating_sub(1) {
        let reach = ROWS_EACH_SIDE.min(v).min(h - 1 - v);
        let (out_c, out_s) = (phasors.c.row_mut(v), phasors.s.row_mut(v));
        for u in 0..w {
            if skip.at(u, v) != 0 || (out_c[u] == 0.0 && out_s[u] == 0.0) {
                continue;
            }
            let (mut sum_c, mut sum_s) = (out_c[u], out_s[u]);
            let (mut length, mut rows) = (size(sum_c, sum_s), 1.0);
            let max_misfit = misfit.at(u, v) + MORE_MISFIT;
            for k in 1..=reach {
                let (above, below) = (v - k, v + k);
                let (a, b) = ((c.at(u, above), s.at(u, above)), (c.at(u, below), s.at(u, below)));
                let (size_a, size_b) = (size(a.0, a.1), size(b.0, b.1));
                let weaker = size_a.min(size_b);
                if weaker == 0.0 || misfit.at(u, above).max(misfit.at(u, below)) > max_misfit {
                    continue;
                }
                let (scale_a, scale_b) = (weaker / size_a, weaker / size_b);
                sum_c += scale_a * a.0 + scale_b * b.0;
                sum_s += scale_a * a.1 + scale_b * b.1;
                length += 2.0 * weaker;
                rows += 2.0;
            }
            if size(sum_c, sum_s) > MIN_COHERENCE * length {
                out_c[u] = sum_c / rows;
                out_s[u] = sum_s / rows;
            }
        }
    }
}

fn size(c: f32, s: f32) -> f32 {
    (c * c + s * s).sqrt()
}

/// Wm: the phase of each phasor in (-pi, pi]; NaN where it is unknown.
pub fn wrapped(phasors: &Phasors) -> Plane<f32> {
    let (w, h) = (phasors.c.width(), phasors.c.height());
    let angle = |(&c, &s): (&f32, &f32)| if c == 0.0 && s == 0.0 { f32::NAN } else { s.atan2(c) };
    let data = phasors.c.as_slice().iter().zip(phasors.s.as_slice()).map(angle).collect();
    Plane::from_vec(w, h, data).unwrap_or_else(|| Plane::filled(0, 0, 0.0))
}

#[cfg(test)]
mod tests {
    use super::{Gains, average_rows, demodulate, wrapped};
    use crate::image::{Mono8, Plane};
    use proptest::prelude::{ProptestConfig, prop_assert, proptest};
    use std::f32::consts::TAU;

    const WIDTH: usize = 96;

    /// Largest phase error, rad, over the middle of rows that hold `light(phase)`, demodulated at `assumed` px.
    fn worst(period: f32, assumed: f32, sign: f32, light: impl Fn(f32) -> f32) -> f32 {
        let mut image = Plane::filled(WIDTH, 5, 0u8);
        let phase = |u: usize, v: usize| sign * TAU * u as f32 / period + 0.13 * v as f32;
        for v in 0..5 {
            for u in 0..WIDTH {
                image.set(u, v, light(phase(u, v)).round().clamp(0.0, 255.0) as u8);
            }
        }
        let mask = Plane::filled(WIDTH, 5, 1u8);
        let assumed = Plane::filled(WIDTH, 5, assumed);
        let mut phasors = demodulate(Mono8::from(&image), &mask, &assumed, &Gains::new(), sign);
        average_rows(&mut phasors, &Plane::filled(WIDTH, 5, 0));
        let found = wrapped(&phasors);
        (20..WIDTH - 20).map(|u| wrap(found.at(u, 2) - phase(u, 2)).abs()).fold(0.0, f32::max)
    }

    fn wrap(x: f32) -> f32 {
        x - TAU * (x / TAU).round()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn exact_at_the_right_period(period in 6.0f32..20.0, amplitude in 30.0f32..110.0, up in proptest::bool::ANY) {
            let sign = if up { 1.0 } else { -1.0 };
            let error = worst(period, period, sign, |x| 120.0 + amplitude * x.cos());
            // Rounding to 8 bits: 0.29 DN / amplitude times the formula's noise gain, five rows, worst of 56.
            prop_assert!(error < 0.02 * 30.0 / amplitude + 0.004, "{error}");
        }

        #[test]
        fn ten_per_cent_of_detuning_costs_little(period in 7.0f32..18.0, detuning in 0.9f32..1.1) {
            let error = worst(period, period * detuning, 1.0, |x| 120.0 + 110.0 * x.cos());
            prop_assert!(error < 0.025, "{error}");
        }

        #[test]
        fn second_and_third_harmonics_cancel(period in 8.0f32..18.0, second in -0.05f32..0.05, third in -0.05f32..0.05) {
            let light = |x: f32| 120.0 + 100.0 * (x.cos() + second * (2.0 * x).cos() + third * (3.0 * x).cos());
            let error = worst(period, period, 1.0, light);
            prop_assert!(error < 0.03, "{error}");
        }
    }

    #[test]
    fn windows_never_leave_the_mask() {
        let image = Plane::filled(WIDTH, 1, 100u8);
        let mut mask = Plane::filled(WIDTH, 1, 1u8);
        mask.set(50, 0, 0);
        let period = Plane::filled(WIDTH, 1, 10.0f32);
        let phasors = demodulate(Mono8::from(&image), &mask, &period, &Gains::new(), 1.0);
        let known = |u: usize| phasors.mean.at(u, 0) > 0.0;
        assert!(!known(4) && known(5) && known(44) && !known(45) && !known(55) && known(56));
    }
}
