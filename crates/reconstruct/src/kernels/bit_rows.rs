// SPDX-License-Identifier: MIT OR Apache-2.0
//! Rows of pixels as bits, 64 a word, so that one operation serves 64 pixels.

use std::ops::Range;

/// Pixels in a machine word: one bit each.
pub(crate) const WORD: usize = u64::BITS as usize;

/// A bit for each place for which `is` holds.
#[inline(always)]
pub(crate) fn bits_where(is: impl Fn(usize) -> bool) -> u64 {
    let mut marks = [0u8; WORD];
    for (i, mark) in marks.iter_mut().enumerate() {
        *mark = if is(i) { u8::MAX } else { 0 };
    }
    together(&marks)
}

/// A bit for each byte that has any of those of `mask`.
#[inline(always)]
pub(crate) fn bits_of(bytes: &[u8; WORD], mask: u8) -> u64 {
    bits_where(
        #[inline(always)]
        |i| bytes[i] & mask != 0,
    )
}

/// A bit for each byte above `level`.
#[inline(always)]
pub(crate) fn bits_above(bytes: &[u8; WORD], level: u8) -> u64 {
    bits_where(
        #[inline(always)]
        |i| bytes[i] > level,
    )
}

/// Whether no bit is set, or every one.
#[inline(always)]
pub(crate) fn even(word: u64) -> bool {
    word.wrapping_add(1) < 2
}

/// Sets the bits of some places.
#[inline(always)]
pub(crate) fn set(words: &mut [u64], places: Range<usize>) {
    let Some(last) = places.end.checked_sub(1).filter(|last| *last >= places.start) else { return };
    let first = places.start / WORD;
    for (k, word) in words[first..=last / WORD].iter_mut().enumerate() {
        let begin = (first + k) * WORD;
        let (from, to) = (places.start.saturating_sub(begin), (last - begin).min(WORD - 1));
        *word |= u64::MAX << from & u64::MAX >> (WORD - 1 - to);
    }
}

/// A bit for each byte of 255; all others are 0.
#[inline(always)]
fn together(marks: &[u8; WORD]) -> u64 {
    // There is an instruction for sixteen of them, which the compiler does not find.
    #[cfg(target_arch = "x86_64")]
    if let Some(sse2) = pulp::core_arch::x86::Sse2::try_new() {
        let mut bits = 0;
        for (k, [low, high]) in marks.as_chunks::<8>().0.as_chunks::<2>().0.iter().enumerate() {
            let sixteen = sse2._mm_set_epi64x(i64::from_le_bytes(*high), i64::from_le_bytes(*low));
            bits |= u64::from(sse2._mm_movemask_epi8(sixteen) as u16) << (16 * k);
        }
        return bits;
    }
    marks.iter().enumerate().fold(0, |bits, (i, &mark)| bits | u64::from(mark & 1) << i)
}

#[cfg(test)]
mod tests {
    use super::{WORD, bits_above, bits_of, set};
    use proptest::prelude::{any, prop_assert_eq, proptest};

    proptest! {
        #[test]
        fn places_are_set(start in 0usize..200, length in 0usize..200) {
            let mut words = [0u64; 7];
            set(&mut words, start..start + length);
            for i in 0..7 * WORD {
                prop_assert_eq!(words[i / WORD] >> (i % WORD) & 1 != 0, (start..start + length).contains(&i));
            }
        }

        #[test]
        fn each_byte_gives_its_bit(seed in proptest::collection::vec(any::<u8>(), WORD), mask in any::<u8>()) {
            let bytes: [u8; WORD] = std::array::from_fn(|i| seed[i]);
            let (any, above) = (bits_of(&bytes, mask), bits_above(&bytes, mask));
            for (i, byte) in bytes.into_iter().enumerate() {
                prop_assert_eq!(any >> i & 1 != 0, byte & mask != 0);
                prop_assert_eq!(above >> i & 1 != 0, byte > mask);
            }
        }
    }
}
