// SPDX-License-Identifier: MIT OR Apache-2.0
//! How far a submitted reconstruction is: by Slurm what waits and runs, by the results what is done.
//!
//! A summary is written when all files of its shard are there, so that it counts more than the scheduler.
//! Where a controller has forgotten its jobs and there is no accounting, it is the only source.

use super::job::Job;
use super::slurm::{Answer, Task};
use crate::base::{json, regular};
use crate::batch::files::{merged_path, summary_path};
use crate::batch::summary::Summary;
use crate::formats::{named, phase_file, ply};
use rayon::prelude::*;
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

/// State of a shard, of the collecting job, or of all.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum State {
    /// For processors, for the job before it, or to be started anew.
    Waiting,
    /// Slurm runs it on a node.
    Running,
    /// Its summary is there, whatever Slurm reports.
    Done,
    /// It has ended, and its summary is not there.
    Failed,
    /// Its summary is not there, and Slurm does not answer.
    Unknown,
}

/// The state of one shard, with its frame sets.
#[derive(Debug, Clone, Serialize)]
pub struct ShardStatus {
    pub shard: u64,
    pub state: State,
    pub frame_sets: u64,
    /// Of these, those whose files are there.
    pub frame_sets_done: u64,
    /// Its task, as Slurm reports it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub task: Option<Task>,
}

/// The state of a submitted reconstruction, as `cluster status` prints it.
#[derive(Debug, Clone, Serialize)]
pub struct Status {
    pub out: String,
    /// State of the whole; done when the collected result is there.
    pub state: State,
    /// Slurm's number of the job array.
    pub array_job: Option<u64>,
    /// Slurm's number of the collecting job.
    pub collect_job: Option<u64>,
    /// Frame sets of all shards.
    pub frame_sets: u64,
    /// Of these, those whose files are there.
    pub frame_sets_done: u64,
    pub shards: Vec<ShardStatus>,
    /// State of the collecting job.
    pub collecting: State,
    /// The collecting job, as Slurm reports it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub collecting_task: Option<Task>,
    /// Sources that did not answer.
    pub notes: Vec<String>,
    /// The summary of the collected result, where it is there.
    #[serde(skip)]
    pub summary: Option<Summary>,
}

/// The state that follows from Slurm's word for it and from the results.
fn judge(word: Option<&str>, done: bool, answered: bool) -> State {
    match word {
        Some("RUNNING" | "COMPLETING" | "SUSPENDED" | "STAGE_OUT" | "SIGNALING" | "STOPPED") => {
            State::Running
        }
        Some(
            "PENDING" | "CONFIGURING" | "REQUEUED" | "REQUEUE_FED" | "REQUEUE_HOLD" | "SPECIAL_EXIT"
            | "RESV_DEL_HOLD",
        ) => State::Waiting,
        _ if done => State::Done,
        None if !answered => State::Unknown,
        _ => State::Failed,
    }
}

/// Reads how far a job is; `answer`: what Slurm reports of it.
pub fn read(job: &Job, answer: Answer) -> Status {
    let Answer { tasks, answered, notes } = answer;
    let word = |task: &Option<Task>| task.as_ref().map(|task| task.state.clone());
    let by_index: BTreeMap<u64, &Task> = tasks
        .iter()
        .filter(|task| Some(task.job) == job.array_job)
        .filter_map(|task| Some((task.index?, task)))
        .collect();
    let done: Vec<bool> =
        (0..job.shards).into_par_iter().map(|shard| summary_of(job, Some(shard)).is_some()).collect();
    let unfinished: BTreeSet<u64> =
        (0..job.shards).zip(&done).filter(|(_, done)| !**done).map(|(shard, _)| shard).collect();
    let counts = if unfinished.is_empty() { BTreeMap::new() } else { count_results(job, &unfinished) };
    let shards: Vec<ShardStatus> = (0..job.shards)
        .zip(done)
        .map(|(shard, done)| {
            let task = by_index.get(&shard).map(|task| (*task).clone());
            let frame_sets = job.frame_sets(shard);
            let counted = counts.get(&shard).copied().unwrap_or(0);
            let frame_sets_done = if done { frame_sets } else { counted };
            let state = judge(word(&task).as_deref(), done, answered);
            ShardStatus { shard, state, frame_sets, frame_sets_done, task }
        })
        .collect();
    let collecting_task = tasks.iter().find(|task| Some(task.job) == job.collect_job).cloned();
    let summary = summary_of(job, None);
    let collecting = judge(word(&collecting_task).as_deref(), summary.is_some(), answered);
    Status {
        out: job.work.out.display().to_string(),
        state: overall(&shards, collecting),
        array_job: job.array_job,
        collect_job: job.collect_job,
        frame_sets: shards.iter().map(|shard| shard.frame_sets).sum(),
        frame_sets_done: shards.iter().map(|shard| shard.frame_sets_done).sum(),
        shards,
        collecting,
        collecting_task,
        notes,
        summary,
    }
}

