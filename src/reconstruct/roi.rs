//! The part of a frame that holds the object: everything after the mask works on it alone.

use super::simd;
use crate::image::{Mono8, Plane};

/// A rectangle of pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Roi {
    /// First column.
    pub u: usize,
    /// First row.
    pub v: usize,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
}

impl Roi {
    /// The smallest rectangle that holds all non-zero pixels; `None` where there are none.
    pub fn of(mask: &Plane<u8>) -> Option<Self> {
        let (mut left, mut right) = (usize::MAX, 0);
        let (mut top, mut bottom) = (usize::MAX, 0);
        simd::dispatch(
            #[inline(always)]
            || {
                for v in 0..mask.height() {
                    if let Some([first, last]) = ends(mask.row(v)) {
                        (left, right) = (left.min(first), right.max(last));
                        (top, bottom) = (top.min(v), v);
                    }
                }
            },
        );
        (left <= right).then(|| Self { u: left, v: top, width: right - left + 1, height: bottom - top + 1 })
    }

    /// The rectangle's part of an image or mask, which it must lie in, into a plane of its size.
    pub fn cut(&self, image: Mono8<'_>, out: &mut Plane<u8>) {
        for v in 0..self.height {
            out.row_mut(v).copy_from_slice(&image.row(self.v + v)[self.u..self.u + self.width]);
        }
    }
}

/// Bytes that are looked at together: whole rows and most of the margins are empty.
const TOGETHER: usize = 64;

/// The first and the last byte of a row that is not 0.
#[inline(always)]
fn ends(row: &[u8]) -> Option<[usize; 2]> {
    let (parts, rest) = row.as_chunks::<TOGETHER>();
    let beyond = TOGETHER * parts.len();
    // Loops, not searches: these would be calls, compiled for the narrowest processor.
    let mut first = 0;
    while first < parts.len() && !shows(&parts[first]) {
        first += 1;
    }
    let shown = |&x: &u8| x != 0;
    let in_rest = rest.iter().rposition(shown);
    if first == parts.len() {
        return Some([beyond + rest.iter().position(shown)?, beyond + in_rest?]);
    }
    let mut last = parts.len() - 1;
    while last > first && !shows(&parts[last]) {
        last -= 1;
    }
    let in_last = || parts[last].iter().rposition(shown).map(|u| TOGETHER * last + u);
    Some([
        TOGETHER * first + parts[first].iter().position(shown)?,
        in_rest.map(|u| beyond + u).or_else(in_last)?,
    ])
}

#[inline(always)]
fn shows(bytes: &[u8; TOGETHER]) -> bool {
    let mut any = 0;
    for x in bytes {
        any |= x;
    }
    any != 0
}

#[cfg(test)]
mod tests {
    use super::Roi;
    use crate::image::Plane;
    use proptest::prelude::{prop_assert_eq, proptest};

    proptest! {
        #[test]
        fn the_rectangle_is_the_smallest(
            width in 1usize..200,
            pixels in proptest::collection::vec((0usize..200, 0usize..9), 0..5),
        ) {
            let mut mask = Plane::filled(width, 9, 0u8);
            let pixels: Vec<_> = pixels.into_iter().map(|(u, v)| (u % width, v)).collect();
            pixels.iter().for_each(|&(u, v)| mask.set(u, v, 1));
            let found = Roi::of(&mask);
            let us = || pixels.iter().map(|p| p.0);
            let vs = || pixels.iter().map(|p| p.1);
            let expected = us().min().zip(us().max()).zip(vs().min().zip(vs().max())).map(
                |((left, right), (top, bottom))| {
                    Roi { u: left, v: top, width: right - left + 1, height: bottom - top + 1 }
                },
            );
            prop_assert_eq!(found, expected);
        }
    }
}
