// SPDX-License-Identifier: MIT OR Apache-2.0
//! Row-major image planes and 8-bit grey PNG files.
//!
//! Pixel (u, v): u is the column, v the row, integers at pixel centres.

use super::{FileError, regular};
use std::fs::File;
use std::io::{self, BufReader, BufWriter};
use std::path::Path;

/// An owned plane of `width * height` values, row-major without padding.
#[derive(Debug, Default)]
pub struct Plane<T> {
    width: usize,
    height: usize,
    /// The values, and behind them what is left of a larger plane.
    data: Vec<T>,
}

impl<T: Copy> Clone for Plane<T> {
    fn clone(&self) -> Self {
        Self { width: self.width, height: self.height, data: self.as_slice().to_vec() }
    }
}

impl<T: Copy + PartialEq> PartialEq for Plane<T> {
    fn eq(&self, other: &Self) -> bool {
        (self.width, self.height) == (other.width, other.height) && self.as_slice() == other.as_slice()
    }
}

impl<T: Copy> Plane<T> {
    /// A plane filled with one value.
    pub fn filled(width: usize, height: usize, value: T) -> Self {
        Self { width, height, data: vec![value; width * height] }
    }

    /// A plane whose value at column u, row v is `value(u, v)`, called row after row.
    pub fn from_fn(width: usize, height: usize, mut value: impl FnMut(usize, usize) -> T) -> Self {
        let rows = (0..height).flat_map(|v| (0..width).map(move |u| (u, v)));
        Self { width, height, data: rows.map(|(u, v)| value(u, v)).collect() }
    }

    /// The plane of what `to` makes of each value.
    pub fn map<U: Copy>(&self, to: impl Fn(T) -> U) -> Plane<U> {
        let data = self.as_slice().iter().map(|&x| to(x)).collect();
        Plane { width: self.width, height: self.height, data }
    }

    /// Wraps `data`; `None` when its length is not `width * height`.
    pub fn from_vec(width: usize, height: usize, data: Vec<T>) -> Option<Self> {
        (data.len() == width * height).then_some(Self { width, height, data })
    }

    /// Makes it a plane of this size filled with one value, in the memory that it has if that suffices: stages keep
    /// their planes from frame to frame.
    pub fn reset(&mut self, width: usize, height: usize, value: T) {
        (self.width, self.height) = (width, height);
        self.data.clear();
        self.data.resize(width * height, value);
    }

    /// Makes it a plane of this size with arbitrary values (those that it had, or `value`), for stages that write all
    /// of them.
    pub fn reshape(&mut self, width: usize, height: usize, value: T) {
        (self.width, self.height) = (width, height);
        if self.data.len() < width * height {
            self.data.resize(width * height, value);
        }
    }

    /// Makes room for this number of values, where there is less. What it holds is lost then. Where `value` is 0 the
    /// system gives memory only as it is written to.
    pub fn reserve(&mut self, values: usize, value: T) {
        if self.data.len() < values {
            *self = Self { width: 0, height: 0, data: vec![value; values] };
        }
    }

    /// The number of columns in a row.
    pub fn width(&self) -> usize {
        self.width
    }

    /// The number of rows of the plane.
    pub fn height(&self) -> usize {
        self.height
    }

    /// All values, row after row.
    pub fn as_slice(&self) -> &[T] {
        &self.data[..self.width * self.height]
    }

    /// All values, row by row.
    pub fn into_vec(mut self) -> Vec<T> {
        self.data.truncate(self.width * self.height);
        self.data
    }

    /// All values, row after row.
    pub fn as_mut_slice(&mut self) -> &mut [T] {
        &mut self.data[..self.width * self.height]
    }

    /// The values of row `v`, by column.
    pub fn row(&self, v: usize) -> &[T] {
        &self.data[v * self.width..(v + 1) * self.width]
    }

    /// The values of row `v`, by column, to be changed.
    pub fn row_mut(&mut self, v: usize) -> &mut [T] {
        &mut self.data[v * self.width..(v + 1) * self.width]
    }

    /// The value at column `u`, row `v`.
    pub fn at(&self, u: usize, v: usize) -> T {
        self.data[v * self.width + u]
    }

    /// Replaces the value at column `u`, row `v`.
    pub fn set(&mut self, u: usize, v: usize, value: T) {
        self.data[v * self.width + u] = value;
    }
}

