//! The node's thread: carries out what the state machine says, and feeds it what happens.

use super::current::Session;
use super::devices::{Devices, PreparedCamera, unique_id};
use super::state::{Action, Event, Fault, Machine, Phase, SessionRequest};
use crate::acquire::matcher::{ClockRelation, Matcher};
use crate::acquire::realtime;
use crate::acquire::receiver::Arrival;
use crate::acquire::recorder::{FromRecorder, LaneSetup, Recorder, RecorderOptions, ToRecorder, WhenFull};
use crate::api::dto::{NodeStatus, Outcome, SessionCommand};
use crate::api::server::{Command, Reply, SharedStatus};
use crate::camera::{AppliedSetting, CameraBackend};
use crate::cmds::Exit;
use crate::config::{FeatureSetting, NodeConfig};
use crate::hsu::{ArmRequest, Hsu, HsuError, HsuEvent, LinkLoss, SessionId, trigger_index};
use crate::ids::SessionName;
use crate::record::{
    CameraHeader, HsuIdentity, NodeEvent, RecordError, Recording, RecordingHeader, TriggerRecord,
    WriterOptions, free_bytes,
};
use crate::time::host_time_ns;
use crossbeam_channel::{Receiver, Sender, bounded, never, select, unbounded};
use std::collections::VecDeque;
use std::path::Path;
use std::sync::{Arc, RwLock};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// The running node.
pub struct Driver {
    commands: Sender<Command>,
    status: SharedStatus,
    stop: Sender<()>,
    thread: JoinHandle<()>,
}

/// The thread looks around at least this often.
const TICK: Duration = Duration::from_millis(100);

