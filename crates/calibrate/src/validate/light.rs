// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which pixels of a photograph carry usable fringes, by the photograph and the truth.
//!
//! A pixel's modulation is the slope of the light on the cosine of the *true* phase, over the pixels of its row that
//! are within half a fringe of it and on the same lit surface: the fringe's amplitude in DN, independent of the method
//! of demodulation. Where the surface ends or its shadow begins within half a fringe, the fringe around the
//! pixel is not whole. Such pixels are counted apart, because a method that needs a whole fringe cannot have them.

use super::truth::{Reference, Truth};
use crate::base::image::{Mono8, Plane};
use nalgebra::Point3;
use serde::Serialize;
use std::f64::consts::PI;

/// Lower bounds of the modulation, DN, for which completeness and wrong points are counted. Read-out and shot noise of
/// 0.6 DN make 0.1 rad of a single row at 4 DN.
pub const BOUNDS_DN: [f32; 6] = [0.0, 1.5, 3.0, 4.0, 6.0, 10.0];

/// The bound from which on light counts as usable, DN.
pub const USABLE_DN: f32 = 4.0;

/// More than this between neighbours of a row is another surface, rad.
const MAX_STEP: f64 = 1.5;

/// Fringes of one camera's lit pixels, over the crop of its truth.
#[derive(Debug)]
pub struct Light {
    /// DN; NaN where nothing is lit or less than half a fringe is in view.
    modulation: Plane<f32>,
    /// 1: half a fringe and more on both sides.
    whole: Plane<u8>,
}

impl Light {
    /// Measures a photograph; an error when it has another size than the camera.
    pub fn measure(truth: &Truth, image: Mono8<'_>, reference: Reference<'_>) -> Result<Self, String> {
        let expected = (reference.camera.width, reference.camera.height);
        if (image.width(), image.height()) != expected {
            let found = (image.width(), image.height());
            return Err(format!("expected a photograph of {expected:?} pixels, found {found:?}"));
        }
        let Truth { lit, points, origin: [left, top], .. } = truth;
        let (width, height) = (lit.width(), lit.height());
        let mut modulation = Plane::filled(width, height, f32::NAN);
        let mut whole = Plane::filled(width, height, 0);
        let pose = reference.camera.world_from_device.isometry();
        let mut phase = vec![f64::NAN; width];
        for v in 0..height {
            for (u, phase) in phase.iter_mut().enumerate() {
                let world = pose.transform_point(&Point3::from(points.at(u, v)));
                let seen = (lit.at(u, v) != 0).then(|| reference.projector.project(&world)).flatten();
                *phase = seen.map_or(f64::NAN, |[column, _]| reference.pattern.phase(column));
            }
            let light = &image.row(*top + v)[*left..*left + width];
            for u in 0..width {
                if let Some((slope, complete)) = fringe_at(u, &phase, light) {
                    modulation.set(u, v, slope as f32);
                    whole.set(u, v, u8::from(complete));
                }
            }
        }
        Ok(Self { modulation, whole })
    }

    /// Modulation, DN, and whether the fringe is whole; `None` where it is not known.
    pub(super) fn at(&self, (u, v): (usize, usize)) -> Option<(f32, bool)> {
        let modulation = self.modulation.at(u, v);
        (!modulation.is_nan()).then(|| (modulation, self.whole.at(u, v) != 0))
    }

    /// All pixels whose modulation is known.
    pub(super) fn pixels(&self) -> impl Iterator<Item = (f32, bool)> {
        let pixels = self.modulation.as_slice().iter().zip(self.whole.as_slice());
        pixels
            .filter(|(modulation, _)| !modulation.is_nan())
            .map(|(&modulation, &whole)| (modulation, whole != 0))
    }
}

/// Slope of the light on the cosine of the phase within half a fringe around column `u`, and whether the fringe is
/// whole; `None` where less than half of it is in view.
fn fringe_at(u: usize, phase: &[f64], light: &[u8]) -> Option<(f64, bool)> {
    let centre = phase[u];
    if centre.is_nan() {
        return None;
    }
    let mut sums = [0.0f64; 5];
    let mut add = |x: usize| {
        let (c, i) = (phase[x].cos(), f64::from(light[x]));
        for (sum, term) in sums.iter_mut().zip([1.0, c, i, c * c, c * i]) {
            *sum += term;
        }
    };
    add(u);
    let mut reach = [0.0; 2];
    for (side, reach) in reach.iter_mut().enumerate() {
        let mut x = u;
        loop {
            let next = if side == 0 { x.checked_sub(1) } else { (x + 1 < phase.len()).then_some(x + 1) };
            // A NaN is no neighbour either.
            let Some(next) = next.filter(|&next| (phase[next] - phase[x]).abs() < MAX_STEP) else { break };
            *reach = (phase[next] - centre).abs();
            if *reach > PI {
                break;
            }
            add(next);
            x = next;
        }
    }
    let whole = reach.iter().all(|&r| r > PI);
    let [n, c, i, cc, ci] = sums;
    let spread = cc - c * c / n;
    (reach[0] + reach[1] >= PI && spread > 0.0).then(|| ((ci - c * i / n) / spread, whole))
}