fn overall(shards: &[ShardStatus], collecting: State) -> State {
    let any = |state: State| shards.iter().any(|shard| shard.state == state);
    match collecting {
        State::Done => State::Done,
        _ if any(State::Failed) => State::Failed,
        State::Waiting if any(State::Running) => State::Running,
        _ => collecting,
    }
}

/// The summary of a shard, or of all, if it is of this job.
fn summary_of(job: &Job, shard: Option<u64>) -> Option<Summary> {
    let path = summary_path(&job.work.out, shard.map(|shard| (shard, job.shards)));
    let summary: Summary = json::from_slice(&regular::read(&path, regular::SUMMARY_BYTES).ok()?).ok()?;
    let expected = shard.map_or(job.work.triggers[1] - job.work.triggers[0], |shard| job.frame_sets(shard));
    (summary.parameters == job.work.parameters && summary.triggers.len() as u64 == expected)
        .then_some(summary)
}

/// Frame sets of unfinished shards whose files are there, made with the job's parameters.
fn count_results(job: &Job, unfinished: &BTreeSet<u64>) -> BTreeMap<u64, u64> {
    let folder = job.work.out.join(if job.work.phase { "phases" } else { "merged" });
    let names = std::fs::read_dir(folder).into_iter().flatten().flatten();
    // INDEX.ply, or CAMERA_INDEX.phase: of these, one stands for its frame set.
    let found: BTreeMap<u64, PathBuf> = names
        .filter_map(|entry| {
            let path = entry.path();
            let stem =
                path.file_name()?.to_str()?.strip_suffix(if job.work.phase { ".phase" } else { ".ply" })?;
            let (index, _) = named(stem)?;
            (job.work.triggers[0]..job.work.triggers[1]).contains(&index).then_some((index, path))
        })
        .filter(|(index, _)| unfinished.contains(&(index % job.shards)))
        .collect();
    let comment = format!("parameters {}", job.work.parameters);
    let of_this_job: Vec<u64> = found
        .into_par_iter()
        .filter(|(index, path)| {
            let comments = if job.work.phase {
                phase_file::load_statement(path).ok().map(|statement| statement.comments)
            } else {
                ply::load_header(&merged_path(&job.work.out, *index)).ok().map(|header| header.comments)
            };
            comments.is_some_and(|comments| comments.contains(&comment))
        })
        .map(|(index, _)| index % job.shards)
        .collect();
    let mut counts = BTreeMap::new();
    of_this_job.into_iter().for_each(|shard| *counts.entry(shard).or_insert(0) += 1);
    counts
}

#[cfg(test)]
mod tests {
    use super::{ShardStatus, State, judge, overall};

    #[test]
    fn what_is_there_counts_more_than_what_a_scheduler_says() {
        for (word, done, expected) in [
            (Some("PENDING"), false, State::Waiting),
            (Some("REQUEUED"), true, State::Waiting),
            (Some("RUNNING"), false, State::Running),
            (Some("COMPLETED"), true, State::Done),
            (Some("COMPLETED"), false, State::Failed),
            (Some("NODE_FAIL"), true, State::Done),
            (Some("TIMEOUT"), false, State::Failed),
            // The controller has forgotten it, and there is no accounting.
            (None, true, State::Done),
            (None, false, State::Failed),
        ] {
            assert_eq!(judge(word, done, true), expected, "{word:?} {done}");
        }
        assert_eq!((judge(None, false, false), judge(None, true, false)), (State::Unknown, State::Done));
    }

    #[test]
    fn the_whole_is_done_when_it_is_collected() {
        let of = |states: &[State], collecting| {
            let shard = |state: &State| ShardStatus {
                shard: 0,
                state: *state,
                frame_sets: 1,
                frame_sets_done: 0,
                task: None,
            };
            overall(&states.iter().map(shard).collect::<Vec<_>>(), collecting)
        };
        use State::{Done, Failed, Running, Waiting};
        assert_eq!(of(&[Done, Done], Done), Done);
        assert_eq!(of(&[Done, Done], Waiting), Waiting);
        assert_eq!(of(&[Done, Running, Waiting], Waiting), Running);
        assert_eq!(of(&[Done, Running, Failed], Waiting), Failed);
        assert_eq!(of(&[Done, Done], Failed), Failed);
    }
}
