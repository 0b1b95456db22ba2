// SPDX-License-Identifier: MIT OR Apache-2.0
//! Marker map Mm of the default method: which pixels lie on the distinguished fringe.
//!
//! A fringe tilted in the image has a period along the column too, and limbs alias into any band there: the
//! carrier is removed first, by the mean over exactly one period along the row. What is left is band-passed
//! along the column at the marker's period and divided by the light. The marker then is a ridge one fringe
//! wide: its energy must stand out of that 1.25 periods to either side, where edges and hems do not. Its core
//! pixels (|W| < pi/2) are separated from those of the next fringe, so that a connected component follows ONE
//! fringe by construction; it must be at least `MIN_DASHES` dashes long.

pub(crate) mod bias;
pub mod epipolar_check;
pub(crate) mod number;
pub(crate) mod pieces;

use super::kernels::connected_components::{self, Piece};
use super::kernels::pixel_runs::{Run, Runs};
use super::kernels::simd;
use super::kernels::subpixel::{self, LANES, Lanes, PAD, Periods};
use super::phase::demodulate::MAX_HALF;
use super::triangulate::camera_projector::CameraProjector;
use crate::base::image::{Mono8, Plane};
use std::f32::consts::{FRAC_PI_2, TAU};
use std::ops::Range;

/// Shortest marker that counts, in periods of its modulation.
const MIN_DASHES: f32 = 2.5;

/// A core's mean width is at most this share of the fringe period: a wider one holds more than one fringe.
const MAX_CORE_PERIODS: f32 = 0.9;

/// A marker's lateral contrast must reach this share of the modulation that is projected: blur takes the rest.
const MIN_CONTRAST: f32 = 0.25;

/// How far beside a pixel the energy is taken that counts against it, in fringe periods: beyond the next fringe's
/// flank.
const LATERAL_PERIODS: f32 = 1.25;

/// Energy beside the marker counts this much against it.
const LATERAL_WEIGHT: f32 = 1.5;

/// Pixels that the band pass takes at once: three sums of each have to stay in registers.
const BAND_LANES: usize = 16;

/// What [`ridges`] uses again from frame to frame.
#[derive(Debug, Default)]
pub(crate) struct Buffers {
    /// Light without the carrier, of as many rows as the band pass has taps, one behind the other.
    light: Vec<f32>,
    energy: Vec<f32>,
    sums: Vec<f32>,
    found: Runs,
}

/// Finds where the light has the marker's modulation along the column, in ridges that are long enough: their pixels.
/// `energy`, where it is given, becomes that modulation relative to the local light, NaN where it is not known.
pub(crate) fn ridges(
    image: Mono8<'_>,
    runs: &Runs,
    period: &Plane<f32>,
    pair: &CameraProjector,
    buffers: &mut Buffers,
    mut energy: Option<&mut Plane<f32>>,
) -> Runs {
    let (w, h) = (image.width(), image.height());
    let band = Band::new(pair.marker_period_px);
    let half = band.taps.len() - 1;
    let threshold = MIN_CONTRAST * pair.marker_contrast;
    let ring = 2 * half + 1;
    // Blocks may begin anywhere in a row and reach beyond its end.
    let stride = w + LANES;
    buffers.light.clear();
    buffers.light.resize(ring * stride, f32::NAN);
    buffers.found.clear();
    if let Some(energy) = energy.as_deref_mut() {
        energy.reset(w, h, f32::NAN);
    }
    simd::dispatch(
        #[inline(always)]
        || {
            for next in 0..h + half {
                let Buffers { light, energy: row, sums, found } = &mut *buffers;
                if next < h {
                    let light = &mut light[next % ring * stride..][..stride];
                    carrier_free_row(image.row(next), runs.row(next), period.row(next), sums, light);
                }
                let Some(v) = next.checked_sub(half) else { continue };
                if v >= half && next < h {
                    row.clear();
                    row.resize(w, f32::NAN);
                    for run in runs.row(v) {
                        band.energy((light, stride), v, run, row);
                    }
                    ridges_of_row(row, runs.row(v), period.row(v), threshold, found);
                    if let Some(energy) = energy.as_deref_mut() {
                        energy.row_mut(v).copy_from_slice(row);
                    }
                }
                found.end_row();
            }
        },
    );
    let mut ridges = Runs::default();
    let choose = |_: &[u32], pieces: &[Piece]| pieces.iter().map(|piece| is_long(piece, pair)).collect();
    connected_components::select(&buffers.found, choose, &mut ridges);
    ridges
}

