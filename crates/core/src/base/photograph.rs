// SPDX-License-Identifier: MIT OR Apache-2.0
//! Photographs in the formats of other recorders, as the 8-bit grey that everything here works on.
//!
//! What is not 8-bit grey is converted as its user says, or refused: by its kind, and with what to do.

use super::image::Plane;
use super::{FileError, regular};
use image::{DynamicImage, ImageDecoder, ImageFormat, ImageReader, Limits};
use std::io::{Cursor, Read};
use std::path::Path;

/// How names of photographs end that can be read.
pub const ENDINGS: [&str; 7] = ["png", "tif", "tiff", "bmp", "jpg", "jpeg", "pgm"];

/// How the values of a file become those of 8-bit grey.
#[derive(Debug, Clone, Copy, Default)]
pub struct Conversion {
    /// The value in the file that becomes 255; those above it do so, too.
    pub scale: Option<f32>,
    /// The colour channel that is taken, 0 for red; `None`: all must be equal.
    pub channel: Option<usize>,
}

/// The picture that a file contained.
#[derive(Debug)]
pub struct Photograph {
    /// Its pixels in 8 bits.
    pub grey: Plane<u8>,
    /// Whether its compression changed them.
    pub lossy: bool,
}

/// No photograph has more bytes.
const FILE_BYTES_MAX: u64 = 1 << 30;
/// No camera has more pixels.
const PIXELS_MAX: u64 = 1 << 28;
/// The most pixels of a byte: deflate makes at most 1032 bytes of one. A file that announces more claims memory for
/// what it does not hold.
const PIXELS_PER_BYTE: u64 = 1032;

/// First bytes of files that are no photographs, where they begin, and what to do.
const OTHERS: [(usize, &[u8], &str); 21] = [
    (0, b"PK\x03\x04", "a zip archive; unpack it and give its folder"),
    (0, b"\x1f\x8b", "a gzip archive; unpack it and give its folder"),
    (0, b"7z\xbc\xaf", "a 7z archive; unpack it and give its folder"),
    (0, b"Rar!", "a RAR archive; unpack it and give its folder"),
    (257, b"ustar", "a tar archive; unpack it and give its folder"),
    (
        4,
        b"ftyphei",
        "a HEIC photograph, which is compressed; export it as PNG, better: record without compression",
    ),
    (
        4,
        b"ftypmif",
        "a HEIC photograph, which is compressed; export it as PNG, better: record without compression",
    ),
    (
        4,
        b"ftypavif",
        "an AVIF photograph, which is compressed; export it as PNG, better: record without compression",
    ),
    (4, b"ftypcrx", "a raw photograph (CR3); develop it linearly to a 16-bit TIFF"),
    (4, b"ftyp", VIDEO),
    (8, b"AVI ", VIDEO),
    (0, b"\x1a\x45\xdf\xa3", VIDEO),
    (0, b"YUV4MPEG2", VIDEO),
    (0, b"GIF8", "a GIF; write its frames as PNG"),
    (8, b"WEBP", "a WebP photograph; write it as PNG"),
    (0, b"\x93NUMPY", "an array of NumPy; write it as a PNG or TIFF"),
    (0, b"\x89HDF", "an HDF5 file; write its frames as PNG or TIFF"),
    (0, b"MATLAB", "a MATLAB file; write its frames with imwrite as PNG or TIFF"),
    (0, b"version https://git-lfs", "a pointer of Git LFS in the file's place; run `git lfs pull`"),
    (0, b"%PDF", "a PDF; write its picture as PNG"),
    (0, b"<", "a text such as HTML or XML; the download may have failed"),
];

const VIDEO: &str = "a video; write its frames as images: \
    ffmpeg -i VIDEO -pix_fmt gray -start_number 0 DIR/CAMERA/%06d.png (a compressed video changes phases)";

/// What a file that is no photograph is, by its first bytes, and what to do; `None`: these say nothing.
pub fn kind(path: &Path) -> Option<&'static str> {
    let mut head = Vec::new();
    regular::open(path).ok()?.take(512).read_to_end(&mut head).ok()?;
    kind_of(&head)
}

fn kind_of(bytes: &[u8]) -> Option<&'static str> {
    let begins =
        |&&(at, magic, _): &&(usize, &[u8], &str)| bytes.get(at..).is_some_and(|b| b.starts_with(magic));
    OTHERS.iter().find(begins).map(|other| other.2)
}

