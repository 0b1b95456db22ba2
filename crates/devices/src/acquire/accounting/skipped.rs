// SPDX-License-Identifier: MIT OR Apache-2.0
//! Causes of the triggers before a frame that have no frame: lost, ignored, or given up.

use super::Lane;
use crate::record::GapCause;
use std::ops::Range;

impl Lane {
    /// Causes of the triggers before a frame that have no frame: frames that came and were given up, `ignored`
    /// triggers, and `cause` for the rest. A frame that was given up belongs to the trigger of its block id or, where
    /// the frame now shows that triggers were ignored, to the trigger of its clock.
    pub(super) fn skipped(&mut self, triggers: Range<u64>, cause: GapCause, ignored: u64) -> Vec<GapCause> {
        let given_up = std::mem::take(&mut self.given_up_now) as usize;
        let shown: Vec<(u64, Option<u64>)> = self.given_up_at.drain(..).collect();
        let disputed = ignored > 0 && shown.iter().any(|(id, clock)| clock.is_some_and(|clock| clock > *id));
        let mut causes = vec![cause; triggers.end.saturating_sub(triggers.start) as usize];
        let mut placed = 0;
        for (id, clock) in shown {
            let trigger = clock.filter(|_| ignored > 0).unwrap_or(id);
            let place = trigger.checked_sub(triggers.start).and_then(|place| causes.get_mut(place as usize));
            if let Some(place) = place.filter(|place| **place != GapCause::IdentityMismatch) {
                *place = GapCause::IdentityMismatch;
                placed += 1;
            }
        }
        let free = |causes: &[GapCause]| -> Vec<usize> {
            (0..causes.len()).filter(|place| causes[*place] != GapCause::IdentityMismatch).collect()
        };
        // The order of lost and ignored triggers is not known: lost ones are placed first. A camera that woke late
        // ignored its first triggers, and so did one whose frames were given up because it ignored some.
        let came = given_up.saturating_sub(placed);
        let mut open = free(&causes);
        // A trigger whose frame came was not ignored.
        let ignored = (ignored as usize).min(open.len().saturating_sub(came));
        if triggers.start > 0 && !disputed {
            open.reverse();
        }
        open.into_iter().take(ignored).for_each(|place| causes[place] = GapCause::NotTriggered);
        // The triggers of the other given-up frames are not known: the last open ones are taken.
        let lost = free(&causes).into_iter().rev().filter(|place| causes[*place] == cause);
        let others: Vec<usize> = lost.take(came).collect();
        others.into_iter().for_each(|place| causes[place] = GapCause::IdentityMismatch);
        causes
    }
}

#[cfg(test)]
mod tests {
    use super::super::LaneSetup;
    use super::{GapCause, Lane};
    use crate::base::ids::CameraId;
    use crate::matcher::{Matcher, Start};

    /// A camera slept until trigger 1, and two frames of it were given up before its place was known.
    #[test]
    fn a_frame_that_came_and_was_given_up_is_of_no_trigger_that_was_ignored() {
        let matcher = Matcher::new(Start { period_ns: 8_333_333, warm_up: 8, hsu_minus_host_ns: None });
        let setup = LaneSetup { id: CameraId("c0".to_owned()), width: 16, height: 1, matcher };
        let mut lane = Lane::new(setup);
        lane.given_up_now = 2;
        let causes = lane.skipped(0..3, GapCause::MissingPackets, 3);
        assert_eq!(causes, [GapCause::NotTriggered, GapCause::IdentityMismatch, GapCause::IdentityMismatch]);
    }
}
