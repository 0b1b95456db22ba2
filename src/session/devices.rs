//! The node's devices: its cameras and its link to the HSU, kept open between sessions.

use super::state::Fault;
use crate::acquire::matcher::ClockRelation;
use crate::acquire::pool::{Pool, block_bytes};
use crate::acquire::receiver::{Arrival, Receiver};
use crate::api::dto::{CameraStatus, HsuStatus};
use crate::camera::{
    AppliedSetting, Camera, CameraBackend, CameraClockSample, CameraIdentity, StreamOptions,
};
use crate::cmds::Exit;
use crate::config::{CameraConfig, NodeConfig};
use crate::hsu::{Hsu, HsuTimeouts, HsuTiming};
use crate::ids::CameraId;
use crate::time::{host_time_ns, monotonic_ns};
use crossbeam_channel::Sender;
use std::time::{Duration, Instant};

/// One configured camera, open or not.
struct Slot {
    config: CameraConfig,
    camera: Option<Box<dyn Camera>>,
    problem: Option<String>,
    /// Columns and rows that the rig has for it.
    size: (usize, usize),
}

impl Slot {
    fn start(&mut self) -> Result<(), Fault> {
        let Some(camera) = &mut self.camera else { return Ok(()) };
        camera.start().map_err(|e| Fault::new(Exit::Device, format!("camera {}: {e}", self.config.id)))
    }
}

/// A camera that is ready for a session.
#[derive(Debug, Clone)]
pub struct PreparedCamera {
    /// Its name in the rig.
    pub id: CameraId,
    /// Columns and rows of its images.
    pub size: (usize, usize),
    /// Who it is.
    pub identity: CameraIdentity,
    /// Settings as read back.
    pub settings: Vec<AppliedSetting>,
}

/// How often a missing device is looked for while the node is idle: an absent camera blocks for 2.5 s.
const RETRY_INTERVAL: Duration = Duration::from_secs(15);
/// The HSU answers at once, or its absence is noticed in a second.
const HSU_RETRY_INTERVAL: Duration = Duration::from_secs(3);
/// Clock exchanges per device before a session; the one with the shortest round trip counts.
const CLOCK_SAMPLES: usize = 8;

/// All devices of the node.
pub struct Devices {
    backend: Box<dyn CameraBackend>,
    slots: Vec<Slot>,
    /// Frame memory, kept between sessions.
    pool: Pool,
    hsu: Option<Hsu>,
    hsu_problem: Option<String>,
    config: NodeConfig,
    next_retry: Instant,
    next_hsu_retry: Instant,
}

impl Devices {
    /// The devices of a node, none open yet.
    pub fn new(config: &NodeConfig, backend: Box<dyn CameraBackend>) -> Self {
        let not_yet = || Some("not opened yet".to_owned());
        let slot = |camera: &CameraConfig| Slot {
            config: camera.clone(),
            camera: None,
            problem: not_yet(),
            size: config
                .rig
                .cameras()
                .find(|(_, known)| known.id == camera.id)
                .map_or((0, 0), |(_, known)| (known.device.width, known.device.height)),
        };
        let slots: Vec<Slot> = config.cameras.iter().map(slot).collect();
        let blocks = |slot: &Slot| config.buffers_per_camera * block_bytes(slot.size.0 * slot.size.1);
        let needed: usize = slots.iter().map(blocks).sum();
        Self {
            pool: Pool::new(config.realtime.lock_memory, needed as u64),
            slots,
            backend,
            hsu: None,
            hsu_problem: not_yet(),
            config: config.clone(),
            next_retry: Instant::now(),
            next_hsu_retry: Instant::now(),
        }
    }

    /// The link to the HSU, when it is up.
    pub fn hsu(&self) -> Option<&Hsu> {
        self.hsu.as_ref()
    }

    /// Forgets a link that failed.
    pub fn drop_hsu(&mut self, reason: String) {
        self.hsu = None;
        self.hsu_problem = Some(reason);
        self.next_hsu_retry = Instant::now() + HSU_RETRY_INTERVAL;
    }

