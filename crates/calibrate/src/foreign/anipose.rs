// SPDX-License-Identifier: MIT OR Apache-2.0
//! The TOML files of Anipose, FreeMoCap and Caliscope: cameras around a room, each with its lens and `x_camera = R x + t`,
//! where R is a rotation vector. The first camera stays where the calibration has it, the others are placed from there.

use super::opencv::{numbers, square, vector};
use super::{Foreign, ForeignDevice, Place, lens};
use nalgebra::Rotation3;
use serde_json::{Map, Value};

/// The cameras of a file, where it is one of these.
fn tables(all: &Map<String, Value>) -> Vec<(&String, &Map<String, Value>)> {
    let inner = all.get("cameras").and_then(Value::as_object).unwrap_or(all);
    let tables = inner.iter().filter_map(|(key, value)| Some((key, value.as_object()?)));
    // Cameras that were left out have no place.
    let mut tables: Vec<_> =
        tables.filter(|(_, x)| x.contains_key("matrix") && x.contains_key("translation")).collect();
    let number = |key: &str| key.trim_start_matches(|c: char| !c.is_ascii_digit()).parse::<u64>().ok();
    tables.sort_by_key(|(key, _)| number(key));
    tables
}

/// Whether a file is one of these.
pub fn is_it(all: &Map<String, Value>) -> bool {
    !tables(all).is_empty()
}

/// The cameras in the order of their numbers.
pub fn devices(all: &Map<String, Value>) -> Result<Foreign, String> {
    let mut first = None;
    let mut devices = Vec::new();
    for (key, table) in tables(all) {
        let name = table.get("name").and_then(Value::as_str).unwrap_or(key).to_owned();
        let of_device = |e: String| format!("{name}: {e}");
        let list = |key: &str| table.get(key).map(numbers).unwrap_or_default();
        if table.get("fisheye") == Some(&Value::Bool(true)) {
            return Err(of_device(
                "expected radial and tangential distortion, found fisheye = true".to_owned(),
            ));
        }
        let vector = |key: &str| vector(key, table.get(key)).map_err(of_device);
        let (turn, shift) = (Rotation3::new(vector("rotation")?), vector("translation")?);
        let place = match first {
            None => Place::First,
            Some((first_turn, first_shift)) => {
                let from_first: Rotation3<f64> = turn * Rotation3::inverse(&first_turn);
                Place::FromFirst(*from_first.matrix(), shift - from_first * first_shift)
            }
        };
        first.get_or_insert((turn, shift));
        let matrix = square(table.get("matrix").unwrap_or(&Value::Null)).map_err(of_device)?;
        let lens = lens(&matrix, &list("distortions")).map_err(of_device)?;
        let size = <[f64; 2]>::try_from(list("size")).ok().map(|size| size.map(|x| x as usize));
        devices.push(ForeignDevice { name, lens, size, place, is_projector: false });
    }
    Ok(Foreign { program: "Anipose, FreeMoCap or Caliscope", devices, unit_mm: None })
}
