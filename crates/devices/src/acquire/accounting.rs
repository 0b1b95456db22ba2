// SPDX-License-Identifier: MIT OR Apache-2.0
//! The accounting of a session: gives every frame its trigger and every trigger of every camera its outcome.

use super::assembler::Assembler;
use super::breaches::{Breaches, gap_cause};
use super::commands::{LaneSetup, RecorderCommand, RecorderEvent, RecorderOptions, TICK};
use super::pause::Pauses;
use super::progress::Progress;
use super::receiver::Arrival;
use super::writer_queue::{ReadyFrame, Ring, ToWriter};
use crate::base::clock_fit::{ClockFit, Exchange, Judged};
use crate::base::ids::{CameraId, TriggerIndex};
use crate::base::time::host_time_ns;
use crate::camera::Transfer;
use crate::config::WhenFull;
use crate::host::run_delay::{Starved, held_back};
use crate::hsu::TriggerFlags;
use crate::matcher::Matcher;
use crate::matcher::trigger_table::TriggerTable;
use crate::matcher::{Match, Matched, Sighting, Witness};
use crate::record::{ClockSample, FrameMeta, GapCause, SessionEnd, WarmUp};
use crossbeam_channel::Sender;
use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

/// The accounting of one camera.
struct Lane {
    id: CameraId,
    width: u32,
    height: u32,
    matcher: Matcher,
    pending: VecDeque<Pending>,
    /// Number of the stream whose frames are accepted.
    stream: u32,
    /// The first trigger without an outcome yet.
    next: u64,
    lost: bool,
    /// Whether the camera was lost and has sent no frame since it is back.
    back: bool,
    /// The cause for which the camera is or was away.
    absence: GapCause,
    /// Number of frames that no trigger explains.
    spurious: u64,
    /// Number of frames whose trigger rests on one witness.
    unconfirmed: u64,
    /// Number of frames given up because their witnesses contradicted each other.
    given_up: u64,
    /// The same, since the last frame whose trigger was found.
    given_up_now: u64,
    /// Triggers of the last frames that were given up: by their block ids, and by the camera's clock where it names
    /// one.
    given_up_at: VecDeque<(u64, Option<u64>)>,
    /// When a reading of its clock was last requested, by [`Accounting::awake`].
    clock_requested: Option<Duration>,
    breaches: Breaches,
}

impl Lane {
    fn new(setup: LaneSetup) -> Self {
        Self {
            id: setup.id,
            width: setup.width,
            height: setup.height,
            matcher: setup.matcher,
            pending: VecDeque::new(),
            stream: 0,
            next: 0,
            lost: false,
            back: false,
            absence: GapCause::Unplugged,
            spurious: 0,
            unconfirmed: 0,
            given_up: 0,
            given_up_now: 0,
            given_up_at: VecDeque::with_capacity(GIVEN_UP_KEPT),
            clock_requested: None,
            breaches: Breaches::default(),
        }
    }
}

/// A frame that waits for its trigger; `since` is a time of [`Accounting::awake`].
struct Pending {
    arrival: Arrival,
    since: Duration,
}

/// Consecutive frame sets that found no room in the ring.
struct Full {
    first: u64,
    last: u64,
    frames: u64,
    /// The thread that got no processor, where the cause was not the disk.
    starved: Option<Starved>,
}

/// The state of the matching thread, which owns it from the start of a session to its close. It promises that every
/// frame gets a trigger by two independent witnesses or is given up by name, and that every trigger of every camera
/// ends with exactly one outcome.
pub(super) struct Accounting {
    lanes: Vec<Lane>,
    table: TriggerTable,
    hsu: ClockFit,
    sets: Assembler<ReadyFrame>,
    ring: Ring,
    full: Option<Full>,
    full_reported: bool,
    options: RecorderOptions,
    progress: Arc<Progress>,
    events: Sender<RecorderEvent>,
    draining: bool,
    /// The HSU's count of triggers, once it is known.
    emitted: Option<u64>,
    /// Time that this thread has been running. It does not grow while the process stands still, so that commands sent
    /// in the meantime are handled before any patience ends.
    awake: Duration,
    last_turn: Instant,
    pauses: Pauses,
    /// When a pause was last recorded, by `awake`.
    recorded_pause: Option<Duration>,
    /// When to check again whether the threads get a processor, by `awake`.
    next_look: Duration,
    /// When a frame last got its trigger, by `awake`.
    last_settled: Duration,
    beginning: beginning::Beginning,
}

