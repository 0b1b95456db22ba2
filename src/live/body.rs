// SPDX-License-Identifier: MIT OR Apache-2.0
//! From every fourth row of a trigger's frames to points on the body: the pipeline of `fourdbody reconstruct`, with the
//! fringe orders of all cameras found together.

use super::rows::Rows;
use crate::acquire::preview::{ROW_STEP, Sample};
use crate::base::ids::CameraId;
use crate::base::image::Mono8;
use crate::data::{Calibration, Cloud};
use crate::preview::quick_look;
use crate::reconstruct::frame_set::{self, Stage};
use crate::reconstruct::fringe_order::{self, MostDifference};
use crate::reconstruct::outcome::Outcome;
use crate::reconstruct::pipeline::{Method, Pipeline, Workspace};
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

impl Reconstructor {
    /// For the cameras of a calibration. Takes longer than many frames: each has its tables.
    pub fn new(calibration: Calibration) -> Result<Self, String> {
        // Fringes run along the rows of the scene, across the columns of the image, so that few of them are lost.
        let calibration = calibration.with_every_nth_row(ROW_STEP);
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
        let prepare = |camera: &Camera| match rows.get(&camera.id).and_then(image) {
            Some(image) => Stage::from(camera.pipeline.prepare(image)),
            None => Stage::Missing("gap", String::new()),
        };
        let stages: Vec<Stage> = self.cameras.par_iter().map(prepare).collect();
        let seen: Vec<_> = self
            .cameras
            .iter()
            .map(|camera| frame_set::Camera {
                id: camera.id.as_str(),
                head: camera.head,
                pipeline: &camera.pipeline,
            })
            .collect();
        let most = MostDifference::of_rows(ROW_STEP);
        let stages = frame_set::settle(&seen, stages, fringe_order::MARGIN, most);
        let finish = |(camera, stage): (&Camera, Stage)| {
            let made = match stage {
                Stage::Made(made) => *made,
                Stage::Unwrapped(prepared) => camera.pipeline.finish(*prepared),
                Stage::Missing(..) => return None,
            };
            let refused = match made.outcome {
                Outcome::Refused(reason) => Some(reason),
                Outcome::Cloud => None,
            };
            let (lit, points) = (made.counts.object, made.cloud.len());
            Some((CameraShare { camera: camera.id.clone(), lit, points, refused }, made.cloud))
        };
        let made: Vec<(CameraShare, Cloud)> =
            self.cameras.par_iter().zip(stages).filter_map(finish).collect();
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
