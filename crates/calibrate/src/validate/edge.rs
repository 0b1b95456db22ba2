// SPDX-License-Identifier: MIT OR Apache-2.0
//! The edge of one circle, to some hundredths of a pixel.
//!
//! A directional cloud has no points in a black circle, and its intensities are means over one fringe period along u,
//! so that neither shows the edge itself. Both are explained, though, by a circle on the surface that the fringes
//! light: light = (plane of light) * (1 - c + c * pattern) * (1 - k * circle), seen through the same window as the
//! intensities. Where the circle lies is what explains them best (Gauss and Newton, weights for outliers). The pattern
//! at each pixel comes from the calibration; without one it is taken as even, which costs some tenths of a millimetre.
//!
//! Where the photograph is at hand its grey levels take the place of the intensities, without a window, and with the
//! inside of the circle.

use super::ring::{Organized, Ring, Surface};
use crate::base::image::{Mono8, Plane};
use crate::estimate::median;
use crate::geometry::Device;
use crate::geometry::pattern::Pattern;
use nalgebra::{SMatrix, SVector, Vector3};
use std::f64::consts::TAU;

/// Weights of the seven samples over one period whose sum is the intensity (see `reconstruct::phase::demodulate`).
const WINDOW: [f64; 7] = [5.0 / 42.0, 5.0 / 42.0, 7.0 / 42.0, 8.0 / 42.0, 7.0 / 42.0, 5.0 / 42.0, 5.0 / 42.0];
/// Width of a pixel: the standard deviation of its square along one axis, px.
const PIXEL_PX: f64 = 0.29;
/// The lens' blur, px (standard deviation). Circle and fringes pass it together: where the fringes are steep, each edge
/// is moved by blur² * slope / light, some tenths of a pixel.
const BLUR_PX: f64 = 0.6;
/// Reach of the blur's kernel, px.
const BLUR_REACH: usize = 2;
/// Share of the light that a black circle takes, where the inside of the circle is not seen.
const BLACK: f64 = 0.95;
/// Period of the fringes where there is no calibration, px.
const PERIOD_PX: f64 = 11.0;
/// Pixels beyond the circle that are explained with it: along u beside the window, and along v.
const RIM: f64 = 6.0;
/// Largest distance of the circle's middle from the dark region's middle, as a share of its radius.
const FURTHEST: f64 = 0.3;
/// Largest RMS of the residuals with which an edge is accepted, as a share of the light.
const WORST_RMS: f64 = 0.06;

/// Most rounds of the search.
const ROUNDS: usize = 25;

/// Unknowns: middle (two, m), radius (m), contrast of the fringes, blackness, light and its slopes along u and v.
const UNKNOWNS: usize = 8;
type Unknowns = SVector<f64, UNKNOWNS>;

/// The head that lights the board.
#[derive(Debug, Clone, Copy)]
pub struct Light<'a> {
    pub projector: &'a Device,
    pub pattern: &'a Pattern,
}

/// A circle on the surface.
#[derive(Debug, Clone)]
pub(super) struct Edge {
    surface: Surface,
    /// A pixel inside: where the axes touch the surface.
    pixel: [f64; 2],
    /// Axes along the surface there, unit vectors in the world.
    axes: [Vector3<f64>; 2],
    /// Middle of the circle along the axes, m.
    middle: [f64; 2],
    /// Its radius as found, m.
    pub(super) radius_m: f64,
    /// RMS of the residuals, as a share of the light.
    pub(super) rms: f64,
}

impl Edge {
    /// The point of the surface at a place along the axes, m.
    pub(super) fn point(&self, place: [f64; 2]) -> Vector3<f64> {
        let mut pixel = self.pixel;
        let origin = self.surface.at(self.pixel);
        for _ in 0..8 {
            let away = self.surface.at(pixel) - origin;
            let rest = [place[0] - self.axes[0].dot(&away), place[1] - self.axes[1].dot(&away)];
            let [du, dv] = self.surface.slopes(pixel);
            let slopes = nalgebra::Matrix2::new(
                self.axes[0].dot(&du),
                self.axes[0].dot(&dv),
                self.axes[1].dot(&du),
                self.axes[1].dot(&dv),
            );
            let Some(step) = slopes.try_inverse().map(|m| m * nalgebra::Vector2::from(rest)) else { break };
            pixel = [pixel[0] + step.x, pixel[1] + step.y];
            if step.norm() < 1e-9 {
                break;
            }
        }
        self.surface.at(pixel).coords
    }

