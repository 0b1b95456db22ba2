// SPDX-License-Identifier: MIT OR Apache-2.0
//! Clouds, meshes, pictures and tables on their way out: files that other programs read.

/// The frames of a session as pictures.
pub mod frames;
/// Edges of the HSU's input lines.
pub mod inputs;
/// The fringe-free images of a reconstruction, as pictures and videos.
pub mod intensity;
/// Clouds to files of other formats, many at a time.
pub mod job;
/// Clouds as triangle meshes, open or closed.
pub mod mesh;
/// Triggers on the cameras' common clock.
pub mod ptp;
mod sequence;
/// The times of all frames of a session, as a table.
pub mod timing;
/// Clouds drawn as pictures, for people.
pub mod view;

pub use sequence::collect;
