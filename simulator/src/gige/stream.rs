// SPDX-License-Identifier: MIT OR Apache-2.0
//! The streaming thread of one camera: triggers and the free-running clock become exposures, exposures
//! become frames on the wire.

use super::Statistics;
use super::clock::CameraClock;
use super::control::StreamSettings;
use super::habits::{Habits, StampPoint};
use super::inject::{self, Injector};
use super::net;
use super::picture::Picture;
use super::presence::Presence;
use super::rogue::Rogue;
use super::segmentation;
use super::sensor::{Exposure, Sensor};
use super::settings::{Edge, ExposureMode, TriggerSource};
use super::transmit::{Frame, History, Transmitter};
use crate::faults::{Fault, Kind};
use crate::wire::TriggerEdge;
use crossbeam_channel::{Receiver, never, select};
use std::collections::VecDeque;
use std::net::UdpSocket;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed, Ordering::SeqCst};
use std::time::{Duration, Instant};

/// What the control thread tells the streaming thread.
#[derive(Debug)]
pub enum Order {
    /// Start acquisition number `.0` (from 1 on), ordered at `.1`: edges count from the acknowledge on,
    /// whenever this thread gets to run.
    Start(u64, Instant, StreamSettings),
    Update(StreamSettings),
    Stop,
    /// A software trigger at this time.
    SoftwareTrigger(Instant),
    /// The trigger of an action command.
    Action(TriggerEdge),
    Quit,
}

/// Longest sleep of an idle streaming thread.
const IDLE: Duration = Duration::from_secs(1);
/// So long before a trigger an injected reset of the clock happens: a timestamp of 0 means that there is none.
const RESET_LEAD: Duration = Duration::from_micros(200);

/// An exposure on its way to become a frame.
struct Shot {
    exposure: Exposure,
    /// Camera clock at its start, ns.
    timestamp: u64,
    /// The simulated instant whose light the exposure sees.
    instant: i64,
    /// What goes wrong with it.
    fault: Option<Fault>,
    /// What becomes of its light.
    picture: Picture,
}

struct Acquisition {
    number: u64,
    started: Instant,
    stream: StreamSettings,
    sensor: Sensor,
    /// Exposures that are not sent yet.
    exposures: VecDeque<Shot>,
    next_block_id: u64,
    /// Time from the exposure of a frame to its first packet.
    late: Duration,
    /// Instant of the simulated world for exposures that no wire triggers.
    next_instant: i64,
    /// Start of the next free-running exposure.
    next_free_run: Option<Instant>,
    /// The number of exposures of this acquisition.
    exposed: u64,
    /// Triggers that it still sleeps through.
    asleep: u32,
    /// Triggers that it still misses because of the exposure before.
    busy: u32,
    frames_left: Option<u64>,
}

/// State of the streaming thread.
pub struct Streamer {
    /// Orders from the control thread.
    pub orders: Receiver<Order>,
    pub triggers: Receiver<TriggerEdge>,
    pub clock: Arc<CameraClock>,
    pub transmitter: Transmitter,
    pub socket: Arc<UdpSocket>,
    pub history: Arc<History>,
    pub statistics: Arc<Statistics>,
    /// Number of the running acquisition, 0 where none runs.
    pub running: Arc<AtomicU64>,
    /// Block id of the first frame of each acquisition.
    pub first_block_id: u64,
    /// What its frames and stamps are like.
    pub habits: Habits,
    pub injector: Option<Injector>,
    /// What the control thread must know of faults.
    pub presence: Arc<Presence>,
    /// The client from which some of them come.
    pub rogue: Option<Rogue>,
    /// Why nothing is sent at the moment.
    pub absence: Option<Absence>,
    /// From this trigger on its registers hold sense again.
    pub sense_from: Option<i64>,
    /// Block id and light of the last frame of all acquisitions.
    pub last_sent: Option<(u64, i64)>,
}

/// The camera is without power, or in other hands.
#[derive(Debug, Clone, Copy)]
pub struct Absence {
    kind: Kind,
    /// The last trigger that it lasts.
    last: i64,
    period: Duration,
    until: Instant,
}

