//! The pixels of one cell, eight by eight: their phases side by side, and masks of them in words of 64 bits.

use crate::image::Plane;
use std::f32::consts::TAU;

/// Side of a cell, px.
pub const CELL_PX: usize = 8;

/// Within a cell, steps this far from the carrier's still continue, rad. Few pixels agree by chance so often that it
/// matters there.
pub(super) const INNER_RAD: f32 = 0.8;

/// All pixels of a cell, a bit each, row by row.
pub(super) const ALL: u64 = !0;

/// The first column of a cell's bits.
pub(super) const FIRST_COLUMN: u64 = 0x0101_0101_0101_0101;

/// Values of a cell's pixels.
pub(super) type Patch = [[f32; CELL_PX]; CELL_PX];

/// Values of a cell's pixels; NaN beyond the region of interest.
#[inline(always)]
pub(super) fn patch(plane: &Plane<f32>, left: usize, top: usize) -> Patch {
    let mut out = [[f32::NAN; CELL_PX]; CELL_PX];
    for (v, out) in (top..plane.height()).zip(&mut out) {
        *out = part(plane.row(v), left, f32::NAN);
    }
    out
}

/// Eight values of a row, `beyond` behind its end.
#[inline(always)]
pub(super) fn part<T: Copy>(row: &[T], left: usize, beyond: T) -> [T; CELL_PX] {
    match row[left..].first_chunk() {
        Some(part) => *part,
        None => std::array::from_fn(|i| row.get(left + i).copied().unwrap_or(beyond)),
    }
}

/// A bit for every pixel (u, v) of a cell.
#[inline(always)]
pub(super) fn bits(is: impl Fn(usize, usize) -> bool) -> u64 {
    let mut rows = [0u8; CELL_PX];
    for (v, row) in rows.iter_mut().enumerate() {
        for u in 0..CELL_PX {
            *row |= u8::from(is(u, v)) << u;
        }
    }
    u64::from_le_bytes(rows)
}

/// Unwraps the phases of a cell: to half a turn around the plane through the pixel nearest to its middle, with the steps
/// that most neighbours take.
#[inline(always)]
pub(super) fn unwrap(phase: &mut Patch, carrier: &Patch, known: u64) {
    let (mut across, mut along) = ([0f32; CELL_PX], [0f32; CELL_PX]);
    let mut counts = [[0f32; CELL_PX]; 2];
    for v in 0..CELL_PX {
        for u in 1..CELL_PX {
            let step = phase[v][u] - phase[v][u - 1] - carrier[v][u];
            let rest = step - TAU * whole_turns(step);
            let continues = rest.abs() < INNER_RAD;
            across[u] += if continues { rest + carrier[v][u] } else { 0.0 };
            counts[0][u] += if continues { 1.0 } else { 0.0 };
        }
    }
    for v in 1..CELL_PX {
        for u in 0..CELL_PX {
            let step = phase[v][u] - phase[v - 1][u];
            let rest = step - TAU * whole_turns(step);
            let continues = rest.abs() < INNER_RAD;
            along[u] += if continues { rest } else { 0.0 };
            counts[1][u] += if continues { 1.0 } else { 0.0 };
        }
    }
    let mean = |sums: [f32; CELL_PX], counts: [f32; CELL_PX]| total(sums) / total(counts).max(1.0);
    let (across, along) = (mean(across, counts[0]), mean(along, counts[1]));
    let place = middle(known);
    let (u0, v0) = (place % CELL_PX, place / CELL_PX);
    let origin = phase[v0][u0] - across * u0 as f32 - along * v0 as f32;
    for (v, row) in phase.iter_mut().enumerate() {
        for (u, phase) in row.iter_mut().enumerate() {
            let expected = origin + across * u as f32 + along * v as f32;
            *phase += TAU * whole_turns(expected - *phase);
        }
    }
}

/// Whole turns in a phase.
#[inline(always)]
fn whole_turns(phase: f32) -> f32 {
    /// Adding and taking away this rounds a float below 2^22 to the nearest whole number.
    const ROUNDER: f32 = 12_582_912.0;
    phase * (1.0 / TAU) + ROUNDER - ROUNDER
}

#[inline(always)]
fn total([a, b, c, d, e, f, g, h]: [f32; CELL_PX]) -> f32 {
    (a + b) + (c + d) + ((e + f) + (g + h))
}

/// The pixels that continue some, and these: `right` and `down` tell which continue the one to their left and above.
#[inline(always)]
fn neighbours(mask: u64, right: u64, down: u64) -> u64 {
    let across = mask | mask << 1 & right | (mask & right) >> 1;
    across | across << CELL_PX & down | (across & down) >> CELL_PX
}

