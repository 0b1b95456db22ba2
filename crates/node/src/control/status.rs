// SPDX-License-Identifier: MIT OR Apache-2.0
//! What goes over the API.

use super::request::{KeepRequest, Phase};
use super::tokens::Role;
use crate::base::Fault;
use crate::base::histogram::Latency;
use crate::base::ids::{CameraId, NodeId};
use crate::camera::{AppliedSetting, CameraIdentity};
use crate::config::{FeatureSetting, OnLoss, SocketMode, WhenFull};
use crate::record::{Interrupted, Verdict};
use crate::telemetry::{Family, Judgement};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;
use std::time::Instant;
use utoipa::ToSchema;

/// The state of a node, its devices and its session. The node's thread publishes it after every event; the API adds
/// the age, the warnings and the judgements.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct NodeStatus {
    /// Its name in the rig.
    #[schema(value_type = String)]
    pub node: NodeId,
    /// The version of the program.
    pub version: String,
    /// The name of the rig in its file.
    pub rig: String,
    /// Triggers per second, by the rig.
    pub trigger_rate_hz: f64,
    /// The nodes that the rig has: a session of fewer is one of a part of the rig.
    #[schema(value_type = Vec<String>)]
    pub rig_nodes: Vec<NodeId>,
    /// Where it is in a session.
    pub phase: Phase,
    /// Its cameras, in the rig's order.
    pub cameras: Vec<CameraStatus>,
    /// Its link to the HSU.
    pub hsu: HsuStatus,
    /// Requests to the system that it refused (real-time priority, locked memory): the node works without.
    #[serde(default)]
    pub warnings: Vec<String>,
    /// The directory in which sessions are recorded.
    #[schema(value_type = String)]
    pub sessions_dir: PathBuf,
    /// Free space in that directory, bytes.
    pub free_bytes: u64,
    /// Recordings of this node that were found unfinished when it started.
    #[serde(default)]
    pub interrupted: Vec<Interrupted>,
    /// The session in progress, or the last one; previews are none.
    pub session: Option<SessionStatus>,
    /// The preview in progress, or the last one.
    #[serde(default)]
    pub preview: Option<SessionStatus>,
    /// Whether the console begins with moving pictures while nothing is recorded.
    #[serde(default)]
    pub live_preview: bool,
    /// What is measured, judged by the thresholds of `fourdbody::telemetry`.
    #[serde(default)]
    pub judgements: Vec<Judgement>,
    /// The worker that reconstructs on this machine, where there is one.
    #[serde(default)]
    pub worker: Option<WorkerStatus>,
    /// How old all this is, s: a device that does not answer keeps the node's thread for some seconds.
    #[serde(default)]
    pub age_s: f64,
    /// When the node's thread last published all this.
    #[serde(skip)]
    pub published: Option<Instant>,
}

impl NodeStatus {
    /// Whether cameras run for a preview, which gives way to everything else.
    pub fn is_in_preview(&self) -> bool {
        self.phase != Phase::Idle && self.preview.as_ref().is_some_and(|preview| preview.outcome.is_none())
    }

    /// Whether a session can begin here: the node is in none, or only in a preview.
    pub fn is_free(&self) -> bool {
        self.phase == Phase::Idle || self.is_in_preview()
    }

    /// The session or preview with this id, in progress or the last one.
    pub fn session_of(&self, session_id: u64) -> Option<&SessionStatus> {
        [&self.session, &self.preview].into_iter().flatten().find(|one| one.session_id == session_id)
    }
}

/// The state of the worker on this machine.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct WorkerStatus {
    /// For people: on what it is, how far, how much waits.
    pub line: String,
    /// Whether the worker runs, by the age of its last report.
    pub running: bool,
    /// Sessions that it has set aside, each with the reason.
    pub set_aside: Vec<(String, String)>,
}

/// Whether a calibration still holds, as a light.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum CalibrationLight {
    /// The devices stand as they were calibrated.
    Green,
    /// One has moved, but not surely by more than it may.
    Amber,
    /// One has moved by more than it may: calibrate again.
    Red,
    /// The calibration was not checked.
    Grey,
}

