//! Which trigger a frame belongs to, by two witnesses: its block id and its timestamp.
//!
//! The block id counts frames that the camera made: a camera that ignored a trigger does not skip an id. The
//! timestamp, brought to the HSU's clock, names the trigger by its time. Where they disagree the timestamp wins as
//! long as its clock is believed, and the caller learns what happened. The arrival on the host is a third witness
//! that errs only towards late: it can refute a timestamp from the future, and bridge a clock that was reset.

use super::block_ids::BlockIds;
use super::clock::{ClockFit, Exchange, Judged};
use super::relation::{Anchor, Latency, Tracker};
use super::trigger_table::{Schedule, TriggerTable};

mod ruling;
mod sighting;
mod witnesses;

use ruling::{Claim, Ruling};
use witnesses::ByTime;

pub use sighting::{Finding, Match, Matched, Sighting, Witness};

/// What is known of a camera's clock before the first exchange.
#[derive(Debug, Clone, Copy, Default)]
pub struct ClockRelation {
    /// The camera's clock minus the HSU's, ns, where the camera's can be read.
    pub camera_minus_hsu_ns: Option<i128>,
    /// The HSU's clock minus the host's, ns.
    pub hsu_minus_host_ns: Option<i128>,
}

/// The last frame that got a trigger.
#[derive(Debug, Clone, Copy)]
struct Last {
    number: i64,
    camera_ns: Option<u64>,
    host_ns: u64,
}

/// Matches the frames of one camera, in the order in which they arrive.
#[derive(Debug)]
pub struct Matcher {
    period_ns: u64,
    clocks: ClockRelation,
    camera: ClockFit,
    tracker: Option<Tracker>,
    latency: Latency,
    ids: BlockIds,
    /// The trigger that the last id taken stands for.
    base: Option<i64>,
    /// Ids skipped before frames that were not recorded.
    lost_before: u64,
    last: Option<Last>,
    /// Frames were given up since the last one that got a trigger: ids alone prove nothing until one does.
    in_doubt: bool,
    /// The clock was set anew while in doubt: neither ids nor times prove anything until arrivals agree.
    anchor: Option<Anchor>,
}

/// A frame, and all there is to judge it by.
#[derive(Clone, Copy)]
struct Case<'a> {
    frame: &'a Sighting,
    /// The next frame with a timestamp that has arrived already.
    next: Option<&'a Sighting>,
    /// The trigger that its id points at.
    by_id: Option<i64>,
    /// The trigger that its arrival points at.
    arrival: Option<i64>,
    table: Schedule<'a>,
    /// The HSU's clock against the host's.
    hsu: &'a ClockFit,
    /// Whether there must be an answer.
    last_call: bool,
}

impl Matcher {
    /// With what is known of the clocks before the session.
    pub fn new(period_ns: u64, clocks: ClockRelation) -> Self {
        Self {
            period_ns: period_ns.max(1),
            clocks,
            camera: ClockFit::new(),
            tracker: None,
            latency: Latency::default(),
            ids: BlockIds::default(),
            base: None,
            lost_before: 0,
            last: None,
            in_doubt: false,
            anchor: None,
        }
    }

    /// Takes an exchange with the camera's clock into account.
    pub fn clock_sample(&mut self, exchange: &Exchange) -> Judged {
        let judged = self.camera.exchange(exchange);
        if let Judged::Reset { .. } = judged {
            self.tracker = None;
            self.clocks.camera_minus_hsu_ns = None;
        }
        judged
    }

    /// The camera's clock against the host's.
    pub fn clock(&self) -> &ClockFit {
        &self.camera
    }

    /// The camera is back with a fresh stream: what was known of its clock and ids ends here.
    pub fn restart(&mut self) {
        self.camera = ClockFit::new();
        self.tracker = None;
        self.latency = Latency::default();
        self.clocks.camera_minus_hsu_ns = None;
        self.ids = BlockIds::default();
        (self.base, self.lost_before, self.in_doubt) = (None, 0, false);
        self.anchor = None;
        self.last = self.last.map(|last| Last { camera_ns: None, ..last });
    }