    /// Between sessions: notices lost devices, and looks for missing ones now and then. Opens at most one
    /// device per call, because an absent one blocks.
    pub fn look_after(&mut self) {
        for slot in &mut self.slots {
            if slot.camera.as_ref().is_some_and(|camera| !camera.is_alive()) {
                slot.camera = None;
                slot.problem = Some("the camera stopped answering; check its power and cable".to_owned());
            }
        }
        if self.hsu.is_none() && Instant::now() >= self.next_hsu_retry {
            drop(self.connect_hsu());
            self.next_hsu_retry = Instant::now() + HSU_RETRY_INTERVAL;
        }
        if Instant::now() < self.next_retry {
            return;
        }
        let fresh = |slot: &Slot| slot.problem.as_deref() == Some("not opened yet");
        let missing = |slot: &Slot| slot.camera.is_none();
        let next = self.slots.iter().position(fresh).or_else(|| self.slots.iter().position(missing));
        if let Some(i) = next {
            drop(self.open(i));
            // One that is absent goes behind the others.
            if let Some(problem) = &self.slots[i].problem {
                tracing::warn!(camera = %self.slots[i].config.id, "{problem}");
            }
        }
        let waiting = self.slots.iter().any(fresh);
        self.next_retry = Instant::now() + if waiting { Duration::ZERO } else { RETRY_INTERVAL };
    }

    fn open(&mut self, i: usize) -> Result<(), Fault> {
        let slot = &mut self.slots[i];
        match self.backend.open(&slot.config.address) {
            Ok(camera) => {
                let identity = camera.identity();
                tracing::info!(camera = %slot.config.id, address = slot.config.address, model = identity.model, serial = identity.serial, "opened");
                slot.camera = Some(camera);
                slot.problem = None;
                Ok(())
            }
            Err(error) => {
                slot.problem = Some(error.to_string());
                Err(Fault::new(Exit::Device, format!("camera {}: {error}", slot.config.id)))
            }
        }
    }

