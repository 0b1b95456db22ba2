// SPDX-License-Identifier: MIT OR Apache-2.0
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

use crate::kernels::fast_atan2;
use crate::kernels::fast_round::whole;
use crate::kernels::pixel_runs::Run;
use crate::kernels::subpixel::{self, LANES, Lanes, Light, Periods};
use std::f32::consts::TAU;
use std::hint::black_box;
use std::ops::Range;

/// Rows averaged on each side of a pixel's own row.
pub(crate) const ROWS_EACH_SIDE: usize = 2;

/// Rows that the mean phasor of a pixel is taken of, at most.
pub const ROWS: usize = 2 * ROWS_EACH_SIDE + 1;

/// Rows whose misfit exceeds the pixel's own by more than this are left out of the mean.
pub(crate) const MORE_MISFIT: f32 = 0.03;

/// Row phasors must point the same way at least this much for their mean to be taken: |mean| / mean of |.|.
const MIN_COHERENCE: f32 = 0.9;

/// Gains of the two sums by period, with linear interpolation of the samples: the bits of that of S, and above those
/// of C.
#[derive(Debug, Clone)]
pub struct Gains(Box<[u64; GAINS]>);

/// Entries of the table per px of the period.
const GAINS_PER_PX: f32 = 32.0;

/// The longest period that the table has gains for, px.
const GAIN_MAX_PX: f32 = 40.0;

/// Entries of the table of gains: a power of two, so that the low bits of any number are a place.
const GAINS: usize = 2048;

/// Half of the longest period that is demodulated, px.
pub(crate) const MAX_HALF: f32 = GAIN_MAX_PX / 2.0;

impl Gains {
    /// Computes the table from the same interpolated cosine and sine that the demodulation uses.
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
            u64::from((6.0 / c).to_bits()) << 32 | u64::from((6.0 / s).to_bits())
        };
        let mut table = Box::new([0; GAINS]);
        for (i, entry) in table.iter_mut().enumerate() {
            *entry = gain(i);
        }
        Self(table)
    }

    /// Where the factors of a period are.
    #[inline(always)]
    fn place(period: f32) -> u32 {
        /// The entry of the longest period.
        const LAST: f32 = GAIN_MAX_PX * GAINS_PER_PX;
        let at = period * GAINS_PER_PX;
        whole(if at < LAST { at } else { LAST }) as u32
    }

    /// Factors for S and C.
    #[inline(always)]
    pub(crate) fn of(&self, period: f32) -> [f32; 2] {
        let both = self.0[Self::place(period) as usize % GAINS];
        [f32::from_bits(both as u32), f32::from_bits((both >> 32) as u32)]
    }

    /// The same for a block of periods, as they are in the table.
    #[inline(always)]
    fn at(&self, period: &Lanes) -> [u64; LANES] {
        // All places before the first look, because vectors find these together.
        let (mut place, mut both) = ([0u32; LANES], [0u64; LANES]);
        for i in 0..LANES {
            place[i] = Self::place(period[i]) % GAINS as u32;
        }
        for i in 0..LANES {
            both[i] = self.0[place[i] as usize % GAINS];
        }
        both
    }
}

/// The square root of 3.
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

    /// The sums (S, C) of the formula.
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
pub(crate) fn sums(i: &[f32; 7]) -> (f32, f32) {
    Folded::of(i).sums()
}

