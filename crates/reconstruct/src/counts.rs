// SPDX-License-Identifier: MIT OR Apache-2.0
//! Pixel counts by which the reconstruction of a frame is judged.

use super::marker::epipolar_check::Dashes;

/// Pixel counts of one frame, stage by stage: what reports and summaries print of it.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Counts {
    /// Pixels on the object mask, without over-exposed ones.
    pub object: usize,
    /// Pixels that have a wrapped phase, and those added at the ends of runs.
    pub phase: usize,
    /// Pixels on the cores of marker pieces whose number is known.
    pub marker: usize,
    /// Whether the marker's dashes lie where the calibration has them.
    pub dashes: Dashes,
    /// Pixels with a phase that give no point because their fringe order is not certain.
    pub refused: usize,
    /// By how much the camera differs from the others in the mean, where they see one surface, rad; 0 where too few
    /// places tell.
    pub differs_rad: f32,
    /// Points of the directional cloud.
    pub points: usize,
    /// Pixels dropped near depth steps, faint or not like a fringe.
    pub dropped: usize,
}
