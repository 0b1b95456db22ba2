// SPDX-License-Identifier: MIT OR Apache-2.0
//! The standard uncertainty of every phase, from what the frame itself shows.
//!
//! - **Noise.** Fourth differences of the phase along the column know nothing of slope and curvature: they are noise.
//!   They are taken between rows whose means have no row in common, so that a texture of the skin, which neighbouring
//!   rows share and no mean takes off, is in them like the noise of the sensor. Their median among pixels of equal
//!   light, times the amplitude B, gives the noise of a mean by light: texture, shot and read noise, fixed pattern and
//!   rounding together, without anything being stated of sensor or skin. Means of fewer rows have more of it.
//! - **Shape.** What windows and rows do where neither light nor slope is constant is taken off to first order
//!   (`shading`, `curvature`); what is left grows with the misfit of the window, beyond the misfit that most pixels
//!   of equal light have from noise and from harmonics, which do no harm.
//! - **Doubt.** At edges of colour it is the error that `albedo_edges` expects.
//! - **Calibration.** What the camera differs from others by, beyond what it would with the true calibration.
//!
//! These are independent. Not in it: wrong fringe orders, which are refused and have no distribution. `fourdbody validate
//! truth --uncertainty` holds it against rendered truth.

use super::FrameMaps;
use crate::base::image::Plane;
use crate::data::encode_sigma;
use crate::kernels::simd;
use crate::phase::demodulate;
use crate::phase::window_quality::{self, GOOD_MISFIT, Windows};

/// Classes of light, from black to white.
const CLASSES: usize = 16;

/// The width of a class of light, DN.
const CLASS_DN: f32 = 16.0;

/// Pixels that a class needs for its noise to be taken from it.
const MIN_PIXELS: u32 = 200;

/// Weights of the five phases of a fourth difference.
const WEIGHTS: [f32; 5] = [1.0, -4.0, 6.0, -4.0, 1.0];

/// Rows from one of these phases to the next: means of [`demodulate::ROWS`] rows do not overlap then.
const LAG: usize = demodulate::ROWS;

/// The median of a squared normal number is 0.4549.
const PER_MEDIAN: f32 = 1.0 / 0.4549;

/// Fourth differences beyond this are steps, rad.
const MAX_DIFFERENCE: f32 = 2.0;

/// Pixels of more than [`GOOD_MISFIT`] are at edges, unless their misfit times the amplitude is below this: then it
/// may be noise, DN.
const MAX_NOISE_DN: f32 = 1.0;

/// Mean square of the residual over its lower quartile, for three degrees of freedom.
const PER_QUARTILE: f32 = 3.0 / 1.2125;

/// Bins of residuals: four in every factor of two from 2^-10 DN^2.
const BINS: usize = 96;

/// Noise of one row's phase times the amplitude, where no class has enough pixels, rad DN.
const DEFAULT_NOISE: f32 = 0.6;

/// What the formula is off by on every surface: panel pixels, rounding, harmonics that are left, rad.
const FLOOR_RAD: f32 = 0.0055;

/// What cameras differ by where the calibration is the true one, rad: they are compared before what bends and shades the
/// phase is taken off. What they differ by beyond that is the calibration's.
const TRUE_DIFFERENCE_RAD: f32 = 0.03;

/// Standard uncertainty per misfit beyond that of noise, rad.
const PER_MISFIT: f32 = 0.4;

/// The square of a misfit is unusual from this many times the usual one on.
const USUAL: f32 = 2.0;

/// The errors that `edges` expects are RMS values over long tails; their core is narrower.
const CORE_SHARE: f32 = 0.55;

/// The standard uncertainty of every known phase, as a byte ([`encode_sigma`]). `expected`: the error that `edges`
/// found for doubtful pixels, NaN for all others. `marker_rows`: rows averaged where `zone` is not 0. `differs_rad`: by
/// how much the camera differs from others.
pub fn sigma_codes(
    absolute: &Plane<f32>,
    FrameMaps { windows, zone, .. }: FrameMaps<'_>,
    expected: &Plane<f32>,
    marker_rows: f32,
    differs_rad: f32,
) -> Plane<u8> {
    let (width, height) = (absolute.width(), absolute.height());
    let rows = averaged_rows(windows);
    let noise = Noise::of(absolute, windows, &rows);
    let mut sigma_codes = Plane::filled(width, height, 0u8);
    let calibration = differs_rad * differs_rad - TRUE_DIFFERENCE_RAD * TRUE_DIFFERENCE_RAD;
    let everywhere = FLOOR_RAD * FLOOR_RAD + calibration.max(0.0);
    simd::dispatch(
        #[inline(always)]
        || {
            for v in 0..height {
                let rows = rows.row(v);
                let (phase, misfit) = (absolute.row(v), windows.misfit.row(v));
                let (strength, light) = (windows.strength.row(v), windows.light.row(v));
                let (zone, expected) = (zone.row(v), expected.row(v));
                for (u, sigma_code) in sigma_codes.row_mut(v).iter_mut().enumerate() {
                    if phase[u].is_nan() {
                        continue;
                    }
                    let amplitude = window_quality::amplitude(strength[u]).max(0.1);
                    let rows = if zone[u] != 0 { marker_rows.max(1.0) } else { f32::from(rows[u]) };
                    let [variance, usual] =
                        noise.at(window_quality::light(light[u])).map(|x| x / (amplitude * amplitude));
                    let random = (variance / rows).sqrt();
                    let shape = if expected[u].is_nan() {
                        let beyond = misfit[u] * misfit[u] - USUAL * usual;
                        PER_MISFIT * beyond.max(0.0).sqrt()
                    } else {
                        CORE_SHARE * expected[u]
                    };
                    *sigma_code = encode_sigma((random * random + shape * shape + everywhere).sqrt());
                }
            }
        },
    );
    sigma_codes
}

