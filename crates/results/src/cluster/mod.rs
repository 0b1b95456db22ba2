// SPDX-License-Identifier: MIT OR Apache-2.0
//! A reconstruction spread over a cluster. Slurm is the engine: it queues, places, watches and repeats; here are the
//! scripts that it runs, their size, and their state by its client programs.
//!
//! ```text
//! OUT/cluster/job.json           what was submitted, with Slurm's numbers
//! OUT/cluster/calibration.json   the calibration that all tasks use: a copy, so that all use the same
//! OUT/cluster/shards.sh          the job array: one task a shard, `reconstruct --shard`
//! OUT/cluster/collect.sh         the job behind it, `reconstruct --collect`
//! OUT/cluster/log/               what the tasks printed
//! ```
//!
//! A task needs nothing but its shard: it may be killed at any time and be run again, there or elsewhere, even twice
//! at the same time, and leaves the same bytes (`batch::collect_shards`, `export::write_whole`).

mod job;
mod script;
mod sizing;
mod slurm;
mod status;

pub use job::{Job, Work, folder};
pub use script::{collect_script, shards_script, write_scripts};
pub use sizing::{Measured, Sizing, Wish, size};
pub use slurm::{Answer, Slurm, Task};
pub use status::{ShardStatus, State, Status, read};
