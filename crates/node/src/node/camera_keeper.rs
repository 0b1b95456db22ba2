// SPDX-License-Identifier: MIT OR Apache-2.0
//! One thread per camera while a session runs: reads the camera's clock, looks whether it still answers, and brings it
//! back when it was lost. So nothing that a camera does or does not do makes the node's own thread wait.

use super::devices::{OpenCamera, SharedBackend};
use super::event_kind::EventKind;
use super::ptp_watch::PtpWatch;
use crate::acquire::receiver::{Receiver, ReceiverSetup};
use crate::acquire::recorder::RecorderCommand;
use crate::base::clock_fit::{Exchange, RESET_RUN};
use crate::base::time::HostClock;
use crate::camera::{Camera, CameraClockSample, CameraError, StreamOptions, quiet_stream};
use crate::host::frame_memory::Pool;
use crate::hsu::action::{ActionTally, PtpClock};
use crate::record::{ClockSample, GapCause};
use crossbeam_channel::{Receiver as Inbox, RecvTimeoutError, Sender, bounded};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// What a camera's attendant, or the keeper of the HSU's link, reports to the node.
#[derive(Debug)]
pub enum Report {
    /// The state of the camera at this place of the node's list has changed.
    Camera(usize, CameraReport),
    /// Something that the operator must know at once, with its subject; `None`: it does not hold any more.
    Notice(&'static str, Option<String>),
}

/// What has happened to a camera.
#[derive(Debug)]
pub enum CameraReport {
    /// It stopped answering, with the reason that was seen.
    Lost(String),
    /// Another program controls it, with that program's address.
    Owned(String),
    /// It sends again, with the same settings.
    Back,
}

/// What the node's thread orders an attendant to do.
#[derive(Debug)]
enum Order {
    /// No packet arrived from the camera: check whether it answers.
    Probe,
    /// Its frames are in doubt: read its clock.
    ReadClock,
    Stop,
}

/// Everything that the thread of one camera works with.
pub struct AttendantSetup {
    /// The camera, open and streaming.
    pub camera: OpenCamera,
    pub backend: SharedBackend,
    /// How its stream is set up.
    pub options: StreamOptions,
    /// The setup of its receiver, for the next stream.
    pub receiver: ReceiverSetup,
    /// Number of frame buffers that each stream gets.
    pub blocks: usize,
    pub pool: Pool,
    pub to_recorder: Sender<RecorderCommand>,
    pub reports: Sender<Report>,
    /// The clock that all cameras share, where this camera's readings stand for it.
    pub ptp: Option<PtpClock>,
    /// Receives the camera's PTP status, where action commands are scheduled by PTP.
    pub actions: Option<ActionTally>,
}

/// The running thread of one camera. The node starts it with the streams of a session and joins it when they are
/// stopped; until then it owns the camera.
pub struct CameraKeeper {
    orders: Sender<Order>,
    thread: JoinHandle<Returned>,
}

/// What an attendant gives back: the camera, if it is there, and the counters of its last stream.
pub type Returned = (OpenCamera, Vec<(String, u64)>);

/// Time between two readings of a camera's clock.
const CLOCK_INTERVAL: Duration = Duration::from_secs(1);
/// Time between two attempts to open a lost camera.
const RETRY_INTERVAL: Duration = Duration::from_millis(500);
/// Number of readings of a clock before a session, and when a camera is back.
pub const CLOCK_BURST: usize = 16;
/// Number of clock readings where frames are in doubt: one more than it takes to believe that a clock was set.
const READINGS: usize = RESET_RUN + 1;
/// Time before a stream that came back is started, in which its socket drops packets of other cameras.
const SETTLE: Duration = Duration::from_millis(300);

impl CameraKeeper {
    /// Starts the thread, which owns the camera until it is joined.
    pub fn start(setup: AttendantSetup, receiver: Receiver) -> std::io::Result<Self> {
        let (orders, inbox) = bounded(8);
        let name = format!("attend-{}", setup.receiver.camera);
        let ptp = PtpWatch::new(setup.camera.config.id.clone(), setup.actions.clone());
        let thread = std::thread::Builder::new().name(name).spawn(move || {
            let mut work = Work { setup, receiver: Some(receiver), owned: None, holder: None, set: 0, ptp };
            work.run(&inbox);
            let counters = work.receiver.take().map(Receiver::stop).unwrap_or_default();
            (work.setup.camera, counters)
        })?;
        Ok(Self { orders, thread })
    }

