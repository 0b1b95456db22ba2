// SPDX-License-Identifier: MIT OR Apache-2.0
//! By how much two cameras differ where both surely see one surface: calibrations age, devices turn.
//!
//! What is certain after the first pass is looked at once more. The differences that one camera has from another
//! change slowly over the image, as those of a turned device do: a plane is laid through them, and taken off in the
//! second pass. How far they scatter about it is how near the two can be expected to agree.

use super::evidence::{NO_ORDER, OrderTable};
use super::inference::Field;
use super::observation::{Observations, Observed, PLACES};
use super::projection::{LANES, Ray};
use super::scene::Scene;
use super::unwrapped_frame::View;
use nalgebra::{Matrix3, Vector3};
use std::f32::consts::{PI, TAU};

/// Terms of a difference: the same everywhere, along the row, along the column.
pub const TERMS: usize = 3;

/// The unit of columns and rows in the terms, px: it keeps the terms near 1.
const UNIT_PX: f32 = 1000.0;

/// Places that a plane needs at least: with fewer, the differences of two cameras stay unknown.
const LEAST_PLACES: usize = 30;

/// How many places the expectation that differences are small counts as, in the fit of the plane.
const PRIOR_PLACES: f64 = 10.0;

/// The size that differences are expected to have before any place is seen, rad.
const PRIOR_RAD: f64 = 0.1;

/// The least scale of the differences about the plane, rad: that of cameras of one head ([`super::evidence`]).
const LEAST_SCALE_RAD: f64 = 0.02;

/// Rounds of the fit, each with weights by the differences that the last one left.
const ROUNDS: usize = 6;

/// Where two cameras differ by more, the calibration is not believed, rad. Chosen on calibrations whose devices have
/// turned (lots 1 to 4 of `make light`, *drift*).
const MOST_RAD: f32 = 0.2;

/// By how much two cameras may differ where both see one surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MostDifference {
    /// Most difference in the middle of what both see, rad: beyond, devices have turned.
    pub everywhere_rad: f32,
    /// Most scale of single places about the fitted plane, rad.
    pub scatter_rad: f32,
}

impl MostDifference {
    /// No bound: cameras are believed whatever they differ by.
    pub const ANY: Self = Self { everywhere_rad: f32::INFINITY, scatter_rad: f32::INFINITY };

    /// The bounds for frames of which each row stands for `rows` rows of the camera. Patches are as many times higher,
    /// and single places differ from their planes by as much more; devices that have turned make the same difference.
    pub fn of_rows(rows: usize) -> Self {
        Self { everywhere_rad: MOST_RAD, scatter_rad: MOST_RAD * rows as f32 }
    }
}

/// Differences of a block of cameras from a view, where both see one surface.
#[derive(Debug, Clone, Default)]
pub struct Differences {
    /// The coefficient of each term, rad, by camera.
    pub terms: [[f32; LANES]; TERMS],
    /// Their scale about the plane of the terms, rad; 0 where it is not known.
    pub scale: [f32; LANES],
    /// What they are in the middle of the places where both see one surface, rad.
    pub middle: [f32; LANES],
}

impl Differences {
    /// The terms of a pixel.
    pub fn terms_of((u, v): (usize, usize)) -> [f32; TERMS] {
        [1.0, u as f32 / UNIT_PX, v as f32 / UNIT_PX]
    }
}

/// A camera that contradicts the others.
#[derive(Debug, Clone, Copy)]
pub struct Turned {
    camera: usize,
    /// By how much it differs from half of the others at least, rad.
    by_rad: f32,
    /// No two differ by too much everywhere: it is single places that do.
    scattered: bool,
}

