// SPDX-License-Identifier: MIT OR Apache-2.0
//! The contract of a frame: one grey image with the format, the size and the place on the sensor that were verified
//! when its camera was set up, and nothing beside it. Any other frame is not recorded.

use crate::config::{Mosaic, Pixel};
use std::fmt;

/// The contract that every frame of a stream must keep. The set-up makes it from what the camera reports; streams check
/// each frame against it while the session runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FrameContract {
    /// Pixel format in which the camera sends.
    pub pixel: Pixel,
    /// Columns and rows of the recorded image.
    pub size: (usize, usize),
    /// Column and row of the recorded pixel within the mosaic's two by two; (0, 0) for grey.
    pub place: (usize, usize),
    /// Column and row of the sensor at which the image begins.
    pub offset: (usize, usize),
    /// Room for chunks behind the image, bytes; 0: no frame may carry any.
    pub chunk_room: usize,
}

impl FrameContract {
    /// Bytes of the recorded image: one per pixel.
    pub fn pixels(&self) -> usize {
        self.size.0 * self.size.1
    }

    /// Columns and rows of the image as the camera sends it.
    pub fn sent_size(&self) -> (usize, usize) {
        let step = self.pixel.step();
        (self.size.0 * step, self.size.1 * step)
    }

    /// Bytes of the image as the camera sends it.
    pub fn sent_bytes(&self) -> usize {
        self.pixel.sent_bytes(self.size)
    }

    /// Bytes of memory that a frame is received into.
    pub fn received_bytes(&self) -> usize {
        self.sent_bytes() + self.chunk_room
    }

    /// Remarks about the parts of the camera's image that are not recorded.
    pub fn loss(&self) -> Vec<String> {
        let (name, depth) = (self.pixel.name(), self.pixel.depth());
        let bits = depth.checked_sub(8).filter(|lost| *lost > 0).map(|lost| {
            format!(
                "its pixels are {name}: the upper 8 of their {depth} bits are recorded, and the lower {lost} are \
                 lost"
            )
        });
        let chunks = (self.chunk_room > 0).then(|| {
            format!("up to {} bytes of chunks follow each image, and are not recorded", self.chunk_room)
        });
        let plane = (self.pixel.step() > 1).then(|| {
            let ((width, height), (columns, rows), (column, row)) = (self.size, self.sent_size(), self.place);
            format!(
                "of its {name} of {columns} x {rows} the plane of the head's colour is recorded, {width} x {height}: \
                 pixel \
                 (u, v) of frames and calibration is pixel (2u + {column}, 2v + {row}) of the camera"
            )
        });
        bits.into_iter().chain(chunks).chain(plane).collect()
    }
}

/// The form of a received frame, to be compared with its contract.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FrameForm {
    /// The image as its leader describes it; `None` where the leader describes none (chunk data).
    pub image: Option<ImageForm>,
    /// The chunks that follow the image, where there are any.
    pub chunks: Option<Chunks>,
    /// Bytes that arrived; one more than the image has where even more came.
    pub bytes: usize,
}

/// The chunks of a received frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Chunks {
    /// Length of the first chunk, which is the image; `None` where the bytes that arrived are not chunks as a whole.
    pub first: Option<usize>,
}

/// An image as the leader of its frame describes it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ImageForm {
    /// PFNC code of the pixel format.
    pub pixel_format: u32,
    /// Columns and rows of the image.
    pub size: (i32, i32),
    /// Column and row of the sensor at which the image begins.
    pub offset: (i32, i32),
    /// Bytes of padding after every row, and rows of padding after the last one.
    pub padding: (i32, i32),
}

/// The first difference between a frame and its contract. `expected` is as verified when the camera was set up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Breach {
    /// Not a plain image: something else, several parts, or an image with chunks that the contract excludes.
    Payload(Payload),
    /// Another pixel format; `found` is its PFNC code.
    PixelFormat { found: u32, expected: Pixel },
    /// Values that are larger than the pixel format has bits.
    TooLarge(Pixel),
    /// Another size: columns and rows.
    Size { found: (i32, i32), expected: (usize, usize) },
    /// Another part of the sensor: its first column and row.
    Offset { found: (i32, i32), expected: (usize, usize) },
    /// Padding: bytes after every row, and rows after the last one.
    Padding(i32, i32),
    /// The chunks are not whole (`first` is `None`), or do not begin with an image of the expected length in bytes.
    Chunks { first: Option<usize>, expected: usize },
    /// More or fewer bytes arrived than the image has; one more than expected stands for any larger number.
    Bytes { found: usize, expected: usize },
}

