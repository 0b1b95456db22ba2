// SPDX-License-Identifier: MIT OR Apache-2.0
//! What each label of a patch costs, by what the other cameras observe at the place where the patch would lie.
//!
//! A camera that sees the surface there *agrees* as far as the phase that its projector would cast on the place is the
//! one that it sees: differences are those of one surface (a Cauchy distribution), or chance. Where it *looks past*
//! the body, or the place *would hide* what it sees there, the label costs more; a place that *is hidden* from it
//! costs little.

use super::drift::{Differences, TERMS};
use super::inference::{Costs, Field, LABELS, NEVER, STEP};
use super::observation::{Observations, Observed, PLACES};
use super::patches::Patches;
use super::projection::{LANES, Ray};
use super::scene::Scene;
use crate::kernels::fast_round::nearest;
use crate::kernels::simd;
use std::f32::consts::{PI, TAU};

/// Weights of what one camera observes at a place.
struct CameraWeight {
    /// Half width of the distribution of differences where both see one surface, rad.
    width_rad: f32,
    /// How often both see one surface, 0 to 1.
    share: f32,
    /// Cost of a place at which the camera looks past the body.
    past: f32,
    /// Cost of a place that would hide what the camera sees.
    before: f32,
    /// Cost of a place that is hidden from the camera.
    behind: f32,
}

/// Weights of the other cameras of a view's own head.
const SAME_HEAD: CameraWeight =
    CameraWeight { width_rad: 0.02, share: 1.0, past: 3.0, before: 2.0, behind: 0.5 };

/// Weights of the cameras of other heads. `past` is small: dark parts look like background to several heads at once.
const OTHER_HEAD: CameraWeight =
    CameraWeight { width_rad: 0.05, share: 0.25, past: 0.2, before: 2.0, behind: 0.0 };

/// Factor on all observations of a patch: neighbouring patches and cameras are not independent.
const EVIDENCE: f32 = 0.3;

/// Factor on `width_rad` in the first pass, in which the differences between cameras are not known yet.
const WIDER: f32 = 2.0;

/// A view this many times darker than another one does not look past the other's places: its mask ends where a fringe
/// is a few DN above black.
const DIM: f32 = 4.0;

/// Pixels from which a patch counts as one that fills its cell of 64 px.
pub const WHOLE_PX: u32 = 60;

/// Pixels of the smallest patch that the other cameras are compared with, in the second pass.
const LEAST_PX: u32 = 24;

/// In the first pass every such cell along rows and columns is compared with the other cameras.
const SAMPLE: u32 = 2;

/// In the second pass the labels are compared again whose costs exceed the least by no more than this.
const KEEP: f32 = 8.0;

/// In the second pass patches that fill their cell are not compared again from this margin on.
const SURE: f32 = 10.0;

/// Stands for whole turns that are not known.
pub const NO_ORDER: i32 = i32::MIN;

/// What the first pass has found of all views' patches, and [no observation and a look
/// past](super::observation::Numbers).
#[derive(Debug)]
pub struct OrderTable {
    /// Whole turns that make a patch's phases absolute, or [`NO_ORDER`].
    pub turns: Vec<i32>,
    /// By how much cameras differ from each view, block by block.
    pub differences: Vec<Vec<Differences>>,
}

/// Entries behind all patches in a list of turns: one for no observation, one for a look past the object.
pub const BEYOND: usize = 2;

type Lanes = [f32; LANES];

/// The weights of a block of cameras for one view, in lanes.
struct CameraWeights {
    width: Lanes,
    share: Lanes,
    past: Lanes,
    before: Lanes,
    behind: Lanes,
    /// Sign of the phase's change with the distance from each camera.
    sign: Lanes,
}