    /// The middle of the circle, world, m.
    pub(super) fn centre(&self) -> Vector3<f64> {
        self.point(self.middle)
    }

    /// The edge's point nearest to (`sign` 1) or furthest from (-1) another point of the board, world, m.
    pub(super) fn towards(&self, other: &Vector3<f64>, sign: f64) -> Vector3<f64> {
        let away = other - self.centre();
        let (x, y) = (self.axes[0].dot(&away), self.axes[1].dot(&away));
        let reach = sign * self.radius_m / x.hypot(y);
        self.point([self.middle[0] + reach * x, self.middle[1] + reach * y])
    }
}

/// One pixel of the patch.
struct Pixel {
    /// Place along the axes, m.
    place: [f64; 2],
    /// Its change with u and with v, m/px.
    slopes: [[f64; 2]; 2],
    /// Place in the patch, -1 to 1.
    share: [f64; 2],
    /// The pattern's light over its mean.
    fringe: f64,
    /// Fringe period along u, px.
    period: f64,
}

/// Everything that stays the same while the unknowns are sought.
struct Patch {
    pixels: Plane<u32>,
    list: Vec<Pixel>,
    /// The measured values that are explained, each with its place in the patch.
    seen: Vec<([usize; 2], f64)>,
    /// Whether what is seen went through the window of one period.
    windowed: bool,
}

/// Finds the edge of a circle; `None` where it cannot be explained: cut, hidden, or too few points.
pub(super) fn find(
    cloud: &Organized<'_>,
    ring: &Ring,
    all: &[Ring],
    radius_m: f64,
    light: Option<Light<'_>>,
    photograph: Option<Mono8<'_>>,
) -> Option<Edge> {
    let surface = cloud.surface(ring, all)?;
    let pixel = ring.outline.centre;
    let [du, dv] = surface.slopes(pixel);
    let first = du.try_normalize(0.0)?;
    let axes = [first, (dv - first * first.dot(&dv)).try_normalize(0.0)?];
    let mut edge = Edge { surface, pixel, axes, middle: [0.0; 2], radius_m, rms: f64::NAN };
    let patch = Patch::new(cloud, &edge, light, photograph)?;
    let free = Free { contrast: light.is_some(), black: photograph.is_some() };
    let (unknowns, rms) = patch.solve(radius_m, free)?;
    edge.middle = [unknowns[0], unknowns[1]];
    edge.radius_m = unknowns[2];
    edge.rms = rms;
    let moved = unknowns[0].hypot(unknowns[1]);
    let fits = moved < FURTHEST * radius_m && (0.75..1.25).contains(&(edge.radius_m / radius_m));
    (fits && rms < WORST_RMS).then_some(edge)
}

/// Which unknowns are free: contrast with a calibration, blackness with a photograph.
#[derive(Clone, Copy)]
struct Free {
    contrast: bool,
    black: bool,
}

impl Patch {
    fn new(
        cloud: &Organized<'_>,
        edge: &Edge,
        light: Option<Light<'_>>,
        photograph: Option<Mono8<'_>>,
    ) -> Option<Self> {
        let [du, dv] = edge.surface.slopes(edge.pixel);
        let across = (du - dv * (du.dot(&dv) / dv.norm_squared())).norm();
        let along = (dv - du * (du.dot(&dv) / du.norm_squared())).norm();
        let half_v = edge.radius_m / along + RIM;
        let half_u = edge.radius_m / across + RIM + 10.0;
        if !(half_u < 200.0 && half_v < 200.0) {
            return None;
        }
        // Wider by a window on each side, which the means reach into.
        let (wide, high) = ((half_u + 24.0).ceil() as i64, half_v.ceil() as i64);
        let centre = edge.pixel.map(|x| x.round() as i64);
        let origin = [centre[0] - wide, centre[1] - high];
        let (width, height) = ((2 * wide + 1) as usize, (2 * high + 1) as usize);
        let mut patch = Self {
            pixels: Plane::filled(width, height, 0),
            list: Vec::with_capacity(width * height),
            seen: Vec::new(),
            windowed: photograph.is_none(),
        };
        for y in 0..height {
            for x in 0..width {
                let pixel = [(origin[0] + x as i64) as f64, (origin[1] + y as i64) as f64];
                patch.pixels.set(x, y, patch.list.len() as u32);
                let share = [(pixel[0] - edge.pixel[0]) / half_u, (pixel[1] - edge.pixel[1]) / half_v];
                patch.list.push(look(edge, light, pixel, share)?);
                if share[0].abs() > 1.0 || share[1].abs() > 1.0 {
                    continue;
                }
                let (u, v) = (origin[0] + x as i64, origin[1] + y as i64);
                let value = match photograph {
                    None => cloud.at(u, v).map(|i| cloud.intensity(i)),
                    Some(image) => grey(image, u, v),
                };
                patch.seen.extend(value.map(|value| ([x, y], value)));
            }
        }
        patch.is_surrounded().then_some(patch)
    }

