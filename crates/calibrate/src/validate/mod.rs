// SPDX-License-Identifier: MIT OR Apache-2.0
//! Figures of merit of clouds (paper, section 5).

/// Signed deviations as figures: mean, RMS, quantiles.
pub mod deviations;
/// Distances between the outermost circles on the board's diagonals.
pub mod distance;
/// The edges of one circle, in a cloud's intensities or in the photograph.
mod edge;
/// Girths of a merged cloud at a height.
pub mod girth;
/// Points by cell: neighbours within a short reach.
/// Which pixels of a photograph carry usable fringes.
pub mod light;
/// Plane fits of the board.
pub mod plane;
/// The circles of the board in a directional cloud.
pub mod ring;
/// Clouds against a sphere or a mesh.
pub mod solid;
/// Distances between the points of a cloud.
pub mod spacing;
/// Clouds against rendered ground truth.
pub mod truth;
/// Predicted uncertainty against actual error.
pub mod uncertainty;
