// SPDX-License-Identifier: MIT OR Apache-2.0
//! What each stage of a frame has taken.

use std::time::{Duration, Instant};

/// Runs stages and keeps their times.
#[derive(Debug, Default)]
pub(crate) struct Clock(pub Vec<(&'static str, Duration)>);

impl Clock {
    /// Runs one stage.
    pub(crate) fn time<T>(&mut self, stage: &'static str, work: impl FnOnce() -> T) -> T {
        let start = Instant::now();
        let result = work();
        self.0.push((stage, start.elapsed()));
        result
    }
}
