// SPDX-License-Identifier: MIT OR Apache-2.0
//! Sums and marks of whole planes that several maps of the paper need.

use crate::base::image::Plane;

/// 1 where the condition holds, else 0.
pub(super) fn one_if(is: bool) -> f32 {
    f32::from(u8::from(is))
}

/// Sum over the box of `columns` and `rows` to each side of every pixel, as far as the plane goes.
pub(super) fn box_sum(plane: &Plane<f32>, columns: usize, rows: usize) -> Plane<f32> {
    let (w, h) = (plane.width(), plane.height());
    let around = |x: usize, reach: usize, end: usize| x.saturating_sub(reach)..(x + reach + 1).min(end);
    let along = Plane::from_fn(w, h, |u, v| plane.row(v)[around(u, columns, w)].iter().sum::<f32>());
    Plane::from_fn(w, h, |u, v| around(v, rows, h).map(|v| along.at(u, v)).sum::<f32>())
}