    /// Whether something is seen just outside of the circle all around.
    fn is_surrounded(&self) -> bool {
        let mut sectors = [0usize; 16];
        for &([x, y], _) in &self.seen {
            let pixel = &self.list[self.pixels.at(x, y) as usize];
            let turn = pixel.share[1].atan2(pixel.share[0]).rem_euclid(TAU) / TAU;
            sectors[((turn * 16.0) as usize).min(15)] += 1;
        }
        let least = self.seen.len() / 64;
        sectors.iter().filter(|n| **n <= least).count() <= 1 && self.seen.len() > 200
    }

    /// Light of one pixel, without the lens' blur and without a window.
    fn light(&self, pixel: &Pixel, x: &Unknowns) -> f64 {
        let (px, py) = (pixel.place[0] - x[0], pixel.place[1] - x[1]);
        let away = px.hypot(py).max(1e-9);
        let slope = |[sx, sy]: [f64; 2]| (px * sx + py * sy) / away;
        let per_px = slope(pixel.slopes[0]).hypot(slope(pixel.slopes[1])).max(1e-9);
        // A logistic edge of the same width.
        let outside = (away - x[2]) / per_px;
        let circle = 1.0 / (1.0 + (1.7 * outside / PIXEL_PX).exp());
        let even = x[5] * (1.0 + x[6] * pixel.share[0] + x[7] * pixel.share[1]);
        even * (1.0 - x[3] + x[3] * pixel.fringe) * (1.0 - x[4] * circle)
    }

    /// What should be seen at every place of `seen`.
    fn expected(&self, x: &Unknowns) -> Vec<f64> {
        let mut raw: Vec<f64> = self.list.iter().map(|pixel| self.light(pixel, x)).collect();
        let (wide, high) = (self.pixels.width(), self.pixels.height());
        raw = blurred(&raw, wide, high, 1);
        raw = blurred(&raw, wide, high, wide);
        let at = |column: usize, row: usize| raw[self.pixels.at(column, row) as usize];
        let last = self.pixels.width() - 1;
        let value = |&([column, row], _): &([usize; 2], f64)| {
            if !self.windowed {
                return at(column, row);
            }
            let period = self.list[self.pixels.at(column, row) as usize].period;
            let sample = |(k, weight): (usize, &f64)| {
                let u = (column as f64 + (k as f64 - 3.0) * period / 6.0).clamp(0.0, last as f64);
                let left = (u as usize).min(last.saturating_sub(1));
                let t = u - left as f64;
                weight * (at(left, row) * (1.0 - t) + at((left + 1).min(last), row) * t)
            };
            WINDOW.iter().enumerate().map(sample).sum()
        };
        self.seen.iter().map(value).collect()
    }

