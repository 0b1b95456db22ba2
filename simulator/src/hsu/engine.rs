// SPDX-License-Identifier: MIT OR Apache-2.0
//! The simulated unit's main loop: what the firmware does with timers and interrupts, on one thread.

use super::inject::{Deed, Injector};
use super::line::Line;
use super::ltc::{Played, Player};
use super::{Control, HsuOptions, RunningClock};
use crate::wire::TriggerEdge;
use crossbeam_channel::{Sender, TrySendError};
use hsu_firmware_proto::frame::{self, Decoder};
use hsu_firmware_proto::{
    HeadTiming, Identity, LinkId, MAX_MESSAGE, Slope, State, Sync, TriggerFlags, TriggerRecord, Unit,
    UnitOutputs, UnitToHost,
};
use std::sync::atomic::Ordering;
use std::sync::{Arc, PoisonError};
use std::time::{Duration, Instant};

/// Sleeping is only accurate to about this; the rest of the way to a trigger is spun.
const SPIN: Duration = Duration::from_micros(100);
/// Longest sleep: how soon the switches in [`Control`] are seen.
const NAP: Duration = Duration::from_millis(10);

pub(super) struct Engine {
    identity: Identity,
    unit: Unit,
    decoders: Vec<Decoder>,
    world: World,
    /// The projectors' own frame clock, for [`Sync::ProjectorFrame`].
    next_frame_ns: u64,
    /// Inputs that swing by themselves: line, half a period in ns, when the next edge comes, whether it rises.
    swinging: Vec<(u8, u64, u64, bool)>,
    /// Time code on an input.
    ltc: Option<Player>,
    /// What came in last; kept for its memory.
    input: Vec<u8>,
}

/// What the unit acts on.
struct World {
    clock: RunningClock,
    lines: Vec<Line>,
    cameras: Vec<(usize, Sender<TriggerEdge>)>,
    /// Edges that have not risen yet, by camera, in order of time.
    edges: Vec<(usize, TriggerEdge)>,
    control: Arc<Control>,
    injector: Option<Injector>,
    shown: Shown,
    /// What the injector has ordered and is not yet carried out.
    deeds: Vec<Deed>,
}

/// Which instant of the scene a trigger shows.
#[derive(Default)]
struct Shown {
    carry_on: bool,
    /// Instants that earlier trains have shown, and those of this one so far.
    before: i64,
    now: i64,
}

impl Shown {
    /// A trigger's own number, or the same counted on from the last train. Its warm-up already sees what comes.
    fn instant(&mut self, number: i64) -> i64 {
        if !self.carry_on {
            return number;
        }
        if number <= 0 && self.now > 0 {
            self.before = self.before.saturating_add(self.now);
            self.now = 0;
        }
        if number >= 0 {
            self.now = number.saturating_add(1);
        }
        self.before.saturating_add(number.max(0))
    }
}

impl UnitOutputs for World {
    fn send(&mut self, link: LinkId, message: &UnitToHost) -> bool {
        let Some(line) = self.lines.get_mut(link.index()) else { return false };
        let mut bytes = [0; MAX_MESSAGE];
        let length = message.encode(&mut bytes);
        let mut framed = [0; frame::MAX_FRAME];
        let length = frame::encode(&bytes[..length], &mut framed);
        line.queue(&framed[..length], Instant::now())
    }

    fn session_output(&mut self, high: bool) {
        let rises = !self.control.output_high.swap(high, Ordering::Relaxed) && high;
        self.control.output_rises.fetch_add(u64::from(rises), Ordering::Relaxed);
    }

    fn fire(&mut self, trigger: &TriggerRecord, heads: &[HeadTiming]) {
        self.control.fired.fetch_add(1, Ordering::Relaxed);
        let late = u64::from(trigger.flags.contains(TriggerFlags::LATE));
        self.control.late.fetch_add(late, Ordering::Relaxed);
        let instant = self.shown.instant(trigger.number);
        for (camera, (head, _)) in self.cameras.iter().enumerate() {
            // A camera on a head that is not configured is on a dead wire.
            let Some(timing) = heads.get(*head) else { continue };
            let time = self.clock.instant(trigger.time_ns.saturating_add(timing.delay_ns));
            let edge = TriggerEdge { instant, time, width_ns: timing.exposure_ns };
            self.edges.push((camera, edge));
        }
        self.edges.sort_by_key(|(_, edge)| edge.time);
        if let Some(injector) = &mut self.injector {
            self.deeds.extend(injector.on_trigger(trigger.number, Instant::now()));
        }
    }
}