/// What is known of the calibration during a session.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct SessionLight {
    /// The name of the session.
    pub session: String,
    /// The id that its recordings share; `None`: whatever has this name.
    pub session_id: Option<String>,
    /// The result of the check as a colour.
    pub light: CalibrationLight,
    /// The result of the check in a sentence.
    pub said: String,
}

/// What the worker of a node's machine has found of the calibration.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct CalibrationLights {
    /// Whether the node file names a worker.
    pub worker: bool,
    /// The sessions recorded last first; then those that could not be looked at.
    pub sessions: Vec<SessionLight>,
    /// Of all other sessions nothing is known; why.
    pub otherwise: String,
}

/// Whether a session can be played.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct PlayableTake {
    /// The name of the session.
    pub session: String,
    /// The id that its recordings share; `None`: whatever has this name.
    pub session_id: Option<String>,
    /// Why it cannot be played; `None`: it can.
    pub why_not: Option<String>,
}

/// What the worker of a node's machine has reconstructed.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct PlayableTakes {
    /// Whether the node file names a worker.
    pub worker: bool,
    /// The sessions that can be played, the last 1000; then those that the worker could not reconstruct.
    pub sessions: Vec<PlayableTake>,
    /// Why no other session can.
    pub otherwise: String,
}

impl NodeStatus {
    /// What keeps the node from capturing, each with the device's name.
    pub fn problems(&self) -> Vec<String> {
        let cameras = self.cameras.iter();
        let cameras = cameras.filter_map(|c| c.problem.as_ref().map(|p| format!("camera {}: {p}", c.id)));
        let hsu = self.hsu.problem.iter().map(|p| format!("HSU at {}: {p}", self.hsu.device.display()));
        cameras.chain(hsu).collect()
    }
}

/// The state of one camera.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct CameraStatus {
    /// Its name in the rig.
    #[schema(value_type = String)]
    pub id: CameraId,
    /// The camera's address in the node file.
    pub address: String,
    /// Who it is, once opened.
    pub identity: Option<CameraIdentity>,
    /// Why it is not usable; `None` when it is.
    pub problem: Option<String>,
    /// The exposure and gain that it has to use.
    #[serde(default)]
    pub exposure: Option<ExposureNow>,
}

/// The exposure and gain that a camera has to use.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ExposureNow {
    /// The head that the camera belongs to.
    pub head: String,
    /// Exposure, microseconds; `None`: the node file leaves it to raw settings.
    pub exposure_us: Option<f64>,
    /// Gain, decibels; `None`: the node file leaves it to raw settings.
    pub gain_db: Option<f64>,
    /// The longest exposure that ends within the trigger period, microseconds.
    pub most_us: f64,
    /// Set since the node was started, and not as in the node file.
    pub differs: bool,
}

/// The result of setting exposure and gain.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ExposureSet {
    /// The cameras of this node.
    pub cameras: Vec<CameraExposure>,
}

/// Exposure and gain of a camera that was set.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct CameraExposure {
    /// Its name in the rig.
    #[schema(value_type = String)]
    pub id: CameraId,
    /// The requested exposure time, microseconds.
    pub exposure_us: f64,
    /// The gain that was requested, decibels.
    pub gain_db: f64,
    /// The camera's own features of both, as requested and as read back.
    pub taken: Vec<AppliedSetting>,
    /// What the camera rounded, and what was found otherwise and mended.
    pub told: Vec<String>,
    /// All settings of the camera, as read back.
    #[serde(skip)]
    pub settings: Vec<AppliedSetting>,
}

/// The link to the HSU.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct HsuStatus {
    /// The serial device in the node file.
    #[schema(value_type = String)]
    pub device: PathBuf,
    /// Who it is, once connected.
    pub identity: Option<String>,
    /// Why it is not usable; `None` when it is.
    pub problem: Option<String>,
}

