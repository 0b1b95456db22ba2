//! Values of a row between its pixels, for many pixels at once and without gathers.
//!
//! The stages look left and right of each pixel by a share of the local period. That changes slowly along a row, so
//! that the whole part of the distance is the same for most pixels of a block, or one of two neighbours: the values
//! then lie side by side in memory, and only the fraction differs.

use super::round::{nearest, whole};

/// Pixels of a block.
pub(super) const LANES: usize = 32;

/// What a padded row has on each side, px: distances must be shorter by two.
pub(super) const PAD: usize = 32;

/// One value for each pixel of a block.
pub(super) type Lanes = [f32; LANES];

/// Makes `padded` a row of `width` values with [`PAD`] on each side, in the memory that it has.
pub(super) fn reserve(padded: &mut Vec<f32>, width: usize) {
    padded.resize(width + 2 * PAD + LANES, 0.0);
}

/// The block's part of a row that may end before the block does; 0 beyond.
#[inline(always)]
pub(super) fn load<T: Copy + Default>(row: &[T], first: usize) -> [T; LANES] {
    part(row, first, T::default())
}

/// Some values of a row from `first` on, and `beyond` behind its end.
#[inline(always)]
pub(super) fn part<T: Copy, const N: usize>(row: &[T], first: usize, beyond: T) -> [T; N] {
    match row[first..].first_chunk() {
        Some(part) => *part,
        None => {
            let mut part = [beyond; N];
            part[..row.len() - first].copy_from_slice(&row[first..]);
            part
        }
    }
}

/// Writes the first `count` of a block's values to a row.
#[inline(always)]
pub(super) fn store<T: Copy>(row: &mut [T], first: usize, count: usize, lanes: &[T; LANES]) {
    match row[first..].first_chunk_mut() {
        Some(all) if count == LANES => *all = *lanes,
        // A choice for each: a copy of so many would be a call.
        Some(all) => {
            for i in 0..LANES {
                all[i] = if i < count { lanes[i] } else { all[i] };
            }
        }
        None => row[first..first + count].copy_from_slice(&lanes[..count]),
    }
}

/// The periods of a block; an unknown one (0) is the largest of the block, so that it does not spoil the others.
pub(super) struct Periods {
    lanes: Lanes,
    /// Smallest and largest: they tell how far the distances go, whatever the share, without a look at each again.
    least: f32,
    most: f32,
}

impl Periods {
    #[inline(always)]
    pub(super) fn new(period: &Lanes) -> Self {
        // Positive numbers are ordered as their bits are.
        let mut most = 0;
        for p in period {
            most = most.max(p.to_bits());
        }
        let most = f32::from_bits(most);
        let (mut lanes, mut least) = ([0.0; LANES], most.to_bits());
        for (lane, &p) in lanes.iter_mut().zip(period) {
            *lane = if p > 0.0 { p } else { most };
            least = least.min(lane.to_bits());
        }
        Self { lanes, least: f32::from_bits(least), most }
    }
}

/// `share` of a period and `more` px, but not further than the padding allows.
#[inline(always)]
fn distance(period: f32, share: f32, more: f32) -> f32 {
    let limit = (PAD - 2) as f32;
    (period * share).clamp(-limit, limit) + more
}

/// The pixel before a distance and how far it is from there. (Half a pixel back, rounded. A tie may give the pixel before
/// that, with a fraction of 1.)
#[inline(always)]
fn parts(distance: f32) -> (i32, f32) {
    (whole(distance - 0.5), distance - nearest(distance - 0.5))
}

/// Linear interpolation of `padded` at the distance of `share` of its period and `more` px from each pixel of the block
/// that begins at `first`. NaN where one of the two neighbours is NaN.
#[inline(always)]
pub(super) fn between(padded: &[f32], first: usize, periods: &Periods, share: f32, more: f32) -> Lanes {
    let (mut whole, mut fraction) = ([0i32; LANES], [0f32; LANES]);
    for i in 0..LANES {
        (whole[i], fraction[i]) = parts(distance(periods.lanes[i], share, more));
    }
    // Nothing on the way from a period to its whole pixels changes the order.
    let ends = if share < 0.0 { [periods.most, periods.least] } else { [periods.least, periods.most] };
    let [least, most] = ends.map(|period| parts(distance(period, share, more)).0);
    let mut out = [0.0; LANES];
    let base = (first + PAD).wrapping_add_signed(least as isize);
    if most - least <= 1 {
        let values = &padded[base..base + LANES + 2];
        for i in 0..LANES {
            // Bits, because the compiler makes a gather of a choice between two places in memory.
            let next = if whole[i] == least { 0 } else { u32::MAX };
            let choose = |a: f32, b: f32| f32::from_bits(a.to_bits() & !next | b.to_bits() & next);
            let (a, b) = (choose(values[i], values[i + 1]), choose(values[i + 1], values[i + 2]));
            out[i] = a + fraction[i] * (b - a);
        }
    } else {
        for i in 0..LANES {
            let at = base + i + (whole[i] - least) as usize;
            let (a, b) = (padded[at], padded[at + 1]);
            out[i] = a + fraction[i] * (b - a);
        }
    }
    out
}

