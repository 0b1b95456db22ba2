//! The part of a frame that holds the object: everything after the mask works on it alone.

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
        for v in 0..mask.height() {
            let row = mask.row(v);
            // Whole rows and most of the margins are empty: sixteen pixels at once.
            let (chunks, rest) = row.as_chunks::<16>();
            let shows = |chunk: &[u8; 16]| u128::from_le_bytes(*chunk) != 0;
            let Some(first) = chunks.iter().position(shows).map_or_else(
                || rest.iter().position(|&x| x != 0).map(|u| 16 * chunks.len() + u),
                |i| chunks[i].iter().position(|&x| x != 0).map(|u| 16 * i + u),
            ) else {
                continue;
            };
            let last = rest.iter().rposition(|&x| x != 0).map(|u| 16 * chunks.len() + u).or_else(|| {
                let i = chunks.iter().rposition(shows)?;
                chunks[i].iter().rposition(|&x| x != 0).map(|u| 16 * i + u)
            });
            (left, right) = (left.min(first), right.max(last.unwrap_or(first)));
            (top, bottom) = (top.min(v), v);
        }
        (left <= right).then(|| Self { u: left, v: top, width: right - left + 1, height: bottom - top + 1 })
    }

    /// The rectangle's part of an image or mask, which it must lie in, into a plane of its size.
    pub fn cut(&self, image: Mono8<'_>, out: &mut Plane<u8>) {
        for v in 0..self.height {
            out.row_mut(v).copy_from_slice(&image.row(self.v + v)[self.u..self.u + self.width]);
        }
    }
}
