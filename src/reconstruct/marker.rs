//! Marker map Mm of the default method: which pixels lie on the distinguished fringe.
//!
//! A fringe tilted in the image has a period along the column too, and limbs alias into any band there: the
//! carrier is removed first, by the mean over exactly one period along the row. What is left is band-passed
//! along the column at the marker's period and divided by the light. The marker then is a ridge one fringe
//! wide: its energy must stand out of that 1.25 periods to either side, where edges and hems do not. Its core
//! pixels (|W| < pi/2) are separated from those of the next fringe, so that a connected component follows ONE
//! fringe by construction; it must be at least [`MIN_DASHES`] dashes long.

use super::components::{self, Components};
use super::pair::Pair;
use super::period::runs;
use crate::image::{Mono8, Plane};
use std::f32::consts::{FRAC_PI_2, TAU};

/// Shortest marker that counts, in periods of its modulation.
const MIN_DASHES: f32 = 2.5;

/// A marker's lateral contrast must reach this share of the modulation that is projected: blur takes the rest.
const MIN_CONTRAST: f32 = 0.25;

/// Energy beside the marker counts this much against it.
const LATERAL_WEIGHT: f32 = 1.5;

/// Where markers may be, before any phase is looked at.
#[derive(Debug)]
pub struct Ridges {
    /// Modulation along the column at the marker's period, relative to the local light.
    pub energy: Plane<f32>,
    /// 1 where that stands out laterally, in pieces that are long enough.
    pub ridge: Plane<u8>,
}

/// Finds where the light has the marker's modulation along the column, in ridges.
pub fn ridges(image: Mono8<'_>, mask: &Plane<u8>, period: &Plane<f32>, pair: &Pair) -> Ridges {
    let light = carrier_free(image, mask, period);
    let energy = column_energy(&light, pair.marker_period_px);
    let threshold = MIN_CONTRAST * pair.marker_contrast;
    let mut ridge = Plane::filled(mask.width(), mask.height(), 0u8);
    for v in 0..mask.height() {
        let (energy, period) = (energy.row(v), period.row(v));
        for (u, ridge) in ridge.row_mut(v).iter_mut().enumerate() {
            *ridge = u8::from(energy[u] > threshold && lateral_contrast(energy, u, period[u]) > threshold);
        }
    }
    let long = |piece: &Piece| piece.rows() >= MIN_DASHES * pair.marker_period_px;
    let ridge = select(&components::label(&ridge), long);
    Ridges { energy, ridge }
}

/// 1 on the ridges' pixels on the core of one fringe. `wrapped` must already be that of the marker's mean light
/// (see [`super::marker_phase`]): between its dashes a darkened marker has no core of its own.
pub fn detect(ridges: &Ridges, period: &Plane<f32>, wrapped: &Plane<f32>, pair: &Pair) -> Plane<u8> {
    let mut core = ridges.ridge.clone();
    for (core, phase) in core.as_mut_slice().iter_mut().zip(wrapped.as_slice()) {
        *core &= u8::from(phase.abs() < FRAC_PI_2);
    }
    let found = components::label(&core);
    let mut widths = vec![0f32; found.area.len()];
    for (&label, &p) in found.label.as_slice().iter().zip(period.as_slice()) {
        widths[label as usize] += p;
    }
    select(&found, |piece| {
        let mean_period = widths[piece.number] / piece.area;
        piece.rows() >= MIN_DASHES * pair.marker_period_px && piece.area / piece.rows() <= 0.9 * mean_period
    })
}

