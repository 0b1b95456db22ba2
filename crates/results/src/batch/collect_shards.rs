// SPDX-License-Identifier: MIT OR Apache-2.0
//! The shards of a session to one result: the very files that one run over all triggers would have written.
//!
//! ```text
//! OUT/clouds, merged, phases      what the shards have written: each file belongs to one of them
//! OUT/summary-I-of-N.json         what a shard says of its triggers, written when all its files are there
//! OUT/summary.json, sequence.mcap what is made of them
//! ```
//!
//! Nothing is taken on trust: a shard counts when its summary was made of this session with these parameters, for just these triggers and
//! cameras, and every file that it speaks of is there, whole, and made with the same parameters. Of what shards have written,
//! collecting changes the frames only that show another trigger ([`super::strangers`]), so that it may be done again at any time.

use super::from_phase_maps::phase_path;
use super::key::Key;
use super::run::{self, Format, Plan, cloud_path, merged_path};
use super::strangers;
use super::summary::{FrameSummary, Summary, TriggerSummary};
use crate::base::ids::CameraId;
use crate::base::{STALE, json, regular, remove_stale};
use crate::data::{Calibration, SessionIdentity};
use crate::formats::{phase_file, ply};
use rayon::prelude::*;
use std::fmt;
use std::path::{Path, PathBuf};

/// Numbers of triggers that a message names.
const NAMED: usize = 8;

/// Where the summary of a run, or of one of its shards, is: `summary.json`, or `summary-0-of-4.json`.
pub fn summary_path(out: &Path, shard: Option<(u64, u64)>) -> PathBuf {
    match shard {
        None => out.join("summary.json"),
        Some((i, n)) => out.join(format!("summary-{i}-of-{n}.json")),
    }
}

/// The summary of a run over all triggers.
pub fn load_summary(out: &Path) -> Result<Summary, String> {
    let path = summary_path(out, None);
    let text =
        regular::read(&path, regular::SUMMARY_BYTES).map_err(|e| format!("{}: {e}", path.display()))?;
    json::from_slice(&text).map_err(|e| format!("{}: {e}; another version wrote it", path.display()))
}

/// Removes temporary files that killed processes have left in a result's directories, as far as that goes.
pub fn remove_leftovers(out: &Path) {
    for folder in [".", "clouds", "merged", "phases"] {
        // A directory that is not there has none.
        let _ = remove_stale(&out.join(folder), STALE);
    }
}

/// What a shard lacks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Lack {
    /// It has not been run to its end, or files that it wrote are gone.
    Work,
    /// It was made with another calibration, method, algorithm, or of other frames.
    Agreement,
}

/// A shard that cannot be collected.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ShardProblem {
    /// Its number.
    pub shard: u64,
    /// What it lacks.
    pub lack: Lack,
    /// What was expected and found.
    pub found: String,
}

/// Why nothing was collected.
#[derive(Debug, thiserror::Error)]
pub struct CollectError {
    /// Number of shards.
    pub shards: u64,
    /// All that are not fit, in order.
    pub problems: Vec<ShardProblem>,
}

impl fmt::Display for CollectError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let n = self.shards;
        write!(
            f,
            "{} of {n} shards cannot be collected; run these again with the same options:",
            self.problems.len()
        )?;
        for ShardProblem { shard, found, .. } in self.problems.iter().take(100) {
            write!(f, "\n  --shard {shard}/{n}: {found}")?;
        }
        let more = self.problems.len().saturating_sub(100);
        if more > 0 { write!(f, "\n  and {more} more") } else { Ok(()) }
    }
}

/// The shards of one run over all triggers.
pub struct Shards<'a> {
    /// The run; its own shard does not matter.
    plan: &'a Plan,
    calibration: &'a Calibration,
    key: Key,
    count: u64,
}

