// SPDX-License-Identifier: MIT OR Apache-2.0
//! The trigger of the first frame of a stream that begins while the train runs: a camera that is back, or one whose
//! place was lost.
//!
//! Its ids are no evidence yet. Its clock, read behind the frame, names a trigger, since what its stamps take from one
//! was measured when the train began; of a clock that cannot be read, its relation from before must do. The arrivals of
//! this frame and of those behind it must name the same. One of the two alone is not enough.

use super::anchor::pace_of;
use super::clock_relation::Tracker;
use super::dispute::{IN_TIME, Timing};
use super::sighting::{Match, Sighting};
use super::{Case, Matcher, Stage};

/// The trigger that a frame's clock names.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Named {
    number: i64,
    /// Whether the clock's relation from before names the same trigger.
    unchanged: bool,
}

impl Matcher {
    /// Finds the place of a stream by clock and arrivals.
    pub(super) fn rejoin(&mut self, case: &Case<'_>) -> Match {
        let before = match &self.stage {
            Stage::Lost(before) => *before,
            _ => None,
        };
        if !case.frame.complete || case.frame.camera_ns.is_none() {
            return self.give_up(case.frame);
        }
        if !case.last_call && self.clock.awaits(case.frame, case.hsu) {
            return Match::Wait;
        }
        let more = !case.last_call;
        let Some(named) = self.named(case, case.frame, before.as_ref()) else {
            let arrived = self.arrived_ns(case.frame.host_ns, case.hsu);
            let ahead = arrived.zip(case.table.latest_ns()).is_some_and(|(ns, latest)| ns > latest.into());
            return if ahead && more { Match::Wait } else { self.give_up(case.frame) };
        };
        let behind = || {
            case.followers.iter().filter_map(|frame| {
                let steps = self.ids.between(case.frame.id.0, frame.id.0);
                let other = self.named(case, frame, before.as_ref())?;
                let ahead = other.number - named.number;
                let follows = steps > 0 && ahead >= steps && other.unchanged == named.unchanged;
                Some((frame, other.number, follows))
            })
        };
        let against = behind().any(|(.., follows)| !follows) || !self.is_fresh(named.number);
        let chain = std::iter::once((case.frame, named.number))
            .chain(behind().map(|(frame, number, _)| (frame, number)));
        let arrivals = self.arrivals(case, chain);
        if against || arrivals.early > 0 {
            return self.give_up(case.frame);
        }
        // What was read of the clock since is right of itself; what held before must be borne out.
        let enough = match self.clock.read_fired_ns(case.frame, case.hsu) {
            Some(_) => arrivals.in_time >= IN_TIME,
            None => self.convince(arrivals),
        };
        if !enough || self.timing(case, case.frame, named.number) != Timing::InTime {
            return if more { Match::Wait } else { self.give_up(case.frame) };
        }
        let ids = |frame: &Sighting| self.ids.between(case.frame.id.0, frame.id.0);
        let behind = behind().map(|(frame, number, _)| (ids(frame), number));
        let pace = pace_of(std::iter::once((0, named.number)).chain(behind));
        self.tracker = before.filter(|_| named.unchanged);
        let answer = self.accept(case, named.number, None);
        self.pace = pace;
        answer
    }

    /// Whether this frame follows the one before as its id does, by their arrivals; keeps this one for the next call.
    pub(super) fn follows(&mut self, frame: &Sighting, number: Option<i64>) -> bool {
        let before = std::mem::replace(&mut self.arrived, number.map(|number| (frame.id, number)));
        before.zip(number).is_some_and(|((id, before), number)| {
            let steps = self.ids.between(id.0, frame.id.0);
            steps > 0 && number.checked_sub(before) == Some(steps)
        })
    }

    /// The trigger at which a frame's clock stands.
    fn named(&self, case: &Case<'_>, frame: &Sighting, before: Option<&Tracker>) -> Option<Named> {
        let period_ns = i128::from(self.start.period_ns);
        let tracked = frame.camera_ns.zip(before).map(|(ns, tracker)| tracker.hsu_ns(ns));
        if self.clock.read_fired_ns(case.frame, case.hsu).is_some() {
            let read = self.clock.fired_ns(frame, case.hsu)?;
            let number = self.read_trigger(case, frame)?;
            let unchanged = tracked.is_some_and(|ns| (ns - read).abs() <= period_ns / 4);
            return Some(Named { number, unchanged });
        }
        // Where the clock can be read, only readings are used.
        if self.clock.distinguishes() {
            return None;
        }
        let (number, residual) = case.table.nearest(tracked?)?;
        let at_trigger = residual.abs() <= period_ns / 8 && case.table.is_reported(number);
        at_trigger.then_some(Named { number, unchanged: true })
    }
}
