// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the worker writes down: what has become of each session, and what it does now.

use crate::base::time::host_time_ns;
use crate::base::{json, regular, write_whole, write_whole_cached};
use serde::{Deserialize, Serialize};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

/// The worker's own directory, inside the results' directory.
pub const OWN_DIR: &str = ".worker";

/// How far a session is.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Stage {
    /// Nothing has been done yet.
    #[default]
    Waiting,
    /// Its recordings are being checked.
    Verifying,
    /// They are verified; clouds are being made.
    Reconstructing,
    /// All clouds of the session are made.
    Done,
    /// It is not tried again unless a person requests it.
    SetAside,
}

/// What has become of a session.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(default)]
pub struct Job {
    /// The name of the session.
    pub session: String,
    /// The id that its recordings share.
    pub session_id: String,
    /// The step that the session has reached.
    pub stage: Stage,
    /// Frame sets that are ready.
    pub done: u64,
    /// Frame sets of the whole session.
    pub of: u64,
    /// Number of failed attempts so far.
    pub attempts: u32,
    /// Why the last attempt failed, or why it was set aside.
    pub reason: Option<String>,
    /// Not before this time, host clock, ns.
    pub not_before_ns: u64,
    /// When it was begun, host clock, ns.
    pub began_ns: u64,
    /// When it was done or set aside, host clock, ns.
    pub ended_ns: u64,
    /// Time spent on it, s.
    pub busy_s: f64,
    /// The most memory that its last process had at once, bytes.
    pub peak_memory_bytes: u64,
    /// Frames without a cloud: missing, refused or damaged.
    pub frames_without_cloud: u64,
    /// Points of all directional clouds; earlier versions called it so.
    #[serde(alias = "merged_points")]
    pub points: u64,
    /// Hash of what the clouds depend on beside the frames, as in `summary.json`.
    pub parameters: String,
}

impl Job {
    /// Whether there is nothing more to do for it.
    pub fn has_ended(&self) -> bool {
        matches!(self.stage, Stage::Done | Stage::SetAside)
    }

    /// The file in which a session's job is stored.
    pub fn path(results: &Path, session: &str) -> PathBuf {
        results.join(session).join("job.json")
    }

    /// What is known of a session; nothing when it has not been begun, or what is there cannot be read.
    pub fn load(results: &Path, session: &str) -> Option<Self> {
        load(&Self::path(results, session))
    }

    /// Writes the job to its file, whole or not at all.
    pub fn store(&self, results: &Path) -> io::Result<()> {
        let text = serde_json::to_string_pretty(self)?;
        write_whole(&Self::path(results, &self.session), |file| file.write_all(text.as_bytes()))
    }
}

/// What the worker is doing now.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Activity {
    /// There is nothing to do.
    #[default]
    Idle,
    /// It works on a session.
    Working,
    /// A node is in a session.
    GivesWay,
    /// It waits for something that is not a session's fault; `reason` names it.
    Waiting,
    /// The worker's process has ended.
    Ended,
}

/// What the worker does now.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(default)]
pub struct WorkerState {
    /// What the worker is doing, in one word.
    pub activity: Activity,
    /// What it waits for, or gives way to.
    pub reason: Option<String>,
    /// What it is on, or was on when it gave way.
    pub job: Option<Job>,
    /// Sessions that could be worked on now.
    pub queued: Vec<String>,
    /// Sessions that cannot yet, each with the reason.
    pub not_yet: Vec<(String, String)>,
    /// Number of sessions whose clouds are complete.
    pub done: u64,
    /// Sessions that were set aside, each with the reason.
    pub set_aside: Vec<(String, String)>,
    /// When this was written, host clock, ns.
    pub written_ns: u64,
}

impl WorkerState {
    /// The last state of the worker of this results' directory.
    pub fn load(results: &Path) -> Option<Self> {
        load(&results.join(OWN_DIR).join("state.json"))
    }

    /// Writes the state for the node and for `fourdbody worker --status`.
    pub fn store(&self, results: &Path) -> io::Result<()> {
        let text = serde_json::to_string_pretty(self)?;
        // It is written every second, and is of no use after a power cut.
        write_whole_cached(&results.join(OWN_DIR).join("state.json"), |file| file.write_all(text.as_bytes()))
    }

    /// Whether the worker that wrote this is gone: it writes every two seconds at least.
    pub fn is_stale(&self) -> bool {
        const SILENT_NS: u64 = 15_000_000_000;
        self.activity != Activity::Ended && host_time_ns().saturating_sub(self.written_ns) > SILENT_NS
    }

    /// Whether the worker that wrote this is still there.
    pub fn is_running(&self) -> bool {
        self.activity != Activity::Ended && !self.is_stale()
    }

    /// The state as one line, for the console and `status`.
    pub fn line(&self) -> String {
        let job = self.job.as_ref().map_or_else(String::new, |job| {
            let what = match job.stage {
                Stage::Verifying => "verifying".to_owned(),
                _ => format!("{} of {} frame sets", job.done, job.of),
            };
            format!(" {}: {what}", job.session)
        });
        let reason = self.reason.as_ref().map_or_else(String::new, |reason| format!(" ({reason})"));
        let activity = match self.activity {
            _ if self.is_stale() => "stopped; see systemctl status fourdbody-worker".to_owned(),
            Activity::Idle => "nothing to do".to_owned(),
            Activity::Working => format!("working on{job}"),
            Activity::GivesWay => format!("paused while a node records{reason}{job}"),
            Activity::Waiting => format!("waiting{reason}{job}"),
            Activity::Ended => "not running".to_owned(),
        };
        let (queued, done, aside) = (self.queued.len(), self.done, self.set_aside.len());
        format!(
            "{activity}; {queued} queued, {} not yet ready, {done} done, {aside} set aside",
            self.not_yet.len()
        )
    }
}

fn load<T: serde::de::DeserializeOwned>(path: &Path) -> Option<T> {
    json::from_slice(&regular::read(path, regular::STATEMENT_BYTES).ok()?).ok()
}
