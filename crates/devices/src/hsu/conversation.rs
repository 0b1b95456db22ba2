// SPDX-License-Identifier: MIT OR Apache-2.0
//! The conversation with the unit: questions and their answers as errors know them, and the keeper thread
//! that shows signs of life and asks for lost telemetry.

use super::error::HsuError;
use super::event::{Feed, HsuEvent, LinkLoss};
use super::link::{Answer, Link, LinkError, Patience};
use super::unit::HsuTimeouts;
use crossbeam_channel::{Receiver, RecvTimeoutError};
use hsu_firmware_proto::{
    Hello, MAX_RECORDS, Refusal, Request, SessionId, TriggerRecord, UnitToHost, Welcome, version,
};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// The product names that an HSU of this project gives, and what plays its part.
const PRODUCTS: [&str; 2] = ["fourdbody-hsu", super::action::PRODUCT];

/// What commands and the keeper thread share.
#[derive(Debug)]
pub(super) struct Conversation {
    device: String,
    link: Link,
    timeouts: HsuTimeouts,
    feed: Arc<Feed>,
    stop: AtomicBool,
}

impl Conversation {
    pub(super) fn new(device: String, link: Link, timeouts: HsuTimeouts, feed: Arc<Feed>) -> Self {
        Self { device, link, timeouts, feed, stop: AtomicBool::new(false) }
    }

    pub(super) fn feed(&self) -> &Feed {
        &self.feed
    }

    pub(super) fn link(&self) -> &Link {
        &self.link
    }

    pub(super) fn timeouts(&self) -> &HsuTimeouts {
        &self.timeouts
    }

    /// The keeper ends when it next wakes.
    pub(super) fn stop(&self) {
        self.stop.store(true, Ordering::Relaxed);
    }

    pub(super) fn ask(&self, what: &'static str, request: Request) -> Result<Answer, HsuError> {
        self.ask_with(what, request, self.timeouts.patience)
    }

    pub(super) fn ask_with(
        &self,
        what: &'static str,
        request: Request,
        patience: Patience,
    ) -> Result<Answer, HsuError> {
        match self.link.ask(request, patience) {
            Ok(Answer { message: UnitToHost::Refused(_, refusal), .. }) => {
                Err(HsuError::Refused { request: what, refusal })
            }
            Ok(answer) => Ok(answer),
            Err(LinkError::NoAnswer { attempts, waited }) => {
                Err(HsuError::NoAnswer { device: self.device.clone(), request: what, attempts, waited })
            }
            Err(LinkError::Broken(cause)) => Err(HsuError::Io { device: self.device.clone(), cause }),
        }
    }

    pub(super) fn greet(&self, hello: Hello) -> Result<Welcome, HsuError> {
        const WHAT: &str = "the greeting";
        let welcome = match self.ask(WHAT, Request::Hello(hello)) {
            Ok(Answer { message: UnitToHost::Welcome(_, welcome), .. }) => welcome,
            Ok(other) => return Err(unexpected(WHAT, "its identity", &other.message)),
            Err(HsuError::Refused { refusal: Refusal::Version { min, current }, .. }) => {
                return Err(HsuError::WrongVersion {
                    device: self.device.clone(),
                    unit_min: min,
                    unit_current: current,
                });
            }
            Err(error) => return Err(error),
        };
        if !PRODUCTS.contains(&welcome.identity.name.as_str()) {
            let found = welcome.identity.name.as_str().to_owned();
            return Err(HsuError::WrongDevice { device: self.device.clone(), found });
        }
        if !(version::MIN..=version::CURRENT).contains(&welcome.agreed) {
            return Err(HsuError::WrongVersion {
                device: self.device.clone(),
                unit_min: welcome.min,
                unit_current: welcome.current,
            });
        }
        Ok(welcome)
    }

    pub(super) fn query_triggers(
        &self,
        session: SessionId,
        first: i64,
        count: u32,
    ) -> Result<Vec<TriggerRecord>, HsuError> {
        const WHAT: &str = "a question for past triggers";
        let end = first.saturating_add(i64::from(count));
        let mut next = first;
        let mut found = Vec::new();
        while next < end {
            let count = (end - next).min(MAX_RECORDS as i64) as u16;
            let records =
                match self.ask(WHAT, Request::QueryTriggers { session, first: next, count })?.message {
                    UnitToHost::Triggers(_, of, records) if of == session => records,
                    other => return Err(unexpected(WHAT, "triggers", &other)),
                };
            // An empty portion: forgotten, or not fired yet. The rest may still be there.
            found.extend(records.as_slice().iter().filter(|r| (next..end).contains(&r.number)));
            next += i64::from(count);
        }
        Ok(found)
    }

    /// The keeper thread: signs of life, and questions for lost telemetry.
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

    /// `false`: the conversation is over for good.
    fn show_life(&self, lost: &mut bool) -> bool {
        let Patience { answer, attempts } = self.timeouts.patience;
        let waited = self.link.quiet_for();
        let result = match self.link.ask_if_idle(Request::Heartbeat, self.timeouts.patience) {
            Some(result) => result,
            // Another request under way is a sign of life itself, for the unit. For us only what comes back is: those
            // who ask one question after the other must not hide that none is answered.
            None if waited < answer * attempts => return true,
            None => Err(LinkError::NoAnswer { attempts, waited }),
        };
        let loss = match result {
            Ok(Answer { message: UnitToHost::Refused(_, Refusal::HelloFirst), .. }) => LinkLoss::Restarted,
            Ok(_) => {
                if std::mem::take(lost) {
                    self.feed.emit(HsuEvent::LinkBack);
                }
                return true;
            }
            Err(LinkError::NoAnswer { .. }) => LinkLoss::Silent,
            Err(LinkError::Broken(cause)) => LinkLoss::Broken(cause),
        };
        let goes_on = loss == LinkLoss::Silent;
        if !(*lost && goes_on) {
            tracing::warn!(device = %self.device, ?loss, "lost the link to the HSU");
            self.feed.emit(HsuEvent::LinkLost(loss));
        }
        *lost = true;
        goes_on
    }

    fn fill_holes(&self) {
        while !self.stop.load(Ordering::Relaxed) {
            let Some(hole) = self.feed.order().hole() else { return };
            let (first, count) = hole.worth_asking();
            let records = self.query_triggers(hole.session, first, count).unwrap_or_else(|error| {
                tracing::warn!(device = %self.device, first, count, %error, "lost trigger telemetry for good");
                Vec::new()
            });
            let mut order = self.feed.order();
            // Meanwhile the hole may have been given up.
            if order.hole() == Some(hole) {
                order.fill(&records, &mut |event| self.feed.emit(event));
            }
        }
    }
}

pub(super) fn unexpected(request: &'static str, expected: &'static str, found: &UnitToHost) -> HsuError {
    HsuError::Unexpected { request, expected, found: format!("{found:?}") }
}