/// Demodulates every pixel of a row's runs whose window of one period lies within its run. `sign` is that of the phase
/// along the columns: the formula alone always yields a phase that grows with the column. `light` is memory to use.
///
/// `each` gets the columns of each block and its c, s, mean and misfit: the phasor `c + i s = 6 B exp(i W)`, the mean
/// light of the window, DN, and what the samples have beside offset, slope and fringe, RMS relative to B. All are 0
/// where they are unknown, and beyond the run.
#[inline(always)]
pub(crate) fn demodulate_row(
    image: &[u8],
    runs: &[Run],
    period: &[f32],
    gains: &Gains,
    sign: f32,
    light: &mut Light,
    mut each: impl FnMut(Range<usize>, &[Lanes; 4]),
) {
    light.reserve(image.len());
    for run in runs {
        let columns = run.columns();
        light.set(columns.start, &image[columns.clone()]);
        for first in columns.clone().step_by(LANES) {
            let period = subpixel::load(period, first);
            let inside = (first - columns.start, columns.end - 1 - first);
            let end = columns.end.min(first + LANES);
            each(first..end, &demodulate_block(light, first, inside, &period, gains, sign));
        }
    }
}

/// c, s, mean and misfit of a block whose first pixel has `inside` pixels of its run before and behind it.
#[inline(always)]
fn demodulate_block(
    light: &Light,
    first: usize,
    inside: (usize, usize),
    period: &Lanes,
    gains: &Gains,
    sign: f32,
) -> [Lanes; 4] {
    // First of all: vectors wait until what was written one by one has come to the cache.
    let gains = gains.at(period);
    let periods = &Periods::new(period);
    let sides_1 = light.both_sides(first, periods, 1.0 / 6.0);
    let sides_2 = light.both_sides(first, periods, 2.0 / 6.0);
    let sides_3 = light.both_sides(first, periods, 3.0 / 6.0);
    let own = light.own(first);
    // The compiler must not know what they are: it would part them one by one.
    let gains = black_box(&gains);
    let (mut gain_s, mut gain_c) = ([0f32; LANES], [0f32; LANES]);
    for i in 0..LANES {
        gain_s[i] = f32::from_bits(gains[i] as u32);
        gain_c[i] = f32::from_bits((gains[i] >> 32) as u32);
    }
    let (left, right) = (inside.0 as i32 as f32, inside.1 as i32 as f32);
    let mut out = [[0f32; LANES]; 4];
    for i in 0..LANES {
        let before = [sides_3[0][i], sides_2[0][i], sides_1[0][i]];
        let behind = [sides_1[1][i], sides_2[1][i], sides_3[1][i]];
        let samples = [before[0], before[1], before[2], own[i], behind[0], behind[1], behind[2]];
        let (s, c, mean, misfit) = of_samples(&samples, [gain_s[i], gain_c[i]]);
        let half = period[i] * 0.5;
        let known = (half > 0.0)
            & (half <= left + subpixel::PLACES[i])
            & (half <= right - subpixel::PLACES[i])
            & (half <= MAX_HALF);
        let known = if known { u32::MAX } else { 0 };
        out[0][i] = f32::from_bits(c.to_bits() & known);
        out[1][i] = f32::from_bits((sign * s).to_bits() & known);
        out[2][i] = f32::from_bits(mean.to_bits() & known);
        out[3][i] = f32::from_bits(misfit.to_bits() & known);
    }
    out
}

/// S, C, mean and misfit of one pixel's seven samples, with the gains of their distance.
#[inline(always)]
pub(crate) fn of_samples(samples: &[f32; 7], [gain_s, gain_c]: [f32; 2]) -> (f32, f32, f32, f32) {
    let folded = Folded::of(samples);
    let (s, c) = folded.sums();
    let (s, c) = (s * gain_s, c * gain_c);
    let (mean, misfit) = folded.remainder(s * (1.0 / 6.0), c * (1.0 / 6.0));
    (s, c, mean, misfit)
}

/// Rows to each side of row `v` of `h` that are averaged with it.
pub(crate) fn row_reach(v: usize, h: usize) -> usize {
    ROWS_EACH_SIDE.min(v).min(h - 1 - v)
}

/// A block of a row of phasors of length 1, their true lengths and misfit.
pub(crate) type Row<'a> = [&'a Lanes; 4];

