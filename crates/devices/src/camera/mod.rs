// SPDX-License-Identifier: MIT OR Apache-2.0
//! Cameras: settings, and streams of frames into our own memory.
//!
//! Nothing above this layer may assume Ethernet: Aravis drives USB3 Vision cameras through the same calls.
//! [`aravis`] is the only module that names Aravis and is compiled with the feature of that name.

#[cfg(feature = "aravis")]
mod aravis;
#[cfg(feature = "aravis")]
mod canary;
#[cfg(feature = "aravis")]
mod chunks;
mod contract;
pub mod description;
#[cfg(feature = "aravis")]
mod device_clock;
#[cfg(feature = "aravis")]
mod features;
#[cfg(feature = "aravis")]
mod packet_size;
#[cfg(feature = "aravis")]
mod packet_test;
pub mod profile;
mod quiet;
#[cfg(feature = "aravis")]
mod set_up;
mod settings;
#[cfg(feature = "aravis")]
mod source_filter;
mod state;
#[cfg(feature = "aravis")]
mod triggers;
#[cfg(feature = "aravis")]
mod unpack;
#[cfg(feature = "aravis")]
mod verify;
#[cfg(feature = "aravis")]
mod write_amount;

#[cfg(feature = "aravis")]
pub use self::aravis::AravisCameras;
pub use contract::{Breach, Chunks, FrameContract, FrameForm, ImageForm, Payload};
pub use profile::Wishes;
pub use quiet::quiet_stream;
pub use settings::{AppliedSetting, SetUp, matches};
pub use state::{Change, State, differences};

use crate::base::ids::BlockId;
use crate::config::SocketMode;
use crate::host::frame_memory::Block;
use serde::{Deserialize, Serialize};
use std::time::Duration;

/// One camera found on the network or the bus.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct CameraListing {
    /// Aravis device id.
    pub id: String,
    /// IP address, or the bus address of a USB camera.
    pub address: String,
    /// Manufacturer.
    pub vendor: String,
    /// Model.
    pub model: String,
    /// Serial number.
    pub serial: String,
    /// "GigEVision", "USB3Vision", ...
    pub protocol: String,
}

/// Who an opened camera says it is.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct CameraIdentity {
    /// Manufacturer.
    pub vendor: String,
    /// Model.
    pub model: String,
    /// Serial number.
    pub serial: String,
}

/// A camera failure, with what the operator can do about it.
#[derive(Debug, thiserror::Error)]
pub enum CameraError {
    /// Nothing answers at the address.
    #[error(
        "no camera answers at {address} ({detail}); check its power and cable, and the address in the node file"
    )]
    NotFound {
        /// As configured.
        address: String,
        /// What Aravis said.
        detail: String,
    },
    /// Another program holds the control privilege.
    #[error(
        "the camera at {address} is controlled by another program{}; close that program, or wait until its heartbeat times out",
        holder.as_ref().map(|host| format!(" on {host}")).unwrap_or_default()
    )]
    Owned {
        /// As configured.
        address: String,
        /// Address and port of that program, where the camera tells.
        holder: Option<String>,
    },
    /// The camera answers, and refuses what only its controller may do.
    #[error(
        "the camera is not under our control any more ({detail}){}; close the program that took it",
        holder.as_ref().map(|host| format!(": {host} controls it")).unwrap_or_default()
    )]
    NotOurs {
        /// Address and port of the controlling program, where there is one and the camera tells.
        holder: Option<String>,
        /// What Aravis said.
        detail: String,
    },
    /// It cannot be set as the node file says, or would not send what a session records.
    #[error("it cannot be used as it is:\n  {}", problems.join("\n  "))]
    SetUp {
        /// Each with its feature, its value and its remedy.
        problems: Vec<String>,
    },
    /// Communication failed.
    #[error(
        "communication with the camera failed while {doing} ({detail}); check its power, cable and switch"
    )]
    Link {
        /// What was being done.
        doing: &'static str,
        /// What Aravis said.
        detail: String,
    },
    /// It answers what no camera can mean.
    #[error(
        "the camera answers nonsense while {doing} ({detail}); restart it, and where it does so again have its firmware \
         looked at by its vendor"
    )]
    Nonsense {
        /// What was being done.
        doing: &'static str,
        /// What it said.
        detail: String,
    },
    /// It sends test packets, and none arrives.
    #[error(
        "no test packet of the camera arrives, of whatever size, within {patience_ms} ms; look for a firewall that drops \
         them, see `fourdbody doctor`, and whether the camera has a way to this host's address"
    )]
    NoTestPackets {
        /// How long was waited for the packets of one size, ms.
        patience_ms: u128,
    },
    /// This host has no memory for its frames.
    #[error("{0}")]
    Memory(String),
}

/// What test packets have shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PacketTest {
    /// The largest packet that arrived, IP and UDP headers counted in.
    pub arrived: u32,
    /// The largest that the camera sends, where that is less than what was asked.
    pub camera_takes: Option<u32>,
}

