// SPDX-License-Identifier: MIT OR Apache-2.0
//! Photographs of one instant reconstructed together, as `reconstruct` does it, but in memory.

use fourdbody::base::image::{Mono8, Plane};
use fourdbody::reconstruct::fringe_order::unwrapped_frame::UnwrappedFrame;
use fourdbody::reconstruct::fringe_order::{self, View};
use fourdbody::reconstruct::outcome::Reconstruction;
use fourdbody::reconstruct::pipeline::{self, Method, Pipeline};
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
    let mut prepared: Vec<Result<UnwrappedFrame, _>> =
        all.map(|(pipeline, x)| pipeline.prepare(Mono8::from(&x.image))).collect();
    let views =
        pipelines.iter().zip(photographs).zip(&mut prepared).filter_map(|((pipeline, x), prepared)| {
            let prepared = prepared.as_mut().ok()?;
            Some(View { id: "", triangulator: pipeline.triangulator(), head: x.head, prepared })
        });
    let said = fringe_order::solve(
        &mut views.collect::<Vec<_>>(),
        fringe_order::MARGIN,
        fringe_order::MostDifference::of_rows(1),
    );
    let finished = pipelines.iter().zip(prepared).map(|(pipeline, prepared)| match prepared {
        Ok(prepared) => match &said {
            Ok(()) => pipeline.finish(prepared),
            Err(reason) => *pipeline::refuse(prepared, reason.clone()),
        },
        Err(refused) => *refused,
    });
    finished.collect()
}