/// The payload that came instead of a plain image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Payload {
    /// An image followed by chunks.
    WithChunks,
    /// This number of parts (multi-part payload).
    Parts(u32),
    /// Any other payload, by its name.
    Other(&'static str),
}

impl FrameContract {
    /// The first difference between a frame and this contract.
    pub fn breach(&self, form: &FrameForm) -> Option<Breach> {
        if form.chunks.is_some() && self.chunk_room == 0 {
            return Some(Breach::Payload(Payload::WithChunks));
        }
        if let Some(breach) = form.image.and_then(|image| self.image_breach(&image)) {
            return Some(breach);
        }
        let (found, expected) = (form.bytes, self.sent_bytes());
        match form.chunks {
            None => (found != expected).then_some(Breach::Bytes { found, expected }),
            // Either condition shows that no packet was short: whole chunks, or as many bytes as the camera announced.
            Some(Chunks { first }) if first == Some(expected) => None,
            Some(Chunks { first: None }) if form.image.is_some() && found == self.received_bytes() => None,
            Some(Chunks { first }) => Some(Breach::Chunks { first, expected }),
        }
    }

    /// The first difference between an image and this contract.
    fn image_breach(&self, form: &ImageForm) -> Option<Breach> {
        let same = |found: (i32, i32), expected: (usize, usize)| {
            usize::try_from(found.0) == Ok(expected.0) && usize::try_from(found.1) == Ok(expected.1)
        };
        if form.pixel_format != self.pixel.code() {
            return Some(Breach::PixelFormat { found: form.pixel_format, expected: self.pixel });
        }
        let size = self.sent_size();
        if !same(form.size, size) {
            return Some(Breach::Size { found: form.size, expected: size });
        }
        if !same(form.offset, self.offset) {
            return Some(Breach::Offset { found: form.offset, expected: self.offset });
        }
        (form.padding != (0, 0)).then_some(Breach::Padding(form.padding.0, form.padding.1))
    }
}

/// Names of the formats that cameras have most often and no session records.
const OTHERS: [(u32, &str); 4] =
    [(0x0218_0014, "RGB8"), (0x0218_0015, "BGR8"), (0x0210_001f, "YUV422_8_UYVY"), (0x0210_0032, "YUV422_8")];

/// A pixel format's name, or its PFNC code where the name is not known here.
pub fn format_name(code: u32) -> String {
    let known = Pixel::GREY.into_iter().chain(Mosaic::ALL.map(Pixel::Bayer8));
    let known = known.map(|pixel| (pixel.code(), pixel.name())).chain(OTHERS);
    let mut named = known.filter(|(known, _)| *known == code);
    named.next().map_or_else(|| format!("pixel format {code:#010x}"), |(_, name)| name.to_owned())
}

impl fmt::Display for Breach {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Payload(Payload::WithChunks) => {
                f.write_str("it carries chunks beside the image, expected none")
            }
            Self::Payload(Payload::Parts(parts)) => write!(f, "it has {parts} parts, expected one image"),
            Self::Payload(Payload::Other(name)) => write!(f, "it is {name}, expected an image"),
            Self::PixelFormat { found, expected } => {
                write!(f, "its pixels are {}, expected {}", format_name(*found), expected.name())
            }
            Self::TooLarge(pixel) => write!(
                f,
                "it has values of more than {} bits, which {} has not: the camera may put them at the upper end of \
                 their \
                 bytes; set pixel to another format",
                pixel.depth(),
                pixel.name()
            ),
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
            Self::Chunks { first: Some(first), expected } => {
                write!(f, "its chunks begin with one of {first} bytes, expected its image of {expected}")
            }
            Self::Chunks { first: None, expected } => write!(
                f,
                "what follows its image of {expected} bytes is no whole row of chunks: a packet arrived short, or the \
                 camera \
                 counts them otherwise; switch its chunks off (ChunkModeActive)"
            ),
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
    use super::{Breach, Chunks, FrameContract, FrameForm, ImageForm, format_name};
    use crate::config::{Mosaic, Pixel};

    const CONTRACT: FrameContract =
        FrameContract { pixel: Pixel::Mono8, size: (320, 200), place: (0, 0), offset: (0, 8), chunk_room: 0 };

    const IMAGE: ImageForm =
        ImageForm { pixel_format: 0x0108_0001, size: (320, 200), offset: (0, 8), padding: (0, 0) };

    fn of(image: ImageForm) -> FrameForm {
        FrameForm { image: Some(image), chunks: None, bytes: 64_000 }
    }

