// SPDX-License-Identifier: MIT OR Apache-2.0
//! Clouds, meshes, pictures and tables on their way out: files that other programs read.

/// Frames to pictures.
pub mod frames;
/// Edges of the HSU's input lines.
pub mod inputs;
/// Clouds to files of other formats, many at a time.
pub mod job;
/// Triangle meshes.
pub mod mesh;
/// Triggers on the cameras' common clock.
pub mod ptp;
mod sequence;
/// When every frame was.
pub mod timing;
/// Pictures of clouds.
pub mod view;

pub use sequence::{Contents, collect};
