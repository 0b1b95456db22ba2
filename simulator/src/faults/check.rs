// SPDX-License-Identifier: MIT OR Apache-2.0
//! Compares recordings with what was injected.

use super::check_links::Links;
use super::check_rows::Rows;
use super::disk::{DiskEvent, Excuse, judge_dropped_sets};
use super::pixels;
use super::truth::{FRAME, Injected};
use fourdbody::base::ids::TriggerIndex;
use fourdbody::record::{GapCause, RecordingReader, SessionReader};
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// So many triggers after a fault a frame may be given up, where this host made it late.
const DOUBTFUL: u64 = 48;
/// Mismatches beyond this many are counted, not listed.
const LISTED: usize = 200;

/// The count of injected faults of one kind, and of wrong accounts of them.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Tally {
    pub injected: u64,
    /// With an outcome and events as expected.
    pub right: u64,
    pub wrong: u64,
}

/// How recordings compare with the truth.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct Accounting {
    pub kinds: BTreeMap<String, Tally>,
    pub total: Tally,
    /// Outcomes looked at: one per camera and trigger.
    pub outcomes: u64,
    /// Outcomes of whole frame sets that the node dropped and said so, because this host was too busy: no fault of its
    /// own, and no proof of anything.
    pub dropped_by_host: u64,
    /// Frames without a fault that were given up by name, shortly after a fault of their camera: late on a busy host.
    pub given_up: u64,
    /// Everything that is not as it should be, faults and others.
    pub mismatches: u64,
    /// The first of them, in words.
    pub listed: Vec<String>,
}

impl Accounting {
    /// Counts a fault as right or wrong.
    pub(super) fn count(&mut self, kind: &str, right: bool) {
        let kind = self.kinds.entry(kind.to_owned()).or_default();
        for tally in [kind, &mut self.total] {
            tally.injected += 1;
            tally.right += u64::from(right);
            tally.wrong += u64::from(!right);
        }
    }

    pub(super) fn mismatch(&mut self, message: String) {
        self.mismatches += 1;
        if self.listed.len() < LISTED {
            self.listed.push(message);
        }
    }
}

/// The images that the cameras sent, by which frames are checked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Shown {
    /// Test images, numbered from 1 in the order of the rig's cameras: every frame's pixels are compared.
    TestImages,
    /// Anything: pixels are not looked at.
    Scene,
}

/// Compares sessions with the truth: the n-th session is the n-th train of every camera in it.
///
/// # Errors
/// A session that cannot be opened.
pub fn check(truth: &[Injected], sessions: &[impl AsRef<Path>], shown: Shown) -> Result<Accounting, String> {
    check_with_disks(truth, &[], sessions, shown)
}

/// The same where disks failed as well: their events explain outcomes of the session that they name.
///
/// # Errors
/// A session that cannot be opened.
pub fn check_with_disks(
    truth: &[Injected],
    disks: &[DiskEvent],
    sessions: &[impl AsRef<Path>],
    shown: Shown,
) -> Result<Accounting, String> {
    let mut accounting = Accounting::default();
    for (train, path) in (1u64..).zip(sessions) {
        let session = SessionReader::open(path.as_ref()).map_err(|e| e.to_string())?;
        for one in session.unreadable() {
            accounting.mismatch(one.to_string());
        }
        let mut first_stamp = 1;
        for recording in session.recordings() {
            let excuse = Excuse::of(disks, recording);
            let stamp = (shown == Shown::TestImages).then_some(first_stamp);
            check_recording(truth, train, recording, excuse, stamp, &mut accounting);
            first_stamp += recording.header.cameras.len() as u32;
        }
    }
    Ok(accounting)
}

