// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which trigger a frame belongs to, by three witnesses: its block id, its timestamp, and its arrival.
//!
//! * The **block id** counts what the camera sent: one that ignored a trigger does not skip an id. Its beginning is
//!   known, because an armed stream is silent until the train starts ([`anchor`]).
//! * The **timestamp**, brought to the HSU's clock by the frames before it, names the trigger by its time. How long
//!   after a trigger a camera stamps is measured with the first frames.
//! * The **arrival** on the host errs towards late only; how late it usually is, is measured likewise.
//!
//! A frame is filed where two of them agree. Where id and timestamp disagree, the frames behind it and a reading of the
//! camera's clock ([`reading`]) say what happened ([`contradiction`]); where nothing says so, the frame is given up,
//! never guessed.

pub mod anchor;
pub mod block_ids;
mod clock_relation;
mod contradiction;
mod reading;
mod rejoin;
mod sighting;
pub mod trigger_table;

pub use sighting::{Finding, Match, Matched, Sighting, Witness};

use crate::base::clock_fit::{ClockFit, Exchange, Judged};
use crate::base::ids::BlockId;
use anchor::{Anchoring, Early};
use block_ids::BlockIds;
use clock_relation::{Latency, Tracker};
use reading::{CameraClock, LATE_PERIODS};
use trigger_table::{Schedule, TriggerTable};

/// So long a tracker is believed without a frame before the clock's fit is asked, ns.
const TRACKER_REACH_NS: i128 = 2_000_000_000;
/// After a contradiction, so many frames are looked at closely.
const DOUBT: u32 = 16;
/// So many frames given up in a row mean that what is known of ids and clock is wrong.
const GIVEN_UP_MAX: u32 = 8;

/// What is known before a camera's first frame.
#[derive(Debug, Clone, Copy, Default)]
pub struct Start {
    /// Trigger period, ns.
    pub period_ns: u64,
    /// Triggers of the warm-up: the first trigger has this number, negative.
    pub warm_up: u32,
    /// The HSU's clock minus the host's, ns, where exchanges before the session said so.
    pub hsu_minus_host_ns: Option<i128>,
}

/// The last frame that got a trigger.
#[derive(Debug, Clone, Copy)]
struct Last {
    number: i64,
    camera_ns: Option<u64>,
}

/// How far a stream's identity is known.
#[derive(Debug)]
enum Stage {
    /// The train is about to begin, or in its warm-up; so many ids after the first.
    Beginning(Anchoring, Option<i64>),
    /// Ids count from a known trigger.
    Known,
    /// The camera is back, or nothing fitted any more.
    Lost(rejoin::Rejoin),
}

/// Matches the frames of one camera, in the order in which they arrive.
#[derive(Debug)]
pub struct Matcher {
    start: Start,
    stage: Stage,
    clock: CameraClock,
    tracker: Option<Tracker>,
    latency: Latency,
    ids: BlockIds,
    /// The trigger that the last id taken stands for.
    base: i64,
    /// Ids skipped before frames that were not recorded.
    lost_before: u64,
    last: Option<Last>,
    given_up: u32,
    /// So many frames must still be in order before arrivals need not confirm id and stamp any more.
    doubt: u32,
    /// The trigger that a given-up frame's arrival named.
    arrived: Option<(BlockId, i64)>,
    /// What happened to ids and clock could not be told: that they agree with each other proves nothing.
    unsettled: bool,
}

/// A frame, and all there is to judge it by.
#[derive(Clone, Copy)]
struct Case<'a> {
    frame: &'a Sighting,
    /// Whole frames that have arrived behind it, in order.
    followers: &'a [Sighting],
    /// The trigger that its id points at.
    by_id: i64,
    table: Schedule<'a>,
    /// The HSU's clock against the host's.
    hsu: &'a ClockFit,
    /// Whether there must be an answer.
    last_call: bool,
}

impl Matcher {
    /// Of the frames behind the one in question, so many are of use.
    pub const FOLLOWERS: usize = 6;

    /// Before the session.
    pub fn new(start: Start) -> Self {
        let period_ns = start.period_ns.max(16);
        Self {
            start: Start { period_ns, ..start },
            stage: Stage::Beginning(Anchoring::default(), None),
            clock: CameraClock::new(period_ns),
            tracker: None,
            latency: Latency::default(),
            ids: BlockIds::default(),
            base: 0,
            lost_before: 0,
            last: None,
            given_up: 0,
            doubt: 0,
            arrived: None,
            unsettled: false,
        }
    }