impl World {
    fn raise_edges(&mut self, now: Instant) {
        let due = self.edges.partition_point(|(_, edge)| edge.time <= now);
        for (camera, edge) in self.edges.drain(..due) {
            // Copper does not wait. A camera that is gone is an open end.
            if let Err(TrySendError::Full(_)) = self.cameras[camera].1.try_send(edge) {
                self.control.lost_edges.fetch_add(1, Ordering::Relaxed);
            }
        }
    }
}

impl Engine {
    pub(super) fn new(options: HsuOptions, lines: Vec<Line>, control: Arc<Control>) -> Self {
        let clock = RunningClock { origin: Instant::now(), clock: options.clock };
        *control.to_play.lock().unwrap_or_else(PoisonError::into_inner) = options.ltc.map(Some);
        Self {
            identity: options.identity,
            unit: Unit::new(options.identity),
            decoders: vec![Decoder::new(); lines.len()],
            world: World {
                clock,
                lines,
                cameras: options.cameras,
                edges: Vec::new(),
                control,
                injector: options.faults.map(Injector::new),
                shown: Shown { carry_on: options.carry_on, ..Shown::default() },
                deeds: Vec::new(),
            },
            next_frame_ns: 0,
            swinging: options.inputs.iter().map(|&(line, hz)| (line, (5e8 / hz) as u64, 0, true)).collect(),
            ltc: None,
            input: Vec::new(),
        }
    }

    pub(super) fn run(mut self) {
        stand_in_for_a_hardware_timer();
        while !self.world.control.stop.load(Ordering::Relaxed) {
            if self.world.control.power_cycle.swap(false, Ordering::Relaxed) {
                self.restart();
            }
            for (line, unplugged) in self.world.lines.iter_mut().zip(&self.world.control.unplugged) {
                let plugged = !unplugged.load(Ordering::Relaxed);
                if plugged != (line.fd() >= 0) {
                    line.set_plugged(plugged);
                }
            }
            let hangs = self.world.control.unresponsive.load(Ordering::Relaxed);
            if !hangs {
                self.keep_time();
                self.see_inputs();
                self.do_deeds();
                let now = Instant::now();
                self.world.lines.iter_mut().for_each(|line| line.write(now));
            }
            self.sleep(if hangs { Instant::now() + NAP } else { self.next_due() });
            self.take_input(hangs);
            self.write_disturbances_down();
        }
    }

    fn restart(&mut self) {
        self.unit = Unit::new(self.identity);
        self.world.edges.clear();
        self.world.session_output(false);
    }

    /// Carries out what was injected at the trigger that was just fired, and ends what is over.
    fn do_deeds(&mut self) {
        let mut deeds = std::mem::take(&mut self.world.deeds);
        if let Some(injector) = &mut self.world.injector {
            deeds.extend(injector.ended(Instant::now()));
        }
        for deed in deeds {
            match deed {
                Deed::Restart => self.restart(),
                Deed::Silence(link, silent) => {
                    if let Some(line) = self.world.lines.get_mut(link) {
                        line.set_silent(silent);
                    }
                }
                Deed::Unplug(link, unplugged) => {
                    if let Some(switch) = self.world.control.unplugged.get(link) {
                        switch.store(unplugged, Ordering::Relaxed);
                    }
                }
            }
        }
    }

    fn write_disturbances_down(&mut self) {
        for (link, line) in self.world.lines.iter_mut().enumerate() {
            let places = line.take_disturbed();
            if let Some(injector) = self.world.injector.as_ref().filter(|_| places > 0) {
                injector.disturbed(link);
            }
        }
    }

    fn keep_time(&mut self) {
        let now = Instant::now();
        self.world.raise_edges(now);
        let now_ns = self.world.clock.reading(now);
        if self.unit.next_due() <= now_ns {
            self.unit.tick(now_ns, &mut self.world);
        }
        if let Some(timing) = self.unit.timing().filter(|timing| timing.sync == Sync::ProjectorFrame)
            && now_ns >= self.next_frame_ns
        {
            self.next_frame_ns = now_ns.max(self.next_frame_ns.saturating_add(timing.period_ns));
            self.unit.frame_sync(now_ns, &mut self.world);
        }
    }

    /// The edges up to now, each with its time: a timer captures them, whenever the firmware comes to look.
    fn hear_time_code(&mut self, now_ns: u64) {
        while let Some((slope, time_ns)) = self.ltc.as_mut().and_then(|player| player.next(now_ns)) {
            self.unit.input(slope, time_ns, &mut self.world);
        }
        let control = &self.world.control;
        let to_play = control.to_play.lock().unwrap_or_else(PoisonError::into_inner).take();
        let Some(to_play) = to_play else { return };
        let mut played = control.played.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(last) = played.last_mut() {
            last.end_ns.get_or_insert(now_ns);
        }
        self.ltc = to_play.map(|source| Player::new(source, now_ns));
        played.extend(to_play.map(|source| Played { source, begin_ns: now_ns, end_ns: None }));
    }

