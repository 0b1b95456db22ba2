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

use super::angle;
use super::round::whole;
use super::runs::Run;
use super::sample::{self, LANES, Lanes, PAD, Periods};
use std::f32::consts::TAU;

/// Rows averaged on each side.
const ROWS_EACH_SIDE: usize = 2;

/// Rows that a mean is taken of.
pub const ROWS: usize = 2 * ROWS_EACH_SIDE + 1;

/// Rows whose misfit exceeds the pixel's own by more than this are left out of the mean.
const MORE_MISFIT: f32 = 0.03;

/// Row phasors must point the same way at least this much for their mean to be taken: |mean| / mean of |.|.
const MIN_COHERENCE: f32 = 0.9;

/// Gains of the two sums by period, with linear interpolation of the samples.
#[derive(Debug, Clone)]
pub struct Gains(Box<[[f32; 2]; GAINS]>);

const GAINS_PER_PX: f32 = 32.0;
const GAIN_MAX_PX: f32 = 40.0;

/// Room for them: a power of two, so that the low bits of any number are a place.
const GAINS: usize = 2048;

/// Half of the longest period that is demodulated, px.
const MAX_HALF: f32 = GAIN_MAX_PX / 2.0;

impl Gains {
    /// The table, from the interpolated cosine and sine themselves.
    pub fn new() -> Self {
        let gain = |i: usize| {
            let period = (i as f32 / GAINS_PER_PX).clamp(2.0, GAIN_MAX_PX);
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
        let mut table = Box::new([[0.0; 2]; GAINS]);
        for (i, entry) in table.iter_mut().enumerate() {
            *entry = gain(i);
        }
        Self(table)
    }

    /// Where the factors of a period are.
    #[inline(always)]
    fn place(period: f32) -> u32 {
        const LAST: f32 = GAIN_MAX_PX * GAINS_PER_PX;
        let at = period * GAINS_PER_PX;
        whole(if at < LAST { at } else { LAST }) as u32
    }

    /// Factors for S and C.
    #[inline(always)]
    pub(super) fn of(&self, period: f32) -> [f32; 2] {
        self.0[Self::place(period) as usize % GAINS]
    }

    /// The same for a block of periods: all places before the first look, because vectors find these together.
    #[inline(always)]
    fn at(&self, period: &Lanes) -> [Lanes; 2] {
        let (mut place, mut out) = ([0u32; LANES], [[0f32; LANES]; 2]);
        for (place, &period) in place.iter_mut().zip(period) {
            *place = Self::place(period);
        }
        for i in 0..LANES {
            [out[0][i], out[1][i]] = self.0[place[i] as usize % GAINS];
        }
        out
    }
}

impl Default for Gains {
    fn default() -> Self {
        Self::new()
    }
}

const ROOT3: f32 = 1.732_050_8;

/// Seven samples as their middle, and the sums and differences of those at equal distances, from the nearest on.
struct Folded {
    middle: f32,
    even: [f32; 3],
    odd: [f32; 3],
}

impl Folded {
    #[inline(always)]
    fn of(i: &[f32; 7]) -> Self {
        Self {
            middle: i[3],
            even: [i[4] + i[2], i[5] + i[1], i[6] + i[0]],
            odd: [i[4] - i[2], i[5] - i[1], i[6] - i[0]],
        }
    }

    /// (S, C).
    #[inline(always)]
    fn sums(&self) -> (f32, f32) {
        let Self { middle, even, odd } = self;
        let s = odd[2] * (1.0 / ROOT3) - ROOT3 * (odd[0] + odd[1]);
        let c = 2.0 * middle + even[0] - even[1] - even[2];
        (s, c)
    }

    /// Mean light of the window, and the RMS of what offset, slope and fringe `c cos - s sin` leave, relative to
    /// the fringe's amplitude. The slope is that of the outermost samples, of which no difference is left.
    #[inline(always)]
    fn remainder(&self, s: f32, c: f32) -> (f32, f32) {
        let Self { middle, even, odd } = self;
        let middle = middle - c;
        let even = [even[0] - c, even[1] + c, even[2] + 2.0 * c];
        let third = odd[2] * (1.0 / 3.0);
        let odd = [odd[0] + (ROOT3 * s - third), odd[1] + (ROOT3 * s - 2.0 * third)];
        let mean = (middle + even[0] + even[1] + even[2]) * (1.0 / 7.0);
        let own = middle - mean;
        let beside = [even[0] - 2.0 * mean, even[1] - 2.0 * mean, even[2] - 2.0 * mean];
        let pairs = beside[0] * beside[0]
            + beside[1] * beside[1]
            + beside[2] * beside[2]
            + (odd[0] * odd[0] + odd[1] * odd[1]);
        let power = own * own + 0.5 * pairs;
        let strength = s * s + c * c;
        (mean, (power * (1.0 / 7.0) / if strength > 1e-6 { strength } else { 1e-6 }).sqrt())
    }
}

/// (S, C) of seven samples.
#[inline(always)]
pub(super) fn sums(i: &[f32; 7]) -> (f32, f32) {
    Folded::of(i).sums()
}

/// The phasors of a row, `c + i s = 6 B exp(i W)`, both zero where they are unknown, the mean light of their windows, DN, and
/// what the samples have beside offset, slope and fringe: RMS relative to B. To be written.
pub(super) struct PhasorRow<'a> {
    pub c: &'a mut [f32],
    pub s: &'a mut [f32],
    pub mean: &'a mut [f32],
    pub misfit: &'a mut [f32],
}

