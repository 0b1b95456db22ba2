// SPDX-License-Identifier: MIT OR Apache-2.0
//! File formats of clouds and phase maps, a file each; [`Format`] lists those of single clouds.
//!
//! Nothing here knows where clouds come from: they come through [`CloudSource`].

mod cloud_source;
pub(crate) mod e57;
mod format;
pub(crate) mod glb;
/// NumPy's arrays in a zip file.
pub mod npz;
pub(crate) mod pcd;
/// Phase maps as files.
pub mod phase_file;
/// Binary PLY files.
pub mod ply;
/// Sequences of clouds as MCAP.
pub mod sequence;
mod shape;
pub(crate) mod text;

pub use cloud_source::{CloudSource, Commented, PlyDirectory};
pub use format::Format;
pub use shape::Shape;
