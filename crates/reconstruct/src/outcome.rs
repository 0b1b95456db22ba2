// SPDX-License-Identifier: MIT OR Apache-2.0
//! What became of a frame: a cloud or a reason why there is none, and all that the frame gives.

use super::counts::Counts;
use super::fringe_order::Regions;
use super::kernels::region_of_interest::Roi;
use crate::base::image::Plane;
use crate::data::{Cloud, PhaseMap};
use std::time::Duration;

/// What became of a frame.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Outcome {
    /// A cloud, which may leave parts unresolved.
    Cloud,
    /// No point can be trusted, for this reason.
    Refused(String),
}

/// Why a frame without light is refused.
pub const NO_OBJECT: &str = "there is no object in the frame";

/// What to ask when dashes lie elsewhere.
pub const WHY_ELSEWHERE: &str =
    "is it the calibration of another camera, or another projector's light, or has a device moved?";

/// What a frame with this cloud has come to.
pub(super) fn outcome_of(cloud: &Cloud, counts: &Counts) -> Outcome {
    if cloud.is_empty() && counts.marker == 0 && counts.dashes.stretches > 0 {
        let reason = "what looks like the marker does not lie where the calibration has it, so that no fringe order is known";
        Outcome::Refused(format!("{reason}; {WHY_ELSEWHERE}"))
    } else if cloud.is_empty() && counts.marker == 0 {
        Outcome::Refused("no marker was found, so that no fringe order is known".to_owned())
    } else if cloud.is_empty() {
        Outcome::Refused("no pixel has a fringe order that can be trusted".to_owned())
    } else {
        Outcome::Cloud
    }
}

/// Everything that one frame gives.
#[derive(Debug)]
pub struct Reconstruction {
    /// The directional cloud, in the world frame.
    pub cloud: Cloud,
    /// What the cloud follows from, given the calibration.
    pub phase: PhaseMap,
    /// Whether there is one.
    pub outcome: Outcome,
    /// How it went.
    pub counts: Counts,
    /// Pieces of surface and how certain their fringe orders are; for each point see [`Regions::margin_at`].
    pub regions: Regions,
    /// Time of each stage, in order.
    pub stages: Vec<(&'static str, Duration)>,
    /// The maps, where they were asked for.
    pub maps: Option<Maps>,
}

/// The maps of a frame, on its region of interest.
#[derive(Debug)]
pub struct Maps {
    /// Where they lie in the frame.
    pub roi: Roi,
    /// Columns and rows of the whole frame.
    pub frame: (usize, usize),
    /// Named maps: Om, Pm, Am, Sm, Wm, Vm, Bm, Qm, Um, Mm, Fm as far as the method has them. NaN: undefined.
    pub planes: Vec<(&'static str, Plane<f32>)>,
}
