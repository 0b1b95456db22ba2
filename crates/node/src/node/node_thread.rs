// SPDX-License-Identifier: MIT OR Apache-2.0
//! The node's thread: carries out the actions of the state machine, and feeds it with events.

use super::devices::Devices;
use super::event_kind::{self, EventKind};
use super::session::Session;
use super::session_lock::SessionLock;
use super::state_machine::{Action, Event, Machine};
use crate::acquire::preview::Taps;
use crate::acquire::recorder::{RecorderCommand, RecorderOptions};
use crate::base::ids::CameraId;
use crate::base::time::host_time_ns;
use crate::base::{Exit, Fault};
use crate::camera::CameraBackend;
use crate::config::NodeConfig;
use crate::control::command::{Command, Reply, SharedStatus};
use crate::control::request::{ExposureRequest, KeepRequest, Phase, SessionRequest};
use crate::control::status::{ExposureSet, NodeStatus, Outcome, SessionCommand};
use crate::host::process_limits::ProcessMemory;
use crate::host::{heap, realtime};
use crate::hsu::{ArmRequest, Hsu, HsuError, SessionId, Slope};
use crate::record::{free_bytes, node_dir};
use crate::telemetry::{Current, Telemetry};
use crossbeam_channel::{Receiver, Sender, bounded, never, select};
use std::collections::VecDeque;
use std::path::PathBuf;
use std::sync::atomic::Ordering;
use std::sync::{Arc, RwLock};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// The running node, as the program holds it. `fourdbody node` starts it with the node file and the camera library; it
/// owns the devices and the session in progress. It publishes its status after every event, and ends a session in
/// progress with a verdict before it ends itself.
pub struct NodeThread {
    /// Where the API sends commands.
    pub commands: Sender<Command>,
    /// The status as the node's thread last published it.
    pub status: SharedStatus,
    /// Samples of frames: for previews, and for the live body.
    pub taps: [Arc<Taps>; 2],
    /// The counters of the node's threads.
    pub telemetry: Arc<Telemetry>,
    stop: Sender<()>,
    thread: JoinHandle<()>,
}

/// Longest time between two turns of the thread.
const TICK: Duration = Duration::from_millis(100);
/// A thread whose last turn is older than this did not run, or waited for a device.
const ASLEEP: Duration = Duration::from_secs(1);

