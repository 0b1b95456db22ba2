//! Fringe period Pm, fringe amplitude Am and period stability Sm (paper, 4.1, Figure 7).
//!
//! For each object pixel a window along the row, about 2.6 nominal periods long, gives the median, largest and
//! smallest intensity. Crossings of the median, found to a fraction of a pixel and with hysteresis, are
//! counted: the period is the mean distance of crossings of equal direction.

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
    let (w, h) = (image.width(), image.height());
    let half = (1.3 * nominal_px).round() as usize;
    let mut raw = Plane::filled(w, h, 0f32);
    let mut amplitude = Plane::filled(w, h, 0u8);
    for v in 0..h {
        for run in runs(mask.row(v)) {
            measure_run(image.row(v), run, half, raw.row_mut(v), amplitude.row_mut(v));
        }
    }
    Periods { period: box_mean_of_valid(&raw, mask, SMOOTH_COLUMNS, SMOOTH_ROWS), amplitude }
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

fn measure_run(row: &[u8], run: Range<usize>, half: usize, period: &mut [f32], amplitude: &mut [u8]) {
    let length = (2 * half + 1).min(run.len());
    let mut window = SlidingMedian::default();
    let mut at = run.start..run.start;
    for c in run.clone() {
        // Near the run's ends the window is shifted, not cut: two whole periods are needed.
        let start = c.saturating_sub(half).clamp(run.start, run.end - length);
        while at.end < start + length {
            window.add(row[at.end]);
            at.end += 1;
        }
        while at.start < start {
            window.remove(row[at.start]);
            at.start += 1;
        }
        let samples = &row[at.clone()];
        let (low, high) = extremes(samples);
        amplitude[c] = high - low;
        period[c] = mean_crossing_distance(samples, window.median(), HYSTERESIS * f32::from(high - low));
    }
}

fn extremes(samples: &[u8]) -> (u8, u8) {
    samples.iter().fold((u8::MAX, 0), |(low, high), &x| (low.min(x), high.max(x)))
}

/// Mean distance of crossings of equal direction, px; 0 where there are too few or the figure is outside
/// [`PERIOD_RANGE_PX`].
fn mean_crossing_distance(samples: &[u8], threshold: f32, margin: f32) -> f32 {
    let (mut sum, mut count) = (0.0, 0u32);
    // The last crossing that counted, and the last that was seen, for falling and rising.
    let mut counted = [f32::NAN; 2];
    let mut seen = f32::NAN;
    let mut side = 0i8;
    let mut before = f32::from(*samples.first().unwrap_or(&0)) - threshold;
    for (i, &sample) in samples.iter().enumerate() {
        let value = f32::from(sample) - threshold;
        if (value > 0.0) != (before > 0.0) {
            seen = i as f32 - value / (value - before);
        }
        let now = if value > margin {
            1
        } else if value < -margin {
            -1
        } else {
            side
        };
        if now != side {
            if side != 0 {
                let direction = usize::from(now > 0);
                if !counted[direction].is_nan() {
                    sum += seen - counted[direction];
                    count += 1;
                }
                counted[direction] = seen;
            }
            side = now;
        }
        before = value;
    }
    let mean = sum / count.max(1) as f32;
    if count > 0 && PERIOD_RANGE_PX.contains(&mean) { mean } else { 0.0 }
}

/// Median of a sliding window of bytes by a histogram whose median moves with it.
struct SlidingMedian {
    count: [u16; 256],
    median: usize,
    /// Samples below `median`.
    below: u32,
    total: u32,
}

impl Default for SlidingMedian {
    fn default() -> Self {
        Self { count: [0; 256], median: 0, below: 0, total: 0 }
    }
}

impl SlidingMedian {
    fn add(&mut self, value: u8) {
        self.count[usize::from(value)] += 1;
        self.total += 1;
        self.below += u32::from(usize::from(value) < self.median);
    }

    fn remove(&mut self, value: u8) {
        self.count[usize::from(value)] -= 1;
        self.total -= 1;
        self.below -= u32::from(usize::from(value) < self.median);
    }

