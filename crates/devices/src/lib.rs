// SPDX-License-Identifier: MIT OR Apache-2.0
//! The hardware of a node: its network, the HSU, the cameras, and the way of their frames to the writer.

#![allow(missing_docs, reason = "fields and variants whose names say it carry no comment")]

use fourdbody_core::{base, config};
use fourdbody_record::{self as record, host, matcher};

/// Frames from cameras to the writer: receivers, accounting, bounded hand-offs.
pub mod acquire;
/// Cameras: settings, and streams through Aravis.
pub mod camera;
/// The serial link to the hardware synchronization unit.
pub mod hsu;
/// This host's network interfaces, and the cameras that answer on them.
pub mod network;