    /// Takes an exchange with the camera's clock into account. What it says of a clock that was set anew is believed
    /// of frames that are in doubt.
    pub fn clock_sample(&mut self, exchange: &Exchange) -> Judged {
        self.clock.exchange(exchange)
    }

    /// Whether a frame waits for a reading of the camera's clock, since it was asked last.
    pub fn takes_clock_wish(&mut self) -> bool {
        self.clock.takes_wish()
    }

    /// The camera's clock against the host's.
    pub fn clock(&self) -> &ClockFit {
        &self.clock.fit
    }

    /// The camera is back with a fresh stream: ids begin anew, its clock may have been set. How long it takes to stamp
    /// a frame and to send it stays.
    pub fn restart(&mut self, train_began: bool) {
        self.clock.restart();
        self.ids = BlockIds::default();
        self.lost_before = 0;
        self.unsettled = false;
        self.stage = match train_began {
            true => Stage::Lost(rejoin::Rejoin { before: self.tracker.take() }),
            false => Stage::Beginning(Anchoring::default(), None),
        };
        (self.given_up, self.arrived) = (0, None);
        self.last = self.last.map(|last| Last { camera_ns: None, ..last });
    }

    /// What a frame says of its trigger by itself: the number by its id, and the time (HSU clock, ns) by its timestamp.
    pub fn claim(&self, frame: &Sighting) -> Option<(i64, i128)> {
        let known = matches!(self.stage, Stage::Known) && frame.complete;
        let camera_ns = frame.camera_ns.filter(|_| known)?;
        let tracker = self.tracker.filter(|tracker| tracker.is_settled())?;
        let number = self.base.checked_add(self.ids.step(frame.id)?)?;
        Some((number, tracker.hsu_ns(camera_ns)))
    }

    /// Whether it is known which trigger the stream's ids stand for.
    pub fn is_placed(&self) -> bool {
        matches!(self.stage, Stage::Known)
    }

    /// Names the trigger of `frame`. `followers` are the whole frames that have arrived behind it, in order; `hsu` is
    /// the HSU's clock against the host's. While the answer is [`Match::Wait`] nothing has changed: ask again with the
    /// same frame; with `last_call` there is always an answer.
    pub fn assign(
        &mut self,
        frame: &Sighting,
        followers: &[Sighting],
        table: &TriggerTable,
        hsu: &ClockFit,
        last_call: bool,
    ) -> Match {
        self.clock.measure(hsu);
        let step = self.ids.step(frame.id);
        if self.is_repeated(frame, step) {
            return Match::Repeated;
        }
        if table.is_empty() {
            return if last_call { Match::BeforeTrain } else { Match::Wait };
        }
        if matches!(self.stage, Stage::Beginning(..))
            && let Some(answer) = self.begin(frame, table, hsu, last_call)
        {
            return answer;
        }
        // Nothing that arrives was triggered later: so far the train is known even where its reports are held up.
        let now_ns = self.arrived_ns(frame.host_ns, hsu).filter(|_| last_call);
        let period_ns = self.start.period_ns;
        let table = now_ns.map_or(table.reported(), |now| table.expected_until(now, period_ns));
        let by_id = self.base.saturating_add(step.unwrap_or(0));
        let case = Case { frame, followers, by_id, table, hsu, last_call };
        if matches!(self.stage, Stage::Lost(_)) {
            return self.rejoin(&case);
        }
        let answer = if frame.complete { self.whole(&case) } else { self.torn(&case) };
        if answer == Match::Undecided && self.given_up >= GIVEN_UP_MAX {
            self.stage = Stage::Lost(rejoin::Rejoin { before: self.tracker.take() });
        }
        answer
    }

