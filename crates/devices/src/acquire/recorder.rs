// SPDX-License-Identifier: MIT OR Apache-2.0
//! The recorder: what the node tells it, what it says, and the thread that keeps the accounting.
//!
//! One thread matches frames to triggers and accounts for them, and never waits for the disk; behind a bounded ring
//! a second one owns the recording.

use super::accounting::Accounting;
use super::dry_run::DryRun;
use super::hold::Hold;
use super::latencies::Latencies;
use super::preview::Taps;
use super::receiver::Arrival;
use super::writer_queue::{Ring, Sink};
use crate::base::Fault;
use crate::base::ids::CameraId;
pub use crate::config::WhenFull;
use crate::matcher::Matcher;
use crate::record::{ClockSample, GapCause, NodeEvent, Recording, TriggerRecord, Verdict};
use crossbeam_channel::{Receiver, Sender, after, select};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

/// What the node tells the recorder.
#[derive(Debug)]
pub enum RecorderCommand {
    /// The HSU reported a trigger.
    Trigger(TriggerRecord),
    /// The HSU reported a warm-up trigger: its frames are recognized and not recorded.
    WarmUp {
        /// Its number, negative.
        number: i64,
        /// When it was fired, HSU clock, ns.
        hsu_time_ns: u64,
        /// Whether the HSU flags it as late.
        late: bool,
        /// When the report arrived, host clock, ns.
        host_time_ns: u64,
    },
    /// Nothing was triggered until then: what cameras sent before is no trigger's.
    Silent {
        /// Host clock, ns.
        until_ns: u64,
    },
    /// A clock exchange with the HSU or a camera, for the fits and for the record.
    Clock(ClockSample),
    /// Something happened, for the record.
    Event(NodeEvent),
    /// A camera is away: what is missing from now on is missing for this reason.
    CameraLost(usize, GapCause),
    /// Why a camera is away turned out to be this.
    CameraAway(usize, GapCause),
    /// The camera is back: its block ids begin anew, its clock may have been reset.
    CameraBack {
        /// The camera.
        camera: usize,
        /// The number of its fresh stream; frames of the ones before are not recorded any more.
        stream: u32,
    },
    /// Record was pressed: what is held from trigger `first` of the train on is the recording, which begins with it.
    Keep {
        /// The first.
        first: u64,
        /// The newest trigger of which all nodes had the frames when it was pressed.
        pressed: u64,
    },
    /// No more triggers will come: wait for their frames, then say so.
    Drain {
        /// How many triggers there were, where the HSU said so.
        emitted: Option<u64>,
    },
    /// Account for what is missing, write the verdict, close, and end.
    Close {
        /// Why the session did not end as asked for.
        aborted: Option<String>,
    },
    /// Close without a verdict and end: the recording will be removed.
    Discard,
}

impl RecorderCommand {
    fn is_last(&self) -> bool {
        matches!(self, Self::Close { .. } | Self::Discard)
    }
}

/// What the recorder tells the node.
#[derive(Debug)]
pub enum RecorderEvent {
    /// The frames of all triggers are in, or will not come any more.
    Drained,
    /// The ring was full for the first time, and the configuration says to stop then.
    RingFull {
        /// Why, where it was not the disk.
        why: Option<String>,
    },
    /// What a camera's frames are of is in doubt: its clock should be read now.
    Doubtful {
        /// Its place in the node's list.
        camera: usize,
    },
    /// The warm-up is over, and whether a camera's place in the train is known.
    Place {
        /// Its place in the node's list.
        camera: usize,
        /// Why it is not; `None`: it is, after it was not.
        unknown: Option<String>,
    },
    /// Writing failed: nothing more can be recorded.
    Failed(Fault),
    /// The recording is closed.
    Closed(Result<Verdict, Fault>),
}

/// Counters that others may look at while the recorder runs.
#[derive(Debug)]
pub struct Progress {
    /// Triggers reported; where frames are held, those from the recording's first on.
    pub triggers: AtomicU64,
    /// Where frames are held before Record: the oldest trigger that is.
    pub held_from: AtomicU64,
    /// One more than the newest.
    pub held_to: AtomicU64,
    /// Frames of all cameras that may be held.
    pub held_room: AtomicU64,
    /// Packets (or whatever else shows that it sends) seen from each camera: the receivers count them.
    pub heard: Vec<AtomicU64>,
    /// Frames taken off each camera's stream, whatever became of them.
    pub received: Vec<AtomicU64>,
    /// Frames written, per camera.
    pub frames: Vec<AtomicU64>,
    /// Gap records written, per camera.
    pub gaps: Vec<AtomicU64>,
    /// The same by cause, per camera: in the order of [`GapCause::ALL`].
    pub causes: Vec<[AtomicU64; GapCause::ALL.len()]>,
    /// Times that the thread which keeps the accounting went round: grows as long as it lives.
    pub recorder_turns: AtomicU64,
    /// Times that the writer's thread went round.
    pub writer_turns: AtomicU64,
    /// Most frames that were waiting at any time, in the ring or before it.
    pub high_water: AtomicU64,
    /// Most frames that were in the ring at any time, beyond those that are held for Record.
    pub ring_high_water: AtomicU64,
    /// Frames in the ring now, those that are held for Record among them.
    pub ring: AtomicU64,
    /// Frames dropped because the ring was full.
    pub dropped: AtomicU64,
    /// How long frames took.
    pub latencies: Latencies,
}

