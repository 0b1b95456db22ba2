// SPDX-License-Identifier: MIT OR Apache-2.0
//! What opens cameras, an opened camera, and its stream: the traits that a library of cameras implements.

use super::contract::{Breach, FrameContract};
use super::error::CameraError;
use super::features::{self, Features};
use super::profile::{self, Wishes};
use super::set_up;
use super::settings::{Change, SetUp, State};
use crate::base::ids::BlockId;
use crate::config::SocketMode;
use crate::host::frame_memory::Block;
use serde::{Deserialize, Serialize};
use std::time::Duration;

/// A camera that was found on the network or the bus, not opened.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct CameraListing {
    /// The camera's id in Aravis.
    pub id: String,
    /// IP address, or the bus address of a USB camera.
    pub address: String,
    /// Name of the manufacturer, as the camera reports it.
    pub vendor: String,
    /// Name of the model, as the camera reports it.
    pub model: String,
    /// Serial number of the camera.
    pub serial: String,
    /// Name of the transport: "GigEVision", "USB3Vision", ...
    pub protocol: String,
}

/// Vendor, model and serial number of an opened camera.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct CameraIdentity {
    /// Name of the manufacturer, as the camera reports it.
    pub vendor: String,
    /// Name of the model, as the camera reports it.
    pub model: String,
    /// Serial number, as the camera reports it.
    pub serial: String,
}

/// The result of a test of packet sizes, bytes with IP and UDP headers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PacketTest {
    /// The largest packet that arrived, bytes with IP and UDP headers.
    pub arrived: u32,
    /// The largest packet that the camera sends, where that is less than requested.
    pub camera_takes: Option<u32>,
}

/// The parameters of a stream.
#[derive(Debug, Clone)]
pub struct StreamOptions {
    /// What every frame must be, as verified.
    pub contract: FrameContract,
    /// GVSP packet size, bytes with IP and UDP headers.
    pub packet_bytes: u32,
    /// Which kind of socket receives the packets.
    pub socket: SocketMode,
    /// Trigger period, ns: the scale of every timeout.
    pub period_ns: u64,
}

/// One reading of a camera's clock between two readings of the host's clock.
#[derive(Debug, Clone, Copy)]
pub struct CameraClockSample {
    /// Host clock (CLOCK_MONOTONIC) before the request, ns.
    pub host_before_ns: u64,
    /// The camera's own clock, ns.
    pub camera_ns: u64,
    /// Host clock (CLOCK_MONOTONIC) after the answer, ns.
    pub host_after_ns: u64,
}

/// The outcome of a frame's transfer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Transfer {
    /// All bytes arrived, and the frame keeps its contract.
    Complete,
    /// Packets of the frame are missing.
    MissingPackets,
    /// The transfer did not end in time.
    Timeout,
    /// Aravis dropped the frame because its size differs from the buffer's.
    SizeMismatch,
    /// All bytes arrived, but the frame breaks its contract.
    Breach(Breach),
    /// Aravis reports all bytes, but a part of the block was not written.
    Unwritten,
    /// The stream was stopped during the transfer.
    Aborted,
}

/// One frame as it left the stream. Its memory returns to the stream's pool when `block` is dropped.
#[derive(Debug)]
pub struct Received {
    /// The outcome of the transfer.
    pub transfer: Transfer,
    /// The camera's frame number (GVSP block id).
    pub block_id: BlockId,
    /// Start of exposure on the camera's clock, ns; 0 where the frame has no timestamp of the camera.
    pub camera_ns: u64,
    /// When the frame's first packet arrived, host clock (CLOCK_REALTIME), ns.
    pub host_ns: u64,
    /// The frame's memory; its pixels are valid when the transfer is complete.
    pub block: Block,
}

/// Finds cameras, and opens them for one program at a time.
pub trait CameraBackend: Send {
    /// All cameras that answer, without opening any.
    fn list(&mut self) -> Vec<CameraListing>;

    /// Opens a camera and takes control of it.
    fn open(&mut self, address: &str) -> Result<Box<dyn Camera>, CameraError>;
}

/// An opened camera. The backend makes it; whoever opened it owns it, sets it up, and creates its streams. Control of
/// the camera ends when it is dropped.
pub trait Camera: Send {
    /// Vendor, model and serial number.
    fn identity(&self) -> &CameraIdentity;

    /// Features and registers of the camera.
    fn features(&self) -> &dyn Features;

    /// Whether this program still controls the camera.
    fn is_alive(&self) -> bool;

    /// For a camera that is not alive: the error that names its controller, where the transport has such a privilege
    /// and the camera answers.
    fn not_ours(&self) -> Option<CameraError>;

    /// Brings the camera into a known state, sets it as the node file requests, and verifies what it will send.
    ///
    /// # Errors
    /// [`CameraError::SetUp`] with every problem.
    fn set_up(&mut self, wishes: &Wishes) -> Result<SetUp, CameraError> {
        set_up::set_up(self.features(), wishes)
    }

    /// The inputs that a trigger's wire can be connected to, by the camera's names, the likeliest first.
    fn trigger_lines(&self) -> Vec<String> {
        profile::trigger_lines(self.features())
    }

    /// All features that can be read, with their values.
    fn state(&mut self) -> Result<State, CameraError> {
        features::read_state(self.features())
    }

    /// The watched features ([`SetUp::watched`]) that have changed since the set-up.
    fn changed(&mut self, watched: &State) -> Result<Vec<Change>, CameraError> {
        set_up::changed(self.features(), watched)
    }

    /// Columns and rows of the images as the camera is set now.
    ///
    /// # Errors
    /// The camera does not answer, or the size is that of no image.
    fn image_size(&mut self) -> Result<(usize, usize), CameraError>;

    /// Reads the camera's clock; `None` where it has none that can be read ([`Self::why_no_clock`]).
    fn sample_clock(&mut self) -> Result<Option<CameraClockSample>, CameraError>;

    /// Why the clock cannot be read, once [`Self::sample_clock`] has tried.
    fn why_no_clock(&self) -> Option<&str>;

    /// The PTP status: `Master`, `Slave`, `Listening` and others; `None` where the camera has no such feature.
    fn ptp_status(&mut self) -> Result<Option<String>, CameraError>;

    /// Makes the camera send test packets of `bytes`, or as large as it can, and gives the largest size that arrives.
    /// `None` where the transport or the camera has no such test. No stream may exist.
    fn test_packet_size(&mut self, bytes: u32) -> Result<Option<PacketTest>, CameraError>;

    /// Creates a fresh stream into `blocks`. All streams of a host are created before any acquisition starts, because a
    /// packet socket receives foreign packets until its filter is set.
    fn create_stream(
        &mut self,
        blocks: Vec<Block>,
        options: &StreamOptions,
    ) -> Result<Box<dyn FrameStream>, CameraError>;

    /// Starts the acquisition. From here on every trigger gives a frame.
    fn start(&mut self) -> Result<(), CameraError>;

    /// Stops the acquisition; frames under way are dropped.
    fn stop(&mut self) -> Result<(), CameraError>;
}

/// A running stream. Dropping it ends it.
pub trait FrameStream: Send {
    /// The next frame, complete or not; `None` after `timeout` without any.
    fn next(&mut self, timeout: Duration) -> Option<Received>;

    /// Number of packets received on this stream, or of frames where the transport has no packets to count. It grows
    /// while the camera sends.
    fn activity(&self) -> u64;

    /// The stream's counters by Aravis' names.
    fn counters(&self) -> Vec<(String, u64)>;
}
