// SPDX-License-Identifier: MIT OR Apache-2.0
//! By how much two cameras differ where both surely see one surface: calibrations age, devices turn.
//!
//! What is certain after the first pass is looked at once more. The differences that one camera has from another
//! change slowly over the image, as those of a turned device do: a plane is laid through them, and taken off in the
//! second pass. How far they scatter about it is how near the two can be expected to agree.

use super::evidence::{NO_ORDER, OrderTable, SAMPLE, is_sample};
use super::far_off::Amounts;
use super::inference::Field;
use super::observation::{Observations, Observed, PLACES};
use super::projection::{LANES, Ray};
use super::scene::Scene;
use super::unwrapped_frame::View;
use nalgebra::{Matrix3, Vector3};
use std::array::from_fn;
use std::f32::consts::{PI, TAU};

/// Terms of a difference: the same everywhere, along the row, along the column.
pub const TERMS: usize = 3;

/// The unit of columns and rows in the terms, px: it keeps the terms near 1.
const UNIT_PX: f32 = 1000.0;

/// Places that a plane needs at least: with fewer, the differences of two cameras stay unknown.
const LEAST_PLACES: usize = 30;

/// Places that a camera is compared with others at, over all pairs, before anything is concluded from its differences.
pub(super) const POOL_PLACES: f32 = 120.0;

/// How many places the expectation that differences are small counts as, in the fit of the plane.
const PRIOR_PLACES: f64 = 10.0;

/// The size that differences are expected to have before any place is seen, rad.
const PRIOR_RAD: f64 = 0.1;

/// The least scale of the differences about the plane, rad: that of cameras of one head ([`super::evidence`]).
const LEAST_SCALE_RAD: f64 = 0.02;

/// Rounds of the fit, each with weights by the differences that the last one left.
const ROUNDS: usize = 6;

/// Where a camera differs from others by more in the mean, the calibration is not believed, rad: half of what the least
/// of the calibrations made whose devices have turned (lots 1 to 4 of `make light`, *drift*), three times a good one's.
const MOST_RAD: f32 = 0.1;

/// Where single places are further off that in the median of a neighbourhood, it is refused, rad
/// ([`super::contradictions`]): half as much costs tattoo half a per cent of its surface, and stripes no worse points.
const MOST_SCATTER_RAD: f32 = 0.4;

/// By how much two cameras may differ where both see one surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MostDifference {
    /// Most difference in the middle of what both see, rad: beyond, devices have turned.
    pub everywhere_rad: f32,
    /// Most scale of single places about the fitted plane, rad: places that scatter more are refused.
    pub scatter_rad: f32,
}

impl MostDifference {
    /// No bound: cameras are believed whatever they differ by.
    pub const ANY: Self = Self { everywhere_rad: f32::INFINITY, scatter_rad: f32::INFINITY };

    /// The bounds for frames of which each row stands for `rows` rows of the camera. Patches are as many times higher,
    /// and single places differ from their planes by as much more; devices that have turned make the same difference.
    pub fn of_rows(rows: usize) -> Self {
        Self { everywhere_rad: MOST_RAD, scatter_rad: MOST_SCATTER_RAD * rows as f32 }
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
    /// How many places these are; 0 where there are too few.
    pub places: [u32; LANES],
    /// Of cameras of other heads: how often they differ by which amount, whatever their orders are.
    pub amounts: [Amounts; LANES],
}

impl Differences {
    /// The terms of a pixel.
    pub fn terms_of((u, v): (usize, usize)) -> [f32; TERMS] {
        [1.0, u as f32 / UNIT_PX, v as f32 / UNIT_PX]
    }
}

/// What one camera's differences come to, over all pairs of it and a camera of the same head, or of another.
#[derive(Debug, Clone, Copy, Default)]
struct Pool {
    places: f32,
    /// The sum over the places of all pairs.
    middle: f32,
}

impl Pool {
    fn add(&mut self, places: u32, middle: f32) {
        let places = places as f32;
        self.places += places;
        self.middle += places * middle.abs();
    }

    /// Mean difference in the middle of what both see, rad; 0 where too few places tell.
    fn mean(&self) -> f32 {
        if self.places >= POOL_PLACES { self.middle / self.places } else { 0.0 }
    }

