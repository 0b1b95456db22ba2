// SPDX-License-Identifier: MIT OR Apache-2.0
//! The record of a submitted job, `OUT/cluster/job.json`.

use super::sizing::Sizing;
use crate::base::{json, regular};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// The version of the format, raised whenever older readers would misread it.
const VERSION: u32 = 1;

/// Where scripts, logs and `job.json` of a result are.
pub fn folder(out: &Path) -> PathBuf {
    out.join("cluster")
}

/// A reconstruction as it was submitted.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Job {
    version: u32,
    /// What is made of which session.
    pub work: Work,
    pub shards: u64,
    /// The shards that are in the job array: those that were not finished when it was submitted.
    pub array: Vec<u64>,
    /// Tasks that may run at once.
    pub at_once: Option<u64>,
    /// Processors, memory and time of a task.
    pub sizing: Sizing,
    /// Further options of `sbatch`, as the user gave them.
    pub sbatch: Vec<String>,
    /// Slurm's number of the job array; `None`: all shards were finished.
    pub array_job: Option<u64>,
    /// Slurm's number of the collecting job.
    pub collect_job: Option<u64>,
}

/// What is made of which session.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Work {
    /// The program, as compute nodes find it.
    pub program: PathBuf,
    /// The session; absolute, as are the other paths.
    pub session: PathBuf,
    /// Where the results go; with a store, what is kept of them here: scripts, logs, summaries.
    pub out: PathBuf,
    /// Where the results go instead, `s3://BUCKET/PREFIX`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub store: Option<String>,
    /// Options of `reconstruct` that all shards share.
    pub options: Vec<String>,
    /// Whether phase maps are written instead of clouds.
    pub phase: bool,
    /// Hash of everything that the clouds depend on beside the frames.
    pub parameters: String,
    /// The triggers, from the first to one beyond the last.
    pub triggers: [u64; 2],
}

impl Job {
    /// A job that has not been submitted. `array`: the shards to run.
    pub fn new(
        work: Work,
        sizing: Sizing,
        array: Vec<u64>,
        at_once: Option<u64>,
        sbatch: Vec<String>,
    ) -> Self {
        let (version, shards) = (VERSION, sizing.tasks);
        let (array_job, collect_job) = (None, None);
        Self { version, work, shards, array, at_once, sizing, sbatch, array_job, collect_job }
    }

    fn path(out: &Path) -> PathBuf {
        folder(out).join("job.json")
    }

    /// Whether a job was ever submitted for this result.
    pub fn exists(out: &Path) -> bool {
        Self::path(out).exists()
    }

    /// Reads the job of a result.
    pub fn load(out: &Path) -> Result<Self, String> {
        let path = Self::path(out);
        let fail = |e: &dyn std::fmt::Display| {
            format!(
                "{}: {e}; expected what `fourdbody cluster submit ... --out {}` writes",
                path.display(),
                out.display()
            )
        };
        let text = regular::read(&path, regular::STATEMENT_BYTES).map_err(|e| fail(&e))?;
        let job: Self = json::from_slice(&text).map_err(|e| fail(&e))?;
        // Seen from another machine the same directory may have another name.
        let job = Self { work: Work { out: out.to_owned(), ..job.work }, ..job };
        if job.version != VERSION || job.shards == 0 || job.work.triggers[0] >= job.work.triggers[1] {
            return Err(fail(&format!(
                "version {}, {} shards of the triggers {:?}",
                job.version, job.shards, job.work.triggers
            )));
        }
        Ok(job)
    }

    /// Writes it beside its scripts.
    pub fn save(&self) -> Result<(), String> {
        json::save(&Self::path(&self.work.out), self)
    }

    /// Frame sets of a shard: the triggers that leave its number when divided by the number of shards.
    pub fn frame_sets(&self, shard: u64) -> u64 {
        let below = |end: u64| end / self.shards + u64::from(end % self.shards > shard);
        below(self.work.triggers[1]).saturating_sub(below(self.work.triggers[0]))
    }

    /// Slurm's numbers of what was submitted.
    pub fn numbers(&self) -> Vec<u64> {
        self.array_job.into_iter().chain(self.collect_job).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::{Job, Work};
    use crate::cluster::sizing::{Measured, Wish, size};
    use proptest::prelude::{prop_assert_eq, proptest};

    proptest! {
        #[test]
        fn the_frame_sets_of_a_shard_are_counted(first in 0u64..50, count in 1u64..100, tasks in 1u64..20) {
            let measured = Measured { cpu_s_per_frame_set: 1.0, peak_memory_bytes: 1, threads: 1 };
            let wish = Wish { tasks: Some(tasks.min(count)), hours: 1.0, cpus: 1, most_tasks: 100 };
            let sizing = size(count, measured, wish).expect("fits");
            let work = Work {
                program: "p".into(),
                session: "s".into(),
                out: "o".into(),
                store: None,
                options: Vec::new(),
                phase: false,
                parameters: String::new(),
                triggers: [first, first + count],
            };
            let job = Job::new(work, sizing, Vec::new(), None, Vec::new());
            for shard in 0..job.shards {
                let found = (first..first + count).filter(|t| t % job.shards == shard).count() as u64;
                prop_assert_eq!(job.frame_sets(shard), found);
                prop_assert_eq!(found <= sizing.frame_sets_per_task, true);
            }
        }
    }
}