    /// What a frame says of its trigger by itself: the number by its id, and the time (HSU clock, ns) by its timestamp.
    pub fn claim(&self, frame: &Sighting) -> Option<(i64, i128)> {
        let camera_ns = frame.camera_ns.filter(|_| frame.complete && self.anchor.is_none())?;
        let tracker = self.tracker.filter(|tracker| tracker.is_settled())?;
        let number = self.base?.checked_add(self.ids.step(frame.id)?)?;
        Some((number, tracker.hsu_ns(camera_ns)))
    }

    /// Names the trigger of `frame`. `next` is the next frame with a timestamp that has arrived already; `hsu` the
    /// HSU's clock against the host's. While the answer is [`Match::Wait`] nothing has changed: ask again with the
    /// same frame; with `last_call` there is always an answer.
    pub fn assign(
        &mut self,
        frame: &Sighting,
        next: Option<&Sighting>,
        table: &TriggerTable,
        hsu: &ClockFit,
        last_call: bool,
    ) -> Match {
        let step = self.ids.step(frame.id);
        if self.is_repeated(frame, step) {
            return Match::Repeated;
        }
        // Nothing that arrives was triggered later: so far the train is known even where its reports are held up.
        let now_ns = self.arrival_hsu_ns(frame.host_ns, hsu).filter(|_| last_call);
        let table = now_ns.map_or(table.reported(), |now| table.expected_until(now, self.period_ns));
        if table.is_empty() {
            return if last_call { Match::BeforeTrain } else { Match::Wait };
        }
        let by_id = self.base.zip(step).map(|(base, step)| base.saturating_add(step));
        let arrival = self.by_arrival(frame.host_ns, &table, hsu);
        let case = Case { frame, next, by_id, arrival, table, hsu, last_call };
        let Some(camera_ns) = frame.camera_ns else { return self.by_id_alone(&case) };
        if self.anchor.is_some() {
            return self.by_anchor(&case, camera_ns);
        }
        let stray = self.is_stray(&case);
        if let Some(by_id) = by_id.filter(|_| !stray && step > Some(0) && self.is_certainly_reset(frame)) {
            return self.reset(&case, camera_ns, by_id);
        }
        match self.by_time(camera_ns, frame.host_ns, &case) {
            ByTime::Trigger(number, residual) => self.by_both(case, camera_ns, number, residual),
            ByTime::Beyond if stray => Match::Stray,
            ByTime::Beyond => self.beyond(&case, camera_ns, now_ns.is_some()),
            ByTime::Unknown => self.by_id_alone(&case),
        }
    }

    /// The timestamp is later than all triggers that have been, or (`until_now`) can have been.
    fn beyond(&mut self, case: &Case<'_>, camera_ns: u64, until_now: bool) -> Match {
        let reported = case.by_id.filter(|id| case.table.time_ns(*id).is_some());
        let ahead = self.is_ahead(case, camera_ns);
        match (case.by_id, case.arrival) {
            // The trigger of its id has been reported, and its arrival confirms it: the time is wrong.
            (Some(id), arrival) if reported.is_some() && (arrival == Some(id) || ahead) => {
                self.reset(case, camera_ns, id)
            }
            _ if !case.last_call => Match::Wait,
            (Some(id), _) if self.in_doubt && ahead => self.reset(case, camera_ns, id),
            _ if until_now => self.undecided(case.frame),
            _ => self.by_id_alone(case),
        }
    }

