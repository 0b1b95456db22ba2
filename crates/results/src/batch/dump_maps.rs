// SPDX-License-Identifier: MIT OR Apache-2.0
//! The maps of a frame as pictures, for people: `DIRECTORY/CAMERA_INDEX_MAP.png`.
//!
//! Phases are drawn as saw teeth (one period of grey from black to white), all other maps from 0
//! (black) to their largest value (white). Undefined pixels are dark blue.

use crate::base::image::{Plane, write_png_rgb};
use crate::reconstruct::outcome::Maps;
use std::f32::consts::TAU;
use std::io;
use std::path::Path;

const UNDEFINED: [u8; 3] = [0, 0, 64];

/// Writes all maps, at their place in the whole frame.
pub fn write(directory: &Path, stem: &str, maps: &Maps) -> io::Result<()> {
    std::fs::create_dir_all(directory)?;
    for (name, plane) in &maps.planes {
        let path = directory.join(format!("{stem}_{name}.png"));
        let (width, height) = maps.frame;
        write_png_rgb(&path, width, height, &picture(name, plane, maps))?;
    }
    Ok(())
}

fn picture(name: &str, plane: &Plane<f32>, maps: &Maps) -> Vec<u8> {
    let (width, height) = maps.frame;
    let grey = shade(name, plane);
    let mut rgb = UNDEFINED.repeat(width * height);
    for v in 0..plane.height() {
        for (u, &x) in plane.row(v).iter().enumerate() {
            if !x.is_nan() {
                let at = 3 * ((maps.roi.v + v) * width + maps.roi.u + u);
                rgb[at..at + 3].fill((255.0 * grey(x)).round().clamp(0.0, 255.0) as u8);
            }
        }
    }
    rgb
}

/// Brightness of a value, 0 to 1.
fn shade(name: &str, plane: &Plane<f32>) -> Box<dyn Fn(f32) -> f32> {
    match name {
        "Wm" => Box::new(|x| x / TAU + 0.5),
        // Eight fringes to a saw tooth: the order is visible, and its jumps too.
        "Um" | "Fm" => Box::new(|x| (x / (8.0 * TAU)).rem_euclid(1.0)),
        _ => {
            let finite = plane.as_slice().iter().copied().filter(|x| x.is_finite());
            let largest = finite.fold(0.0, f32::max).max(f32::MIN_POSITIVE);
            Box::new(move |x| x / largest)
        }
    }
}
