// SPDX-License-Identifier: MIT OR Apache-2.0
//! A frame whose phase is known except for its fringe orders.

use super::orders::{Orders, Regions};
use crate::base::image::Plane;
use crate::counts::Counts;
use crate::data::STEPS_PER_LEVEL;
use crate::kernels::pixel_runs::Runs;
use crate::kernels::region_of_interest::Roi;
use crate::kernels::stage_times::Clock;
use crate::phase::window_quality::Windows;
use crate::triangulate::ray_table::RayTable;
use crate::triangulate::triangulator::Triangulator;
use std::sync::Arc;
use std::time::Duration;

/// A frame whose phase is known except for its fringe orders.
///
/// `Pipeline::prepare` makes it, [`super::solve`] finds or refuses the orders of its patches, and `Pipeline::finish`
/// consumes it and makes the cloud. It owns planes of the pipeline's workspace, which `finish` gives back.
#[derive(Debug)]
pub struct UnwrappedFrame {
    /// Where the object is; all planes cover this part of the frame.
    pub roi: Roi,
    /// Phase, rad, absolute but for the orders of its patches; NaN where it is not known. Far beside the runs it is
    /// any number.
    pub absolute: Plane<f32>,
    /// Lines of sight of the camera.
    pub(crate) table: Arc<RayTable>,
    /// How certain the order of each patch is, after [`super::solve`].
    pub regions: Regions,
    /// Its patches and their orders.
    pub(crate) orders: Orders,
    /// The number of the marker that each pixel is on, from 1; 0 beside markers.
    pub marker: Plane<u8>,
    /// Pixel counts of the stages so far.
    pub counts: Counts,
    /// Runs of the object without what is over-exposed: nothing is known outside of them.
    pub(crate) runs: Runs,
    pub(crate) windows: Windows,
    /// The photograph's part in the region of interest.
    pub(crate) image: Plane<u8>,
    pub(crate) period: Plane<f32>,
    /// Around the marker: not 0.
    pub(crate) zone: Plane<u8>,
    pub(crate) planes: Vec<(&'static str, Plane<f32>)>,
    pub(crate) clock: Clock,
}

impl UnwrappedFrame {
    /// Fringe period Pm of each pixel, px; 0 where it is unknown.
    pub fn period(&self) -> &Plane<f32> {
        &self.period
    }

    /// Runs of the object without what is over-exposed.
    pub fn runs(&self) -> &Runs {
        &self.runs
    }

    /// Light over one period around a pixel that has a phase, by its place in the region of interest, row by row, DN.
    pub(crate) fn light_dn(&self, pixel: usize) -> f32 {
        let light = self.windows.light.at(pixel % self.roi.width, pixel / self.roi.width);
        f32::from(light) / STEPS_PER_LEVEL
    }

    /// Adds a frame's share of the time of work that was done for several frames.
    pub fn add_time(&mut self, stage: &'static str, time: Duration) {
        self.clock.0.push((stage, time));
    }
}

/// One camera's frame and its geometry: what [`super::solve`] takes of each camera.
#[derive(Debug)]
pub struct View<'a> {
    /// The camera's name, for messages to the user.
    pub id: &'a str,
    /// The geometry of the camera and its projector.
    pub triangulator: &'a Triangulator,
    /// Which head it belongs to: cameras of equal number see the same projector.
    pub head: usize,
    /// Its frame, whose orders are found or refused.
    pub prepared: &'a mut UnwrappedFrame,
}