    #[test]
    fn each_difference_is_a_breach_that_says_so() {
        assert_eq!(CONTRACT.breach(&of(IMAGE)), None);
        let cases = [
            (of(ImageForm { pixel_format: 0x0110_0007, ..IMAGE }), "Mono16"),
            (of(ImageForm { pixel_format: 0x0199_0099, ..IMAGE }), "0x01990099"),
            (of(ImageForm { size: (321, 200), ..IMAGE }), "321 x 200"),
            (of(ImageForm { size: (-1, 200), ..IMAGE }), "-1 x 200"),
            (of(ImageForm { offset: (8, 0), ..IMAGE }), "column 8, row 0"),
            (of(ImageForm { padding: (4, 0), ..IMAGE }), "4 bytes of padding"),
            (FrameForm { bytes: 63_972, ..of(IMAGE) }, "63972 bytes"),
            (FrameForm { bytes: 64_001, ..of(IMAGE) }, "more than the 64000 bytes"),
            (FrameForm { chunks: Some(Chunks { first: Some(64_000) }), ..of(IMAGE) }, "carries chunks"),
        ];
        for (form, words) in cases {
            let breach = CONTRACT.breach(&form).expect(words).to_string();
            assert!(breach.contains(words), "{breach}");
        }
        assert!(matches!(CONTRACT.breach(&FrameForm { bytes: 0, ..of(IMAGE) }), Some(Breach::Bytes { .. })));
        assert_eq!(format_name(0x0108_0009), "BayerRG8");
    }

    #[test]
    fn deeper_grey_has_its_own_format_and_bytes() {
        let deep = FrameContract { pixel: Pixel::Mono12p, ..CONTRACT };
        let twelve =
            FrameForm { bytes: 96_000, ..of(ImageForm { pixel_format: Pixel::Mono12p.code(), ..IMAGE }) };
        assert_eq!(deep.breach(&twelve), None);
        let text = deep.breach(&of(IMAGE)).expect("another format").to_string();
        assert!(text.contains("are Mono8, expected Mono12p"), "{text}");
        assert!(matches!(
            deep.breach(&FrameForm { bytes: 64_000, ..twelve }),
            Some(Breach::Bytes { expected: 96_000, .. })
        ));
    }

    #[test]
    fn a_plane_of_colour_is_a_quarter_of_what_is_sent() {
        let plane = FrameContract { pixel: Pixel::Bayer8(Mosaic::GB), place: (1, 0), ..CONTRACT };
        let form = |size, pixel_format| FrameForm {
            bytes: 256_000,
            ..of(ImageForm { pixel_format, size, ..IMAGE })
        };
        assert_eq!(plane.breach(&form((640, 400), 0x0108_000a)), None);
        assert!(matches!(plane.breach(&form((320, 200), 0x0108_000a)), Some(Breach::Size { .. })));
        // Its mosaic begins elsewhere than when it was set up.
        let text = plane.breach(&form((640, 400), 0x0108_0009)).expect("another format").to_string();
        assert!(text.contains("are BayerRG8, expected BayerGB8"), "{text}");
        assert!(plane.loss()[0].contains("(2u + 1, 2v + 0)"), "{:?}", plane.loss());
    }

    /// With room for chunks, chunks may follow the image: their own lengths, or all bytes, show that they are whole.
    #[test]
    fn chunks_are_taken_where_there_is_room_for_them() {
        let room = FrameContract { chunk_room: 24, ..CONTRACT };
        let with = |first, bytes| FrameForm { chunks: Some(Chunks { first }), bytes, ..of(IMAGE) };
        for good in [with(Some(64_000), 64_024), with(Some(64_000), 64_016), with(None, 64_024), of(IMAGE)] {
            assert_eq!(room.breach(&good), None, "{good:?}");
        }
        // A leader that names no image: the chunks alone show that there is one.
        let data = |first, bytes| FrameForm { image: None, ..with(first, bytes) };
        assert_eq!(room.breach(&data(Some(64_000), 64_024)), None);
        for bad in [with(Some(8), 64_024), with(None, 64_020), data(None, 64_024), data(Some(96_000), 64_024)]
        {
            assert!(matches!(room.breach(&bad), Some(Breach::Chunks { .. })), "{bad:?}");
        }
        let wrong =
            FrameForm { image: Some(ImageForm { size: (320, 100), ..IMAGE }), ..with(Some(64_000), 64_024) };
        assert!(matches!(room.breach(&wrong), Some(Breach::Size { .. })));
        let padded = FrameForm { bytes: 64_024, ..of(IMAGE) };
        assert!(matches!(room.breach(&padded), Some(Breach::Bytes { .. })), "the frame has no chunks");
    }
}