impl Absence {
    /// How much later than planned the next edge may come; behind it the train is over.
    const EDGE_WAIT: Duration = Duration::from_secs(1);

    /// Its end follows the edges, not the clock alone: a train on a busy host may be late as a whole.
    fn follow(&mut self, edge: &TriggerEdge) {
        let left = u32::try_from(self.last.saturating_sub(edge.instant)).unwrap_or(0);
        let wait = match left {
            0 => self.period / 2,
            left => self.period.saturating_mul(left) + Self::EDGE_WAIT,
        };
        self.until = edge.time + wait;
    }
}

/// Between two signs of life of the client that has taken control.
const ROGUE_HEARTBEAT: Duration = Duration::from_millis(500);

impl Streamer {
    /// Runs until the order to quit, or until the sender of orders is dropped.
    pub fn run(mut self) {
        let mut acquisition: Option<Acquisition> = None;
        let mut connected = None;
        loop {
            let wait = acquisition.as_mut().map_or(IDLE, |a| a.next_deadline()).min(self.absence_wait());
            let triggers = &self.triggers;
            let order = select! {
                recv(self.orders) -> order => Some(order.unwrap_or(Order::Quit)),
                recv(triggers) -> edge => match edge {
                    Ok(edge) => {
                        // An order that was given before this edge must take effect before it.
                        while let Ok(order) = self.orders.try_recv() {
                            if !self.obey(order, &mut acquisition, &mut connected) {
                                return;
                            }
                        }
                        self.on_edge(&mut acquisition, edge, TriggerSource::Line0);
                        None
                    }
                    // Nobody holds the other end of the wire any more.
                    Err(_) => { self.triggers = never(); None }
                },
                default(wait) => None,
            };
            if order.is_some_and(|order| !self.obey(order, &mut acquisition, &mut connected)) {
                return;
            }
            self.attend_to_absence();
            if let Some(running) = &mut acquisition {
                self.advance(running);
                if running.frames_left == Some(0) {
                    let _ = self.running.compare_exchange(running.number, 0, SeqCst, SeqCst);
                    acquisition = None;
                }
            }
        }
    }

    /// Obeys one order; false to quit.
    fn obey(
        &mut self,
        order: Order,
        acquisition: &mut Option<Acquisition>,
        connected: &mut Option<std::net::SocketAddrV4>,
    ) -> bool {
        match order {
            Order::Start(number, started, stream) => {
                self.history.clear();
                let local = stream.destination.is_some_and(|to| to.ip().is_loopback());
                self.transmitter.set_segmented(local && segmentation::loopback_cuts_before_receivers());
                self.statistics.triggers_ignored_now.store(0, Relaxed);
                // The camera may have another address than last time.
                *connected = None;
                self.connect(&stream, connected);
                let mut begun = Acquisition::new(number, started, stream, self);
                self.send_left_over(&mut begun);
                *acquisition = Some(begun);
            }
            Order::Update(stream) => {
                self.connect(&stream, connected);
                if let Some(running) = acquisition {
                    running.stream = stream;
                }
            }
            Order::Stop => *acquisition = None,
            Order::SoftwareTrigger(time) => {
                if let Some(running) = acquisition {
                    let instant = running.take_instant();
                    let exposure = running.stream.settings.exposure();
                    self.trigger(running, time, exposure, instant, None);
                }
            }
            Order::Action(edge) => self.on_edge(acquisition, edge, TriggerSource::Action0),
            Order::Quit => return false,
        }
        true
    }

    /// What is left over of the acquisition before goes out with the new one, where that is the camera's habit.
    fn send_left_over(&self, begun: &mut Acquisition) {
        let Some((_, instant)) = self.last_sent else { return };
        for number in 1..=self.habits.strays {
            let at = begun.started + self.habits.stray_after.saturating_mul(number);
            let exposure = Exposure { start: at, end: at };
            let (timestamp, picture) = (self.stamp(exposure), self.picture(begun, exposure));
            begun.exposures.push_back(Shot { exposure, timestamp, instant, fault: None, picture });
        }
    }

