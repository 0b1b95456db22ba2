// SPDX-License-Identifier: MIT OR Apache-2.0
//! Conversion of grey values deeper than 8 bits to 8 bits, in the memory that they were received into.
//!
//! No pixel format has less than a byte per pixel, so the result overwrites only bytes that have been read already.
//! No second pool is needed, and the writer finds the image where that of an 8-bit camera is.

use crate::config::Pixel;

/// Pixels of one step: they fit into the first-level cache, and are a whole number of groups in any format.
const STEP: usize = 2048;

/// Shifts `count` pixels at the beginning of `memory` to a byte each. Gives the bits above the format's depth that
/// are set in any value; they must be 0.
pub fn unpack(pixel: Pixel, memory: &mut [u8], count: usize) -> u16 {
    let mut read = [0; 2 * STEP];
    let mut seen = 0;
    if matches!(pixel, Pixel::Mono8 | Pixel::Bayer8(_)) || memory.len() < pixel.bytes(count) {
        return 0;
    }
    for at in (0..count).step_by(STEP) {
        let pixels = STEP.min(count - at);
        let (from, bytes) = (pixel.bytes(at), pixel.bytes(pixels));
        read[..bytes].copy_from_slice(&memory[from..from + bytes]);
        seen |= narrow(pixel, &read[..bytes], &mut memory[at..at + pixels]);
    }
    // A format of 16 bits has no bits above its depth.
    seen.checked_shr(pixel.depth() as u32).unwrap_or(0)
}

/// Keeps one pixel of each two by two of an 8-bit image: the one at column and row `place`. `size` is that of the
/// result, which overwrites the beginning of the memory.
pub fn take_plane(memory: &mut [u8], (width, height): (usize, usize), (column, row): (usize, usize)) {
    let mut read = [0; 2 * STEP];
    if memory.len() < 4 * width * height {
        return;
    }
    for v in 0..height {
        for at in (0..width).step_by(STEP) {
            let pixels = STEP.min(width - at);
            let from = (2 * v + row) * 2 * width + 2 * at;
            read[..2 * pixels].copy_from_slice(&memory[from..from + 2 * pixels]);
            let to = v * width + at;
            for (to, from) in memory[to..to + pixels].iter_mut().zip(read.chunks_exact(2)) {
                *to = from[column];
            }
        }
    }
}

/// Writes the upper 8 bits of each value; gives the bits that are set in any value of two bytes.
fn narrow(pixel: Pixel, read: &[u8], image: &mut [u8]) -> u16 {
    match pixel {
        // These have a byte per pixel already.
        Pixel::Mono8 | Pixel::Bayer8(_) => {}
        // Values without gaps, the lowest bit first: four in five bytes.
        Pixel::Mono10p => {
            for (to, from) in image.chunks_exact_mut(4).zip(read.chunks_exact(5)) {
                to[0] = from[0] >> 2 | from[1] << 6;
                to[1] = from[1] >> 4 | from[2] << 4;
                to[2] = from[2] >> 6 | from[3] << 2;
                to[3] = from[4];
            }
        }
        Pixel::Mono12p => {
            for (to, from) in image.chunks_exact_mut(2).zip(read.chunks_exact(3)) {
                to[0] = from[0] >> 4 | from[1] << 4;
                to[1] = from[2];
            }
        }
        // The byte in the middle holds the lower bits of both values.
        Pixel::Mono10Packed | Pixel::Mono12Packed => {
            for (to, from) in image.chunks_exact_mut(2).zip(read.chunks_exact(3)) {
                to[0] = from[0];
                to[1] = from[2];
            }
        }
        Pixel::Mono10 | Pixel::Mono12 | Pixel::Mono14 | Pixel::Mono16 => {
            let shift = pixel.depth() - 8;
            let mut seen = 0;
            for (to, from) in image.iter_mut().zip(read.chunks_exact(2)) {
                let value = u16::from_le_bytes([from[0], from[1]]);
                seen |= value;
                *to = (value >> shift) as u8;
            }
            return seen;
        }
    }
    0
}

#[cfg(test)]
mod tests {
    use super::{take_plane, unpack};
    use crate::config::Pixel;
    use proptest::prelude::*;

    /// Values as the standards have them, bit by bit.
    fn pack(pixel: Pixel, values: &[u16]) -> Vec<u8> {
        let depth = pixel.depth();
        let mut bytes = vec![0; pixel.bytes(values.len())];
        for (i, value) in values.iter().enumerate() {
            for bit in (0..depth).filter(|bit| value >> bit & 1 == 1) {
                let at = match pixel {
                    // GigE Vision: the upper 8 bits in a byte of their own, the others in the one in the middle, of
                    // which the first pixel has the lower half.
                    Pixel::Mono10Packed | Pixel::Mono12Packed => {
                        let (pair, second) = (i / 2 * 24, i % 2);
                        match bit.checked_sub(depth - 8) {
                            Some(upper) => pair + 16 * second + upper,
                            None => pair + 8 + 4 * second + bit,
                        }
                    }
                    // PFNC: from the lowest bit on, without a hole; or each value in bytes of its own.
                    _ => i * pixel.bits() + bit,
                };
                bytes[at / 8] |= 1 << (at % 8);
            }
        }
        bytes
    }

