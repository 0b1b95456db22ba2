// SPDX-License-Identifier: MIT OR Apache-2.0
//! The shards of a session to one result: the very files that one run over all triggers would have written.
//!
//! ```text
//! OUT/clouds, merged, phases      what the shards have written: each file belongs to one of them
//! OUT/summary-I-of-N.json         the summary of a shard, written when all its files are there
//! OUT/summary.json, sequence.mcap what is made of them
//! ```
//!
//! Nothing is taken on trust: a shard counts when its summary was made of this session with these parameters, for
//! just these triggers and cameras, and every file that it lists is there, whole, and made with the same
//! parameters. Of what shards have written, collecting changes the frames only that show another trigger
//! ([`super::strangers`]), so that it may be done again at any time.

use super::files::{cameras_comment, merged_path, stated};
use super::key::Key;
use super::plan::{Format, Plan};
use super::strangers;
use super::summary::{FrameSummary, Summary, TriggerSummary};
use crate::base::ids::CameraId;
use crate::base::{Exit, Fault, json, regular};
use crate::data::{Calibration, SessionIdentity};
use crate::formats::ply;
use rayon::prelude::*;
use std::path::Path;

pub use super::files::{named, remove_leftovers, summary_path};
pub use super::summary::load_summary;

/// Shards that cannot be collected that a message names.
const SHARDS_NAMED: usize = 100;

/// The shards of one run over all triggers, as `reconstruct --collect` and `cluster submit` compare them with what is
/// in the directory. They change nothing there; [`collect`] makes one summary of them when all are complete.
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

    /// What all of them are made of.
    pub fn key(&self) -> &Key {
        &self.key
    }

    /// The summary of a shard. Its files are not checked. The fault: it has not been run to its end
    /// ([`Exit::Failure`]), or was made with another calibration, method, algorithm, or of other frames
    /// ([`Exit::Usage`]).
    pub fn summary(&self, shard: u64) -> Result<Summary, Fault> {
        let path = summary_path(&self.plan.out, Some((shard, self.count)));
        let fault = |exit, found: String| Fault::new(exit, format!("{}: {found}", path.display()));
        let text = regular::read(&path, regular::SUMMARY_BYTES)
            .map_err(|e| fault(Exit::Failure, format!("{e}; it has not been run to its end")))?;
        let summary: Summary = json::from_slice(&text)
            .map_err(|e| fault(Exit::Usage, format!("{e}; it is of another version, or damaged")))?;
        self.agrees(shard, &summary).map_err(|found| fault(Exit::Usage, found))?;
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
                "made with the parameters {}, expected {parameters}: another calibration, method or \
                 algorithm (number {}, expected \
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
    fn complete(&self, shard: u64) -> Result<Summary, Fault> {
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
            return Err(format!("no whole files of {}", named(&lacking)).into());
        }
        Ok(summary)
    }
}

/// Merges the summaries of all shards, on the current rayon pool: the summary of one run over all triggers. Nothing
/// is written. The fault names all shards that are not fit.
pub fn collect(shards: &Shards<'_>) -> Result<Summary, Fault> {
    let found: Vec<_> = (0..shards.count).into_par_iter().map(|shard| shards.complete(shard)).collect();
    let (mut merged, mut problems, mut time_base) = (Vec::new(), Vec::new(), None);
    for (shard, found) in found.into_iter().enumerate() {
        match found {
            Ok(summary) => {
                merged.extend(summary.triggers);
                time_base = time_base.or(summary.time_base);
            }
            Err(problem) => problems.push((shard, problem)),
        }
    }
    if !problems.is_empty() {
        let (n, count) = (shards.count, problems.len());
        let mut message =
            format!("{count} of {n} shards cannot be collected; run these again with the same options:");
        for (shard, problem) in problems.iter().take(SHARDS_NAMED) {
            message += &format!("\n  --shard {shard}/{n}: {problem}");
        }
        if count > SHARDS_NAMED {
            message += &format!("\n  and {} more", count - SHARDS_NAMED);
        }
        let is_unfinished = problems.iter().all(|(_, problem)| problem.exit == Exit::Failure as u8);
        return Err(Fault::new(if is_unfinished { Exit::Failure } else { Exit::Usage }, message));
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

/// The files that must be there by a summary.
struct Stated<'a> {
    out: &'a Path,
    format: Format,
    /// As every file states them.
    parameters: String,
}

impl Stated<'_> {
    fn has_files(&self, trigger: &TriggerSummary) -> bool {
        let together = cameras_comment(trigger.frames.iter().map(|frame| &frame.camera));
        let directional =
            trigger.frames.iter().all(|frame| self.has_frame(trigger.trigger, frame, &together));
        directional && (self.format == Format::Phase || self.has_merged(trigger))
    }

    fn has_frame(&self, trigger: u64, frame: &FrameSummary, together: &String) -> bool {
        if !matches!(&*frame.outcome, "cloud" | "refused") {
            return true;
        }
        let Some(found) = stated(self.out, self.format, &frame.camera, trigger) else { return false };
        found.points == frame.points
            && found.comments.contains(&self.parameters)
            && found.comments.contains(together)
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
