// SPDX-License-Identifier: MIT OR Apache-2.0
//! Photographs of one instant reconstructed together, as `reconstruct` does it, but in memory.

use fourdbody::base::image::{Mono8, Plane};
use fourdbody::reconstruct::frame_set::{Camera, reconstruct};
use fourdbody::reconstruct::fringe_order::MostDifference;
use fourdbody::reconstruct::outcome::Reconstruction;
use fourdbody::reconstruct::pipeline::{Method, Pipeline};
use fourdbody::reconstruct::triangulate::camera_projector::CameraProjector;
use fourdbody::reconstruct::triangulate::triangulator::Triangulator;

/// A camera's photograph, and its geometry.
#[derive(Clone)]
pub struct Photograph {
    /// Cameras of equal number see the same projector.
    pub head: usize,
    pub pair: CameraProjector,
    pub image: Plane<u8>,
}

impl Photograph {
    fn pipeline(&self) -> Pipeline {
        Pipeline::new(Triangulator::new(self.pair.clone()), Method::Joint, false)
    }

    /// The cloud of this camera by itself.
    pub fn cloud(&self) -> Reconstruction {
        self.pipeline().run(Mono8::from(&self.image))
    }
}

/// The clouds of photographs of one instant, whose cameras confirm each other's fringe orders; one for each.
pub fn clouds(photographs: &[Photograph]) -> Vec<Reconstruction> {
    let pipelines: Vec<Pipeline> = photographs.iter().map(Photograph::pipeline).collect();
    let all = pipelines.iter().zip(photographs);
    let cameras = all.map(|(pipeline, x)| Camera { id: "a camera", head: x.head, pipeline });
    let photograph = |camera: usize| Some(Mono8::from(&photographs[camera].image));
    reconstruct(&cameras.collect::<Vec<_>>(), photograph, MostDifference::of_rows(1))
        .into_iter()
        .flatten()
        .collect()
}