impl NodeThread {
    /// Starts the node's thread, which opens the devices.
    pub fn start(config: NodeConfig, backend: Box<dyn CameraBackend>) -> std::io::Result<Self> {
        heap::give_large_blocks_back();
        realtime::configure(&config.realtime);
        let devices = Devices::new(&config, backend);
        let (commands, inbox) = bounded(16);
        let (stop, stopped) = bounded(1);
        let status = Arc::new(RwLock::new(NodeStatus {
            node: config.node.clone(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            rig: config.rig.name.clone(),
            trigger_rate_hz: config.rig.trigger_rate_hz,
            rig_nodes: config.rig.nodes().into_iter().collect(),
            phase: Phase::Idle,
            cameras: devices.camera_statuses(),
            hsu: devices.hsu_status(),
            warnings: Vec::new(),
            sessions_dir: config.sessions_dir.clone(),
            free_bytes: 0,
            interrupted: Vec::new(),
            session: None,
            preview: None,
            live_preview: config.live_preview,
            judgements: Vec::new(),
            worker: None,
            age_s: 0.0,
            published: None,
        }));
        let period = Duration::from_secs_f64(1.0 / config.rig.trigger_rate_hz);
        let taps =
            [(); 2].map(|()| Arc::new(Taps::new(config.cameras.iter().map(|camera| camera.id.clone()))));
        let telemetry = Arc::new(Telemetry::default());
        let lock = SessionLock::of_service().unwrap_or_else(|error| {
            tracing::warn!("RUNTIME_DIRECTORY: {error}; an upgrade of the package could end a session");
            SessionLock::default()
        });
        let node = Node {
            machine: Machine::new(period),
            config,
            devices,
            session: None,
            taps: taps.clone(),
            telemetry: Arc::clone(&telemetry),
            memory: ProcessMemory::at_start(),
            lock,
            pending: None,
            waiting: None,
            status: Arc::clone(&status),
            origin: Instant::now(),
            ticked: Instant::now(),
        };
        let thread =
            std::thread::Builder::new().name("node".to_owned()).spawn(move || node.run(&inbox, &stopped))?;
        Ok(Self { commands, status, taps, telemetry, stop, thread })
    }

    /// Asks for the end: a session in progress is ended with its verdict, then the thread. Does not wait.
    pub fn request_stop(&self) {
        // One request is enough, and a thread that is gone already needs no telling.
        let _ = self.stop.try_send(());
    }

    /// Whether the thread has ended, and the published status is its last.
    pub fn has_ended(&self) -> bool {
        self.thread.is_finished()
    }

    /// Ends a session in progress with its verdict, then the thread.
    pub fn shut_down(self) {
        self.request_stop();
        if self.thread.join().is_err() {
            tracing::error!("the node's thread panicked");
        }
    }
}

pub(crate) struct Node {
    pub(crate) config: NodeConfig,
    pub(crate) devices: Devices,
    pub(crate) machine: Machine,
    pub(crate) session: Option<Session>,
    pub(crate) taps: [Arc<Taps>; 2],
    pub(crate) telemetry: Arc<Telemetry>,
    /// What this process had before its first session.
    pub(crate) memory: ProcessMemory,
    /// Held from before the preparation until the recording is closed.
    lock: SessionLock,
    /// Answers the request for the preparation under way.
    pending: Option<Reply>,
    /// What a preview gives way to, while it ends.
    waiting: Option<Command>,
    status: SharedStatus,
    /// From here on time is counted, but for the times in which this thread did not run.
    origin: Instant,
    ticked: Instant,
}

impl Node {
    fn run(mut self, commands: &Receiver<Command>, stopped: &Receiver<()>) {
        let mut stopping = false;
        loop {
            let hsu = self.devices.hsu().map_or_else(never, |hsu| hsu.events().clone());
            let recorder = self.session.as_ref().map_or_else(never, |s| s.from_recorder.clone());
            let reports = self.session.as_ref().map_or_else(never, |s| s.reports.clone());
            let links = self.session.as_ref().map_or_else(never, |s| s.links.clone());
            select! {
                recv(commands) -> command => if let Ok(command) = command { self.command(command) },
                recv(hsu) -> event => match event {
                    Ok(event) => self.hsu_event(event),
                    Err(_) => self.hsu_gone("its link ended".to_owned()),
                },
                recv(recorder) -> event => match event {
                    Ok(event) => self.recorder_event(event),
                    Err(_) => self.recorder_gone(),
                },
                recv(reports) -> report => if let Ok(report) = report { self.attendant_reports(report) },
                recv(links) -> hsu => if let Ok(hsu) = hsu { self.link_back(hsu) },
                recv(stopped) -> _ => {
                    stopping = true;
                    // Its client hears that the node shuts down.
                    self.waiting = None;
                    self.take(Event::Abort("the node was shut down".to_owned()));
                }
                default(TICK) => {}
            }
            self.tick();
            if stopping && self.machine.phase() == Phase::Idle {
                break;
            }
        }
    }

    fn tick(&mut self) {
        self.telemetry.node_turns.fetch_add(1, Ordering::Relaxed);
        let asleep = std::mem::replace(&mut self.ticked, Instant::now()).elapsed();
        if asleep > ASLEEP {
            // The reports of the meantime are still in the queues: no device was silent, only this thread.
            self.origin += asleep;
            if self.machine.train_runs() {
                let text = format!("the node's thread did not run for {:.1} s", asleep.as_secs_f64());
                self.note(EventKind::NodeAsleep, None, text);
            }
        }
        self.take(Event::Tick);
        if self.machine.phase() == Phase::Idle
            && let Some(command) = self.waiting.take()
        {
            self.command(command);
        }
        if self.machine.phase() == Phase::Idle {
            self.lock.give_back();
            // Opening one device may take seconds: the state of the others is published before.
            if self.devices.notice_lost() {
                self.publish();
            }
            self.devices.look_after();
        }
        self.in_session(Session::record_warnings);
        self.publish();
    }

