// SPDX-License-Identifier: MIT OR Apache-2.0
//! The node's devices: its cameras and its link to the HSU, kept open between sessions.

mod exposure;

use super::camera_keeper::{
    AttendantSetup, CLOCK_BURST, CameraKeeper, Report, camera_sample, clock_readings, exchange,
};
use super::hsu_keeper::hsu_sample;
use crate::acquire::receiver::{Receiver, ReceiverSetup};
use crate::acquire::recorder::RecorderCommand;
use crate::base::ids::CameraId;
use crate::base::time::HostClock;
use crate::base::{Exit, Fault};
use crate::camera::{
    AppliedSetting, Camera, CameraBackend, CameraError, CameraIdentity, Change, FrameContract, SetUp, State,
    StreamOptions, Wishes, quiet_stream,
};
use crate::config::{CameraConfig, NodeConfig};
use crate::control::status::{CameraStatus, HsuStatus};
use crate::host::frame_memory::{Pool, block_bytes};
use crate::hsu::action::PtpClock;
use crate::hsu::{Hsu, HsuTimeouts, HsuTiming, TriggerUnit};
use crate::record::ClockSample;
use crossbeam_channel::Sender;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// One configured camera, open or not.
pub struct OpenCamera {
    /// Its part of the node file.
    pub config: CameraConfig,
    /// The camera, while it is open and not in the hands of an attendant.
    pub camera: Option<Box<dyn Camera>>,
    /// Its identity when it was last opened.
    pub identity: Option<CameraIdentity>,
    /// Why it cannot be used now.
    pub problem: Option<String>,
    /// Columns and rows that the rig has for it.
    pub size: (usize, usize),
    /// What its frames must be, as it was last verified.
    pub contract: FrameContract,
    /// The settings of the node file for it.
    pub wishes: Wishes,
    /// What must stay as it is while a session runs.
    pub watched: State,
    /// While it is not open: when it is looked for again.
    next_try: Instant,
}

impl OpenCamera {
    fn start(&mut self) -> Result<(), Fault> {
        let Some(camera) = &mut self.camera else { return Ok(()) };
        camera.start().map_err(|e| Fault::new(Exit::Device, format!("camera {}: {e}", self.config.id)))
    }

    /// Sets and reads back all features, and asks whether what it then sends is what a session records.
    fn set_up(&mut self) -> Result<PreparedCamera, CameraError> {
        let not_open = CameraError::Link { doing: "setting its features", detail: "not open".to_owned() };
        let camera = self.camera.as_mut().ok_or(not_open)?;
        let SetUp { contract, settings, remarks: told, watched } = camera.set_up(&self.wishes)?;
        let (id, identity, state) = (self.config.id.clone(), camera.identity().clone(), camera.state()?);
        self.contract = contract;
        self.watched = watched;
        Ok(PreparedCamera { id, contract, identity, settings, told, state })
    }

    /// Settings that are not as they were set, where the camera can be read.
    fn changed(&mut self) -> Vec<Change> {
        let Some(camera) = self.camera.as_mut().filter(|camera| camera.is_alive()) else { return Vec::new() };
        match camera.changed(&self.watched) {
            Ok(changed) => changed,
            Err(error) => {
                tracing::warn!(camera = %self.config.id, "its settings cannot be read again: {error}");
                Vec::new()
            }
        }
    }

    /// Everything but the open camera, which moves to the copy.
    fn hand_over(&mut self) -> Self {
        Self {
            config: self.config.clone(),
            camera: self.camera.take(),
            identity: self.identity.clone(),
            problem: None,
            size: self.size,
            contract: self.contract,
            wishes: self.wishes.clone(),
            watched: self.watched.clone(),
            next_try: self.next_try,
        }
    }
}

/// The backend, shared by the threads that may have to open a camera.
#[derive(Clone)]
pub struct SharedBackend(Arc<Mutex<Box<dyn CameraBackend>>>);

impl SharedBackend {
    /// Opens a camera; one at a time.
    pub fn open(&self, address: &str) -> Result<Box<dyn Camera>, CameraError> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).open(address)
    }
}

