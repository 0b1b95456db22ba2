// SPDX-License-Identifier: MIT OR Apache-2.0
//! Opening by a square of five pixels, or by as many columns of fewer rows, on rows of bits: 64 pixels a word.

use crate::kernels::bit_rows::{WORD, even};
use crate::kernels::pixel_runs::{Run, Runs};
use std::ops::Range;

/// Side of the square.
#[cfg(test)]
const SIDE: usize = 2 * HALF + 1;

/// Pixels that it reaches to each side.
const HALF: usize = 2;

/// Rows of bits that are used again from frame to frame.
#[derive(Debug, Default)]
pub(crate) struct Opening {
    /// What is left along rows and columns, then widened along the rows.
    wide: Vec<u64>,
}

impl Opening {
    /// The runs of a plane of bits of these columns of `h` rows, each row of as many words as it needs, after erosion and dilation by
    /// five columns of `2 half_rows + 1` rows; outside of the plane its outermost pixels repeat. What is left of the bits is any.
    #[inline(always)]
    pub(crate) fn runs(
        &mut self,
        narrow: &mut [u64],
        columns: Range<usize>,
        (h, half_rows): (usize, usize),
        runs: &mut Runs,
    ) {
        let w = columns.len();
        let words = w.div_ceil(WORD).max(1);
        let Self { wide } = self;
        wide.resize(words * h, 0);
        for bits in narrow.chunks_exact_mut(words) {
            along(bits, w, |x, y| x & y);
        }
        for (v, out) in wide.chunks_exact_mut(words).enumerate() {
            across(narrow, words, (v, half_rows), out, |x, y| x & y);
            along(out, w, |x, y| x | y);
        }
        runs.clear();
        let row = &mut narrow[..words.min(words * h)];
        for v in 0..h {
            across(wide, words, (v, half_rows), row, |x, y| x | y);
            runs_of(row, &columns, runs);
            runs.end_row();
        }
    }
}

/// Puts each bit of a row of `width` bits together with the two before and behind it; the ends repeat. What lies beyond
/// `width` is cleared.
#[inline(always)]
fn along(bits: &mut [u64], width: usize, together: impl Fn(u64, u64) -> u64 + Copy) {
    let (Some(&first), Some(last)) = (bits.first(), width.checked_sub(1)) else { return };
    // From the last pixel on: all as that one is.
    let (place, shift) = (last / WORD, last % WORD);
    let rest = u64::MAX << shift;
    let repeated = |bit: u64| 0u64.wrapping_sub(bit & 1);
    let end = repeated(bits[place] >> shift);
    bits[place] = bits[place] & !rest | end & rest;
    let mut before = repeated(first);
    for i in 0..=place {
        let own = bits[i];
        let behind = if i < place { bits[i + 1] } else { end };
        // Most words are empty or full, and those beside them.
        if !even(own) || before != own || behind != own {
            let mut out = own;
            for k in 1..=HALF as u32 {
                let left = own << k | before >> (u64::BITS - k);
                let right = own >> k | behind << (u64::BITS - k);
                out = together(together(out, left), right);
            }
            bits[i] = out;
        }
        before = own;
    }
    bits[place] &= u64::MAX >> (WORD - 1 - shift);
}

/// Puts row `v` together with `half` rows above and below, as far as there are.
#[inline(always)]
fn across(
    plane: &[u64],
    words: usize,
    (v, half): (usize, usize),
    out: &mut [u64],
    together: impl Fn(u64, u64) -> u64 + Copy,
) {
    let height = plane.len() / words;
    let rows = v.saturating_sub(half)..(v + half + 1).min(height);
    out.copy_from_slice(&plane[v * words..(v + 1) * words]);
    for other in rows.filter(|&other| other != v) {
        for (out, &x) in out.iter_mut().zip(&plane[other * words..]) {
            *out = together(*out, x);
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
    use super::{HALF, Opening, SIDE};
    use crate::base::image::Plane;
    use crate::kernels::bit_rows::WORD;
    use crate::kernels::pixel_runs::{Run, Runs};
    use proptest::prelude::{ProptestConfig, prop_assert_eq, proptest};

    /// By the definition: all of, or any of, the square around each pixel.
    fn plain(plane: &Plane<u8>, half_rows: usize, all: bool) -> Plane<u8> {
        let (w, h) = (plane.width(), plane.height());
        let mut out = Plane::filled(w, h, 0);
        for v in 0..h {
            for u in 0..w {
                let near = (0..SIDE * (2 * half_rows + 1)).map(|i| {
                    let place = |x: usize, half: usize, end: usize| x.saturating_sub(half).min(end - 1);
                    plane.at(place(u + i % SIDE, HALF, w), place(v + i / SIDE, half_rows, h)) != 0
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
            half_rows in 1usize..=HALF,
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
            let opened = Runs::of(&plain(&plain(&ones, half_rows, true), half_rows, false));
            for v in 0..h {
                let moved = opened.row(v).iter().map(|run| Run::new(run.start() + first, run.end() + first));
                moved.for_each(|run| expected.push(run));
                expected.end_row();
            }
            let mut found = Runs::default();
            Opening::default().runs(&mut bits, first..first + w, (h, half_rows), &mut found);
            prop_assert_eq!(found.height(), h);
            for v in 0..h {
                prop_assert_eq!(found.row(v), expected.row(v));
            }
        }
    }
}
