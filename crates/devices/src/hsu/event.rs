// SPDX-License-Identifier: MIT OR Apache-2.0
//! Events that the unit and the link report, and the bounded stream that carries them.

use super::order::Order;
use crossbeam_channel::{Receiver, Sender, TrySendError, bounded};
use hsu_firmware_proto::{EndReason, Fault, SessionId, Status, TriggerRecord, UnitToHost};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

/// Room for events, over a minute of triggers at 120 Hz; when full, the oldest event is discarded.
const EVENTS: usize = 8192;

/// An event that the unit, or the link to it, reports unasked.
#[derive(Debug, Clone, PartialEq)]
pub enum HsuEvent {
    /// The unit's status: four times a second and at every change of state.
    Heartbeat(Status),
    /// A trigger was fired. Within a session their numbers have no gap and no repetition; warm-up triggers have
    /// negative numbers. Times are of the HSU's clock, ns.
    Trigger { session: SessionId, trigger: TriggerRecord },
    /// Triggers, from number `first` on, that were fired but whose times are lost for good.
    TriggersMissing { session: SessionId, first: i64, count: u64 },
    /// The train has ended, for this reason; comes once, behind its last trigger. `emitted`: triggers without warm-up.
    Done { session: SessionId, emitted: u64, reason: EndReason },
    /// The unit found something wrong in its current session.
    Fault { session: SessionId, fault: Fault },
    /// The unit does not answer any more.
    LinkLost(LinkLoss),
    /// The unit answers again, after [`LinkLoss::Silent`].
    LinkBack,
}

/// The way in which a link was lost.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum LinkLoss {
    /// The unit does not answer; the link comes back by itself if it does.
    Silent,
    /// The unit was restarted and has forgotten everything: connect again.
    Restarted,
    /// The device is gone: connect again.
    Broken(String),
}

/// The stream of events to the consumer, in order.
#[derive(Debug)]
pub(super) struct Feed {
    order: Mutex<Order>,
    sender: Sender<HsuEvent>,
    /// The consumer's end, here also to discard the oldest event.
    pub(super) receiver: Receiver<HsuEvent>,
    /// Events that were discarded because the channel was full.
    pub(super) dropped: AtomicU64,
}

impl Feed {
    pub(super) fn new() -> Self {
        let (sender, receiver) = bounded(EVENTS);
        Self { order: Mutex::default(), sender, receiver, dropped: AtomicU64::new(0) }
    }

    /// Begins a session that is being armed; see [`Order::begin`].
    pub(super) fn begin(&self, session: SessionId, first: i64) {
        self.order().begin(session, first, &mut |event| self.emit(event));
    }

    pub(super) fn order(&self) -> MutexGuard<'_, Order> {
        self.order.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Sends an event without blocking the reading thread: when full, the oldest event is discarded and counted.
    pub(super) fn emit(&self, mut event: HsuEvent) {
        while let Err(TrySendError::Full(back)) = self.sender.try_send(event) {
            event = back;
            if self.receiver.try_recv().is_ok() {
                self.dropped.fetch_add(1, Ordering::Relaxed);
            }
        }
    }

    /// Takes a message that is no answer. `true`: there is a hole whose triggers must be requested again.
    pub(super) fn take(&self, message: UnitToHost) -> bool {
        let event = match message {
            UnitToHost::Heartbeat(status) => HsuEvent::Heartbeat(status),
            UnitToHost::Trigger(session, trigger) => HsuEvent::Trigger { session, trigger },
            UnitToHost::Done { session, emitted, reason } => HsuEvent::Done { session, emitted, reason },
            UnitToHost::Fault(session, fault) => HsuEvent::Fault { session, fault },
            _ => return false,
        };
        let mut order = self.order();
        order.push(event, &mut |event| self.emit(event));
        order.hole().is_some()
    }
}
