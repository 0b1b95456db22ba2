// SPDX-License-Identifier: MIT OR Apache-2.0
//! Puts trigger telemetry back into a gapless sequence.
//!
//! Telemetry is not acknowledged, so a disturbed frame leaves a hole in the trigger numbers. [`Order`] holds back the
//! events behind a hole until the triggers in it have been requested again, so that a consumer sees every trigger once,
//! in order, and the end of the train last. It does no I/O: the caller sends the request and calls [`Order::fill`].

use super::event::HsuEvent;
use hsu_firmware_proto::{EndReason, HISTORY, SessionId, State, Status, TriggerRecord};
use std::collections::VecDeque;

/// Most events behind a hole, half a minute at 120 Hz; beyond this the hole is given up.
const MAX_HELD: usize = 4096;

/// Triggers that were fired, but whose telemetry was lost.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Hole {
    pub(super) session: SessionId,
    /// Number of the first missing trigger.
    pub(super) first: i64,
    /// Number behind the last missing trigger.
    pub(super) end: i64,
}

impl Hole {
    /// The part that the unit can still have: first number and count.
    pub(super) fn still_known(&self) -> (i64, u32) {
        let first = self.first.max(self.end.saturating_sub(HISTORY as i64));
        (first, u32::try_from(self.end.saturating_sub(first)).unwrap_or(0))
    }
}

/// The sequence of one session at a time.
#[derive(Debug, Default)]
pub(super) struct Order {
    session: SessionId,
    next: i64,
    /// Whether a trigger of the session has been received.
    started: bool,
    done: bool,
    hole: Option<Hole>,
    held: VecDeque<HsuEvent>,
}

impl Order {
    /// Begins a session that is being armed, with the number of its first trigger. A session that has fired goes on,
    /// because the unit refuses to arm it again.
    pub(super) fn begin(&mut self, session: SessionId, first: i64, emit: &mut impl FnMut(HsuEvent)) {
        if self.session == session && self.started {
            return;
        }
        self.give_up(emit);
        *self = Self { session, next: first, ..Self::default() };
    }

    /// The hole that must be filled before more events can pass.
    pub(super) fn hole(&self) -> Option<Hole> {
        self.hole
    }

    /// Takes an event from the line, and passes on what is in order.
    pub(super) fn push(&mut self, event: HsuEvent, emit: &mut impl FnMut(HsuEvent)) {
        match &event {
            HsuEvent::Trigger { session, trigger } if *session != self.session => {
                // A train that another process armed: it begins with this trigger for this process.
                self.begin(*session, trigger.number, emit);
                self.push(event, emit);
            }
            HsuEvent::Trigger { .. } | HsuEvent::Done { .. } if self.hole.is_some() => {
                self.held.push_back(event);
                if self.held.len() >= MAX_HELD {
                    self.give_up(emit);
                }
            }
            HsuEvent::Trigger { trigger, .. } => {
                let number = trigger.number;
                self.started = true;
                if number > self.next {
                    self.open_hole(number);
                    self.held.push_back(event);
                } else if number == self.next {
                    self.next = number.saturating_add(1);
                    emit(event);
                }
            }
            HsuEvent::Done { session, .. } if *session != self.session => emit(event),
            HsuEvent::Done { .. } if self.done => {}
            HsuEvent::Done { emitted, .. } => {
                let end = i64::try_from(*emitted).unwrap_or(i64::MAX);
                if end > 0 && self.next < end {
                    self.open_hole(end);
                    self.held.push_back(event);
                } else {
                    self.done = true;
                    emit(event);
                }
            }
            HsuEvent::Heartbeat(status) => {
                let status = *status;
                emit(event);
                self.check_against(&status, emit);
            }
            _ => emit(event),
        }
    }

    /// Compares a status with the telemetry before it: what is missing then was lost.
    fn check_against(&mut self, status: &Status, emit: &mut impl FnMut(HsuEvent)) {
        if status.session != self.session || self.hole.is_some() || self.done {
            return;
        }
        let fired = matches!(status.state, State::Running | State::Finished);
        if fired && status.next_number > self.next {
            self.open_hole(status.next_number);
        }
        if status.state == State::Finished && status.end != EndReason::None {
            let (session, emitted, reason) = (status.session, status.emitted, status.end);
            self.push(HsuEvent::Done { session, emitted, reason }, emit);
        }
    }

    fn open_hole(&mut self, end: i64) {
        self.hole = Some(Hole { session: self.session, first: self.next, end });
    }

