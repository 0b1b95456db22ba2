//! The standard uncertainty of every phase, from what the frame itself shows.
//!
//! - **Noise.** What offset, slope and fringe leave of seven samples is noise where it is least: its lower quartile
//!   among pixels of equal light gives the noise of a sample by light, shot and read noise, fixed pattern and rounding
//!   together, without anything being stated of the sensor. The formula turns noise `s` into `0.561 s / B` rad (B:
//!   amplitude), the mean of n rows divides by `sqrt(n)`.
//! - **Shape.** What windows and rows do where neither light nor slope is constant is taken off to first order
//!   (`shading`, `curvature`); what is left grows with the misfit of the window.
//! - **Doubt.** At edges of colour `edges` says what error to expect.
//!
//! These are independent. Not in it: the calibration, which moves all points of a camera together, and wrong fringe
//! orders, which are refused and have no distribution. `fourdbody validate truth --uncertainty` holds it against
//! rendered truth.

use super::demodulate::Phasors;
use super::simd;
use crate::export::doubt_of;
use crate::image::Plane;

/// Standard uncertainty of the seven-point formula's phase for noise of 1 DN and an amplitude of 1 DN, rad.
const NOISE_GAIN: f32 = 0.561;

/// Classes of light, and their width in DN.
const CLASSES: usize = 16;
const CLASS_DN: f32 = 16.0;

/// Pixels that a class needs for its noise to be taken from it.
const MIN_PIXELS: u32 = 200;

/// Variance of a sample over the lower quartile of the mean square of seven residuals with three degrees of freedom
/// (7 / 1.2125).
const PER_QUARTILE: f32 = 5.77;

/// Bins of residuals: four in every factor of two from 2^-10 DN^2.
const BINS: usize = 96;

/// Noise of a sample where no class has enough pixels, DN.
const DEFAULT_NOISE_DN: f32 = 1.0;

/// What the formula is off by on every surface: panel pixels, rounding, harmonics that are left, rad.
const FLOOR_RAD: f32 = 0.002;

/// Standard uncertainty per misfit beyond that of noise, rad.
const PER_MISFIT: f32 = 0.4;

/// Twice the mean square of the misfit that a sample's variance of 1 DN^2 gives a fringe of 1 DN: three of seven
/// degrees of freedom are left.
const MISFIT_OF_NOISE: f32 = 2.0 * 3.0 / 7.0;

/// The errors that `edges` expects are RMS values over long tails; their core is narrower.
const CORE_SHARE: f32 = 0.55;

/// Rows that `demodulate::average_rows` takes from on each side, and its bound.
const ROWS_EACH_SIDE: usize = 2;
const MORE_MISFIT: f32 = 0.03;

/// The standard uncertainty of every known phase, as a byte ([`doubt_of`]). `expected`: the error that `edges` found
/// for doubtful pixels, NaN for all others. `marker_rows`: rows averaged where `zone` is not 0.
pub fn doubts(
    absolute: &Plane<f32>,
    phasors: &Phasors,
    expected: &Plane<f32>,
    zone: &Plane<u8>,
    marker_rows: f32,
) -> Plane<u8> {
    let (width, height) = (absolute.width(), absolute.height());
    let noise = Noise::of(absolute, phasors);
    let mut doubts = Plane::filled(width, height, 0u8);
    simd::dispatch(
        #[inline(always)]
        || {
            let mut rows = vec![0f32; width];
            for v in 0..height {
                averaged_rows(phasors, v, &mut rows);
                let (phase, misfit) = (absolute.row(v), phasors.misfit.row(v));
                let (c, s, mean) = (phasors.c.row(v), phasors.s.row(v), phasors.mean.row(v));
                let (zone, expected) = (zone.row(v), expected.row(v));
                for (u, doubt) in doubts.row_mut(v).iter_mut().enumerate() {
                    if phase[u].is_nan() {
                        continue;
                    }
                    let amplitude = ((c[u] * c[u] + s[u] * s[u]).sqrt() / 6.0).max(0.1);
                    let rows = if zone[u] != 0 { marker_rows.max(1.0) } else { rows[u] };
                    let relative = noise.variance(mean[u]) / (amplitude * amplitude);
                    let random = NOISE_GAIN * (relative / rows).sqrt();
                    let shape = if expected[u].is_nan() {
                        let beyond = misfit[u] * misfit[u] - MISFIT_OF_NOISE * relative;
                        PER_MISFIT * beyond.max(0.0).sqrt()
                    } else {
                        CORE_SHARE * expected[u]
                    };
                    *doubt = doubt_of((random * random + shape * shape + FLOOR_RAD * FLOOR_RAD).sqrt());
                }
            }
        },
    );
    doubts
}

