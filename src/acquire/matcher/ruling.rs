//! Where id and timestamp contradict each other: which of the two is right.

use super::witnesses::ByTime;
use super::{Case, Matcher};

/// What id and time say of a frame, where they differ.
pub(super) struct Claim {
    pub(super) id: i64,
    pub(super) number: i64,
    /// Its timestamp on the HSU's clock, and how far after its trigger that is.
    pub(super) hsu_ns: i128,
    pub(super) residual: i128,
}

/// Which of the two is right.
pub(super) enum Ruling {
    Time,
    Id,
    /// What arrives next will tell.
    Later,
}

impl Matcher {
    /// Id and time name two different triggers, both of them possible. A frame may arrive late, and never early: a
    /// trigger that a frame would have preceded is refuted. A frame that is late by just so much that it fits the
    /// wrong trigger is not followed by another one that is: a late arrival passes, a clock that was set stays.
    pub(super) fn rule(&self, claim: &Claim, case: &Case<'_>) -> Ruling {
        let Case { frame, next, table, hsu, .. } = *case;
        let half = i128::from(self.period_ns / 2);
        let ahead = claim.number > claim.id;
        let Some(arrived) = self.usual_arrival(frame.host_ns, hsu) else {
            let early = ahead && self.precedes(case, claim.number);
            return if early { Ruling::Id } else { Ruling::Time };
        };
        if ahead && arrived + half < claim.hsu_ns {
            return Ruling::Id;
        }
        let due = match table.time_ns(claim.id) {
            Some(due) if ahead || arrived + half >= due.into() => i128::from(due),
            // Its arrival may still turn out to be as late as the id says.
            None if table.latest_ns().is_some_and(|latest| arrived > i128::from(latest) + half) => {
                return Ruling::Later;
            }
            _ => return Ruling::Time,
        };
        let Some((next, next_ns)) = next.and_then(|next| Some((next, next.camera_ns?))) else {
            return Ruling::Later;
        };
        let next_due = self.hsu_ns(next_ns, next.host_ns, hsu);
        let Some((by_time, next_arrived)) = next_due.zip(self.usual_arrival(next.host_ns, hsu)) else {
            return Ruling::Time;
        };
        // It is a witness only if its clock goes on from this frame's.
        let steps = i128::from(self.ids.between(frame.id.0, next.id.0));
        if (by_time - claim.hsu_ns - steps * i128::from(self.period_ns)).abs() > self.tight_ns() {
            return Ruling::Time;
        }
        // Were the id right, the clock was set, and the next frame's time is off by as much.
        let next_by_id = by_time - (claim.hsu_ns - due);
        let refuted = |due: i128| next_arrived + half < due;
        let on_time =
            |this: i128, next: i128| (arrived - this).abs() <= half && (next_arrived - next).abs() <= half;
        if refuted(next_by_id) || on_time(claim.hsu_ns, by_time) {
            return Ruling::Time;
        }
        if refuted(by_time) || on_time(due, next_by_id) {
            return Ruling::Id;
        }
        // Both arrived late. A clock that was set hardly points at a trigger as sharply as one that was not.
        if claim.residual.abs() <= self.sharp_ns() { Ruling::Time } else { Ruling::Id }
    }

    /// An extra frame, or the first one after the clock was set by little? The frame after it tells; `None` without one.
    pub(super) fn is_extra(&self, case: &Case<'_>, id: i64, camera_ns: u64) -> Option<bool> {
        let next = case.next?;
        let next_ns = next.camera_ns?;
        let next_id = id.saturating_add(self.ids.between(case.frame.id.0, next.id.0));
        let (due, next_due) = case.table.time_ns(id).zip(case.table.time_ns(next_id))?;
        let apart = i128::from(next_ns) - i128::from(camera_ns);
        let expected = i128::from(next_due) - i128::from(due);
        // Were it set, the next frame follows as its id says; were this one extra, the next is in time at its own trigger.
        let if_set = (apart - expected).abs();
        let if_extra = match self.by_time(next_ns, next.host_ns, case) {
            ByTime::Trigger(number, residual) if self.last.is_some_and(|last| number > last.number) => {
                residual.abs()
            }
            _ => i128::MAX,
        };
        Some(!(next_id > id && if_set <= self.tight_ns() && if_set < if_extra))
    }
}
