// SPDX-License-Identifier: MIT OR Apache-2.0
//! The files that clouds, phase maps and arrays of this program are kept in.

/// NumPy's arrays in a zip file.
#[cfg(feature = "npz")]
pub mod npz;
/// Phase maps as files, written and read.
pub mod phase_file;
/// Clouds as binary PLY files, written and read.
pub mod ply;
