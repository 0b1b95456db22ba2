// SPDX-License-Identifier: MIT OR Apache-2.0
//! Triggers whose reports are held up, inferred where cameras agree on them.

use super::{Accounting, sighting};
use crate::matcher::Sighting;

impl Accounting {
    /// Infers a trigger whose report is held up, where cameras agree on its number and its time. A camera that
    /// ignored triggers, or whose clock was set, is alone with its claim. Two may have ignored equally many triggers:
    /// so for each camera that contradicts, more than two must agree; and where frames of others may still come
    /// (`early`), all other cameras must have sent a frame of this time or later.
    pub(super) fn infer_trigger(&mut self, camera: usize, seen: &Sighting, early: bool) {
        let Some((number, hsu_ns)) = self.lanes[camera].matcher.claim(seen) else { return };
        if self.table.has_report(number) || self.table.is_agreed(number) {
            return;
        }
        let period_ns = i128::from(self.options.period_ns);
        let tolerance_ns = period_ns / 8;
        // A train is never faster than its period: a number that comes too early for its count is too high.
        let ahead = i128::from(number - self.table.end() + 1);
        let earliest = |latest: u64| i128::from(latest) + ahead * period_ns - period_ns / 4;
        if ahead > 0 && self.table.latest_ns().is_some_and(|latest| hsu_ns < earliest(latest)) {
            return;
        }
        let (mut agree, mut contradict) = (1, 0);
        for (other, lane) in self.lanes.iter().enumerate() {
            if other == camera || lane.lost || !lane.matcher.is_placed() {
                continue;
            }
            let (mut agrees, mut contradicts, mut has_come) = (false, false, false);
            let claims =
                lane.pending.iter().filter_map(|other| lane.matcher.claim(&sighting(&other.arrival)));
            for (other, other_ns) in claims {
                let (same, near) = (other == number, (other_ns - hsu_ns).abs() <= tolerance_ns);
                agrees |= same && near;
                contradicts |= same != near;
                has_come |= other_ns >= hsu_ns - tolerance_ns;
            }
            if early && !has_come {
                return;
            }
            agree += usize::from(agrees);
            contradict += usize::from(contradicts && !agrees);
        }
        if let Some(hsu_ns) = u64::try_from(hsu_ns).ok().filter(|_| agree >= 2 && agree > 2 * contradict) {
            self.table.infer(number, hsu_ns);
        }
    }
}
