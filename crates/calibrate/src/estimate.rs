// SPDX-License-Identifier: MIT OR Apache-2.0
//! Estimates that many steps need: the middle value, and ordinary least squares.

use nalgebra::{SMatrix, SVector};

/// The middle value of those that are not NaN; NaN without any. Of an even number it is the larger of the two.
pub(super) fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.filter(|x| !x.is_nan()).collect();
    if values.is_empty() {
        return f64::NAN;
    }
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// The solution of a small system with the least sum of squares; `None` where the rows do not determine it.
pub(super) fn least_squares<const N: usize>(
    rows: impl Iterator<Item = (SVector<f64, N>, f64)>,
) -> Option<SVector<f64, N>> {
    let (mut normal, mut right) = (SMatrix::<f64, N, N>::zeros(), SVector::<f64, N>::zeros());
    for (row, value) in rows {
        normal += row * row.transpose();
        right += row * value;
    }
    normal.cholesky().map(|factor| factor.solve(&right)).filter(|x| x.iter().all(|v| v.is_finite()))
}
