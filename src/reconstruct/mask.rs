//! Object mask Om: which pixels show the lit object (paper, 4.1, Figure 6).
//!
//! Two forms. [`envelope`] (default) thresholds the logarithm of the fringes' upper envelope and keeps every
//! component, so that dark hair and detached hands survive; [`otsu`] is the paper's: Otsu on the raw image,
//! dilation and erosion, largest segment.

use super::components;
use crate::image::{Mono8, Plane};

/// Pixels at or above this value are over-exposed: their phase means nothing.
pub const SATURATED: u8 = 250;

/// Smallest component that [`envelope`] keeps, px.
const MIN_COMPONENT_PX: u32 = 400;

/// Envelope levels below the black level by less than this are never object, DN.
const MIN_ABOVE_BLACK_DN: u8 = 6;

/// Envelope levels above the black level by more than this are always object, DN: fringes on dark hair are
/// that weak, and Otsu's threshold, drawn by the mass of bright skin, lies above them.
const MAX_ABOVE_BLACK_DN: u8 = 8;

/// The default mask: 1 on the object, 0 elsewhere and on over-exposed pixels. `period_px` is the nominal
/// fringe period in the image.
pub fn envelope(image: Mono8<'_>, period_px: f32) -> Plane<u8> {
    let width = (1.2 * period_px).ceil() as usize | 1;
    let mut closed = Plane::filled(image.width(), image.height(), 0u8);
    let (mut scratch, mut raised) = (Scratch::default(), vec![0; image.width()]);
    for v in 0..image.height() {
        scratch.sliding(image.row(v), &mut raised, width, u8::max);
        scratch.sliding(&raised, closed.row_mut(v), width, u8::min);
    }
    let smooth = median3x3(&closed);
    let level = log_threshold(&smooth);
    let mut mask = threshold(&smooth, level);
    mask = open(&mask, 5);
    keep_large(&mut mask);
    remove_saturated(&mut mask, image);
    mask
}

/// The paper's mask: Otsu on the raw image without over-exposed pixels, dilation and erosion by one fringe
/// period, largest segment.
pub fn otsu(image: Mono8<'_>, period_px: f32) -> Plane<u8> {
    let mut histogram = [0u32; 256];
    for &value in image.as_slice().iter().filter(|&&value| value < SATURATED) {
        histogram[usize::from(value)] += 1;
    }
    let level = otsu_level(&histogram) as u8;
    let data = image.as_slice().iter().map(|&x| u8::from(x > level)).collect();
    let raw = Plane::from_vec(image.width(), image.height(), data).unwrap_or_else(|| Plane::filled(0, 0, 0));
    let width = (1.2 * period_px).ceil() as usize | 1;
    let dilated = square(&raw, width, u8::max);
    let mut mask = square(&dilated, width, u8::min);
    let found = components::label(&mask);
    let largest = (1..found.area.len()).max_by_key(|&i| (found.area[i], usize::MAX - i)).unwrap_or(0) as u32;
    for (pixel, label) in mask.as_mut_slice().iter_mut().zip(found.label.as_slice()) {
        *pixel = u8::from(*label == largest && largest != 0);
    }
    remove_saturated(&mut mask, image);
    mask
}

/// Threshold on the envelope: Otsu on its logarithm, but never within the noise of the black level.
fn log_threshold(envelope: &Plane<u8>) -> u8 {
    let mut counts = [0u32; 256];
    for &value in envelope.as_slice() {
        counts[usize::from(value)] += 1;
    }
    let mut logarithmic = [0u32; 256];
    let bin = |value: usize| ((value as f32 + 1.0).log2() * 31.0) as usize;
    for (value, &count) in counts.iter().enumerate() {
        logarithmic[bin(value)] += count;
    }
    let level = otsu_level(&logarithmic);
    let from_otsu = (0..256).rev().find(|&value| bin(value) <= level).unwrap_or(0) as u8;
    // The most frequent level of the darker class: that of the whole frame is the object's where it fills the frame.
    let black = (0..=usize::from(from_otsu)).max_by_key(|&i| (counts[i], 256 - i)).unwrap_or(0) as u8;
    from_otsu.clamp(black.saturating_add(MIN_ABOVE_BLACK_DN), black.saturating_add(MAX_ABOVE_BLACK_DN))
}

