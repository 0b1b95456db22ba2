// SPDX-License-Identifier: MIT OR Apache-2.0
//! Seconds before Record and after Stop: where the recording begins on all nodes, and when it ends by itself.
//!
//! While frames are held every node keeps those of the last seconds. Record names one trigger of the past, which all
//! nodes have, as the first of the recording. What comes behind it is counted by the nodes, so the end is a trigger,
//! too.

use super::participant::Nodes;
use super::request::{CaptureRequest, Control};
use crate::control::request::KeepRequest;
use crate::control::status::{Held, SessionStatus};

/// Longest time before Record, and after Stop, s.
pub const SPAN_MAX_S: f64 = 600.0;

/// Where the recording of one capture begins and ends, in triggers. [`super::run::capture`] makes one for each take,
/// and asks it in every round whether the train has to be stopped.
#[derive(Debug)]
pub(crate) struct Span {
    session_id: u64,
    /// Triggers before Record that are kept; 0: the recording begins with the train.
    pub(super) before: u64,
    /// Triggers behind Record; 0: until stopped.
    behind: u64,
    /// Triggers that are recorded after a stop.
    after_stop: u64,
    /// What was decided when Record was pressed.
    keep: Option<KeepRequest>,
    informed: Vec<bool>,
    /// Stop was pressed, and the nodes have not been asked since how many triggers there are.
    stop_pressed: bool,
    /// The train is stopped when this many triggers are recorded.
    stop_at: Option<u64>,
}

impl Span {
    /// For a capture on this many nodes; `behind` as in [`CaptureRequest::triggers`].
    pub(crate) fn new(
        wish: &CaptureRequest,
        session_id: u64,
        behind: u64,
        rate_hz: f64,
        nodes: usize,
    ) -> Result<Self, String> {
        let before = triggers_of("before Record", wish.pre_trigger_s, rate_hz)?;
        let after_stop = triggers_of("after Stop", wish.post_trigger_s, rate_hz)?;
        let informed = vec![false; nodes];
        Ok(Self {
            session_id,
            before,
            behind,
            after_stop,
            keep: None,
            informed,
            stop_pressed: false,
            stop_at: None,
        })
    }

    /// Record was pressed, or need not be.
    pub(crate) fn records(&self) -> bool {
        self.before == 0 || self.keep.is_some()
    }

    /// Whether the train is to be stopped now. `requested`: the operator pressed Stop, once or again. `recorded`: how many
    /// triggers the nodes knew of in the round before. The seconds after Stop are counted from what they know afterwards,
    /// so that none of them is one from before Stop.
    pub(crate) fn stops(&mut self, requested: bool, recorded: u64) -> bool {
        if std::mem::take(&mut self.stop_pressed) {
            self.stop_at = Some(recorded + self.after_stop);
        }
        if requested {
            let waits = self.stop_at.is_none() && self.records() && recorded > 0;
            if !waits || self.after_stop == 0 {
                return true;
            }
            self.stop_pressed = true;
        }
        self.stop_at.into_iter().chain(self.total()).min().is_some_and(|end| recorded >= end)
    }

    /// Triggers of the whole recording, where that is known once Record was pressed.
    pub(crate) fn total(&self) -> Option<u64> {
        let keep = self.keep.filter(|_| self.behind > 0)?;
        Some((keep.pressed + 1).saturating_sub(keep.first) + self.behind)
    }