/// How a stream is to be set up.
#[derive(Debug, Clone)]
pub struct StreamOptions {
    /// What every frame must be, as verified.
    pub contract: FrameContract,
    /// GVSP packet size, bytes.
    pub packet_bytes: u32,
    /// How packets are received.
    pub socket: SocketMode,
    /// Trigger period, ns: the scale of every timeout.
    pub period_ns: u64,
}

/// One reading of a camera's clock between two readings of the host's.
#[derive(Debug, Clone, Copy)]
pub struct CameraClockSample {
    /// Host clock (CLOCK_MONOTONIC) before the request, ns.
    pub host_before_ns: u64,
    /// Camera clock, ns.
    pub camera_ns: u64,
    /// Host clock (CLOCK_MONOTONIC) after the answer, ns.
    pub host_after_ns: u64,
}

/// What became of a frame's transfer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Transfer {
    /// All bytes arrived.
    Complete,
    /// Packets are missing.
    MissingPackets,
    /// The transfer stalled.
    Timeout,
    /// The transport gave the frame up because it has another size than agreed.
    SizeMismatch,
    /// It arrived, and is not what was agreed.
    Breach(Breach),
    /// All bytes are said to have arrived, but a part of the block was not written.
    Unwritten,
    /// The stream was stopped in the middle.
    Aborted,
}

/// One frame as it left the stream. Its memory goes back to the stream's pool when `block` is dropped.
#[derive(Debug)]
pub struct Received {
    /// What became of the transfer.
    pub transfer: Transfer,
    /// GVSP block id.
    pub block_id: BlockId,
    /// Start of exposure on the camera's clock, ns; 0 where it has no stamp of the camera.
    pub camera_ns: u64,
    /// When the frame's first packet was seen, host clock (CLOCK_REALTIME), ns.
    pub host_ns: u64,
    /// The memory; the pixels are valid when the transfer is complete.
    pub block: Block,
}

/// Discovers and opens cameras.
pub trait CameraBackend: Send {
    /// All cameras that answer, without opening any.
    fn list(&mut self) -> Vec<CameraListing>;

    /// Opens a camera and takes control of it.
    fn open(&mut self, address: &str) -> Result<Box<dyn Camera>, CameraError>;
}

/// An opened camera.
pub trait Camera: Send {
    /// Who it is.
    fn identity(&self) -> &CameraIdentity;

    /// Whether we still control it.
    fn is_alive(&self) -> bool;

    /// The error that says who controls it instead of us, where the transport knows of such a thing and the camera
    /// answers; for a camera that is not alive.
    fn not_ours(&self) -> Option<CameraError> {
        None
    }

    /// Brings it into a known state, sets it as the node file says, and asks it whether it then is as a session needs it.
    ///
    /// # Errors
    /// [`CameraError::SetUp`] with every problem.
    fn set_up(&mut self, wishes: &Wishes) -> Result<SetUp, CameraError>;

    /// The inputs that a trigger's wire can be put to, as it calls them, the likeliest first.
    fn trigger_lines(&self) -> Vec<String>;

    /// Everything that can be read of it.
    fn state(&mut self) -> Result<State, CameraError>;

    /// What is not as it was when it was set up ([`SetUp::watched`]).
    fn changed(&mut self, watched: &State) -> Result<Vec<Change>, CameraError>;

    /// Columns and rows of its images as set now; an error where they are those of no image.
    fn image_size(&mut self) -> Result<(usize, usize), CameraError>;

    /// Reads its clock; `None` where it has none that can be read ([`Self::why_no_clock`]).
    fn sample_clock(&mut self) -> Result<Option<CameraClockSample>, CameraError>;

    /// Why its clock cannot be read, once [`Self::sample_clock`] has found out.
    fn why_no_clock(&self) -> Option<&str>;

    /// What it says of PTP: `Master`, `Slave`, `Listening` and others; `None` where it says nothing.
    fn ptp_status(&mut self) -> Result<Option<String>, CameraError> {
        Ok(None)
    }

    /// Has the camera send test packets of `bytes`, or as large as it can, and gives the size that arrives: that, or the
    /// largest smaller one that does. `None` where the transport or the camera has no such test. No stream may exist.
    fn test_packet_size(&mut self, _bytes: u32) -> Result<Option<PacketTest>, CameraError> {
        Ok(None)
    }

    /// Creates a fresh stream into `blocks`. All streams of a host are created before any acquisition starts:
    /// a packet socket takes foreign packets for its own until its filter is set.
    fn create_stream(
        &mut self,
        blocks: Vec<Block>,
        options: &StreamOptions,
    ) -> Result<Box<dyn FrameStream>, CameraError>;

    /// Starts the acquisition. From here on every trigger gives a frame.
    fn start(&mut self) -> Result<(), CameraError>;

    /// Stops the acquisition.
    fn stop(&mut self) -> Result<(), CameraError>;
}

/// A running stream. Dropping it ends it.
pub trait FrameStream: Send {
    /// The next frame, complete or not; `None` after `timeout` without any.
    fn next(&mut self, timeout: Duration) -> Option<Received>;

    /// How much has been heard of the camera on this stream, whatever became of it: packets, or frames where the
    /// transport has no packets to count. It grows while the camera sends.
    fn heard(&self) -> u64;

    /// Counters by Aravis' names.
    fn counters(&self) -> Vec<(String, u64)>;
}