/// Reads a photograph.
///
/// # Errors
/// It cannot be read, is none, or is not what the conversion expects.
pub fn read(path: &Path, conversion: &Conversion) -> Result<Photograph, FileError> {
    let bytes = regular::read(path, FILE_BYTES_MAX).map_err(FileError::of(path))?;
    decode(&bytes, conversion).map_err(FileError::of(path))
}

fn decode(bytes: &[u8], conversion: &Conversion) -> Result<Photograph, String> {
    let format = image::guess_format(bytes).ok().filter(ImageFormat::reading_enabled);
    let format = format.ok_or_else(|| {
        let found = match bytes.get(..4) {
            _ if let Some(kind) = kind_of(bytes) => return format!("expected a photograph, found {kind}"),
            None => format!("{} bytes", bytes.len()),
            Some(head) => format!("a file that begins with {head:02x?}"),
        };
        format!(
            "expected a photograph as PNG, TIFF, BMP, PGM or JPEG, found {found}; write pixels without a header \
             (raw video) as one of these"
        )
    })?;
    let name = format!("{format:?}").to_uppercase();
    let unreadable = |e: image::ImageError| {
        format!("not a readable {name} ({e}); write it again, as PNG with 8 or 16 bits")
    };
    let mut reader = ImageReader::with_format(Cursor::new(bytes), format);
    // What a file announces is checked below.
    reader.limits(Limits::no_limits());
    let decoder = reader.into_decoder().map_err(unreadable)?;
    let (width, height) = decoder.dimensions();
    let pixels = u64::from(width) * u64::from(height);
    if pixels > PIXELS_MAX || pixels > PIXELS_PER_BYTE * bytes.len() as u64 {
        return Err(format!(
            "expected a photograph, found {width} x {height} pixels in {} bytes",
            bytes.len()
        ));
    }
    let colour = decoder.color_type();
    // The decoder widens 1, 2 and 4 bits of grey; only the header of a PNG (type 0: grey) still tells.
    let narrow = match bytes {
        _ if format != ImageFormat::Png => None,
        bytes => bytes.get(24..26).filter(|x| x[1] == 0 && x[0] < 8).map(|x| x[0]),
    };
    let bits = narrow.unwrap_or(8 * (colour.bytes_per_pixel() / colour.channel_count()));
    let image = DynamicImage::from_decoder(decoder).map_err(unreadable)?;
    let data = match image {
        DynamicImage::ImageLuma8(image) if bits == 8 && conversion.scale.is_none() => image.into_raw(),
        image => convert(&image, u32::from(bits), conversion)?,
    };
    let grey = Plane::from_vec(width as usize, height as usize, data).ok_or("the decoder lost pixels")?;
    Ok(Photograph { grey, lossy: format == ImageFormat::Jpeg })
}

/// The pixels in 8-bit grey, of values with this number of bits; 32 are floating-point numbers as they are.
fn convert(image: &DynamicImage, bits: u32, conversion: &Conversion) -> Result<Vec<u8>, String> {
    let white = if bits == 32 { 1.0 } else { ((1u32 << bits) - 1) as f32 };
    let values: Vec<[f32; 3]> = image.to_rgb32f().pixels().map(|pixel| pixel.0.map(|x| x * white)).collect();
    let differ = |[r, g, b]: [f32; 3]| r.max(g).max(b) - r.min(g).min(b);
    let most = values.iter().map(|&pixel| differ(pixel)).fold(0.0, f32::max);
    if conversion.channel.is_none() && most > 0.0 {
        return Err(format!(
            "expected grey, found colour: its channels differ by up to {most} of {white}; photograph with a monochrome \
             camera, or take one of them with --channel red, green or blue"
        ));
    }
    let values = values.iter().map(|pixel| pixel[conversion.channel.unwrap_or(0)]);
    let scale = match conversion.scale {
        Some(scale) => scale,
        None if bits == 8 => white,
        None => {
            let largest = values.fold(0.0, f32::max);
            return Err(format!(
                "expected 8-bit values, found {bits} bits, the largest value {largest}; say with --scale which value \
                 becomes 255, for instance --scale 4095 for 12 bits in 16"
            ));
        }
    };
    Ok(values.map(|value| (255.0 * value / scale).round() as u8).collect())
}
