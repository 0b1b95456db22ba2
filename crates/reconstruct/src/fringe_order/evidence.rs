// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the other cameras say of the place where a patch would lie on each fringe.
//!
//! A camera that sees the surface there *agrees* as far as the phase that its projector would cast on the place is the one that it
//! sees: differences are those of one surface (a Cauchy distribution), or as good as chance. Where it *looks past* the body, or the
//! place *would hide* what it sees there, it speaks against it; what *is hidden* from it says little.

use super::Scene;
use super::drift::{Differences, TERMS};
use super::inference::{Costs, Field, LABELS, NEVER, STEP};
use super::observation::{Observations, Observed, PLACES};
use super::patches::Patches;
use super::projection::{LANES, Ray};
use crate::kernels::fast_round::nearest;
use crate::kernels::simd;
use std::f32::consts::{PI, TAU};

/// What a camera's observation of a place counts.
struct CameraWeight {
    /// Half width of the differences where both see one surface, rad.
    width_rad: f32,
    /// How often both do.
    share: f32,
    /// Costs where it looks past the body, where the place would hide what it sees, and where it is hidden from it.
    past: f32,
    before: f32,
    behind: f32,
}

/// The other cameras of a view's head, and those of other heads: dark parts look like background to several heads at once.
const SAME_HEAD: CameraWeight =
    CameraWeight { width_rad: 0.02, share: 1.0, past: 3.0, before: 2.0, behind: 0.5 };
const OTHER_HEAD: CameraWeight =
    CameraWeight { width_rad: 0.05, share: 0.25, past: 0.2, before: 2.0, behind: 0.0 };

/// What neighbouring patches say, and what cameras say, is not independent: all of it counts so much.
const EVIDENCE: f32 = 0.3;

/// What a marker pixel counts, and all of a patch at most.
const MARKER: f32 = 0.3;
const MARKER_MOST: f32 = 3.0;

/// At first, as long as it is not known by how much cameras differ, they agree within so many times as much.
const WIDER: f32 = 2.0;

/// A view that is so many times darker than another one cannot tell it what is background: the mask ends where a fringe is a few DN
/// above black.
const DIM: f32 = 4.0;

/// The smallest patch that fills its cell, and the smallest that is asked, px.
pub const WHOLE_PX: u32 = 60;
const LEAST_PX: u32 = 24;

/// At first one whole cell in so many is asked, along rows and columns.
const SAMPLE: u32 = 2;

/// Then labels whose costs are so near to the best; patches whose margin is so large are not asked again.
const KEEP: f32 = 8.0;
const SURE: f32 = 10.0;

/// No turns.
pub const NO_ORDER: i32 = i32::MIN;

/// What is known of all views' patches, and of [nothing and a look past](super::observation::Numbers).
#[derive(Debug)]
pub struct OrderTable {
    /// Whole turns that make a patch's phases absolute, or [`NO_ORDER`].
    pub turns: Vec<i32>,
    /// By how much cameras differ from each view, block by block.
    pub differences: Vec<Vec<Differences>>,
}

/// What stands for nothing, and for a look past the object, in lists of all patches.
pub const BEYOND: usize = 2;

type Lanes = [f32; LANES];

/// What the observations of a block of cameras count for one view.
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

    /// What a patch costs at a place, by what the cameras have there. `turns` of the patches they see.
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

/// Whether a patch is one of the few whole ones that are asked at first.
pub fn is_sample(patches: &Patches, i: usize) -> bool {
    let (patch, columns) = (&patches.all[i], patches.columns as u32);
    patch.size >= WHOLE_PX
        && (patch.cell % columns).is_multiple_of(SAMPLE)
        && (patch.cell / columns).is_multiple_of(SAMPLE)
}