/// A borrowed Mono8 image, for instance a frame read from a recording.
#[derive(Debug, Clone, Copy)]
pub struct Mono8<'a> {
    width: usize,
    height: usize,
    data: &'a [u8],
}

impl<'a> Mono8<'a> {
    /// Wraps `data`; `None` when its length is not `width * height`.
    pub fn new(width: usize, height: usize, data: &'a [u8]) -> Option<Self> {
        (data.len() == width * height).then_some(Self { width, height, data })
    }

    /// The number of columns in a row.
    pub fn width(&self) -> usize {
        self.width
    }

    /// The number of rows of the image.
    pub fn height(&self) -> usize {
        self.height
    }

    /// All pixels, row after row.
    pub fn as_slice(&self) -> &'a [u8] {
        self.data
    }

    /// The pixels of row `v`, by column.
    pub fn row(&self, v: usize) -> &'a [u8] {
        &self.data[v * self.width..(v + 1) * self.width]
    }
}

impl<'a> From<&'a Plane<u8>> for Mono8<'a> {
    fn from(plane: &'a Plane<u8>) -> Self {
        Self { width: plane.width, height: plane.height, data: plane.as_slice() }
    }
}

/// No camera has more pixels.
const PIXELS_MAX: usize = 1 << 28;

/// Reads an 8-bit grey PNG.
pub fn read_png_grey(path: &Path) -> Result<Plane<u8>, FileError> {
    let decode_error = |source: png::DecodingError| {
        FileError::of(path)(format!("not a readable PNG ({source}); expected an 8-bit grey PNG"))
    };
    let format_error = |found: String| {
        let message = format!("expected 8-bit grey pixels, found {found}; convert it to 8-bit grey first");
        Err(FileError::of(path)(message))
    };
    let file = regular::open(path).map_err(FileError::of(path))?;
    let length = file.metadata().map_err(FileError::of(path))?.len();
    let mut reader = png::Decoder::new(BufReader::new(file)).read_info().map_err(decode_error)?;
    let info = reader.info();
    let (width, height) = (info.width as usize, info.height as usize);
    if info.color_type != png::ColorType::Grayscale || info.bit_depth != png::BitDepth::Eight {
        return format_error(format!("{:?} {:?}", info.color_type, info.bit_depth));
    }
    // Deflate makes at most 1032 bytes of one: a file that announces more claims memory for what it does not hold.
    let pixels = width
        .checked_mul(height)
        .filter(|pixels| *pixels <= PIXELS_MAX && *pixels as u64 <= length.saturating_mul(1032));
    let Some(pixels) = pixels else {
        return format_error(format!("{width} x {height} of them in {length} bytes"));
    };
    let mut data = vec![0; pixels];
    reader.next_frame(&mut data).map_err(decode_error)?;
    Ok(Plane { width, height, data })
}

/// Writes an 8-bit grey PNG.
pub fn write_png_grey(path: &Path, image: Mono8<'_>) -> io::Result<()> {
    write_png(path, image.width, image.height, png::ColorType::Grayscale, image.data)
}

/// Writes an 8-bit grey PNG to what is open already.
pub fn encode_png_grey(out: impl io::Write, image: Mono8<'_>) -> io::Result<()> {
    encode_png(out, image.width, image.height, png::ColorType::Grayscale, image.data)
}

/// Writes an 8-bit RGB PNG; `rgb` holds `3 * width * height` bytes.
pub fn write_png_rgb(path: &Path, width: usize, height: usize, rgb: &[u8]) -> io::Result<()> {
    write_png(path, width, height, png::ColorType::Rgb, rgb)
}

fn write_png(path: &Path, width: usize, height: usize, color: png::ColorType, data: &[u8]) -> io::Result<()> {
    encode_png(BufWriter::new(File::create(path)?), width, height, color, data)
}

fn encode_png(
    out: impl io::Write,
    width: usize,
    height: usize,
    color: png::ColorType,
    data: &[u8],
) -> io::Result<()> {
    let too_large = |_| io::Error::new(io::ErrorKind::InvalidInput, "image side exceeds 2^32 pixels");
    let (w, h) = (u32::try_from(width).map_err(too_large)?, u32::try_from(height).map_err(too_large)?);
    let mut encoder = png::Encoder::new(out, w, h);
    encoder.set_color(color);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_compression(png::Compression::Fast);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(data)?;
    writer.finish()?;
    Ok(())
}
