// SPDX-License-Identifier: MIT OR Apache-2.0
//! A simulated HSU: the firmware's own state machine behind two real ptys, and wires to the cameras.
//!
//! A host opens the pty with `serialport` like any serial device; nothing in the product knows of this
//! module. One thread a unit waits for bytes and for the next trigger.

mod disturb;
mod engine;
mod inject;
mod line;
mod ltc;

pub use disturb::{Jitter, LineFaults};
pub use ltc::LtcSource;

use crate::faults::HsuFaults;
use crate::wire::TriggerEdge;
use crossbeam_channel::Sender;
use hsu_firmware_proto::{Identity, LINKS, NodeName, Slope, TimeCode};
use line::Line;
use ltc::Played;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// The unit's clock against the host's monotonic one.
#[derive(Debug, Clone, Copy)]
pub struct HsuClock {
    /// What it shows when the simulation starts, ns.
    pub offset_ns: u64,
    /// How much faster it runs than the host's, parts per million.
    pub drift_ppm: f64,
}

impl Default for HsuClock {
    fn default() -> Self {
        Self { offset_ns: 1_000_000_000, drift_ppm: 0.0 }
    }
}

/// An [`HsuClock`] that runs, with the host's time at which it began.
#[derive(Debug, Clone, Copy)]
struct RunningClock {
    origin: Instant,
    clock: HsuClock,
}

impl RunningClock {
    fn rate(&self) -> f64 {
        1.0 + self.clock.drift_ppm * 1e-6
    }

    /// The unit's reading at an instant, ns.
    fn reading(&self, at: Instant) -> u64 {
        let elapsed = at.saturating_duration_since(self.origin).as_nanos() as f64 * self.rate();
        self.clock.offset_ns.saturating_add(elapsed as u64)
    }

    /// The first instant with at least this reading.
    fn instant(&self, reading_ns: u64) -> Instant {
        let elapsed = reading_ns.saturating_sub(self.clock.offset_ns) as f64 / self.rate();
        self.origin + Duration::from_nanos(elapsed.ceil() as u64)
    }
}

/// The options of a simulated HSU: links, identity, clock and faults.
#[derive(Debug, Clone)]
pub struct HsuOptions {
    /// Where to put a link to the serial device of each of the unit's sockets: one or two paths. A link left
    /// behind by an earlier run is replaced; any other file is not.
    pub links: Vec<PathBuf>,
    /// The trigger wires: the number of the head that each belongs to, and its camera's end.
    pub cameras: Vec<(usize, Sender<TriggerEdge>)>,
    /// The identity that the unit reports.
    pub identity: Identity,
    pub clock: HsuClock,
    /// What the serial lines do to what they carry.
    pub line: Option<LineFaults>,
    /// What else goes wrong, at which triggers.
    pub faults: Option<HsuFaults>,
    /// What the cameras are shown goes on from train to train instead of starting anew with each: the board of a
    /// calibration walk stands elsewhere in the next session.
    pub carry_on: bool,
    /// Inputs that swing by themselves: line and frequency in Hz. More come by [`SimulatedHsu::input`].
    pub inputs: Vec<(u8, f64)>,
    /// Time code that is played into an input from the beginning. [`SimulatedHsu::play`] changes it.
    pub ltc: Option<LtcSource>,
}

impl Default for HsuOptions {
    fn default() -> Self {
        Self {
            links: Vec::new(),
            cameras: Vec::new(),
            identity: Identity {
                name: NodeName::new("fourdbody-hsu").unwrap_or_default(),
                unique_id: *b"SIMULATED-000001",
                firmware: [1, 0, 0],
            },
            clock: HsuClock::default(),
            line: None,
            faults: None,
            carry_on: false,
            inputs: Vec::new(),
            ltc: None,
        }
    }
}

/// What tests may do to a running unit, and see of it.
#[derive(Debug, Default)]
struct Control {
    stop: AtomicBool,
    unresponsive: AtomicBool,
    power_cycle: AtomicBool,
    unplugged: [AtomicBool; LINKS],
    fired: AtomicU64,
    late: AtomicU64,
    lost_edges: AtomicU64,
    /// Edges of input lines that the unit has not seen yet.
    inputs: Mutex<Vec<Slope>>,
    /// All time code so far; what is played is the last, and has no end.
    played: Mutex<Vec<Played>>,
    /// What is to be played instead from now on.
    to_play: Mutex<Option<Option<LtcSource>>>,
    output_high: AtomicBool,
    output_rises: AtomicU64,
}

/// A unit that runs until it is dropped.
#[derive(Debug)]
pub struct SimulatedHsu {
    control: Arc<Control>,
    thread: Option<JoinHandle<()>>,
    links: Vec<PathBuf>,
}

