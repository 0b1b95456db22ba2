// SPDX-License-Identifier: MIT OR Apache-2.0
//! Pauses of the process, or of one of its threads: which triggers they concern, and which frame sets they broke.

use crate::record::GapCause;
use std::collections::BTreeSet;
use std::ops::Range;
use std::time::Duration;

/// Pauses that are remembered; what an older one broke has long been settled.
const REMEMBERED: usize = 16;
/// Broken sets that are remembered: 34 seconds of them at 120 Hz.
const BROKEN: usize = 4096;

/// Times in which the process, or one of its threads, did not run.
#[derive(Debug, Default)]
pub(super) struct Pauses {
    /// From when to when, host clock, ns, before any trigger was reported: which triggers that concerns is not known yet.
    early: Vec<Range<u64>>,
    /// Triggers that each concerns.
    concerned: Vec<Range<u64>>,
    /// Triggers of them of which a camera has no frame.
    broken: BTreeSet<u64>,
}

impl Pauses {
    /// A thread that wakes up every 10 ms and did not run for so long stood still. Longer than what a loaded machine
    /// takes now and then, shorter than what the sockets can hold at full rate.
    pub(super) const SHORTEST: Duration = Duration::from_millis(200);

    /// It stood still before any trigger was reported.
    pub(super) fn add_early(&mut self, from_ns: u64, to_ns: u64) {
        if self.early.len() < REMEMBERED {
            self.early.push(from_ns..to_ns);
        }
    }

    /// Whether it did, and which triggers that concerns is not known yet.
    pub(super) fn has_early(&self) -> bool {
        !self.early.is_empty()
    }

    /// When trigger 0 was fired, host clock, ns: for how many triggers the early pauses lasted, with those whose frames were
    /// on their way; `None` where they were over before.
    pub(super) fn begin(&mut self, first_ns: u64, period_ns: u64) -> Option<u64> {
        let last = self.early.drain(..).map(|pause| pause.end).max()?;
        let concerned = last.saturating_add(period_ns).checked_sub(first_ns)? / period_ns.max(1) + 2;
        self.add(0..concerned);
        Some(concerned)
    }

    /// These triggers came while the process stood still, or just around it.
    pub(super) fn add(&mut self, triggers: Range<u64>) {
        // A host that is starved for long is one pause.
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

    /// Whether a frame that is missing for this cause is missing because of a pause: then its set is broken.
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
