//! Values of a row between its pixels, for many pixels at once and without gathers.
//!
//! The stages look left and right of each pixel by a share of the local period. That changes slowly along a row, so
//! that the whole part of the distance is the same for most pixels of a block, or one of two neighbours: the values
//! then lie side by side in memory, and only the fraction differs.

/// Pixels of a block.
pub(super) const LANES: usize = 32;

/// What a padded row has on each side, px: distances must be shorter by two.
pub(super) const PAD: usize = 32;

/// One value for each pixel of a block.
pub(super) type Lanes = [f32; LANES];

/// Adding this to a number of less than 2^22 rounds it to a whole one, in the low bits.
const ROUND: f32 = 12_582_912.0;

/// Makes `padded` a row of `width` values with [`PAD`] on each side, in the memory that it has.
pub(super) fn reserve(padded: &mut Vec<f32>, width: usize) {
    padded.resize(width + 2 * PAD + LANES, 0.0);
}

/// The block's part of a row that may end before the block does; 0 beyond.
#[inline(always)]
pub(super) fn load(row: &[f32], first: usize) -> Lanes {
    match row[first..].first_chunk() {
        Some(lanes) => *lanes,
        None => {
            let mut lanes = [0.0; LANES];
            lanes[..row.len() - first].copy_from_slice(&row[first..]);
            lanes
        }
    }
}

/// Writes the first `count` of a block's values to a row.
#[inline(always)]
pub(super) fn store(row: &mut [f32], first: usize, count: usize, lanes: &Lanes) {
    match row[first..].first_chunk_mut() {
        Some(all) if count == LANES => *all = *lanes,
        _ => row[first..first + count].copy_from_slice(&lanes[..count]),
    }
}

/// Distances for a block of periods: `share` of each; an unknown period (0) takes the largest of the block, so that
/// it does not spoil the others. None is longer than the padding allows.
#[inline(always)]
pub(super) fn distances(period: &Lanes, share: f32) -> Lanes {
    // Positive numbers are ordered as their bits are.
    let mut most = 0;
    for p in period {
        most = most.max(p.to_bits());
    }
    let most = f32::from_bits(most);
    let limit = (PAD - 2) as f32;
    let mut out = [0.0; LANES];
    for (out, &p) in out.iter_mut().zip(period) {
        let p = if p > 0.0 { p } else { most };
        *out = (p * share).clamp(-limit, limit);
    }
    out
}

/// Linear interpolation of `padded` at `first + i + distance[i]`, where `first` is the block's first pixel. NaN where
/// one of the two neighbours is NaN.
#[inline(always)]
pub(super) fn between(padded: &[f32], first: usize, distance: &Lanes) -> Lanes {
    let (mut whole, mut fraction) = ([0i32; LANES], [0f32; LANES]);
    for i in 0..LANES {
        // Half a pixel back, rounded: the pixel before. A tie may give the one before that, with a fraction of 1.
        let rounded = distance[i] - 0.5 + ROUND;
        whole[i] = rounded.to_bits() as i32 - ROUND.to_bits() as i32;
        fraction[i] = distance[i] - (rounded - ROUND);
    }
    let (mut least, mut most) = (whole[0], whole[0]);
    for &whole in &whole {
        (least, most) = (least.min(whole), most.max(whole));
    }
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

#[cfg(test)]
mod tests {
    use super::{LANES, PAD, between, distances, load};
    use proptest::prelude::{any, prop_assert, proptest};

    proptest! {
        #[test]
        fn values_between_pixels_are_those_of_the_definition(
            values in proptest::collection::vec(any::<u8>(), 200),
            first in 0usize..=136,
            start in -12.0f32..12.0,
            step in -0.4f32..0.4,
        ) {
            let mut padded = vec![0.0; PAD];
            padded.extend(values.iter().map(|&x| f32::from(x)));
            padded.resize(200 + 2 * PAD + LANES, 0.0);
            let distance = std::array::from_fn(|i| start + step * i as f32);
            let found = between(&padded, first, &distance);
            for i in 0..LANES {
                let x = (first + i) as f64 + f64::from(distance[i]);
                let at = |x: f64| if (0.0..200.0).contains(&x) { f64::from(values[x as usize]) } else { 0.0 };
                let (low, f) = (x.floor(), x - x.floor());
                let expected = (1.0 - f) * at(low) + f * at(low + 1.0);
                prop_assert!((f64::from(found[i]) - expected).abs() < 1e-3, "{} {expected}", found[i]);
            }
        }
    }

    #[test]
    fn unknown_periods_take_one_of_the_block() {
        let period = load(&[0.0, 12.0, 10.0], 0);
        assert_eq!(distances(&period, 0.5)[..4], [6.0, 6.0, 5.0, 6.0]);
    }
}
