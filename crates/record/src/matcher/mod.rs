// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which trigger a frame belongs to, by sources that do not know of each other.
//!
//! * The **counter**, block ids, counts what the camera sent: one that ignored a trigger does not skip an id, so a
//!   frame is of the trigger that its id points at or of a later one. Where ids begin is known, because an armed stream
//!   is silent until the train starts ([`anchor`]).
//! * The camera's **clock**, timestamps and readings alike, names the trigger by its time. How long after a trigger a
//!   camera stamps is measured with the first frames.
//! * The **host's clock**, the arrival: nothing arrives before its trigger was fired, nor sooner behind it than the
//!   quickest frames. A late arrival is no evidence: a host may stand still.
//! * The **HSU's table** has a rhythm of its own ([`trigger_table`]).
//!
//! A frame is filed where two of the first three agree on a trigger and the third does not refute it. Where counter and
//! clock contradict each other, the arrivals of this frame and of those behind it decide ([`dispute`]); where they do
//! not, the frame is given up, never guessed.

pub(crate) mod anchor;
pub mod block_ids;
mod case;
mod clock_relation;
mod dispute;
mod reading;
mod rejoin;
mod sighting;
pub mod trigger_table;

pub use sighting::{Finding, Match, Matched, Sighting, Witness};

use crate::base::clock_fit::{ClockFit, Exchange, Judged};
use crate::base::ids::BlockId;
use anchor::{Anchoring, Early};
use block_ids::BlockIds;
use case::Case;
use clock_relation::{Envelope, Latency, OnTime, Tracker};
use reading::{CameraClock, LATE_PERIODS};
use trigger_table::TriggerTable;

/// Frames that must have arrived behind one that no rhythm places, before the habits of cameras alike are used for it.
const LIKE_FOLLOWERS: usize = 5;
/// Frames given up in a row after which the relation of ids and clock to triggers is taken to be wrong, and sought
/// again.
const GIVEN_UP_MAX: u32 = 8;

/// What is known before a camera's first frame.
#[derive(Debug, Clone, Copy, Default)]
pub struct Start {
    /// Nominal time from trigger to trigger, ns.
    pub period_ns: u64,
    /// Triggers of the warm-up: the first trigger has this number, negative.
    pub warm_up: u32,
    /// The HSU's clock minus the host's, ns, where it was measured by exchanges before the session.
    pub hsu_minus_host_ns: Option<i128>,
}

/// How long a camera takes from a trigger to the timestamp and to the frame's arrival.
#[derive(Debug, Clone, Copy)]
pub struct Habits {
    stamp_delay_ns: i128,
    latency: Latency,
}

/// The last frame that got a trigger.
#[derive(Debug, Clone, Copy)]
struct Last {
    number: i64,
    camera_ns: Option<u64>,
    /// Whether it arrived as soon behind its trigger as the quickest frames do.
    in_time: bool,
}

/// How far a stream's identity is known.
#[derive(Debug)]
enum Stage {
    /// The train is about to begin, or in its warm-up. The number is how many ids the last frame came after the first.
    Beginning(Anchoring, Option<i64>),
    /// Ids count from a known trigger.
    Known,
    /// The camera is back, or nothing fitted any more; with its clock's relation from before.
    Lost(Option<Tracker>),
}

/// Matches the frames of one camera to triggers, in the order in which they arrive.
///
/// The recorder's accounting makes one for each camera when a session is prepared, and owns it until the session ends.
/// It promises that a frame gets a trigger only where two independent sources agree on it; all others are given up. It
/// is never replaced during a session: a camera that comes back calls [`Self::restart`].
#[derive(Debug)]
pub struct Matcher {
    start: Start,
    stage: Stage,
    clock: CameraClock,
    tracker: Option<Tracker>,
    latency: Latency,
    on_time: OnTime,
    ids: BlockIds,
    /// The trigger of the last id that was taken.
    base: i64,
    /// Ids skipped before frames that were not recorded.
    lost_before: u64,
    last: Option<Last>,
    given_up: u32,
    /// Counter and clock contradicted each other, and nothing decided which was right: agreement afterwards proves
    /// nothing.
    unsettled: bool,
    /// The first id of the stream with which the session began.
    first_id: Option<BlockId>,
    /// Habits of a camera like this one, used until its own are measured.
    like: Option<Habits>,
    /// Triggers from one frame to the next, where that is more than one, by the last two frames.
    pace: Option<i64>,
    /// The trigger that a given-up frame's arrival named.
    arrived: Option<(BlockId, i64)>,
}

