// SPDX-License-Identifier: MIT OR Apache-2.0
//! Times that frames take from the stream to the disk, stage by stage.

pub use crate::base::histogram::Histogram;
use std::fmt;

/// Times of the stages of a frame's way from the stream to the disk.
#[derive(Debug, Default)]
pub struct Latencies {
    /// From the stream until the frame's trigger is known.
    pub matched: Histogram,
    /// From there until the frame set entered the ring.
    pub assembled: Histogram,
    /// From there until the writer's thread had written the frame.
    pub written: Histogram,
    /// From the stream until the frame was written.
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
        let text = stages.map(|(stage, histogram)| {
            let (p50, p99) = (histogram.quantile_ms(0.5), histogram.quantile_ms(0.99));
            format!("{stage}: p50 {p50:.3} ms, p99 {p99:.3} ms, max {:.3} ms", histogram.max_ms())
        });
        f.write_str(&text.join("; "))
    }
}
