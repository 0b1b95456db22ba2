//! Fringe period Pm, fringe amplitude Am and period stability Sm (paper, 4.1, Figure 7).
//!
//! For each object pixel a window along the row, about 2.6 nominal periods long, gives the median, largest and
//! smallest intensity. Crossings of the median, found to a fraction of a pixel and with hysteresis, are
//! counted: the period is the mean distance of crossings of equal direction.

use super::period_windows::Windows;
use super::runs::{Runs, Surroundings};
use super::{period_fast, simd};
use crate::image::{Mono8, Plane};
use std::ops::Range;

/// Periods outside this range are not measured, px.
pub const PERIOD_RANGE_PX: std::ops::RangeInclusive<f32> = 5.0..=24.0;

/// A crossing counts once the intensity has left the median by this share of the window's range.
pub(super) const HYSTERESIS: f32 = 0.12;

/// Half sides of the box over which the period is smoothed, px.
pub(super) const SMOOTH_COLUMNS: usize = 6;
pub(super) const SMOOTH_ROWS: usize = 1;

/// The maps of this stage.
#[derive(Debug)]
pub struct Periods {
    /// Fringe period, px; 0 where it is unknown.
    pub period: Plane<f32>,
    /// Largest minus smallest intensity in the window, DN.
    pub amplitude: Plane<u8>,
}

/// Measures period and amplitude on the mask. Windows never leave the mask's runs.
pub fn measure(image: Mono8<'_>, mask: &Plane<u8>, nominal_px: f32) -> Periods {
    let runs = Runs::of(mask);
    let half = (1.3 * nominal_px).round() as usize;
    let mut amplitude = Plane::filled(image.width(), image.height(), 0u8);
    let mut period = Plane::default();
    let mut windows = Windows::default();
    // All else is 0 already.
    let nothing_more = Surroundings::default();
    period_fast::measure_with(
        (&runs, &nothing_more),
        (image.width(), image.height()),
        &mut period_fast::Buffers::default(),
        &mut period,
        #[inline(always)]
        |v, run, _, raw| {
            let row = &image.row(v)[run.columns()];
            let count = windows.measure(row, (2 * half + 1).min(row.len()));
            // Near the run's ends the window is shifted, not cut: two whole periods are needed.
            let amplitude = &mut amplitude.row_mut(v)[run.columns()];
            for (i, (raw, amplitude)) in raw.iter_mut().zip(amplitude).enumerate() {
                let window = i.saturating_sub(half).min(count - 1);
                *raw = period_fast::packed(windows.distance[window]);
                *amplitude = windows.range(window);
            }
        },
    );
    Periods { period, amplitude }
}

/// The runs of non-zero pixels of one row.
pub fn runs(mask: &[u8]) -> impl Iterator<Item = Range<usize>> + '_ {
    let mut next = 0;
    std::iter::from_fn(move || {
        let start = next + mask.get(next..)?.iter().position(|&x| x != 0)?;
        let end = mask[start..].iter().position(|&x| x == 0).map_or(mask.len(), |n| start + n);
        next = end;
        Some(start..end)
    })
}

/// Steps of a pixel in which periods are summed here: squares of a window of them fit a word.
const STEPS: f32 = 64.0;

/// Sm: 1 / (1 + variance of the period, in px^2, along the row over +- one nominal period); 0 where the period
/// is unknown. The period is known within `runs` only.
pub fn stability(period: &Plane<f32>, runs: &Runs, nominal_px: f32) -> Plane<f32> {
    let half = nominal_px.round() as usize;
    let (w, h) = (period.width(), period.height());
    let mut out = Plane::filled(w, h, 0f32);
    // Sums, sums of squares and counts up to each column, which is `half + 1` further on.
    let mut sums: [Vec<u32>; 3] = std::array::from_fn(|_| vec![0; w + 2 * half + 1]);
    simd::dispatch(
        #[inline(always)]
        || {
            for v in 0..h {
                let row = period.row(v);
                let [all, squared, counted] = &mut sums;
                let (mut sum, mut squares, mut count, mut done) = (0u32, 0u32, 0u32, half + 1);
                for run in runs.row(v) {
                    let places = run.start() + half + 1..run.end() + half + 1;
                    all[done..places.start].fill(sum);
                    squared[done..places.start].fill(squares);
                    counted[done..places.start].fill(count);
                    let out = all[places.clone()].iter_mut().zip(&mut squared[places.clone()]);
                    for ((out, &p), counted) in out.zip(&row[run.columns()]).zip(&mut counted[places.clone()])
                    {
                        let p = (p * STEPS) as i32 as u32;
                        sum = sum.wrapping_add(p);
                        squares = squares.wrapping_add(p * p);
                        count += u32::from(p > 0);
                        (*out.0, *out.1, *counted) = (sum, squares, count);
                    }
                    done = places.end;
                }
                all[done..].fill(sum);
                squared[done..].fill(squares);
                counted[done..].fill(count);
                for run in runs.row(v) {
                    let (start, n) = (run.start(), run.columns().len());
                    let [before, last] = [start, start + 2 * half + 1]
                        .map(|from| [0, 1, 2].map(|k: usize| &sums[k][from..from + n]));
                    let (row, out) = (&row[run.columns()][..n], &mut out.row_mut(v)[run.columns()][..n]);
                    for i in 0..n {
                        let within = |k: usize| last[k][i].wrapping_sub(before[k][i]) as i32 as f32;
                        let count = if within(2) < 1.0 { 1.0 } else { within(2) };
                        let mean = within(0) / count;
                        let variance = (within(1) / count - mean * mean) / (STEPS * STEPS);
                        let variance = if variance > 0.0 { variance } else { 0.0 };
                        out[i] = if row[i] > 0.0 { 1.0 / (1.0 + variance) } else { 0.0 };
                    }
                }
            }
        },
    );
    out
}

#[cfg(test)]
mod tests {
    use super::{measure, runs, stability};
    use crate::image::{Mono8, Plane};
    use crate::reconstruct::runs::Runs;
    use proptest::prelude::{ProptestConfig, prop_assert, proptest};

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn the_period_of_a_noisy_sine_is_found(period in 6.0f32..18.0, phase in -3.0f32..3.0, amplitude in 15.0f32..100.0) {
            let mut image = Plane::filled(200, 3, 0u8);
            for v in 0..3 {
                for u in 0..200 {
                    let noise = ((u * 7919 + v * 104_729) % 13) as f32 / 6.5 - 1.0;
                    let wave = (std::f32::consts::TAU * u as f32 / period + phase).cos();
                    image.set(u, v, (110.0 + amplitude * wave + noise) as u8);
                }
            }
            let mask = Plane::filled(200, 3, 1u8);
            let found = measure(Mono8::from(&image), &mask, 11.0);
            for u in 20..180 {
                let p = found.period.at(u, 1);
                prop_assert!((p / period - 1.0).abs() < 0.05, "{p} at {u}, true {period}");
                let range = f32::from(found.amplitude.at(u, 1));
                prop_assert!((range / (2.0 * amplitude) - 1.0).abs() < 0.25, "{range}");
            }
            prop_assert!(stability(&found.period, &Runs::of(&mask), 11.0).at(100, 1) > 0.9);
        }
    }

    #[test]
    fn runs_are_found_up_to_the_ends() {
        let found: Vec<_> = runs(&[1, 1, 0, 0, 1, 0, 1]).collect();
        assert_eq!(found, [0..2, 4..5, 6..7]);
        assert_eq!(runs(&[]).count() + runs(&[0, 0]).count(), 0);
    }
}
