// SPDX-License-Identifier: MIT OR Apache-2.0
//! Simulated light, cameras and HSU: real protocols, simulated photons.
//!
//! Knows the product's library (rig, geometry, pattern, calibration file); the product never knows it.

#![allow(missing_docs, reason = "fields and variants whose names say it carry no comment")]

/// Rendered sequences on disk, and their replay.
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
/// Seeded random numbers, each a hash of where it is used.
pub mod random;
/// Writes a rig as the text of `rig.toml`.
pub mod rig_file;
/// Scenario files: subject, motion, light and optics of a rendered sequence.
pub mod scenario;
/// What stands in the light.
pub mod scene;
/// A whole scenario to a cache directory.
pub mod sequence;
/// The true geometry of a rig's cameras and projectors.
pub mod true_rig;
/// Ground truth files: what each pixel really sees.
pub mod truth;
pub mod wire;