/// Counts by modulation, which add up over clouds.
#[derive(Debug, Clone, Default)]
pub(super) struct Classes([Class; BOUNDS_DN.len()]);

/// Pixels, those with a right point, and those with a wrong one: of all fringes, and of those that are whole.
#[derive(Debug, Clone, Copy, Default)]
struct Class([[usize; 3]; 2]);

impl Classes {
    fn count(&mut self, (modulation, whole): (f32, bool), what: usize) {
        for (class, _) in self.0.iter_mut().zip(BOUNDS_DN).filter(|(_, bound)| modulation >= *bound) {
            class.0[0][what] += 1;
            class.0[1][what] += usize::from(whole);
        }
    }

    /// Counts the pixels of a photograph.
    pub(super) fn add_pixels(&mut self, light: &Light) {
        light.pixels().for_each(|pixel| self.count(pixel, 0));
    }

    /// Counts a point on a pixel of which the modulation is known.
    pub(super) fn add_point(&mut self, pixel: (f32, bool), right: bool) {
        self.count(pixel, if right { 1 } else { 2 });
    }

    /// Adds the counts of another cloud.
    pub(super) fn join(&mut self, other: &Self) {
        let mine = self.0.iter_mut().flat_map(|class| class.0.as_flattened_mut());
        let theirs = other.0.iter().flat_map(|class| class.0.as_flattened());
        mine.zip(theirs).for_each(|(mine, theirs)| *mine += theirs);
    }

    /// The figures, by rising bound; nothing when no photograph was given.
    pub(super) fn score(&self, lit_px: usize) -> Vec<LightScore> {
        if self.0[0].0[0][0] == 0 {
            return Vec::new();
        }
        let share = |part: usize, all: usize| part as f64 / all.max(1) as f64;
        let scores = self.0.iter().zip(BOUNDS_DN).map(|(class, bound)| {
            let [[pixels, right, wrong], [whole, whole_right, whole_wrong]] = class.0;
            LightScore {
                min_modulation_dn: bound,
                share_of_lit: share(pixels, lit_px),
                completeness: share(right, pixels),
                wrong_share: share(wrong, right + wrong),
                whole_share_of_lit: share(whole, lit_px),
                whole_completeness: share(whole_right, whole),
                whole_wrong_share: share(whole_wrong, whole_right + whole_wrong),
            }
        });
        scores.collect()
    }
}

/// Completeness and wrong points where the modulation is at least a bound.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct LightScore {
    /// Lower bound of the modulation, DN.
    pub min_modulation_dn: f32,
    /// Share of the lit pixels that have it, half a fringe or more in view.
    pub share_of_lit: f64,
    /// Share of these that have a point of right order.
    pub completeness: f64,
    /// Share of the points on them that are of wrong order.
    pub wrong_share: f64,
    /// Share of the lit pixels that have it in a whole fringe.
    pub whole_share_of_lit: f64,
    /// Share of these that have a point of right order.
    pub whole_completeness: f64,
    /// Share of the points on them that are of wrong order.
    pub whole_wrong_share: f64,
}

#[cfg(test)]
mod tests {
    use super::fringe_at;
    use std::f64::consts::{PI, TAU};

    /// Fringes of 12 px, 40 DN high on a slope, from column 10 to 50; another surface from 40 on.
    fn row() -> (Vec<f64>, Vec<u8>) {
        let phase = |u: usize| match u {
            10..40 => TAU * u as f64 / 12.0,
            40..50 => TAU * u as f64 / 12.0 + 20.0,
            _ => f64::NAN,
        };
        let phase: Vec<f64> = (0..60).map(phase).collect();
        let light = phase.iter().map(|p| if p.is_nan() { 3 } else { (80.0 + 40.0 * p.cos()).round() as u8 });
        let light = light.collect();
        (phase, light)
    }

    #[test]
    fn the_modulation_is_that_of_the_fringe_around() {
        let (phase, light) = row();
        for u in 17..33 {
            let (slope, whole) = fringe_at(u, &phase, &light).expect("a fringe");
            assert!(whole && (slope - 40.0).abs() < 1.0, "{u}: {slope}");
        }
    }

    #[test]
    fn at_borders_and_steps_the_fringe_is_not_whole() {
        let (phase, light) = row();
        for u in [10, 12, 15, 36, 39] {
            let (slope, whole) = fringe_at(u, &phase, &light).expect("half a fringe");
            assert!(!whole && (slope - 40.0).abs() < 2.0, "{u}: {slope}");
        }
        assert!(fringe_at(5, &phase, &light).is_none());
        // A surface of four columns shows less than half a fringe.
        let narrow: Vec<f64> =
            (0..9).map(|u| if (2..6).contains(&u) { PI / 6.0 * u as f64 } else { f64::NAN }).collect();
        assert!(fringe_at(3, &narrow, &[9; 9]).is_none());
    }
}
