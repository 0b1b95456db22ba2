// SPDX-License-Identifier: MIT OR Apache-2.0
//! Pixel form and size of the images.

use super::plan::{Amount, Plan, Trouble, Wishes, Write, first_writable, writable_number};
use crate::camera::description::Description;
use crate::config::{FeatureValue, Mosaic, Pixel};

/// Names under which an image of 8-bit grey is known.
const MONO8: [&str; 8] = ["Mono8", "Mono8bit", "Monochrome8", "Grey8", "Gray8", "Y8", "MonoPacked8", "Luma8"];

/// Adds pixel format and size of the images.
pub fn resolve(camera: &dyn Description, wishes: &Wishes, plan: &mut Plan) {
    if !wishes.left_to_settings("pixel") {
        let found = pixel_format(camera, wishes);
        plan.pixel_format = found.as_ref().ok().map(|(format, _)| format.clone());
        plan.add(found.map(|(_, writes)| writes));
    }
    // The place on the sensor comes first, because it bounds the size.
    for offset in ["OffsetX", "OffsetY"] {
        if writable_number(camera, offset).is_some() {
            plan.writes.push(Write::new(offset, Amount::Value(FeatureValue::Integer(0)), "").optional());
        }
    }
    let step = wishes.words.pixel.map_or(1, Pixel::step);
    for (name, word, size) in [("Width", "width", wishes.size.0), ("Height", "height", wishes.size.1)] {
        if !wishes.left_to_settings(word) {
            plan.add(length(camera, name, word, size * step));
        }
    }
}

/// The requested format; else 8-bit grey; else the first deeper grey that the camera has, packed before unpacked.
fn pixel_format(camera: &dyn Description, wishes: &Wishes) -> Result<((String, Pixel), Vec<Write>), Trouble> {
    const NAME: &str = "PixelFormat";
    let Some(feature) = camera.feature(NAME) else {
        let message =
            "the camera has no PixelFormat, and what its images are cannot be known: expected Mono8";
        return Err(Trouble::new(NAME, message));
    };
    let entry = |pixel: Pixel| match pixel {
        Pixel::Mono8 => feature.entry(&MONO8),
        // Any order of the colour filters will do.
        Pixel::Bayer8(_) => feature.entry(&Mosaic::ALL.map(|mosaic| Pixel::Bayer8(mosaic).name())),
        deeper => feature.entry(&[deeper.name()]),
    };
    let fits = |pixel: &Pixel| wishes.size.0.is_multiple_of(pixel.columns_step());
    let first = || Pixel::GREY.into_iter().find(|pixel| fits(pixel) && entry(*pixel).is_some());
    let chosen = wishes.words.pixel.or_else(first).unwrap_or_default();
    let has_mosaic = entry(Pixel::Bayer8(Mosaic::default())).is_some();
    let Some(entry) = entry(chosen).map(str::to_owned) else {
        let remedy = match wishes.words.pixel {
            Some(_) => "set pixel to one that it has, or leave it out",
            None if has_mosaic => {
                "a session records grey alone: set pixel = \"bayer8\" to take the plane of the head's colour, at half \
                 the size"
            }
            None => "a session records grey alone: use a camera that sends it",
        };
        return Err(Trouble::no_entry(NAME, chosen.name(), &feature, remedy));
    };
    if !fits(&chosen) {
        return Err(Trouble::new(NAME, uneven_rows(chosen, wishes.size.0)));
    }
    if feature.is_writable() {
        let writes = vec![Write::entry(NAME, &entry, "pixel")];
        return Ok(((entry, chosen), writes));
    }
    // Before SFNC 1.4 the format followed from two other features.
    let mut writes = Vec::new();
    let coding = if chosen.name().ends_with("Packed") { "MonoPacked" } else { "Mono" };
    let bits = format!("Bpp{}", chosen.depth());
    for (name, wanted) in [("PixelCoding", coding), ("PixelSize", bits.as_str())] {
        if let Some((name, feature)) = first_writable(camera, &[name])
            && let Some(wanted) = feature.entry(&[wanted])
        {
            writes.push(Write::entry(name, wanted, "pixel"));
        }
    }
    Ok(((entry, chosen), writes))
}

/// Rows of packed pixels that end within a byte are filled up by some cameras, and by others not.
pub fn uneven_rows(pixel: Pixel, width: usize) -> String {
    format!(
        "PixelFormat {} needs rows of a multiple of {} columns, and the rig has {width}: set pixel to another format",
        pixel.name(),
        pixel.columns_step()
    )
}

fn length(
    camera: &dyn Description,
    name: &str,
    word: &'static str,
    size: usize,
) -> Result<Option<Write>, Trouble> {
    let Some(feature) = camera.feature(name) else {
        return Err(Trouble::new(name, format!("the camera has no {name}: expected one of {size}")));
    };
    // A size that cannot be set is checked when all is set.
    if !feature.is_writable() {
        return Ok(None);
    }
    Ok(Some(Write::new(name, Amount::Value(FeatureValue::Integer(size as i64)), word)))
}