impl Matcher {
    /// Frames behind the one in question that are considered, at most: more than arrive in one burst.
    pub const FOLLOWERS: usize = 48;
    /// The same in the warm-up, whose rhythm is in the first frames.
    const FIRST_FOLLOWERS: usize = 16;

    /// A matcher of one camera before its first frame.
    pub fn new(start: Start) -> Self {
        let period_ns = start.period_ns.max(16);
        Self {
            start: Start { period_ns, ..start },
            stage: Stage::Beginning(Anchoring::default(), None),
            clock: CameraClock::new(period_ns),
            tracker: None,
            latency: Latency::default(),
            on_time: OnTime::default(),
            ids: BlockIds::default(),
            base: 0,
            lost_before: 0,
            last: None,
            given_up: 0,
            unsettled: false,
            pace: None,
            first_id: None,
            like: None,
            arrived: None,
        }
    }

    /// Takes an exchange with the camera's clock into account. Where it shows that the clock was set, that counts for
    /// frames that are in doubt.
    pub fn clock_sample(&mut self, exchange: &Exchange) -> Judged {
        self.clock.exchange(exchange)
    }

    /// Whether a frame has begun to wait for a reading of the camera's clock since the last call.
    pub fn takes_clock_wish(&mut self) -> bool {
        self.clock.takes_wish()
    }

    /// How long this camera takes, where that is measured.
    pub fn habits(&self) -> Option<Habits> {
        let known =
            matches!(self.stage, Stage::Known) && self.like.is_none() && self.envelope()?.distinguishes;
        let stamp_delay_ns = self.clock.stamp_delay_ns.filter(|_| known)?;
        Some(Habits { stamp_delay_ns, latency: self.latency })
    }

    /// Whether the time that this camera takes is still to be found.
    pub fn wants_habits(&self) -> bool {
        matches!(self.stage, Stage::Beginning(..)) && self.like.is_none()
    }

    /// Sets the habits of another camera of the same head or make: a camera that slept through the warm-up is placed by
    /// it, where its clock and its arrivals both bear it out.
    pub fn presume(&mut self, like: Habits) {
        self.like = Some(like);
    }

    /// The camera's clock against the host's.
    pub fn clock(&self) -> &ClockFit {
        &self.clock.fit
    }

    /// The camera is back with a fresh stream: ids begin again, its clock may have been set. The times that it takes
    /// to stamp and to send a frame are kept.
    pub fn restart(&mut self, train_began: bool) {
        self.clock.restart();
        self.ids = BlockIds::default();
        self.lost_before = 0;
        self.stage = match train_began {
            true => Stage::Lost(self.tracker.take()),
            false => Stage::Beginning(Anchoring::default(), None),
        };
        (self.given_up, self.arrived, self.unsettled, self.first_id) = (0, None, false, None);
        self.last = self.last.map(|last| Last { camera_ns: None, in_time: false, ..last });
    }

    /// What a frame by itself shows of its trigger: the number by its id, and the time (HSU clock, ns) by its
    /// timestamp.
    pub fn claim(&self, frame: &Sighting) -> Option<(i64, i128)> {
        let known = matches!(self.stage, Stage::Known) && frame.complete;
        let camera_ns = frame.camera_ns.filter(|_| known)?;
        let tracker = self.tracker.filter(|tracker| tracker.is_settled())?;
        let number = self.base.checked_add(self.ids.step(frame.id)?)?;
        Some((number, tracker.hsu_ns(camera_ns)))
    }

    /// The trigger that a frame's id points at, where ids count from a known one.
    pub fn points_at(&self, id: BlockId) -> Option<i64> {
        self.ids.step(id).filter(|_| self.is_placed()).map(|step| self.base.saturating_add(step))
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
        if table.is_empty() && !(last_call && matches!(self.stage, Stage::Beginning(..))) {
            return if last_call { Match::BeforeTrain } else { Match::Wait };
        }
        if matches!(self.stage, Stage::Beginning(..))
            && let Some(answer) = self.begin(frame, followers, table, hsu, last_call)
        {
            return answer;
        }
        // What has arrived was triggered before: up to then the train is known even where its reports are held up.
        let now_ns = self.arrived_ns(frame.host_ns, hsu).filter(|_| last_call);
        let period_ns = self.start.period_ns;
        let table = now_ns.map_or(table.reported(), |now| table.expected_until(now, period_ns));
        let by_id = self.base.saturating_add(step.unwrap_or(0));
        let case = Case { frame, followers, by_id, table, hsu, last_call };
        if matches!(self.stage, Stage::Lost(_)) {
            let answer = self.rejoin(&case);
            self.note_arrival(&case, answer);
            return answer;
        }
        let before = (self.given_up, self.unsettled);
        let answer = if frame.complete { self.whole(&case) } else { self.torn(&case) };
        let unreported = || case.awaits_report(self.arrived_ns(frame.host_ns, hsu), period_ns);
        if answer == Match::Undecided && unreported() {
            // Reports are missing: that is no evidence against ids and clock.
            (self.given_up, self.unsettled) = before;
        }
        self.note_arrival(&case, answer);
        // Without timestamps nothing could find the place again, but ids go on: once frames are in time for them, they
        // are right.
        if answer == Match::Undecided && self.given_up >= GIVEN_UP_MAX && self.tracker.is_some() {
            self.stage = Stage::Lost(self.tracker.take());
        }
        answer
    }

