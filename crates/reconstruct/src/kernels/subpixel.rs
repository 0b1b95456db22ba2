// SPDX-License-Identifier: MIT OR Apache-2.0
//! Values of a row between its pixels, for many pixels at once and without gathers.
//!
//! The stages look left and right of each pixel by a share of the local period. That changes slowly along a row, so
//! that the whole part of the distance is the same for most pixels of a block, or one of two neighbours: the values
//! then lie side by side in memory, and only the fraction differs.

use super::fast_round::{nearest, whole};
use std::hint::black_box;

/// Pixels of a block: what is worked on at once.
pub(crate) const LANES: usize = 32;

/// What a padded row has on each side, px: distances must be shorter by two.
pub(crate) const PAD: usize = 32;

/// One value for each pixel of a block.
pub(crate) type Lanes = [f32; LANES];

/// The place of each pixel in a block. (A conversion of the counter would be one pixel at a time.)
pub(crate) const PLACES: Lanes = {
    let mut places = [0.0; LANES];
    let mut i = 0;
    while i < LANES {
        places[i] = i as f32;
        i += 1;
    }
    places
};

/// Makes `padded` a row of `width` values with [`PAD`] on each side, in the memory that it has.
pub(crate) fn reserve(padded: &mut Vec<f32>, width: usize) {
    padded.resize(width + 2 * PAD + LANES, 0.0);
}

/// The block's part of a row that may end before the block does; 0 beyond.
#[inline(always)]
pub(crate) fn load<T: Copy + Default>(row: &[T], first: usize) -> [T; LANES] {
    part(row, first, T::default())
}

