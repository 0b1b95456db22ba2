// SPDX-License-Identifier: MIT OR Apache-2.0
//! The frames of all cameras of one trigger: each gets its phases alone, then their fringe orders are found together.

use super::fringe_order::unwrapped_frame::UnwrappedFrame;
use super::fringe_order::{self, MostDifference, View};
use super::marker::epipolar_check::Dashes;
use super::outcome::{Reconstruction, WHY_ELSEWHERE};
use super::pipeline::{self, Pipeline};

/// A camera of a frame set, as [`settle`] needs it.
#[derive(Debug, Clone, Copy)]
pub struct Camera<'a> {
    /// The camera's name, for messages to the user.
    pub id: &'a str,
    /// Which head it belongs to: cameras of equal number see the same projector.
    pub head: usize,
    /// The pipeline that reconstructs this camera's frames.
    pub pipeline: &'a Pipeline,
}

/// How far the reconstruction of a frame has come.
#[derive(Debug)]
pub enum Stage {
    /// Its phases are known; its fringe orders are found together with those of the other cameras.
    Unwrapped(Box<UnwrappedFrame>),
    /// It is finished: refused, or made by a method that needs no other camera.
    Made(Box<Reconstruction>),
    /// There is no frame: the outcome, such as `gap`, and the reason.
    Missing(&'static str, String),
}

impl From<Result<UnwrappedFrame, Box<Reconstruction>>> for Stage {
    /// Wraps the result of [`Pipeline::prepare`].
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