    /// Asks it to look at once whether the camera answers.
    pub fn probe(&self) {
        // One that is busy looking already needs no telling.
        drop(self.orders.try_send(Order::Probe));
    }

    /// Orders it to read the camera's clock now, often enough to recognize a clock that was set.
    pub fn read_clock(&self) {
        drop(self.orders.try_send(Order::ReadClock));
    }

    /// Orders it to stop; [`Self::join`] waits for it.
    pub fn stop(&self) {
        drop(self.orders.send(Order::Stop));
    }

    /// Waits for the end of the thread, and returns the camera with its counters.
    pub fn join(self) -> Option<Returned> {
        self.thread.join().ok()
    }
}

struct Work {
    setup: AttendantSetup,
    /// `None` while the camera is lost.
    receiver: Option<Receiver>,
    /// Who controlled it at the last attempt, and who was last reported to.
    owned: Option<String>,
    holder: Option<String>,
    /// How many settings it was given when it was last back.
    set: usize,
    ptp: PtpWatch,
}

impl Work {
    fn run(&mut self, inbox: &Inbox<Order>) {
        let mut next_clock = Instant::now() + CLOCK_INTERVAL;
        let mut next_retry = Instant::now();
        self.begin_ptp();
        loop {
            let due = if self.receiver.is_some() { next_clock } else { next_retry };
            let patience = due.saturating_duration_since(Instant::now()).min(Duration::from_millis(100));
            match inbox.recv_timeout(patience) {
                Ok(Order::Stop) | Err(RecvTimeoutError::Disconnected) => {
                    self.look_at_ptp(true);
                    return self.stop_camera();
                }
                Ok(Order::Probe) => self.probe(),
                Ok(Order::ReadClock) => (0..READINGS).for_each(|_| self.probe()),
                Err(RecvTimeoutError::Timeout) => {}
            }
            let alive = self.setup.camera.camera.as_ref().is_some_and(|camera| camera.is_alive());
            if self.receiver.is_some() && !alive {
                self.lost_control();
            }
            if self.receiver.is_some() && Instant::now() >= next_clock {
                next_clock = Instant::now() + CLOCK_INTERVAL;
                self.probe();
                self.look_at_ptp(false);
            } else if self.receiver.is_none() && Instant::now() >= next_retry {
                self.bring_back();
                next_retry = Instant::now() + RETRY_INTERVAL;
            }
        }
    }

    /// Reads the camera's clock: for the fit, and to see whether it answers.
    fn probe(&mut self) {
        let Some(camera) = self.setup.camera.camera.as_mut().filter(|_| self.receiver.is_some()) else {
            return;
        };
        match camera.sample_clock() {
            Ok(Some(sample)) => {
                if let Some(ptp) = &self.setup.ptp {
                    ptp.read(&exchange(&sample));
                }
                let (id, clock) = (self.setup.camera.config.id.clone(), &self.setup.receiver.clock);
                let sample = camera_sample(id, sample, clock);
                drop(self.setup.to_recorder.send(RecorderCommand::Clock(sample)));
            }
            // Without a clock the image size is as good a question.
            Ok(None) => {
                if let Err(error) = camera.image_size() {
                    self.lost(&error);
                }
            }
            Err(error) => self.lost(&error),
        }
    }

