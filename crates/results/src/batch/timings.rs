// SPDX-License-Identifier: MIT OR Apache-2.0
//! The time that a run has taken, stage by stage and in all.

use serde::Serialize;
use std::collections::BTreeMap;
use std::time::Duration;

/// Time spent, over the frames that were computed and not found finished.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Timings {
    pub frames: usize,
    pub threads: usize,
    /// Sum of each stage, ms.
    pub stage_ms: BTreeMap<&'static str, f64>,
    /// Sum of all stages, ms.
    pub total_ms: f64,
    /// Sum of the time from reading a frame to its points and normals in memory, in the thread that did it, ms.
    /// With one thread this is the whole cost of the frames; with more, other work of that thread in between is in it.
    pub frame_ms: f64,
    /// Sum of the time that was spent on deciding which points merged clouds leave out, over all triggers, ms. Not in
    /// the others.
    pub merge_ms: f64,
    /// From the first frame to the last on the wall's clock, ms.
    pub wall_ms: f64,
    /// The process's processor time meanwhile, user and system, of all threads, ms.
    pub cpu_ms: f64,
}

impl Timings {
    pub(crate) fn add(&mut self, stages: &[(&'static str, Duration)]) {
        self.frames += 1;
        for (stage, time) in stages {
            let ms = time.as_secs_f64() * 1e3;
            *self.stage_ms.entry(stage).or_default() += ms;
            self.total_ms += ms;
        }
    }

    pub(crate) fn add_frame_time(&mut self, time: Duration) {
        self.frame_ms += time.as_secs_f64() * 1e3;
    }
}