    /// Notes whether a frame came as soon as the quickest do, whichever trigger it is of.
    fn note_arrival(&mut self, case: &Case<'_>, answer: Match) {
        let arrived = self.arrived_ns(case.frame.host_ns, case.hsu).filter(|_| answer != Match::Wait);
        let Some((ns, known)) = arrived.zip(self.envelope()).filter(|_| case.frame.complete) else { return };
        if let Some((_, residual)) = case.table.nearest(ns - known.least_ns) {
            self.on_time.add(residual.abs() <= i128::from(self.start.period_ns) / 4);
        }
    }

    /// A frame of a stream whose place in the train is not settled yet; `None` once it is, by the frames before this
    /// one.
    fn begin(
        &mut self,
        frame: &Sighting,
        followers: &[Sighting],
        table: &TriggerTable,
        hsu: &ClockFit,
        last_call: bool,
    ) -> Option<Match> {
        let period_ns = self.start.period_ns;
        let (first, warm_up) = (-i64::from(self.start.warm_up), i64::from(self.start.warm_up));
        let arrived = self.arrived_ns(frame.host_ns, hsu);
        let Stage::Beginning(anchoring, count) = &self.stage else { return Some(Match::Wait) };
        let next = count.map_or(0, |count: i64| count.saturating_add(self.ids.step(frame.id).unwrap_or(1)));
        let before = |due: u64| arrived.is_some_and(|ns| ns + i128::from(period_ns / 8) < due.into());
        if table.first() <= first && count.is_none() && table.time_ns(first).is_some_and(before) {
            return Some(Match::BeforeTrain);
        }
        if count.is_some() && anchoring.is_copy(frame, next) {
            return Some(Match::Repeated);
        }
        // Triggers that can have been fired when it arrived.
        let fired = arrived.map(|ns| table.expected_until(ns, period_ns));
        let newest = fired.and_then(|fired| Some(fired.nearest(arrived? - i128::from(period_ns * 3 / 8))?.0));
        let of_warm_up = newest.is_some_and(|newest| newest < 0);
        if !last_call && newest.is_none_or(|newest| newest >= table.end()) {
            return Some(Match::Wait);
        }
        let mut with_this = anchoring.clone();
        if frame.complete {
            with_this.add(Early::of(frame, next, arrived));
        }
        let followers = &followers[..followers.len().min(Self::FIRST_FOLLOWERS)];
        let with = |count: usize| {
            let mut with = with_this.clone();
            for follower in &followers[..count] {
                let steps = self.ids.between(frame.id.0, follower.id.0);
                let arrived = self.arrived_ns(follower.host_ns, hsu);
                with.add(Early::of(follower, next.saturating_add(steps), arrived));
            }
            with
        };
        // Followers that came in fits and starts take nothing from the rhythm before them.
        let fewer = [8, 4, 2, 0].into_iter().filter(|count| *count < followers.len());
        let tried = std::iter::once(followers.len()).chain(fewer);
        let found = tried.filter(|_| frame.complete).find_map(|count| {
            let with = with(count);
            let placed = with.place(first, table, period_ns)?;
            let place = placed.numbers.len().checked_sub(count + 1)?;
            let number = placed.numbers.get(place).copied().flatten().filter(|_| placed.agreed[place])?;
            Some((number, with, placed.numbers))
        });
        if let Some((number, with, numbers)) = found {
            self.first_id.get_or_insert(frame.id);
            return Some(self.settle(frame, number, &with, &numbers, table));
        }
        let reported = (first..=0).all(|number| table.reported_ns(number).is_some());
        let silent = first.saturating_add(next);
        // Without a rhythm the silence before the train is the only witness.
        let mute = reported && silent >= 0 && !table.has_rhythm(first, period_ns);
        if mute && frame.complete && table.reported_ns(silent).is_some_and(|due| !before(due)) {
            let numbers: Vec<Option<i64>> =
                with_this.frames().iter().map(|frame| first.checked_add(frame.count)).collect();
            let answer = self.settle(frame, silent, &with_this, &numbers, table);
            return Some(match answer {
                Match::Trigger(matched) => Match::Trigger(Matched { witness: Witness::One, ..matched }),
                answer => answer,
            });
        }
        // Frames that may be the session's wait for those behind them. The rhythm is over once they are no more of the
        // warm-up: then what cameras alike take from a trigger must do.
        let unplaced = !of_warm_up && reported && followers.len() >= LIKE_FOLLOWERS;
        if unplaced && let Some(like) = self.like {
            self.first_id.get_or_insert(frame.id);
            self.clock.stamp_delay_ns = Some(like.stamp_delay_ns);
            self.latency = like.latency;
            self.stage = Stage::Lost(None);
            return None;
        }
        if !of_warm_up && !last_call {
            return Some(Match::Wait);
        }
        self.first_id.get_or_insert(frame.id);
        self.ids.take(frame.id);
        // The rhythm is over, and all of it is reported: what it does not show now cannot be known any more.
        let last = match followers.last().filter(|_| frame.complete) {
            Some(last) => self.arrived_ns(last.host_ns, hsu),
            None => with_this.last().and_then(|last| last.arrived_ns),
        };
        let all = last
            .zip(table.latest_ns())
            .is_some_and(|(ns, latest)| ns <= i128::from(latest) + i128::from(period_ns * 9 / 8));
        self.stage = match reported && all && silent > 2 * warm_up {
            true => Stage::Lost(None),
            false => Stage::Beginning(with_this, Some(next)),
        };
        if !of_warm_up {
            return Some(self.give_up(frame));
        }
        let number = silent.min(-1);
        Some(Match::Trigger(Matched { number, witness: Witness::Two, lost: 0, ignored: 0, finding: None }))
    }