    /// The lower median.
    fn median(&mut self) -> f32 {
        let target = self.total.saturating_sub(1) / 2;
        while self.below > target {
            self.median -= 1;
            self.below -= u32::from(self.count[self.median]);
        }
        while self.median < 255 && self.below + u32::from(self.count[self.median]) <= target {
            self.below += u32::from(self.count[self.median]);
            self.median += 1;
        }
        self.median as f32
    }
}

/// Mean of the positive values in a box of +-`across` columns and +-`along` rows, on the mask; 0 where the box
/// holds none.
fn box_mean_of_valid(values: &Plane<f32>, mask: &Plane<u8>, across: usize, along: usize) -> Plane<f32> {
    let (w, h) = (values.width(), values.height());
    let mut out = Plane::filled(w, h, 0f32);
    let mut sums = vec![(0f32, 0u32); w];
    let mut prefix = vec![(0f64, 0u32); w + 1];
    for v in 0..h {
        sums.fill((0.0, 0));
        for row in v.saturating_sub(along)..(v + along + 1).min(h) {
            for (sum, &x) in sums.iter_mut().zip(values.row(row)) {
                sum.0 += x;
                sum.1 += u32::from(x > 0.0);
            }
        }
        for (i, &(sum, count)) in sums.iter().enumerate() {
            prefix[i + 1] = (prefix[i].0 + f64::from(sum), prefix[i].1 + count);
        }
        for run in runs(mask.row(v)) {
            for c in run {
                let (a, b) = (prefix[c.saturating_sub(across)], prefix[(c + across + 1).min(w)]);
                let count = b.1 - a.1;
                if count > 0 {
                    out.set(c, v, ((b.0 - a.0) / f64::from(count)) as f32);
                }
            }
        }
    }
    out
}

/// Sm: 1 / (1 + variance of the period, in px^2, along the row over +- one nominal period); 0 where the period
/// is unknown.
pub fn stability(period: &Plane<f32>, nominal_px: f32) -> Plane<f32> {
    let half = nominal_px.round() as usize;
    let w = period.width();
    let mut out = Plane::filled(w, period.height(), 0f32);
    let mut prefix = vec![(0f64, 0f64, 0u32); w + 1];
    for v in 0..period.height() {
        for (i, &p) in period.row(v).iter().enumerate() {
            let (sum, squares, count) = prefix[i];
            let p = f64::from(p);
            prefix[i + 1] = (sum + p, squares + p * p, count + u32::from(p > 0.0));
        }
        for (c, out) in out.row_mut(v).iter_mut().enumerate() {
            if period.at(c, v) <= 0.0 {
                continue;
            }
            let (a, b) = (prefix[c.saturating_sub(half)], prefix[(c + half + 1).min(w)]);
            let n = f64::from((b.2 - a.2).max(1));
            let mean = (b.0 - a.0) / n;
            let variance = ((b.1 - a.1) / n - mean * mean).max(0.0);
            *out = (1.0 / (1.0 + variance)) as f32;
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::{SlidingMedian, measure, runs, stability};
    use crate::image::{Mono8, Plane};
    use proptest::prelude::{ProptestConfig, any, prop_assert, prop_assert_eq, proptest};

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
            prop_assert!(stability(&found.period, 11.0).at(100, 1) > 0.9);
        }

        #[test]
        fn the_sliding_median_is_the_lower_median(values in proptest::collection::vec(any::<u8>(), 1..80), width in 1usize..20) {
            let mut window = SlidingMedian::default();
            for (i, &value) in values.iter().enumerate() {
                window.add(value);
                if i >= width {
                    window.remove(values[i - width]);
                }
                let mut sorted = values[(i + 1).saturating_sub(width)..=i].to_vec();
                sorted.sort_unstable();
                prop_assert_eq!(window.median(), f32::from(sorted[(sorted.len() - 1) / 2]));
            }
        }
    }

    #[test]
    fn runs_are_found_up_to_the_ends() {
        let found: Vec<_> = runs(&[1, 1, 0, 0, 1, 0, 1]).collect();
        assert_eq!(found, [0..2, 4..5, 6..7]);
        assert_eq!(runs(&[]).count() + runs(&[0, 0]).count(), 0);
    }
}