impl Progress {
    /// Frames that wait for the writer, beyond those that are held for Record.
    pub fn in_ring(&self) -> u64 {
        self.ring.load(Ordering::Relaxed).saturating_sub(self.held_room.load(Ordering::Relaxed))
    }

    /// Counts a gap record.
    pub(super) fn gap(&self, camera: usize, cause: GapCause) {
        if let Some((gaps, causes)) = self.gaps.get(camera).zip(self.causes.get(camera)) {
            gaps.fetch_add(1, Ordering::Relaxed);
            causes[cause as usize].fetch_add(1, Ordering::Relaxed);
        }
    }

    /// All zero.
    pub fn new(cameras: usize) -> Self {
        let zeros = || (0..cameras).map(|_| AtomicU64::new(0)).collect();
        Self {
            triggers: AtomicU64::new(0),
            held_from: AtomicU64::new(0),
            held_to: AtomicU64::new(0),
            held_room: AtomicU64::new(0),
            heard: zeros(),
            received: zeros(),
            frames: zeros(),
            gaps: zeros(),
            causes: (0..cameras).map(|_| Default::default()).collect(),
            recorder_turns: AtomicU64::new(0),
            writer_turns: AtomicU64::new(0),
            high_water: AtomicU64::new(0),
            ring_high_water: AtomicU64::new(0),
            ring: AtomicU64::new(0),
            dropped: AtomicU64::new(0),
            latencies: Latencies::default(),
        }
    }
}

/// Bounds and times of a recorder.
#[derive(Debug, Clone, Copy)]
pub struct RecorderOptions {
    /// Trigger period, ns.
    pub period_ns: u64,
    /// Blocks of each camera: what all bounds derive from.
    pub buffers_per_camera: usize,
    /// Triggers before Record whose frame sets are held at most; 0: nothing is held, the recording begins with the train.
    pub held_sets: usize,
    /// What happens when the ring is full.
    pub when_full: WhenFull,
    /// How long a frame waits for the report of its trigger. Time in which the process stood still does not count.
    pub report_patience: Duration,
    /// How long a frame set waits for its last outcome.
    pub set_patience: Duration,
    /// After the last trigger, how long no frame may arrive before the rest is given up.
    pub drain_patience: Duration,
}

/// Periods of [`RecorderOptions::report_patience`], and its floor.
const REPORT_PERIODS: (u32, Duration) = (48, Duration::from_millis(400));
/// Periods of [`RecorderOptions::set_patience`], and its floor.
const SET_PERIODS: (u32, Duration) = (6, Duration::from_millis(50));
/// Periods of [`RecorderOptions::drain_patience`], and its floor.
const DRAIN_PERIODS: (u32, Duration) = (180, Duration::from_millis(1500));

impl RecorderOptions {
    /// The usual patience for a trigger period.
    pub fn new(period_ns: u64, buffers_per_camera: usize, when_full: WhenFull) -> Self {
        let patience = |(periods, floor): (u32, Duration)| {
            Duration::from_nanos(period_ns.saturating_mul(periods.into())).max(floor)
        };
        Self {
            period_ns,
            buffers_per_camera,
            held_sets: 0,
            when_full,
            report_patience: patience(REPORT_PERIODS),
            set_patience: patience(SET_PERIODS),
            drain_patience: patience(DRAIN_PERIODS),
        }
    }

    /// Frame sets that the ring holds: three eighths of the blocks. With the next two bounds and the writer's two
    /// chunks this leaves Aravis a share at all times; see docs/design/acquisition.md.
    pub fn ring_sets(&self) -> usize {
        (self.buffers_per_camera * 3 / 8).max(1)
    }

    /// Frames of one camera that wait for reports: a quarter of the blocks.
    pub fn waiting_frames(&self) -> usize {
        (self.buffers_per_camera / 4).max(1)
    }