/// The ridges' pixels on the core of one fringe. `wrapped` must already be that of the marker's mean light
/// (`bias.rs`): between its dashes a darkened marker has no core of its own.
pub(crate) fn detect(
    ridges: &Runs,
    period: &Plane<f32>,
    wrapped: &Plane<f32>,
    pair: &CameraProjector,
) -> Runs {
    let mut core = Runs::default();
    for v in 0..ridges.height() {
        let wrapped = wrapped.row(v);
        for run in ridges.row(v) {
            push_where(run, |_| true, |u| wrapped[u].abs() < FRAC_PI_2, &mut core);
        }
        core.end_row();
    }
    let mut cores = Runs::default();
    let choose = |piece: &[u32], pieces: &[Piece]| {
        let mut periods = vec![0f32; pieces.len()];
        for (v, place, run) in core.each() {
            periods[piece[place] as usize] += period.row(v)[run.columns()].iter().sum::<f32>();
        }
        let is_fringe = |(piece, periods): (&Piece, f32)| {
            let area = piece.area as f32;
            is_long(piece, pair) && area / piece.rows() <= MAX_CORE_PERIODS * periods / area
        };
        pieces.iter().zip(periods).map(is_fringe).collect()
    };
    connected_components::select(&core, choose, &mut cores);
    cores
}

/// Whether a piece has as many dashes as a marker.
fn is_long(piece: &Piece, pair: &CameraProjector) -> bool {
    piece.rows() >= MIN_DASHES * pair.marker_period_px
}

/// Adds the pixels of a run for which `is` holds. Stretches for which `may` is false, so that it holds nowhere, are
/// skipped.
#[inline(always)]
fn push_where(run: &Run, may: impl Fn(Range<usize>) -> bool, is: impl Fn(usize) -> bool, out: &mut Runs) {
    let mut start = None;
    for first in run.columns().step_by(LANES) {
        let stretch = first..run.end().min(first + LANES);
        let some = may(stretch.clone());
        // Of a skipped stretch the first pixel is visited: it ends a run that has begun.
        for u in if some { stretch } else { first..first + 1 } {
            match (some && is(u), start) {
                (true, None) => start = Some(u),
                (false, Some(first)) => {
                    out.push(Run::new(first, u));
                    start = None;
                }
                _ => {}
            }
        }
    }
    if let Some(first) = start {
        out.push(Run::new(first, run.end()));
    }
}

/// Light averaged over exactly one local period along the row; NaN where that window leaves the run.
#[inline(always)]
fn carrier_free_row(image: &[u8], runs: &[Run], period: &[f32], sums: &mut Vec<f32>, out: &mut [f32]) {
    out.fill(f32::NAN);
    subpixel::reserve(sums, image.len() + 1);
    for run in runs {
        let columns = run.columns();
        // The integral of the run up to each pixel's left side. Exact in f32: below 2^24.
        let mut sum = 0u32;
        sums[PAD + columns.start] = 0.0;
        for (out, &x) in sums[PAD + columns.start + 1..].iter_mut().zip(&image[columns.clone()]) {
            sum += u32::from(x);
            *out = sum as f32;
        }
        // A block ahead: the range of its distances is known only when all its periods have been compared.
        let mut next = Periods::new(&subpixel::load(period, columns.start));
        for first in columns.clone().step_by(LANES) {
            let count = LANES.min(columns.end - first);
            let periods = next;
            next = Periods::new(&subpixel::load(period, (first + LANES).min(columns.end)));
            let period = subpixel::load(period, first);
            // Pixel i spans [i - 1/2, i + 1/2].
            let left = subpixel::between(sums, first, &periods, -0.5, 0.5);
            let right = subpixel::between(sums, first, &periods, 0.5, 0.5);
            let (before, behind) = ((first - columns.start) as f32, (columns.end - 1 - first) as f32);
            let mut mean: Lanes = [0.0; LANES];
            for i in 0..LANES {
                let half = period[i] / 2.0;
                let inside = (half > 0.0)
                    & (half <= before + i as f32 + 0.5)
                    & (half < behind - i as f32 + 0.5)
                    & (half < MAX_HALF);
                mean[i] = if inside { (right[i] - left[i]) / (2.0 * half) } else { f32::NAN };
            }
            subpixel::store(out, first, count, &mean);
        }
    }
}

