// SPDX-License-Identifier: MIT OR Apache-2.0
//! What comes in on the input lines: an edge that a host waits for, one to be told, or one of the time code.

use super::{Phase, Unit, UnitOutputs};
use crate::ids::LinkId;
use crate::inputs::Slope;
use crate::unit_to_host::Refusal;

impl Unit {
    /// An edge of an input line at `edge_ns`. Those of the time code may be handed over later than they came, in their
    /// order, with the times that the timer has captured.
    pub fn input(&mut self, slope: Slope, edge_ns: u64, out: &mut impl UnitOutputs) {
        if self.time_codes.input() == Some(slope.line()) {
            return self.time_codes.take(slope.rising, edge_ns);
        }
        if self.start_at == Some(slope) && matches!(self.phase, Phase::Armed) && self.all_armed() {
            self.begin_train(edge_ns);
        }
        self.inputs.take(slope, edge_ns);
        self.tell_news(edge_ns, out);
    }

    /// The host of a link names the input that carries time code.
    pub(super) fn set_time_code(&mut self, link: LinkId, input: Option<u8>) -> Result<(), Refusal> {
        if let (Some(slope), Some(host)) = (self.start_at, input)
            && slope.line() == host
        {
            return Err(Refusal::Busy(self.state()));
        }
        for other in LinkId::ALL.into_iter().filter(|&other| other != link) {
            let other = &mut self.links[other.index()];
            let Some(unit) = other.time_code else { continue };
            match input {
                // A host that is not heard any more has no say.
                Some(host) if host != unit && other.silent => other.time_code = None,
                Some(host) if host != unit => return Err(Refusal::TimeCodeDiffers { unit, host }),
                _ => {}
            }
        }
        self.links[link.index()].time_code = input;
        self.listen_for_time_code();
        Ok(())
    }

    /// The host of a link has left, or greets anew.
    pub(super) fn forget_time_code(&mut self, link: LinkId) {
        self.links[link.index()].time_code = None;
        self.listen_for_time_code();
    }

    fn listen_for_time_code(&mut self) {
        self.time_codes.listen(self.links.iter().find_map(|link| link.time_code));
    }
}
