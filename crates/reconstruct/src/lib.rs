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

pub mod counts;
pub mod frame_set;
pub mod fringe_order;
pub(crate) mod kernels;
pub mod marker;
pub(crate) mod mask;
pub mod merge;
pub mod outcome;
pub mod paper;
pub(crate) mod phase;
pub mod pipeline;
pub mod reconstructor;
pub(crate) mod refine;
pub mod triangulate;
pub(crate) mod wrapped_phase;

pub use reconstructor::Reconstructor;