/// How many rows went into each phasor.
fn averaged_rows(windows: &Windows) -> Plane<u8> {
    let misfit = &windows.misfit;
    let mut rows = Plane::filled(misfit.width(), misfit.height(), 1u8);
    simd::dispatch(
        #[inline(always)]
        || {
            for v in 0..misfit.height() {
                let (own, rows) = (misfit.row(v), rows.row_mut(v));
                for k in 1..=demodulate::row_reach(v, misfit.height()) {
                    let (above, below) = (misfit.row(v - k), misfit.row(v + k));
                    let (light_above, light_below) = (windows.light.row(v - k), windows.light.row(v + k));
                    for (u, rows) in rows.iter_mut().enumerate() {
                        let known = (light_above[u] > 0) & (light_below[u] > 0);
                        let takes_part = known & (above[u].max(below[u]) <= own[u] + demodulate::MORE_MISFIT);
                        *rows += if takes_part { 2 } else { 0 };
                    }
                }
            }
        },
    );
    rows
}

/// For each class of light: the variance of one row's phase, rad^2, and the usual mean square of the misfit, both times
/// the square of the amplitude.
struct Noise([[f32; 2]; CLASSES]);

type Counts = [[u32; BINS]; CLASSES];

impl Noise {
    /// `rows`: how many each phase is the mean of.
    fn of(absolute: &Plane<f32>, windows: &Windows, rows: &Plane<u8>) -> Self {
        let (mut differences, mut residuals): (Counts, Counts) = ([[0; BINS]; CLASSES], [[0; BINS]; CLASSES]);
        const REACH: usize = WEIGHTS.len() / 2 * LAG;
        for v in REACH..absolute.height().saturating_sub(REACH) {
            let phases: [&[f32]; WEIGHTS.len()] = std::array::from_fn(|k| absolute.row(v + k * LAG - REACH));
            let counts: [&[u8]; WEIGHTS.len()] = std::array::from_fn(|k| rows.row(v + k * LAG - REACH));
            let (strength, light) = (windows.strength.row(v), windows.light.row(v));
            let misfit = windows.misfit.row(v);
            for u in 0..absolute.width() {
                let difference: f32 = WEIGHTS.iter().zip(phases).map(|(w, phase)| w * phase[u]).sum();
                let amplitude = window_quality::amplitude(strength[u]);
                let level = (misfit[u] < GOOD_MISFIT) | (misfit[u] * amplitude < MAX_NOISE_DN);
                // False for NaN.
                if (difference.abs() < MAX_DIFFERENCE) & level {
                    // Normalized to the noise of one row; `sigma_codes` divides by the number of rows again.
                    let share: f32 = WEIGHTS.iter().zip(counts).map(|(w, n)| w * w / f32::from(n[u])).sum();
                    let power = amplitude * amplitude;
                    let class = class(window_quality::light(light[u]));
                    differences[class][bin(difference * difference / share * power)] += 1;
                    residuals[class][bin(misfit[u] * misfit[u] * power)] += 1;
                }
            }
        }
        let variance = by_class(&differences, 2, PER_MEDIAN, DEFAULT_NOISE * DEFAULT_NOISE);
        let usual = by_class(&residuals, 4, PER_QUARTILE, 1.0);
        Self(std::array::from_fn(|i| [variance[i], usual[i]]))
    }

    /// Both at a mean light, DN, between the middles of the classes.
    #[inline(always)]
    fn at(&self, light: f32) -> [f32; 2] {
        let place = (light / CLASS_DN - 0.5).clamp(0.0, (CLASSES - 1) as f32);
        let below = (place as usize).min(CLASSES - 2);
        let t = place - below as f32;
        let (a, b) = (self.0[below], self.0[below + 1]);
        [a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])]
    }
}