/// The band pass along the column: a Hann window two periods of the marker long.
struct Band {
    /// Weights of the mean, of the cosine and of the sine, at the middle row and at each distance from it.
    taps: Vec<[f32; 3]>,
    /// The share of the mean that leaks into the cosine's sum.
    leak: f32,
}

impl Band {
    fn new(period: f32) -> Self {
        let half = period.round().max(2.0) as usize;
        let tap = |i: usize| {
            let x = i as f32;
            let weight = 0.5 + 0.5 * (TAU * x / (2.0 * half as f32 + 2.0)).cos();
            let (sin, cos) = (TAU * x / period).sin_cos();
            [weight, weight * cos, weight * sin]
        };
        let taps: Vec<[f32; 3]> = (0..=half).map(tap).collect();
        let sum = |k: usize| 2.0 * taps.iter().map(|tap| tap[k]).sum::<f32>() - taps[0][k];
        let leak = sum(1) / sum(0);
        Self { taps, leak }
    }

    /// Amplitude of the band around row `v` relative to the mean, for one of its runs. NaN where the window holds
    /// NaN. `light` is a ring of rows of `stride` values, with room for a block behind each.
    #[inline(always)]
    fn energy(&self, (light, stride): (&[f32], usize), v: usize, run: &Run, out: &mut [f32]) {
        let row = v % (light.len() / stride) * stride;
        for first in run.columns().step_by(LANES) {
            let [mut mean, mut real, mut imaginary] = [[0f32; LANES]; 3];
            let parts = mean.as_chunks_mut().0.iter_mut().zip(real.as_chunks_mut().0);
            for (k, ((mean, real), imaginary)) in parts.zip(imaginary.as_chunks_mut().0).enumerate() {
                [*mean, *real, *imaginary] = self.sums((light, stride), row + first + k * BAND_LANES);
            }
            for i in 0..LANES {
                let real = real[i] - self.leak * mean[i];
                let light = if mean[i] < 1.0 { 1.0 } else { mean[i] };
                mean[i] = 2.0 * (real * real + imaginary[i] * imaginary[i]).sqrt() / light;
            }
            subpixel::store(out, first, LANES.min(run.end() - first), &mean);
        }
    }

    /// Mean, cosine and sine of a part of a block that begins at this place of the ring.
    #[inline(always)]
    fn sums(&self, (light, stride): (&[f32], usize), at: usize) -> [[f32; BAND_LANES]; 3] {
        let own: &[f32; BAND_LANES] = subpixel::chunk(light, at);
        let [mut mean, mut real, mut imaginary] = [[0f32; BAND_LANES]; 3];
        let [weight, cosine, _] = self.taps[0];
        for i in 0..BAND_LANES {
            mean[i] = weight * own[i];
            real[i] = cosine * own[i];
        }
        let (mut above, mut below) = (at, at);
        for &[weight, cosine, sine] in &self.taps[1..] {
            above = if above < stride { above + light.len() } else { above } - stride;
            below += stride;
            below = if below < light.len() { below } else { below - light.len() };
            let (above, below): (&[f32; BAND_LANES], &[f32; BAND_LANES]) =
                (subpixel::chunk(light, above), subpixel::chunk(light, below));
            for i in 0..BAND_LANES {
                let (sum, difference) = (below[i] + above[i], below[i] - above[i]);
                mean[i] += weight * sum;
                real[i] += cosine * sum;
                imaginary[i] += sine * difference;
            }
        }
        [mean, real, imaginary]
    }
}

/// The pixels of a row whose energy stands out of that beside it.
#[inline(always)]
fn ridges_of_row(energy: &[f32], runs: &[Run], period: &[f32], threshold: f32, found: &mut Runs) {
    for run in runs {
        push_where(
            run,
            #[inline(always)]
            |stretch| {
                let mut any = false;
                for &energy in &energy[stretch] {
                    any |= energy > threshold;
                }
                any
            },
            #[inline(always)]
            |u| energy[u] > threshold && lateral_contrast(energy, u, period[u]) > threshold,
            found,
        );
    }
}

