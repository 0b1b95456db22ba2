// SPDX-License-Identifier: MIT OR Apache-2.0
//! What gap records and events of a recording state about a camera's irregularities.
//!
//! They are necessary and never sufficient: an irregularity of ids or stamps that nothing names is a contradiction, and
//! one that is named must be borne out by the other sources.

use crate::base::ids::CameraId;
use crate::layout::{GapCause, NodeEvent};
use crate::reader::{Outcome, RecordingReader};
use crate::recover::is_of_damaged;
use std::cell::Cell;
use std::collections::{BTreeMap, BTreeSet};

/// The statements of a recording about one camera.
pub struct Explained<'a> {
    outcomes: &'a BTreeMap<u64, Outcome>,
    /// Whether records were lost, as the recording states, or are in other segments: the explanation may be among them.
    lost: bool,
    /// Frames that no trigger explains and that took an id all the same: how many may still come.
    extra: Cell<u64>,
    /// Kinds of events, with the triggers that they name; `None` for those that name none.
    events: BTreeMap<&'a str, BTreeSet<Option<u64>>>,
}

/// Kinds of events that explain why ids went less far than triggers.
const IGNORED: [&str; 3] = ["trigger_ignored", "id_repeated", "id_jump"];
/// Kind of the event that explains why ids went further than triggers.
const JUMPED: &str = "id_jump";
/// Kinds of the event for the first frame that no trigger explains, and of the one that counts them at the end.
const EXTRA: [&str; 2] = ["spurious_frame", "spurious_frames"];
/// Kind of the event for a camera whose clock was set.
const CLOCK_SET: &str = "camera_clock_reset";
/// Kind of the event for small records that found no room on the way to the disk.
const RECORDS_REFUSED: &str = "records_lost";
/// Kind of the event for a camera whose clock cannot be read.
const NO_CLOCK: &str = "no_camera_clock";
/// Kind of the event for a frame whose timestamp is wrong.
const STAMP_WRONG: &str = "stamp_wrong";
/// Kind of the event for a camera that came back with a fresh stream.
const BACK: &str = "camera_back";

impl<'a> Explained<'a> {
    /// By the recording's outcomes and events; `camera` is its place in the header. A single segment is not the
    /// `whole`.
    pub fn of(recording: &'a RecordingReader, camera: usize, id: &CameraId, whole: bool) -> Option<Self> {
        let mut events: BTreeMap<&str, BTreeSet<Option<u64>>> = BTreeMap::new();
        for event in recording.events.iter().filter(|event| event.camera.as_ref() == Some(id)) {
            events.entry(&event.kind).or_default().insert(event.trigger.map(|trigger| trigger.0));
        }
        let refused = recording.events.iter().any(|event| event.kind == RECORDS_REFUSED);
        let lost = !whole || refused || is_of_damaged(recording);
        let own = recording.events.iter().filter(|event| event.camera.as_ref() == Some(id));
        let extra = own.filter(|event| EXTRA.contains(&event.kind.as_str())).map(count_of).max().unwrap_or(0);
        // A recording that was aborted did not count them.
        let finished = recording.verdict.as_ref().is_some_and(|verdict| verdict.aborted.is_none());
        let extra = Cell::new(if extra > 0 && !finished { u64::MAX } else { extra });
        Some(Self { outcomes: recording.outcomes.get(camera)?, lost, extra, events })
    }

    /// Whether one of these events names a trigger behind `before` up to `number`. Events of the warm-up name none.
    fn is_named(&self, kinds: &[&str], before: i64, number: i64) -> bool {
        let from = u64::try_from(before.saturating_add(1)).unwrap_or(0);
        let to = u64::try_from(number).unwrap_or(0);
        let within = |at: &Option<u64>| at.map_or(before < 0, |at| (from..=to).contains(&at));
        kinds.iter().filter_map(|kind| self.events.get(kind)).any(|at| at.iter().any(within))
    }

    /// The causes of the gap records between two frames.
    fn causes(&self, before: i64, number: i64) -> impl Iterator<Item = GapCause> + '_ {
        let from = u64::try_from(before.saturating_add(1)).unwrap_or(0);
        let to = u64::try_from(number).unwrap_or(0).max(from);
        self.outcomes.range(from..to).filter_map(|(_, outcome)| match outcome {
            Outcome::Gap(cause) => Some(*cause),
            Outcome::Frame { .. } => None,
        })
    }

    /// Whether the camera was away between two frames: a fresh stream counts anew.
    pub fn was_away(&self, before: i64, number: i64) -> bool {
        let away = |cause| matches!(cause, GapCause::Unplugged | GapCause::ControlLost);
        self.events.contains_key(BACK) && self.causes(before, number).any(away)
    }

    /// Whether a record states why ids went `skipped` further than triggers (negative: less far) between two frames.
    pub fn counts(&self, before: i64, number: i64, skipped: i64) -> bool {
        // With such gaps it is not known trigger by trigger what the camera sent.
        let open = |cause| {
            matches!(
                cause,
                GapCause::IdentityMismatch
                    | GapCause::NodePaused
                    | GapCause::DroppedRingFull
                    | GapCause::DroppedDisk
                    | GapCause::Damaged
                    | GapCause::Unknown
            )
        };
        if self.lost || self.causes(before, number).any(open) {
            return true;
        }
        if skipped > 0 {
            let left = self.extra.get().checked_sub(skipped.unsigned_abs());
            if let Some(left) = left {
                self.extra.set(if self.extra.get() == u64::MAX { u64::MAX } else { left });
            }
            return left.is_some() || self.is_named(&[JUMPED], before, number);
        }
        let ignored = self.causes(before, number).filter(|cause| *cause == GapCause::NotTriggered).count();
        ignored as u64 >= skipped.unsigned_abs() || self.is_named(&IGNORED, before, number)
    }

    /// Whether an event states that the stamp of a trigger's frame is wrong or absent.
    pub fn stamp(&self, number: i64) -> bool {
        let at = u64::try_from(number).ok();
        self.lost
            || at.is_some() && self.events.get(STAMP_WRONG).is_some_and(|triggers| triggers.contains(&at))
    }

    /// Whether an event states that its clock cannot be read.
    pub fn has_no_clock(&self) -> bool {
        self.lost || self.events.contains_key(NO_CLOCK)
    }

    /// Whether an event states that the camera's clock was set, at whatever trigger.
    pub fn clock_set(&self) -> bool {
        self.lost || self.events.contains_key(CLOCK_SET) || self.events.contains_key(BACK)
    }

    /// Whether an event states that the camera's clock was set between two frames.
    pub fn clock_set_at(&self, before: i64, number: i64) -> bool {
        self.lost || self.is_named(&[CLOCK_SET], before, number) || self.was_away(before, number)
    }
}

/// How many frames an event counts: the one at the end begins with their number.
fn count_of(event: &NodeEvent) -> u64 {
    event.message.split(' ').next().and_then(|count| count.parse().ok()).unwrap_or(1)
}
