// SPDX-License-Identifier: MIT OR Apache-2.0
//! The hardware of a node: its network, the HSU, the cameras, and the way of their frames to the writer.

#![allow(missing_docs, reason = "fields and variants whose names say it carry no comment")]

use fourdbody_core::{base, config};
use fourdbody_record::{self as record, host, matcher};

pub mod acquire;
pub mod camera;
pub mod hsu;
pub mod network;
