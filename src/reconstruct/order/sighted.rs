//! A view's pixels as they are looked up: object, node and phase side by side, the object's columns of each row.
//!
//! Looks come from anywhere in the image, and each of them waits for memory: one place to read instead of three planes of
//! megabytes is most of what can be gained.

use crate::reconstruct::pool::Pool;
use crate::reconstruct::runs::Runs;
use std::ops::Range;

/// Memory for pixels, from frame to frame.
static POOL: Pool<Vec<Pixel>> = Pool::new();

/// A pixel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pixel {
    /// NaN where it is unknown.
    pub phase: f32,
    /// Number of the node plus [`FIRST_NODE`], or [`NO_NODE`], or 0 beside the object.
    label: u32,
}

/// Label of a pixel of the object that has no node.
const NO_NODE: u32 = 1;

/// Label of the first node.
pub const FIRST_NODE: u32 = 2;

impl Pixel {
    /// Beside the object.
    pub const BESIDE: Self = Self { phase: f32::NAN, label: 0 };

    /// A pixel, on the object or not, with its node.
    #[inline(always)]
    pub fn new(phase: f32, object: bool, node: Option<u32>) -> Self {
        let label = if object { node.map_or(NO_NODE, |node| node + FIRST_NODE) } else { 0 };
        Self { phase, label }
    }

    /// Its node.
    #[inline(always)]
    pub fn node(&self) -> Option<u32> {
        self.label.checked_sub(FIRST_NODE)
    }

    /// Its node plus [`FIRST_NODE`]; below that it has none.
    #[inline(always)]
    pub fn label(&self) -> usize {
        self.label as usize
    }

    /// Whether it is on the object.
    #[inline(always)]
    pub fn is_object(&self) -> bool {
        self.label != 0
    }
}

/// From the first to the last column of the object in a row.
#[derive(Debug, Clone, Copy)]
struct Span {
    first: u32,
    end: u32,
    /// Where its pixels begin.
    start: u32,
}

/// All pixels of a view's object.
#[derive(Debug)]
pub struct Sighted {
    spans: Vec<Span>,
    pixels: Vec<Pixel>,
}

impl Sighted {
    /// Room for the pixels of an object's runs, all of which have to be written.
    pub fn new(runs: &Runs) -> Self {
        let mut pixels = POOL.take();
        let mut spans = Vec::with_capacity(runs.height());
        let mut start = 0;
        for v in 0..runs.height() {
            let Range { start: first, end } = runs.span(v);
            spans.push(Span { first: first as u32, end: end as u32, start: start as u32 });
            start += end - first;
        }
        // What a frame before has left is written over.
        pixels.resize(start, Pixel::BESIDE);
        Self { spans, pixels }
    }

    /// The pixels of row `v` among the `count` columns from `left` on, each with its column less `left`.
    #[inline(always)]
    pub fn part(&mut self, v: usize, left: usize, count: usize) -> impl Iterator<Item = (&mut Pixel, usize)> {
        let (columns, pixels) = match self.spans.get(v) {
            Some(span) => {
                let (first, end) = (span.first as usize, span.end as usize);
                let start = span.start as usize;
                let columns = left.clamp(first, end)..(left + count).clamp(first, end);
                let places = start + columns.start - first..start + columns.end - first;
                (columns, self.pixels.get_mut(places).unwrap_or_default())
            }
            None => (0..0, Default::default()),
        };
        let shift = columns.start.saturating_sub(left);
        pixels.iter_mut().zip(shift..)
    }

    /// The columns of a row that have pixels, and these.
    pub fn row(&self, v: usize) -> (Range<usize>, &[Pixel]) {
        let Some(span) = self.spans.get(v) else { return (0..0, &[]) };
        let columns = span.first as usize..span.end as usize;
        let start = span.start as usize;
        (columns.clone(), self.pixels.get(start..start + columns.len()).unwrap_or_default())
    }

    /// The pixel at column `u`, row `v`, and the one to its right.
    #[inline(always)]
    pub fn at(&self, u: usize, v: usize) -> (Pixel, Pixel) {
        let Some(span) = self.spans.get(v).filter(|span| u >= span.first as usize && u < span.end as usize)
        else {
            return (Pixel::BESIDE, Pixel::BESIDE);
        };
        let place = span.start as usize + u - span.first as usize;
        let here = self.pixels.get(place).copied().unwrap_or(Pixel::BESIDE);
        let right = self.pixels.get(place + 1).filter(|_| u + 1 < span.end as usize);
        (here, right.copied().unwrap_or(Pixel::BESIDE))
    }

    /// Gives its memory to the next frame.
    pub fn give_back(self) {
        POOL.give(self.pixels);
    }
}

#[cfg(test)]
mod tests {
    use super::{Pixel, Sighted};
    use crate::image::Plane;
    use crate::reconstruct::runs::Runs;

    #[test]
    fn a_pixel_is_what_was_written_and_beside_the_object_there_is_none() {
        let data = [0, 1, 0, 1, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 1];
        let object = Plane::from_vec(5, 3, data.to_vec()).expect("same size");
        let mut sighted = Sighted::new(&Runs::of(&object));
        let pixel = |u: usize, v: usize| {
            let node = (u != 3).then_some((10 * v + u) as u32);
            Pixel::new(node.map_or(f32::NAN, |x| x as f32), object.at(u, v) != 0, node)
        };
        // In parts of three columns, as cells do it.
        for v in 0..3 {
            for left in [0, 3] {
                for (to, u) in sighted.part(v, left, 3.min(5 - left)) {
                    *to = pixel(left + u, v);
                }
            }
        }
        for v in 0..4 {
            for u in 0..7 {
                let on = u < 5 && v < 3 && object.at(u, v) != 0;
                let found = sighted.at(u, v).0;
                assert_eq!(found.is_object(), on, "({u}, {v})");
                assert_eq!(found.node(), if on { pixel(u, v).node() } else { None }, "({u}, {v})");
            }
        }
        assert_eq!(sighted.at(0, 2).1, pixel(1, 2));
        assert!(!sighted.at(4, 2).1.is_object(), "nothing to the right");
        assert_eq!((sighted.row(0).0, sighted.row(0).1.len()), (1..4, 3));
    }
}
