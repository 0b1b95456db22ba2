// SPDX-License-Identifier: MIT OR Apache-2.0
//! Wrapped phase Wm: the fringe period, the seven-point demodulation, the fit of what is left beside
//! over-exposed pixels, and the correction for shading.

pub(crate) mod demodulate;
#[cfg(test)]
pub(crate) mod for_tests;
pub(crate) mod over_exposed;
pub(crate) mod period;
pub(crate) mod shading;
pub(crate) mod window_quality;