impl<'a> Shards<'a> {
    /// The `count` shards of a plan for a session.
    pub fn new(
        session: SessionIdentity,
        plan: &'a Plan,
        calibration: &'a Calibration,
        count: u64,
    ) -> Result<Self, String> {
        let key = Key::of(session, calibration, plan)?;
        Ok(Self { plan, calibration, key, count: count.max(1) })
    }

    /// Removes what killed processes have left.
    pub fn remove_leftovers(&self) {
        remove_leftovers(&self.plan.out);
    }

    /// What they are made of.
    pub fn key(&self) -> &Key {
        &self.key
    }

    /// What a shard says of its triggers. Its files are not looked at.
    pub fn summary(&self, shard: u64) -> Result<Summary, ShardProblem> {
        let problem = |lack, found| ShardProblem { shard, lack, found };
        let path = summary_path(&self.plan.out, Some((shard, self.count)));
        let text = regular::read(&path, regular::SUMMARY_BYTES).map_err(|e| {
            problem(Lack::Work, format!("{}: {e}; it has not been run to its end", path.display()))
        })?;
        let summary: Summary = json::from_slice(&text).map_err(|e| {
            problem(Lack::Agreement, format!("{}: {e}; it is of another version, or damaged", path.display()))
        })?;
        self.agrees(shard, &summary)
            .map_err(|found| problem(Lack::Agreement, format!("{}: {found}", path.display())))?;
        Ok(summary)
    }

    /// Whether a summary is of this run.
    fn agrees(&self, shard: u64, summary: &Summary) -> Result<(), String> {
        if summary.session != self.key.session {
            return Err(format!("made of the session {}, expected {}", summary.session, self.key.session));
        }
        let parameters = self.key.parameters();
        if summary.parameters != parameters {
            return Err(format!(
                "made with the parameters {}, expected {parameters}: another calibration, method or algorithm (number {}, expected \
                 {})",
                summary.parameters, summary.algorithm, self.key.algorithm
            ));
        }
        let has = |t: &TriggerSummary| t.frames.iter().map(|frame| &frame.camera).eq(&self.key.cameras);
        if let Some(trigger) = summary.triggers.iter().find(|t| !has(t)) {
            let list = |ids: &mut dyn Iterator<Item = &CameraId>| {
                ids.map(CameraId::as_str).collect::<Vec<_>>().join(",")
            };
            let found = list(&mut trigger.frames.iter().map(|frame| &frame.camera));
            let expected = list(&mut self.key.cameras.iter());
            return Err(format!("made of the cameras {found}, expected {expected}"));
        }
        let expected: Vec<u64> = self.triggers(shard).collect();
        let found: Vec<u64> = summary.triggers.iter().map(|t| t.trigger).collect();
        if expected != found {
            let lacking: Vec<u64> = expected.iter().filter(|t| !found.contains(t)).copied().collect();
            let beyond: Vec<u64> = found.iter().filter(|t| !expected.contains(t)).copied().collect();
            return Err(format!("lacks {}; has, unasked for, {}", named(&lacking), named(&beyond)));
        }
        Ok(())
    }

    /// The triggers of a shard, in order.
    pub fn triggers(&self, shard: u64) -> impl Iterator<Item = u64> + '_ {
        self.plan.triggers.clone().filter(move |t| t % self.count == shard)
    }

    /// The summary of a shard whose files are all there.
    fn complete(&self, shard: u64) -> Result<Summary, ShardProblem> {
        let mut summary = self.summary(shard)?;
        let (out, formats) = (&self.plan.out, &self.plan.formats);
        let mut lacking = without_files(out, formats, &summary);
        // An earlier collection may have refused some of its frames.
        let mut any = false;
        for one in summary.triggers.iter_mut().filter(|one| lacking.contains(&one.trigger)) {
            any |= strangers::adopt(out, formats, one);
        }
        if any {
            lacking = without_files(out, formats, &summary);
        }
        if !lacking.is_empty() {
            let found = format!("no whole files of {}", named(&lacking));
            return Err(ShardProblem { shard, lack: Lack::Work, found });
        }
        Ok(summary)
    }
}