    fn see_inputs(&mut self) {
        let now_ns = self.world.clock.reading(Instant::now());
        self.hear_time_code(now_ns);
        let pushed =
            std::mem::take(&mut *self.world.control.inputs.lock().unwrap_or_else(PoisonError::into_inner));
        for slope in pushed {
            self.unit.input(slope, now_ns, &mut self.world);
        }
        for (line, half_ns, due_ns, rising) in &mut self.swinging {
            if now_ns < *due_ns {
                continue;
            }
            if let Some(slope) = Slope::new(*line, *rising) {
                self.unit.input(slope, now_ns, &mut self.world);
            }
            *rising = !*rising;
            *due_ns = now_ns.saturating_add(*half_ns);
        }
    }

    fn next_due(&self) -> Instant {
        let mut due = self.unit.next_due();
        if self.unit.timing().is_some_and(|timing| timing.sync == Sync::ProjectorFrame) {
            due = due.min(self.next_frame_ns);
        }
        due = self.swinging.iter().fold(due, |due, (_, _, next_ns, _)| due.min(*next_ns));
        let due = self.world.clock.instant(due);
        self.world.edges.first().map_or(due, |(_, edge)| due.min(edge.time))
    }

    /// Sleeps until a host speaks or, at the latest, until shortly before `due`; then spins up to it.
    fn sleep(&self, due: Instant) {
        let left = due.saturating_duration_since(Instant::now());
        let exact = self.unit.state() == State::Running;
        if left <= SPIN {
            while exact && Instant::now() < due {
                std::hint::spin_loop();
            }
            return;
        }
        // A message that arrives in between is worth being awake, and not more.
        let message = self.world.lines.iter().filter_map(Line::next_due).min();
        let message = message.map_or(NAP, |at| at.saturating_duration_since(Instant::now()));
        let nap = if exact { left - SPIN } else { left }.min(NAP).min(message);
        let mut fds: Vec<libc::pollfd> = self.world.lines.iter().map(poll_for).collect();
        let timeout = libc::timespec { tv_sec: 0, tv_nsec: nap.subsec_nanos().into() };
        // SAFETY: the array and the time are live for the call, and the count is the array's; no signal mask.
        // A failure (a signal came) only shortens the sleep.
        unsafe { libc::ppoll(fds.as_mut_ptr(), fds.len() as libc::nfds_t, &timeout, std::ptr::null()) };
    }

    fn take_input(&mut self, hangs: bool) {
        for (link, decoder) in LinkId::ALL.into_iter().zip(&mut self.decoders) {
            let Some(line) = self.world.lines.get_mut(link.index()) else { continue };
            let bytes = &mut self.input;
            line.read(Instant::now(), bytes);
            if bytes.is_empty() {
                line.lift_exclusive_use();
                continue;
            }
            if hangs {
                continue;
            }
            let now_ns = self.world.clock.reading(Instant::now());
            let bad = decoder.errors().total();
            decoder.feed(bytes, |message| self.unit.receive(link, now_ns, message, &mut self.world));
            self.unit.bad_frames(link, decoder.errors().total().saturating_sub(bad));
        }
    }
}

/// A real unit fires from a timer that no other program delays. With the permission for it (CAP_SYS_NICE or an
/// rtprio limit) this thread comes close; without, late triggers are flagged as late, and nothing else.
fn stand_in_for_a_hardware_timer() {
    let lowest = libc::sched_param { sched_priority: 1 };
    // SAFETY: the parameter is live for the call; 0 is the calling thread. A refusal changes nothing.
    let refused = unsafe { libc::sched_setscheduler(0, libc::SCHED_RR, &lowest) } != 0;
    if refused {
        tracing::debug!("the simulated HSU runs without real-time priority: triggers may be late");
    }
}

fn poll_for(line: &Line) -> libc::pollfd {
    let events = if line.has_output() { libc::POLLIN | libc::POLLOUT } else { libc::POLLIN };
    libc::pollfd { fd: line.fd(), events, revents: 0 }
}

#[cfg(test)]
mod tests {
    use super::Shown;

    #[test]
    fn a_scene_goes_on_from_train_to_train_where_it_shall() {
        let trains = [-2, -1, 0, 1, -2, -1, 0, 1, 2, 0, -1, 0];
        let shown = |carry_on| -> Vec<i64> {
            let mut shown = Shown { carry_on, ..Shown::default() };
            trains.iter().map(|number| shown.instant(*number)).collect()
        };
        assert_eq!(shown(false), trains);
        assert_eq!(shown(true), [0, 0, 0, 1, 2, 2, 2, 3, 4, 5, 6, 6]);
    }
}
