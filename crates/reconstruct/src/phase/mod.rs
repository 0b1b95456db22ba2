// SPDX-License-Identifier: MIT OR Apache-2.0
//! Wrapped phase Wm: the fringe period, the seven-point demodulation, and the correction for shading.

/// Seven samples at the local period to phase and modulation.
pub mod demodulate;
#[cfg(test)]
pub(crate) mod for_tests;
/// Fringe period Pm.
pub mod period;
/// Phase errors where the light changes along the fringes' normal.
pub mod shading;
/// How well the light of a window fits a fringe.
pub mod window_quality;