/// Otsu's threshold (1979): the last bin of the darker class.
fn otsu_level(histogram: &[u32; 256]) -> usize {
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

fn threshold(image: &Plane<u8>, level: u8) -> Plane<u8> {
    let data = image.as_slice().iter().map(|&x| u8::from(x > level)).collect();
    Plane::from_vec(image.width(), image.height(), data).unwrap_or_else(|| Plane::filled(0, 0, 0))
}

fn remove_saturated(mask: &mut Plane<u8>, image: Mono8<'_>) {
    for (pixel, &value) in mask.as_mut_slice().iter_mut().zip(image.as_slice()) {
        *pixel &= u8::from(value < SATURATED);
    }
}

fn keep_large(mask: &mut Plane<u8>) {
    let found = components::label(mask);
    for (pixel, &label) in mask.as_mut_slice().iter_mut().zip(found.label.as_slice()) {
        *pixel = u8::from(label != 0 && found.area[label as usize] >= MIN_COMPONENT_PX);
    }
}

/// Morphological opening with a square of `width` (odd) pixels.
fn open(mask: &Plane<u8>, width: usize) -> Plane<u8> {
    square(&square(mask, width, u8::min), width, u8::max)
}

/// Sliding extreme over a square of `width` (odd) pixels.
fn square(image: &Plane<u8>, width: usize, extreme: impl Fn(u8, u8) -> u8 + Copy) -> Plane<u8> {
    let (w, h) = (image.width(), image.height());
    let mut rows = Plane::filled(w, h, 0u8);
    let mut scratch = Scratch::default();
    for v in 0..h {
        scratch.sliding(image.row(v), rows.row_mut(v), width, extreme);
    }
    let mut out = Plane::filled(w, h, 0u8);
    let half = width / 2;
    for v in 0..h {
        let range = v.saturating_sub(half)..(v + half + 1).min(h);
        let row = out.row_mut(v);
        row.copy_from_slice(rows.row(range.start));
        for other in range.skip(1) {
            for (a, &b) in row.iter_mut().zip(rows.row(other)) {
                *a = extreme(*a, b);
            }
        }
    }
    out
}

/// Buffers of the sliding extremes: the passes go from one to the other, so that nothing overlaps.
#[derive(Default)]
struct Scratch([Vec<u8>; 2]);

impl Scratch {
    /// `out[i]` = extreme of `row[i - width/2 ..= i + width/2]`; the ends repeat. Doubling: log2(width) passes
    /// of plain slice operations, which the compiler vectorises.
    fn sliding(&mut self, row: &[u8], out: &mut [u8], width: usize, extreme: impl Fn(u8, u8) -> u8 + Copy) {
        let (Some(&first), Some(&last)) = (row.first(), row.last()) else { return };
        let half = width / 2;
        let [from, to] = &mut self.0;
        from.clear();
        from.resize(half, first);
        from.extend_from_slice(row);
        from.resize(row.len() + 2 * half, last);
        to.resize(from.len(), 0);
        let mut covered = 1;
        while covered < width {
            let step = covered.min(width - covered);
            for ((to, &a), &b) in to.iter_mut().zip(from.iter()).zip(&from[step..]) {
                *to = extreme(a, b);
            }
            std::mem::swap(from, to);
            covered += step;
        }
        out.copy_from_slice(&from[..row.len()]);
    }
}

/// 3 x 3 median; the outermost pixels are copied.
fn median3x3(image: &Plane<u8>) -> Plane<u8> {
    let (w, h) = (image.width(), image.height());
    let mut out = image.clone();
    for v in 1..h.saturating_sub(1) {
        if w < 3 {
            break;
        }
        // Nine slices of equal length: the compiler takes many pixels at once.
        let (a, b, c) = (image.row(v - 1), image.row(v), image.row(v + 1));
        let (a0, a1, a2) = (&a[..w - 2], &a[1..w - 1], &a[2..]);
        let (b0, b1, b2) = (&b[..w - 2], &b[1..w - 1], &b[2..]);
        let (c0, c1, c2) = (&c[..w - 2], &c[1..w - 1], &c[2..]);
        let out = &mut out.row_mut(v)[1..w - 1];
        for u in 0..w - 2 {
            out[u] = median9([a0[u], b0[u], c0[u]], [a1[u], b1[u], c1[u]], [a2[u], b2[u], c2[u]]);
        }
    }
    out
}

/// Median of nine: the median of the largest of the column minima, the median of the column medians and the
/// smallest of the column maxima.
#[inline(always)]
fn median9(left: [u8; 3], middle: [u8; 3], right: [u8; 3]) -> u8 {
    let sorted = |[a, b, c]: [u8; 3]| {
        let (low, high) = (a.min(b), a.max(b));
        (low.min(c), low.max(high.min(c)), high.max(c))
    };
    let ((l0, m0, h0), (l1, m1, h1), (l2, m2, h2)) = (sorted(left), sorted(middle), sorted(right));
    let median3 = |x: u8, y: u8, z: u8| x.min(y).max(x.max(y).min(z));
    median3(l0.max(l1).max(l2), median3(m0, m1, m2), h0.min(h1).min(h2))
}

#[cfg(test)]
mod tests {
    use super::{Scratch, envelope, median9, otsu};
    use crate::image::{Mono8, Plane};
    use proptest::prelude::{any, prop_assert_eq, proptest};

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
    fn dark_and_detached_parts_stay_in_the_envelope_mask_only() {
        let image = two_parts();
        let both = envelope(Mono8::from(&image), 10.0);
        assert!(both.at(70, 60) == 1 && both.at(230, 60) == 1 && both.at(150, 60) == 0);
        let largest = otsu(Mono8::from(&image), 10.0);
        assert!(largest.at(70, 60) == 1 && largest.at(230, 60) == 0);
    }

    #[test]
    fn over_exposed_pixels_leave() {
        let mut image = two_parts();
        image.set(70, 60, 255);
        assert_eq!(envelope(Mono8::from(&image), 10.0).at(70, 60), 0);
    }

    proptest! {
        #[test]
        fn sliding_maximum_is_the_maximum(row in proptest::collection::vec(any::<u8>(), 1..60), half in 0usize..9) {
            let mut out = vec![0; row.len()];
            Scratch::default().sliding(&row, &mut out, 2 * half + 1, u8::max);
            for (i, &found) in out.iter().enumerate() {
                let window = &row[i.saturating_sub(half)..(i + half + 1).min(row.len())];
                prop_assert_eq!(found, window.iter().copied().max().unwrap_or(0));
            }
        }

        #[test]
        fn median_of_nine_is_the_fifth(values in proptest::array::uniform9(any::<u8>())) {
            let mut sorted = values;
            sorted.sort_unstable();
            let [left, middle, right] = [0, 1, 2].map(|i| [values[i], values[3 + i], values[6 + i]]);
            prop_assert_eq!(median9(left, middle, right), sorted[4]);
        }
    }
}