    /// A frame of a stream whose place in the train is not settled yet; `None` once it is, by the frames of the warm-up alone.
    fn begin(
        &mut self,
        frame: &Sighting,
        table: &TriggerTable,
        hsu: &ClockFit,
        last_call: bool,
    ) -> Option<Match> {
        let period_ns = self.start.period_ns;
        let arrived = self.arrived_ns(frame.host_ns, hsu);
        let first = -i64::from(self.start.warm_up);
        let Stage::Beginning(anchoring, count) = &mut self.stage else { return Some(Match::Wait) };
        let next = count.map_or(0, |count: i64| count.saturating_add(self.ids.step(frame.id).unwrap_or(1)));
        let provisional = first.saturating_add(next);
        if table.reported_ns(provisional).is_none() && !last_call {
            return Some(Match::Wait);
        }
        if count.is_some() && anchoring.is_copy(frame, next) {
            return Some(Match::Repeated);
        }
        let before = |due: u64| arrived.is_some_and(|ns| ns + i128::from(period_ns / 8) < due.into());
        if count.is_none() && table.time_ns(first).is_some_and(before) {
            return Some(Match::BeforeTrain);
        }
        // Whether the rhythm is over, and all of it is reported: what it does not tell then is not to be known any more.
        let warm_up = i64::from(self.start.warm_up);
        let told = (first..warm_up).all(|number| table.reported_ns(number).is_some());
        if let Some(before) = *count
            && provisional > warm_up
        {
            // Its reports were held up for so long that its frames could not be told then.
            if let Some(place) = anchoring.place(first, table, period_ns).filter(|place| place.confirmed) {
                self.settle_late(place, before, table);
                return None;
            }
            *count = Some(next);
            self.ids.take(frame.id);
            if told {
                self.stage = Stage::Lost(rejoin::Rejoin { before: None });
            }
            return Some(self.give_up(frame));
        }
        self.ids.take(frame.id);
        *count = Some(next);
        if frame.complete {
            anchoring.add(Early::of(frame, next, arrived));
        }
        let place = anchoring.place(first, table, period_ns);
        // Where there is a rhythm, it must be heard.
        let place = place.filter(|place| place.confirmed || !table.has_rhythm(first, period_ns));
        let number = place.map_or(provisional, |place| next.saturating_add(place.offset));
        let settled = place.filter(|place| place.confirmed || number >= 0);
        if let Some(place) = settled {
            let anchoring = std::mem::take(anchoring);
            self.settle(&anchoring, place, table);
            let witness = if place.confirmed { Witness::Two } else { Witness::One };
            (self.base, self.stage, self.given_up) = (number, Stage::Known, 0);
            self.last = Some(Last { number, camera_ns: frame.camera_ns });
            return Some(Match::Trigger(Matched { number, witness, lost: 0, ignored: 0, finding: None }));
        }
        if number >= 0 {
            if provisional >= warm_up && told {
                self.stage = Stage::Lost(rejoin::Rejoin { before: None });
            }
            return Some(self.give_up(frame));
        }
        Some(Match::Trigger(Matched { number, witness: Witness::Two, lost: 0, ignored: 0, finding: None }))
    }

    /// The warm-up tells the place, many frames later: those that come now are judged as all others, and by their arrivals, too.
    fn settle_late(&mut self, place: anchor::Place, count: i64, table: &TriggerTable) {
        let Stage::Beginning(anchoring, _) = std::mem::replace(&mut self.stage, Stage::Known) else { return };
        self.settle(&anchoring, place, table);
        (self.base, self.given_up, self.doubt) = (count.saturating_add(place.offset), 0, DOUBT);
        self.last = anchoring.last().map(|frame| {
            let number = frame.count.saturating_add(place.offset);
            Last { number, camera_ns: frame.camera_ns }
        });
    }

    /// Learns from the warm-up how the camera's clock runs, and how long its frames take to arrive.
    fn settle(&mut self, anchoring: &Anchoring, place: anchor::Place, table: &TriggerTable) {
        for (_, due, frame) in anchoring.explained(place, table, self.start.period_ns) {
            if let Some(camera_ns) = frame.camera_ns.filter(|_| anchoring.has_stamps()) {
                Tracker::learn(&mut self.tracker, due, camera_ns);
            }
            if let Some(arrived) = frame.arrived_ns {
                self.latency.follow(arrived - i128::from(due));
            }
        }
        self.clock.ask();
    }