    fn begin_ptp(&mut self) {
        let camera = self.setup.camera.camera.as_mut();
        if let Some(status) = camera.and_then(|camera| self.ptp.begin(camera.as_mut())) {
            self.note(EventKind::PtpStatus, status);
        }
    }

    fn look_at_ptp(&mut self, at_the_end: bool) {
        let camera = self.setup.camera.camera.as_mut().filter(|_| self.receiver.is_some());
        match camera.map(|camera| self.ptp.look(camera.as_mut(), at_the_end)) {
            Some(Ok(Some(status))) => self.note(EventKind::PtpStatus, status),
            // No reading of its clock can be believed, and its frames are matched by that.
            Some(Err(error @ CameraError::Nonsense { .. })) => self.lost(&error),
            // A camera that does not answer is lost, and that is noted.
            _ => {}
        }
    }

    /// Its control channel is gone: either the camera is, or it is not ours any more.
    fn lost_control(&mut self) {
        let gone = || CameraError::Link {
            doing: "keeping control of it",
            detail: "its control channel was lost".to_owned(),
        };
        let error = self.setup.camera.camera.as_ref().and_then(|camera| camera.not_ours());
        self.lost(&error.unwrap_or_else(gone));
    }

    fn lost(&mut self, error: &CameraError) {
        let Some(receiver) = self.receiver.take() else { return };
        self.ptp.lost();
        let camera = self.setup.receiver.camera;
        let cause = match error {
            CameraError::NotOurs { .. } => GapCause::ControlLost,
            _ => GapCause::Unplugged,
        };
        self.holder = None;
        let reason = error.to_string();
        drop(self.setup.to_recorder.send(RecorderCommand::CameraLost(camera, cause)));
        self.report(CameraReport::Lost(reason));
        let counters = receiver.stop();
        self.note(EventKind::StreamCounters, counters_text(&counters));
        // A handle that has lost its camera is of no more use: it must be opened anew.
        self.setup.camera.camera = None;
    }

    fn bring_back(&mut self) {
        match self.reopen() {
            Ok(()) => {
                let text = format!(
                    "{} settings set and read back, fresh stream of {} buffers",
                    self.set, self.setup.blocks
                );
                self.note(EventKind::CameraBack, text);
                self.report(CameraReport::Back);
            }
            Err(reason) => {
                self.setup.camera.camera = None;
                if let Some(holder) = self.owned.take() {
                    self.say_who_has_it(holder, &reason);
                }
                tracing::debug!(camera = %self.setup.camera.config.id, "not back yet: {reason}");
            }
        }
    }

    /// Another program controls the camera: reported once for each program.
    fn say_who_has_it(&mut self, holder: String, reason: &str) {
        if self.holder.as_ref() == Some(&holder) {
            return;
        }
        let camera = self.setup.receiver.camera;
        self.holder = Some(holder);
        drop(self.setup.to_recorder.send(RecorderCommand::CameraAway(camera, GapCause::ControlLost)));
        self.note(EventKind::CameraOwned, reason.to_owned());
        self.report(CameraReport::Owned(reason.to_owned()));
    }

