// SPDX-License-Identifier: MIT OR Apache-2.0
//! Sessions to results and to calibrations: planned, resumed, written, exported, spread over a cluster.

#![allow(missing_docs, reason = "fields and variants whose names say it carry no comment")]

use fourdbody_calibrate as calibrate;
#[cfg(test)]
use fourdbody_core::config;
use fourdbody_core::{base, data, geometry};
use fourdbody_reconstruct::{self as reconstruct, merge};
use fourdbody_record as record;

/// A session reconstructed to a directory of results.
pub mod batch;
/// Photographs of the board to a calibration file, and whether a calibration still stands.
pub mod calibrating;
/// A reconstruction spread over a cluster.
pub mod cluster;
/// Clouds, meshes, pictures and tables in the formats of other programs.
pub mod export;
/// File formats of clouds for other programs.
pub mod formats;
