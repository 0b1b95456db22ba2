//! What a node holds while it is in a session: the request, the threads that record it, and its outcome.

use super::attendant::{Attendant, Report};
use super::devices::PreparedCamera;
use super::link::LinkKeeper;
use super::silence::SilenceWatch;
use super::state::SessionRequest;
use crate::acquire::realtime;
use crate::acquire::recorder::{Destination, FromRecorder, Progress, ToRecorder};
use crate::api::dto::{CameraProgress, Outcome, SessionStatus};
use crate::hsu::Hsu;
use crate::record::NodeEvent;
use crate::time::HostClock;
use crossbeam_channel::{Receiver, Sender, never, unbounded};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread::JoinHandle;
use std::time::Instant;

/// A session from its preparation on.
pub(super) struct Session {
    pub(super) request: SessionRequest,
    pub(super) dir: PathBuf,
    pub(super) cameras: Vec<PreparedCamera>,
    pub(super) destination: Option<Destination>,
    pub(super) progress: Arc<Progress>,
    pub(super) to_recorder: Option<Sender<ToRecorder>>,
    pub(super) from_recorder: Receiver<FromRecorder>,
    pub(super) recorder: Option<JoinHandle<()>>,
    /// The host's clock of this session.
    pub(super) clock: HostClock,
    /// One per camera while streams run.
    pub(super) attendants: Vec<Attendant>,
    pub(super) reports: Receiver<Report>,
    pub(super) reports_in: Sender<Report>,
    pub(super) link_keeper: Option<LinkKeeper>,
    pub(super) links: Receiver<Arc<Hsu>>,
    pub(super) links_in: Sender<Arc<Hsu>>,
    /// Number of the next trigger that the HSU will report.
    pub(super) next_trigger: i64,
    pub(super) silence: SilenceWatch,
    /// When a trigger was last reported.
    pub(super) listened: Option<Instant>,
    pub(super) outcome: Option<Outcome>,
    /// How many of the process's warnings are in the recording.
    warnings_told: usize,
}

impl Session {
    pub(super) fn new(request: SessionRequest, dir: PathBuf, cameras: usize) -> Self {
        // At most one report a camera and a second; whoever has no session any more drops them.
        let (reports_in, reports) = unbounded();
        let (links_in, links) = unbounded();
        Self {
            request,
            dir,
            cameras: Vec::new(),
            destination: None,
            progress: Arc::new(Progress::new(cameras)),
            to_recorder: None,
            from_recorder: never(),
            recorder: None,
            clock: HostClock::start(),
            attendants: Vec::new(),
            reports,
            reports_in,
            link_keeper: None,
            links,
            links_in,
            next_trigger: 0,
            silence: SilenceWatch::new(cameras),
            listened: None,
            outcome: None,
            warnings_told: 0,
        }
    }

    pub(super) fn has_cameras(&mut self, cameras: Vec<PreparedCamera>) {
        self.silence = SilenceWatch::new(cameras.len());
        self.cameras = cameras;
    }

    pub(super) fn tell(&self, message: ToRecorder) {
        if let Some(recorder) = &self.to_recorder {
            // A recorder that is gone is noticed by its event channel.
            drop(recorder.send(message));
        }
    }

    /// Puts what the system refused into the recording, once each.
    pub(super) fn tell_warnings(&mut self) {
        if self.to_recorder.is_none() {
            return;
        }
        let warnings = realtime::warnings();
        for warning in warnings.iter().skip(self.warnings_told) {
            self.tell(ToRecorder::Event(NodeEvent {
                host_time_ns: self.clock.now(),
                kind: warning.kind.to_owned(),
                camera: None,
                trigger: None,
                message: warning.message.clone(),
            }));
        }
        self.warnings_told = warnings.len();
    }

    /// Ends the recorder's thread, if it has not ended by itself.
    pub(super) fn end_recorder(&mut self) {
        self.tell(ToRecorder::Discard);
        self.to_recorder = None;
        self.from_recorder = never();
        if let Some(thread) = self.recorder.take()
            && thread.join().is_err()
        {
            tracing::error!("the recorder panicked");
        }
    }

    pub(super) fn status(&self) -> SessionStatus {
        let load = |counter: &std::sync::atomic::AtomicU64| counter.load(Ordering::Relaxed);
        let cameras = self.cameras.iter().enumerate().map(|(i, camera)| CameraProgress {
            id: camera.id.clone(),
            frames: self.progress.frames.get(i).map_or(0, load),
            gaps: self.progress.gaps.get(i).map_or(0, load),
            silent: self.outcome.is_none() && self.silence.is_silent(i),
        });
        SessionStatus {
            session_id: self.request.session_id,
            name: self.request.name.clone(),
            nodes: self.request.nodes.clone(),
            directory: self.dir.clone(),
            dry_run: self.request.dry_run,
            triggers_asked: self.request.triggers,
            triggers: load(&self.progress.triggers),
            cameras: cameras.collect(),
            ring_high_water_frames: load(&self.progress.high_water),
            written: self.progress.latencies.written.summary(),
            total: self.progress.latencies.total.summary(),
            outcome: self.outcome.clone(),
        }
    }
}
