// SPDX-License-Identifier: MIT OR Apache-2.0
//! From every fourth row of a trigger's frames to points on the body: the pipeline of `fourdbody reconstruct`, with the
//! fringe orders of all cameras found together.

use super::rows::Rows;
use crate::acquire::preview::{ROW_STEP, Sample};
use crate::base::ids::CameraId;
use crate::base::image::Mono8;
use crate::data::{Calibration, Cloud};
use crate::preview::quick_look;
use crate::reconstruct::fringe_order::unwrapped_frame::UnwrappedFrame;
use crate::reconstruct::fringe_order::{self, View};
use crate::reconstruct::outcome::{Outcome, Reconstruction};
use crate::reconstruct::pipeline::{self, Method, Pipeline, Workspace};
use crate::reconstruct::triangulate::camera_projector::CameraProjector;
use crate::reconstruct::triangulate::triangulator::Triangulator;
use rayon::prelude::*;
use serde::Serialize;
use std::sync::Arc;

/// Points of all cameras that a browser gets at most.
pub const POINTS_MAX: usize = 48_000;

/// How a camera sees the body.
#[derive(Debug, Clone, PartialEq, Serialize, utoipa::ToSchema)]
pub struct CameraShare {
    /// The camera.
    #[schema(value_type = String)]
    pub camera: CameraId,
    /// Pixels that show the object, of the rows that were looked at.
    pub lit: usize,
    /// Those that became points.
    pub points: usize,
    /// Why no point can be trusted.
    pub refused: Option<String>,
}

/// One frame set as points.
#[derive(Debug, Clone, Default)]
pub struct Body {
    /// As [`quick_look::encode`] has them.
    pub points: Vec<u8>,
    /// One entry for each camera that had a frame.
    pub cameras: Vec<CameraShare>,
}

/// Reconstructs frame sets of which every fourth row is there.
pub struct Reconstructor {
    cameras: Vec<Camera>,
}

struct Camera {
    id: CameraId,
    head: usize,
    pipeline: Pipeline,
}

enum Stage {
    Unwrapped(Box<UnwrappedFrame>),
    Made(Box<Reconstruction>),
}

impl Reconstructor {
    /// For the cameras of a calibration. Takes longer than many frames: each has its tables.
    pub fn new(calibration: Calibration) -> Result<Self, String> {
        let calibration = of_every_fourth_row(calibration);
        let workspace = Arc::new(Workspace::default());
        let mut heads: Vec<&str> = Vec::new();
        let mut cameras = Vec::new();
        for (head, camera) in calibration.cameras() {
            if heads.last() != Some(&head.id.as_str()) {
                heads.push(head.id.as_str());
            }
            let pair = CameraProjector::new(head, camera, &calibration)?;
            let pipeline = Pipeline::new(Triangulator::new(pair), Method::Joint, false);
            let pipeline = pipeline.with_workspace(Arc::clone(&workspace));
            cameras.push(Camera { id: camera.id.clone(), head: heads.len() - 1, pipeline });
        }
        Ok(Self { cameras })
    }

    /// The body of one trigger, on the current rayon pool.
    pub fn body(&self, rows: &Rows) -> Body {
        let seen: Vec<(&Camera, Mono8<'_>)> =
            self.cameras.iter().filter_map(|camera| Some((camera, image(rows.get(&camera.id)?)?))).collect();
        let prepare = |(camera, image): &(&Camera, Mono8<'_>)| match camera.pipeline.prepare(*image) {
            Ok(prepared) => Stage::Unwrapped(Box::new(prepared)),
            Err(made) => Stage::Made(made),
        };
        let mut stages: Vec<Stage> = seen.par_iter().map(prepare).collect();
        let views = seen.iter().zip(&mut stages).filter_map(|((camera, _), stage)| match stage {
            Stage::Unwrapped(prepared) => Some(View {
                id: camera.id.as_str(),
                triangulator: camera.pipeline.triangulator(),
                head: camera.head,
                prepared,
            }),
            Stage::Made(_) => None,
        });
        let mut views: Vec<View<'_>> = views.collect();
        let solved = match views.is_empty() {
            true => Ok(()),
            // A patch is so many rows of the frame higher, and what differs from its plane grows with it.
            false => {
                let most_rad = fringe_order::MOST_RAD * ROW_STEP as f32;
                fringe_order::solve(&mut views, fringe_order::MARGIN, most_rad)
            }
        };
        drop(views);
        let made: Vec<(CameraShare, Cloud)> = seen
            .par_iter()
            .zip(stages)
            .map(|((camera, _), stage)| {
                let made = match (stage, &solved) {
                    (Stage::Made(made), _) => *made,
                    (Stage::Unwrapped(prepared), Ok(())) => camera.pipeline.finish(*prepared),
                    (Stage::Unwrapped(prepared), Err(reason)) => *pipeline::refuse(*prepared, reason.clone()),
                };
                let refused = match made.outcome {
                    Outcome::Refused(reason) => Some(reason),
                    Outcome::Cloud => None,
                };
                let (lit, points) = (made.counts.object, made.cloud.len());
                (CameraShare { camera: camera.id.clone(), lit, points, refused }, made.cloud)
            })
            .collect();
        let most = POINTS_MAX / made.len().max(1);
        let mut body = Body::default();
        for (share, cloud) in made {
            body.points.extend(quick_look::encode(&cloud, most));
            body.cameras.push(share);
        }
        body
    }
}

fn image(sample: &Sample) -> Option<Mono8<'_>> {
    Mono8::new(sample.width, sample.pixels.len() / sample.width.max(1), &sample.pixels)
}

/// The calibration of frames of which rows 0, 4, 8, ... are there: fringes run along the rows of the scene, across the
/// columns of the image, so that few of them are lost.
fn of_every_fourth_row(mut calibration: Calibration) -> Calibration {
    let n = ROW_STEP as f64;
    for camera in calibration.heads.iter_mut().flat_map(|head| &mut head.cameras) {
        let device = &mut camera.device;
        device.height = device.height.div_ceil(ROW_STEP);
        device.lens.fy /= n;
        device.lens.cy /= n;
    }
    calibration
}
