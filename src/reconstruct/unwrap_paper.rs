//! The paper's unwrapping and marker (4.1, Figure 9): one spanning tree guided by Qm, one shift.
//!
//! The tree is Kruskal's with union-find. An edge is as good as the worse of its two pixels' Qm; the wrapped
//! step between neighbours is taken as the true one. The tree from any seed is the same, so that the paper's
//! random seed pixel, from the best 10 % of Qm, only chooses the component: here the one that holds the pixel
//! of the best Qm. The marker is found by a band pass in the Fourier transform of each image column, a
//! threshold and the largest segment; the median of the unwrapped phase under it gives the shift (Equation 5).

use super::absolute::shift_of_median;
use super::components;
use super::pair::Pair;
use crate::image::{Mono8, Plane};
use rustfft::FftPlanner;
use rustfft::num_complex::Complex;
use std::f32::consts::{FRAC_PI_2, TAU};

/// The marker's band: frequencies from 1 / (this * period) to this / period.
const BAND: f32 = 1.35;

/// Share of the brightest band energy, relative to the light, that counts as marker.
const THRESHOLD: f32 = 0.35;

/// Um: the phase unwrapped over the tree of the best pixel; NaN elsewhere.
pub fn unwrap(wrapped: &Plane<f32>, quality: &Plane<f32>) -> Plane<f32> {
    let (w, phase, q) = (wrapped.width(), wrapped.as_slice(), quality.as_slice());
    let mut tree = Tree::new(phase.len());
    for edge in edges_by_quality(wrapped, quality) {
        let a = (edge >> 1) as usize;
        let b = if edge & 1 == 1 { a + w } else { a + 1 };
        tree.merge(a, b, -((phase[b] - phase[a]) / TAU).round() as i32);
    }
    let best = (0..phase.len())
        .filter(|&i| !phase[i].is_nan())
        .max_by(|&a, &b| q[a].total_cmp(&q[b]).then(b.cmp(&a)));
    let mut out = Plane::filled(w, wrapped.height(), f32::NAN);
    let Some(best) = best else { return out };
    let root = tree.find(best).0;
    for (i, out) in out.as_mut_slice().iter_mut().enumerate() {
        if !phase[i].is_nan() {
            let (own, turns) = tree.find(i);
            if own == root {
                *out = phase[i] + TAU * turns as f32;
            }
        }
    }
    out
}

/// Edges as `2 * pixel + (down ? 1 : 0)`, by falling quality in 4096 steps; ties in the order of the pixels.
fn edges_by_quality(wrapped: &Plane<f32>, quality: &Plane<f32>) -> Vec<u32> {
    const STEPS: usize = 4096;
    let (w, h) = (wrapped.width(), wrapped.height());
    let bucket = |a: f32, b: f32| ((1.0 - a.min(b)).clamp(0.0, 1.0) * (STEPS - 1) as f32) as usize;
    let mut buckets: Vec<Vec<u32>> = vec![Vec::new(); STEPS];
    for v in 0..h {
        for u in 0..w {
            if wrapped.at(u, v).is_nan() {
                continue;
            }
            let pixel = (v * w + u) as u32;
            for (x, y, bit) in [(u + 1, v, 0), (u, v + 1, 1)] {
                if x < w && y < h && !wrapped.at(x, y).is_nan() {
                    buckets[bucket(quality.at(u, v), quality.at(x, y))].push(2 * pixel + bit);
                }
            }
        }
    }
    buckets.concat()
}

/// Union-find whose links carry whole turns.
struct Tree {
    parent: Vec<u32>,
    turns: Vec<i32>,
    size: Vec<u32>,
}

impl Tree {
    fn new(n: usize) -> Self {
        Self { parent: (0..n as u32).collect(), turns: vec![0; n], size: vec![1; n] }
    }

    /// Root of a pixel, and the pixel's turns relative to it.
    fn find(&mut self, pixel: usize) -> (usize, i32) {
        let (mut at, mut turns) = (pixel, 0);
        while self.parent[at] as usize != at {
            // Path halving: skip the parent, with its turns.
            let parent = self.parent[at] as usize;
            let grandparent = self.parent[parent];
            if grandparent as usize != parent {
                self.turns[at] += self.turns[parent];
                self.parent[at] = grandparent;
            }
            turns += self.turns[at];
            at = self.parent[at] as usize;
        }
        (at, turns)
    }

