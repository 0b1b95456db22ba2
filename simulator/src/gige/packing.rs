// SPDX-License-Identifier: MIT OR Apache-2.0
//! The bytes of a row in each pixel format, made of 8-bit grey.
//!
//! The light has 8 bits. Of deeper grey they are the upper ones, and the lower ones follow from the pixel's place: a
//! receiver that rounds, or takes bits of a neighbour, has another picture.

/// How grey values that are deeper than 8 bits lie in a row.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Packing {
    /// In two bytes each, the lower one first.
    TwoBytes,
    /// Without a hole, the lowest bit first (PFNC).
    Bits,
    /// Two in three bytes (GigE Vision 1): upper 8 bits, the lower ones of both, upper 8 bits.
    Pairs,
}

/// Bits of a value, and how values lie; `None` for formats of 8 bits and those with colours.
fn deeper(format: u32) -> Option<(usize, Packing)> {
    Some(match format {
        0x0110_0003 => (10, Packing::TwoBytes),
        0x0110_0005 => (12, Packing::TwoBytes),
        0x0110_0025 => (14, Packing::TwoBytes),
        0x0110_0007 => (16, Packing::TwoBytes),
        0x010a_0046 => (10, Packing::Bits),
        0x010c_0047 => (12, Packing::Bits),
        0x010c_0004 => (10, Packing::Pairs),
        0x010c_0006 => (12, Packing::Pairs),
        _ => return None,
    })
}

/// Byte number `at` of the row `row` of `width` pixels that take `line` bytes; `grey` has the 8-bit value of a column.
pub fn byte(
    format: u32,
    at: usize,
    (row, width, line): (usize, usize, usize),
    grey: impl Fn(usize) -> u8,
) -> u8 {
    let Some((depth, packing)) = deeper(format) else {
        // Colours are all the same grey.
        return grey(at * width / line);
    };
    let lower = (1 << (depth - 8)) - 1;
    let value = |column: usize| {
        let below = (row.wrapping_mul(31).wrapping_add(column.wrapping_mul(17)).wrapping_add(5)) & lower;
        usize::from(grey(column)) << (depth - 8) | below
    };
    let byte = match packing {
        Packing::TwoBytes => value(at / 2) >> (at % 2 * 8),
        Packing::Bits => {
            let (column, from) = (at * 8 / depth, at * 8 % depth);
            value(column) >> from | value(column + 1) << (depth - from)
        }
        Packing::Pairs => {
            let first = at / 3 * 2;
            match at % 3 {
                0 => value(first) >> (depth - 8),
                1 => value(first) & lower | (value(first + 1) & lower) << 4,
                _ => value(first + 1) >> (depth - 8),
            }
        }
    };
    (byte & 0xff) as u8
}

#[cfg(test)]
mod tests {
    use super::byte;

    /// Two pixels, 0x12 and 0xab, whose lower bits are 5 and 22 as far as there are bits.
    #[test]
    fn each_format_has_the_bytes_of_its_standard() {
        let row = |format, line| -> Vec<u8> {
            (0..line).map(|at| byte(format, at, (0, 2, line), |column| [0x12, 0xab][column % 2])).collect()
        };
        assert_eq!(row(0x0108_0001, 2), [0x12, 0xab]);
        assert_eq!(row(0x0110_0003, 4), [0x49, 0x00, 0xae, 0x02]);
        assert_eq!(row(0x0110_0005, 4), [0x25, 0x01, 0xb6, 0x0a]);
        assert_eq!(row(0x0110_0007, 4), [0x05, 0x12, 0x16, 0xab]);
        assert_eq!(row(0x010c_0047, 3), [0x25, 0x61, 0xab]);
        assert_eq!(row(0x010c_0006, 3), [0x12, 0x65, 0xab]);
        assert_eq!(row(0x010c_0004, 3), [0x12, 0x21, 0xab]);
        // Of four pixels the first three bytes: 0x049, 0x2ae, and the beginning of the third.
        assert_eq!(row(0x010a_0046, 3)[..2], [0x49, 0xb8]);
        assert_eq!(row(0x0218_0014, 6), [0x12, 0x12, 0x12, 0xab, 0xab, 0xab]);
    }
}