/// A camera that is ready for a session.
#[derive(Debug, Clone)]
pub struct PreparedCamera {
    /// Its name in the rig.
    pub id: CameraId,
    /// What its frames must be.
    pub contract: FrameContract,
    pub identity: CameraIdentity,
    pub settings: Vec<AppliedSetting>,
    /// What was found otherwise and mended, and what the camera rounded.
    pub told: Vec<String>,
    /// Everything that could be read of it.
    pub state: State,
}

/// Time between two attempts to open an absent camera while the node is idle: each attempt blocks for 2.5 s.
const ABSENT_RETRY_INTERVAL: Duration = Duration::from_secs(15);
/// The same for a camera that another program controls, which answers at once. That program is most often this one
/// before it crashed, and the camera is free when its heartbeat times out (3 s by default).
const OWNED_RETRY_INTERVAL: Duration = Duration::from_millis(500);
/// Time between two attempts to connect to the HSU: its absence is noticed in a second.
const HSU_RETRY_INTERVAL: Duration = Duration::from_secs(3);

/// The place of the camera whose clock readings stand for the clock that all cameras share.
const REFERENCE: usize = 0;

/// All devices of the node: its cameras, its link to the HSU, and the frame memory. The node's thread makes them at
/// its start and keeps them open between sessions. During a session each camera belongs to its attendant, which gives
/// it back when the streams are stopped.
pub struct Devices {
    backend: SharedBackend,
    slots: Vec<OpenCamera>,
    /// Frame memory, kept between sessions.
    pool: Pool,
    hsu: Option<Arc<Hsu>>,
    hsu_problem: Option<String>,
    unit: TriggerUnit,
    config: NodeConfig,
    next_hsu_retry: Instant,
}

impl Devices {
    /// The devices of a node, none open yet.
    pub fn new(config: &NodeConfig, backend: Box<dyn CameraBackend>) -> Self {
        let not_yet = || Some("not opened yet".to_owned());
        let slot = |camera: &CameraConfig| {
            let mut known = config.rig.cameras().filter(|(_, known)| known.id == camera.id);
            let size = known.next().map_or((0, 0), |(_, known)| (known.device.width, known.device.height));
            let pixel = camera.words.pixel.unwrap_or_default();
            OpenCamera {
                config: camera.clone(),
                camera: None,
                identity: None,
                problem: not_yet(),
                size,
                contract: FrameContract { pixel, size, place: (0, 0), offset: (0, 0), chunk_room: 0 },
                wishes: Wishes::of(config, camera),
                watched: State::new(),
                next_try: Instant::now(),
            }
        };
        let slots: Vec<OpenCamera> = config.cameras.iter().map(slot).collect();
        let blocks =
            |slot: &OpenCamera| config.buffers_per_camera * block_bytes(slot.contract.received_bytes());
        let needed: usize = slots.iter().map(blocks).sum();
        Self {
            pool: Pool::new(config.realtime.lock_memory, needed as u64),
            slots,
            backend: SharedBackend(Arc::new(Mutex::new(backend))),
            hsu: None,
            hsu_problem: not_yet(),
            unit: TriggerUnit::of(config),
            config: config.clone(),
            next_hsu_retry: Instant::now(),
        }
    }

    /// The link to the HSU, when it is up.
    pub fn hsu(&self) -> Option<&Arc<Hsu>> {
        self.hsu.as_ref()
    }

    /// The HSU, or the action commands, that fire the triggers.
    pub fn unit(&self) -> &TriggerUnit {
        &self.unit
    }

    pub(super) fn slots_mut(&mut self) -> &mut [OpenCamera] {
        &mut self.slots
    }

    /// The clock that the cameras share, where actions are scheduled by it.
    fn ptp(&self) -> Option<PtpClock> {
        self.unit.action()?.ptp.clone()
    }

    /// A link that was made anew.
    pub fn take_hsu(&mut self, hsu: Arc<Hsu>) {
        self.hsu = Some(hsu);
        self.hsu_problem = None;
    }

    /// A camera's state for the status, while it is in the hands of its attendant.
    pub fn set_problem(&mut self, camera: usize, problem: Option<String>) {
        if let Some(slot) = self.slots.get_mut(camera) {
            slot.problem = problem;
        }
    }

