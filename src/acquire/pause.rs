// SPDX-License-Identifier: MIT OR Apache-2.0
//! Pauses of the process: which triggers they concern, and which frame sets they broke.

use crate::record::GapCause;
use std::collections::BTreeSet;
use std::ops::Range;
use std::time::Duration;

/// Pauses that are remembered; what an older one broke has long been settled.
const REMEMBERED: usize = 16;
/// Broken sets that are remembered: 34 seconds of them at 120 Hz.
const BROKEN: usize = 4096;

/// Times in which the process did not run.
#[derive(Debug, Default)]
pub(super) struct Pauses {
    /// Triggers that each concerns.
    concerned: Vec<Range<u64>>,
    /// Triggers of them of which a camera has no frame.
    broken: BTreeSet<u64>,
}

impl Pauses {
    /// A thread that wakes up every 10 ms and did not run for so long stood still. Longer than what a loaded machine
    /// takes now and then, shorter than what the sockets can hold at full rate.
    pub(super) const SHORTEST: Duration = Duration::from_millis(200);

    /// These triggers came while the process stood still, or just around it.
    pub(super) fn add(&mut self, triggers: Range<u64>) {
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