    /// The first frames' triggers are known: learns from them how the camera's clock runs, and how long frames take to
    /// arrive. This frame's is `number`.
    fn settle(
        &mut self,
        frame: &Sighting,
        number: i64,
        anchoring: &Anchoring,
        numbers: &[Option<i64>],
        table: &TriggerTable,
    ) -> Match {
        let placed = || {
            anchoring.frames().iter().zip(numbers).filter_map(|(frame, number)| {
                let number = (*number)?;
                Some((number, table.reported_ns(number)?, frame))
            })
        };
        // Of frames whose stamps stand as this one's: a slip in the warm-up must not be learned.
        let way = |due: u64, camera_ns: u64| i128::from(camera_ns) - i128::from(due);
        let own = frame.camera_ns.zip(table.reported_ns(number)).map(|(ns, due)| way(due, ns));
        let near = i128::from(self.start.period_ns / 6);
        for (other, due, early) in placed() {
            if let Some(arrived) = early.arrived_ns {
                self.latency.follow(arrived - i128::from(due), self.start.period_ns);
            }
            let stamp = early.camera_ns.filter(|_| anchoring.has_stamps() && other <= number);
            if let Some(camera_ns) =
                stamp.filter(|ns| own.is_some_and(|own| (way(due, *ns) - own).abs() <= near))
            {
                Tracker::learn(&mut self.tracker, due, camera_ns);
            }
        }
        self.clock.ask();
        let counted =
            anchoring.frames().iter().zip(numbers).filter_map(|(early, of)| Some((early.count, (*of)?)));
        let pace = anchor::pace_of(counted);
        let matched = self.place(frame, number, None);
        self.pace = pace;
        Match::Trigger(matched)
    }

    /// A frame that arrived whole, of a stream whose ids count from a known trigger.
    fn whole(&mut self, case: &Case<'_>) -> Match {
        if case.table.time_ns(case.by_id).is_none() && !case.last_call {
            return Match::Wait;
        }
        match self.tracker {
            Some(tracker) => self.by_counter_and_clock(case, &tracker),
            None => self.by_counter_and_arrival(case),
        }
    }

