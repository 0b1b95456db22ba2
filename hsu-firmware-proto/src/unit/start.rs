// SPDX-License-Identifier: MIT OR Apache-2.0
//! How a train begins: at a host's request, or at an edge of an input line that a host has named.

use super::train::Train;
use super::{Phase, Unit, UnitOutputs};
use crate::ids::SessionId;
use crate::inputs::Slope;
use crate::unit_to_host::Refusal;

impl Unit {
    /// An edge of an input line.
    pub fn input(&mut self, slope: Slope, now_ns: u64, out: &mut impl UnitOutputs) {
        if self.start_at == Some(slope) && matches!(self.phase, Phase::Armed) && self.all_armed() {
            self.begin_train(now_ns);
        }
        self.inputs.take(slope, now_ns);
        self.tell_news(now_ns, out);
    }

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