impl Turned {
    /// The camera that differs most from the others, where any two differ by too much: by what they differ everywhere,
    /// or by how much single places scatter about that.
    pub fn most(differences: &[Vec<Differences>], most: MostDifference) -> Option<Self> {
        let mut of_each = vec![Vec::new(); differences.len()];
        let (mut scattered, mut too_much) = (true, false);
        for (view, blocks) in differences.iter().enumerate() {
            let all = blocks.iter().flat_map(|block| block.middle.into_iter().zip(block.scale)).enumerate();
            for (camera, (middle, scale)) in all.filter(|x| x.1.1 > 0.0) {
                let by = middle.abs().max(scale);
                let turned = middle.abs() > most.everywhere_rad;
                scattered &= !turned;
                too_much |= turned || scale > most.scatter_rad;
                of_each[view].push(by);
                of_each[camera].push(by);
            }
        }
        let median = |(camera, by): (usize, &mut Vec<f32>)| {
            by.sort_unstable_by(f32::total_cmp);
            by.get(by.len() / 2).map(|&by_rad| Self { camera, by_rad, scattered })
        };
        let each = of_each.iter_mut().enumerate().filter_map(median);
        let worst = each.max_by(|a, b| a.by_rad.total_cmp(&b.by_rad).then(b.camera.cmp(&a.camera)));
        worst.filter(|_| too_much)
    }

    /// The reason of the refusal, for the user.
    pub fn message(&self, views: &[View<'_>], most: MostDifference) -> String {
        let View { id, triangulator, .. } = &views[self.camera];
        let pair = triangulator.pair();
        let most_rad = if self.scattered { most.scatter_rad } else { most.everywhere_rad };
        let expected =
            format!("expected cameras that agree within {most_rad} rad where they see one surface");
        if self.scattered {
            return format!(
                "{expected}, found single places where they do not, most of all with {id}: a pattern on the surface \
                 that looks like fringes, other light, or devices that have turned; if plain skin gives the same, \
                 calibrate again"
            );
        }
        let px = f64::from(self.by_rad) / std::f64::consts::TAU * f64::from(pair.period_px);
        format!(
            "{expected}, found more: {id} differs most, by {:.2} rad, as if it or its projector had turned by {:.3} \
             degree; run `fourdbody calibration check` to find the devices that have turned, or calibrate again",
            self.by_rad,
            (px / pair.camera.lens.fx).to_degrees()
        )
    }
}

/// The differences of all cameras from a view, block by block.
pub fn of(field: &Field<'_>, scenes: &[Scene<'_>], known: &OrderTable) -> Vec<Differences> {
    let own = field.scene;
    let certain: Vec<usize> = (0..field.graph.label.len())
        .filter(|&i| known.turns[field.first + i] != NO_ORDER && super::evidence::is_sample(&own.patches, i))
        .collect();
    let mut looks = Observations::new(scenes);
    let mut out = Vec::new();
    for block in 0..scenes.len().div_ceil(LANES) {
        let mut seen: [Vec<([f32; TERMS], f32)>; LANES] = Default::default();
        for places in certain.chunks(PLACES) {
            let mut rays = [Ray { direction: [0.0; 3], inverse_depth: 0.0 }; PLACES];
            let mut sights = [Observed::NONE; PLACES];
            for (ray, &i) in rays.iter_mut().zip(places) {
                let patch = &own.patches.all[i];
                let (u, v) = own.pixel(patch);
                let line = own.projection.table.sightline(u, v);
                let [inverse_depth] =
                    own.projection.table.inverse_depths(&line, patch.phase / TAU + field.turns(i) as f32);
                *ray = Ray { direction: line.direction, inverse_depth };
            }
            looks.at(field.number, block, &rays[..places.len()], &mut sights);
            for (sight, &i) in sights.iter().zip(places) {
                let terms = Differences::terms_of(own.pixel(&own.patches.all[i]));
                for (seen, (node, ahead)) in seen.iter_mut().zip(sight.node.iter().zip(sight.ahead)) {
                    let turns = known.turns.get(*node as usize).copied().unwrap_or(NO_ORDER);
                    let off = ahead + TAU * turns as f32;
                    if turns != NO_ORDER && off.abs() < PI {
                        seen.push((terms, off));
                    }
                }
            }
        }
        let mut found = Differences::default();
        for (c, seen) in seen.iter().enumerate().filter(|x| x.1.len() >= LEAST_PLACES) {
            let (terms, scale) = fit(seen);
            for (k, term) in terms.into_iter().enumerate() {
                found.terms[k][c] = term;
                found.middle[c] += term * seen.iter().map(|x| x.0[k]).sum::<f32>() / seen.len() as f32;
            }
            found.scale[c] = scale;
        }
        out.push(found);
    }
    out
}

