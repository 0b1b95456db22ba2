//! A view's pixels as the other cameras look them up: object, node and phase side by side, the object's columns of each row.
//!
//! Looks come from anywhere in the image, and each of them waits for memory: one place to read instead of three planes of
//! megabytes is most of what can be gained.

use crate::image::Plane;

/// Node of a pixel of the object that has none.
pub const NO_NODE: u32 = u32::MAX;

/// A pixel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pixel {
    /// NaN where it is unknown.
    pub phase: f32,
    /// Number of the node plus one, [`NO_NODE`], or 0 beside the object.
    pub node: u32,
}

impl Pixel {
    /// Beside the object.
    pub const BESIDE: Self = Self { phase: f32::NAN, node: 0 };
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
    /// Of planes of one size: phase, node (plus one; 0: none) and object (not 0).
    pub fn new(phase: &Plane<f32>, node: &Plane<u32>, object: &Plane<u8>) -> Self {
        let mut spans = Vec::with_capacity(object.height());
        let mut pixels: Vec<Pixel> = Vec::new();
        for v in 0..object.height() {
            let row = object.row(v);
            let first = row.iter().position(|&x| x != 0).unwrap_or(0);
            let end = row.iter().rposition(|&x| x != 0).map_or(0, |last| last + 1);
            spans.push(Span { first: first as u32, end: end as u32, start: pixels.len() as u32 });
            let span = first..end.max(first);
            let values = row[span.clone()].iter().zip(&phase.row(v)[span.clone()]).zip(&node.row(v)[span]);
            pixels.extend(values.map(|((&object, &phase), &node)| match (object, node) {
                (0, _) => Pixel::BESIDE,
                (_, 0) => Pixel { phase, node: NO_NODE },
                _ => Pixel { phase, node },
            }));
        }
        Self { spans, pixels }
    }

    /// The pixel at column `u`, row `v`, and the one to its right.
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

    /// Whether there is object.
    pub fn is_object(&self, u: usize, v: usize) -> bool {
        self.at(u, v).0.node != 0
    }
}

#[cfg(test)]
mod tests {
    use super::{NO_NODE, Pixel, Sighted};
    use crate::image::Plane;

    #[test]
    fn a_pixel_is_what_the_planes_say() {
        let plane = |data: &[u8]| Plane::from_vec(5, 3, data.to_vec()).expect("same size");
        let object = plane(&[0, 1, 0, 1, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 1]);
        let node: Vec<u32> = [0, 7, 0, 0, 0, 0, 0, 0, 0, 0, 1, 2, 3, 4, 5].to_vec();
        let phase: Vec<f32> = node.iter().map(|&x| if x == 0 { f32::NAN } else { x as f32 }).collect();
        let (node, phase) = (
            Plane::from_vec(5, 3, node).expect("same size"),
            Plane::from_vec(5, 3, phase).expect("same size"),
        );
        let sighted = Sighted::new(&phase, &node, &object);
        for v in 0..4 {
            for u in 0..7 {
                let there = u < 5 && v < 3;
                let found = sighted.at(u, v).0;
                let expected = match there.then(|| (object.at(u, v), node.at(u, v))) {
                    None | Some((0, _)) => 0,
                    Some((_, 0)) => NO_NODE,
                    Some((_, node)) => node,
                };
                assert_eq!(found.node, expected, "({u}, {v})");
                assert_eq!(sighted.is_object(u, v), expected != 0);
                assert!(!there || found.phase.to_bits() == phase.at(u, v).to_bits() || found.node == 0);
            }
        }
        assert_eq!(sighted.at(0, 2).1, Pixel { phase: 2.0, node: 2 });
        assert_eq!(sighted.at(4, 2).1.node, 0, "nothing to the right");
    }
}
