//! Latency histograms that cost one atomic addition a frame.

use std::fmt;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

/// Buckets per factor of two: quantiles are right to 19 %.
const PER_OCTAVE: u32 = 4;
/// From 1 us to over an hour.
const BUCKETS: usize = 32 * PER_OCTAVE as usize;

/// A histogram of durations in logarithmic buckets.
#[derive(Debug)]
pub struct Histogram {
    buckets: Vec<AtomicU64>,
    max_ns: AtomicU64,
}

impl Default for Histogram {
    fn default() -> Self {
        Self { buckets: (0..BUCKETS).map(|_| AtomicU64::new(0)).collect(), max_ns: AtomicU64::new(0) }
    }
}

/// The bucket of a duration: octave by its highest bit, quarter by the two bits below.
fn bucket(us: u64) -> usize {
    let us = us.max(1);
    let octave = us.ilog2();
    let quarter = if octave >= 2 { (us >> (octave - 2)) & 3 } else { (us << (2 - octave)) & 3 };
    ((octave * PER_OCTAVE) as usize + quarter as usize).min(BUCKETS - 1)
}

/// The upper edge of a bucket, us.
fn edge_us(bucket: usize) -> f64 {
    let octave = (bucket / PER_OCTAVE as usize) as i32;
    let quarter = (bucket % PER_OCTAVE as usize) as f64;
    2f64.powi(octave) * (1.0 + (quarter + 1.0) / f64::from(PER_OCTAVE))
}

impl Histogram {
    /// Counts one duration.
    pub fn record(&self, duration: Duration) {
        let us = u64::try_from(duration.as_micros()).unwrap_or(u64::MAX);
        self.buckets[bucket(us)].fetch_add(1, Ordering::Relaxed);
        let ns = u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX);
        self.max_ns.fetch_max(ns, Ordering::Relaxed);
    }

    /// How many were counted.
    pub fn count(&self) -> u64 {
        self.buckets.iter().map(|b| b.load(Ordering::Relaxed)).sum()
    }

    /// The duration that a share of all stays below, ms; 0 without any.
    pub fn quantile_ms(&self, share: f64) -> f64 {
        let counts: Vec<u64> = self.buckets.iter().map(|b| b.load(Ordering::Relaxed)).collect();
        let total: u64 = counts.iter().sum();
        let wanted = (total as f64 * share).ceil() as u64;
        let mut below = 0;
        for (i, count) in counts.iter().enumerate() {
            below += count;
            if *count > 0 && below >= wanted {
                return (edge_us(i) / 1e3).min(self.max_ms());
            }
        }
        0.0
    }

    /// The longest, ms.
    pub fn max_ms(&self) -> f64 {
        self.max_ns.load(Ordering::Relaxed) as f64 / 1e6
    }
}

impl fmt::Display for Histogram {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (p50, p99) = (self.quantile_ms(0.5), self.quantile_ms(0.99));
        write!(f, "p50 {p50:.3} ms, p99 {p99:.3} ms, max {:.3} ms", self.max_ms())
    }
}

/// A frame's way from the stream to the disk, stage by stage.
#[derive(Debug, Default)]
pub struct Latencies {
    /// Taken off the stream until its trigger is known.
    pub matched: Histogram,
    /// From there until its frame set entered the ring.
    pub assembled: Histogram,
    /// From there until the writer had taken it.
    pub written: Histogram,
    /// All of it.
    pub total: Histogram,
}

impl fmt::Display for Latencies {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { matched, assembled, written, total } = self;
        write!(f, "matched: {matched}; assembled: {assembled}; written: {written}; total: {total}")
    }
}

#[cfg(test)]
mod tests {
    use super::Histogram;
    use std::time::Duration;

    #[test]
    fn quantiles_are_right_to_a_fifth() {
        let histogram = Histogram::default();
        (1..=10_000u64).for_each(|us| histogram.record(Duration::from_micros(us)));
        for (share, truth_ms) in [(0.5, 5.0), (0.99, 9.9)] {
            let found = histogram.quantile_ms(share);
            assert!((truth_ms..truth_ms * 1.26).contains(&found), "{share}: {found} ms, truth {truth_ms} ms");
        }
        assert_eq!(histogram.max_ms(), 10.0);
    }
}
