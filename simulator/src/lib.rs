//! Simulated light, cameras and HSU: real protocols, simulated photons.
//!
//! Knows the product's library (rig, geometry, pattern, calibration file); the product never knows it.

pub mod gige;
pub mod hsu;
pub mod images;
pub mod laboratory;
pub mod wire;