    /// That of a camera that is far off.
    fn far_off(by_rad: f32) -> Self {
        Self { places: POOL_PLACES, middle: POOL_PLACES * by_rad }
    }
}

/// How far the cameras of one instant agree. Every pair counts by its places: few of them may all be wrong.
#[derive(Debug)]
pub struct Agreement {
    /// For each camera, with the others of its head, and with those of other heads.
    pools: Vec<[Pool; 2]>,
}

impl Agreement {
    /// From the differences of each camera from each view, block by block.
    pub fn of(differences: &[Vec<Differences>], scenes: &[Scene<'_>]) -> Self {
        Self::of_heads(differences, |a, b| scenes[a].head == scenes[b].head)
    }

    fn of_heads(differences: &[Vec<Differences>], one_head: impl Fn(usize, usize) -> bool) -> Self {
        let mut pools = vec![[Pool::default(); 2]; differences.len()];
        let mut amounts = vec![Amounts::default(); differences.len()];
        for (view, blocks) in differences.iter().enumerate() {
            let lanes = blocks.iter().flat_map(|x| x.places.into_iter().zip(x.middle));
            for (camera, (places, middle)) in lanes.enumerate().filter(|x| x.1.0 > 0) {
                for i in [view, camera] {
                    pools[i][usize::from(!one_head(view, camera))].add(places, middle);
                }
            }
            let seen = blocks.iter().flat_map(|x| &x.amounts);
            amounts.iter_mut().zip(seen).for_each(|(sum, seen)| sum.add(seen));
        }
        for (pools, amounts) in pools.iter_mut().zip(amounts) {
            if let Some(by_rad) = amounts.far_off_rad() {
                *pools = [Pool::default(), Pool::far_off(by_rad)];
            }
        }
        Self { pools }
    }

    /// By how much each camera differs from the others, rad: from those of its head or of other heads, whichever is
    /// more; 0 where too few places tell.
    pub fn differ_rad(&self) -> impl Iterator<Item = f32> {
        self.pools.iter().map(|pools| pools.iter().fold(0.0, |most, pool| pool.mean().max(most)))
    }

    /// Whether enough places were compared to know how far each camera differs from the others.
    pub fn compared(&self) -> impl Iterator<Item = bool> {
        self.pools.iter().map(|pools| pools.iter().any(|pool| pool.places >= POOL_PLACES))
    }

    /// The camera that differs most, and by what, if any camera differs by too much.
    fn worst(&self, most: MostDifference) -> Option<(usize, f32)> {
        if self.differ_rad().all(|by_rad| by_rad <= most.everywhere_rad) {
            return None;
        }
        // A camera that has turned differs from all others; each of these only from that one.
        let of = |[same, other]: &[Pool; 2]| {
            Pool { places: same.places + other.places, middle: same.middle + other.middle }.mean()
        };
        let each = self.pools.iter().map(of).enumerate();
        each.max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0)))
    }

    /// Whether the calibration can be believed; else the reason of the refusal, for the user.
    pub fn verdict(&self, views: &[View<'_>], most: MostDifference) -> Result<(), String> {
        let Some((camera, by_rad)) = self.worst(most) else { return Ok(()) };
        let View { id, triangulator, .. } = &views[camera];
        let pair = triangulator.pair();
        let px = f64::from(by_rad) / std::f64::consts::TAU * f64::from(pair.period_px);
        Err(format!(
            "expected cameras that agree within {} rad where they see one surface, found more: {id} differs most, by \
             {by_rad:.2} rad, as if it or its projector had turned by {:.3} degree; run `fourdbody calibration check` \
             to find the devices that have turned, or calibrate again",
            most.everywhere_rad,
            (px / pair.camera.lens.fx).to_degrees()
        ))
    }
}

