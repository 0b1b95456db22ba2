// SPDX-License-Identifier: MIT OR Apache-2.0
//! Simulated light, cameras and HSU: real protocols, simulated photons.
//!
//! Knows the product's library (rig, geometry, pattern, calibration file); the product never knows it.

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
/// Seeded randomness by hashing.
pub mod random;
/// Writing `rig.toml`.
pub mod rig_file;
/// Scenario files.
pub mod scenario;
/// What stands in the light.
pub mod scene;
/// A whole scenario to a cache directory.
pub mod sequence;
/// The rig's true geometry.
pub mod true_rig;
/// Ground truth files.
pub mod truth;
pub mod wire;