    fn command(&mut self, command: Command) {
        if self.gives_way_to(&command) {
            self.waiting = Some(command);
            return self.take(Event::Abort("the preview gives way".to_owned()));
        }
        match command {
            Command::Prepare(request, reply) => self.prepare(request, reply),
            Command::Start(command, reply) => self.session_command(&command, reply, Event::Start),
            Command::Keep(request, reply) => drop(reply.send(self.keep(&request))),
            Command::Stop(command, reply) => self.session_command(&command, reply, Event::Stop),
            Command::Abort(command, reply) => {
                let reason = command.reason.clone().unwrap_or_else(|| "aborted by the operator".to_owned());
                if self.give_up_waiting(&command, &reason) {
                    return drop(reply.send(Ok(())));
                }
                self.session_command(&command, reply, Event::Abort(reason));
            }
            Command::Expose(request, reply) => drop(reply.send(self.expose(&request))),
        }
    }

    /// Whether a preview has to end before this can be carried out. One command waits at a time.
    fn gives_way_to(&self, command: &Command) -> bool {
        let in_preview = self.machine.request().is_some_and(|request| request.preview);
        let wants_the_cameras = match command {
            Command::Prepare(request, _) => !request.preview,
            Command::Expose(..) => true,
            _ => false,
        };
        in_preview && wants_the_cameras && self.waiting.is_none()
    }

    /// Ends a session that waits for a preview to end; `false`: it is not this one.
    fn give_up_waiting(&mut self, command: &SessionCommand, reason: &str) -> bool {
        let ours = |waiting: &Command| matches!(waiting, Command::Prepare(request, _) if request.session_id == command.session_id);
        let Some(Command::Prepare(_, reply)) = self.waiting.take_if(|waiting| ours(waiting)) else {
            return false;
        };
        drop(reply.send(Err(Fault::new(Exit::Failure, reason))));
        true
    }

    fn prepare(&mut self, request: SessionRequest, reply: Reply) {
        let dir = match self.accept(&request) {
            Ok(dir) => dir,
            Err(message) => return drop(reply.send(Err(Fault::new(Exit::Usage, message)))),
        };
        // A preview keeps no restart waiting.
        if !request.preview
            && let Err(fault) = self.lock.take(&request.name)
        {
            return drop(reply.send(Err(fault)));
        }
        tracing::info!(session = request.name, triggers = request.triggers, "preparing");
        self.pending = Some(reply);
        let mut session = Session::new(request.clone(), dir, self.config.cameras.len());
        session.ring_capacity = self.ring_frames();
        self.telemetry.begin(Current {
            progress: Arc::clone(&session.progress),
            disk: None,
            ring_capacity: session.ring_capacity,
        });
        self.session = Some(session);
        self.take(Event::Prepare(request));
    }

    /// Where this node records a session; or why it cannot take part in it.
    fn accept(&self, request: &SessionRequest) -> Result<PathBuf, String> {
        let (node, phase) = (&self.config.node, self.machine.phase());
        if phase != Phase::Idle {
            return Err(format!("the node is busy with a session ({phase:?})"));
        }
        let name = request.check()?;
        if !request.nodes.contains(node) {
            return Err(format!("the session is for other nodes, this one is {node}"));
        }
        if let Some(edge) = request.start_on {
            if self.config.trigger.action().is_some() {
                return Err(format!(
                    "a start at the {edge}; expected an HSU, which has inputs: this node triggers by action commands"
                ));
            }
            if Some(edge.line) == self.devices.unit().time_code_input() {
                return Err(format!(
                    "a start at the {edge}; expected another input: input {} carries time code (hsu.time_code_input)",
                    edge.line
                ));
            }
        }
        Ok(node_dir(&self.config.sessions_dir.join(name.as_str()), node))
    }

