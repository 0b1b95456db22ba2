// SPDX-License-Identifier: MIT OR Apache-2.0
//! Object mask Om: which pixels show the lit object (paper, 4.1, Figure 6).
//!
//! [`envelope`] thresholds the logarithm of the fringes' upper envelope and keeps every component, so that dark hair
//! and detached hands survive. The paper's own is [`super::paper::mask`].

mod envelope;
mod opening;

use super::kernels::connected_components::{self, Piece};
use super::kernels::pixel_runs::{self, Run, Runs};
use super::kernels::simd;
use super::kernels::sliding::extremes;
use crate::base::image::{Mono8, Plane};
use envelope::Above;

/// Pixels at or above this value are over-exposed: how much light they got is not known.
pub const SATURATED: u8 = 250;

/// Width of the closing over the dark half of a fringe, in nominal fringe periods.
pub(super) const CLOSING_PERIODS: f32 = 1.2;

/// Smallest component that [`envelope`] keeps, px.
const MIN_COMPONENT_PX: u32 = 400;

/// Envelope levels above the black level by less than this are never object, DN: noise alone reaches two.
const MIN_ABOVE_BLACK_DN: u8 = 3;

/// Envelope levels above the black level by more than this are always object, DN: fringes on dark hair are
/// that weak, and Otsu's threshold, drawn by the mass of bright skin, lies above them.
const MAX_ABOVE_BLACK_DN: u8 = 8;

/// Planes and rows that are used again from frame to frame.
#[derive(Debug, Default)]
pub struct Buffers {
    smooth: Plane<u8>,
    closed: [Vec<u8>; 3],
    row: Vec<u8>,
    extremes: [Vec<u8>; 2],
    above: Above,
    bits: Vec<u64>,
    wide: Vec<u64>,
    runs: Runs,
    /// The object's runs with the pixels that are over-exposed.
    pub lit: Runs,
}

/// The default mask: the runs of the object, without over-exposed pixels. `period_px` is the nominal fringe period in
/// the image.
pub fn envelope(image: Mono8<'_>, period_px: f32, buffers: &mut Buffers, object: &mut Runs) {
    let width = (CLOSING_PERIODS * period_px).ceil() as usize | 1;
    simd::dispatch(
        #[inline(always)]
        || {
            sample_envelope(image, width, buffers);
            let Buffers { smooth, above, bits, wide, runs, .. } = &mut *buffers;
            let columns = above.find(image, log_threshold(smooth), width / 2, bits);
            opening::runs(bits, columns, image.height(), wide, runs);
        },
    );
    let Buffers { runs, row, lit, .. } = buffers;
    let is_large = |piece: &Piece| piece.area >= MIN_COMPONENT_PX;
    connected_components::select(runs, |_, pieces| pieces.iter().map(is_large).collect(), lit);
    part(lit, image, row, object);
}

/// Of the image's rows every 16th is used to find the threshold.
const SAMPLED_ROWS: usize = 16;

/// Some rows of the envelope: a row closing of `width` pixels and a 3 x 3 median of it, whose outermost pixels are
/// copied.
#[inline(always)]
fn sample_envelope(image: Mono8<'_>, width: usize, buffers: &mut Buffers) {
    let (w, h) = (image.width(), image.height());
    let Buffers { smooth, closed, row: raised, extremes: sliding, .. } = buffers;
    for row in closed.iter_mut().chain([&mut *raised]) {
        row.resize(w, 0);
    }
    let first = (h / 2).min(SAMPLED_ROWS / 2);
    smooth.reshape(w, (h - first).div_ceil(SAMPLED_ROWS), 0);
    for (out, v) in (first..h).step_by(SAMPLED_ROWS).enumerate() {
        let rows = [v.saturating_sub(1), v, (v + 1).min(h - 1)];
        for (v, closed) in rows.into_iter().zip(&mut *closed) {
            extremes(image.row(v), width / 2, width, sliding, u8::max);
            raised.copy_from_slice(&sliding[0][..w]);
            extremes(raised, width / 2, width, sliding, u8::min);
            closed.copy_from_slice(&sliding[0][..w]);
        }
        let out = smooth.row_mut(out);
        out.copy_from_slice(&closed[1]);
        if v > 0 && v + 1 < h && w >= 3 {
            median3x3([&closed[0], &closed[1], &closed[2]], &mut out[1..w - 1]);
        }
    }
}

/// 3 x 3 median of three rows: the median of the largest of the column minima, the median of the column medians and
/// the smallest of the column maxima. The first and the last column have none.
#[inline(always)]
fn median3x3([above, own, below]: [&[u8]; 3], out: &mut [u8]) {
    let sorted = |a: u8, b: u8, c: u8| {
        let (less, more) = (a.min(b), a.max(b));
        [less.min(c), less.max(more.min(c)), more.max(c)]
    };
    let n = out.len();
    let (above, own, below) = (&above[..n + 2], &own[..n + 2], &below[..n + 2]);
    for u in 0..n {
        let [l0, m0, h0] = sorted(above[u], own[u], below[u]);
        let [l1, m1, h1] = sorted(above[u + 1], own[u + 1], below[u + 1]);
        let [l2, m2, h2] = sorted(above[u + 2], own[u + 2], below[u + 2]);
        let [_, middle, _] = sorted(m0, m1, m2);
        [_, out[u], _] = sorted(l0.max(l1).max(l2), middle, h0.min(h1).min(h2));
    }
}