/// A session's progress, and in the end its outcome.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct SessionStatus {
    /// The same on both nodes.
    pub session_id: u64,
    /// The session's name, as requested.
    pub name: String,
    /// The nodes that take part.
    #[serde(default)]
    #[schema(value_type = Vec<String>)]
    pub nodes: Vec<NodeId>,
    /// The directory of this node's recording.
    #[schema(value_type = String)]
    pub directory: PathBuf,
    /// Nothing was written: `directory` does not exist.
    #[serde(default)]
    pub dry_run: bool,
    /// Number of requested triggers; 0: until stopped.
    pub triggers_asked: u64,
    /// Triggers that the HSU reported so far; before Record 0, and then those from the recording's first on.
    pub triggers: u64,
    /// Where frames are held until Record.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub held: Option<Held>,
    /// Where Record was pressed after frames had been held.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub kept: Option<KeepRequest>,
    /// Progress per camera, in the rig's order.
    pub cameras: Vec<CameraProgress>,
    /// Frames that wait for the writer now.
    #[serde(default)]
    pub ring_frames: u64,
    /// Frames that can wait for the writer; beyond that they are lost.
    #[serde(default)]
    pub ring_capacity: u64,
    /// Most frames that waited for the writer at any time.
    pub ring_high_water_frames: u64,
    /// From the ring until the writer had taken the frame.
    #[serde(default)]
    pub written: Latency,
    /// From the stream until the writer had taken the frame.
    #[serde(default)]
    pub total: Latency,
    /// Notices that the operator must see at once; each holds as long as it is listed here.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub notices: Vec<String>,
    /// Set when the session has ended on this node.
    pub outcome: Option<Outcome>,
}

/// Triggers of the train whose frames are held in memory until Record.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Held {
    /// The index of the oldest held trigger.
    pub oldest: u64,
    /// One more than the newest.
    pub end: u64,
    /// Number of triggers that are to be kept before Record.
    pub asked: u64,
}

/// One camera's frames so far.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct CameraProgress {
    /// Its name in the rig.
    #[schema(value_type = String)]
    pub id: CameraId,
    /// Frames handed to the writer.
    pub frames: u64,
    /// Gap records written so far.
    pub gaps: u64,
    /// No packet has arrived from it for some triggers: long before the camera counts as lost.
    #[serde(default)]
    pub silent: bool,
}

/// How a session ended on this node.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// There is a recording, and this is its verdict.
    Recorded(serde_json::Value),
    /// There is no recording, for this reason.
    Failed(Fault),
}

impl Outcome {
    /// What keeps the recording from being complete, beside its cameras' gaps: a line each.
    pub fn remarks(&self) -> Vec<String> {
        let Self::Recorded(verdict) = self else { return Vec::new() };
        // A verdict of a later version may have words that this one does not know.
        Verdict::deserialize(verdict).map(|verdict| verdict.remarks()).unwrap_or_default()
    }
}

/// Which session a command is for: a late command for another one is refused.
#[derive(Debug, Clone, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct SessionCommand {
    /// The id of the session, as in the request that prepared it.
    pub session_id: u64,
    /// Why the session is aborted; stored in the recording.
    #[serde(default)]
    pub reason: Option<String>,
}

/// How a client showed who it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Via {
    /// The Unix socket: a user of this machine.
    Socket,
    /// A token in the `Authorization` header.
    Token,
    /// A browser's cookie, from a login.
    Cookie,
    /// The code of a link, which works once.
    Link,
    /// Not at all: TCP on a loopback address of a node without tokens.
    Nothing,
}

/// Whether the node can take a session.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Health {
    /// Whether a session could start now.
    pub healthy: bool,
    /// Everything that keeps a session from starting.
    pub reasons: Vec<String>,
}

/// Whether the node's own parts are fit, for monitors without a token: it names no device, session or person.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Fitness {
    /// Whether cameras, HSU and disk can take a session.
    pub fit: bool,
    /// A sentence for each part that is not fit.
    pub reasons: Vec<String>,
}

/// The node's cameras and its link to the HSU.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Devices {
    /// Its cameras, in the rig's order.
    pub cameras: Vec<CameraStatus>,
    /// Its link to the HSU.
    pub hsu: HsuStatus,
}