/// Kind of the event that marks the trigger at which Record was pressed.
const RECORD_PRESSED: &str = "record_pressed";
/// Kind of the event at the first trigger whose time contradicts the HSU's others.
const HSU_TIMES_WRONG: &str = "hsu_times_wrong";
/// Consecutive frames given up whose triggers are remembered.
const GIVEN_UP_KEPT: usize = 64;
/// Longest turn that counts as work: a longer one includes a pause of the thread.
const LONGEST_TURN: Duration = TICK.saturating_mul(2);
/// Longest wait for requested readings of a camera's clock, before they are requested again.
const CLOCK_PATIENCE: Duration = Duration::from_millis(10);
/// Least time that a frame waits for its report, even where too many frames wait, because they may have come at once.
const BURST_PATIENCE: Duration = Duration::from_millis(25);

impl Accounting {
    pub(super) fn new(
        lanes: Vec<LaneSetup>,
        options: RecorderOptions,
        progress: Arc<Progress>,
        ring: Ring,
        events: Sender<RecorderEvent>,
    ) -> Self {
        Self {
            sets: Assembler::new(lanes.len(), options.set_patience, options.open_sets()),
            lanes: lanes.into_iter().map(Lane::new).collect(),
            table: TriggerTable::new(options.period_ns),
            hsu: ClockFit::new(),
            ring,
            full: None,
            full_reported: false,
            options,
            progress,
            events,
            draining: false,
            emitted: None,
            awake: Duration::ZERO,
            last_turn: Instant::now(),
            pauses: Pauses::default(),
            recorded_pause: None,
            next_look: Duration::ZERO,
            last_settled: Duration::ZERO,
            beginning: beginning::Beginning::default(),
        }
    }

    /// Takes a frame that arrived; `behind` more wait in the channel to this thread.
    pub(super) fn frame_arrived(&mut self, arrival: Arrival, behind: usize) {
        let camera = arrival.camera;
        let Some(lane) = self.lanes.get_mut(camera) else { return };
        if arrival.stream != lane.stream {
            return self.spurious(&arrival, "is of a stream that has ended");
        }
        if self.beginning.is_stray(&arrival) {
            return self.stray(&arrival);
        }
        lane.pending.push_back(Pending { arrival, since: self.awake });
        let pending: usize = self.lanes.iter().map(|lane| lane.pending.len()).sum();
        let waiting = pending + behind + self.sets.waiting() + self.ring.len();
        self.progress.high_water.fetch_max(waiting as u64, Ordering::Relaxed);
        self.advance(camera, false);
        self.pass_sets_on(false);
    }