/// Light averaged over exactly one local period along the row; NaN where that window leaves the mask.
fn carrier_free(image: Mono8<'_>, mask: &Plane<u8>, period: &Plane<f32>) -> Plane<f32> {
    let (w, h) = (image.width(), image.height());
    let mut out = Plane::filled(w, h, f32::NAN);
    let mut prefix = vec![0u32; w + 1];
    for v in 0..h {
        for (i, &x) in image.row(v).iter().enumerate() {
            prefix[i + 1] = prefix[i] + u32::from(x);
        }
        // The integral of the row up to x, where pixel i spans [i - 1/2, i + 1/2]. Exact in f32: below 2^24.
        let integral = |x: f32| {
            let i = (x + 0.5) as usize;
            let fraction = x + 0.5 - i as f32;
            prefix[i] as f32 + fraction * (prefix[(i + 1).min(w)] - prefix[i.min(w)]) as f32
        };
        for run in runs(mask.row(v)) {
            let (first, last) = (run.start as f32 - 0.5, run.end as f32 - 0.5);
            for u in run {
                let half = period.at(u, v) / 2.0;
                let (a, b) = (u as f32 - half, u as f32 + half);
                if half > 0.0 && a >= first && b < last {
                    out.set(u, v, (integral(b) - integral(a)) / (2.0 * half));
                }
            }
        }
    }
    out
}

/// Amplitude of the component of `period` rows along the column, relative to the mean: a Hann window two
/// periods long. NaN where the window holds NaN.
fn column_energy(light: &Plane<f32>, period: f32) -> Plane<f32> {
    let (w, h) = (light.width(), light.height());
    let half = period.round().max(2.0) as usize;
    let taps: Vec<[f32; 3]> = (0..=2 * half)
        .map(|i| {
            let x = i as f32 - half as f32;
            let weight = 0.5 + 0.5 * (TAU * x / (2.0 * half as f32 + 2.0)).cos();
            let (sin, cos) = (TAU * x / period).sin_cos();
            [weight, weight * cos, weight * sin]
        })
        .collect();
    let total: f32 = taps.iter().map(|t| t[0]).sum();
    let leak: f32 = taps.iter().map(|t| t[1]).sum::<f32>() / total;
    let mut out = Plane::filled(w, h, f32::NAN);
    let mut sums = vec![[0f32; 3]; w];
    for v in half..h.saturating_sub(half) {
        sums.fill([0.0; 3]);
        for (i, tap) in taps.iter().enumerate() {
            for (sum, &x) in sums.iter_mut().zip(light.row(v + i - half)) {
                sum[0] += tap[0] * x;
                sum[1] += tap[1] * x;
                sum[2] += tap[2] * x;
            }
        }
        for (out, [mean, real, imaginary]) in out.row_mut(v).iter_mut().zip(&sums) {
            let real = real - leak * mean;
            *out = 2.0 * (real * real + imaginary * imaginary).sqrt() / mean.max(1.0);
        }
    }
    out
}

/// Energy at `u` less that 1.25 periods to either side; negative where neither side is known.
fn lateral_contrast(energy: &[f32], u: usize, period: f32) -> f32 {
    let step = (1.25 * period).round() as usize;
    let left = u.checked_sub(step).map_or(f32::NAN, |x| energy[x]);
    let right = energy.get(u + step).copied().unwrap_or(f32::NAN);
    if left.is_nan() && right.is_nan() {
        return -1.0;
    }
    energy[u] - LATERAL_WEIGHT * left.max(right)
}

/// A component.
struct Piece {
    number: usize,
    area: f32,
    first: usize,
    last: usize,
}

impl Piece {
    /// Rows that it spans.
    fn rows(&self) -> f32 {
        (self.last - self.first + 1) as f32
    }
}

/// 1 on the components for which `keep` holds.
fn select(found: &Components, keep: impl Fn(&Piece) -> bool) -> Plane<u8> {
    let label = &found.label;
    let mut rows = vec![(usize::MAX, 0usize); found.area.len()];
    for v in 0..label.height() {
        for &label in label.row(v).iter().filter(|&&label| label != 0) {
            let (first, last) = &mut rows[label as usize];
            (*first, *last) = ((*first).min(v), (*last).max(v));
        }
    }
    let kept = |number: usize| {
        let (first, last) = rows[number];
        number != 0 && keep(&Piece { number, area: found.area[number] as f32, first, last })
    };
    let kept: Vec<bool> = (0..found.area.len()).map(kept).collect();
    let mut selected = Plane::filled(label.width(), label.height(), 0u8);
    for (selected, label) in selected.as_mut_slice().iter_mut().zip(label.as_slice()) {
        *selected = u8::from(kept[*label as usize]);
    }
    selected
}
