// SPDX-License-Identifier: MIT OR Apache-2.0
//! Unwrapped phase Um: a spanning tree guided by Qm.

use crate::base::image::Plane;
use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::f32::consts::TAU;

/// Um, rad, from Wm, rad, and Qm, 0 to 1; NaN where no branch leads to.
///
/// The tree grows from a seed by the best branch that leaves it (Prim), a branch being as good as the worse of the two
/// neighbours that it joins. Along a branch the wrapped step is taken as the true one. The paper's seed is random
/// among the best tenth of Qm. Any seed of one segment gives the same tree, so the best pixel will do.
pub fn unwrap(wrapped: &Plane<f32>, quality: &Plane<f32>) -> Plane<f32> {
    let (width, pixels) = (wrapped.width(), wrapped.as_slice().len());
    let mut unwrapped = wrapped.map(|_| f32::NAN);
    let (wrapped, quality) = (wrapped.as_slice(), quality.as_slice());
    let known = (0..pixels).filter(|&i| !wrapped[i].is_nan());
    let Some(seed) = known.max_by(|&a, &b| quality[a].total_cmp(&quality[b]).then(b.cmp(&a))) else {
        return unwrapped;
    };
    let phase = unwrapped.as_mut_slice();
    // Quality, the pixel that is reached, and that from which. Bits of numbers that are not negative are ordered as
    // these.
    let mut branches = BinaryHeap::from([(quality[seed].to_bits(), Reverse(seed), seed)]);
    while let Some((_, Reverse(pixel), from)) = branches.pop() {
        if !phase[pixel].is_nan() {
            continue;
        }
        let start = if pixel == seed { wrapped[seed] } else { phase[from] };
        phase[pixel] = wrapped[pixel] + TAU * ((start - wrapped[pixel]) / TAU).round();
        let column = pixel % width;
        let neighbours = [
            (column > 0).then(|| pixel - 1),
            (column + 1 < width).then_some(pixel + 1),
            pixel.checked_sub(width),
            Some(pixel + width).filter(|&below| below < pixels),
        ];
        for next in neighbours.into_iter().flatten() {
            if phase[next].is_nan() && !wrapped[next].is_nan() {
                branches.push((quality[pixel].min(quality[next]).to_bits(), Reverse(next), pixel));
            }
        }
    }
    unwrapped
}

#[cfg(test)]
mod tests {
    use super::unwrap;
    use crate::base::image::Plane;
    use proptest::prelude::{prop_assert, proptest};
    use std::f32::consts::TAU;

    const W: usize = 40;
    const H: usize = 30;

    fn wrap(x: f32) -> f32 {
        x - TAU * (x / TAU).round()
    }

    proptest! {
        /// A planted surface with a tear of poor quality, across which steps are no steps, is unwrapped around the
        /// tear.
        #[test]
        fn a_planted_surface_is_found_around_a_tear(
            slopes in (-2.0f32..2.0, -2.0f32..2.0),
            bend in -0.01f32..0.01,
            tear in 3usize..37,
            noise in proptest::collection::vec(-3.0f32..3.0, H),
        ) {
            let torn = |u: usize, v: usize| u == tear && v > 4;
            let truth = Plane::from_fn(W, H, |u, v| {
                let (x, y) = (u as f32, v as f32);
                slopes.0 * x + slopes.1 * y + bend * (x * x + y * y)
            });
            let wrapped = Plane::from_fn(W, H, |u, v| {
                wrap(truth.at(u, v) + if torn(u, v) { noise[v] } else { 0.0 })
            });
            let quality = Plane::from_fn(W, H, |u, v| if torn(u, v) { 0.1 } else { 0.5 + 0.01 * (v % 7) as f32 });
            let found = unwrap(&wrapped, &quality);
            let offset = found.at(0, 0) - truth.at(0, 0);
            for v in 0..H {
                for u in (0..W).filter(|&u| !torn(u, v)) {
                    let error = found.at(u, v) - truth.at(u, v) - offset;
                    prop_assert!(error.abs() < 1e-3, "{error} at {u} {v}");
                }
            }
        }
    }

    #[test]
    fn only_the_segment_of_the_best_pixel_is_unwrapped() {
        let wrapped = Plane::from_fn(9, 5, |u, _| if u == 4 { f32::NAN } else { 0.1 });
        let quality = Plane::from_fn(9, 5, |u, _| if u == 7 { 0.9 } else { 0.5 });
        let found = unwrap(&wrapped, &quality);
        assert!((0..5).all(|u| found.at(u, 2).is_nan()) && (5..9).all(|u| found.at(u, 2) == 0.1));
        assert!(unwrap(&Plane::filled(3, 3, f32::NAN), &Plane::filled(3, 3, 0.5)).at(1, 1).is_nan());
    }
}