    /// Forgets a link that failed.
    pub fn drop_hsu(&mut self, reason: String) {
        self.hsu = None;
        self.hsu_problem = Some(reason);
        self.next_hsu_retry = Instant::now() + HSU_RETRY_INTERVAL;
    }

    /// Between sessions: notices devices that were lost since, and returns whether there are any. Sends no request, so
    /// that it does not wait.
    pub fn notice_lost(&mut self) -> bool {
        let mut found = false;
        for slot in &mut self.slots {
            if slot.camera.as_ref().is_some_and(|camera| !camera.is_alive()) {
                slot.camera = None;
                slot.problem = Some("the camera stopped answering; check its power and cable".to_owned());
                found = true;
            }
        }
        found
    }

    /// Between sessions: looks for missing devices now and then. Opens at most one device per call, because an absent
    /// one blocks.
    pub fn look_after(&mut self) {
        if self.hsu.is_none() && Instant::now() >= self.next_hsu_retry {
            drop(self.connect_hsu());
            self.next_hsu_retry = Instant::now() + HSU_RETRY_INTERVAL;
        }
        let missing = self.slots.iter().enumerate().filter(|(_, slot)| slot.camera.is_none());
        let next = missing.min_by_key(|(_, slot)| slot.next_try).map(|(i, slot)| (i, slot.next_try));
        let Some((i, _)) = next.filter(|(_, due)| Instant::now() >= *due) else { return };
        let known = self.slots[i].problem.clone();
        match self.open(i) {
            // What kept one camera away, a switch for instance, kept the others away as well.
            Ok(()) => self.slots.iter_mut().for_each(|slot| slot.next_try = Instant::now()),
            Err(fault) if self.slots[i].problem != known => tracing::warn!("{}", fault.message),
            Err(_) => {}
        }
    }

    fn open(&mut self, i: usize) -> Result<(), Fault> {
        let slot = &mut self.slots[i];
        match self.backend.open(&slot.config.address) {
            Ok(camera) => {
                let identity = camera.identity();
                let (model, serial) = (&identity.model, &identity.serial);
                tracing::info!(camera = %slot.config.id, address = slot.config.address, model, serial, "opened");
                slot.identity = Some(identity.clone());
                slot.camera = Some(camera);
                slot.problem = None;
                Ok(())
            }
            Err(error) => {
                slot.problem = Some(error.to_string());
                let fault = Fault::new(Exit::Device, format!("camera {}: {error}", slot.config.id));
                let interval = match error {
                    CameraError::Owned { .. } => OWNED_RETRY_INTERVAL,
                    // They block one after the other.
                    _ => ABSENT_RETRY_INTERVAL * self.missing(),
                };
                self.slots[i].next_try = Instant::now() + interval;
                Err(fault)
            }
        }
    }

    fn missing(&self) -> u32 {
        self.slots.iter().filter(|slot| slot.camera.is_none()).count() as u32
    }

    fn connect_hsu(&mut self) -> Result<(), Fault> {
        match self.unit.connect(&self.config.node, &HsuTimeouts::default()) {
            Ok(hsu) => {
                let device = self.config.trigger.device();
                tracing::info!(device = %device.display(), identity = hsu.identity_text(), "HSU connected");
                self.hsu = Some(Arc::new(hsu));
                self.hsu_problem = None;
                Ok(())
            }
            Err(error) => {
                self.hsu_problem = Some(error.to_string());
                let device = self.config.trigger.device();
                Err(Fault::new(Exit::Device, format!("HSU at {}: {error}", device.display())))
            }
        }
    }

    /// Opens what is not open, sets and reads back every setting, and configures the HSU. All cameras are
    /// tried, so that the operator learns of all problems at once.
    pub fn prepare(&mut self) -> Result<Vec<PreparedCamera>, Fault> {
        let mut faults = Vec::new();
        let mut prepared = Vec::new();
        if self.hsu.is_none() {
            faults.extend(self.connect_hsu().err());
        }
        for i in 0..self.slots.len() {
            match self.prepare_camera(i) {
                Ok(camera) => prepared.push(camera),
                Err(fault) => faults.push(fault),
            }
        }
        if let Some(hsu) = &self.hsu
            && let Err(error) = hsu.configure(&HsuTiming::from_rig(&self.config.rig))
        {
            let message = format!("HSU at {}: {error}", self.config.trigger.device().display());
            self.drop_hsu(message.clone());
            faults.push(Fault::new(Exit::Device, message));
        }
        if faults.is_empty() {
            faults.extend(self.check_actions());
        }
        if faults.is_empty() {
            return Ok(prepared);
        }
        let messages: Vec<String> = faults.into_iter().map(|fault| fault.message).collect();
        Err(Fault::new(Exit::Device, messages.join("\n")))
    }

