// SPDX-License-Identifier: MIT OR Apache-2.0
//! Commands to the recorder, its events, and its parameters.

use crate::base::Fault;
use crate::base::ids::CameraId;
use crate::config::WhenFull;
use crate::matcher::Matcher;
use crate::record::{ClockSample, GapCause, NodeEvent, TriggerRecord, Verdict};
use std::time::Duration;

/// Commands of the node to the recorder. All times are ns.
#[derive(Debug)]
pub enum RecorderCommand {
    /// The HSU reported a trigger.
    Trigger(TriggerRecord),
    /// The HSU reported a warm-up trigger, fired at `hsu_time_ns` (HSU clock) and reported at `host_time_ns` (host
    /// clock). Its number is negative; its frames are recognized and not recorded. `late`: the HSU flags it as late.
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
    /// A lost camera is back, with a fresh stream: its block ids begin anew, its clock may have been reset, and
    /// frames of earlier streams are not recorded any more.
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
    /// Whether the recorder ends with this command.
    pub(super) fn is_last(&self) -> bool {
        matches!(self, Self::Close { .. } | Self::Discard)
    }
}

/// Events of the recorder for the node. `camera` is the place in the node's list.
#[derive(Debug)]
pub enum RecorderEvent {
    /// The frames of all triggers are in, or will not come any more.
    Drained,
    /// The ring was full for the first time, and the configuration requires a stop. `why`: the cause, where it was
    /// not the disk.
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

/// Bounds and times of a recorder; the bounds follow from the number of blocks.
#[derive(Debug, Clone, Copy)]
pub struct RecorderOptions {
    /// Time between two triggers, ns.
    pub period_ns: u64,
    /// Memory blocks of each camera, which limit all frames under way.
    pub buffers_per_camera: usize,
    /// Triggers before Record whose frame sets are held at most; 0: nothing is held, the recording begins with the
    /// train.
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
/// [`RecorderOptions::set_patience`] in trigger periods, and its least value: the cameras of a trigger finish close
/// together.
const SET_PERIODS: (u32, Duration) = (6, Duration::from_millis(50));
/// [`RecorderOptions::drain_patience`] in trigger periods, and its least value: frames and reports behind a pause
/// still arrive.
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

/// Longest sleep of the matching thread: then it checks the frames that wait.
pub(super) const TICK: Duration = Duration::from_millis(10);
