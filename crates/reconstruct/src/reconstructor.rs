// SPDX-License-Identifier: MIT OR Apache-2.0
//! The photographs of one instant to points: the entry of this crate.

use crate::base::ids::CameraId;
use crate::base::image::Mono8;
use crate::data::{Calibration, Cloud};
use crate::frame_set;
use crate::fringe_order::MostDifference;
use crate::merge::{Rule, View, Viewpoint, left_out, merged};
use crate::outcome::Reconstruction;
use crate::pipeline::{Method, Pipeline, Workspace};
use crate::triangulate::camera_projector::CameraProjector;
use crate::triangulate::triangulator::Triangulator;
use std::sync::Arc;

/// Reconstructs the photographs that the cameras of one calibration take at one instant.
///
/// Whoever has a calibration makes one, keeps it, and calls [`reconstruct`](Self::reconstruct) for each instant: the
/// tables of a camera take longer to make than a frame to reconstruct. It holds a copy of what it needs of the
/// calibration and buffers that are used again; nothing of one instant has a part in the next. It can be shared by
/// threads, and is dropped when another calibration is in force.
///
/// It promises that equal photographs give equal bytes, whatever the number of threads, and that a point whose fringe
/// order is not certain is left out. Work runs on the current rayon pool.
#[derive(Debug)]
pub struct Reconstructor {
    cameras: Vec<Camera>,
    most: MostDifference,
}

#[derive(Debug)]
struct Camera {
    id: CameraId,
    /// The number of its head: cameras of one head see the same projector.
    head: usize,
    viewpoint: Viewpoint,
    pipeline: Pipeline,
}

impl Reconstructor {
    /// Prepares all cameras of a calibration, which takes about a second.
    ///
    /// # Errors
    ///
    /// A camera cannot be used: it does not see the pattern, or the fringes run along its columns. The text names the
    /// camera and the cause.
    pub fn new(calibration: &Calibration) -> Result<Self, String> {
        Self::of_every_nth_row(calibration.clone(), 1)
    }

    /// The same for photographs of which only every `step`-th row is given, beginning with the first: faster, and
    /// coarser. The calibration is that of the whole photographs.
    ///
    /// # Errors
    ///
    /// As those of [`Self::new`].
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

    /// The names of the cameras, in the order of the calibration: that of all results.
    pub fn cameras(&self) -> impl Iterator<Item = &CameraId> {
        self.cameras.iter().map(|camera| &camera.id)
    }

    /// Reconstructs one instant: `photograph` gives the photograph of each camera, or `None` where there is none. It
    /// is called once for each camera, on any thread.
    ///
    /// There is one result for each of [`Self::cameras`], in this order; `None` where there was no photograph. A
    /// result holds the points of one camera, in metres and in the world of the calibration, or the reason why there
    /// are none ([`Reconstruction::outcome`]): for example that the photograph has another size than the calibration
    /// states, that it shows no object, or that the cameras contradict each other.
    ///
    /// The photographs must show the same instant, because each camera's fringe orders are confirmed by the others.
    /// One camera alone works, too: then its own marker decides, and less of the surface is certain.
    pub fn reconstruct<'a>(
        &self,
        photograph: impl Fn(&CameraId) -> Option<Mono8<'a>> + Sync,
    ) -> Vec<Option<Reconstruction>> {
        let seen = |camera| {
            let Camera { id, head, pipeline, .. }: &Camera = camera;
            frame_set::Camera { id: id.as_str(), head: *head, pipeline }
        };
        let seen: Vec<_> = self.cameras.iter().map(seen).collect();
        frame_set::reconstruct(&seen, |number| photograph(&self.cameras[number].id), self.most)
    }

    /// One cloud of all cameras, from the results of [`Self::reconstruct`]. Each point states its camera by its place
    /// in [`Self::cameras`]. Points at grazing incidence are left out where another head sees the same place well
    /// ([`crate::merge`]); no point is moved.
    pub fn merge(&self, made: &[Option<Reconstruction>]) -> Cloud {
        let views = self.cameras.iter().zip(0..).zip(made).filter_map(|((camera, number), made)| {
            Some(View { camera: number, cloud: &made.as_ref()?.cloud, from: Some(&camera.viewpoint) })
        });
        let views: Vec<View<'_>> = views.collect();
        merged(&views, &left_out(&views, Rule::default()))
    }
}