    pub(super) fn handle(&mut self, command: RecorderCommand) {
        match command {
            RecorderCommand::Trigger(record) => {
                self.first_report(&record);
                if let Ok(number) = i64::try_from(record.index.0) {
                    let late = record.flags & u32::from(TriggerFlags::LATE.0) != 0;
                    self.hsu_reports(number, record.hsu_time_ns, late, record.host_time_ns);
                }
                self.count_triggers();
                self.ring.small(ToWriter::Trigger(record));
                self.advance_all();
            }
            RecorderCommand::Silent { until_ns } => self.silent_until(until_ns),
            RecorderCommand::WarmUp { number, hsu_time_ns, late, host_time_ns: arrived_ns } if number < 0 => {
                self.hsu_reports(number, hsu_time_ns, late, arrived_ns);
                self.beginning.reports += 1;
                let sample = WarmUp::Trigger { number, hsu_time_ns };
                self.ring.small(ToWriter::Event(sample.event(None, host_time_ns())));
                self.advance_all();
            }
            RecorderCommand::Clock(sample) => self.clock_sample(sample),
            RecorderCommand::Event(event) => self.ring.small(ToWriter::Event(event)),
            RecorderCommand::CameraLost(camera, cause) if camera < self.lanes.len() => {
                self.advance(camera, true);
                let lane = &mut self.lanes[camera];
                (lane.lost, lane.absence) = (true, cause);
                self.sets.expect(camera, false);
            }
            RecorderCommand::CameraAway(camera, cause) if camera < self.lanes.len() => {
                self.lanes[camera].absence = cause;
            }
            RecorderCommand::CameraBack { camera, stream } if camera < self.lanes.len() => {
                self.advance(camera, true);
                let lane = &mut self.lanes[camera];
                (lane.lost, lane.back, lane.stream) = (false, true, stream);
                lane.matcher.restart(!self.table.is_empty());
                self.sets.expect(camera, true);
            }
            RecorderCommand::Keep { first, pressed } => {
                self.ring.keep(first, self.lanes.len());
                self.count_triggers();
                let message =
                    format!("Record was pressed here; the recording begins at trigger {first} of the train");
                self.event(RECORD_PRESSED, None, Some(pressed), message);
            }
            RecorderCommand::Drain { emitted } => {
                self.draining = true;
                self.emitted = emitted.or(self.emitted);
                self.last_settled = self.awake;
            }
            _ => {}
        }
    }

    /// Enters the HSU's time of a trigger into the table. The HSU's times are a source of their own: a time that
    /// contradicts their rhythm, or a report that arrived before its trigger can have been fired, confirms no frame.
    fn hsu_reports(&mut self, number: i64, hsu_time_ns: u64, late: bool, host_time_ns: u64) {
        let fired = self.hsu.host_from_device(hsu_time_ns.into());
        let slack = i128::from(self.options.period_ns / 8);
        let possible = fired.is_none_or(|fired| fired <= i128::from(host_time_ns) + slack);
        let before = self.table.contradicting();
        self.table.report(number, hsu_time_ns, late, possible);
        match self.table.contradicting() > before {
            false => self.hsu.heard(hsu_time_ns, host_time_ns),
            true if before == 0 => {
                let text = format!(
                    "the HSU's time of trigger {number}, {hsu_time_ns} ns, contradicts {}: from here on block ids and \
                     timestamps decide on triggers, as far as they agree (later contradictions are counted)",
                    if possible { "the rhythm of its triggers" } else { "its report, which arrived earlier" }
                );
                self.event(HSU_TIMES_WRONG, None, u64::try_from(number).ok(), text);
            }
            true => {}
        }
    }

    /// Counts the triggers that belong to the recording.
    fn count_triggers(&self) {
        let triggers = self.ring.first().map_or(0, |first| self.table.len().saturating_sub(first));
        self.progress.triggers.store(triggers, Ordering::Relaxed);
    }

    fn clock_sample(&mut self, sample: ClockSample) {
        let exchange = Exchange {
            host_send_ns: sample.host_send_ns,
            host_receive_ns: sample.host_receive_ns,
            device_ns: sample.device_time_ns,
        };
        let lane = |id: &CameraId| self.lanes.iter().position(|lane| lane.id == *id);
        match sample.camera.as_ref().map(lane) {
            None => {
                if let Judged::Reset { step_ns } = self.hsu.exchange(&exchange) {
                    let message = format!("the HSU's clock jumped by {step_ns} ns");
                    self.event("hsu_clock_reset", None, None, message);
                }
            }
            Some(Some(camera)) => {
                if let Judged::Reset { step_ns } = self.lanes[camera].matcher.clock_sample(&exchange) {
                    let message = format!("its clock jumped by {step_ns} ns (found by clock readings)");
                    self.note(camera, "camera_clock_reset", None, message);
                }
            }
            Some(None) => {}
        }
        self.ring.small(ToWriter::Clock(sample));
    }