/// Threshold on the envelope: Otsu on its logarithm, but never within the noise of the black level.
#[inline(always)]
fn log_threshold(envelope: &Plane<u8>) -> u8 {
    let counts = histogram(envelope.as_slice());
    let mut logarithmic = [0u32; 256];
    let bin = |value: usize| ((value as f32 + 1.0).log2() * 31.0) as usize;
    for (value, &count) in counts.iter().enumerate() {
        logarithmic[bin(value)] += count;
    }
    let level = otsu_level(&logarithmic);
    let from_otsu = (0..256).rev().find(|&value| bin(value) <= level).unwrap_or(0) as u8;
    // The most frequent level of the darker class. That of the whole frame would be the object's where it fills the
    // frame.
    let black = (0..=usize::from(from_otsu)).max_by_key(|&i| (counts[i], 256 - i)).unwrap_or(0) as u8;
    from_otsu.clamp(black.saturating_add(MIN_ABOVE_BLACK_DN), black.saturating_add(MAX_ABOVE_BLACK_DN))
}

/// Otsu's threshold (1979): the last bin of the darker class.
pub(super) fn otsu_level(histogram: &[u32; 256]) -> usize {
    let total: f64 = histogram.iter().map(|&n| f64::from(n)).sum();
    let sum: f64 = histogram.iter().enumerate().map(|(i, &n)| i as f64 * f64::from(n)).sum();
    let (mut below, mut sum_below) = (0.0, 0.0);
    let mut best = (0.0, 0);
    for (i, &n) in histogram.iter().enumerate() {
        below += f64::from(n);
        sum_below += i as f64 * f64::from(n);
        let above = total - below;
        if below == 0.0 || above == 0.0 {
            continue;
        }
        let gap = sum_below / below - (sum - sum_below) / above;
        let between = below * above * gap * gap;
        if between > best.0 {
            best = (between, i);
        }
    }
    best.1
}

/// How often each value occurs.
pub(super) fn histogram(values: &[u8]) -> [u32; 256] {
    let mut counts = [0; 256];
    values.iter().for_each(|&value| counts[usize::from(value)] += 1);
    counts
}

/// The object's runs, parted by over-exposed pixels. `row` is memory to use.
fn part(lit: &Runs, image: Mono8<'_>, row: &mut Vec<u8>, object: &mut Runs) {
    object.clear();
    simd::dispatch(
        #[inline(always)]
        || {
            for v in 0..lit.height() {
                for run in lit.row(v) {
                    let pixels = &image.row(v)[run.columns()];
                    row.resize(pixels.len(), 0);
                    for (good, &x) in row.iter_mut().zip(pixels) {
                        *good = u8::from(x < SATURATED);
                    }
                    pixel_runs::runs_of(
                        row,
                        #[inline(always)]
                        |first, end| object.push(Run::new(run.start() + first, run.start() + end)),
                    );
                }
                object.end_row();
            }
        },
    );
}

#[cfg(test)]
mod tests {
    use super::{Buffers, envelope, median3x3};
    use crate::base::image::{Mono8, Plane};
    use crate::kernels::pixel_runs::Runs;
    use proptest::prelude::{any, prop_assert_eq, proptest};

    /// The mask as a plane.
    fn mask(image: &Plane<u8>) -> Plane<u8> {
        let (mut object, mut plane) = (Runs::default(), Plane::filled(image.width(), image.height(), 7));
        envelope(Mono8::from(image), 10.0, &mut Buffers::default(), &mut object);
        object.paint(&mut plane);
        plane
    }

    /// A bright and a dark fringed rectangle, apart, on black.
    fn two_parts() -> Plane<u8> {
        let mut image = Plane::filled(300, 120, 2u8);
        for v in 10..110 {
            for u in (20..120).chain(180..280) {
                let level = if u < 150 { 90.0 } else { 12.0 };
                let fringe = 1.0 + (std::f32::consts::TAU * u as f32 / 10.0).cos();
                image.set(u, v, (2.0 + level * fringe) as u8);
            }
        }
        image
    }

    #[test]
    fn dark_and_detached_parts_stay() {
        let both = mask(&two_parts());
        assert!(both.at(70, 60) == 1 && both.at(230, 60) == 1 && both.at(150, 60) == 0);
    }

    #[test]
    fn over_exposed_pixels_leave() {
        let mut image = two_parts();
        image.set(70, 60, 255);
        let found = mask(&image);
        assert_eq!([69, 70, 71].map(|u| found.at(u, 60)), [1, 0, 1]);
    }

    proptest! {
        #[test]
        fn median_of_nine_is_the_fifth(values in proptest::collection::vec(any::<u8>(), 3 * 40)) {
            let rows = [&values[..40], &values[40..80], &values[80..]];
            let mut out = vec![0; 38];
            median3x3(rows, &mut out);
            for (u, &found) in out.iter().enumerate() {
                let mut nine: Vec<u8> = rows.iter().flat_map(|row| row[u..u + 3].to_vec()).collect();
                nine.sort_unstable();
                prop_assert_eq!(found, nine[4]);
            }
        }
    }
}
