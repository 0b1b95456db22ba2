// SPDX-License-Identifier: MIT OR Apache-2.0
//! What MATLAB's `toStruct` states of `stereoParameters` or `cameraParameters`, as JSON.
//!
//! MATLAB counts pixels from 1. Its rotation and its older `IntrinsicMatrix` multiply rows of coordinates from the
//! right: they are transposed here.

use super::opencv::{numbers, square, vector};
use super::{Foreign, ForeignDevice, Place, lens};
use serde_json::{Map, Value};

/// Whether a file is one of MATLAB's.
pub fn is_it(all: &Map<String, Value>) -> bool {
    all.contains_key("CameraParameters1") || all.contains_key("RadialDistortion")
}

/// The cameras of a stereo pair, or one camera.
pub fn devices(all: &Map<String, Value>) -> Result<Foreign, String> {
    let part = |name: &str| all.get(name).and_then(Value::as_object);
    let (Some(first), Some(second)) = (part("CameraParameters1"), part("CameraParameters2")) else {
        let devices = vec![device("camera", all, Place::First)?];
        return Ok(Foreign { program: "MATLAB", devices, unit_mm: None });
    };
    let rotation =
        all.get("RotationOfCamera2").ok_or("expected RotationOfCamera2 of toStruct, found none")?;
    let rotation = square(rotation)?.transpose();
    let place = Place::FromFirst(rotation, vector("TranslationOfCamera2", all.get("TranslationOfCamera2"))?);
    let devices = vec![device("camera 1", first, Place::First)?, device("camera 2", second, place)?];
    let unit_mm = match first.get("WorldUnits").and_then(Value::as_str).unwrap_or_default() {
        "mm" | "millimeters" => Some(1.0),
        "cm" | "centimeters" => Some(10.0),
        "m" | "meters" => Some(1000.0),
        "in" | "inches" => Some(25.4),
        _ => None,
    };
    Ok(Foreign { program: "MATLAB", devices, unit_mm })
}

fn device(name: &str, of: &Map<String, Value>, place: Place) -> Result<ForeignDevice, String> {
    let of_device = |e: String| format!("{name}: {e}");
    let fisheye = |of: &Map<String, Value>| of.contains_key("MappingCoefficients");
    if fisheye(of) || of.get("Intrinsics").and_then(Value::as_object).is_some_and(fisheye) {
        return Err(of_device(
            "expected radial and tangential distortion, found the fisheye model".to_owned(),
        ));
    }
    let list = |key: &str| of.get(key).map(numbers).unwrap_or_default();
    let matrix = match (of.get("K"), of.get("IntrinsicMatrix")) {
        (Some(k), _) => square(k),
        (_, Some(transposed)) => square(transposed).map(|m| m.transpose()),
        _ => Err("expected K or IntrinsicMatrix, found none".to_owned()),
    };
    let mut matrix = matrix.map_err(of_device)?;
    matrix[(0, 2)] -= 1.0;
    matrix[(1, 2)] -= 1.0;
    let (radial, tangential) = (list("RadialDistortion"), list("TangentialDistortion"));
    let (2 | 3, 2) = (radial.len(), tangential.len()) else {
        let counts = [radial.len(), tangential.len()];
        return Err(of_device(format!(
            "expected 2 or 3 radial and 2 tangential coefficients, found {counts:?}"
        )));
    };
    let k3 = radial.get(2).copied().unwrap_or(0.0);
    let lens = lens(&matrix, &[radial[0], radial[1], tangential[0], tangential[1], k3]).map_err(of_device)?;
    // Rows come first.
    let size =
        <[f64; 2]>::try_from(list("ImageSize")).ok().map(|[rows, columns]| [columns as usize, rows as usize]);
    Ok(ForeignDevice { name: name.to_owned(), lens, size, place, is_projector: false })
}
