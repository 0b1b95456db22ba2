// SPDX-License-Identifier: MIT OR Apache-2.0
//! The largest or the smallest value of a window that slides along a row.

/// `out[0][i]` becomes the extreme of the values `i .. i + length` of a row whose ends repeat `beyond` times on either
/// side. The second row of `out` is memory to use.
///
/// Doubling: the window grows by its own length, in passes of plain slice operations that the compiler vectorises.
#[inline(always)]
pub(crate) fn extremes(
    row: &[u8],
    beyond: usize,
    length: usize,
    out: &mut [Vec<u8>; 2],
    extreme: impl Fn(u8, u8) -> u8 + Copy,
) {
    let [from, to] = out;
    let (first, last) = (row.first().copied().unwrap_or(0), row.last().copied().unwrap_or(0));
    from.clear();
    from.resize(beyond, first);
    from.extend_from_slice(row);
    from.resize(row.len() + 2 * beyond, last);
    to.resize(from.len(), 0);
    let mut covered = 1;
    while covered < length {
        let step = covered.min(length - covered);
        let n = from.len() + 1 - covered - step;
        for ((to, &a), &b) in to[..n].iter_mut().zip(&from[..n]).zip(&from[step..step + n]) {
            *to = extreme(a, b);
        }
        std::mem::swap(from, to);
        covered += step;
    }
}

#[cfg(test)]
mod tests {
    use super::extremes;
    use proptest::prelude::{any, prop_assert_eq, proptest};

    proptest! {
        #[test]
        fn the_extreme_is_that_of_each_window(
            row in proptest::collection::vec(any::<u8>(), 1..60), half in 0usize..9, length in 1usize..20,
        ) {
            let mut out = [Vec::new(), Vec::new()];
            extremes(&row, half, 2 * half + 1, &mut out, u8::max);
            for i in 0..row.len() {
                let window = &row[i.saturating_sub(half)..(i + half + 1).min(row.len())];
                prop_assert_eq!(Some(&out[0][i]), window.iter().max());
            }
            extremes(&row, 0, length.min(row.len()), &mut out, u8::min);
            for (i, window) in row.windows(length.min(row.len())).enumerate() {
                prop_assert_eq!(Some(&out[0][i]), window.iter().min());
            }
        }
    }
}