    /// Merges the trees of `a` and `b`, where `b` has `turns` more whole turns than `a`.
    fn merge(&mut self, a: usize, b: usize, turns: i32) {
        let (mut root, turns_a) = self.find(a);
        let (mut other, turns_b) = self.find(b);
        if root == other {
            return;
        }
        let mut shift = turns_a + turns - turns_b;
        if self.size[root] < self.size[other] {
            (root, other, shift) = (other, root, -shift);
        }
        self.parent[other] = root as u32;
        self.turns[other] = shift;
        self.size[root] += self.size[other];
    }
}

/// Mm: energy in the marker's band along each column, relative to the local light, and the largest segment of
/// what exceeds the threshold (1 there).
pub fn marker(image: Mono8<'_>, mask: &Plane<u8>, pair: &Pair) -> (Plane<f32>, Plane<u8>) {
    let energy = band_energy(image, mask, pair.marker_period_px);
    let threshold = THRESHOLD * pair.marker_contrast;
    let data = energy.as_slice().iter().map(|&e| u8::from(e > threshold)).collect();
    let above = Plane::from_vec(mask.width(), mask.height(), data).unwrap_or_else(|| Plane::filled(0, 0, 0));
    let found = components::label(&above);
    let largest = (1..found.area.len()).max_by_key(|&i| (found.area[i], usize::MAX - i)).unwrap_or(0) as u32;
    let mut segment = above;
    for (pixel, &label) in segment.as_mut_slice().iter_mut().zip(found.label.as_slice()) {
        *pixel = u8::from(label != 0 && label == largest);
    }
    (energy, segment)
}

/// Magnitude of each column after a band pass around the marker's frequency (positive frequencies only, so
/// that the magnitude is the envelope), divided by the mean light of the column's object pixels.
fn band_energy(image: Mono8<'_>, mask: &Plane<u8>, period: f32) -> Plane<f32> {
    let (w, h) = (image.width(), image.height());
    let mut planner = FftPlanner::<f32>::new();
    let (forward, inverse) = (planner.plan_fft_forward(h), planner.plan_fft_inverse(h));
    let (low, high) = (h as f32 / (period * BAND), h as f32 * BAND / period);
    let mut out = Plane::filled(w, h, 0f32);
    let mut column = vec![Complex::new(0f32, 0.0); h];
    for u in 0..w {
        let (mut sum, mut count) = (0u32, 0u32);
        for (v, x) in column.iter_mut().enumerate() {
            let value = if mask.at(u, v) != 0 { image.row(v)[u] } else { 0 };
            (sum, count) = (sum + u32::from(value), count + u32::from(mask.at(u, v)));
            *x = Complex::new(f32::from(value), 0.0);
        }
        if count == 0 {
            continue;
        }
        forward.process(&mut column);
        for (k, x) in column.iter_mut().enumerate() {
            if !(low..=high).contains(&(k as f32)) {
                *x = Complex::new(0.0, 0.0);
            }
        }
        inverse.process(&mut column);
        let scale = 2.0 / h as f32 / (sum as f32 / count as f32).max(1.0);
        for (v, x) in column.iter().enumerate() {
            if mask.at(u, v) != 0 {
                out.set(u, v, scale * x.norm());
            }
        }
    }
    out
}

/// Equation 5's shift from the median of the unwrapped phase under the marker's core (|Wm| < pi/2: with the
/// pixels between two fringes the median can sit on their border). `None` without such pixels.
pub fn shift(unwrapped: &Plane<f32>, wrapped: &Plane<f32>, segment: &Plane<u8>, pair: &Pair) -> Option<f32> {
    let pixels = segment.as_slice().iter().zip(wrapped.as_slice()).zip(unwrapped.as_slice());
    let core = pixels.filter(|((marker, phase), _)| **marker != 0 && phase.abs() < FRAC_PI_2);
    let mut phases: Vec<f32> = core.map(|(_, u)| *u).filter(|u| !u.is_nan()).collect();
    phases.sort_unstable_by(f32::total_cmp);
    let median = *phases.get(phases.len() / 2)?;
    Some(shift_of_median(median, pair.pattern.marker_index))
}
