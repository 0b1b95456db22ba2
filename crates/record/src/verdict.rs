// SPDX-License-Identifier: MIT OR Apache-2.0
//! Counting outcomes: which triggers of a camera have one, and the verdict on a session at its end.

use super::advice::{Advice, Rhythm};
use super::layout::{GapCause, MAX_TRIGGERS, RecordingHeader};
use super::noted::Noted;
use crate::base::ids::{CameraId, TriggerIndex};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fmt;
use std::ops::Range;

/// The verdict on a session in one word, from the best to the worst.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Status {
    /// Every camera has a frame for every trigger that was requested.
    Complete,
    /// As [`Self::Complete`], but the trigger of some frames rests on one source alone, or how they were taken is in
    /// doubt: a camera's settings changed, or exposures of a trigger were not at one time.
    Unconfirmed,
    /// Something is missing, and it is known what and why.
    Incomplete,
    /// The session was aborted; what was recorded until then is accounted for.
    Aborted,
}

impl Status {
    /// The word that messages and JSON use.
    pub fn word(self) -> &'static str {
        match self {
            Self::Complete => "complete",
            Self::Unconfirmed => "unconfirmed",
            Self::Incomplete => "incomplete",
            Self::Aborted => "aborted",
        }
    }
}

/// Counts of one camera's outcomes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct CameraVerdict {
    /// Name of the camera in the rig.
    #[cfg_attr(feature = "schema", schema(value_type = String))]
    pub camera: CameraId,
    /// Triggers of which a frame is recorded.
    pub frames: u64,
    /// Triggers with a gap record, by cause.
    #[cfg_attr(feature = "schema", schema(value_type = BTreeMap<String, u64>))]
    pub gaps: BTreeMap<GapCause, u64>,
}

impl CameraVerdict {
    /// Triggers with a gap record.
    pub fn gap_count(&self) -> u64 {
        // The counts may come from a file.
        self.gaps.values().fold(0, |sum, count| sum.saturating_add(*count))
    }
}

/// The verdict on one node's recording: complete or not, with all counts.
///
/// The recording computes it when it is finished, stores it in the last segment and returns it; `verify` computes it
/// again from the records.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Verdict {
    /// The verdict in one word, from best to worst.
    pub status: Status,
    /// Triggers of the session: every camera has this many outcomes.
    pub triggers: u64,
    /// Triggers that were requested; null runs until stop.
    pub triggers_expected: Option<u64>,
    /// Triggers that the HSU reports to have emitted; `None` when the report is missing.
    pub triggers_emitted: Option<u64>,
    /// Per camera, in the recording's order.
    pub cameras: Vec<CameraVerdict>,
    /// Triggers without a row in the HSU's table: when they were fired is not known.
    #[serde(default)]
    pub untimed: u64,
    /// Outcomes that were refused: a second one for a trigger, or one that lies outside the session. Each
    /// is an event in the recording.
    pub refused: u64,
    /// Cameras of which the trigger of some frames rests on one source alone. Each is an event in the recording.
    #[serde(default)]
    pub unconfirmed: u64,
    /// Settings that were not as they had been set when the session ended, each with its camera.
    #[serde(default)]
    pub changed: Vec<String>,
    /// Exposures that were not at the time of the others: camera, triggers and reason, a line each.
    #[serde(default)]
    pub not_simultaneous: Vec<String>,
    /// Why the session was aborted.
    pub aborted: Option<String>,
    /// What the pattern of the gaps shows, and what to do about it. Never read from a file: it is found from its
    /// records.
    #[serde(default, skip_deserializing, skip_serializing_if = "Advice::is_empty")]
    #[cfg_attr(feature = "schema", schema(value_type = Vec<String>))]
    pub advice: Advice,
}

impl Verdict {
    /// Frames of all cameras together.
    pub fn frames(&self) -> u64 {
        self.cameras.iter().fold(0, |sum, camera| sum.saturating_add(camera.frames))
    }

    /// Gap records of all cameras.
    pub fn gaps(&self) -> u64 {
        self.cameras.iter().fold(0, |sum, camera| sum.saturating_add(camera.gap_count()))
    }

    /// How many triggers a session had: what was seen, reported or counted, whichever is most.
    pub fn triggers(tallies: &[CameraTally], reported: u64, end: &SessionEnd) -> u64 {
        let seen = tallies.iter().map(|tally| tally.seen().end()).max().unwrap_or(0);
        seen.max(reported).max(end.triggers_emitted.unwrap_or(0)).min(MAX_TRIGGERS)
    }

