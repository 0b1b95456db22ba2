// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which pixels' upper envelope lies above a level, in rows of bits: 64 pixels a word.
//!
//! The envelope is a closing along the row and a median of 3 x 3 pixels of that. Both give one of the values that they
//! see, by the order of these alone: what they give lies above a level where they give a one for the pixels that do.
//! So they need not be made of values where the level is known, and where nothing lies above it there is nothing to
//! do.

use crate::base::image::Mono8;
use crate::kernels::bit_rows::{WORD, bits_above, even};
use std::ops::Range;

/// Pixels to each side that a closing can reach: those of a word.
const MOST: usize = WORD - 1;

/// Rows that are used again from frame to frame.
#[derive(Debug, Default)]
pub(crate) struct Above {
    /// A bit for each pixel above the level, before the closing.
    raw: Vec<u64>,
    /// A row of these bits after the dilation.
    wide: Vec<u64>,
    /// The last three rows after the closing.
    closed: [Vec<u64>; 3],
    /// How many of these three bits are set in each column, as a binary number: its ones and its twos.
    count: [Vec<u64>; 2],
}

impl Above {
    /// A bit for each pixel whose envelope lies above `level`, row by row, in columns that are returned and begin with
    /// a word: beside them there is none. The closing reaches `half` pixels to each side, 63 at most; the image's
    /// outermost pixels have no median.
    #[inline(always)]
    pub(crate) fn find(
        &mut self,
        image: Mono8<'_>,
        level: u8,
        half: usize,
        bits: &mut Vec<u64>,
    ) -> Range<usize> {
        let (w, h) = (image.width(), image.height());
        let all = w.div_ceil(WORD);
        let half = half.min(MOST) as u32;
        let Self { raw, wide, closed, count } = self;
        raw.resize(all * h, 0);
        let (mut first, mut end) = (all, 0);
        for (v, row) in raw.chunks_exact_mut(all.max(1)).enumerate() {
            find_raw(image.row(v), level, row);
            first = first.min(row.iter().position(|&word| word != 0).unwrap_or(all));
            end = end.max(row.iter().rposition(|&word| word != 0).map_or(0, |last| last + 1));
        }
        // One word more on either side, which the closing may set bits of.
        let (first, end) = (first.min(end).saturating_sub(1), (end + 1).min(all));
        let columns = first * WORD..(end * WORD).min(w);
        let (words, width) = (end - first, columns.len());
        bits.resize(words * h, 0);
        for row in closed.iter_mut().chain(count.iter_mut()).chain([&mut *wide]) {
            row.resize(words, 0);
        }
        for v in 0..h {
            let next = if v == 0 { 0..h.min(2) } else { v + 1..h.min(v + 2) };
            for v in next {
                close(&raw[v * all + first..v * all + end], width, half, wide, &mut closed[v % 3]);
            }
            let (above, own, below) = (&closed[(v + 2) % 3], &closed[v % 3], &closed[(v + 1) % 3]);
            let out = &mut bits[v * words..(v + 1) * words];
            if v > 0 && v + 1 < h && w >= 3 {
                median3x3([above, own, below], width, count, out);
            } else {
                out.copy_from_slice(own);
            }
        }
        columns
    }
}

/// A bit for each pixel above `level`.
#[inline(always)]
fn find_raw(row: &[u8], level: u8, bits: &mut [u64]) {
    let (words, rest) = row.as_chunks::<WORD>();
    for (pixels, word) in words.iter().zip(&mut *bits) {
        // Most of a frame is dark.
        let mut most = 0;
        for &x in pixels {
            most = most.max(x);
        }
        *word = if most > level { bits_above(pixels, level) } else { 0 };
    }
    if let Some(word) = bits.get_mut(words.len()) {
        let mut pixels = [0; WORD];
        pixels[..rest.len()].copy_from_slice(rest);
        *word = bits_above(&pixels, level);
    }
}

/// The closing of a row of `width` bits, whose ends repeat: dilation by `half` bits to each side, then erosion by as
/// many. `wide` is memory to use.
#[inline(always)]
fn close(row: &[u64], width: usize, half: u32, wide: &mut [u64], out: &mut [u64]) {
    if row.iter().all(|&word| word == 0) {
        return out.fill(0);
    }
    spread(row, half, wide);
    // Erosion: bits that are not set spread, but not from beyond the ends.
    complement(wide, width);
    spread(wide, half, out);
    complement(out, width);
}

/// Sets what is not set of a row of `width` bits, and takes away what is.
#[inline(always)]
pub(super) fn complement(row: &mut [u64], width: usize) {
    row.iter_mut().for_each(|word| *word = !*word);
    clip(row, width);
}

/// Takes away what lies beyond the `width` bits of a row.
#[inline(always)]
pub(super) fn clip(row: &mut [u64], width: usize) {
    if let Some(last) = row.last_mut() {
        *last &= u64::MAX >> (width.next_multiple_of(WORD) - width);
    }
}

