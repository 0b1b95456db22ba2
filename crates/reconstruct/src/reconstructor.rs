// SPDX-License-Identifier: MIT OR Apache-2.0
//! The photographs of one instant to points: all that most callers of this crate need.

use crate::base::ids::CameraId;
use crate::base::image::Mono8;
use crate::data::{Calibration, Cloud};
use crate::frame_set::{self, Stage};
use crate::fringe_order::{self, MostDifference};
use crate::merge::{Rule, View, Viewpoint, left_out, merged};
use crate::outcome::Reconstruction;
use crate::pipeline::{Method, Pipeline, Workspace};
use crate::triangulate::camera_projector::CameraProjector;
use crate::triangulate::triangulator::Triangulator;
use rayon::prelude::*;
use std::sync::Arc;

/// Reconstructs the photographs of the cameras of one calibration.
///
/// It is made once and serves any number of instants, on the current rayon pool: a camera's tables take longer to make
/// than a frame to reconstruct. Nothing is kept from one instant to the next but buffers.
#[derive(Debug)]
pub struct Reconstructor {
    cameras: Vec<Camera>,
    most: MostDifference,
}

#[derive(Debug)]
struct Camera {
    id: CameraId,
    /// Its head's number: cameras of one head see the same projector.
    head: usize,
    viewpoint: Viewpoint,
    pipeline: Pipeline,
}

impl Reconstructor {
    /// For all cameras of a calibration. The error says which camera cannot be used, and why.
    pub fn new(calibration: &Calibration) -> Result<Self, String> {
        Self::of_every_nth_row(calibration.clone(), 1)
    }

    /// For photographs of which every `step`-th row is there: faster, and coarser.
    pub fn of_every_nth_row(calibration: Calibration, step: usize) -> Result<Self, String> {
        let calibration = if step > 1 { calibration.with_every_nth_row(step) } else { calibration };
        let workspace = Arc::new(Workspace::default());
        let (mut heads, mut cameras) = (Vec::new(), Vec::new());
        for (head, camera) in calibration.cameras() {
            if heads.last() != Some(&head.id.as_str()) {
                heads.push(head.id.as_str());
            }
            let pair = CameraProjector::new(head, camera, &calibration)?;
            let pipeline = Pipeline::new(Triangulator::new(pair), Method::Joint, false);
            cameras.push(Camera {
                id: camera.id.clone(),
                head: heads.len() - 1,
                viewpoint: Viewpoint::new(head.id.as_str(), &camera.device, &head.projector),
                pipeline: pipeline.with_workspace(Arc::clone(&workspace)),
            });
        }
        Ok(Self { cameras, most: MostDifference::of_rows(step) })
    }

    /// The cameras, in the order of the calibration.
    pub fn cameras(&self) -> impl Iterator<Item = &CameraId> {
        self.cameras.iter().map(|camera| &camera.id)
    }

    /// One result for each camera, in their order: points in metres, in the calibration's world, or why there are none.
    /// `None` where `photograph` has none of that camera.
    pub fn reconstruct<'a>(
        &self,
        photograph: impl Fn(&CameraId) -> Option<Mono8<'a>> + Sync,
    ) -> Vec<Option<Reconstruction>> {
        let prepare = |camera: &Camera| match photograph(&camera.id) {
            Some(image) => Stage::from(camera.pipeline.prepare(image)),
            None => Stage::Missing("gap", String::new()),
        };
        let stages: Vec<Stage> = self.cameras.par_iter().with_max_len(1).map(prepare).collect();
        let seen = |camera| {
            let Camera { id, head, pipeline, .. }: &Camera = camera;
            frame_set::Camera { id: id.as_str(), head: *head, pipeline }
        };
        let seen: Vec<_> = self.cameras.iter().map(seen).collect();
        let stages = frame_set::settle(&seen, stages, fringe_order::MARGIN, self.most);
        let finish = |(camera, stage): (&Camera, Stage)| match stage {
            Stage::Made(made) => Some(*made),
            Stage::Unwrapped(prepared) => Some(camera.pipeline.finish(*prepared)),
            Stage::Missing(..) => None,
        };
        self.cameras.par_iter().with_max_len(1).zip(stages).map(finish).collect()
    }

    /// One cloud of all cameras, without what another head sees better. `made` is what [`Self::reconstruct`] gave.
    pub fn merge(&self, made: &[Option<Reconstruction>]) -> Cloud {
        let views = self.cameras.iter().zip(0..).zip(made).filter_map(|((camera, number), made)| {
            Some(View { camera: number, cloud: &made.as_ref()?.cloud, from: Some(&camera.viewpoint) })
        });
        let views: Vec<View<'_>> = views.collect();
        merged(&views, &left_out(&views, Rule::default()))
    }
}