/// Merges what all shards say, on the current rayon pool: the summary of one run over all triggers. Nothing is written.
pub fn collect(shards: &Shards<'_>) -> Result<Summary, CollectError> {
    let found: Vec<_> = (0..shards.count).into_par_iter().map(|shard| shards.complete(shard)).collect();
    let (mut merged, mut problems, mut time_base) = (Vec::new(), Vec::new(), None);
    for shard in found {
        match shard {
            Ok(summary) => {
                merged.extend(summary.triggers);
                time_base = time_base.or(summary.time_base);
            }
            Err(problem) => problems.push(problem),
        }
    }
    if !problems.is_empty() {
        return Err(CollectError { shards: shards.count, problems });
    }
    merged.sort_by_key(|t| t.trigger);
    Ok(Summary { time_base, ..Summary::of(merged, &shards.key, shards.plan, shards.calibration) })
}

/// Triggers of a summary of which a file is missing, cut, or of other parameters, on the current rayon pool.
pub fn without_files(out: &Path, formats: &[Format], summary: &Summary) -> Vec<u64> {
    let stated = |&format| Stated { out, format, parameters: format!("parameters {}", summary.parameters) };
    let stated: Vec<Stated<'_>> = formats.iter().map(stated).collect();
    let has_all = |trigger: &TriggerSummary| stated.iter().all(|stated| stated.has_files(trigger));
    let lacking = summary.triggers.par_iter().filter(|trigger| !has_all(trigger));
    lacking.map(|trigger| trigger.trigger).collect()
}

/// The files that a summary speaks of.
struct Stated<'a> {
    out: &'a Path,
    format: Format,
    /// As every file states them.
    parameters: String,
}

impl Stated<'_> {
    fn has_files(&self, trigger: &TriggerSummary) -> bool {
        let together = run::cameras_comment(trigger.frames.iter().map(|frame| &frame.camera));
        let directional =
            trigger.frames.iter().all(|frame| self.has_frame(trigger.trigger, frame, &together));
        directional && (self.format == Format::Phase || self.has_merged(trigger))
    }

    fn has_frame(&self, trigger: u64, frame: &FrameSummary, together: &String) -> bool {
        if !matches!(&*frame.outcome, "cloud" | "refused") {
            return true;
        }
        let (points, comments) = match self.format {
            Format::Ply => {
                let path = cloud_path(self.out, &frame.camera, trigger);
                let Ok(header) = ply::load_whole_header(&path) else { return false };
                (header.points, header.comments)
            }
            Format::Phase => {
                let path = phase_path(self.out, frame.camera.as_str(), trigger);
                let Ok(statement) = phase_file::load_statement(&path) else { return false };
                (statement.points, statement.comments)
            }
        };
        points == frame.points && comments.contains(&self.parameters) && comments.contains(together)
    }

    /// Of a trigger without points there is none.
    fn has_merged(&self, trigger: &TriggerSummary) -> bool {
        if trigger.merged_points == Some(0) {
            return true;
        }
        let header = ply::load_whole_header(&merged_path(self.out, trigger.trigger));
        header.is_ok_and(|header| {
            Some(header.points) == trigger.merged_points && header.comments.contains(&self.parameters)
        })
    }
}

/// Triggers as a message names them.
pub fn named(list: &[u64]) -> String {
    let some: Vec<String> = list.iter().take(NAMED).map(u64::to_string).collect();
    match (list.len(), list.len().saturating_sub(NAMED)) {
        (0, _) => "none".to_owned(),
        (1, _) => format!("trigger {}", some.join("")),
        (_, 0) => format!("triggers {}", some.join(", ")),
        (_, more) => format!("triggers {} and {more} more", some.join(", ")),
    }
}