    pub(super) fn advance_all(&mut self) {
        (0..self.lanes.len()).for_each(|camera| self.advance(camera, false));
        self.pass_sets_on(false);
        self.ring.go_on();
        self.look_at_places();
    }

    /// Settles the camera's waiting frames that can be decided, in order; with `now`, all of them.
    fn advance(&mut self, camera: usize, now: bool) {
        while let Some(Pending { arrival, since }) = self.lanes[camera].pending.pop_front() {
            let lane = &mut self.lanes[camera];
            let many = lane.pending.len() >= self.options.waiting_frames();
            let patience = if many { BURST_PATIENCE } else { self.options.report_patience };
            let last_call = now || self.awake - since > patience;
            let behind = lane.pending.iter().map(|next| sighting(&next.arrival)).filter(|next| next.complete);
            let seen = sighting(&arrival);
            let mut followers = [seen; Matcher::FOLLOWERS];
            let count = followers.iter_mut().zip(behind).map(|(place, next)| *place = next).count();
            if last_call {
                // The frames behind it show whether the host stood still, and their reports may be held up as well.
                self.infer_trigger(camera, &seen, false);
                followers[..count].iter().for_each(|seen| self.infer_trigger(camera, seen, true));
            }
            if self.lanes[camera].matcher.wants_habits()
                && let Some(habits) = self.lanes.iter().find_map(|lane| lane.matcher.habits())
            {
                self.lanes[camera].matcher.presume(habits);
            }
            let lane = &mut self.lanes[camera];
            let answer = lane.matcher.assign(&seen, &followers[..count], &self.table, &self.hsu, last_call);
            self.request_clock(camera);
            let lane = &mut self.lanes[camera];
            match answer {
                Match::Wait => return lane.pending.push_front(Pending { arrival, since }),
                Match::Undecided => self.give_up(&arrival),
                Match::Trigger(matched) => self.settle(matched, arrival),
                Match::Spurious(residual_ns) => {
                    self.spurious(&arrival, &format!("lies {residual_ns} ns from the nearest trigger"));
                }
                Match::Stray => self
                    .spurious(&arrival, "is incomplete, and its trigger has an outcome or is not fired yet"),
                Match::BeforeTrain => {
                    self.beginning.early += 1;
                    self.spurious(&arrival, "came before the first trigger");
                }
                Match::Repeated => {
                    let text = format!("block {} was seen before; not recorded", arrival.block_id);
                    self.note(camera, "repeated_frame", None, text);
                }
            }
        }
    }

    /// Requests readings of a camera's clock where a frame waits for them, and again where they do not come.
    fn request_clock(&mut self, camera: usize) {
        let lane = &mut self.lanes[camera];
        let again = lane.clock_requested.is_none_or(|then| self.awake > then + CLOCK_PATIENCE);
        if again && lane.matcher.takes_clock_wish() {
            lane.clock_requested = Some(self.awake);
            drop(self.events.send(RecorderEvent::Doubtful { camera }));
        }
    }

