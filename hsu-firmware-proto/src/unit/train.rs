// SPDX-License-Identifier: MIT OR Apache-2.0
//! One train of triggers: when the next one is due, and which number it has.

use crate::timing::{Sync, Timing};
use crate::unit_to_host::{EndReason, TriggerFlags, TriggerRecord};
use crate::{Arm, HISTORY};

/// What a train wants at a moment.
pub(super) enum Step {
    /// Nothing is due before the next event.
    Wait,
    /// This trigger must be fired now.
    Fire(TriggerRecord),
    /// The projectors' frame sync stays away.
    FrameSyncMissing {
        /// Since the last one, ns.
        since_ns: u64,
    },
    /// All triggers were fired, and their edges are out.
    Ended(EndReason),
}

/// Before these warm-up triggers the train pauses for half a period more: a rhythm that occurs once, so that hosts see
/// from the timestamps of a camera's frames which of them belongs to which trigger.
pub const PAUSE_BEFORE: [i64; 3] = [-6, -3, -2];

/// From the end of the last exposure to the next trigger after a delay, ns.
const SETTLE_NS: u64 = 2_000;

/// The state of a train while it runs.
#[derive(Debug, Clone, Copy)]
pub(super) struct Train {
    /// The number of the next trigger; negative during the warm-up.
    number: i64,
    /// One behind the last trigger; `None`: until stopped.
    end: Option<i64>,
    /// The next trigger is due then; with frame sync: not accepted before.
    due_ns: u64,
    /// When the last one was fired; before the first, when the train was started.
    since_ns: u64,
    fired_any: bool,
    stopping: bool,
    sync_missing: bool,
}

impl Train {
    pub(super) fn start(arm: &Arm, timing: &Timing, now_ns: u64) -> Self {
        // One period of notice, so that the acknowledgement leaves before the first edge.
        let due_ns = match timing.sync {
            Sync::Timer => now_ns.saturating_add(timing.period_ns),
            Sync::ProjectorFrame => now_ns,
        };
        Self {
            number: -i64::from(arm.warm_up),
            end: i64::try_from(arm.trigger_count).ok().filter(|&count| count > 0),
            due_ns,
            since_ns: now_ns,
            fired_any: false,
            stopping: false,
            sync_missing: false,
        }
    }

    /// Number of the next trigger.
    pub(super) fn number(&self) -> i64 {
        self.number
    }

    /// Whether it ends by itself.
    pub(super) fn is_counted(&self) -> bool {
        self.end.is_some()
    }

    /// Triggers fired so far, without those of the warm-up.
    pub(super) fn emitted(&self) -> u64 {
        u64::try_from(self.number).unwrap_or(0)
    }

    /// Ends after the current trigger.
    pub(super) fn stop(&mut self) {
        self.stopping = true;
    }

    fn is_over(&self) -> bool {
        self.stopping || self.end.is_some_and(|end| self.number >= end)
    }

    /// The edges of the last trigger are out by then.
    fn settled_ns(&self, timing: &Timing) -> u64 {
        if self.fired_any { self.since_ns.saturating_add(timing.window_ns()) } else { self.since_ns }
    }

    /// What the pause before the next trigger is longer than a period.
    fn pause_ns(&self, timing: &Timing) -> u64 {
        if self.fired_any && PAUSE_BEFORE.contains(&self.number) { timing.period_ns / 2 } else { 0 }
    }

    fn sync_deadline_ns(&self, timing: &Timing) -> u64 {
        // Frames of the projectors come a period apart: the pause lasts until the next of them.
        let pause_ns = self.pause_ns(timing) * 2;
        self.since_ns.saturating_add(timing.period_ns + timing.period_ns / 2 + pause_ns)
    }

    /// When [`Self::step`] has something to do; `None`: it waits for a frame sync.
    pub(super) fn next_due(&self, timing: &Timing) -> Option<u64> {
        match timing.sync {
            _ if self.is_over() => Some(self.settled_ns(timing)),
            Sync::Timer => Some(self.due_ns),
            Sync::ProjectorFrame => (!self.sync_missing).then(|| self.sync_deadline_ns(timing)),
        }
    }

