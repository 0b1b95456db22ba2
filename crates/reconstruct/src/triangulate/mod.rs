// SPDX-License-Identifier: MIT OR Apache-2.0
//! Absolute phase to points: the geometry of a camera and its projector, a table of rays, normals.

pub mod camera_projector;
pub(crate) mod normals;
pub mod points;
pub mod ray_table;
pub mod triangulator;