/// Energy at `u` less that 1.25 periods to either side; negative where neither side is known.
#[inline(always)]
fn lateral_contrast(energy: &[f32], u: usize, period: f32) -> f32 {
    let step = (LATERAL_PERIODS * period + 0.5) as usize;
    let left = u.checked_sub(step).map_or(f32::NAN, |x| energy[x]);
    let right = energy.get(u + step).copied().unwrap_or(f32::NAN);
    if left.is_nan() && right.is_nan() {
        return -1.0;
    }
    energy[u] - LATERAL_WEIGHT * left.max(right)
}

#[cfg(test)]
mod tests {
    use super::{Band, carrier_free_row};
    use crate::kernels::pixel_runs::Run;
    use crate::kernels::subpixel::LANES;
    use proptest::prelude::{ProptestConfig, prop_assert, prop_assert_eq, proptest};
    use std::f64::consts::TAU;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn the_carrier_free_light_is_the_mean_over_one_period(
            image in proptest::collection::vec(proptest::num::u8::ANY, 150),
            start in 6.0f32..20.0,
            step in -0.05f32..0.05,
            from in 0usize..40,
        ) {
            let period: Vec<f32> = (0..150).map(|u| (start + step * u as f32).max(5.0)).collect();
            let mut found = vec![0.0; 150 + LANES];
            carrier_free_row(&image, &[Run::new(from, 141)], &period, &mut Vec::new(), &mut found);
            for u in 0..150 {
                let half = f64::from(period[u]) / 2.0;
                let (a, b) = (u as f64 - half + 0.5, u as f64 + half + 0.5);
                if u < from || u >= 141 || a < from as f64 || b >= 141.0 {
                    prop_assert!(found[u].is_nan());
                    continue;
                }
                // Pixel i spans i .. i + 1 here.
                let share = |i: usize| ((i + 1) as f64).min(b) - (i as f64).max(a);
                let sum: f64 = (0..150).map(|i| share(i).max(0.0) * f64::from(image[i])).sum();
                prop_assert!((f64::from(found[u]) - sum / (b - a)).abs() < 0.02, "{} {}", found[u], sum / (b - a));
            }
        }

        #[test]
        fn the_band_is_that_of_a_plain_sum(
            values in proptest::collection::vec(20.0f32..200.0, 64 * 60),
            period in 6.0f32..14.0,
            gap in 0usize..60,
        ) {
            let band = Band::new(period);
            let half = band.taps.len() - 1;
            let mut rows: Vec<Vec<f32>> = values.chunks(60).map(|row| [row, &[0.0; 40]].concat()).collect();
            rows[30][gap] = f32::NAN;
            let v = 31;
            let mut found = vec![f32::NAN; 60];
            let row_at = |i: usize| (v - half..=v + half).find(|row| row % (2 * half + 1) == i).expect("a row");
            let ring: Vec<Vec<f32>> = (0..=2 * half).map(|i| rows[row_at(i)].clone()).collect();
            band.energy((&ring.concat(), 100), v, &Run::new(3, 58), &mut found);
            for u in 0..60 {
                let sum = |weight: &dyn Fn(f64) -> f64| -> f64 {
                    let row = |i: usize| f64::from(rows[v + i - half][u]) * weight(i as f64 - half as f64);
                    (0..=2 * half).map(row).sum()
                };
                let window = |x: f64| 0.5 + 0.5 * (TAU * x / (2.0 * half as f64 + 2.0)).cos();
                let turn = TAU / f64::from(period);
                let (mean, real) = (sum(&window), sum(&|x| window(x) * (turn * x).cos()));
                let imaginary = sum(&|x| window(x) * (turn * x).sin());
                let expected = 2.0 * (real - f64::from(band.leak) * mean).hypot(imaginary) / mean;
                if u == gap || !(3..58).contains(&u) {
                    prop_assert_eq!(found[u].is_nan(), true);
                } else {
                    prop_assert!((f64::from(found[u]) - expected).abs() < 1e-4, "{} {expected}", found[u]);
                }
            }
        }
    }
}
