//! The writer's thread: matches frames to triggers and writes them, with a gap record for whatever is missing.

use super::matcher::{Match, Matcher, TriggerTable, Witness};
use super::receiver::Arrival;
use crate::camera::Transfer;
use crate::cmds::Exit;
use crate::ids::{CameraId, TriggerIndex};
use crate::record::{
    ClockSample, FrameMeta, GapCause, NodeEvent, RecordError, Recording, SessionEnd, TriggerRecord, Verdict,
};
use crate::session::state::Fault;
use crate::time::host_time_ns;
use crossbeam_channel::{Receiver, Sender, after, select};
use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// What the node tells the recorder.
#[derive(Debug)]
pub enum ToRecorder {
    /// The HSU reported a trigger.
    Trigger(TriggerRecord),
    /// The HSU reported a warm-up trigger: its frames are recognized and not recorded.
    WarmUp {
        /// Its number, negative.
        number: i64,
        /// When it was fired, HSU clock, ns.
        hsu_time_ns: u64,
    },
    /// A clock exchange with the HSU or a camera, for the fits and for the record.
    Clock(ClockSample),
    /// Something happened, for the record.
    Event(NodeEvent),
    /// A camera is gone: what is missing from now on is missing for that reason.
    CameraLost(usize),
    /// The camera is back with a fresh stream: its block ids begin anew, its clock may have been reset.
    CameraBack(usize),
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

/// What the recorder tells the node.
#[derive(Debug)]
pub enum FromRecorder {
    /// The frames of all triggers are in, or will not come any more.
    Drained,
    /// The ring was full for the first time, and the configuration says to stop then.
    RingFull,
    /// Writing failed: nothing more can be recorded.
    Failed(Fault),
    /// The recording is closed.
    Closed(Result<Verdict, Fault>),
}

/// Counters that others may look at while the recorder runs.
#[derive(Debug)]
pub struct Progress {
    /// Triggers reported.
    pub triggers: AtomicU64,
    /// Packets (or whatever else shows that it sends) seen from each camera: the receivers count them.
    pub heard: Vec<AtomicU64>,
    /// Frames taken off each camera's stream, whatever became of them.
    pub received: Vec<AtomicU64>,
    /// Frames written, per camera.
    pub frames: Vec<AtomicU64>,
    /// Gap records written, per camera.
    pub gaps: Vec<AtomicU64>,
    /// Most frames that were waiting at any time.
    pub high_water: AtomicU64,
}

impl Progress {
    /// All zero.
    pub fn new(cameras: usize) -> Self {
        let zeros = || (0..cameras).map(|_| AtomicU64::new(0)).collect();
        Self {
            triggers: AtomicU64::new(0),
            heard: zeros(),
            received: zeros(),
            frames: zeros(),
            gaps: zeros(),
            high_water: AtomicU64::new(0),
        }
    }
}

/// How long a frame waits for the report of its trigger before its block id must do.
const REPORT_PATIENCE: Duration = Duration::from_millis(400);
/// After the last trigger, how long no frame may arrive before the rest is given up.
const DRAIN_PATIENCE: Duration = Duration::from_millis(1500);

/// One camera, as the recorder sees it.
struct Lane {
    id: CameraId,
    width: u32,
    height: u32,
    matcher: Matcher,
    pending: VecDeque<Arrival>,
    /// The first trigger without an outcome.
    next: u64,
    lost: bool,
    /// Frames that no trigger explains.
    spurious: u64,
}

/// The recorder's side of a session.
pub struct Recorder {
    recording: Recording,
    lanes: Vec<Lane>,
    triggers: TriggerTable,
    progress: Arc<Progress>,
    arrivals: Receiver<Arrival>,
    commands: Receiver<ToRecorder>,
    events: Sender<FromRecorder>,
    draining: bool,
    /// How many triggers there were, once the HSU said so.
    emitted: Option<u64>,
    /// When a frame last got its trigger.
    last_settled: Instant,
    failed: bool,
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

impl Recorder {
    /// Starts the thread.
    pub fn start(
        recording: Recording,
        lanes: Vec<LaneSetup>,
        progress: Arc<Progress>,
        arrivals: Receiver<Arrival>,
        commands: Receiver<ToRecorder>,
        events: Sender<FromRecorder>,
    ) -> std::io::Result<JoinHandle<()>> {
        let lane = |setup: LaneSetup| Lane {
            id: setup.id,
            width: setup.width,
            height: setup.height,
            matcher: setup.matcher,
            pending: VecDeque::new(),
            next: 0,
            lost: false,
            spurious: 0,
        };
        let recorder = Self {
            recording,
            lanes: lanes.into_iter().map(lane).collect(),
            triggers: TriggerTable::default(),
            progress,
            arrivals,
            commands,
            events,
            draining: false,
            emitted: None,
            last_settled: Instant::now(),
            failed: false,
        };
        std::thread::Builder::new().name("recorder".to_owned()).spawn(move || recorder.run())
    }

