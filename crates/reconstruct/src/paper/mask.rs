// SPDX-License-Identifier: MIT OR Apache-2.0
//! Object mask Om (paper, Figure 6): Otsu's threshold, dilation and erosion, the largest segment.

use super::planes::{box_sum, one_if};
use crate::base::image::{Mono8, Plane};
use crate::kernels::connected_components::{self, Piece};
use crate::kernels::pixel_runs::Runs;
use crate::mask::{CLOSING_PERIODS, SATURATED, histogram, otsu_level};

/// Om: 1 on the object, 0 elsewhere. `period_px` is the nominal fringe period in the image.
///
/// Over-exposed pixels have no part in the threshold, and leave the mask at the end, else the erosion would give them
/// back.
pub fn object(image: Mono8<'_>, period_px: f32) -> Plane<f32> {
    let mut counts = histogram(image.as_slice());
    counts[usize::from(SATURATED)..].fill(0);
    let level = otsu_level(&counts);
    let (w, h) = (image.width(), image.height());
    let bright = Plane::from_fn(w, h, |u, v| one_if(usize::from(image.row(v)[u]) > level));
    // A square of 1.2 periods closes the dark half of a fringe, which is object, too.
    let reach = (CLOSING_PERIODS * period_px).ceil() as usize / 2;
    let inverse = |plane: &Plane<f32>| plane.map(|x| 1.0 - x);
    let dilated = dilate(&bright, reach);
    let eroded = inverse(&dilate(&inverse(&dilated), reach));
    let largest = largest_segment(&eroded);
    Plane::from_fn(w, h, |u, v| largest.at(u, v) * one_if(image.row(v)[u] < SATURATED))
}

/// 1 wherever there is a 1 within a square of `reach` pixels to each side.
fn dilate(mask: &Plane<f32>, reach: usize) -> Plane<f32> {
    box_sum(mask, reach, reach).map(|sum| sum.min(1.0))
}

/// The largest of the 8-connected segments of a mask of zeros and ones, the first of several.
pub(super) fn largest_segment(mask: &Plane<f32>) -> Plane<f32> {
    let (all, mut largest) = (Runs::of(&mask.map(|x| x as u8)), Runs::default());
    let choose = |_: &[u32], pieces: &[Piece]| {
        let largest = (0..pieces.len()).max_by_key(|&i| (pieces[i].area, usize::MAX - i));
        (0..pieces.len()).map(|i| Some(i) == largest).collect()
    };
    connected_components::select(&all, choose, &mut largest);
    let mut out = Plane::filled(mask.width(), mask.height(), 0);
    largest.paint(&mut out);
    out.map(f32::from)
}

#[cfg(test)]
mod tests {
    use super::object;
    use crate::base::image::{Mono8, Plane};

    #[test]
    fn the_largest_part_is_the_object_with_its_dark_fringes_and_without_what_is_over_exposed() {
        let mut image = Plane::from_fn(300, 120, |u, v| {
            let lit = (10..110).contains(&v) && ((20..140).contains(&u) || (200..280).contains(&u));
            let wave = 100.0 + 90.0 * (std::f32::consts::TAU * u as f32 / 10.0).cos();
            if lit { wave as u8 } else { 2 }
        });
        image.set(70, 60, 255);
        let found = object(Mono8::from(&image), 10.0);
        assert!((30..130).all(|u| found.at(u, 40) == 1.0), "the fringes");
        assert!((150..300).all(|u| found.at(u, 40) == 0.0), "the smaller part");
        assert_eq!([69, 70, 71].map(|u| found.at(u, 60)), [1.0, 0.0, 1.0]);
        let dark = object(Mono8::from(&Plane::filled(30, 20, 0)), 10.0);
        assert!(dark.as_slice().iter().all(|&x| x == 0.0));
    }
}