/// Some values of a row from `first` on, and `beyond` behind its end.
#[inline(always)]
pub(crate) fn part<T: Copy, const N: usize>(row: &[T], first: usize, beyond: T) -> [T; N] {
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
pub(crate) fn store<T: Copy>(row: &mut [T], first: usize, count: usize, lanes: &[T; LANES]) {
    match row[first..].first_chunk_mut() {
        Some(all) if count == LANES => *all = *lanes,
        // A choice for each: a copy of unknown length would be a call.
        Some(all) => {
            for i in 0..LANES {
                all[i] = if i < count { lanes[i] } else { all[i] };
            }
        }
        None => row[first..first + count].copy_from_slice(&lanes[..count]),
    }
}

/// Some values of a row that has room for them ([`reserve`], [`with_room`]).
#[inline(always)]
pub(crate) fn chunk<T, const N: usize>(row: &[T], first: usize) -> &[T; N] {
    row[first..].first_chunk().expect("a row with room behind its end")
}

/// Writes a whole block to a row, or what fits of it. Values beyond the run are unused, or written again later.
#[inline(always)]
pub(crate) fn put<T: Copy, const N: usize>(row: &mut [T], first: usize, lanes: &[T; N]) {
    let row = &mut row[first..];
    match row.first_chunk_mut() {
        Some(all) => *all = *lanes,
        None => put_end(row, lanes),
    }
}

/// Apart, because the compiler would make one copy of both cases, of a length that it does not know: a call.
#[cold]
#[inline(never)]
fn put_end<T: Copy, const N: usize>(row: &mut [T], lanes: &[T; N]) {
    row.copy_from_slice(&lanes[..row.len()]);
}

/// The same for values that are computed one by one. They are written to their place directly: loading them from the
/// stack in other widths than they were stored in would stall the processor.
#[inline(always)]
pub(crate) fn put_each<T>(row: &mut [T], first: usize, value: impl Fn(usize) -> T) {
    let row = &mut row[first..];
    if let Some(all) = row.first_chunk_mut::<LANES>() {
        for (i, out) in all.iter_mut().enumerate() {
            *out = value(i);
        }
    } else {
        for (i, out) in row.iter_mut().enumerate() {
            *out = value(i);
        }
    }
}

/// Fills a row with zeros: `width` of them, and a block behind its end.
pub(crate) fn with_room(row: &mut Vec<f32>, width: usize) {
    row.clear();
    row.resize(width + LANES, 0.0);
}

/// The periods of a block; an unknown one (0) is the largest of the block, so that it does not spoil the others.
pub(crate) struct Periods {
    lanes: Lanes,
    /// The smallest and the largest of them: the range of the distances at any share follows from these two.
    least: f32,
    most: f32,
}

impl Periods {
    #[inline(always)]
    pub(crate) fn new(period: &Lanes) -> Self {
        // Half of it has to lie within the padding. Positive numbers are ordered as their bits are.
        const LONGEST: f32 = 2.0 * (PAD - 2) as f32;
        let mut most = 0;
        for p in period {
            most = most.max(p.to_bits());
        }
        let most = f32::from_bits(most).min(LONGEST);
        let (mut lanes, mut least) = ([0.0; LANES], most.to_bits());
        for i in 0..LANES {
            let known = if period[i] > 0.0 { period[i] } else { most };
            lanes[i] = if known < most { known } else { most };
        }
        for lane in &lanes {
            least = least.min(lane.to_bits());
        }
        Self { lanes, least: f32::from_bits(least), most }
    }
}

/// `share` of a period, of at most a half, and `more` px.
#[inline(always)]
fn distance(period: f32, share: f32, more: f32) -> f32 {
    let distance = period * share;
    if more == 0.0 { distance } else { distance + more }
}

/// The pixel before a distance. (Half a pixel back, rounded. A tie may give the pixel before that.)
#[inline(always)]
fn pixel_before(distance: f32) -> f32 {
    nearest(distance - 0.5)
}

/// `a` where `mask` has no bits, `b` where it has all. Bits, because the compiler makes a gather of a choice between
/// two places in memory.
#[inline(always)]
pub(crate) fn choose(a: f32, b: f32, mask: u32) -> f32 {
    f32::from_bits(a.to_bits() & !mask | b.to_bits() & mask)
}

/// Linear interpolation of `padded` at the distance of `share` of its period and `more` px from each pixel of the block
/// that begins at `first`. NaN where one of the two neighbours is NaN.
#[inline(always)]
pub(crate) fn between(padded: &[f32], first: usize, periods: &Periods, share: f32, more: f32) -> Lanes {
    // Nothing on the way from a period to its whole pixels changes the order.
    let (near, far) = (distance(periods.least, share, more), distance(periods.most, share, more));
    let (least, most) = if share < 0.0 { (far, near) } else { (near, far) };
    let (low, most) = (pixel_before(least), whole(most - 0.5));
    let least = whole(least - 0.5);
    let base = (first + PAD).wrapping_add_signed(least as isize);
    let mut out = [0.0; LANES];
    if most - least <= 1 {
        let values: &[f32; LANES + 2] = chunk(padded, base);
        for i in 0..LANES {
            let distance = distance(periods.lanes[i], share, more);
            let before = pixel_before(distance);
            let next = if before == low { 0 } else { u32::MAX };
            let (a, b) = (choose(values[i], values[i + 1], next), choose(values[i + 1], values[i + 2], next));
            out[i] = a + (distance - before) * (b - a);
        }
        return out;
    }
    // For each distance in whole pixels, the pixels with this distance take their two values.
    let (mut before, mut a, mut b) = ([0.0; LANES], [0.0; LANES], [0.0; LANES]);
    for (before, &period) in before.iter_mut().zip(&periods.lanes) {
        *before = pixel_before(distance(period, share, more));
    }
    for step in 0..=(most - least) as usize {
        let values: Lanes = *chunk(padded, base + step);
        let next: Lanes = *chunk(padded, base + step + 1);
        let pixel = low + step as i32 as f32;
        for i in 0..LANES {
            let here = if before[i] == pixel { u32::MAX } else { 0 };
            a[i] = choose(a[i], values[i], here);
            b[i] = choose(b[i], next[i], here);
        }
    }
    for i in 0..LANES {
        let distance = distance(periods.lanes[i], share, more);
        out[i] = a[i] + (distance - before[i]) * (b[i] - a[i]);
    }
    out
}

/// The light of a row, with padding, and how much more the next pixel has than each.
#[derive(Debug, Default)]
pub(crate) struct Light {
    padded: Vec<f32>,
    steps: Vec<f32>,
}

impl Light {
    /// Makes room for a row of `width` pixels.
    pub(crate) fn reserve(&mut self, width: usize) {
        reserve(&mut self.padded, width);
        reserve(&mut self.steps, width);
    }

    /// Takes the light of a run that begins at `first`. Values beside the run stay undefined.
    #[inline(always)]
    pub(crate) fn set(&mut self, first: usize, pixels: &[u8]) {
        let n = pixels.len();
        let padded = &mut self.padded[PAD + first..][..n + 1];
        for i in 0..n {
            padded[i] = f32::from(pixels[i]);
        }
        // Values beside a run are not used, but the first and the last pixel have neighbours there.
        let (padded, steps) =
            (&self.padded[PAD + first - 1..][..n + 2], &mut self.steps[PAD + first - 1..][..n + 1]);
        for i in 0..n + 1 {
            steps[i] = padded[i + 1] - padded[i];
        }
    }

    /// That of the pixels of a block.
    #[inline(always)]
    pub(crate) fn own(&self, first: usize) -> &Lanes {
        chunk(&self.padded, PAD + first)
    }

    /// [`between`] before and behind each pixel, at the distance of `share` of its period. A line through the first
    /// two of three values, and what the second line is steeper: no pixel has to choose.
    #[inline(always)]
    pub(crate) fn both_sides(&self, first: usize, periods: &Periods, share: f32) -> [Lanes; 2] {
        let least = whole(distance(periods.least, share, 0.0) - 0.5);
        let most = whole(distance(periods.most, share, 0.0) - 0.5);
        if most - least > 1 {
            let at = |share: f32| between(&self.padded, first, periods, share, 0.0);
            return [at(-share), at(share)];
        }
        let (low, offset) = (least as usize, least as f32);
        let [before, behind] = [first + PAD - low - 2, first + PAD + low];
        let (value_before, value_behind): (&Lanes, &Lanes) =
            (chunk(&self.padded, before), chunk(&self.padded, behind));
        let steps_before = [chunk(&self.steps, before), next_of(&self.steps, before)];
        let steps_behind = [chunk(&self.steps, behind), next_of(&self.steps, behind)];
        let mut sides = [[0f32; LANES]; 2];
        for i in 0..LANES {
            let along = distance(periods.lanes[i], share, 0.0) - offset;
            sides[0][i] = bent(2.0 - along, value_before[i], [steps_before[0][i], steps_before[1][i]]);
            sides[1][i] = bent(along, value_behind[i], [steps_behind[0][i], steps_behind[1][i]]);
        }
        sides
    }
}

/// The block of a padded row that begins one value after `first`. The two blocks overlap; `black_box` makes the compiler
/// load the second, which is faster than shuffling it from the first.
#[inline(always)]
fn next_of(padded: &[f32], first: usize) -> &Lanes {
    black_box(chunk(padded, first + 1))
}

/// The value at 0..2 of three at 0, 1 and 2, of which the first is `a`, and the steps to the next two.
#[inline(always)]
fn bent(at: f32, a: f32, steps: [f32; 2]) -> f32 {
    let first = if at < 1.0 { at } else { 1.0 };
    a + first * steps[0] + (at - first) * steps[1]
}

#[cfg(test)]
mod tests {
    use super::{LANES, Light, PAD, Periods, between, load};
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
            let mut light = Light::default();
            light.reserve(200);
            light.set(0, &values);
            let periods = Periods::new(&std::array::from_fn(|i| (start + step * i as f32).max(1.0)));
            let share = f32::from(sixths) / 6.0;
            let [before, behind] = light.both_sides(first, &periods, share);
            for (found, share) in [(before, -share), (behind, share)] {
                // From the other of both neighbours: the last bits differ.
                for (x, alone) in found.iter().zip(between(&light.padded, first, &periods, share, 0.0)) {
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