/// Demodulates every pixel of a row's runs whose window of one period lies within its run; only the runs are written. `sign`
/// is that of the phase along the columns: the formula alone always yields a phase that grows with the column. `light` is
/// memory to use, of finite numbers.
#[inline(always)]
pub(super) fn demodulate_row(
    image: &[u8],
    runs: &[Run],
    period: &[f32],
    gains: &Gains,
    sign: f32,
    light: &mut Vec<f32>,
    out: PhasorRow<'_>,
) {
    let PhasorRow { c, s, mean, misfit } = out;
    sample::reserve(light, image.len());
    for run in runs {
        let columns = run.columns();
        for (light, &x) in light[PAD + columns.start..].iter_mut().zip(&image[columns.clone()]) {
            *light = f32::from(x);
        }
        for first in columns.clone().step_by(LANES) {
            let end = columns.end.min(first + LANES);
            let period = sample::load(period, first);
            let inside = (first - columns.start, columns.end - 1 - first);
            let block = demodulate_block(light, first, inside, &period, gains, sign);
            for (row, lanes) in [&mut *c, &mut *s, &mut *mean, &mut *misfit].into_iter().zip(&block) {
                sample::store(row, first, end - first, lanes);
            }
        }
    }
}

/// c, s, mean and misfit of a block whose first pixel has `inside` pixels of its run before and behind it.
#[inline(always)]
fn demodulate_block(
    light: &[f32],
    first: usize,
    inside: (usize, usize),
    period: &Lanes,
    gains: &Gains,
    sign: f32,
) -> [Lanes; 4] {
    let periods = &Periods::new(period);
    let [before_1, behind_1] = sample::both_sides(light, first, periods, 1.0 / 6.0);
    let [before_2, behind_2] = sample::both_sides(light, first, periods, 2.0 / 6.0);
    let [before_3, behind_3] = sample::both_sides(light, first, periods, 3.0 / 6.0);
    let own = sample::load(&light[PAD..], first);
    let samples = [before_3, before_2, before_1, own, behind_1, behind_2, behind_3];
    let [gain_s, gain_c] = gains.at(period);
    let [mut out_c, mut out_s, mut out_mean, mut out_misfit] = [[0f32; LANES]; 4];
    let (left, right) = (inside.0 as f32, inside.1 as f32);
    for i in 0..LANES {
        let sample = [0, 1, 2, 3, 4, 5, 6].map(|k: usize| samples[k][i]);
        let (s, c, mean, misfit) = of_samples(&sample, [gain_s[i], gain_c[i]]);
        let half = period[i] * 0.5;
        let known =
            (half > 0.0) & (half <= left + i as f32) & (half <= right - i as f32) & (half <= MAX_HALF);
        out_c[i] = if known { c } else { 0.0 };
        out_s[i] = if known { sign * s } else { 0.0 };
        out_mean[i] = if known { mean } else { 0.0 };
        out_misfit[i] = if known { misfit } else { 0.0 };
    }
    [out_c, out_s, out_mean, out_misfit]
}

/// S, C, mean and misfit of one pixel's seven samples, with the gains of their distance.
#[inline(always)]
pub(super) fn of_samples(samples: &[f32; 7], [gain_s, gain_c]: [f32; 2]) -> (f32, f32, f32, f32) {
    let folded = Folded::of(samples);
    let (s, c) = folded.sums();
    let (s, c) = (s * gain_s, c * gain_c);
    let (mean, misfit) = folded.remainder(s * (1.0 / 6.0), c * (1.0 / 6.0));
    (s, c, mean, misfit)
}

/// Rows to each side of row `v` of `h` that are averaged with it.
pub(super) fn row_reach(v: usize, h: usize) -> usize {
    ROWS_EACH_SIDE.min(v).min(h - 1 - v)
}

