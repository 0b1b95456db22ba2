// SPDX-License-Identifier: MIT OR Apache-2.0
//! Absolute phase to points: the geometry of a camera and its projector, a table of rays, normals.

/// A camera, its projector and what lies between them.
pub mod camera_projector;
/// Normals from neighbouring points.
pub mod normals;
/// A phase map to a directional cloud.
pub mod points;
/// Points of a pixel as a polynomial of its phase.
pub mod ray_table;
/// The exact intersection, pixel by pixel.
pub mod triangulator;
