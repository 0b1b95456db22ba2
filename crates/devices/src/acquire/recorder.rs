// SPDX-License-Identifier: MIT OR Apache-2.0
//! The recorder: its commands and events, and the thread that keeps the accounting.
//!
//! One thread matches frames to triggers and accounts for them, and never waits for the disk; behind a bounded ring
//! a second thread owns the recording.

use super::accounting::Accounting;
use super::hold::Hold;
use super::latencies::Latencies;
use super::preview::Taps;
use super::receiver::Arrival;
use super::writer_queue::Ring;
pub use super::writer_queue::Sink;
use crate::base::Fault;
use crate::base::ids::CameraId;
pub use crate::config::WhenFull;
use crate::matcher::Matcher;
use crate::record::{ClockSample, GapCause, NodeEvent, TriggerRecord, Verdict};
use crossbeam_channel::{Receiver, Sender, after, select};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

/// Commands of the node to the recorder. All times are ns.
#[derive(Debug)]
pub enum RecorderCommand {
    /// The HSU reported a trigger.
    Trigger(TriggerRecord),
    /// The HSU reported a warm-up trigger, fired at `hsu_time_ns` (HSU clock) and reported at `host_time_ns` (host clock).
    /// Its number is negative; its frames are recognized and not recorded. `late`: the HSU flags it as late.
    WarmUp { number: i64, hsu_time_ns: u64, late: bool, host_time_ns: u64 },
    /// Nothing was triggered before this time (host clock): frames that arrived earlier belong to no trigger.
    Silent { until_ns: u64 },
    /// A clock exchange with the HSU or a camera, for the fits and for the recording.
    Clock(ClockSample),
    /// An event for the recording.
    Event(NodeEvent),
    /// A camera is lost: frames that are missing from now on are missing for this cause.
    CameraLost(usize, GapCause),
    /// The cause for which a lost camera is away is now known to be this one.
    CameraAway(usize, GapCause),
    /// A lost camera is back, with a fresh stream: its block ids begin anew, its clock may have been reset, and frames of
    /// earlier streams are not recorded any more.
    CameraBack { camera: usize, stream: u32 },
    /// Record was pressed: the recording begins with trigger `first` of the train, as far as its frames are held.
    /// `pressed`: the newest trigger of which all nodes had the frames at that moment.
    Keep { first: u64, pressed: u64 },
    /// No more triggers will come: wait for their frames, then report it. `emitted`: the HSU's count of triggers.
    Drain { emitted: Option<u64> },
    /// Account for what is missing, write the verdict, close, and end. `aborted`: why the session ended early.
    Close { aborted: Option<String> },
    /// Close without a verdict and end: the recording will be removed.
    Discard,
}

impl RecorderCommand {
    fn is_last(&self) -> bool {
        matches!(self, Self::Close { .. } | Self::Discard)
    }
}

/// Events of the recorder for the node. `camera` is the place in the node's list.
#[derive(Debug)]
pub enum RecorderEvent {
    /// The frames of all triggers are in, or will not come any more.
    Drained,
    /// The ring was full for the first time, and the configuration requires a stop. `why`: the cause, where it was not the
    /// disk.
    RingFull { why: Option<String> },
    /// The trigger of a camera's frame is in doubt: the camera's clock should be read now.
    Doubtful { camera: usize },
    /// The warm-up is over. `unknown`: why the camera's place in the train is not known; `None`: it has become known.
    Place { camera: usize, unknown: Option<String> },
    /// Writing failed: nothing more can be recorded.
    Failed(Fault),
    /// The recording is closed, with this verdict.
    Closed(Result<Verdict, Fault>),
}

/// Counters that other threads read while the recorder runs. Lists have one entry per camera, in the node's order.
#[derive(Debug, Default)]
pub struct Progress {
    /// Triggers reported; where frames are held, those from the recording's first on.
    pub triggers: AtomicU64,
    /// The oldest trigger whose frames are held before Record.
    pub held_from: AtomicU64,
    /// One more than the newest trigger whose frames are held before Record.
    pub held_to: AtomicU64,
    /// Room for held frames, of all cameras together.
    pub held_room: AtomicU64,
    /// Packets received from each camera, or frames where the transport has no packets.
    pub activity: Vec<AtomicU64>,
    /// Frames taken from each camera's stream, complete or not.
    pub received: Vec<AtomicU64>,
    /// Frames written to the recording, per camera.
    pub frames: Vec<AtomicU64>,
    /// Gap records written, per camera.
    pub gaps: Vec<AtomicU64>,
    /// Gap records written per camera and cause, in the order of [`GapCause::ALL`].
    pub causes: Vec<[AtomicU64; GapCause::ALL.len()]>,
    /// Turns of the matching thread: the count grows as long as the thread lives.
    pub recorder_turns: AtomicU64,
    /// Turns of the writer's thread: the count grows as long as the thread lives.
    pub writer_turns: AtomicU64,
    /// Most frames that were waiting at any time, in the ring or before it.
    pub high_water: AtomicU64,
    /// Most frames that were in the ring at any time, without those that are held for Record.
    pub ring_high_water: AtomicU64,
    /// Frames in the ring now, including those that are held for Record.
    pub ring: AtomicU64,
    /// Frames dropped because the ring was full.
    pub dropped: AtomicU64,
    /// Times that frames took, stage by stage.
    pub latencies: Latencies,
}

