// SPDX-License-Identifier: MIT OR Apache-2.0
//! One frame to one point cloud: the phase pipeline (paper, section 4.1).
//!
//! Knows nothing of cameras, networks or tokio, and builds without Aravis. The folders follow the paper's Figure 5, from
//! the mask to the points; [`pipeline`] composes them for one frame, [`frame_set`] for those of a trigger. `docs/design/reconstruction.md` describes them.

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
/// What became of a frame.
pub mod outcome;
/// The paper's method, plain.
pub mod paper;
/// Fringe period Pm and wrapped phase Wm.
pub mod phase;
/// One frame to one directional cloud.
pub mod pipeline;
/// Absolute phase Fm, made better pixel by pixel.
pub mod refine;
/// Absolute phase to points and normals.
pub mod triangulate;
/// From a photograph and its mask to wrapped phases and the marker.
pub mod wrapped_phase;
