// SPDX-License-Identifier: MIT OR Apache-2.0
//! From every fourth row of a trigger's frames to points on the body: the pipeline of `fourdbody reconstruct`, with the
//! fringe orders of all cameras found together.

use super::rows::Rows;
use crate::acquire::preview::Sample;
use crate::base::ids::CameraId;
use crate::base::image::Mono8;
use crate::preview::quick_look;
use crate::reconstruct::Reconstructor;
use crate::reconstruct::outcome::Outcome;
use serde::Serialize;

/// Most points of all cameras that a browser receives.
pub const POINTS_MAX: usize = 48_000;

/// How a camera sees the body.
#[derive(Debug, Clone, PartialEq, Serialize, utoipa::ToSchema)]
pub struct CameraShare {
    /// The name of the camera in the rig.
    #[schema(value_type = String)]
    pub camera: CameraId,
    /// Pixels that show the object, of the rows that were looked at.
    pub lit: usize,
    /// Those of the lit pixels that became points.
    pub points: usize,
    /// Why no point can be trusted.
    pub refused: Option<String>,
}

/// One frame set as points.
#[derive(Debug, Clone, Default)]
pub struct Body {
    pub points: Vec<u8>,
    /// One entry for each camera that had a frame.
    pub cameras: Vec<CameraShare>,
}

/// The body of one trigger, of which every fourth row is there, on the current rayon pool.
pub fn body(reconstructor: &Reconstructor, rows: &Rows) -> Body {
    let made = reconstructor.reconstruct(|camera| rows.get(camera).and_then(image));
    let most = POINTS_MAX / made.iter().flatten().count().max(1);
    let mut body = Body::default();
    for (camera, made) in reconstructor.cameras().zip(made) {
        let Some(made) = made else { continue };
        let refused = match made.outcome {
            Outcome::Refused(reason) => Some(reason),
            Outcome::Cloud => None,
        };
        let (lit, points) = (made.counts.object, made.cloud.len());
        body.points.extend(quick_look::encode(&made.cloud, most));
        body.cameras.push(CameraShare { camera: camera.clone(), lit, points, refused });
    }
    body
}

fn image(sample: &Sample) -> Option<Mono8<'_>> {
    Mono8::new(sample.width, sample.pixels.len() / sample.width.max(1), &sample.pixels)
}
