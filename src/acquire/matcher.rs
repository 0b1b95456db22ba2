//! Which trigger a frame belongs to, by two witnesses: its block id and its timestamp.
//!
//! The block id counts frames that the camera made: a camera that ignored a trigger does not skip an id. The
//! timestamp, brought to the HSU's clock, names the trigger by its time. Where they disagree the timestamp wins as
//! long as its clock is believed, and the caller learns what happened. The arrival on the host is a third witness
//! that errs only towards late: it can refute a timestamp from the future, and bridge a clock that was reset.

use super::block_ids::BlockIds;
use super::clock::{ClockFit, Exchange, Judged};
use super::relation::{Latency, Tracker};
use super::trigger_table::{Schedule, TriggerTable};

mod sighting;

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
}

/// More than arrivals can be late or early against each other, ns: a timestamp that runs ahead by more was reset.
const ARRIVAL_SLACK_NS: i128 = 500_000_000;
/// So long a tracker is believed without a frame before the fits are asked, ns.
const TRACKER_REACH_NS: i128 = 2_000_000_000;

/// Where a timestamp points.
enum ByTime {
    /// At a trigger, this far after it.
    Trigger(i64, i128),
    /// Later than every trigger reported so far.
    Beyond,
    /// The clocks' relation is not known.
    Unknown,
}

/// What id and time say of a frame, where they differ.
struct Claim {
    id: i64,
    number: i64,
    /// Its timestamp on the HSU's clock.
    hsu_ns: i128,
}

/// Which of the two is right.
enum Ruling {
    Time,
    Id,
    /// What arrives next will tell.
    Later,
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

    /// The camera is gone: what was known of its clock and ids ends here.
    pub fn lost(&mut self) {
        self.camera = ClockFit::new();
        self.restart();
    }

    /// The camera is back with a fresh stream.
    pub fn restart(&mut self) {
        self.tracker = None;
        self.latency = Latency::default();
        self.clocks.camera_minus_hsu_ns = None;
        self.ids = BlockIds::default();
        (self.base, self.lost_before) = (None, 0);
        self.last = self.last.map(|last| Last { camera_ns: None, ..last });
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
        let table = &now_ns.map_or(table.reported(), |now| table.expected_until(now, self.period_ns));
        if table.is_empty() {
            return if last_call { Match::BeforeTrain } else { Match::Wait };
        }
        let by_id = self.base.zip(step).map(|(base, step)| base.saturating_add(step));
        let arrival = self.by_arrival(frame.host_ns, table, hsu);
        let Some(camera_ns) = frame.camera_ns else {
            return self.by_id_alone(frame, by_id, arrival, table, hsu, last_call);
        };
        let stray = self.is_stray(frame, by_id, table, hsu);
        if let Some(by_id) = by_id.filter(|_| !stray && step > Some(0) && self.is_certainly_reset(frame)) {
            return self.reset(frame, camera_ns, by_id, arrival, table, hsu, last_call);
        }
        let (number, residual) = match self.by_time(camera_ns, frame.host_ns, table, hsu) {
            ByTime::Trigger(number, residual) => (number, residual),
            ByTime::Beyond if stray => return Match::Stray,
            ByTime::Beyond => match (by_id, arrival) {
                // The trigger of its id has been reported and its arrival confirms it: the time is wrong.
                (Some(id), Some(arrival)) if id == arrival && table.time_ns(id).is_some() => {
                    return self.reset(frame, camera_ns, id, Some(arrival), table, hsu, last_call);
                }
                (Some(id), _) if table.time_ns(id).is_some() && self.is_ahead(camera_ns, frame, hsu) => {
                    return self.reset(frame, camera_ns, id, arrival, table, hsu, last_call);
                }
                _ if !last_call => return Match::Wait,
                _ if now_ns.is_none() => return self.by_id_alone(frame, by_id, arrival, table, hsu, true),
                // Later than all triggers that can have been: of none of them.
                _ => return self.spurious(frame, i128::from(self.period_ns)),
            },
            ByTime::Unknown => return self.by_id_alone(frame, by_id, arrival, table, hsu, last_call),
        };
        if by_id == Some(number) && residual.abs() <= self.tolerance_ns() {
            // Nothing arrives before its trigger: both witnesses go back to a frame that was late, and stood wrong.
            if self.precedes(frame, number, table, hsu) {
                let arrival = arrival.or_else(|| self.fired_before(frame, table, hsu));
                return self.reset(frame, camera_ns, number, arrival, table, hsu, last_call);
            }
            return self.accept(frame, number, Witness::Both, None, table, hsu);
        }
        self.disagreement(frame, next, by_id, (number, residual), arrival, table, hsu, last_call)
    }

