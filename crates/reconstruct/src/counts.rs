// SPDX-License-Identifier: MIT OR Apache-2.0
//! Pixel counts that tell how a frame went.

use super::marker::epipolar_check::Dashes;

/// Pixel counts that tell how a frame went.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Counts {
    /// Pixels on the object mask.
    pub object: usize,
    /// Pixels with a wrapped phase.
    pub phase: usize,
    /// Pixels on marker cores.
    pub marker: usize,
    /// Whether the marker's dashes lie where the calibration has them.
    pub dashes: Dashes,
    /// Pixels left out because their fringe order is not certain.
    pub refused: usize,
    /// Pixels dropped near depth steps, faint or not like a fringe.
    pub dropped: usize,
}