    /// Sets exposure and gain between sessions.
    fn expose(&mut self, request: &ExposureRequest) -> Result<ExposureSet, Fault> {
        let phase = self.machine.phase();
        if phase != Phase::Idle {
            return Err(Fault::new(
                Exit::Usage,
                format!(
                    "the node is in a session ({phase:?}): exposure and gain are set between sessions; end it first"
                ),
            ));
        }
        let set = self.devices.expose(request)?;
        for camera in &set.cameras {
            let (exposure_us, gain_db) = (camera.exposure_us, camera.gain_db);
            tracing::info!(camera = %camera.id, exposure_us, gain_db, "exposure and gain are set");
            self.telemetry.applied(&camera.id, camera.settings.clone());
        }
        Ok(set)
    }

    /// Frames that fit into the ring of a session.
    fn ring_frames(&self) -> u64 {
        let period_ns = (1e9 / self.config.rig.trigger_rate_hz) as u64;
        let options = RecorderOptions::new(period_ns, self.config.buffers_per_camera, self.config.when_full);
        (options.ring_sets() * self.config.cameras.len()) as u64
    }

    fn session_command(&mut self, command: &SessionCommand, reply: Reply, event: Event) {
        let ours = self.machine.request().is_some_and(|request| request.session_id == command.session_id);
        let phase = self.machine.phase();
        let usage = |message: String| Err(Fault::new(Exit::Usage, message));
        let answer = match event {
            _ if !ours => usage("the node is not in this session".to_owned()),
            Event::Start if phase != Phase::Ready => {
                usage(format!("the session cannot be started, it is {phase:?}"))
            }
            // The answer to a start is the HSU's.
            Event::Start => {
                let actions = self.machine.step(event, self.origin.elapsed());
                if actions.contains(&Action::StartTrain) { self.start_on_hsu() } else { Ok(()) }
            }
            _ => {
                self.take(event);
                Ok(())
            }
        };
        drop(reply.send(answer));
    }

    /// Steps the machine, and carries out its actions until there are no more.
    pub(crate) fn take(&mut self, event: Event) {
        let mut events = VecDeque::from([event]);
        while let Some(event) = events.pop_front() {
            let begins = matches!(event, Event::Prepare(_));
            let preparing = begins || self.machine.phase() == Phase::Preparing;
            let actions = self.machine.step(event, self.origin.elapsed());
            if begins {
                // Devices take their time: the status shows meanwhile for which session.
                self.publish();
            }
            for action in actions {
                let step = preparing && !matches!(action, Action::ReportReady | Action::ReportFailed(_));
                let still = self.machine.phase() == Phase::Preparing;
                match self.act(action) {
                    Ok(()) if step && still => events.push_back(Event::StepDone),
                    Ok(()) => {}
                    Err(fault) if still => events.push_back(Event::Failed(fault)),
                    // An action that undoes or ends something is tried, and its failure is logged.
                    Err(fault) => tracing::warn!("{}", fault.message),
                }
            }
        }
        self.publish();
    }

    fn act(&mut self, action: Action) -> Result<(), Fault> {
        match action {
            Action::PrepareDevices => {
                let cameras = self.devices.prepare()?;
                for camera in &cameras {
                    self.telemetry.applied(&camera.id, camera.settings.clone());
                }
                self.in_session(|session| session.has_cameras(cameras));
                self.check_memory()?;
            }
            Action::CreateRecording => self.create_recording()?,
            Action::StartStreams => self.start_streams()?,
            Action::SilenceGate => self.silence_gate()?,
            Action::ArmHsu => {
                let Some(session) = &self.session else { return Ok(()) };
                let request = session.request.clone();
                let Some(hsu) = self.devices.hsu() else { return Err(hsu_missing()) };
                let arm = ArmRequest {
                    session: hsu_session(request.session_id),
                    triggers: (request.triggers > 0).then_some(request.triggers),
                    warm_up: self.config.rig.warm_up_triggers,
                    nodes: request.nodes,
                };
                hsu.arm(&arm).map_err(hsu_fault)?;
                self.in_session(|session| session.next_trigger = -i64::from(arm.warm_up));
            }
            Action::ReportReady => self.answer(Ok(())),
            Action::ReportFailed(fault) => {
                tracing::warn!("session failed: {}", fault.message);
                self.in_session(|session| session.outcome = Some(Outcome::Failed(fault.clone())));
                self.answer(Err(fault));
            }
            Action::StartTrain => self.start_on_hsu()?,
            Action::StopTrain => self.on_hsu(|hsu, session| hsu.stop(session))?,
            Action::DisarmHsu => self.on_hsu(|hsu, session| hsu.disarm(session))?,
            Action::StopStreams => self.stop_streams(),
            Action::DiscardRecording => self.discard_recording()?,
            Action::Keep(KeepRequest { first, pressed, .. }) => {
                self.in_session(|session| session.send(RecorderCommand::Keep { first, pressed }))
            }
            Action::Drain { emitted } => {
                self.in_session(|session| session.send(RecorderCommand::Drain { emitted }))
            }
            Action::CloseRecording { aborted } => {
                self.in_session(|session| session.send(RecorderCommand::Close { aborted }))
            }
        }
        Ok(())
    }