    /// A frame that arrived whole, of a stream whose ids count from a known trigger.
    fn whole(&mut self, case: &Case<'_>) -> Match {
        let due = case.table.time_ns(case.by_id);
        if due.is_none() && !case.last_call {
            return Match::Wait;
        }
        let Some(tracker) = self.tracker else { return self.by_arrivals(case) };
        let exposed = self.triggered_ns(&tracker, case.frame, case.hsu);
        let agrees = |(exposed, due): (i128, u64)| (exposed - i128::from(due)).abs() <= self.near_ns();
        let agree = exposed.zip(due).is_some_and(agrees);
        if agree && self.unsettled && self.awaits_reading(case) {
            return Match::Wait;
        }
        if agree && self.is_fresh(case.by_id) && !self.is_refuted(case, due) && self.is_settled(case) {
            self.doubt = self.doubt.saturating_sub(1);
            return self.accept(case, case.by_id, Witness::Two, None);
        }
        self.doubt = DOUBT;
        self.contradiction(case, exposed)
    }

    /// Whether the arrival speaks against a frame's id and clock: in a doubtful time it must be in time.
    fn is_refuted(&self, case: &Case<'_>, due: Option<u64>) -> bool {
        let Some(due) = due else { return false };
        let half = i128::from(self.start.period_ns / 2);
        let late = || self.late_ns(case.frame, due, case.hsu);
        (self.doubt > 0 && late().is_some_and(|ns| ns.abs() > half))
            || self.precedes(case.frame, due, case.hsu)
    }

    /// Whether id and clock may be believed where they agree: nothing unexplained has happened to them since the last
    /// frame, or else the clock's readings or the arrival confirm them.
    fn is_settled(&self, case: &Case<'_>) -> bool {
        let half = i128::from(self.start.period_ns / 2);
        let late = || self.late_ns(case.frame, case.table.time_ns(case.by_id)?, case.hsu);
        !self.unsettled
            || match self.clock.read_fired_ns(case.frame, case.hsu) {
                Some(_) => self.read_trigger(case, case.frame) == Some(case.by_id),
                None => late().is_some_and(|ns| ns.abs() <= half),
            }
    }

    /// Parts of a frame: no pixels are recorded of it, and its id says which frame is missing.
    fn torn(&mut self, case: &Case<'_>) -> Match {
        let Some(due) = case.table.time_ns(case.by_id) else {
            let ahead = self.arrived_ns(case.frame.host_ns, case.hsu).zip(case.table.latest_ns());
            let period_ns = i128::from(self.start.period_ns);
            // Triggers come no faster than 8/7 of the rate (`hsu-protocol.md`, invariant 5).
            let triggers = i128::from(case.by_id.saturating_sub(case.table.end()));
            let yet = |(now, latest): (i128, u64)| {
                now + 3 * period_ns < i128::from(latest) + triggers * period_ns * 7 / 8
            };
            return match ahead.is_some_and(yet) {
                true => Match::Stray,
                false if case.last_call => self.give_up(case.frame),
                false => Match::Wait,
            };
        };
        if !self.is_fresh(case.by_id) || self.precedes(case.frame, due, case.hsu) {
            return Match::Stray;
        }
        Match::Trigger(self.place(case.frame, case.by_id, Witness::Two, None))
    }

    fn is_fresh(&self, number: i64) -> bool {
        self.last.is_none_or(|last| number > last.number)
    }

    /// What the residuals of an unchanged clock do not exceed, ns.
    fn near_ns(&self) -> i128 {
        let period_ns = i128::from(self.start.period_ns);
        let spread = self.tracker.map_or(0.0, |tracker| tracker.spread_ns);
        (period_ns / 16).max((spread * 6.0) as i128).min(period_ns / 4)
    }

    /// When a frame's trigger was fired by its timestamp, HSU time: by the frames before it, or where these are long
    /// ago, by the clock's fit.
    fn triggered_ns(&self, tracker: &Tracker, frame: &Sighting, hsu: &ClockFit) -> Option<i128> {
        let tracked = tracker.hsu_ns(frame.camera_ns?);
        if (tracked - tracker.last_hsu_ns()).abs() <= TRACKER_REACH_NS {
            return Some(tracked);
        }
        self.clock.fired_ns(frame, hsu).or(Some(tracked))
    }

    /// Whether a reading of the camera's clock is still to be had for this frame; if so it is asked for.
    fn awaits_reading(&mut self, case: &Case<'_>) -> bool {
        !case.last_call && self.clock.awaits(case.frame, case.hsu)
    }

