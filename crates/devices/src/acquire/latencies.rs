// SPDX-License-Identifier: MIT OR Apache-2.0
//! How long frames take from the stream to the disk, stage by stage.

pub use crate::base::histogram::Histogram;
use std::fmt;

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
        let stages = [
            ("matched", &self.matched),
            ("assembled", &self.assembled),
            ("written", &self.written),
            ("total", &self.total),
        ];
        for (i, (stage, histogram)) in stages.into_iter().enumerate() {
            let (p50, p99) = (histogram.quantile_ms(0.5), histogram.quantile_ms(0.99));
            let comma = if i == 0 { "" } else { "; " };
            write!(f, "{comma}{stage}: p50 {p50:.3} ms, p99 {p99:.3} ms, max {:.3} ms", histogram.max_ms())?;
        }
        Ok(())
    }
}
