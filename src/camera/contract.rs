// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a frame is: one image of 8-bit grey, of the size and at the place that were verified when its camera was
//! prepared, and nothing beside it. A frame that is anything else is never recorded.

use std::fmt;

/// PFNC code of Mono8, and its name.
pub const MONO8: (u32, &str) = (0x0108_0001, "Mono8");

/// What every frame of a stream must be.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FrameContract {
    /// Columns and rows.
    pub size: (usize, usize),
    /// Column and row of the sensor at which the image begins.
    pub offset: (usize, usize),
}

impl FrameContract {
    /// Bytes of the image: one for each pixel.
    pub fn bytes(&self) -> usize {
        self.size.0 * self.size.1
    }
}

/// What the transport says a frame is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FrameForm {
    /// PFNC code of its pixels.
    pub pixel_format: u32,
    /// Columns and rows.
    pub size: (i32, i32),
    /// Column and row of the sensor at which it begins.
    pub offset: (i32, i32),
    /// Bytes after every row, and rows after the last one.
    pub padding: (i32, i32),
    /// Bytes that arrived; one more than the image has where more than that came.
    pub bytes: usize,
}

/// How a frame breaks the contract.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Breach {
    /// It is no plain image: something else, several parts, or an image with chunks.
    Payload(Payload),
    /// Its pixels are of another format.
    PixelFormat(u32),
    /// It has another size.
    Size {
        /// Columns and rows.
        found: (i32, i32),
        /// As verified.
        expected: (usize, usize),
    },
    /// It is another part of the sensor.
    Offset {
        /// Column and row.
        found: (i32, i32),
        /// As verified.
        expected: (usize, usize),
    },
    /// Bytes after every row, and rows after the last one.
    Padding(i32, i32),
    /// More or fewer bytes arrived than it has pixels.
    Bytes {
        /// Bytes; one more than expected stands for any number.
        found: usize,
        /// As verified.
        expected: usize,
    },
}

/// What came instead of a plain image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Payload {
    /// An image followed by chunks.
    WithChunks,
    /// So many parts.
    Parts(u32),
    /// Anything else, by its name.
    Other(&'static str),
}

impl FrameContract {
    /// How a plain image breaks it.
    pub fn breach(&self, form: &FrameForm) -> Option<Breach> {
        let same = |found: (i32, i32), expected: (usize, usize)| {
            usize::try_from(found.0) == Ok(expected.0) && usize::try_from(found.1) == Ok(expected.1)
        };
        if form.pixel_format != MONO8.0 {
            return Some(Breach::PixelFormat(form.pixel_format));
        }
        if !same(form.size, self.size) {
            return Some(Breach::Size { found: form.size, expected: self.size });
        }
        if !same(form.offset, self.offset) {
            return Some(Breach::Offset { found: form.offset, expected: self.offset });
        }
        if form.padding != (0, 0) {
            return Some(Breach::Padding(form.padding.0, form.padding.1));
        }
        let (found, expected) = (form.bytes, self.bytes());
        (found != expected).then_some(Breach::Bytes { found, expected })
    }
}

/// Names of the formats that cameras have most often.
const FORMATS: [(u32, &str); 17] = [
    MONO8,
    (0x0110_0003, "Mono10"),
    (0x010c_0004, "Mono10Packed"),
    (0x010a_0046, "Mono10p"),
    (0x0110_0005, "Mono12"),
    (0x010c_0006, "Mono12Packed"),
    (0x010c_0047, "Mono12p"),
    (0x0110_0025, "Mono14"),
    (0x0110_0007, "Mono16"),
    (0x0108_0008, "BayerGR8"),
    (0x0108_0009, "BayerRG8"),
    (0x0108_000a, "BayerGB8"),
    (0x0108_000b, "BayerBG8"),
    (0x0218_0014, "RGB8"),
    (0x0218_0015, "BGR8"),
    (0x0210_001f, "YUV422_8_UYVY"),
    (0x0210_0032, "YUV422_8"),
];

/// A pixel format's name, and its code where it has none here.
pub fn format_name(code: u32) -> String {
    let known = FORMATS.iter().find(|(known, _)| *known == code);
    known.map_or_else(|| format!("pixel format {code:#010x}"), |(_, name)| (*name).to_owned())
}

impl fmt::Display for Breach {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Payload(Payload::WithChunks) => {
                f.write_str("it carries chunks beside the image, expected none")
            }
            Self::Payload(Payload::Parts(parts)) => write!(f, "it has {parts} parts, expected one image"),
            Self::Payload(Payload::Other(name)) => write!(f, "it is {name}, expected an image"),
            Self::PixelFormat(code) => {
                write!(f, "its pixels are {}, expected {}", format_name(*code), MONO8.1)
            }
            Self::Size { found, expected } => {
                write!(f, "it is {} x {}, expected {} x {}", found.0, found.1, expected.0, expected.1)
            }
            Self::Offset { found, expected } => write!(
                f,
                "it begins at column {}, row {} of the sensor, expected column {}, row {}",
                found.0, found.1, expected.0, expected.1
            ),
            Self::Padding(bytes, rows) => {
                write!(
                    f,
                    "it has {bytes} bytes of padding after every row and {rows} rows of it, expected none"
                )
            }
            Self::Bytes { found, expected } if found > expected => {
                write!(f, "it has more than the {expected} bytes of its pixels")
            }
            Self::Bytes { found, expected } => write!(
                f,
                "{found} bytes of it arrived at their places, expected {expected}: its packets are shorter than the \
                 packet size that the camera states"
            ),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{Breach, FrameContract, FrameForm, MONO8, format_name};

    const CONTRACT: FrameContract = FrameContract { size: (320, 200), offset: (0, 8) };

    fn form() -> FrameForm {
        FrameForm { pixel_format: MONO8.0, size: (320, 200), offset: (0, 8), padding: (0, 0), bytes: 64_000 }
    }

    #[test]
    fn each_difference_is_a_breach_that_says_so() {
        assert_eq!(CONTRACT.breach(&form()), None);
        let cases = [
            (FrameForm { pixel_format: 0x0110_0007, ..form() }, "Mono16"),
            (FrameForm { pixel_format: 0x0199_0099, ..form() }, "0x01990099"),
            (FrameForm { size: (321, 200), ..form() }, "321 x 200"),
            (FrameForm { size: (-1, 200), ..form() }, "-1 x 200"),
            (FrameForm { offset: (8, 0), ..form() }, "column 8, row 0"),
            (FrameForm { padding: (4, 0), ..form() }, "4 bytes of padding"),
            (FrameForm { bytes: 63_972, ..form() }, "63972 bytes"),
            (FrameForm { bytes: 64_001, ..form() }, "more than the 64000 bytes"),
        ];
        for (form, words) in cases {
            let breach = CONTRACT.breach(&form).expect(words).to_string();
            assert!(breach.contains(words), "{breach}");
        }
        assert!(matches!(CONTRACT.breach(&FrameForm { bytes: 0, ..form() }), Some(Breach::Bytes { .. })));
        assert_eq!(format_name(0x0108_0009), "BayerRG8");
    }
}
