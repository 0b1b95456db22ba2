// SPDX-License-Identifier: MIT OR Apache-2.0
//! The forms of a pixel that cameras send: names and codes of the PFNC and of GigE Vision 1.

use super::rig::Channel;
use serde::{Deserialize, Serialize};

/// A form of a pixel that a session takes from its cameras. What is deeper than 8 bits is shifted to 8.
///
/// `...p` is the PFNC's packing, a row of bits that begins with the lowest; `...Packed` is GigE Vision's, two pixels in
/// three bytes of which the first and the last hold the upper 8 bits.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Pixel {
    #[default]
    Mono8,
    /// 10 bits, four pixels in five bytes.
    Mono10p,
    /// 10 bits, two pixels in three bytes.
    Mono10Packed,
    /// 12 bits, two pixels in three bytes.
    Mono12p,
    /// 12 bits, two pixels in three bytes.
    Mono12Packed,
    /// 10 bits in two bytes.
    Mono10,
    /// 12 bits in two bytes.
    Mono12,
    /// 14 bits in two bytes.
    Mono14,
    Mono16,
    /// 8 bits behind a mosaic of filters: of two columns and rows the pixels of one colour are taken, at half the
    /// size. Which pixels these are follows from what the camera calls it.
    Bayer8(Mosaic),
}

/// The colours of a mosaic's first row and second row, from the left.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum Mosaic {
    /// Green and red, below them blue and green.
    GR,
    /// Red and green, below them green and blue.
    #[default]
    RG,
    /// Green and blue, below them red and green.
    GB,
    /// Blue and green, below them green and red.
    BG,
}

impl Mosaic {
    pub const ALL: [Self; 4] = [Self::GR, Self::RG, Self::GB, Self::BG];

    /// Column and row, 0 or 1, of a colour in each square of two by two pixels. Of the two greens it is that of the
    /// first row.
    pub fn place(self, channel: Channel) -> (usize, usize) {
        let first = match self {
            Self::GR => [Channel::G, Channel::R],
            Self::RG => [Channel::R, Channel::G],
            Self::GB => [Channel::G, Channel::B],
            Self::BG => [Channel::B, Channel::G],
        };
        match first.iter().position(|colour| *colour == channel) {
            Some(column) => (column, 0),
            // What the first row lacks stands below its green.
            None => (usize::from(first[1] == Channel::G), 1),
        }
    }
}

/// The names and the depth of a form of a pixel.
struct Form {
    pixel: Pixel,
    word: &'static str,
    name: &'static str,
    code: u32,
    depth: usize,
}

const fn form(pixel: Pixel, word: &'static str, name: &'static str, code: u32, depth: usize) -> Form {
    Form { pixel, word, name, code, depth }
}

const FORMS: [Form; 13] = [
    form(Pixel::Mono8, "mono8", "Mono8", 0x0108_0001, 8),
    form(Pixel::Mono10p, "mono10p", "Mono10p", 0x010a_0046, 10),
    form(Pixel::Mono10Packed, "mono10packed", "Mono10Packed", 0x010c_0004, 10),
    form(Pixel::Mono12p, "mono12p", "Mono12p", 0x010c_0047, 12),
    form(Pixel::Mono12Packed, "mono12packed", "Mono12Packed", 0x010c_0006, 12),
    form(Pixel::Mono10, "mono10", "Mono10", 0x0110_0003, 10),
    form(Pixel::Mono12, "mono12", "Mono12", 0x0110_0005, 12),
    form(Pixel::Mono14, "mono14", "Mono14", 0x0110_0025, 14),
    form(Pixel::Mono16, "mono16", "Mono16", 0x0110_0007, 16),
    form(Pixel::Bayer8(Mosaic::GR), "bayer8", "BayerGR8", 0x0108_0008, 8),
    form(Pixel::Bayer8(Mosaic::RG), "bayer8", "BayerRG8", 0x0108_0009, 8),
    form(Pixel::Bayer8(Mosaic::GB), "bayer8", "BayerGB8", 0x0108_000a, 8),
    form(Pixel::Bayer8(Mosaic::BG), "bayer8", "BayerBG8", 0x0108_000b, 8),
];

impl Pixel {
    /// The grey forms, in the order in which one is chosen of those that a camera has: 8 bits first, then by bytes,
    /// then by depth.
    pub const GREY: [Self; 9] = [
        Self::Mono8,
        Self::Mono10p,
        Self::Mono10Packed,
        Self::Mono12p,
        Self::Mono12Packed,
        Self::Mono10,
        Self::Mono12,
        Self::Mono14,
        Self::Mono16,
    ];

    fn form(self) -> &'static Form {
        FORMS.iter().find(|form| form.pixel == self).unwrap_or(&FORMS[0])
    }

    /// Its word in a node file.
    pub fn word(self) -> &'static str {
        self.form().word
    }

    /// Its name, as cameras and the PFNC write it.
    pub fn name(self) -> &'static str {
        self.form().name
    }

    /// Its code in the leader of a GVSP frame.
    pub fn code(self) -> u32 {
        self.form().code
    }

    /// Bits of its value, 8 to 16.
    pub fn depth(self) -> usize {
        self.form().depth
    }

    /// Bits of a row that a pixel takes, with its padding.
    pub fn bits(self) -> usize {
        (self.code() >> 16 & 0xff) as usize
    }

    /// Bytes of this number of pixels. Where a format packs pixels, rows that end within a byte are refused earlier.
    pub fn bytes(self, pixels: usize) -> usize {
        (pixels * self.bits()).div_ceil(8)
    }

    /// Columns of the camera's image for each column of the recording, and likewise rows: 2 behind a mosaic, else 1.
    pub fn step(self) -> usize {
        if matches!(self, Self::Bayer8(_)) { 2 } else { 1 }
    }

    /// Bytes that a camera sends for a recorded image of this width and height.
    pub fn sent_bytes(self, (width, height): (usize, usize)) -> usize {
        self.bytes(width * height * self.step() * self.step())
    }

    /// Rows of a multiple of this number of columns end with a whole byte.
    pub fn columns_step(self) -> usize {
        match self.bits() {
            10 => 4,
            12 => 2,
            _ => 1,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{Channel, Mosaic};

    #[test]
    fn each_colour_has_its_place_in_each_mosaic() {
        for (mosaic, colours) in
            [(Mosaic::GR, "GRBG"), (Mosaic::RG, "RGGB"), (Mosaic::GB, "GBRG"), (Mosaic::BG, "BGGR")]
        {
            for (channel, letter) in [(Channel::R, 'R'), (Channel::G, 'G'), (Channel::B, 'B')] {
                let first = colours.find(letter).expect("there");
                assert_eq!(mosaic.place(channel), (first % 2, first / 2), "{mosaic:?} {channel:?}");
            }
        }
    }
}
