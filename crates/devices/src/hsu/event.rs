// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the unit and the link report by themselves, and the bounded stream that it goes into.

use super::order::Order;
use super::timing::trigger_index;
use crate::base::ids::TriggerIndex;
use crossbeam_channel::{Receiver, Sender, TrySendError, bounded};
use hsu_firmware_proto::{EndReason, Fault, SessionId, Status, TriggerRecord, UnitToHost};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

/// Events that nobody has taken yet: over a minute of triggers at 120 Hz. Then the oldest gives way.
const EVENTS: usize = 8192;

/// Something the unit, or the link, reports by itself.
#[derive(Debug, Clone, PartialEq)]
pub enum HsuEvent {
    /// The unit's status: four times a second and at every change of state.
    Heartbeat(Status),
    /// A trigger was fired. Within a session their numbers have no gap and no repetition.
    Trigger {
        /// The session.
        session: SessionId,
        /// Number (negative: warm-up), time on the HSU's clock in ns, flags.
        trigger: TriggerRecord,
    },
    /// Triggers that were fired, but whose times are lost for good.
    TriggersMissing {
        /// The session.
        session: SessionId,
        /// Number of the first.
        first: i64,
        /// How many.
        count: u64,
    },
    /// The train has ended; comes once, behind its last trigger.
    Done {
        /// The session.
        session: SessionId,
        /// Triggers fired, without warm-up.
        emitted: u64,
        /// Why it ended.
        reason: EndReason,
    },
    /// The unit found something wrong.
    Fault {
        /// The session that it is at.
        session: SessionId,
        /// What.
        fault: Fault,
    },
    /// The unit cannot be talked to.
    LinkLost(LinkLoss),
    /// It can again, after [`LinkLoss::Silent`].
    LinkBack,
}

impl HsuEvent {
    /// The trigger index, if the event is a trigger of the train itself.
    pub fn index(&self) -> Option<TriggerIndex> {
        match self {
            Self::Trigger { trigger, .. } => trigger_index(trigger),
            _ => None,
        }
    }
}

/// How a link was lost.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum LinkLoss {
    /// The unit does not answer; the link comes back by itself if it does.
    Silent,
    /// The unit was restarted and has forgotten everything: connect again.
    Restarted,
    /// The device is gone: connect again.
    Broken(String),
}

/// Where events go, in order.
#[derive(Debug)]
pub(super) struct Feed {
    order: Mutex<Order>,
    sender: Sender<HsuEvent>,
    /// The consumer's end, to make room.
    receiver: Receiver<HsuEvent>,
    dropped: AtomicU64,
}

impl Feed {
    pub(super) fn new() -> Self {
        let (sender, receiver) = bounded(EVENTS);
        Self { order: Mutex::default(), sender, receiver, dropped: AtomicU64::new(0) }
    }

    /// The consumer's end.
    pub(super) fn events(&self) -> &Receiver<HsuEvent> {
        &self.receiver
    }

    /// Events that gave way because nobody took them.
    pub(super) fn dropped(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }

    /// A session is being armed; see [`Order::begin`].
    pub(super) fn begin(&self, session: SessionId, first: i64) {
        self.order().begin(session, first, &mut |event| self.emit(event));
    }

    pub(super) fn order(&self) -> MutexGuard<'_, Order> {
        self.order.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Bounded, and never blocks the reading thread: when full, the oldest event gives way and is counted.
    pub(super) fn emit(&self, mut event: HsuEvent) {
        while let Err(TrySendError::Full(back)) = self.sender.try_send(event) {
            event = back;
            if self.receiver.try_recv().is_ok() {
                self.dropped.fetch_add(1, Ordering::Relaxed);
            }
        }
    }

    /// Takes a message that is no answer; says whether there is a hole to be asked about.
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