    /// A connected socket saves the kernel a route look-up per packet.
    fn connect(&self, stream: &StreamSettings, connected: &mut Option<std::net::SocketAddrV4>) {
        if let Some(destination) = stream.destination.filter(|d| *connected != Some(*d)) {
            match self.socket.connect(destination) {
                Ok(()) => *connected = Some(destination),
                Err(error) => tracing::warn!(%destination, %error, "no route to the stream's destination"),
            }
        }
        if let Err(error) = net::set_do_not_fragment(&self.socket, stream.do_not_fragment) {
            tracing::warn!(%error, "cannot set the don't-fragment option of the stream");
        }
    }

    fn on_edge(&mut self, acquisition: &mut Option<Acquisition>, edge: TriggerEdge, source: TriggerSource) {
        if let Some(absence) = &mut self.absence {
            absence.follow(&edge);
        }
        if let Some((from, to)) = self.habits.ptp_away {
            self.presence.lose_master((from..to).contains(&edge.instant));
        }
        if self.sense_from.take_if(|from| edge.instant >= *from).is_some() {
            self.presence.talk_nonsense(false);
        }
        let hears = |a: &Acquisition| match source {
            TriggerSource::Action0 => a.stream.settings.hears_actions(),
            _ => a.stream.settings.hears_edges(),
        };
        let listening = acquisition.as_mut().filter(|a| hears(a) && edge.time >= a.started);
        let Some(running) = listening else {
            self.statistics.edges_unheard.fetch_add(1, Relaxed);
            return;
        };
        if let Some(asleep) = running.asleep.checked_sub(1) {
            running.asleep = asleep;
            return;
        }
        if let Some(busy) = running.busy.checked_sub(1) {
            running.busy = busy;
            return;
        }
        running.busy = self.habits.takes_one_in.saturating_sub(1);
        let exposure = match running.stream.settings.exposure_mode {
            ExposureMode::Timed => running.stream.settings.exposure(),
            ExposureMode::TriggerWidth => Duration::from_nanos(edge.width_ns),
        };
        let delay = running.stream.settings.delay;
        let fault = self.injector.as_mut().and_then(|injector| injector.on_edge(&edge));
        match fault.map(|fault| fault.kind) {
            Some(Kind::TriggerIgnored) => return,
            // Between two triggers: the frame of this one is the first of the new time.
            Some(Kind::ClockReset) => self.clock.reset(edge.time - RESET_LEAD),
            Some(Kind::Nonsense) => {
                let count = fault.map_or(0, |fault| i64::try_from(fault.count).unwrap_or(i64::MAX));
                self.sense_from = Some(edge.instant.saturating_add(count));
                self.presence.talk_nonsense(true);
            }
            _ => {}
        }
        if let Some(fault) = fault.filter(|fault| fault.kind.is_absence()) {
            return self.go_away(acquisition, fault, &edge);
        }
        if let Some(rogue) = &mut self.rogue {
            rogue.look_at_answers();
            if let Some(fault) = fault.filter(|fault| fault.kind == Kind::RogueClient) {
                rogue.harass(fault);
            }
        }
        let fall = edge.time + Duration::from_nanos(edge.width_ns);
        let starts: &[Instant] = match running.stream.settings.edge {
            _ if source == TriggerSource::Action0 => &[edge.time],
            Edge::Rising => &[edge.time],
            Edge::Falling => &[fall],
            Edge::Any => &[edge.time, fall],
        };
        for start in starts {
            for number in 0..running.stream.settings.burst {
                let later = running.stream.settings.free_run_period().saturating_mul(number);
                self.trigger(
                    running,
                    *start + delay + later,
                    exposure,
                    edge.instant,
                    fault.filter(|_| number == 0),
                );
            }
        }
    }