    /// Parts of a frame: no pixels are recorded of it, and its id shows which frame is missing.
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
        // Its id is the only witness: of a counter that is in doubt it would settle nothing.
        match self.unsettled {
            true => self.give_up(case.frame),
            false => Match::Trigger(self.place(case.frame, case.by_id, None)),
        }
    }

    fn is_fresh(&self, number: i64) -> bool {
        self.last.is_none_or(|last| number > last.number)
    }

    /// Bound of the residuals of a clock that was not set, ns.
    fn near_ns(&self) -> i128 {
        let period_ns = i128::from(self.start.period_ns);
        let spread = self.tracker.map_or(0.0, |tracker| tracker.spread_ns);
        (period_ns / 16).max((spread * 6.0) as i128).min(period_ns / 4)
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

    /// How much later than the quickest frames one of the trigger at `due` arrived, ns.
    fn late_ns(&self, frame: &Sighting, due: u64, hsu: &ClockFit) -> Option<i128> {
        let least_ns = self.envelope()?.least_ns;
        Some(self.arrived_ns(frame.host_ns, hsu)? - least_ns - i128::from(due))
    }

    /// How soon frames arrive, where that is known.
    fn envelope(&self) -> Option<Envelope> {
        self.latency.envelope(self.start.period_ns)
    }

    /// Whether a frame arrived before a trigger was fired.
    fn precedes(&self, frame: &Sighting, due: u64, hsu: &ClockFit) -> bool {
        let slack = i128::from(self.start.period_ns / 8);
        self.arrived_ns(frame.host_ns, hsu).is_some_and(|arrived| arrived + slack < due.into())
    }

    /// Whether it is the same frame again, or one from before the last.
    fn is_repeated(&self, frame: &Sighting, step: Option<i64>) -> bool {
        let Some((last, step)) = self.last.zip(step) else { return false };
        match frame.camera_ns.zip(last.camera_ns) {
            Some((now, before)) => (step == 0 && now == before) || (step < 0 && now < before),
            None => step <= 0,
        }
    }

    fn accept(&mut self, case: &Case<'_>, number: i64, finding: Option<Finding>) -> Match {
        let Case { frame, table, .. } = *case;
        // From times that are expected or inferred nothing is learned: they come from what was learned before.
        if let Some(due) = table.reported_ns(number) {
            let stamp = frame.camera_ns.filter(|_| !matches!(finding, Some(Finding::StampWrong(_))));
            if let Some(camera_ns) = stamp {
                Tracker::learn(&mut self.tracker, due, camera_ns);
                self.clock.learn(due, frame);
            }
            if let Some(arrived) = self.arrived_ns(frame.host_ns, case.hsu) {
                self.latency.follow(arrived - i128::from(due), self.start.period_ns);
            }
        }
        let in_time = self.timing(case, frame, number) == dispute::Timing::InTime;
        let matched = self.place(frame, number, finding);
        self.last = self.last.map(|last| Last { in_time, ..last });
        // Counter and clock have contradicted each other: that they agree again proves nothing yet.
        self.unsettled = matches!(finding, Some(Finding::StampWrong(Some(_))));
        Match::Trigger(matched)
    }

    /// Enters a frame at a trigger, and explains the triggers before it that have none.
    fn place(&mut self, frame: &Sighting, number: i64, finding: Option<Finding>) -> Matched {
        let step = self.ids.step(frame.id).filter(|_| matches!(self.stage, Stage::Known));
        let skipped = self.last.map_or(number.max(0), |last| (number - last.number - 1).max(0)) as u64;
        let (mut lost, mut ignored, mut finding) = (skipped, 0, finding);
        if let Some(first) = self.first_id.filter(|_| self.last.is_none()) {
            // What the stream's ids do not count before its first frame that has a trigger, the camera ignored; not
            // what came and was given up.
            let before = number.saturating_add(self.start.warm_up.into());
            let uncounted = before.saturating_sub(self.ids.between(first.0, frame.id.0));
            let without_frame = skipped.saturating_sub(self.given_up.into());
            ignored = without_frame.min(u64::try_from(uncounted).unwrap_or(0));
            lost = skipped - ignored;
        }
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
        (self.base, self.lost_before, self.given_up) = (number, 0, 0);
        (self.unsettled, self.pace) = (false, None);
        self.stage = Stage::Known;
        self.last = Some(Last { number, camera_ns: frame.camera_ns, in_time: false });
        Matched { number, witness: Witness::Two, lost, ignored, finding }
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

    /// Gives a frame up: its trigger cannot be known. Ids count on from the last frame that has a trigger.
    fn give_up(&mut self, frame: &Sighting) -> Match {
        self.unsettled = true;
        self.pass_over(frame)
    }

    /// As [`Self::give_up`], for a frame that alone is wrong: those behind it agree with those before.
    fn pass_over(&mut self, frame: &Sighting) -> Match {
        self.given_up = self.given_up.saturating_add(1);
        if let Some(last) = self.last.as_mut() {
            last.camera_ns = frame.camera_ns.or(last.camera_ns);
        }
        Match::Undecided
    }
}

#[cfg(test)]
mod tests;