    fn prepare_camera(&mut self, i: usize) -> Result<PreparedCamera, Fault> {
        if self.slots[i].camera.as_ref().is_none_or(|camera| !camera.is_alive()) {
            self.slots[i].camera = None;
            self.open(i)?;
        }
        let mut set_up = self.slots[i].set_up();
        if matches!(set_up, Err(CameraError::NotOurs { holder: None, .. })) {
            // It was restarted since it was opened.
            self.slots[i].camera = None;
            self.open(i)?;
            set_up = self.slots[i].set_up();
        }
        let id = &self.slots[i].config.id;
        set_up.map_err(|error| Fault::new(Exit::Device, format!("camera {id}: {error}")))
    }

    /// A burst of clock readings of the HSU and of every camera, for the fits and for the record.
    pub fn clock_burst(&mut self, clock: &HostClock) -> Vec<ClockSample> {
        let mut all = Vec::new();
        if let Some(hsu) = &self.hsu {
            let samples = (0..CLOCK_BURST).filter_map(|_| hsu.query_clock().ok());
            all.extend(samples.map(|sample| hsu_sample(&sample, clock)));
        }
        let ptp = self.ptp();
        for (place, slot) in self.slots.iter_mut().enumerate() {
            let Some(camera) = slot.camera.as_mut() else { continue };
            let id = &slot.config.id;
            for sample in clock_readings(camera.as_mut()) {
                if let Some(ptp) = ptp.as_ref().filter(|_| place == REFERENCE) {
                    ptp.read(&exchange(&sample));
                }
                all.push(camera_sample(id.clone(), sample, clock));
            }
        }
        all
    }

    /// Bytes of frame memory that no stream has.
    pub fn idle_bytes(&self) -> u64 {
        self.pool.idle_bytes()
    }

    /// Gives frame memory back that no stream has.
    pub fn release_memory(&self) {
        self.pool.release();
    }

    /// Cameras whose clock cannot be read, and why, once it was tried.
    pub fn without_clock(&self) -> Vec<(CameraId, String)> {
        let why = |slot: &OpenCamera| {
            Some((slot.config.id.clone(), slot.camera.as_ref()?.why_no_clock()?.to_owned()))
        };
        self.slots.iter().filter_map(why).collect()
    }

    /// What is not as it was when each camera was set up for the session.
    pub fn changed_settings(&mut self) -> Vec<(CameraId, Vec<Change>)> {
        let all = self.slots.iter_mut().map(|slot| (slot.config.id.clone(), slot.changed()));
        all.filter(|(_, changed)| !changed.is_empty()).collect()
    }

