// SPDX-License-Identifier: MIT OR Apache-2.0
//! The conversation with the unit: requests with checked answers, and the keeper thread, which sends heartbeats and
//! requests lost telemetry.

use super::error::HsuError;
use super::event::{Feed, HsuEvent, LinkLoss};
use super::link::{HsuTimeouts, Link, Patience};
use crossbeam_channel::{Receiver, RecvTimeoutError};
use hsu_firmware_proto::{
    Hello, MAX_RECORDS, Refusal, Request, SessionId, TriggerRecord, UnitToHost, Welcome, version,
};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// Product name of the unit that takes the HSU's place where action commands are the triggers.
pub(super) const ACTION_PRODUCT: &str = "fourdbody-action";
/// The product names of an HSU of this project, and of the unit in its place.
const PRODUCTS: [&str; 2] = ["fourdbody-hsu", ACTION_PRODUCT];

/// The link and the event stream, shared by the commands and the keeper thread.
#[derive(Debug)]
pub(super) struct Conversation {
    pub(super) link: Link,
    pub(super) timeouts: HsuTimeouts,
    pub(super) feed: Arc<Feed>,
    /// Set when the keeper thread is to end.
    pub(super) stop: AtomicBool,
}

impl Conversation {
    /// Sends a request; `what` names it in errors.
    pub(super) fn ask(&self, what: &'static str, request: Request) -> Result<UnitToHost, HsuError> {
        Ok(self.link.ask(what, request, self.timeouts.patience)?.message)
    }

    /// Sends the greeting, and checks that the unit is an HSU with a common protocol version.
    pub(super) fn greet(&self, hello: Hello) -> Result<Welcome, HsuError> {
        const WHAT: &str = "the greeting";
        let device = self.link.device();
        let other_version = |min: u8, current: u8| {
            HsuError::Unfit(format!(
                "the HSU on {device} speaks protocol versions {min} to {current}, this program {} to {}: update the \
                 older of the two",
                version::MIN,
                version::CURRENT
            ))
        };
        let welcome = match self.ask(WHAT, Request::Hello(hello)) {
            Ok(UnitToHost::Welcome(_, welcome)) => welcome,
            Ok(other) => return Err(HsuError::unexpected(WHAT, "its identity", &other)),
            Err(HsuError::Refused { refusal: Refusal::Version { min, current }, .. }) => {
                return Err(other_version(min, current));
            }
            Err(error) => return Err(error),
        };
        let product = welcome.identity.name.as_str();
        if !PRODUCTS.contains(&product) {
            return Err(HsuError::Unfit(format!(
                "{device} is a {product:?}, expected a \"fourdbody-hsu\": check the device in the node file"
            )));
        }
        if !(version::MIN..=version::CURRENT).contains(&welcome.agreed) {
            return Err(other_version(welcome.min, welcome.current));
        }
        Ok(welcome)
    }

    /// Requests past triggers: those of `count` from `first` on that the unit still has.
    pub(super) fn query_triggers(
        &self,
        session: SessionId,
        first: i64,
        count: u32,
    ) -> Result<Vec<TriggerRecord>, HsuError> {
        const WHAT: &str = "the request for past triggers";
        let end = first.saturating_add(i64::from(count));
        let mut next = first;
        let mut found = Vec::new();
        while next < end {
            let count = (end - next).min(MAX_RECORDS as i64) as u16;
            let records = match self.ask(WHAT, Request::QueryTriggers { session, first: next, count })? {
                UnitToHost::Triggers(_, of, records) if of == session => records,
                other => return Err(HsuError::unexpected(WHAT, "triggers", &other)),
            };
            // An empty portion was forgotten, or is not fired yet. The unit may still have later ones.
            found.extend(records.as_slice().iter().filter(|r| (next..end).contains(&r.number)));
            next += i64::from(count);
        }
        Ok(found)
    }

    /// Runs the keeper thread: heartbeats, and requests for lost telemetry.
    pub(super) fn keep(&self, woken: &Receiver<()>) {
        let mut next_beat = Instant::now();
        let mut lost = false;
        while !self.stop.load(Ordering::Relaxed) {
            match woken.recv_deadline(next_beat) {
                Ok(()) => self.fill_holes(),
                Err(RecvTimeoutError::Timeout) => {
                    next_beat = Instant::now() + self.timeouts.heartbeat;
                    if !self.show_life(&mut lost) {
                        return;
                    }
                }
                Err(RecvTimeoutError::Disconnected) => return,
            }
        }
    }

    /// Sends a heartbeat, and reports a loss of the link. `false`: the link cannot come back.
    fn show_life(&self, lost: &mut bool) -> bool {
        let Patience { answer, attempts } = self.timeouts.patience;
        let loss = match self.link.ask_if_idle("the heartbeat", Request::Heartbeat, self.timeouts.patience) {
            // For the unit, any other request is a sign of life. For this host only answers are: one request after
            // the other must not hide that none is answered.
            None if self.link.unanswered_for() < answer * attempts => return true,
            None | Some(Err(HsuError::NoAnswer { .. })) => LinkLoss::Silent,
            Some(Err(HsuError::Refused { refusal: Refusal::HelloFirst, .. })) => LinkLoss::Restarted,
            Some(Err(HsuError::Io { cause, .. })) => LinkLoss::Broken(cause),
            Some(_) => {
                if std::mem::take(lost) {
                    self.feed.emit(HsuEvent::LinkBack);
                }
                return true;
            }
        };
        let goes_on = loss == LinkLoss::Silent;
        if !(*lost && goes_on) {
            tracing::warn!(device = self.link.device(), ?loss, "lost the link to the HSU");
            self.feed.emit(HsuEvent::LinkLost(loss));
        }
        *lost = true;
        goes_on
    }

    fn fill_holes(&self) {
        while !self.stop.load(Ordering::Relaxed) {
            let Some(hole) = self.feed.order().hole() else { return };
            let (first, count) = hole.still_known();
            let records = self.query_triggers(hole.session, first, count).unwrap_or_else(|error| {
                tracing::warn!(device = self.link.device(), first, count, %error, "lost trigger telemetry for good");
                Vec::new()
            });
            let mut order = self.feed.order();
            // The hole may have been given up in the meantime.
            if order.hole() == Some(hole) {
                order.fill(&records, &mut |event| self.feed.emit(event));
            }
        }
    }
}