    /// The timestamp does not point at the trigger that the id points at, or at none.
    #[allow(clippy::too_many_arguments)]
    fn disagreement(
        &mut self,
        frame: &Sighting,
        next: Option<&Sighting>,
        by_id: Option<i64>,
        (number, residual): (i64, i128),
        arrival: Option<i64>,
        table: &Schedule<'_>,
        hsu: &ClockFit,
        last_call: bool,
    ) -> Match {
        let fits = residual.abs() <= self.tolerance_ns();
        let fresh = self.last.is_none_or(|last| number > last.number);
        let Some((id, camera_ns)) = by_id.zip(frame.camera_ns) else {
            return match (fits, fresh) {
                (true, true) => self.accept(frame, number, Witness::TimeOnly, None, table, hsu),
                (true, false) => self.spurious(frame, residual),
                (false, _) if table.time_ns(number - 1).is_none() && residual < 0 => Match::BeforeTrain,
                (false, _) => self.spurious(frame, residual),
            };
        };
        if !frame.complete {
            return self.by_id_alone(frame, by_id, arrival, table, hsu, last_call);
        }
        if table.is_expected(number.max(id)) && self.ids.step(frame.id) == Some(1) {
            // A train may pause: what is only expected confirms an id, and does not overrule the next one.
            return self.by_id_alone(frame, by_id, None, table, hsu, last_call);
        }
        if fits && fresh {
            let claim =
                Claim { id, number, hsu_ns: i128::from(table.time_ns(number).unwrap_or(0)) + residual };
            return match self.rule(&claim, frame, next, table, hsu) {
                Ruling::Id => self.reset(frame, camera_ns, id, arrival, table, hsu, last_call),
                Ruling::Later if !last_call => Match::Wait,
                Ruling::Time | Ruling::Later => self.accept(frame, number, Witness::Both, None, table, hsu),
            };
        }
        // An extra frame, or the first one after the clock was set by little: the frame after it tells.
        let Some((next, next_ns)) = next.and_then(|next| Some((next, next.camera_ns?))) else {
            return if last_call { self.spurious(frame, residual) } else { Match::Wait };
        };
        let next_id = id.saturating_add(self.ids.between(frame.id.0, next.id.0));
        let Some((due, next_due)) = table.time_ns(id).zip(table.time_ns(next_id)) else {
            return if last_call { self.spurious(frame, residual) } else { Match::Wait };
        };
        let apart = i128::from(next_ns) - i128::from(camera_ns);
        let expected = i128::from(next_due) - i128::from(due);
        // Were it set, the next frame follows as its id says; were this one extra, the next is in time at its own trigger.
        let if_set = (apart - expected).abs();
        let if_extra = match self.by_time(next_ns, next.host_ns, table, hsu) {
            ByTime::Trigger(number, residual) if self.last.is_some_and(|last| number > last.number) => {
                residual.abs()
            }
            _ => i128::MAX,
        };
        if next_id > id && if_set <= self.tight_ns() && if_set < if_extra {
            return self.reset(frame, camera_ns, id, arrival, table, hsu, last_call);
        }
        self.spurious(frame, residual)
    }