/// `first_stamp`: what the test images of its first camera are stamped with.
fn check_recording(
    truth: &[Injected],
    train: u64,
    recording: &RecordingReader,
    excuse: Excuse,
    first_stamp: Option<u32>,
    into: &mut Accounting,
) {
    for problem in &recording.problems {
        into.mismatch(format!("{}: {}", recording.path.display(), problem.message));
    }
    // Without books what is there is compared, and how much there should be is not known.
    let unfinished = recording.verdict.is_none() && excuse.no_books;
    if recording.verdict.is_none() && !unfinished {
        into.mismatch(format!("{}: the recording has no verdict", recording.path.display()));
    }
    let events: BTreeSet<(&str, &str, Option<u64>)> = recording
        .events
        .iter()
        .filter_map(|e| Some((e.camera.as_ref()?.as_str(), e.kind.as_str(), e.trigger.map(|t| t.0))))
        .collect();
    let end = recording.triggers_end();
    let dropped = GapCause::DroppedRingFull.to_string();
    let doubtful = GapCause::IdentityMismatch.to_string();
    let paused = GapCause::NodePaused.to_string();
    let mut all = Vec::new();
    let links = Links::of(truth, train, recording);
    links.judge(recording, into);
    for (number, camera) in recording.header.cameras.iter().enumerate() {
        let mut injected: BTreeMap<u64, &Injected> = BTreeMap::new();
        let mine = || truth.iter().filter(|f| f.train == train && f.camera == camera.id.as_str());
        for fault in mine().filter(|fault| fault.lasts.is_none()) {
            if injected.insert(fault.trigger, fault).is_some() {
                into.mismatch(format!("{} trigger {}: two faults in the truth", camera.id, fault.trigger));
            }
        }
        for (trigger, fault) in injected.range(end..).filter(|_| !unfinished && links.ends_whole()) {
            into.mismatch(format!("{} trigger {trigger}: {} after the last trigger", camera.id, fault.kind));
        }
        let outcomes: Vec<String> = (0..end).map(|t| outcome(recording, number, t)).collect();
        let rows = Rows::of(mine(), &outcomes);
        rows.judge(recording, &outcomes, into);
        // Nothing after it proves what a camera's last frames were lost by. Shortly after a fault id, stamp and arrival
        // must all agree: a frame that this host made late is given up then.
        let doubtful_time = |trigger: u64| {
            let since = |fault: &Injected| trigger.checked_sub(fault.trigger + fault.lasts.unwrap_or(0));
            mine().filter_map(since).any(|since| since <= DOUBTFUL)
        };
        let last_frame = outcomes.iter().rposition(|outcome| outcome == FRAME).map_or(0, |at| at as u64);
        for (trigger, found) in (0u64..).zip(&outcomes) {
            if unfinished && trigger > last_frame && found.contains(ABSENT) {
                continue;
            }
            into.outcomes += 1;
            let at_end = trigger > last_frame;
            let place = || format!("train {train} {} trigger {trigger}", camera.id);
            let wrong =
                first_stamp.and_then(|s| pixels::wrong(recording, number, trigger, s + number as u32));
            if let Some(wrong) = wrong {
                into.mismatch(format!("{}: {wrong}", place()));
            }
            match injected.get(&trigger) {
                _ if links.is_cut_off(trigger) || rows.at(trigger).is_some() => {}
                None if found == FRAME => {}
                _ if excuse.covers(found) => {}
                None if *found == doubtful && doubtful_time(trigger) => into.given_up += 1,
                // That the set is whole and that an event names it is judged below.
                _ if *found == dropped || *found == paused => into.dropped_by_host += 1,
                None => into.mismatch(format!("{}: {found}, nothing was injected", place())),
                Some(fault) => {
                    let wrong = judge(fault, found, at_end, &events);
                    let right = wrong.is_none();
                    into.count(&fault.kind, right);
                    if let Some(wrong) = wrong {
                        into.mismatch(format!(
                            "{}: {} (block {:?}): {wrong}",
                            place(),
                            fault.kind,
                            fault.block
                        ));
                    }
                }
            }
        }
        all.push(outcomes);
    }
    let torn = judge_dropped_sets(recording, &all);
    torn.into_iter().for_each(|wrong| into.mismatch(format!("{}: {wrong}", recording.path.display())));
}

/// In the reader's words, a trigger without an outcome.
const ABSENT: &str = "neither a frame nor a gap record";

/// `frame`, the cause of a gap, or what is wrong with the recording there.
fn outcome(recording: &RecordingReader, camera: usize, trigger: u64) -> String {
    match recording.frame(camera, TriggerIndex(trigger)) {
        Ok(Ok(_)) => FRAME.to_owned(),
        Ok(Err(cause)) => cause.to_string(),
        Err(problem) => problem,
    }
}

/// What is wrong with the outcome of a fault.
fn judge(
    fault: &Injected,
    found: &str,
    at_end: bool,
    events: &BTreeSet<(&str, &str, Option<u64>)>,
) -> Option<String> {
    let loss = !fault.expected.iter().any(|outcome| outcome == FRAME);
    let given_up = at_end && loss && found == "timeout";
    if !given_up && !fault.expected.iter().any(|outcome| outcome == found) {
        return Some(format!("found {found}, expected {}", fault.expected.join(" or ")));
    }
    if given_up {
        return None;
    }
    let missing = fault.events.iter().find(|kind| {
        let of_camera =
            |trigger: Option<u64>| events.contains(&(fault.camera.as_str(), kind.as_str(), trigger));
        // An event without a trigger stands for several; a stall has one event, at its first trigger.
        let first_of_row = |reach: u64| (0..=reach).any(|k| of_camera(fault.trigger.checked_sub(k)));
        !(of_camera(None) || first_of_row(if fault.kind == "stall" { 1000 } else { 0 }))
    });
    missing.map(|kind| format!("outcome {found} is right, but there is no event {kind}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fault(expected: &str, events: &[&str]) -> Injected {
        Injected {
            camera: "c".to_owned(),
            expected: vec![expected.to_owned()],
            events: events.iter().map(|e| (*e).to_owned()).collect(),
            ..Injected::at(1, 5, "k")
        }
    }

    #[test]
    fn outcome_and_events_must_fit() {
        let events = BTreeSet::from([("c", "frames_lost", Some(5))]);
        let lost = fault("missing_packets", &["frames_lost"]);
        assert_eq!(judge(&lost, "missing_packets", false, &events), None);
        assert!(judge(&lost, "missing_packets", false, &BTreeSet::new()).is_some());
        assert!(judge(&lost, "not_triggered", false, &events).is_some());
        assert!(judge(&lost, "timeout", false, &events).is_some());
        assert_eq!(judge(&lost, "timeout", true, &BTreeSet::new()), None);
        assert!(judge(&lost, FRAME, true, &events).is_some());
        assert!(judge(&fault(FRAME, &[]), "timeout", true, &events).is_some());
    }
}
