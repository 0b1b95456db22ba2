// SPDX-License-Identifier: MIT OR Apache-2.0
//! File formats of clouds for other programs, a file each; [`Format`] lists those of single clouds.
//!
//! Nothing here knows where clouds come from: they come through [`CloudSource`].

mod cloud_source;
#[cfg(feature = "e57")]
mod e57;
mod format;
mod glb;
mod pcd;
/// Sequences of clouds as MCAP.
pub mod sequence;
mod shape;
mod text;

pub(crate) use cloud_source::named;
pub use cloud_source::{CloudSource, Commented, PlyDirectory, merged_cloud, save_merged};
pub use format::Format;
#[cfg(feature = "npz")]
pub use fourdbody_core::formats::npz;
pub use fourdbody_core::formats::{phase_file, ply};
pub use shape::Shape;