    /// The verdict on what was counted.
    pub fn of(
        header: &RecordingHeader,
        tallies: &[CameraTally],
        rows: &TriggerSet,
        triggers: u64,
        noted: Noted,
        end: SessionEnd,
    ) -> Self {
        let named = header.cameras.iter().zip(tallies);
        let cameras: Vec<CameraVerdict> = named.map(|(camera, tally)| tally.verdict(&camera.id)).collect();
        let mut verdict = Self {
            status: Status::Incomplete,
            triggers,
            triggers_expected: header.expected_triggers,
            triggers_emitted: end.triggers_emitted,
            advice: Advice::of(tallies.iter().map(CameraTally::rhythm).zip(&cameras)),
            cameras,
            untimed: Self::untimed(header, rows, triggers),
            refused: noted.refused,
            unconfirmed: noted.unconfirmed,
            changed: noted.changed,
            not_simultaneous: noted.not_simultaneous.lines(),
            aborted: end.aborted,
        };
        verdict.status = verdict.judge();
        verdict
    }

    /// How many triggers have no row; a recording without an HSU has no table.
    pub fn untimed(header: &RecordingHeader, rows: &TriggerSet, triggers: u64) -> u64 {
        let absent = || rows.absent(triggers).into_iter().map(|range| range.end - range.start).sum();
        header.hsu.as_ref().map_or(0, |_| absent())
    }

    /// Derives the status from everything else.
    pub fn judge(&self) -> Status {
        let as_requested = self.triggers_expected.is_none_or(|n| n == self.triggers);
        let counted = self.triggers_emitted == Some(self.triggers);
        if self.aborted.is_some() {
            Status::Aborted
        } else if as_requested && counted && self.gaps() == 0 && self.untimed == 0 && self.refused == 0 {
            if self.unconfirmed == 0 && self.changed.is_empty() && self.not_simultaneous.is_empty() {
                Status::Complete
            } else {
                Status::Unconfirmed
            }
        } else {
            Status::Incomplete
        }
    }
}

impl Verdict {
    /// Every reason beside gaps and an abort that keeps the session from being complete, a sentence each.
    pub fn remarks(&self) -> Vec<String> {
        let mut remarks = Vec::new();
        let triggers = self.triggers;
        match (self.triggers_expected, self.triggers_emitted) {
            (Some(n), _) if n != triggers => remarks.push(format!("{n} triggers were requested")),
            (_, None) => remarks.push("the HSU's count is missing".to_owned()),
            (_, Some(n)) if n != triggers => remarks.push(format!("the HSU counted {n} triggers")),
            _ => {}
        }
        if self.untimed > 0 {
            remarks.push(format!("the times of {} triggers are lost", self.untimed));
        }
        if self.refused > 0 {
            remarks.push(format!("{} outcomes refused", self.refused));
        }
        if self.unconfirmed > 0 {
            let cameras = self.unconfirmed;
            let reason = "the trigger of some frames is not proven: one source alone names it";
            remarks.push(format!("of {cameras} cameras {reason}"));
        }
        remarks.extend(self.changed.iter().map(|line| format!("settings changed while it ran: {line}")));
        let apart = self.not_simultaneous.iter();
        remarks.extend(apart.map(|line| format!("not simultaneous with the others: {line}")));
        remarks
    }
}

impl fmt::Display for Verdict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let word = self.status.word();
        let (triggers, frames, gaps) = (self.triggers, self.frames(), self.gaps());
        write!(f, "{word}: {triggers} triggers, {frames} frames, {gaps} gaps")?;
        self.remarks().iter().try_for_each(|remark| write!(f, "; {remark}"))?;
        if let Some(reason) = &self.aborted {
            write!(f, "; {reason}")?;
        }
        for camera in self.cameras.iter().filter(|camera| !camera.gaps.is_empty()) {
            write!(f, "\n  {}: {} frames", camera.camera, camera.frames)?;
            for (cause, count) in &camera.gaps {
                write!(f, ", {count} {cause}")?;
            }
        }
        self.advice.0.iter().try_for_each(|line| write!(f, "\n  {line}"))
    }
}