/// Mean phasor of up to five rows, of one and its nearest pair or two; the rows above and below take part in pairs, so
/// that the mean stays centred. A pair takes part where both are known, each as strong as the weaker one (else an edge
/// of colour along the fringe would draw the mean to its bright side), and neither has more misfit than the pixel's
/// own row allows: the window of a row above may touch an edge that this one clears. Averaging along the fringe halves
/// the noise. Pixels with a non-zero `skip` stay as they are, and so do those whose rows disagree. One block: of its
/// own row are `[c, s]`, their `length` and `misfit`.
#[inline(always)]
pub(crate) fn average_block<const PAIRS: usize>(
    [c, s, length, misfit]: Row<'_>,
    pairs: &[[Row<'_>; 2]; PAIRS],
    skip: &[u8; LANES],
) -> [Lanes; 2] {
    let mut out = [[0f32; LANES]; 2];
    for i in 0..LANES {
        let most = misfit[i] + MORE_MISFIT;
        let (mut sum_c, mut sum_s, mut length, mut rows) = (c[i], s[i], length[i], 1.0);
        for pair in pairs {
            let [size, of_c, of_s] = of_pair(pair, most, i);
            (sum_c, sum_s) = (sum_c + of_c, sum_s + of_s);
            length += 2.0 * size;
            rows += if size > 0.0 { 2.0 } else { 0.0 };
        }
        let known = (c[i] != 0.0) | (s[i] != 0.0);
        let least = MIN_COHERENCE * length;
        let coherent = sum_c * sum_c + sum_s * sum_s > least * least;
        let averaged = (skip[i] == 0) & known & coherent;
        // One, three or five rows.
        let more = if rows > 1.0 { 1.0 / 3.0 } else { 1.0 };
        let share = if rows > 3.0 { 1.0 / 5.0 } else { more };
        out[0][i] = if averaged { sum_c * share } else { c[i] };
        out[1][i] = if averaged { sum_s * share } else { s[i] };
    }
    out
}

/// How strong a pair of rows is at a place, 0 where it takes no part, and what it adds to C and S.
#[inline(always)]
fn of_pair([a, b]: &[Row<'_>; 2], most_misfit: f32, i: usize) -> [f32; 3] {
    let size = if a[2][i] < b[2][i] { a[2][i] } else { b[2][i] };
    let takes_part = (size > 0.0) & (a[3][i] <= most_misfit) & (b[3][i] <= most_misfit);
    // By its bits: else the compiler makes a branch of it, and stores with a mask.
    let weaker = f32::from_bits(size.to_bits() & if takes_part { u32::MAX } else { 0 });
    [weaker, weaker * (a[0][i] + b[0][i]), weaker * (a[1][i] + b[1][i])]
}

/// Phasors of length 1 in the direction of a block's, and the lengths of these; 0 where there is none.
#[inline(always)]
pub(crate) fn units(c: &Lanes, s: &Lanes) -> [Lanes; 3] {
    let mut out = [[0f32; LANES]; 3];
    for i in 0..LANES {
        let size = (c[i] * c[i] + s[i] * s[i]).sqrt();
        let scale = 1.0 / if size > 0.0 { size } else { 1.0 };
        out[0][i] = c[i] * scale;
        out[1][i] = s[i] * scale;
        out[2][i] = size;
    }
    out
}

/// The phase of a phasor; NaN where it is 0.
#[inline(always)]
pub(crate) fn phase(c: f32, s: f32) -> f32 {
    let known = (c != 0.0) | (s != 0.0);
    if known { fast_atan2::atan2(s, c) } else { f32::NAN }
}

#[cfg(test)]
mod tests {
    use super::Gains;
    use crate::base::image::{Mono8, Plane};
    use crate::phase::for_tests::{Phasors, average_rows, demodulate, wrapped};
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
        fn second_and_third_harmonics_cancel(
            period in 8.0f32..18.0, second in -0.05f32..0.05, third in -0.05f32..0.05,
        ) {
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

    /// The mean of a pixel's rows, one pair after the other, as in [`average_rows`].
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
