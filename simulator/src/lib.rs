// SPDX-License-Identifier: MIT OR Apache-2.0
//! Simulated light, cameras and HSU: real protocols, simulated photons.
//!
//! Knows the product's library (rig, geometry, pattern, calibration file); the product never knows it.

#![allow(missing_docs, reason = "no library for others: what a name says needs no comment")]

/// Rendered sequences on disk, and their replay.
pub mod cache;
/// One file per command of the command line.
pub mod cmds;
/// A calibration against the true rig.
pub mod compare;
pub mod disk;
/// Injected faults, and how recordings account for them.
pub mod faults;
pub mod gige;
pub mod hsu;
pub mod images;
pub mod laboratory;
/// From the projector's panel to pixel values.
pub mod optics;
/// Random numbers that follow from a seed and a counter by hashing.
pub mod random;
/// Writes `rig.toml` with the geometry that was simulated.
pub mod rig_file;
/// Scenario files: subject, motion, light, faults of the geometry.
pub mod scenario;
/// What stands in the light.
pub mod scene;
/// A whole scenario to a cache directory.
pub mod sequence;
/// The true geometry of a rig, which differs from the nominal one.
pub mod true_rig;
/// Files with the ground truth of each rendered frame.
pub mod truth;
pub mod wire;