    /// Opens the camera, verifies it, and starts a fresh stream.
    fn reopen(&mut self) -> Result<(), String> {
        let config = self.setup.camera.config.clone();
        let text = |error: CameraError| error.to_string();
        let opened = self.setup.backend.open(&config.address);
        if let Err(CameraError::Owned { holder, .. }) = &opened {
            self.owned = Some(holder.clone().unwrap_or_default());
        }
        let mut camera = opened.map_err(text)?;
        if let Some(expected) = &self.setup.camera.identity
            && camera.identity() != expected
        {
            let reason = format!(
                "another camera answers at {}: {:?}, expected {expected:?}",
                config.address,
                camera.identity()
            );
            self.note(EventKind::CameraRefused, reason.clone());
            return Err(reason);
        }
        let set_up = camera.set_up(&self.setup.camera.wishes).map_err(text)?;
        if let Some(status) = self.ptp.look(camera.as_mut(), false).map_err(text)? {
            self.note(EventKind::PtpStatus, status);
        }
        self.setup.options.contract = set_up.contract;
        self.setup.camera.watched = set_up.watched;
        self.set = set_up.settings.len();
        let (pool, contract, count) = (&self.setup.pool, set_up.contract, self.setup.blocks);
        let blocks = || pool.take(contract.pixels(), contract.received_bytes(), count);
        let (mut stream, quiet) = quiet_stream(camera.as_mut(), blocks, &self.setup.options).map_err(text)?;
        if !quiet {
            // The other cameras are sending: whatever its socket caught of them must have passed.
            let settled = Instant::now() + SETTLE;
            while Instant::now() < settled {
                drop(stream.next(Duration::from_millis(20)));
            }
        }
        let place = self.setup.receiver.camera;
        self.setup.receiver.stream += 1;
        let back = RecorderCommand::CameraBack { camera: place, stream: self.setup.receiver.stream };
        drop(self.setup.to_recorder.send(back));
        for _ in 0..CLOCK_BURST {
            if let Some(sample) = camera.sample_clock().map_err(text)? {
                let sample = camera_sample(config.id.clone(), sample, &self.setup.receiver.clock);
                drop(self.setup.to_recorder.send(RecorderCommand::Clock(sample)));
            }
        }
        let receiver = Receiver::start(stream, self.setup.receiver.clone()).map_err(|e| e.to_string())?;
        if let Err(error) = camera.start() {
            receiver.stop();
            drop(self.setup.to_recorder.send(RecorderCommand::CameraLost(place, GapCause::Unplugged)));
            return Err(error.to_string());
        }
        self.setup.camera.camera = Some(camera);
        self.receiver = Some(receiver);
        Ok(())
    }

    fn stop_camera(&mut self) {
        if let Some(camera) = self.setup.camera.camera.as_mut()
            && camera.is_alive()
            && let Err(error) = camera.stop()
        {
            tracing::warn!(camera = %self.setup.camera.config.id, "{error}");
        }
    }

    fn report(&self, report: CameraReport) {
        drop(self.setup.reports.send(Report::Camera(self.setup.receiver.camera, report)));
    }

    fn note(&self, kind: EventKind, message: String) {
        let id = self.setup.camera.config.id.clone();
        let event = kind.event(self.setup.receiver.clock.now(), Some(id), message);
        drop(self.setup.to_recorder.send(RecorderCommand::Event(event)));
    }
}

/// A burst of readings of a camera's clock. It ends with the first one that fails: each attempt takes seconds.
pub fn clock_readings(camera: &mut dyn Camera) -> impl Iterator<Item = CameraClockSample> {
    (0..CLOCK_BURST).map_while(|_| camera.sample_clock().ok()).flatten()
}

/// A reading of a camera's clock on this host's monotonic clock.
pub fn exchange(sample: &CameraClockSample) -> Exchange {
    Exchange {
        host_send_ns: sample.host_before_ns,
        host_receive_ns: sample.host_after_ns,
        device_ns: sample.camera_ns,
    }
}

/// A reading of a camera's clock, as the recording has it.
pub fn camera_sample(
    id: crate::base::ids::CameraId,
    sample: CameraClockSample,
    clock: &HostClock,
) -> ClockSample {
    ClockSample {
        camera: Some(id),
        host_send_ns: clock.from_monotonic(sample.host_before_ns),
        host_receive_ns: clock.from_monotonic(sample.host_after_ns),
        device_time_ns: sample.camera_ns,
    }
}

/// A stream's counters in words.
pub fn counters_text(counters: &[(String, u64)]) -> String {
    let text: Vec<String> = counters.iter().map(|(name, count)| format!("{name} {count}")).collect();
    text.join(", ")
}