/// What is configured, and what cameras made of it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Settings {
    /// The node's name in the rig.
    pub node: String,
    /// The name of the rig in its file.
    pub rig: String,
    /// Triggers a second, by the rig file.
    pub trigger_rate_hz: f64,
    /// The directory in which sessions are recorded.
    pub sessions_dir: String,
    /// The disk is never filled beyond this many free bytes.
    pub reserve_bytes: u64,
    /// A segment is closed at the first trigger after this many bytes.
    pub segment_bytes: u64,
    /// Number of frame buffers of each camera.
    pub buffers_per_camera: usize,
    /// Size of the GVSP packets, bytes.
    pub packet_bytes: u32,
    /// The kind of socket that receives packets.
    pub socket: SocketMode,
    /// Before arming no camera may send for this long.
    pub silence_gate_ms: u64,
    /// When frames come faster than the disk takes them.
    pub when_full: WhenFull,
    /// When a camera stops answering.
    pub on_camera_lost: OnLoss,
    /// When the link to the HSU breaks during a train.
    pub on_link_lost: OnLoss,
    /// Its cameras, in the rig's order.
    pub cameras: Vec<CameraSettings>,
}

/// The settings of one camera.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct CameraSettings {
    /// Its name in the rig.
    #[schema(value_type = String)]
    pub id: CameraId,
    /// The camera's address in the node file.
    pub address: String,
    /// Columns and rows of its images, by the rig.
    pub size: [usize; 2],
    /// The settings of the node file, its words and raw settings; a word stands under its own name.
    pub configured: Vec<FeatureSetting>,
    /// As read back when a session was last prepared; none before the first.
    pub read_back: Option<Vec<AppliedSetting>>,
}

/// All metrics of the node as JSON.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Metrics {
    /// The same families as in the text for Prometheus.
    pub families: Vec<Family>,
}

/// Who the node takes a caller for.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Identity {
    /// The token's name, `uid N` of the Unix socket, or the address.
    pub name: String,
    /// The role, which decides what the caller may do.
    pub role: Role,
    /// How they showed who they are.
    pub via: Via,
}

/// What a proof of a token is made for (`docs/design/api.md`).
#[derive(Debug, Clone, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Challenge {
    /// A random number of this connection alone.
    pub nonce: String,
}

/// What a browser logs in with.
#[derive(Clone, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Login {
    /// The secret, as `fourdbody token new` wrote it.
    pub token: String,
}

/// A login by a link: its code works once.
#[derive(Clone, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct LoginByLink {
    /// What follows `#login=` in the link that `fourdbody token link` printed.
    pub code: String,
}

/// The number of a capture that has begun.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct CaptureBegun {
    /// Counts the captures that the node has run since it started.
    pub number: u64,
}

/// A name under which nothing is recorded at the node.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct FreeName {
    /// The requested name, or the first number after it that is free.
    pub name: String,
}

/// Why a session is given up.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct AbortReason {
    /// The reason, which is stored in the recording.
    #[serde(default)]
    pub reason: Option<String>,
}

/// Another node, as this one sees it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct PeerState {
    /// Its name in the rig.
    #[schema(value_type = String)]
    pub name: NodeId,
    /// The URL of the node's API.
    pub url: String,
    /// The status of the node, where it answered.
    pub status: Option<NodeStatus>,
    /// Why there is no status of it.
    pub problem: Option<String>,
}

