// SPDX-License-Identifier: MIT OR Apache-2.0
//! The cause that the pattern of a camera's outcomes shows, and what to do about it.
//!
//! A gap record names the cause of one trigger. A camera that takes every second trigger, or wakes up late, shows it in
//! the order of its gaps alone.

use super::layout::GapCause;
use super::verdict::CameraVerdict;
use serde::{Deserialize, Serialize};

/// Lines of advice. They are text, not figures: another version may word them in another way, and so all are equal.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Advice(pub Vec<String>);

impl PartialEq for Advice {
    fn eq(&self, _: &Self) -> bool {
        true
    }
}

impl Eq for Advice {}

impl Advice {
    /// Whether there is no line.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The advice on cameras, by their rhythm and their counts.
    pub(crate) fn of<'a>(cameras: impl Iterator<Item = (&'a Rhythm, &'a CameraVerdict)>) -> Self {
        Self(cameras.filter_map(|(rhythm, counts)| rhythm.advice(counts)).collect())
    }
}

/// Distances from 1 to below this number are counted one by one, longer ones together.
const DISTANCES: usize = 9;
/// Distances that a rhythm needs: fewer may be regular by chance.
const ENOUGH: u64 = 5;
/// Triggers without a frame at the beginning beyond which a camera did not wake up late, but was absent.
const LATEST: u64 = 1000;

/// Distances between triggers of one kind, as far as they come in order.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct Distances {
    first: Option<u64>,
    last: Option<u64>,
    count: u64,
    sum: u64,
    squares: u128,
    /// Counts by distance; at 0 those of longer ones.
    of: [u64; DISTANCES],
}

impl Distances {
    fn add(&mut self, trigger: u64) {
        self.first.get_or_insert(trigger);
        let Some(last) = self.last.replace(trigger) else { return };
        let Some(distance) = trigger.checked_sub(last).filter(|distance| *distance > 0) else {
            // Late, and of no use here.
            self.last = Some(last);
            return;
        };
        self.count += 1;
        self.sum += distance;
        self.squares += u128::from(distance).pow(2);
        let place = usize::try_from(distance).ok().filter(|distance| *distance < DISTANCES).unwrap_or(0);
        self.of[place] += 1;
    }

    /// The distance that nine of ten have, if it is above 1.
    fn usual(&self) -> Option<u64> {
        let usual = (2..DISTANCES).find(|distance| self.of[*distance] * 10 >= self.count * 9)?;
        (self.count >= ENOUGH).then_some(usual as u64)
    }

    /// The mean distance, if all are about that.
    fn even(&self) -> Option<f64> {
        let (count, sum) = (self.count as f64, self.sum as f64);
        let mean = sum / count.max(1.0);
        let variance = self.squares as f64 / count.max(1.0) - mean * mean;
        (self.count >= ENOUGH && mean >= 1.5 && variance <= (mean / 4.0).powi(2)).then_some(mean)
    }
}

/// In which rhythm a camera's frames come, and the triggers that it ignored. Its size is fixed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Rhythm {
    frames: Distances,
    ignored: Distances,
}

impl Rhythm {
    /// A frame of this trigger.
    pub(crate) fn frame(&mut self, trigger: u64) {
        self.frames.add(trigger);
    }

    /// No frame of this trigger.
    pub(crate) fn gap(&mut self, trigger: u64, cause: GapCause) {
        if cause == GapCause::NotTriggered {
            self.ignored.add(trigger);
        }
    }

    /// The advice that rhythm and counts give; `None` where they give none.
    fn advice(&self, counts: &CameraVerdict) -> Option<String> {
        let of = |causes: &[GapCause]| -> u64 {
            causes.iter().filter_map(|cause| counts.gaps.get(cause)).fold(0, |sum, n| sum.saturating_add(*n))
        };
        let (id, gaps, ignored) = (&counts.camera, counts.gap_count(), of(&[GapCause::NotTriggered]));
        if ignored * 10 >= gaps * 8 && ignored >= ENOUGH {
            let evenly = match (self.frames.usual(), self.ignored.even()) {
                (Some(usual), _) => Some(format!("takes every {} trigger only", ordinal(usual))),
                (None, Some(every)) if self.spans_half(counts) => {
                    Some(format!("ignores one trigger in {:.0}, evenly", every.round()))
                }
                _ => None,
            };
            if let Some(evenly) = evenly {
                return Some(format!(
                    "{id} {evenly}: its exposure and readout are longer than the trigger period, or a trigger may not \
                     come during readout (TriggerOverlap is off); shorten exposure_us or set overlap = true in the \
                     node file, or lower trigger_rate_hz in the rig file"
                ));
            }
        }
        let first = self.frames.first.filter(|first| (1..=LATEST).contains(first))?;
        let late = of(&[GapCause::NotTriggered, GapCause::MissingPackets, GapCause::Timeout]);
        let unknown = of(&[GapCause::IdentityMismatch]);
        let others = gaps.saturating_sub(first);
        if late + unknown < first || others * 10 > counts.frames || counts.frames < ENOUGH {
            return None;
        }
        let none = match first {
            1 => "trigger 0".to_owned(),
            first => format!("the first {first} triggers"),
        };
        Some(if unknown * 2 > first {
            format!(
                "{id} sent frames of {none}, but too few frames of the warm-up arrived to know their triggers; raise \
                 warm_up_triggers in the rig file"
            )
        } else {
            format!(
                "{id} has no frame of {none} and those behind: it woke up late; raise warm_up_triggers in the rig file \
                 by at least {first}"
            )
        })
    }

