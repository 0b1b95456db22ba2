// SPDX-License-Identifier: MIT OR Apache-2.0
//! The frames of all cameras of one trigger: each gets its phases alone, then their fringe orders are found together.

use super::fringe_order::unwrapped_frame::UnwrappedFrame;
use super::fringe_order::{self, MostDifference, View};
use super::marker::epipolar_check::Dashes;
use super::outcome::{Reconstruction, WHY_ELSEWHERE};
use super::pipeline::{self, Pipeline};
use crate::base::image::Mono8;
use rayon::prelude::*;

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

/// Reconstructs one instant: `photograph` gives the photograph of a camera, by its place in `cameras`, or `None` where there
/// is none; it is called once for each, on any thread. One result for each camera, in the same order; `most` as in
/// [`fringe_order::solve`].
pub fn reconstruct<'a>(
    cameras: &[Camera<'_>],
    photograph: impl Fn(usize) -> Option<Mono8<'a>> + Sync,
    most: MostDifference,
) -> Vec<Option<Reconstruction>> {
    let prepare = |(number, camera): (usize, &Camera<'_>)| match photograph(number) {
        Some(image) => Stage::from(camera.pipeline.prepare(image)),
        None => Stage::Missing("gap", String::new()),
    };
    let stages = cameras.par_iter().enumerate().with_max_len(1).map(prepare).collect();
    let finish = |(camera, stage): (&Camera<'_>, Stage)| match stage {
        Stage::Made(made) => Some(*made),
        Stage::Unwrapped(prepared) => Some(camera.pipeline.finish(*prepared)),
        Stage::Missing(..) => None,
    };
    let stages = settle(cameras, stages, fringe_order::MARGIN, most);
    cameras.par_iter().with_max_len(1).zip(stages).map(finish).collect()
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
        Ok(_) if most == MostDifference::ANY => stages,
        Ok(compared) => refuse_unconfirmed(cameras, stages, compared),
        Err(reason) => refuse_all(stages, &reason),
    }
}

/// Where the marker of one camera contradicts the calibration, another one is believed only as far as it was `compared`
/// with others: the same may have happened to it.
fn refuse_unconfirmed(cameras: &[Camera<'_>], stages: Vec<Stage>, compared: Vec<bool>) -> Vec<Stage> {
    let contradicts =
        |stage: &Stage| matches!(stage, Stage::Made(result) if result.counts.dashes.contradict());
    let Some(camera) = cameras.iter().zip(&stages).find(|x| contradicts(x.1)).map(|x| x.0) else {
        return stages;
    };
    let reason = format!(
        "the marker of {} does not lie where the calibration has it, and too few places show whether this camera \
         agrees with others; {WHY_ELSEWHERE}",
        camera.id
    );
    let mut compared = compared.into_iter();
    let check = |stage| match stage {
        Stage::Unwrapped(_) if compared.next() != Some(true) => refuse(stage, &reason),
        other => other,
    };
    stages.into_iter().map(check).collect()
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
    refuse_all(stages, &reason)
}

/// No clouds are made of any frame of a trigger, for this reason.
fn refuse_all(stages: Vec<Stage>, reason: &str) -> Vec<Stage> {
    stages.into_iter().map(|stage| refuse(stage, reason)).collect()
}

/// No cloud is made of a frame, for this reason.
fn refuse(stage: Stage, reason: &str) -> Stage {
    match stage {
        Stage::Unwrapped(prepared) => Stage::Made(pipeline::refuse(*prepared, reason.to_owned())),
        other => other,
    }
}
