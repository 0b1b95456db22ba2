// SPDX-License-Identifier: MIT OR Apache-2.0
//! Rounding of many numbers at once, through the bits of a float: a conversion has to care for numbers that are not
//! here, and keeps a loop from becoming vectors.

/// Adding this to a number of less than 2^22 rounds it to a whole one, in the low bits.
const ROUND: f32 = 12_582_912.0;

/// The nearest whole number of a number below 2^22; of two the even one.
#[inline(always)]
pub(crate) fn nearest(x: f32) -> f32 {
    (x + ROUND) - ROUND
}

/// The same as an integer; any for NaN.
#[inline(always)]
pub(crate) fn whole(x: f32) -> i32 {
    ((x + ROUND).to_bits() as i32).wrapping_sub(ROUND.to_bits() as i32)
}

/// The largest whole number that is not above a number below 2^22; any for NaN.
#[inline(always)]
pub(crate) fn floor(x: f32) -> i32 {
    whole(x) - i32::from(nearest(x) > x)
}

#[cfg(test)]
mod tests {
    use super::{floor, nearest, whole};
    use proptest::prelude::{prop_assert_eq, proptest};

    proptest! {
        #[test]
        fn numbers_are_rounded_as_the_library_does(x in -4e6f32..4e6) {
            prop_assert_eq!(nearest(x), x.round_ties_even());
            prop_assert_eq!(whole(x), x.round_ties_even() as i32);
            for x in [x, x.trunc(), x.trunc() + 0.5] {
                prop_assert_eq!(floor(x), x.floor() as i32);
            }
        }
    }
}
