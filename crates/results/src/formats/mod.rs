// SPDX-License-Identifier: MIT OR Apache-2.0
//! File formats of clouds for other programs, a file each; [`Format`] lists those of single clouds.
//!
//! Nothing here knows where clouds come from: they come through [`CloudSource`].

mod cloud_source;
mod e57;
mod format;
mod glb;
mod pcd;
/// Sequences of clouds as MCAP.
pub mod sequence;
mod shape;
mod text;

pub use cloud_source::{CloudSource, Commented, PlyDirectory, merged_cloud, save_merged};
pub use format::Format;
pub use fourdbody_core::formats::{npz, phase_file, ply};
pub use shape::Shape;