impl CameraWeights {
    fn new(scenes: &[Scene<'_>], view: usize, first: usize, differences: &Differences, wide: f32) -> Self {
        let none = [0.0; LANES];
        let mut weights =
            Self { width: [1.0; LANES], share: none, past: none, before: none, behind: none, sign: none };
        let own = &scenes[view];
        for (i, scene) in scenes[first..].iter().enumerate().take(LANES).filter(|x| first + x.0 != view) {
            let weight = if scene.head == own.head { SAME_HEAD } else { OTHER_HEAD };
            let width = weight.width_rad * wide;
            weights.width[i] = width.max(differences.scale[i]);
            weights.share[i] = weight.share;
            weights.past[i] = if scene.light_dn * DIM < own.light_dn { 0.0 } else { weight.past };
            (weights.before[i], weights.behind[i], weights.sign[i]) =
                (weight.before, weight.behind, scene.towards);
        }
        weights
    }

    /// What a patch costs at a place, by what the cameras have there. `turns` of the patches that they see.
    #[inline(always)]
    fn cost(&self, seen: &Observed, turns: &[i32; LANES], bias: &Lanes, nothing: u32) -> f32 {
        let mut cost = [0f32; LANES];
        for i in 0..LANES {
            let known = turns[i] != NO_ORDER;
            let off =
                (seen.ahead[i] - bias[i] + if known { TAU * turns[i] as f32 } else { 0.0 }) * self.sign[i];
            let wrapped = off - TAU * nearest(off * (1.0 / TAU));
            let likelier = 2.0 * self.width[i] / (self.width[i] * self.width[i] + wrapped * wrapped);
            let agrees = -ln(1.0 + self.share[i] * likelier);
            let against = if off > 0.0 { self.before[i] } else { self.behind[i] };
            let there = if !known | (off.abs() < PI) { agrees } else { against };
            let is_past = seen.node[i] == nothing + 1;
            cost[i] = if seen.node[i] < nothing {
                there
            } else if is_past {
                self.past[i]
            } else {
                0.0
            };
        }
        let mut sum = 0.0;
        for cost in cost {
            sum += cost;
        }
        sum
    }
}

/// Natural logarithm of a positive number, to 0.01.
#[inline(always)]
fn ln(x: f32) -> f32 {
    let bits = x.to_bits();
    let exponent = (bits >> 23) as i32 - 127;
    let mantissa = f32::from_bits(bits & 0x007f_ffff | 0x3f80_0000);
    let log2 = exponent as f32 + ((2.0 - mantissa * (1.0 / 3.0)) * mantissa - 5.0 / 3.0);
    log2 * std::f32::consts::LN_2
}

/// Whether a patch fills its cell and is one of those that the first pass compares.
pub fn is_sample(patches: &Patches, i: usize) -> bool {
    let (patch, columns) = (&patches.all[i], patches.columns as u32);
    patch.size >= WHOLE_PX
        && (patch.cell % columns).is_multiple_of(SAMPLE)
        && (patch.cell / columns).is_multiple_of(SAMPLE)
}

/// Sets the costs of all labels of a view's patches. The first pass compares some whole cells at all labels; the
/// second, with what is known, every patch at the labels near its best.
pub fn collect(field: &mut Field<'_>, scenes: &[Scene<'_>], known: &OrderTable, first: bool) {
    let (own, view) = (field.scene, field.number);
    let mut looks = Observations::new(scenes);
    let wide = if first { WIDER } else { 1.0 };
    let weights = known.differences[view].iter().enumerate();
    let weights: Vec<CameraWeights> =
        weights.map(|(block, x)| CameraWeights::new(scenes, view, block * LANES, x, wide)).collect();
    let patches = &own.patches;
    // By patch.
    let votes: Vec<(u32, i32, f32)> = field.votes().collect();
    let mut comparison = Comparison {
        looks: &mut looks,
        own,
        view,
        weights: &weights,
        known,
        sights: [Observed::NONE; PLACES],
    };
    for (i, patch) in patches.all.iter().enumerate() {
        let whole = patch.size >= WHOLE_PX;
        if !first && whole && field.graph.margin[i] >= SURE {
            continue;
        }
        let count = field.count[i] as usize;
        let mut costs = [f32::INFINITY; LABELS];
        costs[..count].fill(0.0);
        if first && is_sample(patches, i) {
            let each = (SAMPLE * SAMPLE) as f32;
            comparison.look(field, i, count, |_| true, EVIDENCE * each, &mut costs);
        } else if !first && patch.size >= LEAST_PX {
            let most = field.graph.marginal[i].iter().fold(NEVER, |a, &b| a.min(b)) + (KEEP / STEP) as i16;
            for (cost, marginal) in costs[..count].iter_mut().zip(&field.graph.marginal[i]) {
                if *marginal > most {
                    *cost = KEEP;
                }
            }
            comparison.look(
                field,
                i,
                count,
                |l| field.graph.marginal[i][l] <= most,
                EVIDENCE * patch.size as f32 / 64.0,
                &mut costs,
            );
        } else if !first {
            continue;
        }
        let own_votes = &votes[votes.partition_point(|x| (x.0 as usize) < i)..];
        for (_, l, counts) in own_votes.iter().take_while(|x| x.0 as usize == i) {
            if let Some(cost) = usize::try_from(*l).ok().and_then(|l| costs[..count].get_mut(l)) {
                *cost -= counts;
            }
        }
        field.graph.unary[i] = in_steps(&costs);
    }
}

