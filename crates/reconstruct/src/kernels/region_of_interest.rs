// SPDX-License-Identifier: MIT OR Apache-2.0
//! The part of a frame that holds the object: everything after the mask works on it alone.

use super::pixel_runs::{Run, Runs};
use crate::base::image::{Mono8, Plane};

/// A rectangle of pixels in a frame. All planes of a frame cover it; (u, v) is its first pixel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Roi {
    pub u: usize,
    pub v: usize,
    pub width: usize,
    pub height: usize,
}

impl Roi {
    /// The smallest rectangle that holds all runs of a frame; `None` where there are none.
    pub fn of(runs: &Runs) -> Option<Self> {
        let mut rows = (0..runs.height()).filter(|&v| !runs.row(v).is_empty());
        let top = rows.next()?;
        let bottom = rows.next_back().unwrap_or(top);
        let left = runs.all().iter().map(Run::start).min()?;
        let right = runs.all().iter().map(Run::end).max()?;
        Some(Self { u: left, v: top, width: right - left, height: bottom - top + 1 })
    }

    /// The rectangle's part of an image, which it must lie in, into a plane of its size.
    pub fn cut(&self, image: Mono8<'_>, out: &mut Plane<u8>) {
        for v in 0..self.height {
            out.row_mut(v).copy_from_slice(&image.row(self.v + v)[self.u..self.u + self.width]);
        }
    }

    /// A frame's runs, which must lie in the rectangle, with its corner as the origin.
    pub fn cut_runs(&self, runs: &Runs) -> Runs {
        let mut cut = Runs::default();
        for v in self.v..self.v + self.height {
            for run in runs.row(v) {
                cut.push(Run::new(run.start() - self.u, run.end() - self.u));
            }
            cut.end_row();
        }
        cut
    }
}

#[cfg(test)]
mod tests {
    use super::Roi;
    use crate::base::image::{Mono8, Plane};
    use crate::kernels::pixel_runs::Runs;
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
            let runs = Runs::of(&mask);
            let found = Roi::of(&runs);
            let us = || pixels.iter().map(|p| p.0);
            let vs = || pixels.iter().map(|p| p.1);
            let expected = us().min().zip(us().max()).zip(vs().min().zip(vs().max())).map(
                |((left, right), (top, bottom))| {
                    Roi { u: left, v: top, width: right - left + 1, height: bottom - top + 1 }
                },
            );
            prop_assert_eq!(found, expected);
            if let Some(roi) = found {
                let [mut cut, mut painted] = [(); 2].map(|()| Plane::filled(roi.width, roi.height, 7));
                roi.cut(Mono8::from(&mask), &mut cut);
                roi.cut_runs(&runs).paint(&mut painted);
                prop_assert_eq!(painted.as_slice(), cut.as_slice());
            }
        }
    }
}
