// SPDX-License-Identifier: MIT OR Apache-2.0
//! Frames whose block id and timestamp are not enough by themselves: they differ, or something has just happened.
//!
//! Counter and clock are two accounts of what the camera did. Each gives every frame a trigger, the frames behind
//! included. The arrival decides between them, and only in one direction: nothing arrives before its trigger was fired.
//! So the account that gives the **later** triggers is refuted by one frame that arrives too early for it. It is
//! accepted where more frames arrive just in time for it than a host that stood still can explain. Where
//! neither happens, the frame is given up.

use super::sighting::{Finding, Match, Sighting};
use super::{Case, Matcher};
use crate::matcher::clock_relation::Tracker;
use std::cmp::Ordering;

/// Frames that must be considered behind a contradiction, for a camera without timestamps.
const COUNTED: usize = 8;
/// Frames that must be in time for the account that gives the later triggers.
pub(super) const IN_TIME: usize = 3;
/// Share of the frames expected in time that must be in time.
const IN_TIME_SHARE: f64 = 0.75;
/// Upper bound of the share of frames that a host takes up at once, so that no probability becomes zero.
const MOST_QUICK: f64 = 0.98;
/// Probability below which it is excluded that a host took up none of the frames at once.
const CHANCE: f64 = 1e-5;
/// Frames that must be in time behind frames that were lost.
const IN_TIME_AGREED: usize = 2;
/// Frames behind one that must agree with each other; with no more to come, one is enough.
const ALIKE: usize = 2;

/// The triggers that counter and clock give a frame.
#[derive(Clone, Copy)]
struct Claim<'a> {
    frame: &'a Sighting,
    /// The trigger that its id points at.
    by_id: i64,
    /// The trigger at which its timestamp lies.
    by_clock: Option<i64>,
    /// When its trigger was fired by its timestamp, HSU time, ns.
    exposed: Option<i128>,
}

/// How a frame's arrival fits a trigger.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Timing {
    /// Before the trigger was fired, or sooner behind it than any frame comes.
    Early,
    /// As soon as the quickest frames.
    InTime,
    /// Later than they, but not by a period.
    Slow,
    /// By a period or more: that is no evidence of which trigger it is of.
    Late,
    /// How soon frames come, or when the trigger was fired, is not known.
    Unknown,
}

/// How the arrivals of several frames fit their triggers.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Arrivals {
    pub(super) early: usize,
    pub(super) in_time: usize,
    /// In time, or not a period later.
    pub(super) soon: usize,
    /// All frames, those of unknown timing included.
    pub(super) frames: usize,
}

impl Matcher {
    /// How a frame's arrival fits a trigger.
    pub(super) fn timing(&self, case: &Case<'_>, frame: &Sighting, number: i64) -> Timing {
        // Between reports a time that is only calculated may be too late as well as too early.
        let known = !case.table.is_bridged(number);
        let Some(due) = case.table.time_ns(number).filter(|_| known) else { return Timing::Unknown };
        if self.precedes(frame, due, case.hsu) {
            return Timing::Early;
        }
        let period_ns = i128::from(self.start.period_ns);
        let distinct = self.envelope().is_some_and(|known| known.distinguishes);
        match self.late_ns(frame, due, case.hsu).filter(|_| distinct) {
            Some(ns) if ns < -period_ns / 4 => Timing::Early,
            Some(ns) if ns.abs() <= period_ns / 4 => Timing::InTime,
            Some(ns) if ns <= period_ns * 3 / 4 => Timing::Slow,
            Some(_) => Timing::Late,
            None => Timing::Unknown,
        }
    }

    /// How the arrivals of frames fit their triggers.
    pub(super) fn arrivals<'a>(
        &self,
        case: &Case<'_>,
        frames: impl Iterator<Item = (&'a Sighting, i64)>,
    ) -> Arrivals {
        let mut arrivals = Arrivals::default();
        for (frame, number) in frames {
            let timing = self.timing(case, frame, number);
            arrivals.frames += 1;
            arrivals.early += usize::from(timing == Timing::Early);
            arrivals.in_time += usize::from(timing == Timing::InTime);
            arrivals.soon += usize::from(matches!(timing, Timing::InTime | Timing::Slow));
        }
        arrivals
    }