/// Where the API lies on a node.
pub mod path {
    /// POST: somebody looks at the pictures while nothing is recorded.
    pub const PREVIEW: &str = "/api/v1/preview";
    /// GET: the capture that the node runs; POST [`crate::capture::series::Series`]: begins one.
    pub const CAPTURE: &str = "/api/v1/capture";
    pub const CAPTURE_STOP: &str = "/api/v1/capture/stop";
    /// POST: keeps what is held, and records.
    pub const CAPTURE_RECORD: &str = "/api/v1/capture/record";
    pub const CAPTURE_ABORT: &str = "/api/v1/capture/abort";
    /// GET: what is known of all cameras' pictures.
    pub const PREVIEWS: &str = "/api/v1/previews";
    pub const PICTURE: &str = "/api/v1/previews/{camera}";
    /// GET: the newest frame set as points.
    pub const LIVE: &str = "/api/v1/live";
    /// GET: every fourth row of this node's frames of a trigger, for another node.
    pub const LIVE_ROWS: &str = "/api/v1/live/rows/{trigger}";
    /// GET: what the node has recorded.
    pub const SESSIONS: &str = "/api/v1/sessions";
    pub const SESSION: &str = "/api/v1/sessions/{name}";
    /// GET [`super::FreeName`]: this name, or the first number after it that is free.
    pub const FREE_NAME: &str = "/api/v1/sessions/{name}/free";
    /// POST [`crate::record::remark::Remark`]: what people think of a recording.
    pub const REMARK: &str = "/api/v1/sessions/{name}/remark";
    /// GET: how far the look is; POST: asks for one.
    pub const QUICK_LOOK: &str = "/api/v1/sessions/{name}/quick-look";
    pub const QUICK_LOOK_CLOUD: &str = "/api/v1/sessions/{name}/quick-look/{trigger}";
    /// GET [`super::PlayableTakes`]: what the worker has reconstructed.
    pub const PLAYABLE: &str = "/api/v1/playable";
    /// GET [`crate::play::Described`]: what a player must know.
    pub const FRAME_SETS: &str = "/api/v1/sessions/{name}/frame-sets";
    pub const FRAME_SET: &str = "/api/v1/sessions/{name}/frame-sets/{trigger}";
    /// GET: what the worker found of the calibration.
    pub const CALIBRATION_LIGHTS: &str = "/api/v1/calibration-lights";
    /// GET: the plot of the worker's history.
    pub const CALIBRATION_PLOT: &str = "/api/v1/calibration-lights/plot";
    /// POST: exposure and gain of heads.
    pub const EXPOSURE: &str = "/api/v1/exposure";
    /// POST: the same at another node.
    pub const PEER_EXPOSURE: &str = "/api/v1/peers/{peer}/exposure";
    pub const PEERS: &str = "/api/v1/peers";
    /// POST [`crate::record::remark::Remark`]: the same for another node's recording.
    pub const PEER_REMARK: &str = "/api/v1/peers/{peer}/sessions/{name}/remark";
    /// GET: how far another node's look is; POST: asks it for one.
    pub const PEER_QUICK_LOOK: &str = "/api/v1/peers/{peer}/sessions/{name}/quick-look";
    pub const STATUS: &str = "/api/v1/status";
    /// POST [`crate::control::request::SessionRequest`]: answers when the node is ready, or why it is not.
    pub const PREPARE: &str = "/api/v1/session/prepare";
    pub const START: &str = "/api/v1/session/start";
    pub const KEEP: &str = "/api/v1/session/keep";
    pub const STOP: &str = "/api/v1/session/stop";
    pub const ABORT: &str = "/api/v1/session/abort";
    /// GET [`super::Challenge`]: what a proof of a token is made for, for clients over plain TCP.
    pub const CHALLENGE: &str = "/api/v1/challenge";
    pub const LOGIN: &str = "/api/v1/login";
    pub const LOGIN_BY_LINK: &str = "/api/v1/login/link";
    pub const LOGOUT: &str = "/api/v1/logout";
    pub const IDENTITY: &str = "/api/v1/identity";
    /// GET: [`super::Health`]; 503 when a session could not start.
    pub const HEALTH: &str = "/api/v1/health";
    /// Open to all, without a token.
    pub const FITNESS: &str = "/health";
    pub const DEVICES: &str = "/api/v1/devices";
    pub const SETTINGS: &str = "/api/v1/settings";
    /// GET: metrics as Prometheus reads them.
    pub const METRICS: &str = "/api/v1/metrics";
    pub const METRICS_JSON: &str = "/api/v1/metrics.json";
    /// GET: the API's description (OpenAPI).
    pub const OPENAPI: &str = "/api/v1/openapi.json";
}