/// `factor` times the value that one in `part` of each class does not exceed. Classes with few pixels take what the
/// nearest darker one has, the darkest that of the next brighter one.
fn by_class(counts: &Counts, part: u32, factor: f32, default: f32) -> [f32; CLASSES] {
    let mut values = counts.map(|counts| {
        let all: u32 = counts.iter().sum();
        let mut below = 0;
        let found = counts.iter().position(|count| {
            below += count;
            part * below >= all
        });
        found.filter(|_| all >= MIN_PIXELS).map_or(f32::NAN, |bin| factor * bin_value(bin))
    });
    let mut last = values.iter().copied().find(|x| !x.is_nan()).unwrap_or(default);
    for x in &mut values {
        last = if x.is_nan() { last } else { *x };
        *x = last;
    }
    values
}

fn class(light: f32) -> usize {
    ((light / CLASS_DN) as usize).min(CLASSES - 1)
}

/// The bits of a float from here on: as a number they grow by 1 with every quarter of an octave, nearly.
const BIN_SHIFT: u32 = 21;

/// These bits of 2^-10, the lower end of the first bin.
const FIRST_BIN: u32 = (127 - 10) << 2;

fn bin(left: f32) -> usize {
    ((left.to_bits() >> BIN_SHIFT).saturating_sub(FIRST_BIN) as usize).min(BINS - 1)
}

/// The middle of a bin.
fn bin_value(bin: usize) -> f32 {
    f32::from_bits(((FIRST_BIN + bin as u32) << BIN_SHIFT) + (1 << (BIN_SHIFT - 1)))
}

#[cfg(test)]
mod tests {
    use super::{bin, bin_value};
    use crate::base::image::{Mono8, Plane};
    use crate::phase::demodulate::Gains;
    use crate::phase::for_tests::{average_rows, demodulate, wrapped};
    use std::f32::consts::TAU;

    #[test]
    fn bins_hold_what_they_stand_for() {
        for i in 0..90 {
            assert_eq!(bin(bin_value(i)), i);
        }
        assert!((bin_value(bin(1.3)) / 1.3 - 1.0).abs() < 0.12);
    }

    /// Neighbouring phases share samples and rows (`docs/design/phase.md`, *Correlation*).
    #[test]
    fn noise_is_correlated_over_a_period_and_five_rows() {
        const PERIOD: f32 = 11.3;
        let (width, height) = (900, 900);
        let mut state = 1u64;
        // The sum of twelve numbers of 0 to 1 is nearly normal, of variance 1.
        let mut noise = || {
            let mut uniform = || {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                (state >> 40) as f32 / (1u64 << 24) as f32
            };
            (0..12).map(|_| uniform()).sum::<f32>() - 6.0
        };
        let mut image = Plane::filled(width, height, 0u8);
        for v in 0..height {
            for u in 0..width {
                let light = 120.0 + 100.0 * (TAU * u as f32 / PERIOD).cos() + 1.5 * noise();
                image.set(u, v, light.round() as u8);
            }
        }
        let [mask, skip] = [1, 0].map(|x| Plane::filled(width, height, x));
        let period = Plane::filled(width, height, PERIOD);
        let mut phasors = demodulate(Mono8::from(&image), &mask, &period, &Gains::new(), 1.0);
        average_rows(&mut phasors, &skip);
        let wrapped = wrapped(&phasors);
        let off = |u: usize, v: usize| {
            let off = wrapped.at(u, v) - TAU * u as f32 / PERIOD;
            off - TAU * (off / TAU).round()
        };
        let mut error = Plane::filled(width, height, 0f32);
        for u in 20..width - 20 {
            // What interpolation is off by is no noise: it is the same in all rows.
            let mean = (0..height).map(|v| off(u, v)).sum::<f32>() / height as f32;
            (0..height).for_each(|v| error.set(u, v, off(u, v) - mean));
        }
        let correlation = |columns: usize, rows: usize| {
            let places = (20..height - 20).flat_map(|v| (20..width - 40).map(move |u| (u, v)));
            let (sum, square) = places.fold((0.0, 0.0), |(sum, square), (u, v)| {
                let own = f64::from(error.at(u, v));
                (sum + own * f64::from(error.at(u + columns, v + rows)), square + own * own)
            });
            sum / square
        };
        let along: Vec<f64> = (1..=14).map(|by| correlation(by, 0)).collect();
        let across: Vec<f64> = (1..=6).map(|by| correlation(0, by)).collect();
        println!("columns {along:.2?}\nrows {across:.2?}");
        let [columns, rows] = [&along, &across].map(|x| 1.0 + 2.0 * x.iter().sum::<f64>());
        assert!((columns / f64::from(PERIOD) - 0.7).abs() < 0.08, "{columns}");
        assert!((rows - 5.0).abs() < 0.5, "{rows}");
        assert!(along[11].abs() < 0.05 && across[4].abs() < 0.05, "{along:?} {across:?}");
    }
}