    /// From this edge on nothing is sent, for as many triggers as the fault lasts. What was exposed before goes out
    /// first, so that exactly these triggers are lost.
    fn go_away(&mut self, acquisition: &mut Option<Acquisition>, fault: Fault, edge: &TriggerEdge) {
        if let Some(mut running) = acquisition.take() {
            while running.exposures.front().is_some_and(|shot| shot.exposure.end <= edge.time) {
                self.advance(&mut running);
            }
            let _ = self.running.compare_exchange(running.number, 0, SeqCst, SeqCst);
        }
        let period = self.injector.as_ref().and_then(Injector::period).unwrap_or(IDLE);
        let more = i64::try_from(fault.count).unwrap_or(i64::MAX).saturating_sub(1);
        let last = edge.instant.saturating_add(more);
        let mut absence = Absence { kind: fault.kind, last, period, until: edge.time };
        absence.follow(edge);
        match fault.kind {
            Kind::ControlTaken => {
                if let Some(client) = self.rogue.as_ref().and_then(Rogue::address) {
                    self.presence.give_control_to(client);
                }
            }
            _ => self.presence.power_off(),
        }
        self.absence = Some(absence);
    }

    fn absence_wait(&self) -> Duration {
        let left = |absence: Absence| absence.until.saturating_duration_since(Instant::now());
        self.absence.map_or(IDLE, |absence| left(absence).min(ROGUE_HEARTBEAT))
    }

    /// Keeps a stranger in control, and ends what is over.
    fn attend_to_absence(&mut self) {
        let Some(absence) = self.absence else { return };
        let over = Instant::now() >= absence.until;
        match (absence.kind, &mut self.rogue) {
            (Kind::ControlTaken, Some(rogue)) if over => rogue.leave(),
            (Kind::ControlTaken, Some(rogue)) => rogue.heartbeat(),
            (Kind::Unplugged, _) if over => {
                self.clock.restart(Instant::now());
                self.history.clear();
                self.presence.power_on();
            }
            _ => {}
        }
        if over {
            self.absence = None;
        }
    }

    fn trigger(
        &self,
        running: &mut Acquisition,
        time: Instant,
        exposure: Duration,
        instant: i64,
        fault: Option<Fault>,
    ) {
        let rows = running.stream.layout.height;
        let settings = &running.stream.settings;
        (running.sensor.apart, running.sensor.pace) = (settings.apart, settings.pace);
        match running.sensor.trigger(time, exposure, rows) {
            Some(exposure) => {
                let timestamp = self.stamp(exposure);
                let picture = self.picture(running, exposure);
                running.exposures.push_back(Shot { exposure, timestamp, instant, fault, picture });
                let period = self.injector.as_ref().and_then(Injector::period);
                if let (Some(Kind::ExtraFrame), Some(period)) = (fault.map(|fault| fault.kind), period) {
                    let (start, end) = (exposure.start + period / 3, exposure.end + period / 3);
                    let exposure = Exposure { start, end };
                    let timestamp = self.stamp(exposure);
                    running.exposures.push_back(Shot { exposure, timestamp, instant, fault: None, picture });
                }
            }
            None => {
                self.statistics.triggers_ignored.fetch_add(1, Relaxed);
                self.statistics.triggers_ignored_now.fetch_add(1, Relaxed);
            }
        }
    }

    /// What the camera's clock shows where in a frame it takes the stamp.
    fn stamp(&self, exposure: Exposure) -> u64 {
        let at = match self.habits.stamp {
            StampPoint::ExposureStart => exposure.start,
            StampPoint::ExposureEnd => exposure.end,
            StampPoint::ReadoutStart | StampPoint::LeaderSent => exposure.end + self.habits.readout_late,
        };
        self.clock.at(at + self.habits.stamp_late)
    }

    fn picture(&self, running: &mut Acquisition, exposure: Exposure) -> Picture {
        let number = running.exposed;
        running.exposed += 1;
        let picture = running.stream.settings.picture;
        // So near that no grey value of a picture tells: increments of exposures leave pictures as they are.
        const NEAR: f64 = 0.05;
        let length = (exposure.end - exposure.start).as_secs_f64();
        let ratio = self.habits.nominal.map_or(1.0, |nominal| length / nominal.as_secs_f64().max(1e-9));
        let ratio = if (ratio - 1.0).abs() <= NEAR { 1.0 } else { ratio };
        picture.of_frame(number, ratio)
    }