    /// The reported trigger of a timestamp by readings of the camera's clock, if the frame can have come from there.
    fn read_trigger(&self, case: &Case<'_>, frame: &Sighting) -> Option<i64> {
        let period_ns = i128::from(self.start.period_ns);
        let (number, residual) = case.table.nearest(self.clock.fired_ns(frame, case.hsu)?)?;
        let due = case.table.reported_ns(number)?;
        let late = self.arrived_ns(frame.host_ns, case.hsu)? - i128::from(due);
        let possible = (-period_ns / 8..=i128::from(LATE_PERIODS) * period_ns).contains(&late);
        (possible && residual.abs() <= period_ns / 4).then_some(number)
    }

    /// When a frame arrived, HSU time.
    fn arrived_ns(&self, host_ns: u64, hsu: &ClockFit) -> Option<i128> {
        let measured = || Some(i128::from(host_ns) + self.start.hsu_minus_host_ns?);
        hsu.device_from_host(host_ns.into()).or_else(measured)
    }

    /// How much later than usual a frame of the trigger at `due` arrived, ns, where arrivals are regular.
    fn late_ns(&self, frame: &Sighting, due: u64, hsu: &ClockFit) -> Option<i128> {
        let usual = self.latency.usual_ns(self.start.period_ns)?;
        Some(self.arrived_ns(frame.host_ns, hsu)? - usual - i128::from(due))
    }

    /// Whether a frame arrived before a trigger was fired.
    fn precedes(&self, frame: &Sighting, due: u64, hsu: &ClockFit) -> bool {
        let slack = i128::from(self.start.period_ns / 8);
        self.arrived_ns(frame.host_ns, hsu).is_some_and(|arrived| arrived + slack < due.into())
    }

    /// The same frame once more, or one from before the last.
    fn is_repeated(&self, frame: &Sighting, step: Option<i64>) -> bool {
        let Some((last, step)) = self.last.zip(step) else { return false };
        match frame.camera_ns.zip(last.camera_ns) {
            Some((now, before)) => (step == 0 && now == before) || (step < 0 && now < before),
            None => step <= 0,
        }
    }

    /// How late a frame of the trigger at `due`, HSU time, arrived.
    fn learn_latency(&mut self, case: &Case<'_>, due: u64) {
        if let Some(arrived) = self.arrived_ns(case.frame.host_ns, case.hsu) {
            self.latency.follow(arrived - i128::from(due));
        }
    }

    fn accept(&mut self, case: &Case<'_>, number: i64, witness: Witness, finding: Option<Finding>) -> Match {
        let Case { frame, table, .. } = *case;
        // From times that are expected or inferred nothing is learned: they come from what was learned before.
        if let Some(due) = table.reported_ns(number) {
            let stamp = frame.camera_ns.filter(|_| !matches!(finding, Some(Finding::StampWrong(_))));
            if let Some(camera_ns) = stamp {
                Tracker::learn(&mut self.tracker, due, camera_ns);
                self.clock.learn(due, frame);
            }
            self.learn_latency(case, due);
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
        let step = self.ids.step(frame.id).filter(|_| matches!(self.stage, Stage::Known));
        let skipped = self.last.map_or(0, |last| (number - last.number - 1).max(0)) as u64;
        let (mut lost, mut ignored, mut finding) = (skipped, 0, finding);
        if let Some(step) = step {
            let ids = self.lost_before.saturating_add_signed(step.saturating_sub(1).max(0));
            match self.base.saturating_add(step).saturating_sub(number) {
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
        (self.base, self.lost_before, self.given_up, self.unsettled) = (number, 0, 0, false);
        self.stage = Stage::Known;
        self.last = Some(Last { number, camera_ns: frame.camera_ns });
        Matched { number, witness, lost, ignored, finding }
    }

    /// A frame without a trigger has an id all the same: the next one follows on it.
    fn spurious(&mut self, frame: &Sighting, residual: i128) -> Match {
        if let Some(step) = self.ids.step(frame.id)
            && step > 0
        {
            self.lost_before = self.lost_before.saturating_add_signed(step - 1);
            self.base = self.base.saturating_add(step - 1);
            self.ids.take(frame.id);
        }
        Match::Spurious(i64::try_from(residual).unwrap_or(i64::MAX))
    }

    /// Given up: what it was is not to be known. Ids count on from the last frame that has a trigger.
    fn give_up(&mut self, frame: &Sighting) -> Match {
        self.given_up = self.given_up.saturating_add(1);
        if let Some(last) = self.last.as_mut() {
            last.camera_ns = frame.camera_ns.or(last.camera_ns);
        }
        Match::Undecided
    }
}

#[cfg(test)]
mod tests;