    /// The unknowns that explain best, and the RMS of the rest as a share of the light.
    fn solve(&self, radius_m: f64, free: Free) -> Option<(Unknowns, f64)> {
        let mut levels: Vec<f64> = self.seen.iter().map(|s| s.1).collect();
        levels.sort_unstable_by(f64::total_cmp);
        let level = levels[levels.len() * if self.windowed { 3 } else { 2 } / 4].max(1e-6);
        let contrast = if free.contrast { 0.9 } else { 0.0 };
        let mut x = Unknowns::from([0.0, 0.0, radius_m, contrast, BLACK, level, 0.0, 0.0]);
        let scales = Unknowns::from([radius_m, radius_m, radius_m, 1.0, 1.0, level, 1.0, 1.0]);
        let held = [false, false, false, !free.contrast, !free.black, false, false, false];
        for round in 0..ROUNDS {
            let expected = self.expected(&x);
            let rests: Vec<f64> = self.seen.iter().zip(&expected).map(|(s, e)| s.1 - e).collect();
            let gate = 3.0 * 1.4826 * median(rests.iter().map(|r| r.abs())) + 1e-4 * level;
            let mut columns = Vec::new();
            for i in 0..UNKNOWNS {
                let step = 1e-5 * scales[i];
                let mut moved = x;
                moved[i] += step;
                let after = if held[i] { expected.clone() } else { self.expected(&moved) };
                columns.push((after, step));
            }
            let (mut normal, mut right) = (SMatrix::<f64, UNKNOWNS, UNKNOWNS>::zeros(), Unknowns::zeros());
            for (place, rest) in rests.iter().enumerate() {
                let row = Unknowns::from_fn(|i, _| {
                    (columns[i].0[place] - expected[place]) / columns[i].1 * scales[i]
                });
                let weight = (gate / rest.abs().max(gate)).min(1.0);
                normal += row * row.transpose() * weight;
                right += row * (rest * weight);
            }
            for i in (0..UNKNOWNS).filter(|i| held[*i]) {
                normal[(i, i)] = 1.0;
            }
            // A little damping holds unknowns that the pixels hardly determine.
            let trace = normal.trace() / UNKNOWNS as f64;
            (0..UNKNOWNS).for_each(|i| normal[(i, i)] += 1e-7 * trace);
            let step = normal.cholesky()?.solve(&right);
            let shrink = (0.3 / step.amax()).min(1.0);
            x += step.component_mul(&scales) * shrink;
            // Weights of outliers may go on flickering: then the last step must at least be small.
            let largest = step.rows(0, 3).amax();
            if largest < 1e-4 || (round + 1 == ROUNDS && largest < 2e-3) {
                let sum: f64 = rests.iter().map(|r| r.abs().min(gate).powi(2)).sum();
                return Some((x, (sum / rests.len() as f64).sqrt() / x[5]));
            }
        }
        None
    }
}

/// A row-major plane blurred by the lens along u (`step` 1) or v (`step` the width); the rim keeps its values.
fn blurred(plane: &[f64], wide: usize, high: usize, step: usize) -> Vec<f64> {
    let weight = |k: usize| (-0.5 * (k as f64 / BLUR_PX).powi(2)).exp();
    let total = 1.0 + 2.0 * (1..=BLUR_REACH).map(weight).sum::<f64>();
    let mut out = plane.to_vec();
    let (rim_u, rim_v) = if step == 1 { (BLUR_REACH, 0) } else { (0, BLUR_REACH) };
    for v in rim_v..high.saturating_sub(rim_v) {
        for u in rim_u..wide.saturating_sub(rim_u) {
            let at = v * wide + u;
            let sides = (1..=BLUR_REACH).map(|k| weight(k) * (plane[at - k * step] + plane[at + k * step]));
            out[at] = (plane[at] + sides.sum::<f64>()) / total;
        }
    }
    out
}

/// Geometry and light of one pixel.
fn look(edge: &Edge, light: Option<Light<'_>>, pixel: [f64; 2], share: [f64; 2]) -> Option<Pixel> {
    let along = |v: &Vector3<f64>| [edge.axes[0].dot(v), edge.axes[1].dot(v)];
    let point = edge.surface.at(pixel);
    let slopes = edge.surface.slopes(pixel);
    let (mut fringe, mut period) = (1.0, PERIOD_PX);
    if let Some(Light { projector, pattern }) = light {
        let [u, v] = projector.project(&point)?;
        fringe = pattern.light(u, v) / ((pattern.low + pattern.high) / 2.0);
        let [next, _] = projector.project(&(point + slopes[0]))?;
        period = (pattern.period_px / (next - u).abs()).clamp(3.0, 40.0);
    }
    Some(Pixel {
        place: along(&(point - edge.surface.at(edge.pixel))),
        slopes: [along(&slopes[0]), along(&slopes[1])],
        share,
        fringe,
        period,
    })
}

fn grey(image: Mono8<'_>, u: i64, v: i64) -> Option<f64> {
    let (u, v) = (usize::try_from(u).ok()?, usize::try_from(v).ok()?);
    (u < image.width() && v < image.height()).then(|| f64::from(image.row(v)[u]) / 255.0)
}