    /// A whole frame of a stream whose ids count from a known trigger, and whose clock's relation is known.
    pub(super) fn by_counter_and_clock(&mut self, case: &Case<'_>, tracker: &Tracker) -> Match {
        let exposed = |frame: &Sighting| frame.camera_ns.map(|camera_ns| tracker.hsu_ns(camera_ns));
        let own = self.claim_of(case, case.frame, case.by_id, exposed(case.frame));
        // The ordinary frame: nothing happened, and nothing is allocated.
        let plain = own.by_clock == Some(own.by_id)
            && !self.unsettled
            && self.last.is_some_and(|last| own.by_id == last.number + 1);
        if plain && self.timing(case, case.frame, own.by_id) == Timing::InTime {
            return self.accept(case, own.by_id, None);
        }
        let mut before = 0;
        let behind: Vec<Claim<'_>> = case
            .followers
            .iter()
            .map_while(|frame| {
                // Behind an id that does not increase, ids are no evidence for this frame.
                let steps = self.ids.between(case.frame.id.0, frame.id.0);
                let by_id = case
                    .by_id
                    .checked_add(steps)
                    .filter(|_| steps > std::mem::replace(&mut before, steps))?;
                Some(self.claim_of(case, frame, by_id, exposed(frame)))
            })
            .collect();
        match own.by_clock == Some(own.by_id) {
            true => self.agreed(case, &own, &behind),
            false => self.disputed(case, &own, &behind),
        }
    }

