// SPDX-License-Identifier: MIT OR Apache-2.0
//! Histograms of durations that cost a few atomic additions a value: threads count while others read.

use serde::{Deserialize, Serialize};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

/// Classes per doubling: a quantile is at most an eighth too high.
const PER_OCTAVE: u32 = 8;
/// The number of classes: from 1 us to over an hour.
const CLASSES: usize = 32 * PER_OCTAVE as usize;

/// Counts of durations in logarithmic classes.
#[derive(Debug)]
pub struct Histogram {
    counts: Box<[AtomicU64]>,
    max_ns: AtomicU64,
    sum_us: AtomicU64,
}

/// A distribution of durations, microseconds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Latency {
    /// The median: half of the durations are not longer.
    pub p50_us: u64,
    /// 99 of 100 are not longer.
    pub p99_us: u64,
    /// The longest of all durations, exact.
    pub max_us: u64,
}

impl Default for Histogram {
    fn default() -> Self {
        let counts = (0..CLASSES).map(|_| AtomicU64::new(0)).collect();
        Self { counts, max_ns: AtomicU64::new(0), sum_us: AtomicU64::new(0) }
    }
}

impl Histogram {
    /// Counts one duration in its class.
    pub fn record(&self, duration: Duration) {
        let us = u64::try_from(duration.as_micros()).unwrap_or(u64::MAX);
        self.counts[class(us)].fetch_add(1, Ordering::Relaxed);
        self.max_ns.fetch_max(u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX), Ordering::Relaxed);
        self.sum_us.fetch_add(us, Ordering::Relaxed);
    }

    /// The number of durations that were counted.
    pub fn count(&self) -> u64 {
        self.loaded().iter().sum()
    }

    /// The sum of all durations, us.
    pub fn sum_us(&self) -> u64 {
        self.sum_us.load(Ordering::Relaxed)
    }

    /// The longest duration so far, us.
    pub fn max_us(&self) -> u64 {
        self.max_ns.load(Ordering::Relaxed) / 1000
    }

    /// The longest duration so far, ms.
    pub fn max_ms(&self) -> f64 {
        self.max_ns.load(Ordering::Relaxed) as f64 / 1e6
    }

    /// The duration that a share of all stays below, ms; 0 without any.
    pub fn quantile_ms(&self, share: f64) -> f64 {
        (self.quantile_us(share) as f64 / 1e3).min(self.max_ms())
    }

    /// Median, 99 % and the longest.
    pub fn summary(&self) -> Latency {
        Latency { p50_us: self.quantile_us(0.5), p99_us: self.quantile_us(0.99), max_us: self.max_us() }
    }

    /// How many were shorter than each of these powers of two, us: what a cumulative histogram needs.
    pub fn below_powers_of_two(&self, exponents: impl IntoIterator<Item = u32>) -> Vec<u64> {
        let counts = self.loaded();
        let below = |exponent: u32| {
            // A power of two begins a class.
            let first = class(1u64.checked_shl(exponent).unwrap_or(u64::MAX));
            counts.iter().take(first).sum()
        };
        exponents.into_iter().map(below).collect()
    }

    fn loaded(&self) -> Vec<u64> {
        self.counts.iter().map(|count| count.load(Ordering::Relaxed)).collect()
    }

    /// The upper bound of the class in which the quantile lies.
    fn quantile_us(&self, share: f64) -> u64 {
        let counts = self.loaded();
        let total: u64 = counts.iter().sum();
        let mut left = (total as f64 * share).ceil() as u64;
        for (class, count) in counts.iter().enumerate() {
            if *count >= left {
                return if left == 0 { 0 } else { upper_bound(class).min(self.max_us()) };
            }
            left -= count;
        }
        self.max_us()
    }
}

/// Values below `PER_OCTAVE` have a class each; above, the bits after the first one choose it.
fn class(us: u64) -> usize {
    let per = u64::from(PER_OCTAVE);
    if us < per {
        return us as usize;
    }
    let octave = us.ilog2() - PER_OCTAVE.ilog2();
    ((u64::from(octave) * per + (us >> octave)) as usize).min(CLASSES - 1)
}

fn upper_bound(class: usize) -> u64 {
    let (class, per) = (class as u64, u64::from(PER_OCTAVE));
    if class < per {
        return class;
    }
    let octave = class / per - 1;
    ((class - octave * per + 1) << octave) - 1
}

#[cfg(test)]
mod tests {
    use super::{Histogram, Latency, class, upper_bound};
    use std::time::Duration;

    #[test]
    fn classes_follow_each_other_and_are_narrow() {
        let mut before = 0;
        for us in (0..100_000).chain((17..30).map(|n| 1 << n)) {
            let bound = upper_bound(class(us));
            assert!(bound >= us && bound <= us + us / 8, "{us} is in the class up to {bound}");
            assert!(class(us) >= before);
            before = class(us);
        }
        assert_eq!(class(u64::MAX), super::CLASSES - 1);
    }

    #[test]
    fn quantiles_are_those_of_the_values() {
        let histogram = Histogram::default();
        assert_eq!(histogram.summary(), Latency::default());
        (1..=1000).for_each(|ms| histogram.record(Duration::from_millis(ms)));
        let found = histogram.summary();
        assert!((500_000..=563_000).contains(&found.p50_us), "{found:?}");
        assert!((990_000..=1_000_000).contains(&found.p99_us), "{found:?}");
        assert_eq!((found.max_us, histogram.max_ms()), (1_000_000, 1000.0));
        assert_eq!((histogram.count(), histogram.sum_us()), (1000, 500_500_000));
    }

    #[test]
    fn counts_below_powers_of_two_are_exact() {
        let histogram = Histogram::default();
        (0..5000).for_each(|us| histogram.record(Duration::from_micros(us)));
        assert_eq!(histogram.below_powers_of_two([0, 3, 10, 12, 13]), [1, 8, 1024, 4096, 5000]);
    }
}