    /// Gives a frame's trigger an outcome, and the triggers before it that have none.
    fn settle(&mut self, matched: Matched, arrival: Arrival) {
        let camera = arrival.camera;
        self.progress.latencies.matched.record(arrival.taken.elapsed());
        let Ok(trigger) = u64::try_from(matched.number) else {
            self.report_skipped(camera, arrival.block_id, (matched.lost, None), (matched.ignored, None));
            self.report(camera, &matched, &arrival);
            return self.warm_up_frame(&arrival);
        };
        if self.emitted.is_some_and(|emitted| trigger >= emitted) {
            return self.spurious(&arrival, "came after the last trigger");
        }
        let lane = &mut self.lanes[camera];
        if trigger < lane.next {
            let text =
                format!("block {} is of a trigger that has an outcome; not recorded", arrival.block_id);
            return self.note(camera, "repeated_frame", Some(trigger), text);
        }
        self.last_settled = self.awake;
        lane.unconfirmed += u64::from(matched.witness == Witness::One);
        let start = std::mem::replace(&mut lane.next, trigger + 1);
        let (cause, ignored) = match std::mem::take(&mut lane.back) {
            true => (lane.absence, 0),
            false => (GapCause::MissingPackets, matched.ignored),
        };
        let skipped = lane.skipped(start..trigger, cause, ignored);
        let of = |cause: GapCause| {
            let mut at = (start..).zip(&skipped).filter(|(_, other)| **other == cause).map(|(at, _)| at);
            let first = at.next();
            (first.map_or(0, |_| 1 + at.count() as u64), first)
        };
        let (lost, ignored) = (of(GapCause::MissingPackets), of(GapCause::NotTriggered));
        self.report_skipped(camera, arrival.block_id, lost, ignored);
        self.report(camera, &matched, &arrival);
        self.gaps(camera, start, skipped);
        if let Transfer::Breach(breach) = arrival.transfer {
            self.breach(camera, arrival.block_id, breach);
        }
        match gap_cause(arrival.transfer) {
            Some(cause) => self.gaps(camera, trigger, vec![cause]),
            None => self.ready(camera, trigger, arrival),
        }
    }

    /// Records a warm-up frame's id and times, whether its trigger is known or not: `verify` computes the triggers
    /// again.
    fn warm_up_frame(&mut self, arrival: &Arrival) {
        let sample = WarmUp::Frame {
            block: arrival.block_id.0,
            camera_time_ns: arrival.camera_ns,
            host_time_ns: arrival.host_ns,
        };
        let camera = Some(self.lanes[arrival.camera].id.clone());
        self.ring.small(ToWriter::Event(sample.event(camera, host_time_ns())));
    }

    fn ready(&mut self, camera: usize, trigger: u64, arrival: Arrival) {
        let lane = &self.lanes[camera];
        let meta = FrameMeta {
            trigger: TriggerIndex(trigger),
            block: arrival.block_id,
            camera_time_ns: arrival.camera_ns,
            host_time_ns: arrival.host_ns,
            width: lane.width,
            height: lane.height,
            pixels_crc: arrival.pixels_crc,
        };
        let now = Instant::now();
        let frame = ReadyFrame { camera, meta, block: arrival.block, taken: arrival.taken, since: now };
        self.sets.outcome(camera, trigger, Some(frame), now);
    }

    /// Passes finished sets to the ring, or drops them where it has no room.
    fn pass_sets_on(&mut self, all: bool) {
        while let Some((trigger, mut frames)) = self.sets.next(Instant::now(), all) {
            let dropped_before = self.full.as_ref().is_some_and(|full| full.last == trigger);
            let broken = self.pauses.is_broken(trigger);
            if broken {
                // The frames of an incomplete set are given up, too, with the pause as their cause.
                self.give_up_set(trigger, &mut frames, GapCause::NodePaused);
            } else if !all && (dropped_before || !self.ring.has_room_for(frames.len())) {
                self.drop_set(trigger, &mut frames);
            } else if !frames.is_empty() {
                self.end_of_full();
                for mut frame in frames.drain(..) {
                    self.progress.latencies.assembled.record(frame.since.elapsed());
                    frame.since = Instant::now();
                    self.ring.frame(frame);
                }
                self.progress.ring_high_water.fetch_max(self.progress.in_ring(), Ordering::Relaxed);
            }
            self.sets.recycle(frames);
        }
    }

