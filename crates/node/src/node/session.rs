// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a node holds while it is in a session: the request, the threads that record it, and its outcome.

use super::camera_keeper::{CameraKeeper, Report};
use super::devices::PreparedCamera;
use super::event_kind::{self, EventKind};
use super::hsu_keeper::HsuKeeper;
use super::silence::SilenceWatch;
use crate::acquire::recorder::{Progress, RecorderCommand, RecorderEvent, Sink};
use crate::base::ids::CameraId;
use crate::base::time::HostClock;
use crate::control::request::{KeepRequest, SessionRequest};
use crate::control::status::{CameraProgress, Held, Outcome, SessionStatus};
use crate::host::realtime;
use crate::hsu::Hsu;
use crate::record::NodeEvent;
use crossbeam_channel::{Receiver, Sender, never, unbounded};
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread::JoinHandle;
use std::time::Instant;

/// A session from its preparation on. The node's thread makes it for each request, and it owns the threads that record
/// it until they have ended. Its outcome stays in the status until the next session is prepared.
pub(crate) struct Session {
    pub(crate) request: SessionRequest,
    pub(crate) dir: PathBuf,
    pub(crate) cameras: Vec<PreparedCamera>,
    pub(crate) destination: Option<Box<dyn Sink>>,
    pub(crate) progress: Arc<Progress>,
    pub(crate) to_recorder: Option<Sender<RecorderCommand>>,
    pub(crate) from_recorder: Receiver<RecorderEvent>,
    pub(crate) recorder: Option<JoinHandle<()>>,
    /// The host's clock of this session.
    pub(crate) clock: HostClock,
    /// One per camera while streams run.
    pub(crate) attendants: Vec<CameraKeeper>,
    pub(crate) reports: Receiver<Report>,
    pub(crate) reports_in: Sender<Report>,
    pub(crate) link_keeper: Option<HsuKeeper>,
    pub(crate) links: Receiver<Arc<Hsu>>,
    pub(crate) links_in: Sender<Arc<Hsu>>,
    /// Number of the next trigger that the HSU will report.
    pub(crate) next_trigger: i64,
    pub(crate) silence: SilenceWatch,
    /// When a trigger was last reported.
    pub(crate) last_trigger: Option<Instant>,
    /// Since when the line to the HSU is lost.
    pub(crate) link_lost: Option<Instant>,
    pub(crate) outcome: Option<Outcome>,
    pub(crate) kept: Option<KeepRequest>,
    /// Frames that fit into the ring.
    pub(crate) ring_capacity: u64,
    /// Notices that the operator must see at once, by their subject.
    notices: BTreeMap<String, String>,
    /// How many of the process's warnings are in the recording.
    warnings_recorded: usize,
}

impl Session {
    pub(crate) fn new(request: SessionRequest, dir: PathBuf, cameras: usize) -> Self {
        // At most one report a camera and a second; a node without a session drops them.
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
            last_trigger: None,
            link_lost: None,
            outcome: None,
            kept: None,
            ring_capacity: 0,
            notices: BTreeMap::new(),
            warnings_recorded: 0,
        }
    }

    pub(crate) fn has_cameras(&mut self, cameras: Vec<PreparedCamera>) {
        self.silence = SilenceWatch::new(cameras.len());
        self.cameras = cameras;
    }

    pub(crate) fn send(&self, message: RecorderCommand) {
        if let Some(recorder) = &self.to_recorder {
            // A recorder that is gone is noticed by its event channel.
            drop(recorder.send(message));
        }
    }

    /// An event of this session, now.
    pub(crate) fn event(
        &self,
        kind: EventKind,
        camera: Option<CameraId>,
        text: impl Into<String>,
    ) -> NodeEvent {
        kind.event(self.clock.now(), camera, text)
    }

    pub(crate) fn record(&self, event: NodeEvent) {
        self.send(RecorderCommand::Event(event));
    }

    /// Logs an event as a warning, and records it.
    pub(crate) fn warn(&self, event: NodeEvent) {
        event_kind::warn(&event);
        self.record(event);
    }

    /// Shows the operator a notice at once; `None`: the notice on this subject does not hold any more.
    pub(crate) fn notice(&mut self, about: &str, text: Option<String>) {
        match text {
            Some(text) => drop(self.notices.insert(about.to_owned(), text)),
            None => drop(self.notices.remove(about)),
        }
    }

    /// Puts the system's refusals into the recording, once each.
    pub(crate) fn record_warnings(&mut self) {
        if self.to_recorder.is_none() {
            return;
        }
        let warnings = realtime::warnings();
        for warning in warnings.iter().skip(self.warnings_recorded) {
            let (kind, message) = (warning.kind.to_owned(), warning.message.clone());
            let host_time_ns = self.clock.now();
            self.record(NodeEvent { host_time_ns, kind, camera: None, trigger: None, message });
        }
        self.warnings_recorded = warnings.len();
    }

    /// Ends the recorder's thread, if it has not ended by itself.
    pub(crate) fn end_recorder(&mut self) {
        self.send(RecorderCommand::Discard);
        self.to_recorder = None;
        self.from_recorder = never();
        if let Some(thread) = self.recorder.take()
            && thread.join().is_err()
        {
            tracing::error!("the recorder panicked");
        }
    }

    /// The session's part of the node's status; `holding`: it waits for Record.
    pub(crate) fn status(&self, holding: bool) -> SessionStatus {
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
            held: (holding && self.outcome.is_none()).then(|| Held {
                oldest: load(&self.progress.held_from),
                end: load(&self.progress.held_to),
                asked: self.request.pre_triggers,
            }),
            kept: self.kept,
            cameras: cameras.collect(),
            ring_frames: self.progress.in_ring(),
            ring_capacity: self.ring_capacity,
            ring_high_water_frames: load(&self.progress.high_water),
            written: self.progress.latencies.written.summary(),
            total: self.progress.latencies.total.summary(),
            notices: self.notices.values().cloned().collect(),
            outcome: self.outcome.clone(),
        }
    }
}
