// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a frame comes to before geometry: absolute phase and light of the pixels that are known, in whole steps.
//!
//! Points and normals follow from it and the calibration alone, so that it is all that has to be stored
//! (`crate::export::compact`). The pipeline itself makes its clouds from a phase map: a cloud made when a stored map
//! is read has the same bytes.

/// Steps of the absolute phase in one fringe. A step is 0.005 mm of depth where a fringe is 40 mm: the rounding adds
/// less than a thousandth to the variance of 0.05 mm.
pub const STEPS_PER_FRINGE: f32 = 8192.0;

/// Steps of light in one level (DN) of the image.
pub const STEPS_PER_LEVEL: f32 = 4.0;

/// A stretch of known pixels of one row.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Run {
    pub row: u16,
    /// First column in the frame.
    pub first: u16,
    /// The number of pixels, at least 1.
    pub length: u16,
}

impl Run {
    /// The column after its last.
    pub fn end(&self) -> usize {
        usize::from(self.first) + usize::from(self.length)
    }
}

/// The known pixels of a frame: runs row by row from left to right, and an entry for each of their pixels in that
/// order.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct PhaseMap {
    /// Columns and rows of the frame.
    pub frame: [u16; 2],
    /// Where the pixels are. Runs of a row neither touch nor overlap.
    pub runs: Vec<Run>,
    /// Absolute phase, in fringes times [`STEPS_PER_FRINGE`].
    pub phase: Vec<i32>,
    /// Light over one fringe, DN times [`STEPS_PER_LEVEL`].
    pub light: Vec<u16>,
    /// Standard uncertainty of the phase ([`encode_sigma`]); empty without `--uncertainty`.
    pub sigma_code: Vec<u8>,
}

impl PhaseMap {
    /// Column and row of each pixel, in the order of [`Self::phase`].
    pub fn pixels(&self) -> impl Iterator<Item = [u16; 2]> {
        self.runs.iter().flat_map(|run| (0..run.length).map(|i| [run.first + i, run.row]))
    }
}

/// Bits of the least standard uncertainty that its code can state: 0.0001 rad.
const LEAST_SIGMA: u32 = 0x38d1_b717;

/// Bits of a float below those that its code keeps: 16 steps in an octave.
const SIGMA_SHIFT: u32 = 19;

/// A standard uncertainty of phase, rad, as a byte: 16 steps in every factor of two from 0.0001 to 6 rad.
#[inline(always)]
pub fn encode_sigma(rad: f32) -> u8 {
    // The bits of a positive float grow with it, nearly as its logarithm.
    let above = rad.to_bits().saturating_sub(LEAST_SIGMA) + (1 << (SIGMA_SHIFT - 1));
    (above >> SIGMA_SHIFT).min(255) as u8
}

/// The standard uncertainty that a byte stands for, rad.
#[inline(always)]
pub fn decode_sigma(sigma_code: u8) -> f32 {
    f32::from_bits(LEAST_SIGMA + (u32::from(sigma_code) << SIGMA_SHIFT))
}

#[cfg(test)]
mod tests {
    use super::{decode_sigma, encode_sigma};

    #[test]
    fn a_byte_of_doubt_is_within_three_per_cent() {
        for i in 0..1000 {
            let rad = 1.1e-4 * 1.01f32.powi(i);
            if rad < 6.0 {
                assert!((decode_sigma(encode_sigma(rad)) / rad - 1.0).abs() < 0.032, "{rad}");
            }
        }
        assert_eq!((encode_sigma(0.0), encode_sigma(f32::INFINITY)), (0, 255));
        assert!((0..=255).all(|x| encode_sigma(decode_sigma(x)) == x));
    }
}