    /// Creates a fresh stream with a receiver on every camera, starts every acquisition, and puts every camera into
    /// the hands of an attendant; on failure none is left running.
    pub fn start_streams(
        &mut self,
        receivers: &[ReceiverSetup],
        blocks: usize,
        to_recorder: &Sender<RecorderCommand>,
        reports: &Sender<Report>,
    ) -> Result<Vec<CameraKeeper>, Fault> {
        let mut running = Vec::new();
        let created = receivers.iter().try_for_each(|setup| {
            running.push(self.create_stream(setup, blocks)?);
            Ok(())
        });
        let started = created.and_then(|()| self.slots.iter_mut().try_for_each(OpenCamera::start));
        if let Err(fault) = started {
            self.slots
                .iter_mut()
                .filter_map(|slot| slot.camera.as_mut())
                .for_each(|camera| drop(camera.stop()));
            running.into_iter().for_each(|receiver| drop(receiver.stop()));
            return Err(fault);
        }
        let mut attendants = Vec::new();
        let ptp = self.ptp();
        // Actions that are not scheduled depend on no clock.
        let actions =
            self.unit().action().filter(|action| action.ptp.is_some()).map(|action| action.tally.clone());
        for (receiver, setup) in running.into_iter().zip(receivers) {
            let slot = &mut self.slots[setup.camera];
            let setup = AttendantSetup {
                camera: slot.hand_over(),
                backend: self.backend.clone(),
                options: stream_options(&self.config, slot.contract),
                receiver: setup.clone(),
                blocks,
                pool: self.pool.clone(),
                to_recorder: to_recorder.clone(),
                reports: reports.clone(),
                ptp: ptp.clone().filter(|_| setup.camera == REFERENCE),
                actions: actions.clone(),
            };
            match CameraKeeper::start(setup, receiver) {
                Ok(attendant) => attendants.push(attendant),
                Err(error) => {
                    self.stop_streams(attendants);
                    return Err(Fault::new(
                        Exit::Failure,
                        format!("cannot start a camera's thread: {error}"),
                    ));
                }
            }
        }
        Ok(attendants)
    }

    fn create_stream(&mut self, setup: &ReceiverSetup, count: usize) -> Result<Receiver, Fault> {
        let slot = &mut self.slots[setup.camera];
        let options = stream_options(&self.config, slot.contract);
        let (id, contract) = (&slot.config.id, slot.contract);
        let fault = |error: String| Fault::new(Exit::Device, format!("camera {id}: {error}"));
        let camera = slot.camera.as_mut().ok_or_else(|| fault("not open".to_owned()))?;
        let pool = &self.pool;
        let blocks = || pool.take(contract.pixels(), contract.received_bytes(), count);
        let (stream, quiet) =
            quiet_stream(camera.as_mut(), blocks, &options).map_err(|e| fault(e.to_string()))?;
        if !quiet {
            return Err(fault(
                "packets arrive on its stream before its acquisition was started; expected silence: is another \
                 program, or a camera with the same address, streaming to this host?"
                    .to_owned(),
            ));
        }
        Receiver::start(stream, setup.clone()).map_err(|e| fault(format!("cannot start its thread: {e}")))
    }

    /// Stops acquisitions and receivers and takes the cameras back; returns each camera's stream counters, in their
    /// order.
    pub fn stop_streams(&mut self, attendants: Vec<CameraKeeper>) -> Vec<Vec<(String, u64)>> {
        attendants.iter().for_each(CameraKeeper::stop);
        let mut counters = Vec::new();
        for (slot, attendant) in self.slots.iter_mut().zip(attendants) {
            let Some((camera, counted)) = attendant.join() else {
                slot.problem = Some("its thread ended unexpectedly; it is opened again".to_owned());
                counters.push(Vec::new());
                continue;
            };
            slot.problem = match camera.camera {
                Some(_) => None,
                None => Some("the camera stopped answering; check its power and cable".to_owned()),
            };
            slot.camera = camera.camera;
            slot.watched = camera.watched;
            counters.push(counted);
        }
        counters
    }

    /// The state of every camera, in the configuration's order, for the node's status.
    pub fn camera_statuses(&self) -> Vec<CameraStatus> {
        let status = |slot: &OpenCamera| CameraStatus {
            id: slot.config.id.clone(),
            address: slot.config.address.clone(),
            identity: slot.identity.clone().filter(|_| slot.problem.is_none()),
            problem: slot.problem.clone(),
            exposure: self.exposure_now(slot),
        };
        self.slots.iter().map(status).collect()
    }

    /// The state of the link to the HSU, for the node's status.
    pub fn hsu_status(&self) -> HsuStatus {
        HsuStatus {
            device: self.config.trigger.device(),
            identity: self.hsu.as_deref().map(Hsu::identity_text),
            problem: self.hsu_problem.clone(),
        }
    }
}

fn stream_options(config: &NodeConfig, contract: FrameContract) -> StreamOptions {
    StreamOptions {
        contract,
        packet_bytes: config.packet_bytes,
        socket: config.socket,
        period_ns: (1e9 / config.rig.trigger_rate_hz) as u64,
    }
}