impl Driver {
    /// Starts the node's thread.
    pub fn start(config: NodeConfig, backend: Box<dyn CameraBackend>) -> std::io::Result<Self> {
        realtime::configure(&config.realtime);
        let devices = Devices::new(&config, backend);
        let (commands, inbox) = bounded(16);
        let (stop, stopped) = bounded(1);
        let status = Arc::new(RwLock::new(NodeStatus {
            node: config.node.clone(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            rig: config.rig.name.clone(),
            trigger_rate_hz: config.rig.trigger_rate_hz,
            phase: Phase::Idle,
            cameras: devices.camera_statuses(),
            hsu: devices.hsu_status(),
            warnings: Vec::new(),
            sessions_dir: config.sessions_dir.clone(),
            free_bytes: 0,
            session: None,
        }));
        let period = Duration::from_secs_f64(1.0 / config.rig.trigger_rate_hz);
        let node = Node {
            machine: Machine::new(period),
            config,
            devices,
            session: None,
            pending: None,
            status: Arc::clone(&status),
            origin: Instant::now(),
        };
        let thread =
            std::thread::Builder::new().name("node".to_owned()).spawn(move || node.run(&inbox, &stopped))?;
        Ok(Self { commands, status, stop, thread })
    }

    /// Where the API sends commands.
    pub fn commands(&self) -> Sender<Command> {
        self.commands.clone()
    }

    /// The status as the node's thread last published it.
    pub fn status(&self) -> SharedStatus {
        Arc::clone(&self.status)
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

struct Node {
    config: NodeConfig,
    devices: Devices,
    machine: Machine,
    session: Option<Session>,
    /// Whoever waits for the preparation.
    pending: Option<Reply>,
    status: SharedStatus,
    origin: Instant,
}

impl Node {
    fn run(mut self, commands: &Receiver<Command>, stopped: &Receiver<()>) {
        let mut stopping = false;
        loop {
            let hsu = self.devices.hsu().map_or_else(never, |hsu| hsu.events().clone());
            let recorder = self.session.as_ref().map_or_else(never, |s| s.from_recorder.clone());
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
                recv(stopped) -> _ => {
                    stopping = true;
                    self.take(Event::Abort("the node was told to shut down".to_owned()));
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
        self.take(Event::Tick);
        match self.machine.phase() {
            Phase::Idle => self.devices.look_after(),
            Phase::Ready | Phase::Running => self.notice_lost_cameras(),
            _ => {}
        }
        self.in_session(Session::tell_warnings);
        self.publish();
    }

    fn notice_lost_cameras(&mut self) {
        let Some((camera, id)) = self.devices.lost_camera() else { return };
        let Some(session) = self.session.as_mut().filter(|session| !session.lost_reported) else { return };
        session.lost_reported = true;
        session.tell(ToRecorder::CameraLost(camera));
        let message = format!("camera {id} stopped answering; check its power and cable");
        self.note("camera_lost", &message);
        self.take(Event::Failed(Fault::new(Exit::Device, message)));
    }

    fn command(&mut self, command: Command) {
        match command {
            Command::Prepare(request, reply) => self.prepare(request, reply),
            Command::Start(command, reply) => self.session_command(&command, reply, Event::Start),
            Command::Stop(command, reply) => self.session_command(&command, reply, Event::Stop),
            Command::Abort(command, reply) => {
                let reason = command.reason.clone().unwrap_or_else(|| "aborted by the operator".to_owned());
                self.session_command(&command, reply, Event::Abort(reason));
            }
        }
    }

    fn prepare(&mut self, request: SessionRequest, reply: Reply) {
        let refuse = |reply: Reply, message: String| drop(reply.send(Err(Fault::new(Exit::Usage, message))));
        if self.machine.phase() != Phase::Idle {
            return refuse(reply, format!("the node is busy with a session ({:?})", self.machine.phase()));
        }
        let name = match SessionName::parse(&request.name) {
            Ok(name) => name,
            Err(message) => return refuse(reply, message),
        };
        if !request.nodes.contains(&self.config.node) {
            return refuse(
                reply,
                format!("the session is for other nodes, this one is {}", self.config.node),
            );
        }
        let dir = self.config.sessions_dir.join(name.as_str()).join(format!("node-{}", self.config.node));
        tracing::info!(session = request.name, triggers = request.triggers, "preparing");
        self.pending = Some(reply);
        self.session = Some(Session::new(request.clone(), dir, self.config.cameras.len()));
        self.take(Event::Prepare(request));
    }

    fn session_command(&mut self, command: &SessionCommand, reply: Reply, event: Event) {
        let ours = self.machine.request().is_some_and(|request| request.session_id == command.session_id);
        let phase = self.machine.phase();
        let answer = match (ours, &event) {
            (false, _) => Err(Fault::new(Exit::Usage, "the node is not in this session (any more)")),
            (true, Event::Start) if phase != Phase::Ready => {
                Err(Fault::new(Exit::Usage, format!("the session cannot be started, it is {phase:?}")))
            }
            // The answer to a start is the HSU's.
            (true, Event::Start) => self.start_train(),
            (true, _) => {
                self.take(event);
                Ok(())
            }
        };
        drop(reply.send(answer));
    }

    fn start_train(&mut self) -> Result<(), Fault> {
        let mut answer = Ok(());
        for action in self.machine.step(Event::Start, self.origin.elapsed()) {
            if action == Action::StartTrain {
                answer = self.on_hsu(|hsu, session| hsu.start(session));
            }
        }
        answer
    }

    /// Steps the machine, and carries out what it says until it says nothing more.
    fn take(&mut self, event: Event) {
        let mut events = VecDeque::from([event]);
        while let Some(event) = events.pop_front() {
            let preparing = self.machine.phase() == Phase::Preparing || matches!(event, Event::Prepare(_));
            for action in self.machine.step(event, self.origin.elapsed()) {
                let step = preparing && !matches!(action, Action::ReportReady | Action::ReportFailed(_));
                let still = self.machine.phase() == Phase::Preparing;
                match self.act(action) {
                    Ok(()) if step && still => events.push_back(Event::StepDone),
                    Ok(()) => {}
                    Err(fault) if still => events.push_back(Event::Failed(fault)),
                    // What undoes or ends something is tried, and its failure is told.
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
                self.in_session(|session| session.cameras = cameras);
                Ok(())
            }
            Action::CreateRecording => self.create_recording(),
            Action::StartStreams => self.start_streams(),
            Action::ArmHsu => {
                let Some(session) = &self.session else { return Ok(()) };
                let request = session.request.clone();
                let Some(hsu) = self.devices.hsu() else { return Err(hsu_missing()) };
                let arm = ArmRequest {
                    session: hsu_session(request.session_id),
                    triggers: (request.triggers > 0).then_some(request.triggers),
                    warm_up: 0,
                    nodes: request.nodes,
                };
                hsu.arm(&arm).map_err(hsu_fault)
            }
            Action::ReportReady => {
                self.answer(Ok(()));
                Ok(())
            }
            Action::ReportFailed(fault) => {
                tracing::warn!("session failed: {}", fault.message);
                self.in_session(|session| session.outcome = Some(Outcome::Failed(fault.clone())));
                self.answer(Err(fault));
                Ok(())
            }
            Action::StartTrain => self.on_hsu(|hsu, session| hsu.start(session)),
            Action::StopTrain => self.on_hsu(|hsu, session| hsu.stop(session)),
            Action::DisarmHsu => self.on_hsu(|hsu, session| hsu.disarm(session)),
            Action::StopStreams => {
                self.stop_streams();
                Ok(())
            }
            Action::DiscardRecording => self.discard_recording(),
            Action::Drain { emitted } => {
                self.in_session(|session| session.tell(ToRecorder::Drain { emitted }));
                Ok(())
            }
            Action::CloseRecording { aborted } => {
                self.in_session(|session| session.tell(ToRecorder::Close { aborted }));
                Ok(())
            }
        }
    }

    fn in_session(&mut self, change: impl FnOnce(&mut Session)) {
        if let Some(session) = &mut self.session {
            change(session);
        }
    }

    fn on_hsu(&self, ask: impl FnOnce(&Hsu, SessionId) -> Result<(), HsuError>) -> Result<(), Fault> {
        let Some(session) = &self.session else { return Ok(()) };
        let Some(hsu) = self.devices.hsu() else { return Err(hsu_missing()) };
        ask(hsu, hsu_session(session.request.session_id)).map_err(hsu_fault)
    }

    fn answer(&mut self, answer: Result<(), Fault>) {
        if let Some(reply) = self.pending.take() {
            drop(reply.send(answer));
        }
    }

    fn create_recording(&mut self) -> Result<(), Fault> {
        let Some(session) = &mut self.session else { return Ok(()) };
        let read_back = |setting: &AppliedSetting| FeatureSetting {
            feature: setting.feature.clone(),
            value: setting.actual.clone(),
        };
        let camera = |camera: &PreparedCamera| CameraHeader {
            id: camera.id.clone(),
            width: u32::try_from(camera.size.0).unwrap_or(u32::MAX),
            height: u32::try_from(camera.size.1).unwrap_or(u32::MAX),
            device: format!(
                "{} {} {}",
                camera.identity.vendor, camera.identity.model, camera.identity.serial
            ),
            settings: camera.settings.iter().map(read_back).collect(),
        };
        let request = &session.request;
        let header = RecordingHeader {
            session: SessionName(request.name.clone()),
            session_id: format!("{:016x}", request.session_id),
            node: self.config.node.clone(),
            rig_text: self.config.rig_text.clone(),
            cameras: session.cameras.iter().map(camera).collect(),
            hsu: self.devices.hsu().map(|hsu| HsuIdentity {
                uid: unique_id(hsu),
                firmware: hsu.identity().firmware.map(|n| n.to_string()).join("."),
                protocol: u32::from(hsu.welcome().agreed),
            }),
            expected_triggers: (request.triggers > 0).then_some(request.triggers),
            trigger_rate_hz: self.config.rig.trigger_rate_hz,
            host_clock: "CLOCK_REALTIME".to_owned(),
            created_ns: host_time_ns(),
            software: concat!("fourdbody ", env!("CARGO_PKG_VERSION")).to_owned(),
            subject: request.subject.clone(),
            note: request.note.clone(),
        };
        let options = WriterOptions {
            segment_bytes: self.config.segment_bytes,
            reserve_bytes: self.config.reserve_bytes,
            ..WriterOptions::default()
        };
        let recording = Recording::create(&session.dir, header, options).map_err(|error| {
            remove_if_empty(&session.dir);
            let exit = if matches!(error, RecordError::Exists { .. }) { Exit::Usage } else { Exit::Failure };
            Fault::new(exit, error)
        })?;
        session.recording = Some(recording);
        Ok(())
    }

    /// Relates the clocks, starts the recorder, then the streams.
    fn start_streams(&mut self) -> Result<(), Fault> {
        let clocks = self.devices.clock_relations();
        let Some(session) = &mut self.session else { return Ok(()) };
        let Some(recording) = session.recording.take() else { return Ok(()) };
        let period_ns = (1e9 / self.config.rig.trigger_rate_hz) as u64;
        let lane = |(camera, clocks): (&PreparedCamera, ClockRelation)| LaneSetup {
            id: camera.id.clone(),
            width: u32::try_from(camera.size.0).unwrap_or(u32::MAX),
            height: u32::try_from(camera.size.1).unwrap_or(u32::MAX),
            matcher: Matcher::new(period_ns, clocks),
        };
        let lanes: Vec<LaneSetup> = session.cameras.iter().zip(clocks).map(lane).collect();
        let (arrivals_in, arrivals) = bounded::<Arrival>(self.config.buffers_per_camera * lanes.len().max(1));
        let (to_recorder, commands) = unbounded();
        let (events, from_recorder) = unbounded();
        let thread_error =
            |e: std::io::Error| Fault::new(Exit::Failure, format!("cannot start the recorder: {e}"));
        let progress = Arc::clone(&session.progress);
        let options = RecorderOptions::new(period_ns, self.config.buffers_per_camera, WhenFull::DropFrameSet);
        let recorder = Recorder::start(recording, lanes, options, progress, arrivals, commands, events)
            .map_err(thread_error)?;
        session.recorder = Some(recorder);
        session.to_recorder = Some(to_recorder);
        session.from_recorder = from_recorder;
        match self.devices.start_streams(&arrivals_in) {
            Ok(receivers) => session.receivers = receivers,
            Err(fault) => {
                session.end_recorder();
                return Err(fault);
            }
        }
        Ok(())
    }

    fn stop_streams(&mut self) {
        let Some(session) = &mut self.session else { return };
        let receivers = std::mem::take(&mut session.receivers);
        let counters = self.devices.stop_streams(receivers);
        for (camera, counters) in session.cameras.iter().zip(counters) {
            let text: Vec<String> = counters.iter().map(|(name, count)| format!("{name} {count}")).collect();
            let event = NodeEvent {
                host_time_ns: host_time_ns(),
                kind: "stream_counters".to_owned(),
                camera: Some(camera.id.clone()),
                trigger: None,
                message: text.join(", "),
            };
            session.tell(ToRecorder::Event(event));
        }
    }

    /// Removes what `create_recording` made: this session's own files, without a single trigger in them.
    fn discard_recording(&mut self) -> Result<(), Fault> {
        let Some(session) = &mut self.session else { return Ok(()) };
        session.end_recorder();
        session.recording = None;
        let removed = std::fs::remove_dir_all(&session.dir);
        remove_if_empty(&session.dir);
        removed.map_err(|e| {
            Fault::new(Exit::Failure, format!("{}: cannot be removed: {e}", session.dir.display()))
        })
    }

    fn hsu_event(&mut self, event: HsuEvent) {
        let ours = self.machine.request().map(|request| hsu_session(request.session_id));
        match event {
            HsuEvent::Trigger { session, trigger } if Some(session) == ours => {
                let Some(index) = trigger_index(&trigger) else { return };
                let record = TriggerRecord {
                    index,
                    hsu_time_ns: trigger.time_ns,
                    flags: u32::from(trigger.flags.0),
                    host_time_ns: host_time_ns(),
                };
                self.in_session(|session| session.tell(ToRecorder::Trigger(record)));
                self.take(Event::Trigger);
            }
            HsuEvent::TriggersMissing { session, first, count } if Some(session) == ours => {
                self.note(
                    "triggers_missing",
                    &format!("the times of {count} triggers from {first} on are lost"),
                );
            }
            HsuEvent::Done { session, emitted, .. } if Some(session) == ours => {
                self.take(Event::TrainDone { emitted })
            }
            HsuEvent::Fault { session, fault } if Some(session) == ours => {
                let message = format!("the HSU reports: {fault}");
                self.note("hsu_fault", &message);
                self.take(Event::Failed(Fault::new(Exit::Device, message)));
            }
            HsuEvent::LinkLost(LinkLoss::Silent) => self.hsu_gone("it does not answer".to_owned()),
            HsuEvent::LinkLost(LinkLoss::Restarted) => self.hsu_gone("it was restarted".to_owned()),
            HsuEvent::LinkLost(LinkLoss::Broken(cause)) => self.hsu_gone(cause),
            _ => {}
        }
    }

    fn hsu_gone(&mut self, reason: String) {
        let message =
            format!("the link to the HSU is lost ({reason}); check the serial cable and the HSU's power");
        self.devices.drop_hsu(message.clone());
        self.note("hsu_lost", &message);
        self.take(Event::Failed(Fault::new(Exit::Device, message)));
    }

    fn recorder_event(&mut self, event: FromRecorder) {
        match event {
            FromRecorder::Drained => self.take(Event::Drained),
            FromRecorder::RingFull => {}
            FromRecorder::Failed(fault) => self.take(Event::Failed(fault)),
            FromRecorder::Closed(verdict) => {
                self.in_session(|session| {
                    session.outcome = Some(match verdict {
                        Ok(verdict) => {
                            tracing::info!("session {}: {verdict}", session.request.name);
                            Outcome::Recorded(serde_json::to_value(&verdict).unwrap_or_default())
                        }
                        Err(fault) => Outcome::Failed(fault),
                    });
                    session.end_recorder();
                });
                self.take(Event::Closed);
            }
        }
    }

    /// The recorder's thread ended without saying so: it panicked. The session cannot be finished.
    fn recorder_gone(&mut self) {
        self.in_session(|session| {
            session.from_recorder = never();
            let message =
                "the recorder stopped unexpectedly; what was written can be read with `fourdbody verify`";
            session.outcome.get_or_insert(Outcome::Failed(Fault::new(Exit::Failure, message)));
        });
        self.take(Event::Failed(Fault::new(Exit::Failure, "the recorder stopped unexpectedly")));
        self.take(Event::Drained);
        self.take(Event::Closed);
    }

    fn note(&mut self, kind: &str, message: &str) {
        tracing::warn!(kind, "{message}");
        let event = NodeEvent {
            host_time_ns: host_time_ns(),
            kind: kind.to_owned(),
            camera: None,
            trigger: None,
            message: message.to_owned(),
        };
        self.in_session(|session| session.tell(ToRecorder::Event(event)));
    }

    fn publish(&mut self) {
        let session = self.session.as_ref().map(Session::status);
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
        status.session = session;
    }
}

/// Removes a session's directory, unless the other node has recorded into it.
fn remove_if_empty(recording: &Path) {
    if let Some(session) = recording.parent() {
        // Not empty, or not there: both are as they should be.
        drop(std::fs::remove_dir(session));
    }
}

fn hsu_missing() -> Fault {
    Fault::new(
        Exit::Device,
        "the HSU is not connected; check the serial cable and hsu.device in the node file",
    )
}

/// The session's id as the HSU's links compare it.
fn hsu_session(id: u64) -> SessionId {
    let mut bytes = [0; 16];
    bytes[..8].copy_from_slice(&id.to_le_bytes());
    SessionId(bytes)
}

fn hsu_fault(error: HsuError) -> Fault {
    Fault::new(Exit::Device, format!("HSU: {error}"))
}