/// The plane that most differences are near, and their scale about it.
fn fit(seen: &[([f32; TERMS], f32)]) -> ([f32; TERMS], f32) {
    let mut plane = Vector3::zeros();
    let mut sorted: Vec<f32> = seen.iter().map(|x| x.1).collect();
    sorted.sort_unstable_by(f32::total_cmp);
    plane[0] = f64::from(sorted[sorted.len() / 2]);
    let mut scale = 0.0;
    for _ in 0..ROUNDS {
        let rest = |(terms, off): &([f32; TERMS], f32)| {
            f64::from(*off) - Vector3::from(terms.map(f64::from)).dot(&plane)
        };
        let mut sizes: Vec<f64> = seen.iter().map(|x| rest(x).abs()).collect();
        sizes.sort_unstable_by(f64::total_cmp);
        scale = sizes[sizes.len() / 2].max(LEAST_SCALE_RAD);
        let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
        for x in seen {
            let terms = Vector3::from(x.0.map(f64::from));
            let weight = 1.0 / (1.0 + (rest(x) / scale).powi(2)) / (scale * scale);
            normal += terms * terms.transpose() * weight;
            right += terms * f64::from(x.1) * weight;
        }
        normal += Matrix3::identity() * PRIOR_PLACES / (PRIOR_RAD * PRIOR_RAD);
        plane = normal.cholesky().map_or(plane, |x| x.solve(&right));
    }
    (plane.map(|x| x as f32).into(), scale as f32)
}

#[cfg(test)]
mod tests {
    use super::{Differences, MostDifference, Turned, fit};

    #[test]
    fn the_plane_is_that_of_most_places() {
        // Three of ten places are of chance.
        let plane = [0.12, -0.05, 0.08];
        let seen: Vec<_> = (0..400u32)
            .map(|i| {
                let terms = [1.0, (i * 37 % 1900) as f32 / 1000.0, (i * 53 % 1190) as f32 / 1000.0];
                let true_one: f32 = terms.iter().zip(plane).map(|(a, b)| a * b).sum();
                let noise = ((i * 29 % 101) as f32 / 101.0 - 0.5) * 0.04;
                let chance = (i * 61 % 620) as f32 / 100.0 - 3.1;
                (terms, if i % 10 < 3 { chance } else { true_one + noise })
            })
            .collect();
        let (found, scale) = fit(&seen);
        for (found, true_one) in found.into_iter().zip(plane) {
            assert!((found - true_one).abs() < 0.02, "{found} {true_one}");
        }
        assert!(scale < 0.04, "{scale}");
    }

    #[test]
    fn the_camera_that_has_turned_is_named() {
        let differences = |by: [f32; 3]| {
            let mut found = Differences::default();
            found.middle[..3].copy_from_slice(&by);
            found.scale[..3].fill(0.02);
            found
        };
        let of = |x: f32, rows: usize| {
            let all = [[0.0, 0.03, x], [0.02, 0.0, x], [-x, x, 0.0]];
            Turned::most(&all.map(|by| vec![differences(by)]), MostDifference::of_rows(rows))
        };
        assert_eq!(of(0.15, 1).map(|x| x.camera), None);
        assert_eq!(of(0.25, 1).map(|x| x.camera), Some(2));
        assert_eq!(of(0.25, 4).map(|x| x.camera), Some(2), "fewer rows are no reason to differ everywhere");
    }
}
