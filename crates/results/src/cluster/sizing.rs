// SPDX-License-Identifier: MIT OR Apache-2.0
//! How many tasks, and how long and how large each: from the measured cost of a frame set.
//!
//! ```text
//! expected = frame sets of a task x processor time a frame set / (1 + EFFICIENCY x (processors - 1))
//! limit    = expected x TIME_MARGIN + START_MIN
//! memory   = measured peak x processors / threads measured (at least 1) x MEMORY_MARGIN + MEMORY_SPARE
//! ```

use crate::base::{json, regular};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// What each further processor of a task adds to the first: `make bench-reconstruct` measures it for the second, as
/// `scaling_2_threads` (1.70, of two processors that share their memory). It is taken for the others, too.
const EFFICIENCY: f64 = 0.7;

/// The limit of time over what is expected: nodes differ, and a shared disk has busy hours.
const TIME_MARGIN: f64 = 2.0;

/// Minutes that a task may take to start: preparations of the machine, and reading the session's index.
const START_MIN: f64 = 10.0;

/// The memory requested over what was measured on a few frame sets: it grows for a while with what a task has seen
/// (docs/guide/cluster.md), and a person near the camera covers more pixels.
const MEMORY_MARGIN: f64 = 2.0;
/// Memory requested in addition, MiB, for the program itself and the session's index.
const MEMORY_SPARE_MIB: f64 = 256.0;

/// What a frame set was measured to take.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measured {
    /// Processor time of all cameras of one trigger, from the recording to the files, s.
    pub cpu_s_per_frame_set: f64,
    /// The most memory at once, bytes.
    pub peak_memory_bytes: u64,
    /// Threads of the process that was measured.
    pub threads: u64,
}

/// The parts of `reconstruct --timings` that count here.
#[derive(Deserialize)]
struct Timings {
    frames: u64,
    threads: u64,
    cpu_ms: f64,
    peak_memory_bytes: u64,
}

impl Measured {
    /// Reads what `reconstruct --timings` wrote of a run with this number of cameras.
    pub fn load(path: &Path, cameras: usize) -> Result<Self, String> {
        let fail = |e: &dyn std::fmt::Display| {
            format!("{}: {e}; expected what `fourdbody reconstruct --timings` writes", path.display())
        };
        let text = regular::read(path, regular::SUMMARY_BYTES).map_err(|e| fail(&e))?;
        let timings: Timings = json::from_slice(&text).map_err(|e| fail(&e))?;
        if timings.frames == 0 || timings.threads == 0 || !(timings.cpu_ms > 0.0) {
            return Err(fail(&"no frame was computed: all were found finished, or are missing"));
        }
        Ok(Self {
            cpu_s_per_frame_set: timings.cpu_ms / 1e3 / timings.frames as f64 * cameras as f64,
            peak_memory_bytes: timings.peak_memory_bytes,
            threads: timings.threads,
        })
    }
}

/// The size that the user requests.
#[derive(Debug, Clone, Copy)]
pub struct Wish {
    /// The number of tasks, where the user gave one.
    pub tasks: Option<u64>,
    /// The hours that a task is to take, where the number of tasks is not given.
    pub hours: f64,
    pub cpus: u64,
    /// The most tasks that the cluster accepts in one array.
    pub most_tasks: u64,
}

/// The size of the tasks that a session is divided into.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Sizing {
    /// Number of tasks, which is that of the shards.
    pub tasks: u64,
    /// Frame sets of the largest.
    pub frame_sets_per_task: u64,
    pub cpus: u64,
    pub memory_mib: u64,
    /// The time that each is expected to take, minutes.
    pub expected_min: f64,
    /// The time after which Slurm ends it, minutes.
    pub limit_min: u64,
    /// Processor time of a frame set that all this follows from, s.
    pub cpu_s_per_frame_set: f64,
}

