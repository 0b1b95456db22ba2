//! Rows of pixels as bits, 64 a word: what is asked of each pixel is asked of a word at once.

/// Pixels of a word.
pub(super) const WORD: usize = u64::BITS as usize;

/// The bits of bytes that are 0 or 1 each; bit i is byte i.
#[inline(always)]
pub(super) fn gathered(ones: &[u8; WORD]) -> u64 {
    gathered_from(ones, 0)
}

/// Bit `from` of each byte; bit i of the result is byte i's.
#[inline(always)]
pub(super) fn gathered_from(bytes: &[u8; WORD], from: u32) -> u64 {
    let mut out = 0;
    for (k, eight) in bytes.as_chunks::<8>().0.iter().enumerate() {
        let ones = u64::from_le_bytes(*eight) >> from & 0x0101_0101_0101_0101;
        // Bit i of the product's highest byte is byte i.
        out |= ones.wrapping_mul(0x0102_0408_1020_4080) >> 56 << (8 * k);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::{WORD, gathered, gathered_from};
    use proptest::prelude::{any, prop_assert_eq, proptest};

    proptest! {
        #[test]
        fn each_byte_gives_its_bit(seed in proptest::collection::vec(any::<u8>(), WORD), from in 0u32..8) {
            let bytes: [u8; WORD] = std::array::from_fn(|i| seed[i]);
            let ones = bytes.map(|byte| byte >> from & 1);
            let word = gathered_from(&bytes, from);
            prop_assert_eq!(gathered(&ones), word);
            for (i, one) in ones.into_iter().enumerate() {
                prop_assert_eq!(word >> i & 1, u64::from(one));
            }
        }
    }
}
