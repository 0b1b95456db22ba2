// SPDX-License-Identifier: MIT OR Apache-2.0
//! A sample as a small upright PNG.
//!
//! The cameras are mounted in portrait, columns running down: the picture is the frame turned clockwise.

use super::light::windows;
use crate::acquire::preview::{ROW_STEP, Sample};

/// The grey value of saturated pixels, which the palette shows red.
const RED: u8 = 255;

/// A quarter of the frame's size: means of four columns of every fourth row. A pixel with a saturated one among its
/// four is red.
pub fn upright_png(sample: &Sample) -> Result<Vec<u8>, png::EncodingError> {
    let columns = sample.width / ROW_STEP;
    let rows = sample.pixels.len().checked_div(sample.width).unwrap_or(0);
    let (width, height) = (rows, columns);
    let mut pixels = vec![0u8; width * height];
    for (v, row) in sample.pixels.chunks_exact(sample.width.max(1)).enumerate() {
        for (u, four) in row.chunks_exact(ROW_STEP).enumerate() {
            let sum: u32 = four.iter().map(|&x| u32::from(x)).sum();
            let grey = (sum / ROW_STEP as u32).min(254) as u8;
            pixels[u * width + (rows - 1 - v)] = if four.contains(&255) { RED } else { grey };
        }
    }
    encode((width, height), &pixels, (greys(), Vec::new()))
}

/// The square with all its pixels ([`Sample::detail`]), upright; saturated pixels are red. None where none was requested.
pub fn detail_png(sample: &Sample) -> Result<Option<Vec<u8>>, png::EncodingError> {
    let columns = sample.detail_width;
    let rows = sample.detail.len().checked_div(columns).unwrap_or(0);
    if rows == 0 {
        return Ok(None);
    }
    let mut pixels = vec![0u8; sample.detail.len()];
    for (v, row) in sample.detail.chunks_exact(columns).enumerate() {
        row.iter().enumerate().for_each(|(u, grey)| pixels[u * rows + (rows - 1 - v)] = *grey);
    }
    encode((rows, columns), &pixels, (greys(), Vec::new())).map(Some)
}

/// All grey values, the largest of them red.
fn greys() -> Vec<u8> {
    let mut palette: Vec<u8> = (0..=254u8).flat_map(|grey| [grey; 3]).collect();
    palette.extend([255, 40, 40]);
    palette
}

/// Colours of [`WindowLight`]: nothing, green, amber, red.
const LIGHTS: [[u8; 3]; 4] = [[0, 0, 0], [60, 220, 110], [255, 180, 40], [255, 40, 40]];
/// How much of the picture below they hide.
const OPACITY: [u8; 4] = [0, 110, 150, 190];

/// What the light is good for, to lie over the picture: as wide, and a row for each window of columns.
pub fn light_png(sample: &Sample) -> Result<Vec<u8>, png::EncodingError> {
    let rows: Vec<Vec<u8>> = windows(sample).map(|row| row.map(|light| light as u8).collect()).collect();
    let (width, height) = (rows.len(), rows.first().map_or(0, Vec::len));
    let mut pixels = vec![0u8; width * height];
    for (v, row) in rows.iter().enumerate() {
        row.iter().enumerate().for_each(|(u, light)| pixels[u * width + (width - 1 - v)] = *light);
    }
    encode((width, height), &pixels, (LIGHTS.concat(), OPACITY.to_vec()))
}

/// A PNG with this palette and, where that is not empty, its opacities.
fn encode(
    (width, height): (usize, usize),
    pixels: &[u8],
    (palette, opacity): (Vec<u8>, Vec<u8>),
) -> Result<Vec<u8>, png::EncodingError> {
    let mut png = Vec::new();
    let side = |n: usize| u32::try_from(n).unwrap_or(u32::MAX);
    let mut encoder = png::Encoder::new(&mut png, side(width), side(height));
    encoder.set_color(png::ColorType::Indexed);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_palette(palette);
    if !opacity.is_empty() {
        encoder.set_trns(opacity);
    }
    encoder.set_compression(png::Compression::Fast);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(pixels)?;
    writer.finish()?;
    Ok(png)
}

#[cfg(test)]
mod tests {
    use super::{detail_png, upright_png};
    use crate::acquire::preview::Sample;

    #[test]
    fn the_first_column_is_on_top_and_the_first_row_on_the_right() {
        // Two rows (of eight) by eight columns: the first row bright on its left half, one saturated pixel in the
        // second.
        let first = [200, 200, 200, 200, 10, 10, 10, 10];
        let second = [30, 30, 30, 30, 30, 30, 30, 255];
        let sample = Sample { width: 8, pixels: [first, second].concat(), ..Sample::default() };
        let png = upright_png(&sample).expect("encoded");
        assert_eq!(pixels_of(png), ((2, 2), vec![30, 200, 255, 10]));
    }

    #[test]
    fn a_square_is_turned_like_the_picture() {
        assert!(detail_png(&Sample::default()).expect("nothing to encode").is_none());
        let sample = Sample { detail: vec![1, 2, 3, 4, 5, 255], detail_width: 3, ..Sample::default() };
        let png = detail_png(&sample).expect("encoded").expect("a square");
        assert_eq!(pixels_of(png), ((2, 3), vec![4, 1, 5, 2, 255, 3]));
    }

    fn pixels_of(png: Vec<u8>) -> ((u32, u32), Vec<u8>) {
        let mut reader = png::Decoder::new(std::io::Cursor::new(png)).read_info().expect("a PNG");
        let size = (reader.info().width, reader.info().height);
        let mut pixels = vec![0; (size.0 * size.1) as usize];
        reader.next_frame(&mut pixels).expect("pixels");
        (size, pixels)
    }
}
