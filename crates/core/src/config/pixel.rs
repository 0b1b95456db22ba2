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
    /// 8 bits.
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
    /// 16 bits.
    Mono16,
    /// 8 bits behind a mosaic of filters: of two columns and rows the pixels of one colour are taken, at half the size. Which
    /// pixels these are follows from what the camera calls it.
    Bayer8(Mosaic),
}

/// The colours of a mosaic's first row and second row, from the left.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum Mosaic {
    /// Green, red; blue, green.
    GR,
    /// Red, green; green, blue.
    #[default]
    RG,
    /// Green, blue; red, green.
    GB,
    /// Blue, green; green, red.
    BG,
}

impl Mosaic {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::GR, Self::RG, Self::GB, Self::BG];

    /// Column and row of a colour among two by two pixels. Of the two greens it is that of the first row.
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

impl Pixel {
    /// Those of grey, in the order in which a camera's is chosen: 8 bits, then by bytes, then by depth.
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

    /// Its word in a node file.
    pub fn word(self) -> &'static str {
        match self {
            Self::Mono8 => "mono8",
            Self::Mono10p => "mono10p",
            Self::Mono10Packed => "mono10packed",
            Self::Mono12p => "mono12p",
            Self::Mono12Packed => "mono12packed",
            Self::Mono10 => "mono10",
            Self::Mono12 => "mono12",
            Self::Mono14 => "mono14",
            Self::Mono16 => "mono16",
            Self::Bayer8(_) => "bayer8",
        }
    }

    /// Its name, as cameras and the PFNC write it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Mono8 => "Mono8",
            Self::Mono10p => "Mono10p",
            Self::Mono10Packed => "Mono10Packed",
            Self::Mono12p => "Mono12p",
            Self::Mono12Packed => "Mono12Packed",
            Self::Mono10 => "Mono10",
            Self::Mono12 => "Mono12",
            Self::Mono14 => "Mono14",
            Self::Mono16 => "Mono16",
            Self::Bayer8(Mosaic::GR) => "BayerGR8",
            Self::Bayer8(Mosaic::RG) => "BayerRG8",
            Self::Bayer8(Mosaic::GB) => "BayerGB8",
            Self::Bayer8(Mosaic::BG) => "BayerBG8",
        }
    }

    /// Its code in a leader.
    pub fn code(self) -> u32 {
        match self {
            Self::Mono8 => 0x0108_0001,
            Self::Mono10p => 0x010a_0046,
            Self::Mono10Packed => 0x010c_0004,
            Self::Mono12p => 0x010c_0047,
            Self::Mono12Packed => 0x010c_0006,
            Self::Mono10 => 0x0110_0003,
            Self::Mono12 => 0x0110_0005,
            Self::Mono14 => 0x0110_0025,
            Self::Mono16 => 0x0110_0007,
            Self::Bayer8(Mosaic::GR) => 0x0108_0008,
            Self::Bayer8(Mosaic::RG) => 0x0108_0009,
            Self::Bayer8(Mosaic::GB) => 0x0108_000a,
            Self::Bayer8(Mosaic::BG) => 0x0108_000b,
        }
    }

    /// Bits of its value.
    pub fn depth(self) -> usize {
        match self {
            Self::Mono8 | Self::Bayer8(_) => 8,
            Self::Mono10p | Self::Mono10Packed | Self::Mono10 => 10,
            Self::Mono12p | Self::Mono12Packed | Self::Mono12 => 12,
            Self::Mono14 => 14,
            Self::Mono16 => 16,
        }
    }

    /// Bits that it takes of a row.
    pub fn bits(self) -> usize {
        (self.code() >> 16 & 0xff) as usize
    }

    /// Bytes of so many pixels. Of the formats that pack them, rows that end within a byte are refused before.
    pub fn bytes(self, pixels: usize) -> usize {
        (pixels * self.bits()).div_ceil(8)
    }

    /// Columns, and rows, of the camera's image for one of the recording's.
    pub fn step(self) -> usize {
        if matches!(self, Self::Bayer8(_)) { 2 } else { 1 }
    }

    /// Bytes that a camera sends for an image of so many columns and rows of the recording.
    pub fn sent_bytes(self, (width, height): (usize, usize)) -> usize {
        self.bytes(width * height * self.step() * self.step())
    }

    /// Columns of whose multiples rows end with a byte.
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