    /// The timestamp points at a trigger, the id at the same one or not.
    fn by_both(&mut self, case: Case<'_>, camera_ns: u64, number: i64, residual: i128) -> Match {
        // In doubt, an extra frame's id may stand for the trigger before it.
        let near = if self.in_doubt { self.sharp_ns() } else { self.tolerance_ns() };
        if case.by_id == Some(number) && residual.abs() <= near {
            // Nothing arrives before its trigger: both witnesses go back to a frame that was late, and stood wrong.
            if self.precedes(&case, number) {
                let arrival = case.arrival.or_else(|| self.fired_before(&case));
                return self.reset(&Case { arrival, ..case }, camera_ns, number);
            }
            return self.accept(&case, number, Witness::Both, None);
        }
        let fits = residual.abs() <= self.tolerance_ns();
        let fresh = self.last.is_none_or(|last| number > last.number);
        let Some(id) = case.by_id else {
            return match (fits, fresh) {
                (true, true) => self.accept(&case, number, Witness::TimeOnly, None),
                (false, _) if case.table.time_ns(number - 1).is_none() && residual < 0 => Match::BeforeTrain,
                _ => self.spurious(case.frame, residual),
            };
        };
        if !case.frame.complete {
            return self.by_id_alone(&case);
        }
        if fresh && case.table.is_expected(number) {
            // A camera that ignored triggers, or a train that paused? Only the reports know.
            return self.undecided(case.frame);
        }
        if self.in_doubt && fresh && residual.abs() > self.sharp_ns() {
            return self.reset(&case, camera_ns, id);
        }
        if fits && fresh {
            let hsu_ns = i128::from(case.table.time_ns(number).unwrap_or(0)) + residual;
            return match self.rule(&Claim { id, number, hsu_ns, residual }, &case) {
                Ruling::Id => self.reset(&case, camera_ns, id),
                Ruling::Later if !case.last_call => Match::Wait,
                Ruling::Time | Ruling::Later => self.accept(&case, number, Witness::Both, None),
            };
        }
        match self.is_extra(&case, id, camera_ns) {
            Some(false) => self.reset(&case, camera_ns, id),
            None if !case.last_call => Match::Wait,
            _ => self.spurious(case.frame, residual),
        }
    }

    /// A frame without a timestamp that can be used.
    fn by_id_alone(&mut self, case: &Case<'_>) -> Match {
        if self.is_stray(case) {
            return Match::Stray;
        }
        if !case.last_call && case.by_id.is_none_or(|id| case.table.time_ns(id).is_none()) {
            return Match::Wait;
        }
        if self.in_doubt {
            return Match::Undecided;
        }
        // Without any witness it could be any trigger's.
        let Some(id) = case.by_id.or(case.arrival) else { return Match::Spurious(0) };
        let next = self.last.map_or(i64::MIN, |last| last.number.saturating_add(1));
        // Nothing arrives before its trigger.
        let number = case.arrival.filter(|arrival| *arrival < id).unwrap_or(id).max(next);
        Match::Trigger(self.place(case.frame, number, Witness::BlockIdOnly, None))
    }

    /// The ids go on, the clock does not: the id names the trigger, and the frame teaches the clock's new relation.
    fn reset(&mut self, case: &Case<'_>, camera_ns: u64, by_id: i64) -> Match {
        if self.in_doubt {
            self.forget_clock();
            self.anchor = Some(Anchor::default());
            return Match::Undecided;
        }
        let number = case.arrival.filter(|arrival| *arrival < by_id).unwrap_or(by_id);
        let Some(due) = case.table.time_ns(number) else {
            let case = Case { by_id: Some(by_id), ..*case };
            return if case.last_call { self.by_id_alone(&case) } else { Match::Wait };
        };
        let was = self.hsu_ns(camera_ns, case.frame.host_ns, case.hsu).unwrap_or(due.into());
        let step = was - i128::from(due);
        self.forget_clock();
        self.tracker = Some(Tracker::new(due, camera_ns));
        if self.last.is_some_and(|last| number <= last.number) {
            // A frame before it stood too far on and took this one's place: it is given up, the next ones stand right.
            self.saw(case.frame);
            self.ids.take(case.frame.id);
            (self.base, self.lost_before) = (Some(number), 0);
            return Match::Spurious(i64::try_from(step).unwrap_or(i64::MAX));
        }
        let finding = Some(Finding::ClockReset(step));
        Match::Trigger(self.place(case.frame, number, Witness::BlockIdOnly, finding))
    }

    fn forget_clock(&mut self) {
        self.camera = ClockFit::new();
        self.clocks.camera_minus_hsu_ns = None;
        self.tracker = None;
    }

    /// Notes when a frame without a trigger was exposed and came.
    fn saw(&mut self, frame: &Sighting) {
        let seen = |last: Last| Last { camera_ns: frame.camera_ns, host_ns: frame.host_ns, ..last };
        self.last = self.last.map(seen);
    }

    /// Given up: what it was is not to be known. Ids count on from the last frame that has a trigger.
    fn undecided(&mut self, frame: &Sighting) -> Match {
        self.in_doubt = true;
        self.saw(frame);
        Match::Undecided
    }

