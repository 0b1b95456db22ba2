// SPDX-License-Identifier: MIT OR Apache-2.0
//! How a train begins: whether it may, and its first trigger.

use super::train::Train;
use super::{Phase, Unit};
use crate::ids::SessionId;
use crate::unit_to_host::Refusal;

impl Unit {
    /// Whether the train is still to be started; `false` where it runs.
    pub(super) fn may_start(&self, session: SessionId) -> Result<bool, Refusal> {
        let (Some(arm), Some(_)) = (self.arm, self.timing) else {
            return Err(Refusal::NotAllArmed { armed_links: 0, expected: 0 });
        };
        match self.phase {
            Phase::Armed => {
                self.expect_session(session)?;
                if !self.all_armed() {
                    let expected = arm.expected.iter().filter(|name| !name.is_none()).count() as u8;
                    return Err(Refusal::NotAllArmed { armed_links: self.armed_links(), expected });
                }
                Ok(true)
            }
            // Both hosts may ask.
            Phase::Running(_) => self.expect_session(session).map(|()| false),
            Phase::Idle | Phase::Finished { .. } => Err(Refusal::NotAllArmed { armed_links: 0, expected: 0 }),
        }
    }

    pub(super) fn begin_train(&mut self, now_ns: u64) {
        let (Some(arm), Some(timing)) = (self.arm, self.timing) else { return };
        let train = Train::start(&arm, &timing, now_ns);
        self.history.restart(train.number());
        self.phase = Phase::Running(train);
        self.start_at = None;
        self.news.state = true;
    }
}
