// SPDX-License-Identifier: MIT OR Apache-2.0
//! The trigger of the first frame of a stream that begins while the train runs: a camera that is back.
//!
//! Its ids say nothing yet. What its stamps and arrivals take from a trigger was measured when the train began. Its
//! clock is read; of one that cannot be read, its relation from before (the cable was out) or arrivals alone must do.
//! The frames behind it must agree: their triggers follow as their ids do.

use super::clock_relation::Tracker;
use super::sighting::{Match, Sighting, Witness};
use super::{Case, Matcher, Stage};

/// So many frames behind it must agree where stamp and arrival do.
const AGREEING: usize = 2;
/// As [`AGREEING`], of a camera that has no clock which can be read: arrivals alone speak.
const AGREEING_ARRIVALS: usize = 5;

/// What is known of a stream whose place is looked for.
#[derive(Debug)]
pub(super) struct Rejoin {
    /// The clock's relation before.
    pub(super) before: Option<Tracker>,
}

/// The trigger that a frame's witnesses name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Named {
    number: i64,
    /// By the clock's relation from before.
    unchanged: bool,
    /// By its arrival alone.
    alone: bool,
}

impl Matcher {
    /// Finds the place of a stream by stamp and arrival.
    pub(super) fn rejoin(&mut self, case: &Case<'_>) -> Match {
        let before = match &self.stage {
            Stage::Lost(lost) => lost.before,
            _ => None,
        };
        if case.frame.complete && case.frame.camera_ns.is_some() && self.awaits_reading(case) {
            return Match::Wait;
        }
        let Some(named) = self.named(case, case.frame, before.as_ref()).filter(|_| case.frame.complete)
        else {
            let arrived = self.arrived_ns(case.frame.host_ns, case.hsu);
            let ahead = arrived.zip(case.table.latest_ns()).is_some_and(|(ns, latest)| ns > latest.into());
            let held_up = ahead && case.frame.complete && case.followers.is_empty();
            return if held_up && !case.last_call { Match::Wait } else { self.give_up(case.frame) };
        };
        let (mut agreeing, mut against) = (0, false);
        for frame in case.followers {
            let steps = self.ids.between(case.frame.id.0, frame.id.0);
            if let Some(other) = self.named(case, frame, before.as_ref()) {
                let follows =
                    steps > 0 && other.number - named.number == steps && other.unchanged == named.unchanged;
                agreeing += usize::from(follows);
                against |= !follows;
            }
        }
        let needed = if named.alone { AGREEING_ARRIVALS } else { AGREEING };
        let agreed = agreeing >= needed && !against && self.is_fresh(named.number);
        if !agreed && !against && !case.last_call && case.followers.len() < Self::FOLLOWERS {
            return Match::Wait;
        }
        // An arrival alone may be late, before a trigger that the camera ignored: the one before must agree as well.
        let follows = self.follows(case.frame, Some(named.number));
        if agreed && (!named.alone || follows) {
            self.tracker = before.filter(|_| named.unchanged);
            let witness = if named.alone { Witness::One } else { Witness::Two };
            return self.accept(case, named.number, witness, None);
        }
        self.give_up(case.frame)
    }

    /// Whether the frame before arrived as the ids say; this one is the next one's.
    pub(super) fn follows(&mut self, frame: &Sighting, number: Option<i64>) -> bool {
        let before = std::mem::replace(&mut self.arrived, number.map(|number| (frame.id, number)));
        before.zip(number).is_some_and(|((id, before), number)| {
            let steps = self.ids.between(id.0, frame.id.0);
            steps > 0 && number.checked_sub(before) == Some(steps)
        })
    }

    /// What a frame's stamp and arrival agree on.
    fn named(&self, case: &Case<'_>, frame: &Sighting, before: Option<&Tracker>) -> Option<Named> {
        let period_ns = i128::from(self.start.period_ns);
        let at = |ns: i128, slack: i128| {
            let (number, residual) = case.table.nearest(ns)?;
            (residual.abs() <= slack && case.table.is_reported(number)).then_some(number)
        };
        let tracked = frame.camera_ns.zip(before).map(|(ns, tracker)| tracker.hsu_ns(ns));
        if self.clock.read_fired_ns(case.frame, case.hsu).is_some() {
            let read = self.clock.fired_ns(frame, case.hsu)?;
            let number = self.read_trigger(case, frame)?;
            let unchanged = tracked.is_some_and(|ns| (ns - read).abs() <= period_ns / 4);
            return Some(Named { number, unchanged, alone: false });
        }
        // Where readings are to be had, nothing else is believed.
        if frame.camera_ns.is_some() && self.clock.tells() {
            return None;
        }
        let arrived =
            self.arrived_ns(frame.host_ns, case.hsu)? - self.latency.usual_ns(self.start.period_ns)?;
        if let Some(number) = tracked.and_then(|ns| at(ns, period_ns / 8))
            && at(arrived, period_ns / 4) == Some(number)
        {
            return Some(Named { number, unchanged: true, alone: false });
        }
        let number = at(arrived, period_ns / 8)?;
        Some(Named { number, unchanged: false, alone: true })
    }
}
