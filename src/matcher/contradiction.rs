// SPDX-License-Identifier: MIT OR Apache-2.0
//! A frame whose block id and timestamp do not name the same trigger: the frames behind it say why.
//!
//! What happened once (a wrong stamp, a frame without a trigger) is gone with the next frame; what happened to the
//! camera (a trigger ignored, ids that jumped, a clock set anew) stays. So nothing is believed of one frame alone:
//! two frames behind it must agree on the explanation. Where two explanations fit (a clock set by whole periods looks
//! like triggers ignored), a reading of the camera's clock decides; where that cannot be read, arrivals do.

use super::clock_relation::Tracker;
use super::sighting::{Finding, Match, Sighting, Witness};
use super::{Case, Matcher};

/// So many frames behind one must agree on what happened; with no more to come, one.
const AGREEING: usize = 2;

/// What a frame behind the one in question says.
struct Follower<'a> {
    frame: &'a Sighting,
    /// The trigger of its id, were nothing wrong with ids.
    by_id: i64,
    /// When its trigger was fired by its stamp, were nothing wrong with the clock, HSU time.
    triggered: Option<i128>,
    /// How many triggers further on than its id its stamp is, where it lies at a trigger.
    ahead: Option<i64>,
}

impl Matcher {
    /// `triggered`: when the frame's trigger was fired by its timestamp, HSU time; `None` without one.
    pub(super) fn contradiction(&mut self, case: &Case<'_>, triggered: Option<i128>) -> Match {
        let Some(tracker) = self.tracker else { return self.give_up(case.frame) };
        let followers = self.followers(case, &tracker);
        let period_ns = i128::from(self.start.period_ns);
        let own = triggered.and_then(|ns| self.at_trigger(case, ns));
        let residual = triggered.zip(case.table.time_ns(case.by_id)).map(|(ns, due)| ns - i128::from(due));
        // The frames behind it stand where ids and clock said before.
        if self.stand(case, &followers, 0) && !self.unsettled {
            return self.passing(case, own, residual, &followers);
        }
        if self.awaits_reading(case) {
            return Match::Wait;
        }
        if let Some(read) = self.clock.read_fired_ns(case.frame, case.hsu) {
            let unchanged = triggered.is_some_and(|ns| (ns - read).abs() <= period_ns / 4);
            let answer = match unchanged {
                true => self.as_stamped(case, own, residual, &followers),
                false => self.as_read(case, residual, &followers),
            };
            return answer.unwrap_or_else(|| self.undecided(case, &followers));
        }
        let taken = own.is_none_or(|number| !self.is_fresh(number));
        let Some(off) = residual else { return self.undecided(case, &followers) };
        // How many whole periods it is off, if it is.
        let periods = (off + off.signum() * period_ns / 2) / period_ns;
        let whole = own.map(|number| number.saturating_sub(case.by_id));
        let whole =
            whole.or_else(|| ((off - periods * period_ns).abs() <= self.near_ns()).then_some(periods as i64));
        let by_clock = self.clock_agrees(case, triggered, &followers);
        // The frames behind stand one id too far: this one has no trigger.
        let one_less = taken && self.stand(case, &followers, -1);
        let ahead = if one_less { Some(-1) } else { whole.filter(|periods| *periods != 0) };
        // An arrival may be late, never early: where frames come on time for the one, they are not those of the other.
        let punctual = |ahead: i64| self.latency.is_known() && self.are_punctual(case, &followers, ahead);
        let clock_set = match (punctual(0), ahead.is_some_and(punctual)) {
            (true, false) => Some(true),
            (false, true) => Some(false),
            _ => None,
        };
        match (clock_set, own) {
            (Some(true), _) if by_clock => self.reset(case, residual),
            (Some(false), _) if one_less => self.spurious(case.frame, off),
            (Some(false), Some(number))
                if self.stand(case, &followers, number.saturating_sub(case.by_id))
                    && self.is_fresh(number)
                    && case.table.is_reported(number) =>
            {
                self.accept(case, number, Witness::Two, None)
            }
            _ => self.undecided(case, &followers),
        }
    }