    /// Starts free-running exposures that are due, and sends at most one frame whose exposure has ended.
    fn advance(&mut self, running: &mut Acquisition) {
        let now = Instant::now();
        if let Some((exposure, instant)) = running.free_run(now) {
            let (timestamp, picture) = (self.stamp(exposure), self.picture(running, exposure));
            running.exposures.push_back(Shot { exposure, timestamp, instant, fault: None, picture });
        }
        let due = running.exposures.front().is_some_and(|shot| shot.exposure.end + running.late <= now);
        if !due {
            return;
        }
        let Some(Shot { exposure, timestamp, instant, fault, picture }) = running.exposures.pop_front()
        else {
            return;
        };
        if let Some(fault) = fault.filter(|fault| fault.kind == Kind::IdJump) {
            for _ in 0..fault.count {
                running.next_block_id = running.stream.layout.ids.next_block_id(running.next_block_id);
            }
        }
        let layout = match self.habits.frames {
            Some((from, form)) if instant >= from => running.stream.layout.with(form),
            _ => running.stream.layout,
        };
        let timestamp = match self.habits.stamp {
            StampPoint::LeaderSent => self.clock.at(now + self.habits.stamp_late),
            _ => timestamp,
        };
        let timestamp = if self.habits.no_stamps { 0 } else { timestamp };
        let timestamp = self.habits.ticks(fault.map_or(timestamp, |fault| inject::stamp(timestamp, fault)));
        let frame = Frame { block_id: running.next_block_id, timestamp, instant, layout, picture };
        running.next_block_id = frame.layout.ids.next_block_id(frame.block_id);
        self.last_sent = Some((frame.block_id, instant));
        running.frames_left = running.frames_left.map(|left| left.saturating_sub(1));
        let lag = now.saturating_duration_since(exposure.end).as_nanos();
        self.statistics.worst_lag_ns.fetch_max(u64::try_from(lag).unwrap_or(u64::MAX), Relaxed);
        if let Some(destination) = running.stream.destination {
            if let (Some(rogue), Some(fault)) = (&self.rogue, fault.filter(|fault| fault.kind.is_foreign())) {
                rogue.stray(&frame, fault, destination);
            }
            match fault {
                None => self.transmitter.send(&frame, running.stream.packet_delay),
                Some(fault) => self.transmitter.send_with(&frame, fault),
            }
        }
        if let (Some(injector), Some(fault)) = (&self.injector, fault) {
            injector.sent(instant, frame.block_id, fault);
        }
    }
}

impl Acquisition {
    fn new(number: u64, started: Instant, stream: StreamSettings, camera: &Streamer) -> Self {
        let after = |(last, _)| stream.layout.ids.next_block_id(last);
        let next_block_id = camera.last_sent.filter(|_| camera.habits.ids_go_on).map(after);
        Self {
            number,
            started,
            sensor: Sensor::new(camera.habits.readout_late),
            exposures: VecDeque::new(),
            next_block_id: next_block_id.unwrap_or(camera.first_block_id),
            late: camera.habits.send_late,
            next_instant: 0,
            next_free_run: (!stream.settings.triggered && !stream.settings.acquisition_triggered)
                .then_some(started),
            exposed: 0,
            asleep: camera.habits.late_triggers,
            busy: 0,
            frames_left: stream.settings.frame_limit(),
            stream,
        }
    }

    fn take_instant(&mut self) -> i64 {
        let instant = self.next_instant;
        self.next_instant = instant.wrapping_add(1);
        instant
    }

    /// The free-running exposure that is due, if one is, and the light it sees.
    fn free_run(&mut self, now: Instant) -> Option<(Exposure, i64)> {
        let start = self.next_free_run.filter(|start| *start <= now && self.exposures.is_empty())?;
        let settings = &self.stream.settings;
        let (exposure, period) = (settings.exposure(), settings.free_run_period());
        // A host that fell behind by more than a period does not catch up by a burst.
        let start = if now.saturating_duration_since(start) > period { now } else { start };
        self.next_free_run = Some(start + period);
        let instant = self.take_instant();
        Some((Exposure { start, end: start + exposure }, instant))
    }

    /// How long the thread may sleep.
    fn next_deadline(&mut self) -> Duration {
        let next = match self.exposures.front() {
            Some(shot) => Some(shot.exposure.end + self.late),
            None => self.next_free_run,
        };
        next.map_or(IDLE, |at| at.saturating_duration_since(Instant::now()).min(IDLE))
    }
}
