// SPDX-License-Identifier: MIT OR Apache-2.0
//! What each label of a patch costs, by what the other cameras observe at the place where the patch would lie.
//!
//! A camera that sees the surface there *agrees* as far as the phase that its projector would cast on the place is the
//! one that it sees: differences are those of one surface (a Cauchy distribution), or chance. Where it *looks past*
//! the body, or the place *would hide* what it sees there, the label costs more; a place that *is hidden* from it
//! costs little.

use super::drift::{Differences, TERMS};
use super::inference::{Field, NEVER, STEP, least};
use super::observation::{Observations, Observed, PLACES};
use super::patches::{CELL_PX, Patches};
use super::projection::{LANES, Ray};
use super::same_head::Mate;
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
pub const SAMPLE: u32 = 2;

/// In the second pass the labels are compared again whose costs exceed the least by no more than this.
const KEEP: f32 = 5.0;

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
pub(super) struct CameraWeights {
    pub width: Lanes,
    pub share: Lanes,
    pub past: Lanes,
    pub before: Lanes,
    pub behind: Lanes,
    /// Sign of the phase's change with the distance from each camera.
    pub sign: Lanes,
}

impl CameraWeights {
    /// The weights of the cameras from number `first` on for a view; `wide`: a factor on the widths.
    pub fn new(
        scenes: &[Scene<'_>],
        view: usize,
        first: usize,
        differences: &Differences,
        wide: f32,
    ) -> Self {
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

    /// What a patch costs at a place, by what the cameras have there. `turns` of the patches that they see, unless this
    /// is the first pass (`FIRST`), where neither these nor differences (`bias`) are known.
    #[inline(always)]
    fn cost<const FIRST: bool>(
        &self,
        seen: &Observed,
        turns: &[i32; LANES],
        bias: &Lanes,
        nothing: u32,
    ) -> f32 {
        // One logarithm for all cameras that agree.
        let (mut odds, mut cost) = ([1f32; LANES], [0f32; LANES]);
        for i in 0..LANES {
            let known = !FIRST & (turns[i] != NO_ORDER);
            let off = match FIRST {
                true => seen.ahead[i],
                false => {
                    let by_turns = if known { TAU * turns[i] as f32 } else { 0.0 };
                    (seen.ahead[i] - bias[i] + by_turns) * self.sign[i]
                }
            };
            let likelier = self::odds(self.share[i], self.width[i], wrapped(off));
            let against = if off > 0.0 { self.before[i] } else { self.behind[i] };
            let (is_seen, is_one) = (seen.node[i] < nothing, !known | (off.abs() < PI));
            odds[i] = if is_seen & is_one { likelier } else { 1.0 };
            let past = if seen.node[i] == nothing + 1 { self.past[i] } else { 0.0 };
            let there = if is_one { 0.0 } else { against };
            cost[i] = if is_seen { there } else { past };
        }
        let [a, b, c, d, e, f, g, h] = odds;
        let odds = ((a * b) * (c * d)) * ((e * f) * (g * h));
        let [a, b, c, d, e, f, g, h] = cost;
        ((a + b) + (c + d)) + ((e + f) + (g + h)) - ln(odds)
    }
}

/// A difference of phases without its whole turns, rad.
#[inline(always)]
pub(super) fn wrapped(off: f32) -> f32 {
    off - TAU * nearest(off * (1.0 / TAU))
}

/// How much likelier a [wrapped] difference is where both cameras see one surface, in `share` of all cases and with
/// differences of this width, than by chance: `1 + q 2 g / (g^2 + r^2)`.
#[inline(always)]
pub(super) fn odds(share: f32, width: f32, wrapped: f32) -> f32 {
    1.0 + share * (2.0 * width / (width * width + wrapped * wrapped))
}

/// Natural logarithm of a positive number, to 0.01.
#[inline(always)]
pub(super) fn ln(x: f32) -> f32 {
    let bits = x.to_bits();
    let exponent = (bits >> 23) as i32 - 127;
    let mantissa = f32::from_bits(bits & 0x007f_ffff | 0x3f80_0000);
    let log2 = exponent as f32 + ((2.0 - mantissa * (1.0 / 3.0)) * mantissa - 5.0 / 3.0);
    log2 * std::f32::consts::LN_2
}

/// Whether a patch fills its cell, and this is one of every `each` cells along rows and columns.
pub fn is_sample(patches: &Patches, i: usize, each: u32) -> bool {
    let (patch, columns) = (&patches.all[i], patches.columns as u32);
    patch.size >= WHOLE_PX
        && (patch.cell % columns).is_multiple_of(each)
        && (patch.cell / columns).is_multiple_of(each)
}

/// Sets the costs of all labels of a view's nodes. The first pass compares squares, and some whole cells beside them, at
/// all labels; the second, with what is known, every node that is not sure yet, at the labels near its best.
pub fn collect(field: &mut Field<'_>, scenes: &[Scene<'_>], known: &OrderTable, first: bool) {
    let (own, view) = (field.scene, field.number);
    let wide = if first { WIDER } else { 1.0 };
    let weights = known.differences[view].iter().enumerate();
    let weights: Vec<CameraWeights> =
        weights.map(|(block, x)| CameraWeights::new(scenes, view, block * LANES, x, wide)).collect();
    let patches = &own.patches;
    let mut votes: Vec<(u32, i32, f32)> = field.votes().collect();
    votes.sort_by_key(|vote| vote.0);
    let room = field.graph.labels.next_multiple_of(PLACES);
    let mut comparison = Comparison {
        looks: Observations::new(scenes),
        own,
        view,
        mate: Mate::new(scenes, view, &weights, known),
        weights: &weights,
        known,
        sights: [Observed::NONE; PLACES],
        inverse: Vec::with_capacity(room),
        wanted: Vec::with_capacity(room),
        compared: Vec::with_capacity(room),
        costs: Vec::with_capacity(room),
    };
    for node in 0..field.squares.all.len() {
        let square = field.squares.all[node];
        let i = square.patch as usize;
        let patch = &patches.all[i];
        if !first && patch.size >= WHOLE_PX && field.graph.margin[node] >= SURE {
            continue;
        }
        let cells = (square.side * square.side) as f32;
        let size = cells * patch.size as f32 / (CELL_PX * CELL_PX) as f32;
        let weight = match first {
            true if square.side > 1 => Some(cells),
            true => is_sample(patches, i, SAMPLE).then_some((SAMPLE * SAMPLE) as f32),
            false => Some(size).filter(|_| patch.size >= LEAST_PX),
        };
        let count = field.count[i] as usize;
        comparison.begin(count);
        if let Some(weight) = weight {
            if !first {
                comparison.keep(field.graph.marginal(node));
            }
            // What the first pass leaves open is compared everywhere.
            let samples = field.squares.samples(node, patches, if first { SAMPLE as usize } else { 1 });
            let each = EVIDENCE * weight / samples.len() as f32;
            for j in samples {
                let turns = field.squares.ahead[j] - field.base[j];
                let place = (j, patches.all[j].phase / TAU + turns as f32, each);
                match first {
                    true => comparison.look::<true>(place, j == i),
                    false => comparison.look::<false>(place, j == i),
                }
            }
        } else if !first {
            continue;
        }
        let own_votes = &votes[votes.partition_point(|x| (x.0 as usize) < node)..];
        for (_, l, counts) in own_votes.iter().take_while(|x| x.0 as usize == node) {
            if let Some(cost) = usize::try_from(*l).ok().and_then(|l| comparison.costs[..count].get_mut(l)) {
                *cost -= counts;
            }
        }
        in_steps(&comparison.costs[..count], field.graph.unary_mut(node));
    }
}

/// Writes costs in steps, of which the least is 0; labels beyond them are never had.
fn in_steps(costs: &[f32], out: &mut [i16]) {
    simd::dispatch(
        #[inline(always)]
        || {
            let least = costs.iter().copied().fold(f32::MAX, f32::min);
            let (out, beyond) = out.split_at_mut(costs.len());
            for (out, cost) in out.iter_mut().zip(costs) {
                // Not a number of more than 32767: no cast has to care for it.
                *out = ((cost - least) * (1.0 / STEP)).min(f32::from(NEVER)) as i32 as i16;
            }
            beyond.fill(NEVER);
        },
    );
}

/// The cameras that a view's nodes are compared with, and what has come out for the labels of one node.
struct Comparison<'a> {
    looks: Observations<'a>,
    own: &'a Scene<'a>,
    view: usize,
    /// The other camera of the head.
    mate: Option<Mate<'a>>,
    weights: &'a [CameraWeights],
    known: &'a OrderTable,
    sights: [Observed; PLACES],
    /// The inverse depth of each label, 1/m.
    inverse: Vec<f32>,
    /// Whether a label of the node is compared, and whether all cameras are compared at it for one of its patches.
    wanted: Vec<bool>,
    compared: Vec<bool>,
    costs: Vec<f32>,
}

