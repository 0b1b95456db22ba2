// SPDX-License-Identifier: MIT OR Apache-2.0
//! Absolute phase Fm, made better pixel by pixel: what is kept, and corrections for curvature and edges of colour.

pub(crate) mod albedo_edges;
pub(crate) mod curvature;
pub(crate) mod extend_runs;
pub(crate) mod select;
pub(crate) mod uncertainty;

use super::kernels::pixel_runs::Runs;
use super::phase::window_quality::Windows;
use crate::base::image::Plane;

/// The maps of a frame beside its absolute phase, all on its region of interest.
#[derive(Debug, Clone, Copy)]
pub struct FrameMaps<'a> {
    /// Where a phase may be known.
    pub runs: &'a Runs,
    /// Strength, light and misfit of the fringe in each pixel's window.
    pub windows: &'a Windows,
    /// Fringe period Pm of each pixel, px.
    pub period: &'a Plane<f32>,
    /// Not 0 around the marker, where phases are means of more rows.
    pub zone: &'a Plane<u8>,
    /// Sign of the phase along the columns.
    pub sign: f32,
}
