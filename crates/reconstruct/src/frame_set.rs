// SPDX-License-Identifier: MIT OR Apache-2.0
//! The frames of all cameras of one trigger on their way: each gets its phases alone, then all give each other their fringe
//! orders.

use super::fringe_order::unwrapped_frame::UnwrappedFrame;
use super::fringe_order::{self, MostDifference, View};
use super::marker::epipolar_check::Dashes;
use super::outcome::{Reconstruction, WHY_ELSEWHERE};
use super::pipeline::{self, Pipeline};

/// A camera of a frame set.
#[derive(Debug, Clone, Copy)]
pub struct Camera<'a> {
    /// Its name, for messages.
    pub id: &'a str,
    /// Which head it belongs to: cameras of equal number see the same projector.
    pub head: usize,
    /// What reconstructs its frames.
    pub pipeline: &'a Pipeline,
}

/// A frame on its way.
#[derive(Debug)]
pub enum Stage {
    /// The other cameras have a part in its fringe orders.
    Unwrapped(Box<UnwrappedFrame>),
    /// They have none: it is refused, or what has become of it is known already.
    Made(Box<Reconstruction>),
    /// No frame: outcome and reason.
    Missing(&'static str, String),
}

impl From<Result<UnwrappedFrame, Box<Reconstruction>>> for Stage {
    /// What [`Pipeline::prepare`] gives.
    fn from(prepared: Result<UnwrappedFrame, Box<Reconstruction>>) -> Self {
        match prepared {
            Ok(prepared) => Self::Unwrapped(Box::new(prepared)),
            Err(made) => Self::Made(made),
        }
    }
}

/// Finds the fringe orders of all frames together, or refuses the frames. `cameras` and `stages` are in the same order;
/// `margin` and `most` as in [`fringe_order::solve`].
pub fn settle(cameras: &[Camera<'_>], stages: Vec<Stage>, margin: f32, most: MostDifference) -> Vec<Stage> {
    let mut stages = refuse_displaced_markers(stages);
    let views = cameras.iter().zip(&mut stages).filter_map(|(camera, stage)| match stage {
        Stage::Unwrapped(prepared) => Some(View {
            id: camera.id,
            triangulator: camera.pipeline.triangulator(),
            head: camera.head,
            prepared,
        }),
        Stage::Made(_) | Stage::Missing(..) => None,
    });
    match fringe_order::solve(&mut views.collect::<Vec<_>>(), margin, most) {
        Ok(()) => stages,
        Err(reason) => refuse(stages, &reason),
    }
}

/// Where the markers of most cameras contradict the calibration, those of the others agree by chance.
fn refuse_displaced_markers(stages: Vec<Stage>) -> Vec<Stage> {
    let dashes = stages.iter().filter_map(|stage| match stage {
        Stage::Unwrapped(prepared) => Some(&prepared.counts.dashes),
        Stage::Made(result) => Some(&result.counts.dashes),
        Stage::Missing(..) => None,
    });
    if !Dashes::most_contradict(dashes) {
        return stages;
    }
    let reason = format!(
        "the markers of most other cameras do not lie where the calibration has them; {WHY_ELSEWHERE}"
    );
    refuse(stages, &reason)
}

/// No clouds are made of any frame of a trigger, for this reason.
fn refuse(stages: Vec<Stage>, reason: &str) -> Vec<Stage> {
    let refuse = |stage| match stage {
        Stage::Unwrapped(prepared) => Stage::Made(pipeline::refuse(*prepared, reason.to_owned())),
        other => other,
    };
    stages.into_iter().map(refuse).collect()
}