    /// Frame sets that are being assembled: a sixteenth of the blocks.
    pub fn open_sets(&self) -> usize {
        (self.buffers_per_camera / 16).max(2)
    }
}

/// A camera's name, image size and matcher.
pub struct LaneSetup {
    /// The camera.
    pub id: CameraId,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Its matcher.
    pub matcher: Matcher,
}

/// Where frames go.
pub enum Destination {
    /// To the disk.
    Recording(Box<Recording>),
    /// Nowhere: they are counted.
    DryRun(Box<DryRun>),
}

/// The recorder's side of a session.
pub struct Recorder {
    accounting: Accounting,
    progress: Arc<Progress>,
    arrivals: Receiver<Arrival>,
    commands: Receiver<RecorderCommand>,
}

/// Without news the thread looks at what waits this often.
pub(super) const TICK: Duration = Duration::from_millis(10);

/// What a recorder hears and says.
#[derive(Debug)]
pub struct Channels {
    /// Frames, from the cameras' receivers.
    pub arrivals: Receiver<Arrival>,
    /// From the node.
    pub commands: Receiver<RecorderCommand>,
    /// To the node.
    pub events: Sender<RecorderEvent>,
}

impl Recorder {
    /// Starts the threads. The handle is that of the first one, which waits for the second. Previews and the live body look
    /// at the frames through `taps`.
    pub fn start(
        destination: Destination,
        taps: [Arc<Taps>; 2],
        lanes: Vec<LaneSetup>,
        options: RecorderOptions,
        progress: Arc<Progress>,
        channels: Channels,
    ) -> std::io::Result<JoinHandle<()>> {
        let sink: Box<dyn Sink> = match destination {
            Destination::Recording(recording) => recording,
            Destination::DryRun(run) => run,
        };
        Self::start_with(sink, taps, lanes, options, progress, channels)
    }

    pub(super) fn start_with(
        sink: Box<dyn Sink>,
        taps: [Arc<Taps>; 2],
        lanes: Vec<LaneSetup>,
        options: RecorderOptions,
        progress: Arc<Progress>,
        Channels { arrivals, commands, events }: Channels,
    ) -> std::io::Result<JoinHandle<()>> {
        let cameras = lanes.len().max(1);
        let room = (options.ring_sets() * cameras, options.held_sets * cameras);
        let hold = (options.held_sets > 0).then(|| Hold::new(options.held_sets as u64));
        let ring = Ring::start(sink, room, hold, taps, Arc::clone(&progress), events.clone())?;
        let accounting = Accounting::new(lanes, options, Arc::clone(&progress), ring, events);
        let recorder = Self { accounting, progress, arrivals, commands };
        std::thread::Builder::new().name("recorder".to_owned()).spawn(move || {
            crate::host::realtime::enter_configured("recorder");
            recorder.run()
        })
    }

    fn run(mut self) {
        loop {
            let waiting = self.arrivals.len();
            self.accounting.begin_turn();
            self.progress.recorder_turns.fetch_add(1, Ordering::Relaxed);
            select! {
                recv(self.arrivals) -> arrival => match arrival {
                    Ok(arrival) => {
                        // What was said before a frame arrived comes first: reports, clocks, a fresh stream.
                        if let Some(last) = self.handle_all() {
                            self.accounting.frame_arrived(arrival, waiting);
                            return self.end(last);
                        }
                        self.accounting.frame_arrived(arrival, waiting);
                    }
                    // The receivers are gone; their last words are commands.
                    Err(_) => self.arrivals = crossbeam_channel::never(),
                },
                recv(self.commands) -> command => match command {
                    Ok(command) if command.is_last() => return self.end(command),
                    Ok(command) => self.accounting.handle(command),
                    Err(_) => return self.accounting.discard(),
                },
                recv(after(TICK)) -> _ => self.accounting.advance_all(),
            }
            self.accounting.check_drained(self.arrivals.is_empty());
        }
    }

    /// Obeys what has been said so far; a last word is returned.
    fn handle_all(&mut self) -> Option<RecorderCommand> {
        while let Ok(command) = self.commands.try_recv() {
            if command.is_last() {
                return Some(command);
            }
            self.accounting.handle(command);
        }
        None
    }

    fn end(mut self, last: RecorderCommand) {
        let RecorderCommand::Close { aborted } = last else { return self.accounting.discard() };
        while let Ok(arrival) = self.arrivals.try_recv() {
            self.accounting.frame_arrived(arrival, 0);
        }
        self.accounting.close(aborted);
    }
}

#[cfg(test)]
mod tests;
