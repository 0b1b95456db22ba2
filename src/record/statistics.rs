//! How the disk kept up: latencies in logarithmic classes, cheap enough for every frame.

use serde::{Deserialize, Serialize};
use std::fmt;
use std::time::Duration;

/// Classes per doubling: a percentile is at most an eighth too high.
const PER_OCTAVE: u32 = 8;
/// From 1 us to over an hour.
const CLASSES: usize = 32 * PER_OCTAVE as usize;

/// Counts of durations.
pub(super) struct Histogram {
    counts: Box<[u64; CLASSES]>,
    max_us: u64,
}

impl Default for Histogram {
    fn default() -> Self {
        Self { counts: Box::new([0; CLASSES]), max_us: 0 }
    }
}

impl Histogram {
    pub fn add(&mut self, duration: Duration) {
        let us = u64::try_from(duration.as_micros()).unwrap_or(u64::MAX);
        self.counts[class(us)] += 1;
        self.max_us = self.max_us.max(us);
    }

    pub fn summary(&self) -> Latency {
        Latency { p50_us: self.quantile(50, 100), p99_us: self.quantile(99, 100), max_us: self.max_us }
    }

    /// The upper bound of the class in which the quantile lies.
    fn quantile(&self, part: u64, of: u64) -> u64 {
        let total: u64 = self.counts.iter().sum();
        let mut left = (total * part).div_ceil(of);
        for (class, count) in self.counts.iter().enumerate() {
            if *count >= left {
                return if left == 0 { 0 } else { upper_bound(class).min(self.max_us) };
            }
            left -= count;
        }
        self.max_us
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

/// A distribution of durations, microseconds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Latency {
    /// Half are not longer.
    pub p50_us: u64,
    /// 99 of 100 are not longer.
    pub p99_us: u64,
    /// The longest.
    pub max_us: u64,
}

/// How bytes go to the disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DiskAccess {
    /// Past the page cache (`O_DIRECT`).
    Direct,
    /// Through the page cache: the file system refuses `O_DIRECT`.
    PageCache,
}

impl fmt::Display for DiskAccess {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Direct => "past the page cache (O_DIRECT)",
            Self::PageCache => "through the page cache (the file system refuses O_DIRECT)",
        })
    }
}

/// How the disk kept up with a recording.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct WriteStatistics {
    /// Frames handed over and not refused.
    pub frames: u64,
    /// Bytes of all segments, without what closes the last one.
    pub bytes: u64,
    /// From a frame's handing over until it is in the file.
    pub written: Latency,
    /// From a frame's handing over until it survives a power cut.
    pub durable: Latency,
    /// Frame blocks that the writer held at the same time, at most.
    pub blocks_high_water: usize,
    /// Frames in blocks that were copied, because they were not where the disk can take them.
    pub copied_frames: u64,
    /// How the segments were written, the last one to be opened; not known of older recordings.
    #[serde(default)]
    pub access: Option<DiskAccess>,
}

#[cfg(test)]
mod tests {
    use super::{Histogram, class, upper_bound};
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
        let mut histogram = Histogram::default();
        assert_eq!(histogram.summary(), super::Latency::default());
        (1..=1000).for_each(|ms| histogram.add(Duration::from_millis(ms)));
        let found = histogram.summary();
        assert!((500_000..=563_000).contains(&found.p50_us), "{found:?}");
        assert!((990_000..=1_000_000).contains(&found.p99_us), "{found:?}");
        assert_eq!(found.max_us, 1_000_000);
    }
}