    /// Id and time name two different triggers, both of them possible. A frame may arrive late, and never early: a
    /// trigger that a frame would have preceded is refuted. A frame that is late by just so much that it fits the
    /// wrong trigger is not followed by another one that is: a late arrival passes, a clock that was set stays.
    fn rule(
        &self,
        claim: &Claim,
        frame: &Sighting,
        next: Option<&Sighting>,
        table: &Schedule<'_>,
        hsu: &ClockFit,
    ) -> Ruling {
        let half = i128::from(self.period_ns / 2);
        let ahead = claim.number > claim.id;
        let Some(arrived) = self.usual_arrival(frame.host_ns, hsu) else {
            let early = ahead && self.precedes(frame, claim.number, table, hsu);
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
        let Some((by_time, arrived)) = next_due.zip(self.usual_arrival(next.host_ns, hsu)) else {
            return Ruling::Time;
        };
        // It is a witness only if its clock goes on from this frame's.
        let steps = i128::from(self.ids.between(frame.id.0, next.id.0));
        if (by_time - claim.hsu_ns - steps * i128::from(self.period_ns)).abs() > self.tight_ns() {
            return Ruling::Time;
        }
        // Were the id right, the clock was set, and the next frame's time is off by as much.
        let by_id = by_time - (claim.hsu_ns - due);
        let refuted = |due: i128| arrived + half < due;
        if !refuted(by_id) && (refuted(by_time) || !ahead) { Ruling::Id } else { Ruling::Time }
    }

    fn is_repeated(&self, frame: &Sighting, step: Option<i64>) -> bool {
        let Some((last, step)) = self.last.zip(step) else { return false };
        match frame.camera_ns.zip(last.camera_ns) {
            Some((now, before)) => (step == 0 && now == before) || (step < 0 && now < before),
            None => step <= 0,
        }
    }

    /// A clock that went back, or ran ahead of all arrivals, while the ids went on.
    fn is_certainly_reset(&self, frame: &Sighting) -> bool {
        let Some(last) = self.last else { return false };
        let Some((now, before)) = frame.camera_ns.zip(last.camera_ns) else { return false };
        let camera = i128::from(now) - i128::from(before);
        camera <= 0 || camera - (i128::from(frame.host_ns) - i128::from(last.host_ns)) > ARRIVAL_SLACK_NS
    }

    /// A quarter of a period once frames have taught the clocks' relation, half a period before.
    fn tolerance_ns(&self) -> i128 {
        let settled = self.tracker.is_some_and(|tracker| tracker.is_settled());
        i128::from(self.period_ns) / if settled { 4 } else { 2 }
    }

    fn tight_ns(&self) -> i128 {
        let spread = self.tracker.map_or(0.0, |tracker| tracker.spread_ns);
        (i128::from(self.period_ns) / 16).max((spread * 6.0) as i128).min(self.tolerance_ns())
    }

    fn by_time(&self, camera_ns: u64, host_ns: u64, table: &Schedule<'_>, hsu: &ClockFit) -> ByTime {
        let Some(hsu_ns) = self.hsu_ns(camera_ns, host_ns, hsu) else { return ByTime::Unknown };
        let half = i128::from(self.period_ns / 2);
        match table.nearest(hsu_ns).zip(table.latest_ns()) {
            Some((_, latest)) if hsu_ns > i128::from(latest) + half => ByTime::Beyond,
            Some(((number, residual), _)) => ByTime::Trigger(number, residual),
            None => ByTime::Beyond,
        }
    }

    /// A frame's time on the HSU's clock: by the frames before it, else by the fits, else by what was measured
    /// before the session, else by its arrival.
    fn hsu_ns(&self, camera_ns: u64, host_ns: u64, hsu: &ClockFit) -> Option<i128> {
        let fits = self.by_fits(camera_ns, hsu);
        if let Some(tracker) = &self.tracker {
            let tracked = tracker.hsu_ns(camera_ns);
            let near = (tracked - tracker.last_hsu_ns()).abs() <= TRACKER_REACH_NS;
            let contradicted = self.camera.used() >= 3
                && fits.is_some_and(|fits| (fits - tracked).abs() > i128::from(self.period_ns) * 3 / 4);
            if !contradicted && (near || fits.is_none()) {
                return Some(tracked);
            }
        }
        let measured = self.clocks.camera_minus_hsu_ns.map(|offset| i128::from(camera_ns) - offset);
        let arrived = || Some(self.arrival_hsu_ns(host_ns, hsu)? - i128::from(self.period_ns / 4));
        fits.or(measured).or_else(arrived)
    }

    fn by_fits(&self, camera_ns: u64, hsu: &ClockFit) -> Option<i128> {
        let host_ns = self.camera.host_from_device(camera_ns.into())?;
        let hsu_ns = hsu.device_from_host(host_ns)?;
        let unsure =
            self.camera.uncertainty_ns(camera_ns.into())?.saturating_add(hsu.uncertainty_ns(hsu_ns)?);
        (unsure < self.period_ns / 3).then_some(hsu_ns)
    }

    fn arrival_hsu_ns(&self, host_ns: u64, hsu: &ClockFit) -> Option<i128> {
        let measured = || Some(i128::from(host_ns) + self.clocks.hsu_minus_host_ns?);
        hsu.device_from_host(host_ns.into()).or_else(measured)
    }

    /// The trigger that its arrival points at, where arrivals are regular.
    fn by_arrival(&self, host_ns: u64, table: &Schedule<'_>, hsu: &ClockFit) -> Option<i64> {
        let hsu_ns = self.usual_arrival(host_ns, hsu)?;
        let near = |(_, residual): &(i64, i128)| residual.abs() <= i128::from(self.period_ns / 2);
        table.nearest(hsu_ns).filter(near).map(|(number, _)| number)
    }

    /// When a frame's trigger was fired if it took the usual time to arrive, HSU time, where arrivals are regular.
    fn usual_arrival(&self, host_ns: u64, hsu: &ClockFit) -> Option<i128> {
        Some(self.arrival_hsu_ns(host_ns, hsu)? - self.latency.usual_ns(self.period_ns)?)
    }

    /// Whether a timestamp says that the frame was exposed after it arrived.
    fn is_ahead(&self, camera_ns: u64, frame: &Sighting, hsu: &ClockFit) -> bool {
        let arrived = self.arrival_hsu_ns(frame.host_ns, hsu);
        let exposed = self.tracker.map(|tracker| tracker.hsu_ns(camera_ns));
        arrived.zip(exposed).is_some_and(|(arrived, exposed)| exposed > arrived + i128::from(self.period_ns))
    }

    /// Whether a frame arrived before a trigger was fired.
    fn precedes(&self, frame: &Sighting, number: i64, table: &Schedule<'_>, hsu: &ClockFit) -> bool {
        let arrived = self.arrival_hsu_ns(frame.host_ns, hsu).zip(table.time_ns(number));
        arrived.is_some_and(|(arrived, due)| arrived + i128::from(self.period_ns / 8) < due.into())
    }

    /// The latest trigger that was fired before a frame arrived.
    fn fired_before(&self, frame: &Sighting, table: &Schedule<'_>, hsu: &ClockFit) -> Option<i64> {
        let (number, residual) = table.nearest(self.arrival_hsu_ns(frame.host_ns, hsu)?)?;
        Some(if residual < 0 { number - 1 } else { number })
    }

    /// Whether the trigger of this number had not been fired yet when a frame arrived, by several periods.
    fn is_yet_to_come(&self, number: i64, frame: &Sighting, table: &Schedule<'_>, hsu: &ClockFit) -> bool {
        const PERIODS: i128 = 3;
        let ahead = number.saturating_sub(table.end().saturating_sub(1));
        let arrived = self.arrival_hsu_ns(frame.host_ns, hsu);
        let Some((arrived, latest)) = arrived.zip(table.latest_ns()).filter(|_| ahead > 0) else {
            return false;
        };
        // Triggers come no faster than 8/7 of the rate (`hsu-protocol.md`, invariant 5).
        let due = i128::from(latest) + i128::from(ahead) * i128::from(self.period_ns) * 7 / 8;
        arrived + PERIODS * i128::from(self.period_ns) < due
    }

    /// Whether a torn frame has an id that is not due. Whoever sent it, ids and triggers go on without it; was it the
    /// camera after all, the next frame says so.
    fn is_stray(&self, frame: &Sighting, by_id: Option<i64>, table: &Schedule<'_>, hsu: &ClockFit) -> bool {
        let settled = |id: i64| self.last.is_some_and(|last| id <= last.number);
        let stray = |id: i64| settled(id) || self.is_yet_to_come(id, frame, table, hsu);
        !frame.complete && by_id.is_some_and(stray)
    }

    /// A frame without a timestamp that can be used.
    fn by_id_alone(
        &mut self,
        frame: &Sighting,
        by_id: Option<i64>,
        arrival: Option<i64>,
        table: &Schedule<'_>,
        hsu: &ClockFit,
        last_call: bool,
    ) -> Match {
        if self.is_stray(frame, by_id, table, hsu) {
            return Match::Stray;
        }
        if !last_call && by_id.is_none_or(|id| table.time_ns(id).is_none()) {
            return Match::Wait;
        }
        // Without any witness it could be any trigger's.
        let Some(id) = by_id.or(arrival) else { return Match::Spurious(0) };
        let next = self.last.map_or(i64::MIN, |last| last.number.saturating_add(1));
        // Nothing arrives before its trigger.
        let number = arrival.filter(|arrival| *arrival < id).unwrap_or(id).max(next);
        let matched = self.place(frame, number, Witness::BlockIdOnly, None);
        Match::Trigger(matched)
    }

    /// The ids go on, the clock does not: the id names the trigger, and the frame teaches the clock's new relation.
    #[allow(clippy::too_many_arguments)]
    fn reset(
        &mut self,
        frame: &Sighting,
        camera_ns: u64,
        by_id: i64,
        arrival: Option<i64>,
        table: &Schedule<'_>,
        hsu: &ClockFit,
        last_call: bool,
    ) -> Match {
        let number = arrival.filter(|arrival| *arrival < by_id).unwrap_or(by_id);
        let Some(due) = table.time_ns(number) else {
            return if last_call {
                self.by_id_alone(frame, Some(by_id), arrival, table, hsu, true)
            } else {
                Match::Wait
            };
        };
        let was = self.hsu_ns(camera_ns, frame.host_ns, hsu).unwrap_or(due.into());
        let step = was - i128::from(due);
        self.camera = ClockFit::new();
        self.clocks.camera_minus_hsu_ns = None;
        self.tracker = Some(Tracker::new(due, camera_ns));
        if self.last.is_some_and(|last| number <= last.number) {
            // A frame before it stood too far on and took this one's place: it is given up, the next ones stand right.
            let camera_ns = Some(camera_ns);
            self.last = self.last.map(|last| Last { camera_ns, host_ns: frame.host_ns, ..last });
            self.ids.take(frame.id);
            (self.base, self.lost_before) = (Some(number), 0);
            return Match::Spurious(i64::try_from(step).unwrap_or(i64::MAX));
        }
        Match::Trigger(self.place(frame, number, Witness::BlockIdOnly, Some(Finding::ClockReset(step))))
    }

    fn accept(
        &mut self,
        frame: &Sighting,
        number: i64,
        witness: Witness,
        finding: Option<Finding>,
        table: &Schedule<'_>,
        hsu: &ClockFit,
    ) -> Match {
        // From times that are only expected nothing is learned: a train may pause.
        let reported = table.time_ns(number).filter(|_| !table.is_expected(number));
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
        (self.base, self.lost_before) = (Some(number), 0);
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