/// How many rows went into each phasor of row `v`.
#[inline(always)]
fn averaged_rows(phasors: &Phasors, v: usize, rows: &mut [f32]) {
    rows.fill(1.0);
    let misfit = &phasors.misfit;
    let own = misfit.row(v);
    for k in 1..=ROWS_EACH_SIDE.min(v).min(misfit.height() - 1 - v) {
        let (above, below) = (misfit.row(v - k), misfit.row(v + k));
        let (mean_above, mean_below) = (phasors.mean.row(v - k), phasors.mean.row(v + k));
        for (u, rows) in rows.iter_mut().enumerate() {
            let known = (mean_above[u] > 0.0) & (mean_below[u] > 0.0);
            let takes_part = known & (above[u].max(below[u]) <= own[u] + MORE_MISFIT);
            *rows += if takes_part { 2.0 } else { 0.0 };
        }
    }
}

/// Variance of a sample by light.
struct Noise([f32; CLASSES]);

impl Noise {
    fn of(absolute: &Plane<f32>, phasors: &Phasors) -> Self {
        let mut counts = [[0u32; BINS]; CLASSES];
        for v in 0..absolute.height() {
            let (c, s, misfit) = (phasors.c.row(v), phasors.s.row(v), phasors.misfit.row(v));
            for (u, (phase, mean)) in absolute.row(v).iter().zip(phasors.mean.row(v)).enumerate() {
                if !phase.is_nan() {
                    let left = misfit[u] * misfit[u] * (c[u] * c[u] + s[u] * s[u]) / 36.0;
                    counts[class(*mean)][bin(left)] += 1;
                }
            }
        }
        let mut variance = counts.map(|counts| {
            let all: u32 = counts.iter().sum();
            let mut below = 0;
            let quartile = counts.iter().position(|count| {
                below += count;
                4 * below >= all
            });
            let enough = all >= MIN_PIXELS;
            quartile.filter(|_| enough).map_or(f32::NAN, |bin| PER_QUARTILE * bin_value(bin))
        });
        // Classes with few pixels take what the nearest darker one has, the darkest that of the next brighter one.
        let first = variance.iter().copied().find(|x| !x.is_nan());
        let mut last = first.unwrap_or(DEFAULT_NOISE_DN * DEFAULT_NOISE_DN);
        for x in &mut variance {
            last = if x.is_nan() { last } else { *x };
            *x = last;
        }
        Self(variance)
    }

    /// Variance at a mean light, DN^2, between the middles of the classes.
    #[inline(always)]
    fn variance(&self, light: f32) -> f32 {
        let place = (light / CLASS_DN - 0.5).clamp(0.0, (CLASSES - 1) as f32);
        let below = (place as usize).min(CLASSES - 2);
        let t = place - below as f32;
        self.0[below] + t * (self.0[below + 1] - self.0[below])
    }
}

fn class(light: f32) -> usize {
    ((light / CLASS_DN) as usize).min(CLASSES - 1)
}

/// The bits of a float above its mantissa's second grow by 1 with every quarter of an octave, nearly.
const BIN_SHIFT: u32 = 21;
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

    #[test]
    fn bins_hold_what_they_stand_for() {
        for i in 0..90 {
            assert_eq!(bin(bin_value(i)), i);
        }
        assert!((bin_value(bin(1.3)) / 1.3 - 1.0).abs() < 0.12);
    }
}
