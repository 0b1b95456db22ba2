// SPDX-License-Identifier: MIT OR Apache-2.0
//! What is known when a frame is judged: the frames behind it, the train so far, the clocks.

use super::sighting::Sighting;
use super::trigger_table::Schedule;
use crate::base::clock_fit::ClockFit;

/// A frame, and all there is to judge it by.
#[derive(Clone, Copy)]
pub(super) struct Case<'a> {
    pub(super) frame: &'a Sighting,
    /// Whole frames that have arrived behind it, in order.
    pub(super) followers: &'a [Sighting],
    /// The trigger that its id points at.
    pub(super) by_id: i64,
    pub(super) table: Schedule<'a>,
    /// The HSU's clock against the host's.
    pub(super) hsu: &'a ClockFit,
    /// Whether there must be an answer.
    pub(super) last_call: bool,
}

impl Case<'_> {
    /// Whether a frame's report may be held up: by its id it is of a trigger behind the last that was reported, and
    /// that may have been fired when it arrived.
    pub(super) fn awaits_report(&self, arrived: Option<i128>, period_ns: u64) -> bool {
        let reported = |number| Some((number, self.table.reported_ns(number)?));
        let Some((last, last_ns)) = (0..self.table.end()).rev().take(64).find_map(reported) else {
            return true;
        };
        let steps = i128::from(self.by_id.saturating_sub(last));
        let period_ns = i128::from(period_ns);
        let due = i128::from(last_ns) + steps.saturating_mul(period_ns * 7 / 8) - period_ns / 8;
        steps > 0 && arrived.is_none_or(|ns| ns >= due)
    }
}