    fn connect_hsu(&mut self) -> Result<(), Fault> {
        match Hsu::connect(&self.config.hsu_device, &self.config.node, &HsuTimeouts::default()) {
            Ok(hsu) => {
                tracing::info!(device = %self.config.hsu_device.display(), identity = identity_text(&hsu), "HSU connected");
                self.hsu = Some(hsu);
                self.hsu_problem = None;
                Ok(())
            }
            Err(error) => {
                self.hsu_problem = Some(error.to_string());
                let device = self.config.hsu_device.display();
                Err(Fault::new(Exit::Device, format!("HSU at {device}: {error}")))
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
            let message = format!("HSU at {}: {error}", self.config.hsu_device.display());
            self.drop_hsu(message.clone());
            faults.push(Fault::new(Exit::Device, message));
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
        let slot = &mut self.slots[i];
        let id = slot.config.id.clone();
        let fault = |error: &dyn std::fmt::Display| Fault::new(Exit::Device, format!("camera {id}: {error}"));
        let camera = slot.camera.as_mut().ok_or_else(|| fault(&"not open"))?;
        let applied =
            camera.apply(&slot.config.settings).and_then(|settings| Ok((settings, camera.image_size()?)));
        let (settings, size) = applied.map_err(|error| fault(&error))?;
        if size != slot.size {
            let (found, expected) = (size, slot.size);
            let text = format!(
                "its images are {} x {}, the rig has {} x {}; set Width and Height in the node file",
                found.0, found.1, expected.0, expected.1
            );
            return Err(fault(&text));
        }
        Ok(PreparedCamera { id: id.clone(), size, identity: camera.identity().clone(), settings })
    }

    /// How each camera's clock relates to the HSU's; accurate to half a round trip.
    pub fn clock_relations(&mut self) -> Vec<ClockRelation> {
        let hsu = self.hsu.as_ref().and_then(|hsu| {
            let samples = (0..CLOCK_SAMPLES).filter_map(|_| hsu.query_clock().ok());
            let best = samples.min_by_key(|s| s.received - s.sent)?;
            Some(i128::from(best.time_ns) - middle(monotonic_ns(best.sent), monotonic_ns(best.received)))
        });
        let realtime = i128::from(host_time_ns()) - i128::from(monotonic_ns(Instant::now()));
        let camera = |slot: &mut Slot| {
            let camera = slot.camera.as_mut()?;
            let samples = (0..CLOCK_SAMPLES).filter_map(|_| camera.sample_clock().ok().flatten());
            let samples: Vec<CameraClockSample> = samples.collect();
            // A latch that does nothing leaves the value as it is.
            let runs = samples.iter().any(|s| s.camera_ns != samples[0].camera_ns);
            let best = samples.iter().min_by_key(|s| s.host_after_ns - s.host_before_ns).filter(|_| runs)?;
            Some(i128::from(best.camera_ns) - middle(best.host_before_ns, best.host_after_ns))
        };
        let relation = |slot: &mut Slot| ClockRelation {
            camera_minus_hsu_ns: camera(slot).zip(hsu).map(|(camera, hsu)| camera - hsu),
            hsu_minus_host_ns: hsu.map(|hsu| hsu - realtime),
        };
        self.slots.iter_mut().map(relation).collect()
    }

    /// Creates a fresh stream with a receiver on every camera, then starts every acquisition; on failure none
    /// is left running.
    pub fn start_streams(&mut self, recorder: &Sender<Arrival>) -> Result<Vec<Receiver>, Fault> {
        let mut receivers = Vec::new();
        let created = (0..self.slots.len()).try_for_each(|i| {
            receivers.push(self.create_stream(i, recorder.clone())?);
            Ok(())
        });
        let started = created.and_then(|()| self.slots.iter_mut().try_for_each(Slot::start));
        match started {
            Ok(()) => Ok(receivers),
            Err(fault) => {
                self.stop_streams(receivers);
                Err(fault)
            }
        }
    }

    fn create_stream(&mut self, i: usize, recorder: Sender<Arrival>) -> Result<Receiver, Fault> {
        let options = StreamOptions {
            packet_bytes: self.config.packet_bytes,
            socket: self.config.socket,
            period_ns: (1e9 / self.config.rig.trigger_rate_hz) as u64,
        };
        let slot = &mut self.slots[i];
        let (id, pixel_bytes) = (&slot.config.id, slot.size.0 * slot.size.1);
        let fault = |error: String| Fault::new(Exit::Device, format!("camera {id}: {error}"));
        let camera = slot.camera.as_mut().ok_or_else(|| fault("not open".to_owned()))?;
        let blocks = self.pool.take(pixel_bytes, self.config.buffers_per_camera);
        let stream = camera.create_stream(blocks, &options).map_err(|e| fault(e.to_string()))?;
        Receiver::start(i, stream, recorder).map_err(|e| fault(format!("cannot start its thread: {e}")))
    }

    /// Stops acquisition and receivers; returns each camera's stream counters.
    pub fn stop_streams(&mut self, receivers: Vec<Receiver>) -> Vec<Vec<(String, u64)>> {
        for slot in self.slots.iter_mut().take(receivers.len()) {
            if let Some(camera) = &mut slot.camera
                && let Err(error) = camera.stop()
            {
                tracing::warn!(camera = %slot.config.id, "{error}");
            }
        }
        receivers.into_iter().map(Receiver::stop).collect()
    }

    /// The first camera that is gone, with its place.
    pub fn lost_camera(&self) -> Option<(usize, CameraId)> {
        let lost = |slot: &Slot| slot.camera.as_ref().is_some_and(|camera| !camera.is_alive());
        self.slots.iter().position(lost).map(|i| (i, self.slots[i].config.id.clone()))
    }

    /// For the status.
    pub fn camera_statuses(&self) -> Vec<CameraStatus> {
        let status = |slot: &Slot| CameraStatus {
            id: slot.config.id.clone(),
            address: slot.config.address.clone(),
            identity: slot.camera.as_ref().map(|camera| camera.identity().clone()),
            problem: slot.problem.clone(),
        };
        self.slots.iter().map(status).collect()
    }

    /// For the status.
    pub fn hsu_status(&self) -> HsuStatus {
        HsuStatus {
            device: self.config.hsu_device.clone(),
            identity: self.hsu.as_ref().map(identity_text),
            problem: self.hsu_problem.clone(),
        }
    }
}

/// Product, unit and firmware, for people.
fn identity_text(hsu: &Hsu) -> String {
    let identity = hsu.identity();
    let [major, minor, patch] = identity.firmware;
    format!("{} {} firmware {major}.{minor}.{patch}", identity.name, unique_id(hsu))
}

/// The unit's serial number: as text where it is one, in hexadecimal otherwise.
pub fn unique_id(hsu: &Hsu) -> String {
    let id = hsu.identity().unique_id;
    match std::str::from_utf8(&id) {
        Ok(text) if text.chars().all(|c| c.is_ascii_graphic()) => text.to_owned(),
        _ => id.iter().map(|byte| format!("{byte:02x}")).collect(),
    }
}

fn middle(a: u64, b: u64) -> i128 {
    (i128::from(a) + i128::from(b)) / 2
}