    pub(crate) fn in_session(&mut self, change: impl FnOnce(&mut Session)) {
        if let Some(session) = &mut self.session {
            change(session);
        }
    }

    fn on_hsu(&self, ask: impl FnOnce(&Hsu, SessionId) -> Result<(), HsuError>) -> Result<(), Fault> {
        let Some(session) = &self.session else { return Ok(()) };
        let Some(hsu) = self.devices.hsu() else { return Err(hsu_missing()) };
        ask(hsu, hsu_session(session.request.session_id)).map_err(hsu_fault)
    }

    fn start_on_hsu(&self) -> Result<(), Fault> {
        let edge = self.session.as_ref().and_then(|session| session.request.start_on);
        match edge.and_then(|edge| Slope::new(edge.line, edge.rising)) {
            Some(slope) => self.on_hsu(|hsu, session| hsu.start_at_edge(session, slope)),
            None => self.on_hsu(|hsu, session| hsu.start(session)),
        }
    }

    fn answer(&mut self, answer: Result<(), Fault>) {
        if let Some(reply) = self.pending.take() {
            drop(reply.send(answer));
        }
    }

    /// Logs an event as a warning, and records it where there is a session.
    pub(crate) fn note(&self, kind: EventKind, camera: Option<CameraId>, message: impl Into<String>) {
        match &self.session {
            Some(session) => session.warn(session.event(kind, camera, message)),
            None => event_kind::warn(&kind.event(host_time_ns(), camera, message)),
        }
    }

    fn publish(&mut self) {
        let holding = self.machine.phase() == Phase::Holding;
        let session = self.session.as_ref().map(|session| session.status(holding));
        let (cameras, hsu) = (self.devices.camera_statuses(), self.devices.hsu_status());
        // The directory is made with the first session.
        let existing = self.config.sessions_dir.ancestors().find(|dir| dir.is_dir());
        let free = existing.and_then(|dir| free_bytes(dir).ok()).unwrap_or(0);
        let mut status = match self.status.write() {
            Ok(status) => status,
            Err(poisoned) => poisoned.into_inner(),
        };
        status.phase = self.machine.phase();
        status.cameras = cameras;
        status.hsu = hsu;
        status.warnings = realtime::warnings().into_iter().map(|warning| warning.message).collect();
        status.free_bytes = free;
        // A preview hides no session, whose verdict somebody still waits for.
        if self.session.as_ref().is_some_and(|session| session.request.preview) {
            status.preview = session;
        } else {
            status.session = session;
        }
        status.published = Some(Instant::now());
    }
}

fn hsu_missing() -> Fault {
    Fault::new(
        Exit::Device,
        "the HSU is not connected; check the serial cable and hsu.device in the node file",
    )
}

/// The session's id as the HSU's links compare it.
pub(crate) fn hsu_session(id: u64) -> SessionId {
    let mut bytes = [0; 16];
    bytes[..8].copy_from_slice(&id.to_le_bytes());
    SessionId(bytes)
}

fn hsu_fault(error: HsuError) -> Fault {
    Fault::new(Exit::Device, format!("HSU: {error}"))
}
