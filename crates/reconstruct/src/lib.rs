// SPDX-License-Identifier: MIT OR Apache-2.0
//! Photographs of fringes to points: the phase pipeline (paper, section 4.1).
//!
//! [`Reconstructor`] is what most callers need: a calibration and the photographs of one instant in, points in metres
//! out, as `examples/points.rs` does it. The folders follow the paper's Figure 5, from the mask to the points;
//! [`pipeline`] composes them for one frame, [`frame_set`] for those of a trigger. Nothing here knows of recordings,
//! cameras, networks or tokio. `docs/design/reconstruction.md` describes the stages.

#[cfg(test)]
use fourdbody_core::config;
use fourdbody_core::{base, data, formats, geometry};

/// Pixel counts that tell how a frame went.
pub mod counts;
/// The frames of all cameras of one trigger.
pub mod frame_set;
/// Fringe orders of all views of one instant.
pub mod fringe_order;
/// What the stages are computed with.
pub mod kernels;
/// Marker map Mm.
pub mod marker;
/// Object mask Om.
pub mod mask;
/// Directional clouds to merged clouds.
pub mod merge;
/// What became of a frame.
pub mod outcome;
/// The paper's method, plain.
pub mod paper;
/// Fringe period Pm and wrapped phase Wm.
pub mod phase;
/// One frame to one directional cloud.
pub mod pipeline;
/// The photographs of one instant to points.
pub mod reconstructor;
/// Absolute phase Fm, made better pixel by pixel.
pub mod refine;
/// Absolute phase to points and normals.
pub mod triangulate;
/// From a photograph and its mask to wrapped phases and the marker.
pub mod wrapped_phase;

pub use reconstructor::Reconstructor;