    fn claim_of<'a>(
        &self,
        case: &Case<'_>,
        frame: &'a Sighting,
        by_id: i64,
        exposed: Option<i128>,
    ) -> Claim<'a> {
        let at = |ns: i128| {
            let (number, residual) = case.table.nearest(ns)?;
            (residual.abs() <= self.near_ns()).then_some(number)
        };
        Claim { frame, by_id, by_clock: exposed.and_then(at), exposed }
    }

    /// Counter and clock name the same trigger. A frame that comes late waits for one behind it that does not: as long
    /// as the frames behind stand as it does, they are of one piece with it.
    fn agreed(&mut self, case: &Case<'_>, own: &Claim<'_>, behind: &[Claim<'_>]) -> Match {
        let number = own.by_id;
        if !self.is_fresh(number) {
            // Both went back.
            return self.give_up(case.frame);
        }
        let chain = || {
            let behind = behind.iter().take_while(|claim| claim.by_clock == Some(claim.by_id));
            std::iter::once(own).chain(behind).map(|claim| (claim.frame, claim.by_id))
        };
        let arrivals = self.arrivals(case, chain());
        if arrivals.early > 0 {
            // Both are too far ahead: they slipped alike.
            return self.give_up(case.frame);
        }
        let doubtful = self.unsettled || self.last.is_some_and(|last| number > last.number + 1);
        let distinct = self.envelope().is_some_and(|known| known.distinguishes);
        // In a doubtful time no loss may lie between it and those that are in time.
        let arrivals = match doubtful {
            true => {
                let unbroken = chain().zip(number..).take_while(|((_, number), next)| number == next);
                self.arrivals(case, unbroken.map(|(claim, _)| claim))
            }
            false => arrivals,
        };
        // Where arrivals do not distinguish triggers, two witnesses suffice.
        let before = self.last.is_some_and(|last| last.in_time && number == last.number + 1);
        // What the rhythm lets expect is no trigger that was reported: one may have been held.
        let known = !doubtful || !(case.table.is_bridged(number) || case.table.is_expected(number));
        let enough = match doubtful && distinct {
            _ if !known => false,
            true if self.unsettled => {
                let in_time = arrivals.in_time + usize::from(before);
                let soon = arrivals.soon + usize::from(before);
                soon > IN_TIME && in_time >= IN_TIME_AGREED
            }
            true => arrivals.soon + usize::from(before) >= IN_TIME_AGREED,
            false => arrivals.soon > 0 || !(distinct || self.unsettled),
        };
        if enough && !self.is_shifted(case, chain()) {
            return self.accept(case, number, None);
        }
        match case.last_call {
            // With no more to come, and no contradiction right behind it.
            true if !doubtful
                && !enough
                && (behind.is_empty() || chain().nth(1).is_some())
                && !self.stays_late(chain()) =>
            {
                self.accept(case, number, None)
            }
            false if !enough => Match::Wait,
            _ => self.give_up(case.frame),
        }
    }

    /// Whether frames that came one by one, and not out of a queue, were all of them late, on a host that took up those
    /// before as soon as they came: no host stands still for that long.
    fn stays_late<'a>(&self, chain: impl Iterator<Item = (&'a Sighting, i64)>) -> bool {
        let mut before = None;
        let one_by_one = chain.filter(|(frame, _)| {
            let before = before.replace(frame.host_ns);
            before.is_some_and(|before: u64| frame.host_ns.saturating_sub(before) > self.start.period_ns / 2)
        });
        self.on_time.is_calm() && one_by_one.count() >= IN_TIME
    }

    /// Whether the frames before the next that are missing are late by whole periods, all alike: that is no host that
    /// stood still, but triggers that are miscounted.
    fn is_shifted<'a>(&self, case: &Case<'_>, chain: impl Iterator<Item = (&'a Sighting, i64)>) -> bool {
        let period_ns = i128::from(self.start.period_ns);
        let mut expected = None;
        let (mut skipped, mut frames) = (false, 0);
        let (mut least, mut most) = (i128::MAX, i128::MIN);
        for (frame, number) in chain {
            if expected.is_some_and(|expected| number != expected) {
                skipped = true;
                break;
            }
            expected = number.checked_add(1);
            let Some(late) = case.table.time_ns(number).and_then(|due| self.late_ns(frame, due, case.hsu))
            else {
                return false;
            };
            (least, most) = (least.min(late), most.max(late));
            frames += 1;
        }
        // One alone may be late by as much on any host.
        if frames < ALIKE {
            return false;
        }
        let whole = (least + period_ns / 2) / period_ns * period_ns;
        skipped && whole > 0 && least >= whole - period_ns / 4 && most <= whole + period_ns / 4
    }

    /// Counter and clock name different triggers, or the clock names none.
    fn disputed(&mut self, case: &Case<'_>, own: &Claim<'_>, behind: &[Claim<'_>]) -> Match {
        // A camera that takes every second trigger does so again, and a late arrival is no evidence against it.
        let again = |(last, number): (super::Last, i64)| self.pace == Some(number - last.number);
        if let Some(number) = own.by_clock
            && self.last.zip(own.by_clock).is_some_and(again)
            && case.table.is_reported(number)
        {
            let timing = self.timing(case, own.frame, number);
            let in_time = matches!(timing, Timing::InTime | Timing::Slow);
            if in_time || (timing != Timing::Early && case.last_call) {
                let pace = self.pace;
                let answer = self.accept(case, number, None);
                self.pace = pace;
                return answer;
            }
        }
        // Whether the clock gives the frames behind later triggers than their ids, earlier ones or the same: as far as
        // they agree with the first of them.
        let sides = || behind.iter().filter_map(|claim| Some(claim.by_clock?.cmp(&claim.by_id)));
        let side = sides().next();
        let alike = sides().take_while(|other| Some(*other) == side).count();
        let enough = alike >= ALIKE || (alike > 0 && case.last_call);
        let answer = match side.filter(|_| enough) {
            Some(Ordering::Equal) => self.passing(case, own, behind),
            Some(side) => self.standing(case, own, behind, side),
            None if case.last_call
                && case.followers.is_empty()
                && own.by_clock.is_some_and(|n| n > own.by_id) =>
            {
                self.standing(case, own, behind, Ordering::Greater)
            }
            None => self.off_the_grid(case, own, behind),
        };
        match answer {
            Some(answer) => answer,
            None if case.last_call => self.give_up(case.frame),
            None => Match::Wait,
        }
    }

    /// The frames behind stand as ids and clock did before: what happened was this frame's alone.
    fn passing(&mut self, case: &Case<'_>, own: &Claim<'_>, behind: &[Claim<'_>]) -> Option<Match> {
        let settled = behind.iter().find(|claim| claim.by_clock == Some(claim.by_id))?;
        let chain = behind.iter().filter(|claim| claim.by_clock == Some(claim.by_id));
        let arrivals = self.arrivals(case, chain.map(|claim| (claim.frame, claim.by_id)));
        if arrivals.early > 0 {
            return Some(self.pass_over(case.frame));
        }
        // Ids count through it, and no exposure can be where its timestamp is: that alone is wrong.
        let apart = i128::from(self.start.period_ns / 16);
        let before = self.last.and_then(|last| case.table.time_ns(last.number)).map(i128::from);
        let after = case.table.time_ns(settled.by_id).map(i128::from);
        let impossible = own.exposed.is_none_or(|ns| {
            before.is_some_and(|before| ns < before + apart) || after.is_some_and(|after| ns > after - apart)
        });
        let reported = |number: i64| self.is_fresh(number) && case.table.is_reported(number);
        if reported(own.by_id) && impossible {
            // Between two frames whose counter and clock agree, next to both by its id: it can be of no other trigger.
            let enclosed = self.last.is_some_and(|last| own.by_id == last.number + 1)
                && settled.by_id == own.by_id.saturating_add(1)
                && arrivals.frames >= ALIKE;
            let by_clock = || own.by_clock.is_some_and(|n| self.timing(case, own.frame, n) == Timing::InTime);
            return match self.timing(case, own.frame, own.by_id) {
                Timing::Early => Some(self.pass_over(case.frame)),
                Timing::Late if by_clock() => Some(self.pass_over(case.frame)),
                timing if enclosed || timing == Timing::InTime => {
                    let residual = own.exposed.zip(case.table.time_ns(own.by_id));
                    let residual = residual.map(|(ns, due)| ns - i128::from(due));
                    Some(self.accept(case, own.by_id, Some(Finding::StampWrong(residual))))
                }
                Timing::Unknown if !case.last_call && self.envelope().is_none() => None,
                _ => Some(self.pass_over(case.frame)),
            };
        }
        // Its id stood still.
        let free = own
            .by_clock
            .filter(|number| !self.is_fresh(own.by_id) && reported(*number) && *number < settled.by_id);
        match free.filter(|number| self.timing(case, own.frame, *number) == Timing::InTime) {
            Some(number) => Some(self.accept(case, number, None)),
            None => Some(self.pass_over(case.frame)),
        }
    }

    /// The clock gives the frames behind other triggers than their ids, all of them later ones or all earlier ones.
    fn standing(
        &mut self,
        case: &Case<'_>,
        own: &Claim<'_>,
        behind: &[Claim<'_>],
        side: Ordering,
    ) -> Option<Match> {
        // Of one piece are frames whose triggers by the clock are the same number of steps further for each id.
        let stands =
            |claim: &&Claim<'_>| claim.by_clock.is_some_and(|number| number.cmp(&claim.by_id) == side);
        let own_stands = stands(&own);
        let first = if own_stands { own } else { behind.iter().find(stands)? };
        let steps = |from: &Claim<'_>, to: &Claim<'_>| {
            let clock = to.by_clock?.checked_sub(from.by_clock?)?;
            let ids = to.by_id.checked_sub(from.by_id).filter(|ids| *ids > 0)?;
            (clock % ids == 0).then_some(clock / ids)
        };
        let after = || behind.iter().filter(|claim| claim.by_id > first.by_id);
        let pace = after().find(|next| next.by_clock.is_some()).and_then(|next| steps(first, next));
        let chain = || {
            // A loss between them may be a slip that is over.
            let unbroken =
                after().zip(first.by_id.saturating_add(1)..).take_while(|(claim, id)| claim.by_id == *id);
            // A timestamp that names no trigger is that frame's alone.
            let named = unbroken.map(|(claim, _)| claim).filter(|claim| claim.by_clock.is_some());
            let alike = named.take_while(|claim| pace.is_some() && steps(first, claim) == pace);
            std::iter::once(first).chain(alike)
        };
        let by_id = self.arrivals(case, chain().map(|claim| (claim.frame, claim.by_id)));
        let by_clock = self.arrivals(case, chain().filter_map(|claim| Some((claim.frame, claim.by_clock?))));
        let clock_is_right = match side {
            // With no more to come, behind one that was in time.
            Ordering::Greater if case.last_call && self.ends_in_time(by_clock) => true,
            Ordering::Greater => self.decides(by_id, by_clock)?,
            _ => !self.decides(by_clock, by_id)?,
        };
        if clock_is_right {
            return Some(match own.by_clock {
                Some(number) if own_stands && self.is_fresh(number) && case.table.is_reported(number) => {
                    let pace = self.last.map(|last| number - last.number);
                    let answer = self.accept(case, number, None);
                    self.pace = pace.filter(|pace| *pace > 1);
                    answer
                }
                // The frames behind have one id too many: this one has no trigger.
                None if side == Ordering::Less && case.table.is_reported(own.by_id) => {
                    let off = own.exposed.zip(case.table.time_ns(own.by_id));
                    self.spurious(case.frame, off.map_or(0, |(ns, due)| ns - i128::from(due)))
                }
                _ => self.give_up(case.frame),
            });
        }
        Some(self.clock_was_set(case, own))
    }

    /// The timestamps of this frame and of those behind lie at no trigger, but as far from their ids' all of them: the
    /// clock was set, and the arrivals show that ids are right.
    fn off_the_grid(&mut self, case: &Case<'_>, own: &Claim<'_>, behind: &[Claim<'_>]) -> Option<Match> {
        let off = |claim: &Claim<'_>| Some(claim.exposed? - i128::from(case.table.time_ns(claim.by_id)?));
        let own_off = off(own)?;
        let slack = i128::from(self.start.period_ns / 16);
        let alike = |claim: &&Claim<'_>| off(claim).is_some_and(|ns| (ns - own_off).abs() <= slack);
        let chain = std::iter::once(own).chain(behind).filter(alike);
        let arrivals = self.arrivals(case, chain.map(|claim| (claim.frame, claim.by_id)));
        (own.by_clock.is_none() && !self.unsettled && self.convince(arrivals))
            .then(|| self.clock_was_set(case, own))
    }

    /// Ids go on, the clock does not: its relation is learned again from here.
    fn clock_was_set(&mut self, case: &Case<'_>, own: &Claim<'_>) -> Match {
        let (Some(camera_ns), Some(due)) = (case.frame.camera_ns, case.table.reported_ns(own.by_id)) else {
            return self.give_up(case.frame);
        };
        // An extra frame between two triggers would not be in time.
        let timing = self.timing(case, own.frame, own.by_id);
        let in_time = timing == Timing::InTime || (timing == Timing::Slow && !self.unsettled);
        if !self.is_fresh(own.by_id) || !in_time {
            return self.give_up(case.frame);
        }
        let residual = own.exposed.map_or(0, |ns| ns - i128::from(due));
        self.clock.was_set();
        self.tracker = Some(Tracker::new(due, camera_ns));
        Match::Trigger(self.place(case.frame, own.by_id, Some(Finding::ClockReset(residual))))
    }

    /// A camera without timestamps: its counter and the arrivals are the witnesses. A frame that is late may be of a
    /// later trigger, if the camera ignored some; of one that is early, ids have jumped.
    pub(super) fn by_counter_and_arrival(&mut self, case: &Case<'_>) -> Match {
        let mut before = 0;
        let behind = case.followers.iter().map_while(|frame| {
            // Behind an id that does not increase, ids are no evidence for this frame.
            let steps = self.ids.between(case.frame.id.0, frame.id.0);
            let goes_on = steps > std::mem::replace(&mut before, steps);
            Some((frame, case.by_id.checked_add(steps).filter(|_| goes_on)?))
        });
        let in_time = self.timing(case, case.frame, case.by_id) == Timing::InTime;
        // After a contradiction that nothing resolved, an extra frame between two triggers must not pass for the next
        // one's.
        let due = case.table.time_ns(case.by_id);
        let late = due.and_then(|due| self.late_ns(case.frame, due, case.hsu));
        let near = !self.unsettled || late.is_some_and(|ns| ns.abs() <= i128::from(self.start.period_ns / 8));
        let in_time = in_time && near;
        let arrivals = self.arrivals(case, behind);
        let possible = self.is_fresh(case.by_id) && case.table.is_reported(case.by_id);
        let enough = match self.unsettled {
            true => self.convince(arrivals) && arrivals.frames >= COUNTED && self.on_time.is_calm(),
            false => arrivals.in_time > 0,
        };
        if possible && in_time && !enough && arrivals.early == 0 && !case.last_call {
            return Match::Wait;
        }
        // At the end of a session nothing comes behind it.
        let follows = self.follows(case.frame, in_time.then_some(case.by_id));
        let confirmed = enough || (case.followers.is_empty() && follows);
        match possible && in_time && arrivals.early == 0 && confirmed {
            true => self.accept(case, case.by_id, None),
            false => self.give_up(case.frame),
        }
    }

    /// Whether arrivals confirm the triggers that they were compared with: as many frames are in time as there should
    /// be, and it cannot be that all of them are late ones of earlier triggers.
    pub(super) fn convince(&self, arrivals: Arrivals) -> bool {
        self.envelope().is_some_and(|known| {
            let frames = arrivals.frames as f64;
            let chance = if self.on_time.is_calm() { CHANCE } else { CHANCE * CHANCE };
            let expected = known.quick * frames;
            arrivals.early == 0
                && arrivals.in_time >= IN_TIME
                && arrivals.in_time as f64 >= IN_TIME_SHARE * expected
                && (1.0 - known.quick.min(MOST_QUICK)).powf(frames) <= chance
        })
    }

    /// Whether the last frames of a session, behind one that was in time, are all in time.
    fn ends_in_time(&self, arrivals: Arrivals) -> bool {
        let before = self.last.is_some_and(|last| last.in_time) && !self.unsettled;
        before && arrivals.frames < IN_TIME && arrivals.in_time == arrivals.frames
    }

    /// Whether arrivals decide for the account that gives the later triggers; `None` where they do not decide.
    fn decides(&self, earlier: Arrivals, later: Arrivals) -> Option<bool> {
        match later.early {
            0 => self.convince(later).then_some(true),
            _ => (earlier.early == 0 && earlier.in_time >= IN_TIME_AGREED).then_some(false),
        }
    }
}