/// How a session ended, as the node that ran it knows.
#[derive(Debug, Clone)]
pub struct SessionEnd {
    /// Triggers that the HSU reports to have emitted.
    pub triggers_emitted: Option<u64>,
    /// Why the session was aborted, if it was.
    pub aborted: Option<String>,
    /// Cause of the gap records for outcomes that are still absent.
    pub absent: GapCause,
    /// When it ended, host clock, ns.
    pub host_time_ns: u64,
}

/// A set of trigger indexes as disjoint ranges: its size is that of the disorder, not of the session.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct TriggerSet {
    /// Start to end (exclusive); neighbours never touch.
    ranges: BTreeMap<u64, u64>,
}

impl TriggerSet {
    /// Adds an index; `false` when it was there. Indexes from [`MAX_TRIGGERS`] on are never added.
    pub fn insert(&mut self, index: u64) -> bool {
        if index >= MAX_TRIGGERS {
            return false;
        }
        let before = self.ranges.range(..=index).next_back().map(|(&start, &end)| (start, end));
        let start = match before {
            Some((_, end)) if end > index => return false,
            Some((start, end)) if end == index => start,
            _ => index,
        };
        let end = self.ranges.remove(&(index + 1)).unwrap_or(index + 1);
        self.ranges.insert(start, end);
        true
    }

    /// Takes an index out again; `false` when it was not there.
    pub fn remove(&mut self, index: u64) -> bool {
        let Some((&start, &end)) = self.ranges.range(..=index).next_back() else { return false };
        if end <= index {
            return false;
        }
        self.ranges.remove(&start);
        if start < index {
            self.ranges.insert(start, index);
        }
        if index + 1 < end {
            self.ranges.insert(index + 1, end);
        }
        true
    }

    /// One more than the highest index; 0 when there is none.
    pub fn end(&self) -> u64 {
        self.ranges.last_key_value().map_or(0, |(_, &end)| end)
    }

    /// Whether all indexes of 0 to `end` are there.
    pub fn covers(&self, end: u64) -> bool {
        end == 0 || self.ranges.get(&0).is_some_and(|&first| first >= end)
    }

    /// The ranges of 0 to `end` that are absent.
    pub fn absent(&self, end: u64) -> Vec<Range<u64>> {
        let mut absent = Vec::new();
        let mut next = 0;
        for (&start, &stop) in self.ranges.range(..end) {
            if next < start {
                absent.push(next..start);
            }
            next = stop;
        }
        if next < end {
            absent.push(next..end);
        }
        absent
    }
}

/// Outcomes of one camera so far: at most one for each trigger.
#[derive(Debug, Clone, Default)]
pub struct CameraTally {
    seen: TriggerSet,
    frames: u64,
    gaps: BTreeMap<GapCause, u64>,
    rhythm: Rhythm,
}

impl CameraTally {
    /// Notes a frame; `false` when the trigger has an outcome already.
    pub fn frame(&mut self, trigger: TriggerIndex) -> bool {
        let fresh = self.seen.insert(trigger.0);
        self.frames += u64::from(fresh);
        if fresh {
            self.rhythm.frame(trigger.0);
        }
        fresh
    }

    /// Notes a gap; `false` when the trigger has an outcome already.
    pub fn gap(&mut self, trigger: TriggerIndex, cause: GapCause) -> bool {
        let fresh = self.seen.insert(trigger.0);
        if fresh {
            *self.gaps.entry(cause).or_default() += 1;
            self.rhythm.gap(trigger.0, cause);
        }
        fresh
    }

    /// In which order they came.
    pub(crate) fn rhythm(&self) -> &Rhythm {
        &self.rhythm
    }

    /// Takes back a frame that did not reach the disk.
    pub fn forget_frame(&mut self, trigger: TriggerIndex) {
        if self.seen.remove(trigger.0) {
            self.frames = self.frames.saturating_sub(1);
        }
    }

    /// The triggers with an outcome.
    pub fn seen(&self) -> &TriggerSet {
        &self.seen
    }

    /// The counts of this camera so far.
    pub fn verdict(&self, camera: &CameraId) -> CameraVerdict {
        CameraVerdict { camera: camera.clone(), frames: self.frames, gaps: self.gaps.clone() }
    }
}