    /// Values 0x3f1 and 0x0a2 (10 bits), 0xf12 and 0x0a3 (12), as in the figures of the standards.
    #[test]
    fn each_format_has_the_bytes_of_its_standard() {
        let ten = [0x3f1, 0x0a2, 0x155, 0x200];
        let twelve = [0xf12, 0x0a3, 0x555, 0x800];
        /// Values, their bytes, and the resulting image.
        type Case<'a> = (Pixel, &'a [u16], &'a [u8], &'a [u8]);
        let cases: [Case<'_>; 9] = [
            (Pixel::Mono8, &[0xf1, 0x0a], &[0xf1, 0x0a], &[0xf1, 0x0a]),
            (Pixel::Mono10p, &ten, &[0xf1, 0x8b, 0x52, 0x15, 0x80], &[0xfc, 0x28, 0x55, 0x80]),
            (Pixel::Mono10Packed, &ten, &[0xfc, 0x21, 0x28, 0x55, 0x01, 0x80], &[0xfc, 0x28, 0x55, 0x80]),
            (Pixel::Mono12p, &twelve, &[0x12, 0x3f, 0x0a, 0x55, 0x05, 0x80], &[0xf1, 0x0a, 0x55, 0x80]),
            (Pixel::Mono12Packed, &twelve, &[0xf1, 0x32, 0x0a, 0x55, 0x05, 0x80], &[0xf1, 0x0a, 0x55, 0x80]),
            (Pixel::Mono10, &ten[..2], &[0xf1, 0x03, 0xa2, 0x00], &[0xfc, 0x28]),
            (Pixel::Mono12, &twelve[..2], &[0x12, 0x0f, 0xa3, 0x00], &[0xf1, 0x0a]),
            (Pixel::Mono14, &[0x3f12, 0x00c0], &[0x12, 0x3f, 0xc0, 0x00], &[0xfc, 0x03]),
            (Pixel::Mono16, &[0xf123, 0x0aff], &[0x23, 0xf1, 0xff, 0x0a], &[0xf1, 0x0a]),
        ];
        for (pixel, values, packed, image) in cases {
            assert_eq!(pack(pixel, values), packed, "{pixel:?}");
            let mut memory = packed.to_vec();
            assert_eq!(unpack(pixel, &mut memory, values.len()), 0, "{pixel:?}");
            assert_eq!(&memory[..values.len()], image, "{pixel:?}");
        }
    }

    proptest! {
        #[test]
        fn what_was_packed_comes_back_without_its_lower_bits(
            pixel in prop::sample::select(Pixel::GREY.to_vec()),
            values in prop::collection::vec(any::<u16>(), 0..9000),
            behind in 0usize..20,
        ) {
            let depth = pixel.depth();
            let whole = values.len() / 4 * 4;
            let values: Vec<u16> = values[..whole].iter().map(|value| value >> (16 - depth)).collect();
            let mut memory = pack(pixel, &values);
            memory.extend(vec![0x5a; behind]);
            prop_assert_eq!(unpack(pixel, &mut memory, whole), 0);
            let expected: Vec<u8> = values.iter().map(|value| (value >> (depth - 8)) as u8).collect();
            prop_assert_eq!(&memory[..whole], &expected[..]);
            prop_assert!(memory.ends_with(&vec![0x5a; behind]), "what lies behind the image is not touched");
        }
    }

    proptest! {
        #[test]
        fn a_plane_is_every_second_pixel_of_every_second_row(
            width in 1usize..5000, height in 1usize..6, column in 0usize..2, row in 0usize..2, seed: u8,
        ) {
            let value = |u: usize, v: usize| (u * 7 + v * 31 + u / 256 + usize::from(seed)) as u8;
            let mut memory: Vec<u8> =
                (0..4 * width * height).map(|at| value(at % (2 * width), at / (2 * width))).collect();
            take_plane(&mut memory, (width, height), (column, row));
            for (at, found) in memory[..width * height].iter().enumerate() {
                prop_assert_eq!(*found, value(2 * (at % width) + column, 2 * (at / width) + row));
            }
        }
    }

    #[test]
    fn values_that_are_too_large_are_seen_and_memory_that_is_too_short_is_left_alone() {
        // A 12-bit value at the upper end of its two bytes, as some cameras have it.
        let mut memory = vec![0x20, 0xf1, 0, 0];
        assert_eq!(unpack(Pixel::Mono12, &mut memory, 2), 0xf);
        let mut memory = vec![1, 2, 3];
        assert_eq!(unpack(Pixel::Mono16, &mut memory, 2), 0);
        assert_eq!(memory, [1, 2, 3]);
    }

    /// Prints the time that each format takes per frame.
    #[test]
    #[ignore = "prints figures and judges none: cargo test --release --lib unpack -- --ignored --nocapture"]
    fn cost_per_frame() {
        const PIXELS: usize = 1920 * 1200;
        for pixel in &Pixel::GREY[1..] {
            // More than the caches hold, as in a session.
            let mut blocks: Vec<Vec<u8>> = (0..32).map(|_| vec![1; pixel.bytes(PIXELS)]).collect();
            let begin = std::time::Instant::now();
            blocks.iter_mut().for_each(|block| assert_eq!(unpack(*pixel, block, PIXELS), 0));
            let per_frame = begin.elapsed().as_micros() / blocks.len() as u128;
            println!("{}: {per_frame} us for a frame of 1920 x 1200", pixel.name());
        }
    }
}