/// Sizes the tasks for this number of frame sets.
pub fn size(frame_sets: u64, measured: Measured, wish: Wish) -> Result<Sizing, String> {
    let cpus = wish.cpus.max(1);
    let speed = 1.0 + EFFICIENCY * (cpus - 1) as f64;
    let all_min = frame_sets as f64 * measured.cpu_s_per_frame_set / speed / 60.0;
    let tasks = match wish.tasks {
        Some(tasks) if tasks > frame_sets => {
            return Err(format!("--tasks {tasks}: there are only {frame_sets} frame sets"));
        }
        Some(tasks) => tasks.max(1),
        None => ((all_min / 60.0 / wish.hours).ceil() as u64).clamp(1, frame_sets.max(1)),
    };
    if tasks > wish.most_tasks {
        return Err(format!(
            "{tasks} tasks: the cluster takes at most {} in one array (MaxArraySize); give fewer --tasks, \
             more --hours or \
             more --cpus",
            wish.most_tasks
        ));
    }
    let frame_sets_per_task = frame_sets.div_ceil(tasks);
    let expected_min = frame_sets_per_task as f64 * measured.cpu_s_per_frame_set / speed / 60.0;
    let threads = (cpus as f64 / measured.threads.max(1) as f64).max(1.0);
    let memory =
        measured.peak_memory_bytes as f64 / f64::from(1 << 20) * threads * MEMORY_MARGIN + MEMORY_SPARE_MIB;
    Ok(Sizing {
        tasks,
        frame_sets_per_task,
        cpus,
        memory_mib: memory.ceil() as u64,
        expected_min,
        limit_min: (expected_min * TIME_MARGIN + START_MIN).ceil() as u64,
        cpu_s_per_frame_set: measured.cpu_s_per_frame_set,
    })
}

#[cfg(test)]
mod tests {
    use super::{Measured, Wish, size};
    use proptest::prelude::{prop_assert, proptest};

    const MEASURED: Measured = Measured { cpu_s_per_frame_set: 0.9, peak_memory_bytes: 1 << 30, threads: 2 };
    const WISH: Wish = Wish { tasks: None, hours: 1.0, cpus: 4, most_tasks: 1001 };

    #[test]
    fn a_minute_of_capture_is_sized_by_hand() {
        // 7200 x 0.9 s = 108 min of one processor; four do 3.1 times as much.
        let sizing = size(7200, MEASURED, WISH).expect("fits");
        assert_eq!((sizing.tasks, sizing.frame_sets_per_task), (1, 7200));
        assert!((sizing.expected_min - 34.84).abs() < 0.01, "{sizing:?}");
        assert_eq!((sizing.limit_min, sizing.memory_mib), (80, 2 * 1024 * 2 + 256));
        let sizing = size(7200, MEASURED, Wish { hours: 0.1, ..WISH }).expect("fits");
        assert_eq!((sizing.tasks, sizing.frame_sets_per_task), (6, 1200));
    }

    #[test]
    fn what_the_cluster_does_not_take_is_refused() {
        for (frame_sets, wish, words) in [
            (3, Wish { tasks: Some(4), ..WISH }, "only 3 frame sets"),
            (1 << 30, WISH, "MaxArraySize"),
            (5000, Wish { tasks: Some(1002), ..WISH }, "1002 tasks"),
        ] {
            let error = size(frame_sets, MEASURED, wish).expect_err("must be refused");
            assert!(error.contains(words), "{error}");
        }
    }

    proptest! {
        #[test]
        fn every_frame_set_has_a_task_that_has_time_for_it(frame_sets in 1u64..100_000, hours in 0.01f64..100.0, cpus in 1u64..128) {
            let wish = Wish { hours, cpus, most_tasks: u64::MAX, ..WISH };
            let sizing = size(frame_sets, MEASURED, wish).expect("fits");
            prop_assert!(sizing.tasks * sizing.frame_sets_per_task >= frame_sets && sizing.tasks <= frame_sets);
            prop_assert!(sizing.limit_min as f64 > sizing.expected_min);
            // As long as was requested, but for the frame set that cannot be cut.
            prop_assert!(sizing.expected_min <= hours * 60.0 + 0.9 / 60.0 + 1e-9);
        }
    }
}