#[cfg(test)]
mod tests {
    use super::{Advice, CameraTally, Noted, SessionEnd, Status, TriggerSet, Verdict};
    use crate::base::ids::{CameraId, TriggerIndex};
    use crate::layout::{GapCause, HsuIdentity, NodeEvent, RecordingHeader};
    use crate::{SETTING_CHANGED, TriggerRow};
    use proptest::prelude::*;
    use std::collections::BTreeSet;

    proptest! {
        #[test]
        fn a_trigger_set_is_a_set(steps in prop::collection::vec((0u64..60, any::<bool>()), 0..200), end in 0u64..70) {
            let (mut set, mut model) = (TriggerSet::default(), BTreeSet::new());
            for (index, add) in steps {
                if add {
                    prop_assert_eq!(set.insert(index), model.insert(index));
                } else {
                    prop_assert_eq!(set.remove(index), model.remove(&index));
                }
            }
            prop_assert_eq!(set.end(), model.last().map_or(0, |last| last + 1));
            prop_assert_eq!(set.covers(end), (0..end).all(|i| model.contains(&i)));
            let absent: Vec<u64> = set.absent(end).into_iter().flatten().collect();
            let expected: Vec<u64> = (0..end).filter(|i| !model.contains(i)).collect();
            prop_assert_eq!(absent, expected);
        }
    }

    #[test]
    fn a_setting_that_changed_and_exposures_apart_are_in_the_verdict_by_name() {
        let mut noted = Noted::default();
        let event = |kind: &str| NodeEvent {
            host_time_ns: 0,
            kind: kind.to_owned(),
            camera: Some(CameraId::from("h0_up")),
            trigger: None,
            message: "Gain was 0, is 6".to_owned(),
        };
        let verdict = |noted: &Noted| Verdict {
            status: Status::Incomplete,
            triggers: 3,
            triggers_expected: Some(3),
            triggers_emitted: Some(3),
            cameras: Vec::new(),
            untimed: 0,
            refused: 0,
            unconfirmed: 0,
            changed: noted.changed.clone(),
            not_simultaneous: noted.not_simultaneous.lines(),
            aborted: None,
            advice: Advice::default(),
        };
        noted.note(&event("camera_setting"));
        assert_eq!(verdict(&noted).judge(), Status::Complete);
        (0..100).for_each(|_| noted.note(&event(SETTING_CHANGED)));
        assert_eq!(verdict(&noted).judge(), Status::Unconfirmed);
        assert!(verdict(&noted).to_string().contains("h0_up: Gain was 0, is 6"));
        assert_eq!(noted.changed.len(), 16, "bounded");

        let mut noted = Noted::default();
        noted.note(&TriggerRow::all(11, 13).event(CameraId::from("h1_low"), "it came late", 0));
        assert_eq!(verdict(&noted).judge(), Status::Unconfirmed);
        let text = verdict(&noted).to_string();
        assert!(
            text.contains("not simultaneous with the others: h1_low, triggers 11 to 13: it came late"),
            "{text}"
        );
    }

    #[test]
    fn triggers_without_a_row_are_loss() {
        let mut header = crate::writer::tests::header(Some(4));
        let mut tally = CameraTally::default();
        (0..4).for_each(|trigger| assert!(tally.frame(TriggerIndex(trigger))));
        let mut rows = TriggerSet::default();
        [0, 2, 3].into_iter().for_each(|row| assert!(rows.insert(row)));
        let of = |header: &RecordingHeader| {
            let absent = GapCause::IdentityMismatch;
            let end = SessionEnd { triggers_emitted: Some(4), aborted: None, absent, host_time_ns: 0 };
            Verdict::of(header, &[tally.clone(), tally.clone()], &rows, 4, Noted::default(), end)
        };
        assert_eq!((of(&header).untimed, of(&header).status), (0, Status::Complete), "without an HSU");
        header.hsu = Some(HsuIdentity { uid: "7".to_owned(), firmware: "1".to_owned(), protocol: 1 });
        assert_eq!((of(&header).untimed, of(&header).status), (1, Status::Incomplete));
        assert!(of(&header).to_string().contains("the times of 1 triggers are lost"));
    }

    #[test]
    fn its_size_is_that_of_the_disorder() {
        let mut set = TriggerSet::default();
        for index in (0..10_000u64).map(|i| i ^ 3) {
            assert!(set.insert(index));
            assert!(set.ranges.len() <= 3);
        }
        assert_eq!((set.ranges.len(), set.end()), (1, 10_000));
    }
}