    /// Whether triggers were ignored over half of the session, and not in one place.
    fn spans_half(&self, counts: &CameraVerdict) -> bool {
        let span = self.ignored.last.zip(self.ignored.first).map_or(0, |(last, first)| last - first);
        span.saturating_mul(2) >= counts.frames.saturating_add(counts.gap_count())
    }
}

fn ordinal(number: u64) -> String {
    match number {
        2 => "second".to_owned(),
        3 => "third".to_owned(),
        4 => "fourth".to_owned(),
        number => format!("{number}th"),
    }
}

#[cfg(test)]
mod tests {
    use super::{CameraVerdict, GapCause, Rhythm};
    use crate::base::ids::{CameraId, TriggerIndex};
    use crate::verdict::CameraTally;

    /// The advice on a camera with these outcomes, `None` for a frame.
    fn advice(triggers: u64, outcome: impl Fn(u64) -> Option<GapCause>) -> Option<String> {
        let mut tally = CameraTally::default();
        for trigger in 0..triggers {
            match outcome(trigger) {
                None => tally.frame(TriggerIndex(trigger)),
                Some(cause) => tally.gap(TriggerIndex(trigger), cause),
            };
        }
        let counts: CameraVerdict = tally.verdict(&CameraId::from("h0_up"));
        tally.rhythm().advice(&counts)
    }

    /// Aravis #771 and its siblings: at whatever trigger it began, and whatever else was lost.
    #[test]
    fn of_a_camera_that_takes_every_nth_trigger_cause_and_remedy_are_named() {
        for (every, word) in [(2, "second"), (3, "third"), (4, "fourth"), (5, "5th")] {
            for begin in 0..every {
                let ignored = |trigger: u64| (trigger % every != begin).then_some(GapCause::NotTriggered);
                let said = advice(40, ignored).expect("a rhythm");
                for part in
                    [&format!("h0_up takes every {word} trigger only"), "TriggerOverlap", "exposure_us"]
                {
                    assert!(said.contains(part), "{part}: {said}");
                }
            }
        }
        // A frame lost on the way, and the first ones given up.
        let lost = |trigger: u64| match trigger {
            0..6 => Some(GapCause::IdentityMismatch),
            301 => Some(GapCause::MissingPackets),
            _ => trigger.is_multiple_of(2).then_some(GapCause::NotTriggered),
        };
        assert!(advice(900, lost).expect("a rhythm").contains("every second trigger"));
        // A camera with a queue of its own: 100 frames a second at 120 triggers.
        let sixth = |trigger: u64| (trigger % 6 == 5).then_some(GapCause::NotTriggered);
        assert!(advice(600, sixth).expect("a rhythm").contains("ignores one trigger in 6, evenly"));
    }

    #[test]
    fn for_a_camera_that_wakes_late_a_longer_warm_up_is_advised() {
        for late in [1, 6, 9] {
            for cause in [GapCause::NotTriggered, GapCause::MissingPackets, GapCause::Timeout] {
                let said = advice(120, |trigger| (trigger < late).then_some(cause)).expect("late");
                assert!(said.contains("woke up late"), "{said}");
                assert!(
                    said.contains(&format!("warm_up_triggers in the rig file by at least {late}")),
                    "{said}"
                );
            }
        }
        let unknown = |trigger: u64| (trigger < 9).then_some(GapCause::IdentityMismatch);
        let said = advice(120, unknown).expect("late");
        assert!(said.contains("frames of the warm-up") && !said.contains("woke"), "{said}");
    }

    #[test]
    fn there_is_no_advice_where_the_gaps_have_no_such_rhythm() {
        type Cause = fn(u64) -> Option<GapCause>;
        let silent: [Cause; 7] = [
            |_| None,
            |_| Some(GapCause::Unplugged),
            |trigger| [3, 17, 18, 77].contains(&trigger).then_some(GapCause::NotTriggered),
            // Unplugged at first, a full ring at first, every second packet lost.
            |trigger| (trigger < 9).then_some(GapCause::Unplugged),
            |trigger| (trigger < 9).then_some(GapCause::DroppedRingFull),
            |trigger| trigger.is_multiple_of(2).then_some(GapCause::MissingPackets),
            // In one place.
            |trigger| {
                ((40..60).contains(&trigger) && trigger.is_multiple_of(3)).then_some(GapCause::NotTriggered)
            },
        ];
        for (place, outcome) in silent.into_iter().enumerate() {
            assert_eq!(advice(120, outcome), None, "{place}");
        }
    }

    #[test]
    fn what_comes_late_changes_nothing() {
        let mut rhythm = Rhythm::default();
        [0, 2, 4, 3, 6].into_iter().for_each(|trigger| rhythm.frame(trigger));
        assert_eq!((rhythm.frames.count, rhythm.frames.of[2]), (3, 3));
    }
}
