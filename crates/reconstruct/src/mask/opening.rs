// SPDX-License-Identifier: MIT OR Apache-2.0
//! Opening by a square of five pixels, on rows of bits: 64 pixels a word.

use super::envelope::{clip, complement, spread};
use crate::kernels::bit_rows::WORD;
use crate::kernels::pixel_runs::{Run, Runs};
use std::ops::Range;

/// Pixels that the square reaches to each side: it is five wide and high.
const HALF: usize = 2;

/// The runs of a plane of bits of these columns of `height` rows, each row of as many words as it needs, after erosion
/// and dilation by a square; outside of the plane its outermost pixels repeat. The bits are overwritten, and `wide` is
/// memory to use.
#[inline(always)]
pub(crate) fn runs(
    bits: &mut [u64],
    columns: Range<usize>,
    height: usize,
    wide: &mut Vec<u64>,
    runs: &mut Runs,
) {
    let words = columns.len().div_ceil(WORD).max(1);
    wide.resize(words * height, 0);
    // Erosion: bits that are not set spread.
    for row in bits.chunks_exact_mut(words) {
        complement(row, columns.len());
    }
    spread_rows(bits, words, wide);
    for (v, row) in bits.chunks_exact_mut(words).enumerate() {
        around(wide, words, v, row);
        complement(row, columns.len());
    }
    spread_rows(bits, words, wide);
    runs.clear();
    let row = &mut bits[..words.min(words * height)];
    for v in 0..height {
        around(wide, words, v, row);
        clip(row, columns.len());
        runs_of(row, &columns, runs);
        runs.end_row();
    }
}

/// Sets the bits to each side of every one that is set, along all rows.
#[inline(always)]
fn spread_rows(bits: &[u64], words: usize, wide: &mut [u64]) {
    for (row, wide) in bits.chunks_exact(words).zip(wide.chunks_exact_mut(words)) {
        spread(row, HALF as u32, wide);
    }
}

/// What is set in row `v`, or in those above and below it that the square reaches.
#[inline(always)]
fn around(plane: &[u64], words: usize, v: usize, out: &mut [u64]) {
    let height = plane.len() / words;
    out.fill(0);
    for other in v.saturating_sub(HALF)..(v + HALF + 1).min(height) {
        for (out, &x) in out.iter_mut().zip(&plane[other * words..]) {
            *out |= x;
        }
    }
}

/// The runs of ones of a row, whose bits are those of these columns.
#[inline(always)]
fn runs_of(bits: &[u64], columns: &Range<usize>, runs: &mut Runs) {
    let (mut start, mut inside) = (0, 0u64);
    for (k, &word) in bits.iter().enumerate() {
        // A bit wherever a pixel differs from that before.
        let mut changes = word ^ (word << 1 | inside);
        while changes != 0 {
            let at = columns.start + k * WORD + changes.trailing_zeros() as usize;
            if inside == 0 {
                start = at;
            } else {
                runs.push(Run::new(start, at));
            }
            inside ^= 1;
            changes &= changes - 1;
        }
    }
    if inside != 0 {
        runs.push(Run::new(start, columns.end));
    }
}

#[cfg(test)]
mod tests {
    use super::{HALF, runs};
    use crate::base::image::Plane;
    use crate::kernels::bit_rows::WORD;
    use crate::kernels::pixel_runs::{Run, Runs};
    use proptest::prelude::{ProptestConfig, prop_assert_eq, proptest};

    /// By the definition: all of, or any of, the square around each pixel.
    fn plain(plane: &Plane<u8>, all: bool) -> Plane<u8> {
        const SIDE: usize = 2 * HALF + 1;
        let (w, h) = (plane.width(), plane.height());
        let mut out = Plane::filled(w, h, 0);
        for v in 0..h {
            for u in 0..w {
                let near = (0..SIDE * SIDE).map(|i| {
                    let place = |x: usize, end: usize| x.saturating_sub(HALF).min(end - 1);
                    plane.at(place(u + i % SIDE, w), place(v + i / SIDE, h)) != 0
                });
                let mut near = near;
                out.set(u, v, u8::from(if all { near.all(|x| x) } else { near.any(|x| x) }));
            }
        }
        out
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn bits_are_opened_as_pixels_are(
            w in 1usize..200,
            h in 1usize..12,
            first in 0usize..100,
            holes in proptest::collection::vec((0usize..200, 0usize..12), 0..30),
        ) {
            let words = w.div_ceil(WORD);
            let mut ones = Plane::filled(w, h, 1u8);
            let mut bits = vec![u64::MAX; words * h];
            for (u, v) in holes {
                let (u, v) = (u % w, v % h);
                ones.set(u, v, 0);
                bits[v * words + u / WORD] &= !(1 << (u % WORD));
            }
            let mut expected = Runs::default();
            let opened = Runs::of(&plain(&plain(&ones, true), false));
            for v in 0..h {
                let moved = opened.row(v).iter().map(|run| Run::new(run.start() + first, run.end() + first));
                moved.for_each(|run| expected.push(run));
                expected.end_row();
            }
            let mut found = Runs::default();
            runs(&mut bits, first..first + w, h, &mut Vec::new(), &mut found);
            prop_assert_eq!(found.height(), h);
            for v in 0..h {
                prop_assert_eq!(found.row(v), expected.row(v));
            }
        }
    }
}