/// All pixels that hang together with some.
#[inline(always)]
fn flood(seed: u64, right: u64, down: u64) -> u64 {
    let mut mask = seed;
    loop {
        let next = neighbours(mask, right, down);
        if next == mask {
            return mask;
        }
        mask = next;
    }
}

/// Parts of a cell whose pixels continue each other, and how many there are: `right` and `down` tell which continue the one
/// to their left and above. What is not `fine` belongs to the part that it continues, but joins no parts.
#[inline(always)]
pub(super) fn parts(known: u64, fine: u64, right: u64, down: u64) -> ([u64; CELL_PX * CELL_PX], usize) {
    let (mut parts, mut count) = ([0u64; CELL_PX * CELL_PX], 0);
    let mut cut = |of: u64, parts: &mut [u64]| {
        let (right, down) = (right & of & of << 1, down & of & of << CELL_PX);
        let mut rest = of;
        while rest != 0 {
            parts[count] = flood(rest & rest.wrapping_neg(), right, down);
            rest &= !parts[count];
            count += 1;
        }
        count
    };
    let fine_parts = cut(known & fine, &mut parts);
    let mut rest = known & !fine;
    while rest != 0 {
        let before = rest;
        for part in &mut parts[..fine_parts] {
            *part |= neighbours(*part, right, down) & rest;
            rest &= !*part;
        }
        if rest == before {
            break;
        }
    }
    let count = cut(rest, &mut parts);
    (parts, count)
}

/// The pixel of a node that is nearest to the cell's middle, the first of several.
#[inline(always)]
pub(super) fn middle(mask: u64) -> usize {
    /// Pixels within so many half steps of the middle, counted along rows and columns.
    const RINGS: [u64; 8] = {
        let mut rings = [0; 8];
        let mut at = 0;
        while at < CELL_PX * CELL_PX {
            let (u, v) = (at % CELL_PX, at / CELL_PX);
            let distance = (2 * u).abs_diff(CELL_PX - 1) + (2 * v).abs_diff(CELL_PX - 1);
            rings[distance / 2] |= 1 << at;
            at += 1;
        }
        rings
    };
    let ring = RINGS.iter().find(|ring| **ring & mask != 0).map_or(mask, |ring| ring & mask);
    (ring.trailing_zeros() as usize).min(CELL_PX * CELL_PX - 1)
}

/// The mean of a value over the pixels of a mask; 0 where there are none.
#[inline(always)]
pub(super) fn mean(mask: u64, value: impl Fn(usize, usize) -> f32) -> f32 {
    let mut sums = [0f32; CELL_PX];
    for (v, bits) in mask.to_le_bytes().into_iter().enumerate() {
        for (u, sum) in sums.iter_mut().enumerate() {
            *sum += if bits >> u & 1 != 0 { value(u, v) } else { 0.0 };
        }
    }
    total(sums) / mask.count_ones().max(1) as f32
}

#[cfg(test)]
mod tests {
    use super::{ALL, CELL_PX, FIRST_COLUMN, Patch, middle, parts, unwrap};
    use std::f32::consts::TAU;

    #[test]
    fn a_wrapped_plane_is_one_plane_again() {
        let carrier = [[TAU / 11.0; CELL_PX]; CELL_PX];
        let plane = |u: usize, v: usize| 0.6 * u as f32 - 0.4 * v as f32 + 40.0;
        let mut phase: Patch = std::array::from_fn(|v| {
            std::array::from_fn(|u| (plane(u, v) + TAU / 2.0).rem_euclid(TAU) - TAU / 2.0)
        });
        unwrap(&mut phase, &carrier, ALL);
        let shift = phase[0][0] - plane(0, 0);
        for v in 0..CELL_PX {
            for u in 0..CELL_PX {
                assert!((phase[v][u] - plane(u, v) - shift).abs() < 1e-4, "({u}, {v})");
            }
        }
    }

    #[test]
    fn what_is_not_fine_belongs_to_a_part_and_joins_none() {
        // All neighbours continue; the fourth column is not fine.
        let (right, down) = (ALL & !FIRST_COLUMN, ALL << CELL_PX);
        let fine = !(FIRST_COLUMN << 3);
        let (found, count) = parts(ALL, fine, right, down);
        assert_eq!(count, 2);
        assert_eq!((found[0] | found[1], found[0] & found[1]), (ALL, 0));
        assert_eq!(found[0], FIRST_COLUMN * 0b1111, "the first part takes it");
        assert_eq!(parts(ALL, ALL, right, down).1, 1);
        assert_eq!(parts(ALL, 0, right, down).1, 1, "what is nowhere fine hangs together");
    }

    #[test]
    fn the_middle_is_the_first_of_the_nearest() {
        assert_eq!(middle(ALL), 27);
        assert_eq!(middle(1 | 1 << 63), 0);
        assert_eq!(middle(1 << 5), 5);
    }
}
