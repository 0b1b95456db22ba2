// SPDX-License-Identifier: MIT OR Apache-2.0
//! The result of a frame: a cloud, or the reason why there is none.

use super::counts::Counts;
use super::fringe_order::Regions;
use super::kernels::region_of_interest::Roi;
use crate::base::image::Plane;
use crate::data::{Cloud, PhaseMap};
use std::time::Duration;

/// Whether a frame gave a cloud.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Outcome {
    /// A cloud, which may leave parts unresolved.
    Cloud,
    /// No point can be trusted, for this reason.
    Refused(String),
}

/// The reason of a frame that is refused because its mask is empty.
pub const NO_OBJECT: &str = "there is no object in the frame";

/// Possible causes, for messages about markers that do not lie where the calibration has them.
pub const WHY_ELSEWHERE: &str =
    "is it the calibration of another camera, or another projector's light, or has a device moved?";

/// The outcome of a frame with this cloud.
pub(super) fn outcome_of(counts: &Counts) -> Outcome {
    if counts.points == 0 && counts.marker == 0 && counts.dashes.stretches > 0 {
        Outcome::Refused(format!(
            "what looks like the marker does not lie where the calibration has it, so that no fringe order is \
             known; {WHY_ELSEWHERE}"
        ))
    } else if counts.points == 0 && counts.marker == 0 {
        Outcome::Refused("no marker was found, so that no fringe order is known".to_owned())
    } else if counts.points == 0 {
        Outcome::Refused("no pixel has a fringe order that can be trusted".to_owned())
    } else {
        Outcome::Cloud
    }
}

/// Everything that one frame gives. [`crate::pipeline::Pipeline::finish`] makes it; the caller owns it.
#[derive(Debug)]
pub struct Reconstruction {
    /// The directional cloud: points and normals in the world frame, m. Empty where the frame is refused, and where
    /// points are only counted ([`crate::pipeline::Pipeline::counting`]).
    pub cloud: Cloud,
    /// Absolute phase and light of each known pixel in whole steps: the calibration turns it into the same cloud.
    pub phase: PhaseMap,
    /// Whether the frame gave a cloud.
    pub outcome: Outcome,
    /// Pixel counts of the stages.
    pub counts: Counts,
    /// Pieces of surface and how certain their fringe orders are; for each point see [`Regions::margin_at`].
    pub regions: Regions,
    /// Name and duration of each stage, in the order in which they ran.
    pub stages: Vec<(&'static str, Duration)>,
    /// The maps of the stages, where the pipeline keeps them (`reconstruct --dump-maps`).
    pub maps: Option<Maps>,
}

/// The maps of a frame, on its region of interest.
#[derive(Debug)]
pub struct Maps {
    /// The part of the frame that the maps cover.
    pub roi: Roi,
    /// Columns and rows of the whole frame, px.
    pub frame: (usize, usize),
    /// Named maps: Om, Pm, Am, Sm, Wm, Vm, Bm, Qm, Um, Mm, Fm as far as the method has them. NaN: undefined.
    pub planes: Vec<(&'static str, Plane<f32>)>,
}