/// Costs in steps, of which the least is 0.
fn in_steps(costs: &[f32; LABELS]) -> Costs {
    let least = costs.iter().copied().fold(f32::MAX, f32::min);
    costs.map(|cost| ((cost - least) * (1.0 / STEP)).min(f32::from(NEVER)) as i16)
}

/// The cameras that a view's patches are compared with.
struct Comparison<'a> {
    looks: &'a mut Observations<'a>,
    own: &'a Scene<'a>,
    view: usize,
    weights: &'a [CameraWeights],
    known: &'a OrderTable,
    sights: [Observed; PLACES],
}

impl Comparison<'_> {
    /// Adds the costs of those labels of patch `i` for which `is_wanted`, from the places on its line of sight.
    fn look(
        &mut self,
        field: &Field<'_>,
        i: usize,
        count: usize,
        is_wanted: impl Fn(usize) -> bool,
        weight: f32,
        costs: &mut [f32; LABELS],
    ) {
        let patch = &self.own.patches.all[i];
        let (u, v) = self.own.pixel(patch);
        let table = self.own.projection.table;
        let line = table.sightline(u, v);
        let fringe = patch.phase / TAU - field.base[i] as f32;
        let place = (Differences::terms_of((u, v)), weight);
        let mut rays = [Ray { direction: line.direction, inverse_depth: 0.0 }; PLACES];
        let (mut labels, mut len) = ([0; PLACES], 0);
        for first in (0..count).step_by(PLACES) {
            let inverse: [f32; PLACES] = simd::dispatch(
                #[inline(always)]
                || table.inverse_depths(&line, fringe + first as f32),
            );
            for (l, inverse) in (first..count).zip(inverse) {
                if inverse.is_nan() {
                    costs[l] = f32::INFINITY;
                } else if is_wanted(l) {
                    (rays[len].inverse_depth, labels[len]) = (inverse, l);
                    len += 1;
                    if len == PLACES {
                        self.add_costs(&rays, &labels, place, costs);
                        len = 0;
                    }
                }
            }
        }
        if len > 0 {
            self.add_costs(&rays[..len], &labels, place, costs);
        }
    }

    /// Adds the costs of some labels, by what the cameras observe there. `terms` of the patch's differences; `weight`
    /// of all its observations.
    #[inline(always)]
    fn add_costs(
        &mut self,
        rays: &[Ray],
        labels: &[usize; PLACES],
        (terms, weight): ([f32; TERMS], f32),
        costs: &mut [f32; LABELS],
    ) {
        let Self { looks, view, weights, known, sights, .. } = self;
        for (block, weights) in weights.iter().enumerate() {
            let nothing = looks.at(*view, block, rays, sights);
            let differences = &known.differences[*view][block];
            simd::dispatch(
                #[inline(always)]
                || {
                    let mut bias = [0.0; LANES];
                    for (term, by) in terms.iter().zip(&differences.terms) {
                        for i in 0..LANES {
                            bias[i] += term * by[i];
                        }
                    }
                    for (seen, &l) in sights.iter().zip(labels).take(rays.len()) {
                        let mut turns = [NO_ORDER; LANES];
                        for (turns, node) in turns.iter_mut().zip(seen.node) {
                            *turns = known.turns[(node as usize).min(known.turns.len() - 1)];
                        }
                        costs[l] += weight * weights.cost(seen, &turns, &bias, nothing);
                    }
                },
            );
        }
    }
}