impl Progress {
    /// Frames that wait for the writer, without those that are held for Record.
    pub fn in_ring(&self) -> u64 {
        self.ring.load(Ordering::Relaxed).saturating_sub(self.held_room.load(Ordering::Relaxed))
    }

    /// Counts a gap record of a camera.
    pub(super) fn gap(&self, camera: usize, cause: GapCause) {
        if let Some((gaps, causes)) = self.gaps.get(camera).zip(self.causes.get(camera)) {
            gaps.fetch_add(1, Ordering::Relaxed);
            causes[cause as usize].fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Counters at zero for this number of cameras.
    pub fn new(cameras: usize) -> Self {
        let zeros = || (0..cameras).map(|_| AtomicU64::new(0)).collect();
        Self {
            activity: zeros(),
            received: zeros(),
            frames: zeros(),
            gaps: zeros(),
            causes: (0..cameras).map(|_| Default::default()).collect(),
            ..Self::default()
        }
    }
}

/// Bounds and times of a recorder; the bounds follow from the number of blocks.
#[derive(Debug, Clone, Copy)]
pub struct RecorderOptions {
    /// Time between two triggers, ns.
    pub period_ns: u64,
    /// Memory blocks of each camera, which limit all frames under way.
    pub buffers_per_camera: usize,
    /// Triggers before Record whose frame sets are held at most; 0: nothing is held, the recording begins with the train.
    pub held_sets: usize,
    /// Whether a full ring drops frame sets or stops the session.
    pub when_full: WhenFull,
    /// How long a frame waits for the report of its trigger. Time in which the process stood still does not count.
    pub report_patience: Duration,
    /// How long a frame set waits for its last outcome.
    pub set_patience: Duration,
    /// After the last trigger, how long no frame may arrive before the rest is given up.
    pub drain_patience: Duration,
}

/// [`RecorderOptions::report_patience`] in trigger periods, and its least value: enough for a report over a busy link.
const REPORT_PERIODS: (u32, Duration) = (48, Duration::from_millis(400));
/// [`RecorderOptions::set_patience`] in trigger periods, and its least value: the cameras of a trigger finish close together.
const SET_PERIODS: (u32, Duration) = (6, Duration::from_millis(50));
/// [`RecorderOptions::drain_patience`] in trigger periods, and its least value: frames and reports behind a pause still arrive.
const DRAIN_PERIODS: (u32, Duration) = (180, Duration::from_millis(1500));

impl RecorderOptions {
    /// The patience for a trigger period, as sessions use it.
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

    /// Most frames of one camera that wait for reports: a quarter of the blocks.
    pub fn waiting_frames(&self) -> usize {
        (self.buffers_per_camera / 4).max(1)
    }

    /// Most frame sets that are assembled at a time: a sixteenth of the blocks.
    pub fn open_sets(&self) -> usize {
        (self.buffers_per_camera / 16).max(2)
    }
}

/// A camera's name, image size in pixels, and matcher.
pub struct LaneSetup {
    pub id: CameraId,
    pub width: u32,
    pub height: u32,
    pub matcher: Matcher,
}

/// The recorder of one session: the thread that matches frames to triggers and accounts for them. The node starts it when
/// the cameras are armed. It owns the accounting, and the writer's thread behind it owns the recording. It promises that
/// every trigger of every camera ends with a frame or a gap record. It ends with [`RecorderCommand::Close`] or
/// [`RecorderCommand::Discard`], or when all senders of commands are gone.
pub struct Recorder {
    accounting: Accounting,
    progress: Arc<Progress>,
    arrivals: Receiver<Arrival>,
    commands: Receiver<RecorderCommand>,
}

/// Longest sleep of the matching thread: then it checks the frames that wait.
pub(super) const TICK: Duration = Duration::from_millis(10);

/// The channels of a recorder: frames of the receivers, commands of the node, and events for the node.
#[derive(Debug)]
pub struct Channels {
    pub arrivals: Receiver<Arrival>,
    pub commands: Receiver<RecorderCommand>,
    pub events: Sender<RecorderEvent>,
}

impl Recorder {
    /// Starts the threads, which write to `sink`: a recording, or a dry run. The handle is that of the matching thread,
    /// which waits for the writer's. Previews and the live body take samples of the frames through `taps`.
    pub fn start(
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
                        // Commands that were sent before the frame arrived come first: reports, clocks, a fresh stream.
                        let last = self.handle_all();
                        self.accounting.frame_arrived(arrival, waiting);
                        if let Some(last) = last {
                            return self.end(last);
                        }
                    }
                    // The receivers have ended; the last command is still to come.
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

    /// Handles all commands that wait; returns the last command of the session if it is among them.
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