    /// Closes the hole with what the unit still had of it, in any portions, in order.
    pub(super) fn fill(&mut self, records: &[TriggerRecord], emit: &mut impl FnMut(HsuEvent)) {
        let Some(Hole { session, end, .. }) = self.hole.take() else { return };
        for &trigger in records.iter().filter(|record| record.number < end) {
            self.skip_to(trigger.number, session, emit);
            if trigger.number == self.next {
                self.next = trigger.number.saturating_add(1);
                emit(HsuEvent::Trigger { session, trigger });
            }
        }
        self.skip_to(end, session, emit);
        for event in std::mem::take(&mut self.held) {
            self.push(event, emit);
        }
    }

    /// Reports the triggers of the hole as missing.
    fn give_up(&mut self, emit: &mut impl FnMut(HsuEvent)) {
        while self.hole.is_some() {
            self.fill(&[], emit);
        }
    }

    fn skip_to(&mut self, number: i64, session: SessionId, emit: &mut impl FnMut(HsuEvent)) {
        if let Some(count) = number.checked_sub(self.next).and_then(|n| u64::try_from(n).ok())
            && count > 0
        {
            emit(HsuEvent::TriggersMissing { session, first: self.next, count });
            self.next = number;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::Order;
    use crate::hsu::event::HsuEvent;
    use hsu_firmware_proto::{EndReason, SessionId, State, Status, TriggerFlags, TriggerRecord};
    use proptest::prelude::{any, prop, prop_assert_eq, proptest};

    const SESSION: SessionId = SessionId([7; 16]);

    fn record(number: i64) -> TriggerRecord {
        let time_ns = (number + 100) as u64;
        TriggerRecord { number, time_ns, flags: TriggerFlags::default() }
    }

    fn all_numbers(events: &[HsuEvent]) -> Vec<i64> {
        let mut numbers = Vec::new();
        for event in events {
            match event {
                HsuEvent::Trigger { trigger, .. } => numbers.push(trigger.number),
                HsuEvent::TriggersMissing { first, count, .. } => {
                    numbers.extend(*first..*first + *count as i64)
                }
                _ => {}
            }
        }
        numbers
    }

    proptest! {
        /// Whatever the line loses, and whatever the unit has forgotten when triggers are requested again: each
        /// trigger is accounted for once, in order, and the end comes last.
        #[test]
        fn every_trigger_is_accounted_for_once_in_order(
            lost in prop::collection::vec(any::<bool>(), 40),
            forgotten in prop::collection::vec(any::<bool>(), 40),
            done_lost in any::<bool>(),
            fill_after in 1usize..10,
        ) {
            let (first, end) = (-5i64, 35i64);
            let mut order = Order::default();
            order.begin(SESSION, first, &mut |_| {});
            let mut events = Vec::new();
            let place = |number: i64| (number - first) as usize;
            let fill = |order: &mut Order, events: &mut Vec<HsuEvent>| {
                while let Some(hole) = order.hole() {
                    let known: Vec<_> =
                        (hole.first..hole.end).filter(|&n| !forgotten[place(n)]).map(record).collect();
                    order.fill(&known, &mut |event| events.push(event));
                }
            };
            for number in (first..end).filter(|&n| !lost[place(n)]) {
                let event = HsuEvent::Trigger { session: SESSION, trigger: record(number) };
                order.push(event, &mut |event| events.push(event));
                if number % fill_after as i64 == 0 {
                    fill(&mut order, &mut events);
                }
            }
            let done = HsuEvent::Done { session: SESSION, emitted: end as u64, reason: EndReason::Completed };
            if !done_lost {
                order.push(done, &mut |event| events.push(event));
                fill(&mut order, &mut events);
            }
            let status = Status {
                state: State::Finished, session: SESSION, next_number: end, emitted: end as u64,
                end: EndReason::Completed, ..Status::default()
            };
            // Heartbeats go on for ever; a few of them settle everything.
            for _ in 0..3 {
                order.push(HsuEvent::Heartbeat(status), &mut |event| events.push(event));
                fill(&mut order, &mut events);
            }
            prop_assert_eq!(all_numbers(&events), (first..end).collect::<Vec<_>>());
            events.retain(|event| !matches!(event, HsuEvent::Heartbeat(_)));
            let dones = events.iter().filter(|event| matches!(event, HsuEvent::Done { .. })).count();
            prop_assert_eq!(dones, 1);
            prop_assert_eq!(matches!(events.last(), Some(HsuEvent::Done { .. })), true);
        }
    }
}