/// Rows of phasors of length 1, their true lengths and misfit.
pub(super) type Rows<'a> = [&'a [f32]; 4];

/// Mean phasor of up to five rows; the rows above and below take part in pairs, so that the mean stays centred.
/// A pair takes part where both are known, each as strong as the weaker one (else an edge of colour along the
/// fringe would draw the mean to its bright side), and neither has more misfit than the pixel's own row allows:
/// the window of a row above may touch an edge that this one clears. Averaging along the fringe halves the
/// noise. Pixels with a non-zero `skip` stay as they are, and so do those whose rows disagree. One block: `own` is its row, of
/// which `[c, s]` are C and S.
#[inline(always)]
pub(super) fn average_block(
    [c, s]: [&[f32]; 2],
    own: Rows<'_>,
    pairs: &[[Rows<'_>; 2]],
    skip: &[u8],
    first: usize,
) -> [Lanes; 2] {
    let (c, s) = (sample::load(c, first), sample::load(s, first));
    let (mut length, misfit) = (sample::load(own[2], first), sample::load(own[3], first));
    let (mut sum_c, mut sum_s, mut rows) = (c, s, [1f32; LANES]);
    for pair in pairs {
        let [c_a, s_a, size_a, misfit_a] = load(pair[0], first);
        let [c_b, s_b, size_b, misfit_b] = load(pair[1], first);
        // 0 where the pair takes no part. All of them first: else the compiler makes a branch of it, and stores with a mask.
        let mut weaker = [0f32; LANES];
        for i in 0..LANES {
            let size = if size_a[i] < size_b[i] { size_a[i] } else { size_b[i] };
            let most = misfit[i] + MORE_MISFIT;
            let takes_part = (size > 0.0) & (misfit_a[i] <= most) & (misfit_b[i] <= most);
            weaker[i] = if takes_part { size } else { 0.0 };
        }
        for i in 0..LANES {
            sum_c[i] += weaker[i] * (c_a[i] + c_b[i]);
            sum_s[i] += weaker[i] * (s_a[i] + s_b[i]);
            length[i] += 2.0 * weaker[i];
            rows[i] += if weaker[i] > 0.0 { 2.0 } else { 0.0 };
        }
    }
    let mut out = [c, s];
    let skipped = sample::load(skip, first);
    for i in 0..LANES {
        let known = (c[i] != 0.0) | (s[i] != 0.0);
        let least = MIN_COHERENCE * length[i];
        let coherent = sum_c[i] * sum_c[i] + sum_s[i] * sum_s[i] > least * least;
        let averaged = (skipped[i] == 0) & known & coherent;
        // One, three or five.
        let share = if rows[i] > 4.0 { 1.0 / 5.0 } else { 1.0 / 3.0 };
        let share = if rows[i] > 2.0 { share } else { 1.0 };
        out[0][i] = if averaged { sum_c[i] * share } else { c[i] };
        out[1][i] = if averaged { sum_s[i] * share } else { s[i] };
    }
    out
}

#[inline(always)]
fn load([c, s, length, misfit]: Rows<'_>, first: usize) -> [Lanes; 4] {
    // Not by `map`: that would be a call, compiled for the narrowest processor.
    [sample::load(c, first), sample::load(s, first), sample::load(length, first), sample::load(misfit, first)]
}

/// Phasors of length 1 in the direction of a row's, and the lengths of these; 0 where there is none.
#[inline(always)]
pub(super) fn units(c: &[f32], s: &[f32], [unit_c, unit_s, length]: [&mut [f32]; 3]) {
    let n = c.len();
    let (s, unit_c, unit_s, length) = (&s[..n], &mut unit_c[..n], &mut unit_s[..n], &mut length[..n]);
    for i in 0..n {
        let size = (c[i] * c[i] + s[i] * s[i]).sqrt();
        let scale = 1.0 / if size > 0.0 { size } else { 1.0 };
        length[i] = size;
        unit_c[i] = c[i] * scale;
        unit_s[i] = s[i] * scale;
    }
}

/// The phase of a phasor; NaN where it is 0.
#[inline(always)]
pub(super) fn phase(c: f32, s: f32) -> f32 {
    let known = (c != 0.0) | (s != 0.0);
    if known { angle::atan2(s, c) } else { f32::NAN }
}

#[cfg(test)]
mod tests {
    use super::Gains;
    use crate::image::{Mono8, Plane};
    use crate::reconstruct::phasors::{Phasors, average_rows, demodulate, wrapped};
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

    /// C, S and mean of the definition, in f64, where the window lies in columns 0 .. `WIDTH`.
    fn plain(row: &[u8], u: usize, period: f64, gains: &Gains) -> Option<[f64; 3]> {
        if period / 2.0 > u.min(WIDTH - 1 - u) as f64 {
            return None;
        }
        let sample = |k: i32| {
            let x = u as f64 + f64::from(k) * period / 6.0;
            let at = |x: f64| f64::from(row[(x as usize).min(WIDTH - 1)]);
            (1.0 - x.fract()) * at(x) + x.fract() * at(x + 1.0)
        };
        let i = [-3, -2, -1, 0, 1, 2, 3].map(sample);
        let s = 3f64.sqrt() * (i[1] + i[2] - i[4] - i[5]) + (i[6] - i[0]) / 3f64.sqrt();
        let c = -i[0] - i[1] + i[2] + 2.0 * i[3] + i[4] - i[5] - i[6];
        let [gain_s, gain_c] = gains.of(period as f32).map(f64::from);
        let mean = (i.iter().sum::<f64>() + c * gain_c / 6.0) / 7.0;
        Some([c * gain_c, s * gain_s, mean])
    }

    /// The mean of a pixel's rows, one pair after the other, as [`average_rows`] says.
    fn plain_average(rows: &[[f32; 3]; 5]) -> [f32; 2] {
        let size = |row: &[f32; 3]| row[0].hypot(row[1]);
        let own = rows[2];
        let (mut sum, mut length, mut count) = ([own[0], own[1]], size(&own), 1.0);
        for (a, b) in [(rows[1], rows[3]), (rows[0], rows[4])] {
            let weaker = size(&a).min(size(&b));
            if weaker > 0.0 && a[2].max(b[2]) <= own[2] + 0.03 {
                for k in 0..2 {
                    sum[k] += weaker * (a[k] / size(&a) + b[k] / size(&b));
                }
                (length, count) = (length + 2.0 * weaker, count + 2.0);
            }
        }
        let averaged = size(&own) > 0.0 && sum[0].hypot(sum[1]) > 0.9 * length;
        if averaged { sum.map(|x| x / count) } else { [own[0], own[1]] }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn blocks_of_pixels_are_as_pixels_alone(
            values in proptest::collection::vec(proptest::num::u8::ANY, WIDTH),
            start in 5.0f32..24.0,
            step in -0.15f32..0.15,
        ) {
            let image = Plane::from_vec(WIDTH, 1, values).expect("a row");
            let mut period = Plane::filled(WIDTH, 1, 0f32);
            for u in 0..WIDTH {
                period.set(u, 0, (start + step * u as f32).clamp(5.0, 24.0));
            }
            let mask = Plane::filled(WIDTH, 1, 1u8);
            let found = demodulate(Mono8::from(&image), &mask, &period, &Gains::new(), -1.0);
            for u in 0..WIDTH {
                let plain = plain(image.row(0), u, f64::from(period.at(u, 0)), &Gains::new());
                let [c, s, mean] = plain.unwrap_or_default();
                let error = (f64::from(found.c.at(u, 0)) - c).abs() + (f64::from(found.s.at(u, 0)) + s).abs();
                prop_assert!(error < 0.02, "{error} at {u}");
                prop_assert!((f64::from(found.mean.at(u, 0)) - mean).abs() < 0.01, "{} {mean}", found.mean.at(u, 0));
            }
        }

        #[test]
        fn rows_are_averaged_as_the_definition_says(
            values in proptest::collection::vec(-1.0f32..1.0, 3 * 5 * 40),
            coherent in proptest::bool::ANY,
        ) {
            let value = |i: usize, scale: f32, offset: f32| {
                let data = values[i * 200..(i + 1) * 200].iter();
                let data = data.map(|&x| if x.abs() < 0.1 { 0.0 } else { x * scale + offset });
                Plane::from_vec(40, 5, data.collect()).expect("200 pixels")
            };
            let offset = if coherent { 4.0 } else { 0.0 };
            let (c, s, misfit) = (value(0, 1.0, offset), value(1, 1.0, 0.0), value(2, 0.04, 0.05));
            let mut phasors = Phasors { c, s, mean: misfit.clone(), misfit };
            let of = |v: usize, u: usize| [phasors.c.at(u, v), phasors.s.at(u, v), phasors.misfit.at(u, v)];
            let expected: Vec<_> =
                (0..40).map(|u| plain_average(&std::array::from_fn(|v| of(v, u)))).collect();
            average_rows(&mut phasors, &Plane::filled(40, 5, 0));
            for (u, expected) in expected.iter().enumerate() {
                let error = (phasors.c.at(u, 2) - expected[0]).hypot(phasors.s.at(u, 2) - expected[1]);
                prop_assert!(error < 1e-5, "{error} at {u}");
            }
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