/// Sets `half` bits to each side of every one that is set. Bits beyond the row's end may be set, too.
#[inline(always)]
pub(super) fn spread(row: &[u64], half: u32, out: &mut [u64]) {
    let mut before = 0;
    for i in 0..row.len() {
        let own = row[i];
        let behind = row.get(i + 1).copied().unwrap_or(0);
        out[i] = if even(own) && before == own && behind == own {
            own
        } else {
            let up = smear(u128::from(own) << WORD | u128::from(before), half, |x, by| x << by);
            let down = smear(u128::from(behind) << WORD | u128::from(own), half, |x, by| x >> by);
            (up >> WORD) as u64 | down as u64
        };
        before = own;
    }
}

/// Sets `half` bits beside every one, in one direction, by doubling.
#[inline(always)]
fn smear(bits: u128, half: u32, shift: impl Fn(u128, u32) -> u128) -> u128 {
    let (mut bits, mut covered) = (bits, 0);
    while covered < half {
        let by = (covered + 1).min(half - covered);
        bits |= shift(bits, by);
        covered += by;
    }
    bits
}

/// The median of the nine bits around each of a row of `width`: five and more are set. The first and the last have
/// none.
#[inline(always)]
fn median3x3([above, own, below]: [&[u64]; 3], width: usize, count: &mut [Vec<u64>; 2], out: &mut [u64]) {
    let words = own.len();
    let (above, below) = (&above[..words], &below[..words]);
    let [ones, twos] = count;
    let (ones, twos) = (&mut ones[..words], &mut twos[..words]);
    let mut any = 0;
    for i in 0..words {
        let (a, b, c) = (above[i], own[i], below[i]);
        any |= a | b | c;
        (ones[i], twos[i]) = sum(a, b, c);
    }
    if any == 0 {
        return out.fill(0);
    }
    let beside = |row: &[u64], i: usize| {
        let (before, behind) = (i.checked_sub(1).map_or(0, |i| row[i]), row.get(i + 1).copied().unwrap_or(0));
        (row[i] << 1 | before >> (WORD - 1), row[i], row[i] >> 1 | behind << (WORD - 1))
    };
    for (i, out) in out.iter_mut().enumerate() {
        let ((a, b, c), (d, e, f)) = (beside(ones, i), beside(twos, i));
        let (one, two) = sum(a, b, c);
        let (other_two, four) = sum(d, e, f);
        // Five and more of nine.
        *out = four & (two | other_two) | one & (four | two & other_two);
    }
    let (last, bit) = ((width - 1) / WORD, 1 << ((width - 1) % WORD));
    out[0] = out[0] & !1 | own[0] & 1;
    out[last] = out[last] & !bit | own[last] & bit;
}

/// How many of three bits are set: ones and twos.
#[inline(always)]
fn sum(a: u64, b: u64, c: u64) -> (u64, u64) {
    (a ^ b ^ c, a & b | c & (a ^ b))
}

#[cfg(test)]
mod tests {
    use super::{Above, MOST};
    use crate::base::image::{Mono8, Plane};
    use crate::kernels::bit_rows::WORD;
    use proptest::prelude::{ProptestConfig, prop_assert_eq, proptest};

    /// The envelope by its definition, of values: the row closing, then the median of 3 x 3 but for the outermost
    /// pixels.
    fn envelope(image: &Plane<u8>, half: usize) -> Plane<u8> {
        let (w, h) = (image.width(), image.height());
        let slide = |from: &Plane<u8>, extreme: fn(u8, u8) -> u8| {
            let mut to = from.clone();
            for v in 0..h {
                for u in 0..w {
                    let window = &from.row(v)[u.saturating_sub(half)..(u + half + 1).min(w)];
                    to.set(u, v, window.iter().copied().reduce(extreme).expect("a window holds its pixel"));
                }
            }
            to
        };
        let closed = slide(&slide(image, u8::max), u8::min);
        let mut out = closed.clone();
        for v in 1..h.saturating_sub(1) {
            for u in 1..w.saturating_sub(1) {
                let mut nine: Vec<u8> = (0..9).map(|i| closed.at(u + i % 3 - 1, v + i / 3 - 1)).collect();
                nine.sort_unstable();
                out.set(u, v, nine[4]);
            }
        }
        out
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(128))]
        #[test]
        fn bits_are_where_the_envelope_of_values_lies_above(
            w in 1usize..400,
            h in 1usize..9,
            half in 0usize..=MOST,
            bright in proptest::collection::vec((0usize..400, 0usize..9, 1usize..90, 0u8..9), 0..12),
        ) {
            let mut image = Plane::filled(w, h, 4u8);
            for (u, v, length, value) in bright {
                (u..u + length).filter(|&u| u < w).for_each(|u| image.set(u, v % h, value));
            }
            let expected = envelope(&image, half);
            let mut bits = Vec::new();
            let columns = Above::default().find(Mono8::from(&image), 4, half, &mut bits);
            let words = columns.len().div_ceil(WORD);
            for v in 0..h {
                for u in 0..w {
                    let place = u.checked_sub(columns.start).filter(|_| u < columns.end);
                    let found = place.is_some_and(|i| bits[v * words + i / WORD] >> (i % WORD) & 1 != 0);
                    prop_assert_eq!(found, expected.at(u, v) > 4, "{} {}", u, v);
                }
            }
        }
    }
}