    /// Passes Record on, where it was pressed and every node holds frames. A node that does not answer gets it again.
    pub(crate) fn pass_record_on(
        &mut self,
        nodes: Nodes<'_>,
        latest: &[Option<SessionStatus>],
        control: &Control,
    ) {
        if self.before == 0 || !control.record_is_pressed() {
            return;
        }
        if self.keep.is_none() {
            let ends: Option<Vec<u64>> = latest
                .iter()
                .map(|session| Some(session.as_ref()?.held?.end).filter(|end| *end > 0))
                .collect();
            let Some(end) = ends.and_then(|ends| ends.into_iter().min()) else { return };
            let (session_id, first) = (self.session_id, end.saturating_sub(self.before));
            self.keep = Some(KeepRequest { session_id, first, pressed: end - 1 });
        }
        let Some(keep) = &self.keep else { return };
        for ((node, informed), session) in nodes.iter().zip(&mut self.informed).zip(latest) {
            // A node that holds nothing any more has received it, and its answer was lost.
            let received = || session.as_ref().is_some_and(|session| session.held.is_none());
            if !*informed {
                *informed = match node.keep(keep) {
                    Ok(()) => true,
                    Err(fault) => {
                        tracing::warn!(place = node.place(), "Record: {}", fault.message);
                        received()
                    }
                };
            }
        }
    }

    /// Triggers that every node holds, while Record is waited for.
    pub(crate) fn held(&self, latest: &[Option<SessionStatus>]) -> Option<u64> {
        let of = |session: &Option<SessionStatus>| session.as_ref()?.held;
        let all: Option<Vec<Held>> = latest.iter().map(of).collect();
        let held = all?.into_iter().map(|held| held.end.saturating_sub(held.oldest).min(held.asked)).min();
        held.filter(|triggers| !self.records() && *triggers > 0)
    }
}

fn triggers_of(what: &str, seconds: Option<f64>, rate_hz: f64) -> Result<u64, String> {
    match seconds {
        None => Ok(0),
        Some(seconds) if (0.0..=SPAN_MAX_S).contains(&seconds) => Ok((seconds * rate_hz).round() as u64),
        Some(seconds) => Err(format!("{seconds} s {what}; expected 0 to {SPAN_MAX_S} s")),
    }
}

#[cfg(test)]
mod tests {
    use super::Span;
    use crate::capture::request::CaptureRequest;
    use crate::control::request::KeepRequest;

    fn span(before_s: f64, after_s: f64, behind: u64) -> Span {
        let wish = CaptureRequest {
            pre_trigger_s: Some(before_s),
            post_trigger_s: Some(after_s),
            ..CaptureRequest::default()
        };
        Span::new(&wish, 7, behind, 100.0, 2).expect("it is as expected")
    }

    #[test]
    fn a_session_ends_so_many_triggers_behind_record_or_stop() {
        let mut pressed = span(2.0, 0.0, 500);
        assert!(!pressed.records() && pressed.before == 200);
        pressed.keep = Some(KeepRequest { session_id: 7, first: 1000, pressed: 1199 });
        assert_eq!(pressed.total(), Some(700));
        assert!(!pressed.stops(false, 699));
        assert!(pressed.stops(false, 700));

        let mut stopped = span(0.0, 1.0, 0);
        assert!(stopped.records() && !stopped.stops(false, 5000));
        assert!(!stopped.stops(true, 5000), "a second more");
        assert!(!stopped.stops(false, 5020), "20 triggers were on their way when it was pressed");
        assert!(!stopped.stops(false, 5119) && stopped.stops(false, 5120));
        assert!(span(0.0, 1.0, 0).stops(true, 0), "nothing was recorded yet");
        let mut twice = span(0.0, 1.0, 0);
        assert!(!twice.stops(true, 10) && twice.stops(true, 11), "whoever stops again does not want to wait");
    }

    #[test]
    fn before_record_a_stop_waits_for_nothing() {
        assert!(span(2.0, 3.0, 0).stops(true, 0));
    }

    #[test]
    fn times_that_cannot_be_are_refused() {
        for seconds in [-1.0, f64::NAN, f64::INFINITY, 601.0] {
            let wish = CaptureRequest { pre_trigger_s: Some(seconds), ..CaptureRequest::default() };
            assert!(Span::new(&wish, 7, 0, 100.0, 1).is_err(), "{seconds}");
        }
    }
}
