//! Photographs of one instant reconstructed together, as `reconstruct` does it, but in memory.

use fourdbody::image::{Mono8, Plane};
use fourdbody::reconstruct::order::{self, View};
use fourdbody::reconstruct::pair::Pair;
use fourdbody::reconstruct::pipeline::{Method, Pipeline, Prepared, Reconstruction};
use fourdbody::reconstruct::triangulate::Triangulator;

/// A camera's photograph, and its geometry.
#[derive(Clone)]
pub struct Photograph {
    /// Cameras of equal number see the same projector.
    pub head: usize,
    pub pair: Pair,
    pub image: Plane<u8>,
}

impl Photograph {
    fn pipeline(&self, method: Method) -> Pipeline {
        Pipeline::new(Triangulator::new(self.pair.clone()), method, false)
    }

    /// Its cloud by itself.
    pub fn cloud(&self) -> Reconstruction {
        self.pipeline(Method::Anchored).run(Mono8::from(&self.image))
    }
}

/// The clouds of photographs of one instant, whose cameras confirm each other's fringe orders; one for each.
pub fn clouds(photographs: &[Photograph]) -> Vec<Reconstruction> {
    clouds_by(Method::Anchored, photographs)
}

/// The same by another method.
pub fn clouds_by(method: Method, photographs: &[Photograph]) -> Vec<Reconstruction> {
    let pipelines: Vec<Pipeline> = photographs.iter().map(|x| x.pipeline(method)).collect();
    let all = pipelines.iter().zip(photographs);
    let mut prepared: Vec<Result<Prepared, _>> =
        all.map(|(pipeline, x)| pipeline.prepare(Mono8::from(&x.image))).collect();
    let views =
        pipelines.iter().zip(photographs).zip(&mut prepared).filter_map(|((pipeline, x), prepared)| {
            let prepared = prepared.as_mut().ok()?;
            Some(View { triangulator: pipeline.triangulator(), head: x.head, prepared })
        });
    order::settle(&mut views.collect::<Vec<_>>());
    let finished = pipelines.iter().zip(prepared).map(|(pipeline, prepared)| match prepared {
        Ok(prepared) => pipeline.finish(prepared),
        Err(refused) => *refused,
    });
    finished.collect()
}