impl SimulatedHsu {
    /// Opens the ptys and switches the unit on. Fails if a path is taken by something that is not a link, or
    /// the system has no pty left.
    pub fn start(options: HsuOptions) -> io::Result<Self> {
        if options.links.is_empty() || options.links.len() > LINKS {
            let message = format!("a unit has 1 to {LINKS} links, found {}", options.links.len());
            return Err(io::Error::new(io::ErrorKind::InvalidInput, message));
        }
        let links = options.links.iter().enumerate();
        let lines: Vec<Line> =
            links.map(|(number, path)| Line::open(path, options.line, number)).collect::<io::Result<_>>()?;
        let control = Arc::new(Control::default());
        let links = options.links.clone();
        let engine = engine::Engine::new(options, lines, control.clone());
        let thread = std::thread::Builder::new().name("sim-hsu".into()).spawn(move || engine.run())?;
        Ok(Self { control, thread: Some(thread), links })
    }

    /// The serial devices, in the order of the unit's sockets.
    pub fn links(&self) -> &[PathBuf] {
        &self.links
    }

    /// The serial device of a socket.
    ///
    /// # Panics
    /// If the unit was started without it.
    pub fn link(&self, index: usize) -> &Path {
        &self.links[index]
    }

    /// A hanging unit: takes bytes, but answers nothing and fires nothing.
    pub fn set_unresponsive(&self, unresponsive: bool) {
        self.control.unresponsive.store(unresponsive, Ordering::Relaxed);
    }

    /// Takes the power away for a moment: the unit forgets everything but its clock.
    pub fn power_cycle(&self) {
        self.control.power_cycle.store(true, Ordering::Relaxed);
    }

    /// Pulls the serial cable of a socket, or puts it in again.
    ///
    /// # Panics
    /// If a unit has no such socket.
    pub fn set_plugged(&self, index: usize, plugged: bool) {
        self.control.unplugged[index].store(!plugged, Ordering::Relaxed);
    }

    /// Triggers fired since the start, warm-up included.
    pub fn fired(&self) -> u64 {
        self.control.fired.load(Ordering::Relaxed)
    }

    /// Triggers among them that were late.
    pub fn late(&self) -> u64 {
        self.control.late.load(Ordering::Relaxed)
    }

    /// Edges for which a camera's wire had no room: its end is not being read.
    pub fn lost_edges(&self) -> u64 {
        self.control.lost_edges.load(Ordering::Relaxed)
    }

    /// An edge of an input line.
    ///
    /// # Panics
    /// If a unit has no such line.
    pub fn input(&self, line: u8, rising: bool) {
        let slope = Slope::new(line, rising).expect("a line of the unit");
        self.control.inputs.lock().unwrap_or_else(PoisonError::into_inner).push(slope);
    }

    /// Plays time code into an input from now on, in place of what was played so far; `None`: silence.
    pub fn play(&self, ltc: Option<LtcSource>) {
        *self.control.to_play.lock().unwrap_or_else(PoisonError::into_inner) = Some(ltc);
    }

    /// The time code that was played at a time of the unit's clock, and how much of its frame had gone by.
    pub fn time_code_at(&self, time_ns: u64) -> Option<(TimeCode, f64)> {
        let played = self.control.played.lock().unwrap_or_else(PoisonError::into_inner);
        played.iter().find_map(|played| played.at(time_ns))
    }

    /// Whether the session's output is high, and how often it rose.
    pub fn output(&self) -> (bool, u64) {
        (self.control.output_high.load(Ordering::Relaxed), self.control.output_rises.load(Ordering::Relaxed))
    }

    /// Switches the unit off and removes its serial devices; the same as dropping it.
    pub fn stop(self) {}
}

impl Drop for SimulatedHsu {
    fn drop(&mut self) {
        self.control.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // A panic in the engine has already been printed; a drop must not add another.
            let _ = thread.join();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{HsuClock, RunningClock};
    use proptest::prelude::{prop_assert, proptest};
    use std::time::Instant;

    proptest! {
        /// The engine sleeps until `instant(due)`: if the clock did not show `due` then, it would spin.
        #[test]
        fn clock_shows_what_it_was_asked_to_wait_for(
            offset_ns in 0u64..1 << 50, drift_ppm in -200.0..200.0, ahead_ns in 0u64..1 << 45,
        ) {
            let clock = RunningClock { origin: Instant::now(), clock: HsuClock { offset_ns, drift_ppm } };
            let reading = clock.reading(clock.instant(offset_ns + ahead_ns));
            prop_assert!(reading.abs_diff(offset_ns + ahead_ns) <= 1);
        }
    }
}