/// [`between`] before and behind each pixel, at the distance of `share` of its period, of a row of whole numbers, finite
/// everywhere. A line through the first two of three values, and what the second line is steeper: no pixel has to choose.
#[inline(always)]
pub(super) fn both_sides(padded: &[f32], first: usize, periods: &Periods, share: f32) -> [Lanes; 2] {
    let least = parts(distance(periods.least, share, 0.0)).0;
    let most = parts(distance(periods.most, share, 0.0)).0;
    if most - least > 1 {
        return [between(padded, first, periods, -share, 0.0), between(padded, first, periods, share, 0.0)];
    }
    let base = first + PAD;
    let (low, offset) = (least as usize, least as f32);
    let values_behind = &padded[base + low..base + low + LANES + 2];
    let values_before = &padded[base - low - 2..base - low + LANES];
    let [mut before, mut behind] = [[0f32; LANES]; 2];
    for i in 0..LANES {
        let along = distance(periods.lanes[i], share, 0.0) - offset;
        let [a, b, c] = [values_behind[i], values_behind[i + 1], values_behind[i + 2]];
        behind[i] = bent(along, [a, b, c]);
        let [a, b, c] = [values_before[i], values_before[i + 1], values_before[i + 2]];
        before[i] = bent(2.0 - along, [a, b, c]);
    }
    [before, behind]
}

/// The value at 0..2 of three at 0, 1 and 2.
#[inline(always)]
fn bent(at: f32, [a, b, c]: [f32; 3]) -> f32 {
    let first = if at < 1.0 { at } else { 1.0 };
    a + first * (b - a) + (at - first) * (c - b)
}

#[cfg(test)]
mod tests {
    use super::{LANES, PAD, Periods, between, both_sides, load};
    use proptest::prelude::{any, prop_assert, proptest};

    proptest! {
        #[test]
        fn values_between_pixels_are_those_of_the_definition(
            values in proptest::collection::vec(any::<u8>(), 200),
            first in 0usize..=136,
            start in 2.0f32..24.0,
            step in -0.8f32..0.8,
            share in -0.5f32..0.5,
            more in 0f32..0.5,
        ) {
            let mut padded = vec![0.0; PAD];
            padded.extend(values.iter().map(|&x| f32::from(x)));
            padded.resize(200 + 2 * PAD + LANES, 0.0);
            let period = std::array::from_fn(|i| (start + step * i as f32).max(1.0));
            let found = between(&padded, first, &Periods::new(&period), share, more);
            for i in 0..LANES {
                let x = (first + i) as f64 + f64::from(period[i] * share + more);
                let at = |x: f64| if (0.0..200.0).contains(&x) { f64::from(values[x as usize]) } else { 0.0 };
                let (low, f) = (x.floor(), x - x.floor());
                let expected = (1.0 - f) * at(low) + f * at(low + 1.0);
                prop_assert!((f64::from(found[i]) - expected).abs() < 1e-3, "{} {expected}", found[i]);
            }
        }
    }

    proptest! {
        #[test]
        fn both_sides_are_those_of_each(
            values in proptest::collection::vec(any::<u8>(), 200),
            first in 0usize..=136,
            start in 2.0f32..24.0,
            step in -0.4f32..0.4,
            sixths in 1u8..=3,
        ) {
            let mut padded = vec![0.0; PAD];
            padded.extend(values.iter().map(|&x| f32::from(x)));
            padded.resize(200 + 2 * PAD + LANES, 0.0);
            let periods = Periods::new(&std::array::from_fn(|i| (start + step * i as f32).max(1.0)));
            let share = f32::from(sixths) / 6.0;
            let [before, behind] = both_sides(&padded, first, &periods, share);
            for (found, share) in [(before, -share), (behind, share)] {
                // From the other of both neighbours: the last bits differ.
                for (x, alone) in found.iter().zip(between(&padded, first, &periods, share, 0.0)) {
                    prop_assert!((x - alone).abs() < 1e-3, "{x} {alone}");
                }
            }
        }
    }

    #[test]
    fn unknown_periods_take_one_of_the_block() {
        let periods = Periods::new(&load(&[0.0, 12.0, 10.0], 0));
        assert_eq!(periods.lanes[..4], [12.0, 12.0, 10.0, 12.0]);
        assert_eq!((periods.least, periods.most), (10.0, 12.0));
    }
}
