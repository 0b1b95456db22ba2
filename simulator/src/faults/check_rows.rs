// SPDX-License-Identifier: MIT OR Apache-2.0
//! Faults that concern a row of triggers, and what the recording must state about each of them.

use super::check::Accounting;
use super::truth::{FRAME, Injected};
use fourdbody::record::RecordingReader;
use std::collections::BTreeMap;

/// The rows of one camera in one train, by every trigger that they cover.
pub(super) struct Rows<'a> {
    faults: Vec<&'a Injected>,
    by_trigger: BTreeMap<u64, &'a Injected>,
}

/// Whether a camera that was away must first be found and set up again: how long that takes is not known beforehand.
fn ends_with_a_frame(fault: &Injected) -> bool {
    fault.events.iter().any(|event| event == "camera_lost")
}

impl<'a> Rows<'a> {
    /// Of these faults those with a length; `outcomes` are the camera's.
    pub(super) fn of(faults: impl Iterator<Item = &'a Injected>, outcomes: &[String]) -> Self {
        let faults: Vec<&Injected> = faults.filter(|fault| fault.lasts.is_some()).collect();
        let mut by_trigger = BTreeMap::new();
        for fault in &faults {
            let mut end = fault.trigger.saturating_add(fault.lasts.unwrap_or(1));
            if ends_with_a_frame(fault) {
                let tail = outcomes.iter().skip(end as usize).take_while(|outcome| *outcome != FRAME).count();
                end = end.saturating_add(tail as u64);
            }
            by_trigger.extend((fault.trigger..end.min(outcomes.len() as u64)).map(|t| (t, *fault)));
        }
        Self { faults, by_trigger }
    }

    /// The row that a trigger belongs to.
    pub(super) fn at(&self, trigger: u64) -> Option<&'a Injected> {
        self.by_trigger.get(&trigger).copied()
    }

    /// Counts the rows, each with its outcomes and its events.
    pub(super) fn judge(&self, recording: &RecordingReader, outcomes: &[String], into: &mut Accounting) {
        for (number, fault) in self.faults.iter().enumerate() {
            let covered = || self.by_trigger.iter().filter(|(_, row)| **row == *fault).map(|(t, _)| *t);
            let wrong = covered()
                .filter_map(|trigger| Some((trigger, outcomes.get(trigger as usize)?)))
                .find(|(_, found)| !fault.expected.contains(found));
            let seen = |kind: &str| {
                let of = |e: &&fourdbody::record::NodeEvent| {
                    e.kind == kind && e.camera.as_ref().is_some_and(|camera| camera.as_str() == fault.camera)
                };
                recording.events.iter().filter(of).count()
            };
            let needed = |kind: &str| {
                1 + self.faults[..number].iter().filter(|f| f.events.iter().any(|e| e == kind)).count()
            };
            let missing = fault.events.iter().find(|kind| seen(kind) < needed(kind));
            let stays = covered().next_back().is_none_or(|last| last as usize + 1 >= outcomes.len());
            let not_back = ends_with_a_frame(fault) && !stays && seen("camera_back") < needed("camera_lost");
            into.count(&fault.kind, wrong.is_none() && missing.is_none() && !not_back);
            let place = || format!("{} {} trigger {}", fault.camera, fault.kind, fault.trigger);
            if let Some((trigger, found)) = wrong {
                let expected = fault.expected.join(" or ");
                into.mismatch(format!("{}: found {found} at {trigger}, expected {expected}", place()));
            }
            if let Some(kind) = missing {
                into.mismatch(format!("{}: there is no event {kind}", place()));
            }
            if not_back {
                into.mismatch(format!("{}: frames came again, but there is no event camera_back", place()));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::Rows;
    use crate::faults::Injected;

    #[test]
    fn an_absence_lasts_until_the_next_frame_and_other_rows_as_long_as_they_say() {
        let row = |kind: &str, trigger: u64, events: &[&str]| Injected {
            lasts: Some(2),
            events: events.iter().map(|e| (*e).to_owned()).collect(),
            ..Injected::at(1, trigger, kind)
        };
        let faults =
            [row("unplugged", 1, &["camera_lost"]), row("foreign_ahead", 7, &[]), Injected::at(1, 0, "k")];
        let outcomes = ["frame", "u", "u", "u", "u", "frame", "frame", "u", "u", "u"].map(str::to_owned);
        let rows = Rows::of(faults.iter(), &outcomes);
        let covered: Vec<usize> = (0..10).filter(|t| rows.at(*t as u64).is_some()).collect();
        assert_eq!(covered, [1, 2, 3, 4, 7, 8]);
    }
}