    /// The camera's clock was read, and runs as it did: its stamps are right, and what changed are its ids.
    fn as_stamped(
        &mut self,
        case: &Case<'_>,
        own: Option<i64>,
        residual: Option<i128>,
        followers: &[Follower<'_>],
    ) -> Option<Match> {
        let half = i128::from(self.start.period_ns / 2);
        let late = |number: i64| self.late_ns(case.frame, case.table.time_ns(number)?, case.hsu);
        let own = own.filter(|number| self.is_fresh(*number));
        match own {
            // It would have come too early: its stamp is wrong by just that much.
            Some(number) if late(number).is_some_and(|ns| ns < -half) => None,
            Some(number) if self.stand(case, followers, number.saturating_sub(case.by_id)) => {
                self.doubt = 0;
                Some(self.accept(case, number, Witness::Two, None))
            }
            // The frames behind stand one id too far: this one has no trigger.
            None if self.stand(case, followers, -1) => {
                self.doubt = 0;
                Some(self.spurious(case.frame, residual.unwrap_or(0)))
            }
            _ => None,
        }
    }

    /// The camera's clock was read, and does not run as it did: it was set, and the readings say which trigger this is.
    fn as_read(
        &mut self,
        case: &Case<'_>,
        residual: Option<i128>,
        followers: &[Follower<'_>],
    ) -> Option<Match> {
        let number = self.read_trigger(case, case.frame).filter(|number| self.is_fresh(*number))?;
        let ahead = number.saturating_sub(case.by_id);
        let says = |f: &Follower<'_>| {
            self.read_trigger(case, f.frame).map(|read| read.saturating_sub(f.by_id) == ahead)
        };
        if !self.agree(case, followers.iter().map(says)) {
            return None;
        }
        let (camera_ns, due) = (case.frame.camera_ns?, case.table.time_ns(number)?);
        self.tracker = Some(Tracker::new(due, camera_ns));
        self.doubt = 0;
        let finding = Finding::ClockReset(residual.unwrap_or(0));
        Some(Match::Trigger(self.place(case.frame, number, Witness::Two, Some(finding))))
    }

    /// The frames behind, as far as their ids go on from this one's.
    fn followers<'a>(&self, case: &Case<'a>, tracker: &Tracker) -> Vec<Follower<'a>> {
        let follow = |frame: &'a Sighting| {
            let steps = self.ids.between(case.frame.id.0, frame.id.0);
            let by_id = case.by_id.checked_add(steps).filter(|_| steps > 0)?;
            let triggered = frame.camera_ns.map(|camera_ns| tracker.hsu_ns(camera_ns));
            let at = triggered.and_then(|ns| self.at_trigger(case, ns));
            Some(Follower { frame, by_id, triggered, ahead: at.map(|number| number.saturating_sub(by_id)) })
        };
        case.followers.iter().filter_map(follow).collect()
    }

    /// The reported trigger at a time.
    fn at_trigger(&self, case: &Case<'_>, hsu_ns: i128) -> Option<i64> {
        let (number, residual) = case.table.nearest(hsu_ns)?;
        (residual.abs() <= self.near_ns() && case.table.is_reported(number)).then_some(number)
    }

    /// Something that passed: its stamp alone was wrong, or its id was.
    fn passing(
        &mut self,
        case: &Case<'_>,
        own: Option<i64>,
        residual: Option<i128>,
        followers: &[Follower<'_>],
    ) -> Match {
        // However late it is and whatever becomes of it: how regular arrivals are is learned of all.
        if let Some(due) = case.table.reported_ns(case.by_id) {
            self.learn_latency(case, due);
        }
        let late =
            |number: i64| case.table.time_ns(number).and_then(|due| self.late_ns(case.frame, due, case.hsu));
        let half = i128::from(self.start.period_ns / 2);
        let punctual = |number: i64| late(number).is_some_and(|ns| ns.abs() <= half);
        // Nor are they early: ids and a clock that both stand a trigger too far agree with each other.
        let early = |f: &Follower<'_>| {
            let due = case.table.time_ns(f.by_id);
            due.and_then(|due| self.late_ns(f.frame, due, case.hsu)).is_some_and(|ns| ns < -half)
        };
        // A free trigger before its id's, where its stamp lies, would explain it with an arrival that is late.
        let earlier = own.is_some_and(|number| number < case.by_id && self.is_fresh(number));
        if earlier || followers.iter().any(early) {
            return self.give_up(case.frame);
        }
        let possible = self.is_fresh(case.by_id) && case.table.is_reported(case.by_id);
        // Late alone, in a doubtful time: its id and stamp agree, and those behind it are in time.
        let in_time = |f: &Follower<'_>| {
            let due = case.table.time_ns(f.by_id);
            due.and_then(|due| self.late_ns(f.frame, due, case.hsu)).is_some_and(|ns| ns.abs() <= half)
        };
        let agrees = residual.is_some_and(|ns| ns.abs() <= self.near_ns());
        if possible && agrees && followers.iter().any(in_time) {
            return self.accept(case, case.by_id, Witness::Two, None);
        }
        // No exposure between those before and behind it: its stamp is wrong for certain, and ids go on through it.
        let behind = followers.iter().find(|f| f.ahead == Some(0));
        let bounds = self.last.zip(behind).and_then(|(last, next)| {
            Some((case.table.time_ns(last.number)?.into(), case.table.time_ns(next.by_id)?.into()))
        });
        let apart = i128::from(self.start.period_ns / 16);
        let own_ns = residual.zip(case.table.time_ns(case.by_id)).map(|(ns, due)| ns + i128::from(due));
        let impossible = bounds.is_some_and(|(before, after): (i128, i128)| {
            own_ns.is_none_or(|ns| ns < before + apart || ns > after - apart)
        });
        let preceded =
            case.table.time_ns(case.by_id).is_some_and(|due| self.precedes(case.frame, due, case.hsu));
        // Packets are taken off the socket every 5 ms; a trigger later it would be a whole period.
        let in_time = late(case.by_id).is_none_or(|ns| (-half..=half * 3 / 2).contains(&ns));
        if possible && impossible && in_time && !preceded {
            let answer = self.accept(case, case.by_id, Witness::Two, Some(Finding::StampWrong(residual)));
            // A clock that was set just before a trigger was ignored looks the same.
            self.unsettled = self.clock.answers();
            return answer;
        }
        // Its id stood still: what its stamp and its arrival agree on.
        let own = own.filter(|_| !self.is_fresh(case.by_id));
        match own.filter(|number| self.is_fresh(*number) && punctual(*number)) {
            Some(number) => self.accept(case, number, Witness::Two, None),
            None => {
                self.unsettled = self.clock.answers();
                self.give_up(case.frame)
            }
        }
    }

    /// Whether the frames behind stand so many triggers further on than their ids.
    fn stand(&self, case: &Case<'_>, followers: &[Follower<'_>], ahead: i64) -> bool {
        self.agree(case, followers.iter().map(|f| f.ahead.map(|found| found == ahead)))
    }

    /// Whether the frames behind say so, from the first on: `Some(false)` is one that says otherwise.
    fn agree(&self, case: &Case<'_>, mut say: impl Iterator<Item = Option<bool>>) -> bool {
        let mut agreeing = 0;
        let against = say.any(|says| {
            agreeing += usize::from(says == Some(true));
            agreeing >= AGREEING || says == Some(false)
        });
        agreeing >= AGREEING || (agreeing > 0 && case.last_call && !against)
    }

    /// Whether the frames behind say that the clock was set and runs on: their stamps are off by as much as this one's.
    fn clock_agrees(&self, case: &Case<'_>, triggered: Option<i128>, followers: &[Follower<'_>]) -> bool {
        let off =
            |triggered: Option<i128>, by_id: i64| Some(triggered? - i128::from(case.table.time_ns(by_id)?));
        let Some(own) = off(triggered, case.by_id) else { return false };
        let slack = i128::from(self.start.period_ns / 16);
        let says = |f: &Follower<'_>| off(f.triggered, f.by_id).map(|ns| (ns - own).abs() <= slack);
        self.agree(case, followers.iter().map(says))
    }

    /// Whether a frame and those behind it come on time, were each the frame of a trigger so far beyond its id's.
    fn are_punctual(&self, case: &Case<'_>, followers: &[Follower<'_>], ahead: i64) -> bool {
        let half = i128::from(self.start.period_ns / 2);
        let late = |frame: &Sighting, by_id: i64| {
            let due = case.table.time_ns(by_id.checked_add(ahead)?)?;
            self.late_ns(frame, due, case.hsu)
        };
        let behind = || followers.iter().filter_map(|f| late(f.frame, f.by_id));
        late(case.frame, case.by_id).is_some_and(|ns| ns.abs() <= half)
            && behind().any(|ns| ns.abs() <= half)
            && behind().all(|ns| ns >= -half)
    }

    /// The ids go on, the clock does not: frames that agree teach its new relation.
    fn reset(&mut self, case: &Case<'_>, residual: Option<i128>) -> Match {
        let (Some(camera_ns), Some(due)) = (case.frame.camera_ns, case.table.time_ns(case.by_id)) else {
            return self.give_up(case.frame);
        };
        let in_time = self
            .late_ns(case.frame, due, case.hsu)
            .is_none_or(|ns| ns >= -i128::from(self.start.period_ns / 2));
        if !self.is_fresh(case.by_id) || !case.table.is_reported(case.by_id) || !in_time {
            return self.give_up(case.frame);
        }
        self.clock.was_set();
        self.tracker = Some(Tracker::new(due, camera_ns));
        let finding = Finding::ClockReset(residual.unwrap_or(0));
        Match::Trigger(self.place(case.frame, case.by_id, Witness::Two, Some(finding)))
    }

    /// Nothing explains it so far. With no more to come, id and arrival may still agree where the stamp is absurd.
    fn undecided(&mut self, case: &Case<'_>, followers: &[Follower<'_>]) -> Match {
        if !case.last_call && followers.len() < Self::FOLLOWERS {
            return Match::Wait;
        }
        let quarter = i128::from(self.start.period_ns / 4);
        let late = case.table.time_ns(case.by_id).and_then(|due| self.late_ns(case.frame, due, case.hsu));
        let own = case.frame.camera_ns.zip(self.tracker).map(|(ns, tracker)| tracker.hsu_ns(ns));
        let credible =
            own.zip(self.arrived_ns(case.frame.host_ns, case.hsu)).is_some_and(|(own, arrived)| {
                let usual = self.latency.usual_ns(self.start.period_ns).unwrap_or(0);
                (arrived - usual - own).abs() <= 4 * quarter
            });
        let alone = followers.is_empty() && !credible && !self.unsettled && self.is_fresh(case.by_id);
        if alone && case.table.is_reported(case.by_id) && late.is_some_and(|ns| ns.abs() <= quarter) {
            let finding = Finding::StampWrong(
                own.zip(case.table.time_ns(case.by_id)).map(|(own, due)| own - i128::from(due)),
            );
            return self.accept(case, case.by_id, Witness::Two, Some(finding));
        }
        self.unsettled = true;
        self.give_up(case.frame)
    }

    /// A camera without timestamps: id and arrival are its witnesses, and the frames behind must not arrive early.
    pub(super) fn by_arrivals(&mut self, case: &Case<'_>) -> Match {
        let late = |frame: &Sighting, number: i64| {
            case.table.time_ns(number).and_then(|due| self.late_ns(frame, due, case.hsu))
        };
        let behind = case.followers.iter().filter_map(|frame| {
            let steps = self.ids.between(case.frame.id.0, frame.id.0);
            late(frame, case.by_id.checked_add(steps).filter(|_| steps > 0)?)
        });
        let fits = self.is_fresh(case.by_id) && case.table.is_reported(case.by_id);
        let Some(own) = late(case.frame, case.by_id) else {
            // Arrivals are not regular: the id is the only witness.
            let due = case.table.time_ns(case.by_id);
            let early = due.is_none_or(|due| self.precedes(case.frame, due, case.hsu));
            return match fits && !early {
                true => self.accept(case, case.by_id, Witness::One, None),
                false => self.give_up(case.frame),
            };
        };
        // One that is late may be of a later trigger, if the camera ignored some.
        let quarter = i128::from(self.start.period_ns / 4);
        let (early, heard) =
            behind.fold((false, 0), |(early, heard), ns| (early || ns < -quarter, heard + 1));
        let in_time = own.abs() <= quarter && !early;
        if in_time && fits && heard == 0 && !case.last_call {
            return Match::Wait;
        }
        // One that was late and stands before an ignored trigger is in order with those behind it: after a frame that
        // was given up, the one before must be in order, too.
        let follows = self.follows(case.frame, in_time.then_some(case.by_id));
        if fits && in_time && (self.given_up == 0 || follows) {
            return self.accept(case, case.by_id, Witness::Two, None);
        }
        self.give_up(case.frame)
    }
}
