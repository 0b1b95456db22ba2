// SPDX-License-Identifier: MIT OR Apache-2.0
//! Cameras: settings, and streams of frames into this program's memory.
//!
//! Nothing above this layer may assume Ethernet: Aravis drives USB3 Vision cameras through the same calls.
//! `aravis.rs` and its folder alone name Aravis, and are compiled with the feature of that name.

#[cfg(feature = "aravis")]
mod aravis;
mod backend;
#[cfg(feature = "aravis")]
mod canary;
#[cfg(feature = "aravis")]
mod chunks;
mod contract;
pub mod description;
#[cfg(feature = "aravis")]
mod device_clock;
mod error;
mod features;
mod packet_size;
#[cfg(feature = "aravis")]
mod packet_test;
pub mod profile;
mod quiet;
mod set_up;
mod settings;
#[cfg(feature = "aravis")]
mod source_filter;
mod triggers;
#[cfg(feature = "aravis")]
mod unpack;
mod verify;
mod write_amount;

#[cfg(feature = "aravis")]
pub use self::aravis::AravisCameras;
pub use backend::{
    Camera, CameraBackend, CameraClockSample, CameraIdentity, CameraListing, FrameStream, PacketTest,
    Received, StreamOptions, Transfer,
};
pub use contract::{Breach, Chunks, FrameContract, FrameForm, ImageForm, Payload};
pub use error::CameraError;
pub use features::{Failed, Features};
pub use profile::Wishes;
pub use quiet::quiet_stream;
pub use settings::{AppliedSetting, Change, SetUp, State, differences};
