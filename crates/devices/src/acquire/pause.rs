// SPDX-License-Identifier: MIT OR Apache-2.0
//! Pauses of the process, or of one of its threads: the triggers concerned, and the frame sets that lost frames.

use crate::record::GapCause;
use std::collections::BTreeSet;
use std::ops::Range;
use std::time::Duration;

/// Pauses that are kept; the frame sets of older ones have long been settled.
const REMEMBERED: usize = 16;
/// Incomplete frame sets that are kept: 34 seconds of them at 120 Hz.
const BROKEN: usize = 4096;

/// Times in which the process, or one of its threads, did not run.
#[derive(Debug, Default)]
pub(super) struct Pauses {
    /// Pauses before any trigger was reported, host clock, ns: the triggers concerned are not known yet.
    early: Vec<Range<u64>>,
    /// Triggers concerned, a range per pause.
    concerned: Vec<Range<u64>>,
    /// Concerned triggers of which a camera has no frame.
    broken: BTreeSet<u64>,
}

impl Pauses {
    /// Shortest gap between two turns of a 10 ms thread that counts as a pause: longer than a loaded machine takes
    /// now and then, shorter than the time whose packets the sockets can hold at full rate.
    pub(super) const SHORTEST: Duration = Duration::from_millis(200);

    /// Adds a pause before any trigger was reported.
    pub(super) fn add_early(&mut self, from_ns: u64, to_ns: u64) {
        if self.early.len() < REMEMBERED {
            self.early.push(from_ns..to_ns);
        }
    }

    /// Whether there are pauses whose triggers are not known yet.
    pub(super) fn has_early(&self) -> bool {
        !self.early.is_empty()
    }

    /// Assigns the early pauses to triggers, once it is known when trigger 0 was fired (host clock, ns). Gives the
    /// number of triggers concerned, including those whose frames were on their way; `None` where the pauses ended
    /// before.
    pub(super) fn begin(&mut self, first_ns: u64, period_ns: u64) -> Option<u64> {
        let last = self.early.drain(..).map(|pause| pause.end).max()?;
        let concerned = last.saturating_add(period_ns).checked_sub(first_ns)? / period_ns.max(1) + 2;
        self.add(0..concerned);
        Some(concerned)
    }

    /// Adds triggers that came during a pause, or just before or after it.
    pub(super) fn add(&mut self, triggers: Range<u64>) {
        // Pauses that meet are one, so that a host that is starved for long fills no list.
        if let Some(last) = self.concerned.last_mut()
            && triggers.start <= last.end
            && last.start <= triggers.start
        {
            last.end = last.end.max(triggers.end);
            return;
        }
        if self.concerned.len() >= REMEMBERED {
            self.concerned.remove(0);
        }
        self.concerned.push(triggers);
    }

    /// Whether a frame that is missing for this cause is missing because of a pause: then its set counts as incomplete.
    pub(super) fn breaks(&mut self, trigger: u64, cause: GapCause) -> bool {
        let by_pause = matches!(
            cause,
            GapCause::MissingPackets
                | GapCause::Timeout
                | GapCause::DroppedRingFull
                | GapCause::IdentityMismatch
                | GapCause::NodePaused
        );
        let concerned = by_pause && self.concerned.iter().any(|range| range.contains(&trigger));
        if concerned {
            self.broken.insert(trigger);
            if self.broken.len() > BROKEN {
                self.broken.pop_first();
            }
        }
        concerned
    }

    /// Whether a frame of this set is missing because of a pause.
    pub(super) fn is_broken(&self, trigger: u64) -> bool {
        self.broken.contains(&trigger)
    }
}

#[cfg(test)]
mod tests {
    use super::Pauses;
    use crate::record::GapCause;

    #[test]
    fn a_pause_before_the_first_report_concerns_the_triggers_that_were_fired_meanwhile() {
        let mut pauses = Pauses::default();
        assert_eq!(pauses.begin(1000, 100), None, "there was none");
        // Over in the warm-up; and over 250 ns after trigger 0.
        pauses.add_early(0, 700);
        assert_eq!(pauses.begin(1000, 100), None);
        pauses.add_early(0, 700);
        pauses.add_early(800, 1250);
        assert_eq!(pauses.begin(1000, 100), Some(5));
        assert!(pauses.breaks(0, GapCause::MissingPackets) && pauses.breaks(4, GapCause::IdentityMismatch));
        assert!(!pauses.breaks(5, GapCause::MissingPackets));
        assert_eq!(pauses.begin(1000, 100), None, "once");
    }

    #[test]
    fn pauses_that_meet_are_one() {
        let mut pauses = Pauses::default();
        (0..1000).for_each(|k| pauses.add(k * 10..k * 10 + 12));
        assert_eq!((pauses.concerned.len(), pauses.concerned[0].end), (1, 10_002));
        pauses.add(20_000..20_001);
        assert_eq!(pauses.concerned.len(), 2);
    }

    #[test]
    fn only_what_a_pause_explains_is_blamed_on_it() {
        let mut pauses = Pauses::default();
        pauses.add(10..20);
        assert!(!pauses.breaks(9, GapCause::MissingPackets) && !pauses.breaks(20, GapCause::Timeout));
        assert!(!pauses.breaks(12, GapCause::NotTriggered) && !pauses.breaks(12, GapCause::Unplugged));
        assert!(!pauses.is_broken(12), "a camera that ignored a trigger did so without our help");
        assert!(
            pauses.breaks(12, GapCause::DroppedRingFull) && pauses.is_broken(12) && !pauses.is_broken(13)
        );
    }
}