impl Comparison<'_> {
    /// Begins with a node of this many labels: all are compared, and cost nothing.
    fn begin(&mut self, count: usize) {
        self.wanted.clear();
        self.wanted.resize(count, true);
        self.costs.clear();
        self.costs.resize(count, 0.0);
    }

    /// Only labels near the best are compared; all others cost as much more as that.
    fn keep(&mut self, marginal: &[i16]) {
        let most = least(marginal).saturating_add((KEEP / STEP) as i16);
        for ((wanted, cost), marginal) in self.wanted.iter_mut().zip(&mut self.costs).zip(marginal) {
            *wanted = *marginal <= most;
            *cost = if *wanted { 0.0 } else { KEEP };
        }
    }

    /// Adds the costs of the labels that are wanted, from the places on the line of sight of patch `i`, whose phase is
    /// `fringe` fringes at label 0; `weight` of these. Labels that the patch `decides` to lie nowhere are never had.
    fn look<const FIRST: bool>(&mut self, (i, fringe, weight): (usize, f32, f32), decides: bool) {
        let (u, v) = self.own.pixel(&self.own.patches.all[i]);
        let table = self.own.projection.table;
        let line = table.sightline(u, v);
        let count = self.costs.len();
        self.inverse.clear();
        self.inverse.resize(count.next_multiple_of(PLACES), 0.0);
        simd::dispatch(
            #[inline(always)]
            || {
                for (first, inverse) in self.inverse.as_chunks_mut::<PLACES>().0.iter_mut().enumerate() {
                    *inverse = table.inverse_depths(&line, fringe + (first * PLACES) as f32);
                }
            },
        );
        self.compared.clear();
        for l in 0..count {
            let lies = !self.inverse[l].is_nan();
            if decides && !lies {
                self.wanted[l] = false;
                self.costs[l] = f32::INFINITY;
            }
            self.compared.push(self.wanted[l] && lies);
        }
        let terms = Differences::terms_of((u, v));
        if let Some(mate) = &mut self.mate {
            mate.judge::<FIRST>(line.direction, fringe, &self.inverse, &terms);
            // Where it contradicts all of them, all cameras are heard.
            if (0..count).any(|l| self.compared[l] && !mate.contradicts[l]) {
                for l in (0..count).filter(|&l| mate.contradicts[l]) {
                    self.costs[l] += if self.compared[l] { weight * mate.costs[l] } else { 0.0 };
                    self.compared[l] = false;
                }
            }
        }
        let mut rays = [Ray { direction: line.direction, inverse_depth: 0.0 }; PLACES];
        let (mut labels, mut len) = ([0; PLACES], 0);
        for l in 0..count {
            if self.compared[l] {
                (rays[len].inverse_depth, labels[len]) = (self.inverse[l], l);
                len += 1;
            }
            if len == PLACES || l + 1 == count && len > 0 {
                self.add_costs::<FIRST>(&rays[..len], &labels, (terms, weight));
                len = 0;
            }
        }
    }

    /// Adds the costs of some labels, by what the cameras observe there. `terms` of the patch's differences; `weight`
    /// of all its observations.
    #[inline(always)]
    fn add_costs<const FIRST: bool>(
        &mut self,
        rays: &[Ray],
        labels: &[usize; PLACES],
        (terms, weight): ([f32; TERMS], f32),
    ) {
        let Self { looks, view, weights, known, sights, costs, .. } = self;
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
                        if !FIRST {
                            for (turns, node) in turns.iter_mut().zip(seen.node) {
                                *turns = known.turns[(node as usize).min(known.turns.len() - 1)];
                            }
                        }
                        costs[l] += weight * weights.cost::<FIRST>(seen, &turns, &bias, nothing);
                    }
                },
            );
        }
    }
}