/// The differences of all cameras from a view, block by block, and how far single places are off them: patch, rad.
pub fn of(
    field: &Field<'_>,
    scenes: &[Scene<'_>],
    known: &OrderTable,
) -> (Vec<Differences>, Vec<(u32, f32)>) {
    let own = field.scene;
    let certain: Vec<usize> = (0..own.patches.all.len())
        .filter(|&i| {
            known.turns[field.first + i] != NO_ORDER && is_sample(&own.patches, i, SAMPLE) && own.is_bright[i]
        })
        .collect();
    let mut looks = Observations::new(scenes);
    let (mut out, mut rests) = (Vec::new(), Vec::new());
    for block in 0..scenes.len().div_ceil(LANES) {
        let mut seen: [Vec<Seen>; LANES] = Default::default();
        let mut found = Differences::default();
        let other_head: [bool; LANES] =
            from_fn(|c| scenes.get(block * LANES + c).is_some_and(|scene| scene.head != own.head));
        for places in certain.chunks(PLACES) {
            let mut rays = [Ray { direction: [0.0; 3], inverse_depth: 0.0 }; PLACES];
            let mut sights = [Observed::NONE; PLACES];
            rays.iter_mut().zip(places).for_each(|(ray, &i)| *ray = field.place(i));
            let nothing = looks.at(field.number, block, &rays[..places.len()], &mut sights);
            for (sight, &i) in sights.iter().zip(places) {
                let terms = Differences::terms_of(own.pixel(&own.patches.all[i]));
                for c in (0..LANES).filter(|&c| other_head[c] && sight.node[c] < nothing) {
                    found.amounts[c].count(sight.ahead[c]);
                }
                for (seen, (node, ahead)) in seen.iter_mut().zip(sight.node.iter().zip(sight.ahead)) {
                    let turns = known.turns.get(*node as usize).copied().unwrap_or(NO_ORDER);
                    let off = ahead + TAU * turns as f32;
                    if turns != NO_ORDER && off.abs() < PI {
                        seen.push(Seen { patch: i as u32, terms, off });
                    }
                }
            }
        }
        for (c, seen) in seen.iter().enumerate().filter(|x| x.1.len() >= LEAST_PLACES) {
            let (terms, scale) = fit(seen);
            for (k, term) in terms.into_iter().enumerate() {
                found.terms[k][c] = term;
                found.middle[c] += term * seen.iter().map(|x| x.terms[k]).sum::<f32>() / seen.len() as f32;
            }
            // Cameras of other heads mostly see other surfaces there, whose phases differ by chance.
            if scenes[block * LANES + c].head == own.head {
                rests.extend(seen.iter().map(|x| (x.patch, x.rest(&terms))));
            }
            found.scale[c] = scale;
            found.places[c] = seen.len() as u32;
        }
        out.push(found);
    }
    (out, rests)
}

/// A place of a view that another camera sees.
#[derive(Debug, Clone, Copy)]
struct Seen {
    patch: u32,
    terms: [f32; TERMS],
    /// What the other camera differs by, rad.
    off: f32,
}

impl Seen {
    /// What the plane does not explain, rad.
    fn rest(&self, plane: &[f32; TERMS]) -> f32 {
        self.off - self.terms.iter().zip(plane).map(|(term, by)| term * by).sum::<f32>()
    }
}

/// The plane that most differences are near, and their scale about it.
fn fit(seen: &[Seen]) -> ([f32; TERMS], f32) {
    let mut plane = Vector3::zeros();
    let mut sorted: Vec<f32> = seen.iter().map(|x| x.off).collect();
    sorted.sort_unstable_by(f32::total_cmp);
    plane[0] = f64::from(sorted[sorted.len() / 2]);
    let mut scale = 0.0;
    for _ in 0..ROUNDS {
        let rest = |x: &Seen| f64::from(x.off) - Vector3::from(x.terms.map(f64::from)).dot(&plane);
        let mut sizes: Vec<f64> = seen.iter().map(|x| rest(x).abs()).collect();
        let middle = sizes.len() / 2;
        scale = sizes.select_nth_unstable_by(middle, f64::total_cmp).1.max(LEAST_SCALE_RAD);
        let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
        for x in seen {
            let terms = Vector3::from(x.terms.map(f64::from));
            let weight = 1.0 / (1.0 + (rest(x) / scale).powi(2)) / (scale * scale);
            normal += terms * terms.transpose() * weight;
            right += terms * f64::from(x.off) * weight;
        }
        normal += Matrix3::identity() * PRIOR_PLACES / (PRIOR_RAD * PRIOR_RAD);
        plane = normal.cholesky().map_or(plane, |x| x.solve(&right));
    }
    (plane.map(|x| x as f32).into(), scale as f32)
}

#[cfg(test)]
mod tests {
    use super::{Agreement, Differences, MostDifference, Seen, fit};

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
                Seen { patch: i, terms, off: if i % 10 < 3 { chance } else { true_one + noise } }
            })
            .collect();
        let (found, scale) = fit(&seen);
        for (found, true_one) in found.into_iter().zip(plane) {
            assert!((found - true_one).abs() < 0.02, "{found} {true_one}");
        }
        assert!(scale < 0.04, "{scale}");
    }

    /// Two cameras of each of two heads, and what they differ by in pairs: (camera, camera, places, middle).
    fn agreement(pairs: &[(usize, usize, u32, f32)]) -> Agreement {
        let mut all = vec![vec![Differences::default()]; 4];
        for &(a, b, places, middle) in pairs {
            for (a, b, middle) in [(a, b, middle), (b, a, -middle)] {
                (all[a][0].places[b], all[a][0].middle[b]) = (places, middle);
            }
        }
        Agreement::of_heads(&all, |a, b| a / 2 == b / 2)
    }

    #[test]
    fn the_camera_that_has_turned_is_named() {
        let of = |x: f32, rows: usize| {
            let pairs = [
                (0, 1, 300, 0.02),
                (2, 3, 300, x),
                (0, 2, 100, 0.01),
                (1, 2, 80, 0.02),
                (0, 3, 90, x),
                (1, 3, 90, x),
            ];
            agreement(&pairs).worst(MostDifference::of_rows(rows)).map(|worst| worst.0)
        };
        assert_eq!(of(0.08, 1), None);
        assert_eq!(of(0.25, 1), Some(3));
        assert_eq!(of(0.25, 4), Some(3), "fewer rows are no reason to differ everywhere");
    }

    #[test]
    fn few_places_of_one_pair_refuse_no_body() {
        let pairs = [(0, 1, 300, 0.02), (2, 3, 300, 0.01), (0, 2, 100, 0.01), (1, 3, 30, 0.5)];
        assert_eq!(agreement(&pairs).worst(MostDifference::of_rows(1)), None);
        let differ: Vec<f32> = agreement(&pairs).differ_rad().collect();
        assert!(differ[0] < 0.03 && differ[2] < 0.03, "{differ:?}");
    }

    #[test]
    fn a_projector_that_has_turned_is_seen_by_other_heads() {
        // Its two cameras agree with each other wherever they look.
        let pairs = [(0, 1, 900, 0.01), (2, 3, 900, 0.01), (0, 2, 70, 0.3), (1, 3, 70, 0.3)];
        assert!(agreement(&pairs).worst(MostDifference::of_rows(1)).is_some());
    }
}