    /// Neither id nor clock can be believed: what new exchanges say, or what arrivals in a row agree on.
    fn by_anchor(&mut self, case: &Case<'_>, camera_ns: u64) -> Match {
        let Case { frame, table, hsu, .. } = *case;
        let slack_ns = i128::from(self.period_ns / 8);
        let latency = self.latency.usual_ns(self.period_ns).unwrap_or(i128::from(self.period_ns / 4));
        let fired = self.arrival_hsu_ns(frame.host_ns, hsu).filter(|_| frame.complete);
        let by_arrivals = fired.zip(self.anchor.as_mut()).and_then(|(arrived, anchor)| {
            Some(anchor.sighted(arrived - latency, camera_ns, slack_ns)? + i128::from(camera_ns))
        });
        let fresh = self.last.map_or(i64::MIN, |last| last.number.saturating_add(1));
        let at = self.by_fits(camera_ns, hsu).or(by_arrivals).and_then(|hsu_ns| table.nearest(hsu_ns));
        let at = at.filter(|(number, residual)| {
            *number >= fresh && !table.is_expected(*number) && residual.abs() <= self.tolerance_ns()
        });
        let Some((number, residual)) = at else { return Match::Undecided };
        self.accept(case, number, Witness::TimeOnly, Some(Finding::ClockReset(residual)))
    }

    fn accept(&mut self, case: &Case<'_>, number: i64, witness: Witness, finding: Option<Finding>) -> Match {
        let Case { frame, table, hsu, .. } = *case;
        // From times that are expected or inferred nothing is learned: they come from what was learned before.
        let reported = table.time_ns(number).filter(|_| table.is_reported(number));
        if let Some((due, camera_ns)) = reported.zip(frame.camera_ns) {
            let near = |tracker: &Tracker| {
                (tracker.hsu_ns(camera_ns) - i128::from(due)).abs() <= i128::from(self.period_ns / 2)
            };
            match self.tracker.as_mut().filter(|tracker| near(tracker)) {
                Some(tracker) => tracker.follow(due, camera_ns),
                None => self.tracker = Some(Tracker::new(due, camera_ns)),
            }
            let latency = self.arrival_hsu_ns(frame.host_ns, hsu).map(|arrived| arrived - i128::from(due));
            if let Some(latency) = latency.filter(|latency| *latency >= 0) {
                self.latency.follow(latency);
            }
        }
        Match::Trigger(self.place(frame, number, witness, finding))
    }

    /// Enters a frame at a trigger, and explains the triggers before it that have none.
    fn place(
        &mut self,
        frame: &Sighting,
        number: i64,
        witness: Witness,
        finding: Option<Finding>,
    ) -> Matched {
        let step = self.ids.step(frame.id).zip(self.base);
        let skipped = self.last.map_or(0, |last| (number - last.number - 1).max(0)) as u64;
        let (mut lost, mut ignored, mut finding) = (skipped, 0, finding);
        if let Some((step, base)) = step {
            let ids = self.lost_before.saturating_add_signed(step.saturating_sub(1).max(0));
            match base.saturating_add(step).saturating_sub(number) {
                0 => {}
                _ if step == 0 => finding = finding.or(Some(Finding::IdRepeated)),
                ahead if ahead > 0 || step < 0 => finding = finding.or(Some(Finding::IdJump(ahead))),
                _ => {
                    lost = ids.min(skipped);
                    ignored = skipped - lost;
                }
            }
        }
        self.ids.take(frame.id);
        (self.base, self.lost_before, self.in_doubt) = (Some(number), 0, false);
        self.anchor = None;
        let camera_ns = frame.camera_ns.or(self.last.and_then(|last| last.camera_ns));
        self.last = Some(Last { number, camera_ns, host_ns: frame.host_ns });
        Matched { number, witness, lost, ignored, finding }
    }

    /// A frame without a trigger has an id all the same: the next one follows on it.
    fn spurious(&mut self, frame: &Sighting, residual: i128) -> Match {
        if let Some((step, base)) = self.ids.step(frame.id).zip(self.base)
            && step > 0
        {
            self.lost_before = self.lost_before.saturating_add_signed(step - 1);
            self.base = Some(base.saturating_add(step - 1));
            self.ids.take(frame.id);
        }
        Match::Spurious(i64::try_from(residual).unwrap_or(i64::MAX))
    }
}

#[cfg(test)]
mod tests;
