// SPDX-License-Identifier: MIT OR Apache-2.0
//! Photographs of one instant and a calibration to one cloud of points:
//!
//! ```text
//! cargo run --release -p fourdbody-reconstruct --example points -- \
//!     calibration.json cloud.ply h0_low=h0_low.png h0_up=h0_up.png ...
//! ```
//!
//! Each photograph is an 8-bit grey PNG with the size that the calibration states, under the name that the camera has
//! there. Cameras without a photograph are left out. `fourdbody export SESSION --format png` writes such files of a
//! recording.

use fourdbody_core::base::image::{Mono8, read_png_grey};
use fourdbody_core::data::Calibration;
use fourdbody_core::formats::ply;
use fourdbody_reconstruct::Reconstructor;
use std::collections::BTreeMap;
use std::path::Path;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [calibration, out, photographs @ ..] = arguments.as_slice() else {
        return Err("expected CALIBRATION OUT.ply CAMERA=PHOTOGRAPH.png ...".into());
    };

    // Once for a calibration: tables of all cameras.
    let reconstructor = Reconstructor::new(&Calibration::load(Path::new(calibration))?)?;

    let mut images = BTreeMap::new();
    for photograph in photographs {
        let (camera, file) = photograph.split_once('=').ok_or("expected CAMERA=PHOTOGRAPH.png")?;
        images.insert(camera, read_png_grey(Path::new(file))?);
    }

    // Once for each instant: points of each camera, or why there are none.
    let results = reconstructor.reconstruct(|camera| images.get(camera.as_str()).map(Mono8::from));
    for (camera, result) in reconstructor.cameras().zip(&results) {
        let Some(result) = result else { continue };
        println!("{camera}: {} points, {:?}", result.cloud.len(), result.outcome);
    }

    // One cloud of all cameras, in metres, with intensity and normals.
    let merged = reconstructor.merge(&results);
    ply::write(&mut std::fs::File::create(out)?, &merged, &[])?;
    println!("{out}: {} points of all cameras", merged.len());
    Ok(())
}
