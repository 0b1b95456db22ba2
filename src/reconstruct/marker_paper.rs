//! The paper's marker and shift (4.1): the marker is found by a band pass in the Fourier transform of each image column, a
//! threshold and the largest segment; the median of the unwrapped phase under it gives the shift (Equation 5).

use super::absolute::shift_of_median;
use super::components;
use super::pair::Pair;
use super::runs::Runs;
use crate::image::{Mono8, Plane};
use rustfft::FftPlanner;
use rustfft::num_complex::Complex;
use std::f32::consts::FRAC_PI_2;

/// The marker's band: frequencies from 1 / (this * period) to this / period.
const BAND: f32 = 1.35;

/// Share of the brightest band energy, relative to the light, that counts as marker.
const THRESHOLD: f32 = 0.35;

/// Mm: energy in the marker's band along each column, relative to the local light, and the largest segment of
/// what exceeds the threshold (1 there). `runs` are the mask's.
pub fn marker(image: Mono8<'_>, mask: &Plane<u8>, runs: &Runs, pair: &Pair) -> (Plane<f32>, Plane<u8>) {
    let energy = band_energy(image, mask, pair.marker_period_px);
    let threshold = THRESHOLD * pair.marker_contrast;
    let mut segment = Plane::filled(mask.width(), mask.height(), 0u8);
    for v in 0..runs.height() {
        for run in runs.row(v) {
            let above = segment.row_mut(v)[run.columns()].iter_mut().zip(&energy.row(v)[run.columns()]);
            above.for_each(|(above, &energy)| *above = u8::from(energy > threshold));
        }
    }
    let found = Runs::of(&segment);
    let (piece, pieces) = components::connect(&found);
    let largest = (0..pieces.len()).max_by_key(|&i| (pieces[i].area, usize::MAX - i));
    for v in 0..found.height() {
        for place in found.places(v).filter(|&place| Some(piece[place] as usize) != largest) {
            segment.row_mut(v)[found.all()[place].columns()].fill(0);
        }
    }
    (energy, segment)
}

/// Columns whose light is read, and whose energies are written, together.
const COLUMNS: usize = 16;

/// Magnitude of each column after a band pass around the marker's frequency (positive frequencies only, so
/// that the magnitude is the envelope), divided by the mean light of the column's object pixels. Columns are continued
/// with darkness to a length that is quick to transform.
fn band_energy(image: Mono8<'_>, mask: &Plane<u8>, period: f32) -> Plane<f32> {
    let (w, h) = (image.width(), image.height());
    let length = quick_length(h);
    let mut planner = FftPlanner::<f32>::new();
    let (forward, inverse) = (planner.plan_fft_forward(length), planner.plan_fft_inverse(length));
    let band = length as f32 / (period * BAND)..=length as f32 * BAND / period;
    let band = band.start().ceil() as usize..(band.end().floor() as usize + 1).min(length / 2);
    let zero = Complex::new(0f32, 0.0);
    let mut out = Plane::filled(w, h, 0f32);
    let mut columns = vec![zero; COLUMNS / 2 * length];
    let mut halves = vec![zero; COLUMNS * length];
    let mut scratch = vec![zero; forward.get_inplace_scratch_len().max(inverse.get_inplace_scratch_len())];
    for first in (0..w).step_by(COLUMNS) {
        let count = COLUMNS.min(w - first);
        // Two columns are one complex one.
        let (mut sums, mut counts) = ([0u32; COLUMNS], [0u32; COLUMNS]);
        columns.fill(zero);
        for v in 0..h {
            let (image, mask) = (&image.row(v)[first..first + count], &mask.row(v)[first..first + count]);
            if is_dark(mask) {
                continue;
            }
            for i in 0..count {
                let value = image[i] * mask[i];
                (sums[i], counts[i]) = (sums[i] + u32::from(value), counts[i] + u32::from(mask[i]));
                let at = &mut columns[i / 2 * length + v];
                *if i % 2 == 0 { &mut at.re } else { &mut at.im } = f32::from(value);
            }
        }
        if counts == [0; COLUMNS] {
            continue;
        }
        forward.process_with_scratch(&mut columns, &mut scratch);
        halves.fill(zero);
        for (pair, halves) in columns.chunks_exact(length).zip(halves.chunks_exact_mut(2 * length)) {
            for k in band.clone() {
                let (x, mirrored) = (pair[k], pair[length - k].conj());
                let (sum, difference) = (x + mirrored, x - mirrored);
                halves[k] = sum * 0.5;
                halves[length + k] = Complex::new(difference.im, -difference.re) * 0.5;
            }
        }
        inverse.process_with_scratch(&mut halves, &mut scratch);
        for v in 0..h {
            let (out, mask) = (&mut out.row_mut(v)[first..first + count], &mask.row(v)[first..first + count]);
            if is_dark(mask) {
                continue;
            }
            for i in 0..count {
                let mean = (sums[i] as f32 / counts[i].max(1) as f32).max(1.0);
                let energy = 2.0 / length as f32 / mean * halves[i * length + v].norm_sqr().sqrt();
                out[i] = if mask[i] != 0 { energy } else { 0.0 };
            }
        }
    }
    out
}

/// Whether a row of the mask shows nothing of some columns: most do not.
#[inline(always)]
fn is_dark(mask: &[u8]) -> bool {
    mask.iter().fold(0, |all, x| all | x) == 0
}

/// The least length from `n` on that has no other factors than 2 and 3, and at least one 8.
fn quick_length(n: usize) -> usize {
    let smooth = |mut n: usize| {
        while n.is_multiple_of(3) {
            n /= 3;
        }
        n.is_power_of_two()
    };
    (n.next_multiple_of(8)..).step_by(8).find(|&n| smooth(n)).unwrap_or(n)
}

/// Equation 5's shift from the median of the unwrapped phase under the marker's core (|Wm| < pi/2: with the
/// pixels between two fringes the median can sit on their border). `None` without such pixels.
pub fn shift(unwrapped: &Plane<f32>, wrapped: &Plane<f32>, segment: &Plane<u8>, pair: &Pair) -> Option<f32> {
    let pixels = segment.as_slice().iter().zip(wrapped.as_slice()).zip(unwrapped.as_slice());
    let core = pixels.filter(|((marker, phase), _)| **marker != 0 && phase.abs() < FRAC_PI_2);
    let mut phases: Vec<f32> = core.map(|(_, u)| *u).filter(|u| !u.is_nan()).collect();
    phases.sort_unstable_by(f32::total_cmp);
    let median = *phases.get(phases.len() / 2)?;
    Some(shift_of_median(median, pair.pattern.marker_index))
}