    /// At most one trigger a call: a unit that was held up never fires two at once.
    pub(super) fn step(&mut self, now_ns: u64, timing: &Timing) -> Step {
        if self.is_over() {
            let reason = if self.stopping { EndReason::Stopped } else { EndReason::Completed };
            return if now_ns >= self.settled_ns(timing) { Step::Ended(reason) } else { Step::Wait };
        }
        match timing.sync {
            Sync::Timer if now_ns >= self.due_ns => Step::Fire(self.fire(now_ns, timing)),
            Sync::ProjectorFrame if !self.sync_missing && now_ns > self.sync_deadline_ns(timing) => {
                self.sync_missing = true;
                Step::FrameSyncMissing { since_ns: now_ns - self.since_ns }
            }
            _ => Step::Wait,
        }
    }

    /// A frame sync of the projectors; `None` if it does not fire (train over, or too soon after the last).
    pub(super) fn frame_sync(&mut self, now_ns: u64, timing: &Timing) -> Option<TriggerRecord> {
        let wanted = timing.sync == Sync::ProjectorFrame && !self.is_over() && now_ns >= self.due_ns;
        wanted.then(|| self.fire(now_ns, timing))
    }

    fn fire(&mut self, now_ns: u64, timing: &Timing) -> TriggerRecord {
        let period_ns = timing.period_ns;
        let late = match timing.sync {
            Sync::Timer => now_ns.saturating_sub(self.due_ns) > period_ns / 16,
            Sync::ProjectorFrame => {
                let due_ns = period_ns + self.pause_ns(timing) * 2;
                self.fired_any && now_ns.saturating_sub(self.since_ns) > due_ns + period_ns / 16
            }
        };
        let flags = TriggerFlags::default()
            .with_if(TriggerFlags::WARM_UP, self.number < 0)
            .with_if(TriggerFlags::LAST, self.end == self.number.checked_add(1))
            .with_if(TriggerFlags::LATE, late);
        let record = TriggerRecord { number: self.number, time_ns: now_ns, flags };
        // After a delay the schedule moves: no trigger is dropped, and none comes closer to the one before
        // than 7/8 of a period, which a camera could not follow.
        let earliest = now_ns.saturating_add(period_ns - period_ns / 8);
        let due_ns = match timing.sync {
            Sync::Timer => {
                // Nor into the exposures of the one before.
                let exposed_ns = (timing.window_ns() + SETTLE_NS).min(period_ns);
                earliest.max(now_ns.saturating_add(exposed_ns)).max(self.due_ns.saturating_add(period_ns))
            }
            Sync::ProjectorFrame => earliest,
        };
        self.number = self.number.saturating_add(1);
        self.since_ns = now_ns;
        self.fired_any = true;
        self.due_ns = due_ns.saturating_add(self.pause_ns(timing));
        self.sync_missing = false;
        record
    }
}

/// The last [`HISTORY`] triggers of one session.
#[derive(Debug, Clone)]
pub(super) struct History {
    records: [TriggerRecord; HISTORY],
    first: i64,
    next: i64,
}

impl History {
    pub(super) const fn new() -> Self {
        let empty = TriggerRecord { number: 0, time_ns: 0, flags: TriggerFlags(0) };
        Self { records: [empty; HISTORY], first: 0, next: 0 }
    }

    /// Forgets everything; the next trigger has this number.
    pub(super) fn restart(&mut self, number: i64) {
        (self.first, self.next) = (number, number);
    }

    fn place(number: i64) -> usize {
        number.rem_euclid(HISTORY as i64) as usize
    }

    pub(super) fn push(&mut self, record: TriggerRecord) {
        self.records[Self::place(record.number)] = record;
        self.next = record.number.saturating_add(1);
        self.first = self.first.max(self.next.saturating_sub(HISTORY as i64));
    }

    /// What is left of `count` triggers from `first` on.
    pub(super) fn query(&self, first: i64, count: u16) -> impl Iterator<Item = TriggerRecord> + '_ {
        let end = first.saturating_add(i64::from(count)).min(self.next);
        (first.max(self.first)..end).map(|number| self.records[Self::place(number)])
    }
}
