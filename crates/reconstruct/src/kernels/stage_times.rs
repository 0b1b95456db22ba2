// SPDX-License-Identifier: MIT OR Apache-2.0
//! The duration of each stage of a frame.

use std::time::{Duration, Instant};

/// Runs stages and keeps their times.
#[derive(Debug, Default)]
pub(crate) struct Clock(pub Vec<(&'static str, Duration)>);

impl Clock {
    /// Runs one stage and keeps its duration under its name.
    pub(crate) fn time<T>(&mut self, stage: &'static str, work: impl FnOnce() -> T) -> T {
        let start = Instant::now();
        let result = work();
        self.0.push((stage, start.elapsed()));
        result
    }
}
