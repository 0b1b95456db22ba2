// SPDX-License-Identifier: MIT OR Apache-2.0
//! Photographs of one instant and a calibration to points:
//! `cargo run --release -p fourdbody-reconstruct --example points -- calibration.json OUT.ply h0_up=PHOTOGRAPH.png ...`

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
    let reconstructor = Reconstructor::new(&Calibration::load(Path::new(calibration))?)?;
    let mut images = BTreeMap::new();
    for photograph in photographs {
        let (camera, file) = photograph.split_once('=').ok_or("expected CAMERA=PHOTOGRAPH.png")?;
        images.insert(camera, read_png_grey(Path::new(file))?);
    }
    let made = reconstructor.reconstruct(|camera| images.get(camera.as_str()).map(Mono8::from));
    for (camera, made) in reconstructor.cameras().zip(&made) {
        let Some(made) = made else { continue };
        println!("{camera}: {} points, {:?}", made.cloud.len(), made.outcome);
    }
    ply::write(&mut std::fs::File::create(out)?, &reconstructor.merge(&made), &[])?;
    Ok(())
}