    fn run(mut self) {
        loop {
            let (arrivals, commands) = (self.arrivals.clone(), self.commands.clone());
            select! {
                recv(arrivals) -> arrival => if let Ok(arrival) = arrival { self.take(arrival) },
                recv(commands) -> command => match command {
                    Ok(ToRecorder::Close { aborted }) => return self.close(aborted),
                    Ok(ToRecorder::Discard) | Err(_) => return,
                    Ok(command) => self.obey(command),
                },
                recv(after(Duration::from_millis(20))) -> _ => {
                    (0..self.lanes.len()).for_each(|camera| self.advance(camera));
                    self.attempt(Recording::tick);
                }
            }
            self.look_whether_drained();
        }
    }

    fn take(&mut self, arrival: Arrival) {
        let camera = arrival.camera;
        self.lanes[camera].pending.push_back(arrival);
        let waiting: usize =
            self.lanes.iter().map(|lane| lane.pending.len()).sum::<usize>() + self.arrivals.len();
        self.progress.high_water.fetch_max(waiting as u64, Ordering::Relaxed);
        self.advance(camera);
    }

    fn obey(&mut self, command: ToRecorder) {
        match command {
            ToRecorder::Trigger(record) => {
                self.triggers.insert(record.index, record.hsu_time_ns);
                self.progress.triggers.store(self.triggers.len(), Ordering::Relaxed);
                self.attempt(|recording| recording.trigger(&record));
                (0..self.lanes.len()).for_each(|camera| self.advance(camera));
            }
            ToRecorder::Clock(sample) => self.attempt(|recording| recording.clock_sample(&sample)),
            ToRecorder::Event(event) => self.attempt(|recording| recording.event(&event)),
            ToRecorder::WarmUp { .. } => {}
            ToRecorder::CameraLost(camera) => self.lanes[camera].lost = true,
            ToRecorder::CameraBack(camera) => self.lanes[camera].lost = false,
            ToRecorder::Drain { emitted } => {
                self.draining = true;
                self.emitted = emitted.or(self.emitted);
                self.last_settled = Instant::now();
            }
            ToRecorder::Close { .. } | ToRecorder::Discard => {}
        }
    }

    /// Writes what is decided of a camera's frames, in order.
    fn advance(&mut self, camera: usize) {
        while let Some(arrival) = self.lanes[camera].pending.pop_front() {
            let last_call = arrival.taken.elapsed() > REPORT_PATIENCE;
            let lane = &mut self.lanes[camera];
            match lane.matcher.assign(
                arrival.block_id,
                arrival.camera_ns,
                arrival.host_ns,
                &self.triggers,
                last_call,
            ) {
                Match::Wait => return lane.pending.push_front(arrival),
                Match::Trigger(trigger, witness) => self.settle(trigger, witness, arrival),
                Match::Spurious(residual_ns) => {
                    self.spurious(&arrival, &format!("lies {residual_ns} ns from the nearest trigger"));
                }
                Match::BeforeTrain => self.spurious(&arrival, "came before the first trigger"),
                Match::Repeated(last) => self.note(
                    camera,
                    "repeated_frame",
                    Some(last),
                    format!("block {} is not later than the frame before it; not recorded", arrival.block_id),
                ),
            }
        }
    }

    /// Gives the trigger of `arrival`, and those before it that have none, an outcome.
    fn settle(&mut self, trigger: TriggerIndex, witness: Witness, arrival: Arrival) {
        if self.emitted.is_some_and(|emitted| trigger.0 >= emitted) {
            return self.spurious(&arrival, "came after the last trigger");
        }
        let camera = arrival.camera;
        self.last_settled = Instant::now();
        let (mut skipped, mut cause) = (self.lanes[camera].next..trigger.0, GapCause::MissingPackets);
        if let Witness::Corrected { expected } = witness {
            cause = GapCause::NotTriggered;
            let text = format!(
                "block {} was expected at trigger {expected}, its timestamp says {trigger}",
                arrival.block_id
            );
            self.note(camera, "identity_corrected", Some(trigger), text);
            // Ids that did skip are frames lost on the way, whatever else happened.
            if expected.0 > skipped.start && expected < trigger {
                self.gaps(camera, skipped.start..expected.0, GapCause::MissingPackets);
                skipped.start = expected.0;
            }
        }
        self.gaps(camera, skipped, cause);
        self.lanes[camera].next = trigger.0 + 1;
        match gap_cause(arrival.transfer) {
            Some(cause) => self.gap(camera, trigger, cause),
            None => self.write(camera, trigger, arrival),
        }
    }