/// Sets the costs of all labels of a view's patches. At first some whole cells are asked at all labels; then, with what is known, every
/// patch at those near its best.
pub fn ask(field: &mut Field<'_>, scenes: &[Scene<'_>], known: &OrderTable, first: bool) {
    let (own, view) = (field.scene, field.number);
    let mut looks = Observations::new(scenes);
    let wide = if first { WIDER } else { 1.0 };
    let weights = known.differences[view].iter().enumerate();
    let weights: Vec<CameraWeights> =
        weights.map(|(block, x)| CameraWeights::new(scenes, view, block * LANES, x, wide)).collect();
    let patches = &own.patches;
    // By patch.
    let votes: Vec<(u32, i32, f32)> = field.votes().collect();
    let mut asked =
        Asked { looks: &mut looks, own, view, weights: &weights, known, sights: [Observed::NONE; PLACES] };
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
            asked.look(field, i, count, |_| true, EVIDENCE * each, &mut costs);
        } else if !first && patch.size >= LEAST_PX {
            let most = field.graph.marginal[i].iter().fold(NEVER, |a, &b| a.min(b)) + (KEEP / STEP) as i16;
            for (cost, marginal) in costs[..count].iter_mut().zip(&field.graph.marginal[i]) {
                if *marginal > most {
                    *cost = KEEP;
                }
            }
            asked.look(
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

/// What so many marker pixels count.
pub fn marker(px: u32) -> f32 {
    (MARKER * px as f32).min(MARKER_MOST)
}

/// Who is asked, and what for.
struct Asked<'a> {
    looks: &'a mut Observations<'a>,
    own: &'a Scene<'a>,
    view: usize,
    weights: &'a [CameraWeights],
    known: &'a OrderTable,
    sights: [Observed; PLACES],
}

impl Asked<'_> {
    /// Looks from a patch's line of sight at all labels that are asked, and adds what is said.
    fn look(
        &mut self,
        field: &Field<'_>,
        i: usize,
        count: usize,
        is_asked: impl Fn(usize) -> bool,
        weight: f32,
        costs: &mut [f32; LABELS],
    ) {
        let patch = &self.own.patches.all[i];
        let (u, v) = self.own.pixel(patch);
        let table = self.own.projection.table;
        let line = table.sightline(u, v);
        let fringe = patch.phase / TAU - field.base[i] as f32;
        let place = Place { terms: Differences::terms_of((u, v)), weight };
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
                } else if is_asked(l) {
                    (rays[len].inverse_depth, labels[len]) = (inverse, l);
                    len += 1;
                    if len == PLACES {
                        self.said(&rays, &labels, &place, costs);
                        len = 0;
                    }
                }
            }
        }
        if len > 0 {
            self.said(&rays[..len], &labels, &place, costs);
        }
    }

    /// Adds what the cameras say of some places.
    #[inline(always)]
    fn said(&mut self, rays: &[Ray], labels: &[usize; PLACES], place: &Place, costs: &mut [f32; LABELS]) {
        let Self { looks, view, weights, known, sights, .. } = self;
        for (block, weights) in weights.iter().enumerate() {
            let nothing = looks.at(*view, block, rays, sights);
            let differences = &known.differences[*view][block];
            simd::dispatch(
                #[inline(always)]
                || {
                    let mut bias = [0.0; LANES];
                    for (term, by) in place.terms.iter().zip(&differences.terms) {
                        for i in 0..LANES {
                            bias[i] += term * by[i];
                        }
                    }
                    for (seen, &l) in sights.iter().zip(labels).take(rays.len()) {
                        let mut turns = [NO_ORDER; LANES];
                        for (turns, node) in turns.iter_mut().zip(seen.node) {
                            *turns = known.turns[(node as usize).min(known.turns.len() - 1)];
                        }
                        costs[l] += place.weight * weights.cost(seen, &turns, &bias, nothing);
                    }
                },
            );
        }
    }
}

/// A patch that is asked for.
struct Place {
    /// Of its differences.
    terms: [f32; TERMS],
    /// What all weights of it count.
    weight: f32,
}
