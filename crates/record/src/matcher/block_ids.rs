// SPDX-License-Identifier: MIT OR Apache-2.0
//! Block ids as a count: 16-bit ids run 1..=65535 and skip 0, 64-bit ids do not wrap.

use crate::base::ids::BlockId;

/// Steps of a 16-bit id before it repeats.
const CYCLE: u64 = 65_535;

/// The ids of one stream.
#[derive(Debug, Default)]
pub struct BlockIds {
    last: Option<u64>,
    /// An id beyond 16 bits was seen.
    wide: bool,
}

impl BlockIds {
    /// How many blocks after the last one `id` is: 1 for the next, 0 for a repeat, negative for an earlier one.
    /// `None` before the first. A narrow id further ahead than half its cycle counts as earlier.
    pub fn step(&self, id: BlockId) -> Option<i64> {
        Some(self.between(self.last?, id.0))
    }

    /// As [`Self::step`], between two ids of this stream.
    pub fn between(&self, from: u64, to: u64) -> i64 {
        if self.wide || from > CYCLE || to > CYCLE {
            return (i128::from(to) - i128::from(from)).clamp(i64::MIN.into(), i64::MAX.into()) as i64;
        }
        let ahead = (to + CYCLE - from) % CYCLE;
        if ahead > CYCLE / 2 { ahead as i64 - CYCLE as i64 } else { ahead as i64 }
    }

    /// Makes `id` the one that further steps are counted from.
    pub fn take(&mut self, id: BlockId) {
        self.wide |= id.0 > CYCLE;
        self.last = Some(id.0);
    }
}

#[cfg(test)]
mod tests {
    use super::BlockIds;
    use crate::base::ids::BlockId;
    use proptest::prelude::{prop_assert_eq, proptest};

    proptest! {
        #[test]
        fn steps_are_counted_across_the_wrap(first in 1u64..=65_535, step in -30_000i64..30_000) {
            let mut ids = BlockIds::default();
            ids.take(BlockId(first));
            let next = (first as i64 - 1 + step).rem_euclid(65_535) + 1;
            prop_assert_eq!(ids.step(BlockId(next as u64)), Some(step));
        }

        #[test]
        fn wide_ids_do_not_wrap(first in 65_536u64..u64::MAX / 4, step in -60_000i64..1 << 40) {
            let mut ids = BlockIds::default();
            ids.take(BlockId(first));
            prop_assert_eq!(ids.step(BlockId(first.saturating_add_signed(step))), Some(step));
        }
    }

    #[test]
    fn an_id_of_64_bits_may_pass_65535() {
        let mut ids = BlockIds::default();
        ids.take(BlockId(65_535));
        assert_eq!(ids.step(BlockId(65_536)), Some(1));
        ids.take(BlockId(65_536));
        assert_eq!(ids.step(BlockId(65_540)), Some(4));
    }
}