    fn write(&mut self, camera: usize, trigger: TriggerIndex, arrival: Arrival) {
        let lane = &self.lanes[camera];
        let meta = FrameMeta {
            trigger,
            block: arrival.block_id,
            camera_time_ns: arrival.camera_ns,
            host_time_ns: arrival.host_ns,
            width: lane.width,
            height: lane.height,
            pixels_crc: arrival.pixels_crc,
        };
        match self.recording.frame_in_place(camera, &meta, arrival.block) {
            Ok(()) => drop(self.progress.frames[camera].fetch_add(1, Ordering::Relaxed)),
            // The recording has accounted for the frame as dropped.
            Err(error) => {
                self.progress.gaps[camera].fetch_add(1, Ordering::Relaxed);
                self.fail(&error.to_string());
            }
        }
    }

    /// A frame that no trigger explains: a free-running camera makes many, so only the first is an event.
    fn spurious(&mut self, arrival: &Arrival, why: &str) {
        let lane = &mut self.lanes[arrival.camera];
        lane.spurious += 1;
        if lane.spurious == 1 {
            let text = format!("block {} {why}; not recorded (later ones are counted)", arrival.block_id);
            self.note(arrival.camera, "spurious_frame", None, text);
        }
    }

    fn gaps(&mut self, camera: usize, triggers: std::ops::Range<u64>, cause: GapCause) {
        triggers.for_each(|trigger| self.gap(camera, TriggerIndex(trigger), cause));
    }

    fn gap(&mut self, camera: usize, trigger: TriggerIndex, cause: GapCause) {
        self.progress.gaps[camera].fetch_add(1, Ordering::Relaxed);
        self.attempt(|recording| recording.gap(camera, trigger, cause));
    }

    fn note(&mut self, camera: usize, kind: &str, trigger: Option<TriggerIndex>, message: String) {
        let id = self.lanes[camera].id.clone();
        tracing::warn!(camera = %id, kind, "{message}");
        let event = NodeEvent {
            host_time_ns: host_time_ns(),
            kind: kind.to_owned(),
            camera: Some(id),
            trigger,
            message,
        };
        self.attempt(|recording| recording.event(&event));
    }

    /// Writes a small record; the first failure is reported.
    fn attempt(&mut self, write: impl FnOnce(&mut Recording) -> Result<(), RecordError>) {
        if let Err(error) = write(&mut self.recording) {
            self.fail(&error.to_string());
        }
    }

    fn fail(&mut self, message: &str) {
        if !std::mem::replace(&mut self.failed, true) {
            tracing::error!("recording failed: {message}");
            drop(self.events.send(FromRecorder::Failed(Fault::new(Exit::Failure, message))));
        }
    }

    fn look_whether_drained(&mut self) {
        if !self.draining {
            return;
        }
        let all_in = self.emitted.is_some_and(|n| self.lanes.iter().all(|lane| lane.lost || lane.next >= n));
        let quiet = self.last_settled.elapsed() > DRAIN_PATIENCE && self.arrivals.is_empty();
        if all_in || quiet {
            self.draining = false;
            drop(self.events.send(FromRecorder::Drained));
        }
    }

    /// Gap records for the frames of the last triggers, which nothing later can prove missing.
    fn give_up_until(&mut self, triggers: u64) {
        for camera in 0..self.lanes.len() {
            let lane = &mut self.lanes[camera];
            let cause = if lane.lost { GapCause::Unplugged } else { GapCause::Timeout };
            let missing = lane.next..triggers;
            lane.next = lane.next.max(triggers);
            self.gaps(camera, missing, cause);
        }
    }

    fn close(mut self, aborted: Option<String>) {
        // Frames that still wait get their outcome by block id.
        for camera in 0..self.lanes.len() {
            self.lanes[camera].pending.iter_mut().for_each(|arrival| arrival.taken -= REPORT_PATIENCE * 2);
            self.advance(camera);
            let count = self.lanes[camera].spurious;
            if count > 1 {
                self.note(
                    camera,
                    "spurious_frames",
                    None,
                    format!("{count} frames that no trigger explains"),
                );
            }
        }
        self.give_up_until(self.emitted.unwrap_or(0).max(self.triggers.len()));
        let end = SessionEnd {
            triggers_emitted: self.emitted,
            aborted,
            absent: GapCause::Unknown,
            host_time_ns: host_time_ns(),
        };
        let verdict = self.recording.finish(end).map_err(|e| Fault::new(Exit::DataLoss, e));
        drop(self.events.send(FromRecorder::Closed(verdict)));
    }
}

fn gap_cause(transfer: Transfer) -> Option<GapCause> {
    match transfer {
        Transfer::Complete => None,
        Transfer::MissingPackets | Transfer::Unwritten => Some(GapCause::MissingPackets),
        Transfer::Timeout => Some(GapCause::Timeout),
        Transfer::SizeMismatch => Some(GapCause::SizeMismatch),
        Transfer::Aborted => Some(GapCause::Aborted),
    }
}