    fn drop_set(&mut self, trigger: u64, frames: &mut Vec<ReadyFrame>) {
        let count = frames.len() as u64;
        if self.pauses.breaks(trigger, GapCause::DroppedRingFull) {
            return self.give_up_set(trigger, frames, GapCause::NodePaused);
        }
        let mut full = self.full.take().unwrap_or_else(|| {
            let starved = held_back(&["writer", "disk"]);
            Full { first: trigger, last: trigger, frames: 0, starved }
        });
        (full.last, full.frames) = (full.last.max(trigger), full.frames + count);
        let cause = if full.starved.is_some() { GapCause::NodePaused } else { GapCause::DroppedRingFull };
        self.give_up_set(trigger, frames, cause);
        self.progress.dropped.fetch_add(count, Ordering::Relaxed);
        if self.options.when_full == WhenFull::Stop && !std::mem::replace(&mut self.full_reported, true) {
            let why = full.starved.as_ref().map(ToString::to_string);
            drop(self.events.send(RecorderEvent::RingFull { why }));
        }
        self.full = Some(full);
    }

    /// Adds gap records for consecutive triggers.
    fn gaps(&mut self, camera: usize, first: u64, causes: Vec<GapCause>) {
        let now = Instant::now();
        for (trigger, cause) in (first..).zip(causes) {
            let paused = self.pauses.breaks(trigger, cause);
            self.count_gap(camera, trigger, if paused { GapCause::NodePaused } else { cause });
            self.sets.outcome(camera, trigger, None, now);
            // A long absence must not pile up sets that wait for no camera.
            self.pass_sets_on(false);
        }
    }

    fn count_gap(&mut self, camera: usize, trigger: u64, cause: GapCause) {
        self.ring.small(ToWriter::Gap(camera, TriggerIndex(trigger), cause));
    }

    /// Adds gap records in place of the frames of a set.
    fn give_up_set(&mut self, trigger: u64, frames: &mut Vec<ReadyFrame>, cause: GapCause) {
        frames.drain(..).for_each(|frame| self.count_gap(frame.camera, trigger, cause));
    }

    pub(super) fn check_drained(&mut self, all_taken: bool) {
        if !self.draining {
            return;
        }
        let all_in = self.emitted.is_some_and(|n| self.lanes.iter().all(|lane| lane.lost || lane.next >= n));
        let quiet = self.awake - self.last_settled > self.options.drain_patience && all_taken;
        if all_in || quiet {
            self.draining = false;
            drop(self.events.send(RecorderEvent::Drained));
        }
    }

    /// Adds gap records for the last triggers, after which no frame came that would show the loss.
    fn give_up_until(&mut self, triggers: u64) {
        for camera in 0..self.lanes.len() {
            let lane = &mut self.lanes[camera];
            let cause = if lane.lost || lane.back { lane.absence } else { GapCause::Timeout };
            let first = lane.next;
            lane.next = first.max(triggers);
            let skipped = lane.skipped(first..triggers, cause, 0);
            self.gaps(camera, first, skipped);
        }
    }

    pub(super) fn close(mut self, aborted: Option<String>) {
        // Frames that still wait are decided by what is known now.
        (0..self.lanes.len()).for_each(|camera| self.advance(camera, true));
        self.pass_sets_on(true);
        self.end_of_full();
        self.give_up_until(self.emitted.unwrap_or(0).max(self.table.len()));
        self.pass_sets_on(true);
        self.sum_up();
        let latencies = self.progress.latencies.to_string();
        self.event("latency", None, None, latencies);
        self.ring.close(Some(SessionEnd {
            triggers_emitted: self.emitted,
            aborted,
            absent: GapCause::Unknown,
            host_time_ns: host_time_ns(),
        }));
    }

    pub(super) fn discard(self) {
        self.ring.close(None);
    }
}

fn sighting(arrival: &Arrival) -> Sighting {
    Sighting {
        id: arrival.block_id,
        // A frame whose leader was lost has no timestamp.
        camera_ns: Some(arrival.camera_ns).filter(|ns| *ns != 0),
        host_ns: arrival.host_ns,
        complete: matches!(arrival.transfer, Transfer::Complete | Transfer::Unwritten | Transfer::Breach(_)),
    }
}

mod beginning;
mod held_up;
mod skipped;
mod statements;
mod stood_still;

#[cfg(test)]
mod tests;
