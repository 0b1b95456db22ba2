// SPDX-License-Identifier: MIT OR Apache-2.0
//! What another camera of the same head observes along a line of sight: eight labels at once.
//!
//! It sees nearly the same surface under the same projector, so that it contradicts most labels by itself. The cameras of
//! other heads are compared at those alone that are left.

use super::drift::{Differences, TERMS};
use super::evidence::{CameraWeights, NO_ORDER, OrderTable, ln, odds, wrapped};
use super::lookup::{CellContent, CellLanes};
use super::projection::{LANES, Projection};
use super::scene::Scene;
use crate::kernels::simd;
use std::f32::consts::{PI, TAU};

/// The camera contradicts a label where its phase differs by more, rad: many times the width of true differences, which
/// the edges of a striped shirt make wider.
const CONTRADICTION_RAD: f32 = 2.0;

/// Another camera of a view's head, and what it observes at the labels of one patch.
pub struct Mate<'a> {
    projection: &'a Projection<'a>,
    cells: &'a [CellContent],
    /// Turns of its patches, where they are known.
    turns: &'a [i32],
    differences: [f32; TERMS],
    width: f32,
    share: f32,
    past: f32,
    before: f32,
    behind: f32,
    /// Sign of the phase's change with the distance from it.
    sign: f32,
    /// The cost of each label by this camera alone.
    pub costs: Vec<f32>,
    /// Whether it contradicts the label.
    pub contradicts: Vec<bool>,
}

impl<'a> Mate<'a> {
    /// The mate of a view, if there is one.
    pub fn new(
        scenes: &'a [Scene<'a>],
        view: usize,
        weights: &[CameraWeights],
        known: &'a OrderTable,
    ) -> Option<Self> {
        let projection = &scenes[view].projection;
        let number = projection.mate()?;
        let (block, lane) = (number / LANES, number % LANES);
        let Differences { terms, .. } = &known.differences[view][block];
        let first: usize = scenes[..number].iter().map(|scene| scene.patches.all.len()).sum();
        let (scene, weights) = (&scenes[number], &weights[block]);
        Some(Self {
            projection,
            cells: scene.patches.lookup.cells(),
            turns: &known.turns[first..][..scene.patches.all.len()],
            differences: terms.map(|term| term[lane]),
            width: weights.width[lane],
            share: weights.share[lane],
            past: weights.past[lane],
            before: weights.before[lane],
            behind: weights.behind[lane],
            sign: weights.sign[lane],
            costs: Vec::new(),
            contradicts: Vec::new(),
        })
    }

    /// Judges all labels of a line of sight, given by their inverse depths; the phase of label 0 is `fringe` fringes.
    /// Outlines and steps are left to [`super::observation`]: nothing is observed there.
    pub fn judge<const FIRST: bool>(
        &mut self,
        direction: [f32; 3],
        fringe: f32,
        inverse: &[f32],
        terms: &[f32; TERMS],
    ) {
        self.costs.resize(inverse.len(), 0.0);
        self.contradicts.resize(inverse.len(), false);
        let bias: f32 = terms.iter().zip(self.differences).map(|(term, by)| term * by).sum();
        simd::dispatch(
            #[inline(always)]
            || {
                for (block, inverse) in inverse.as_chunks::<LANES>().0.iter().enumerate() {
                    let first = block * LANES;
                    let cast = bias + TAU * (fringe + first as f32);
                    let (costs, against) = self.judge_block::<FIRST>(direction, inverse, cast);
                    self.costs[first..][..LANES].copy_from_slice(&costs);
                    self.contradicts[first..][..LANES].copy_from_slice(&against);
                }
            },
        );
    }

    /// The costs of eight labels, and whether they are contradicted. `cast`: the phase that the first one expects, rad.
    #[inline(always)]
    fn judge_block<const FIRST: bool>(
        &self,
        direction: [f32; 3],
        inverse: &[f32; LANES],
        cast: f32,
    ) -> ([f32; LANES], [bool; LANES]) {
        let at = self.projection.at_mate(direction, inverse);
        let mut cells = CellLanes::<LANES>::UNSEEN;
        for (k, &cell) in at.cell.iter().enumerate() {
            cells.set(k, self.cells.get(cell as usize).unwrap_or(&CellContent::UNSEEN));
        }
        let mut turns = [NO_ORDER; LANES];
        if !FIRST {
            for (k, turns) in turns.iter_mut().enumerate() {
                *turns = self.turns.get(cells.node(k) as usize).copied().unwrap_or(NO_ORDER);
            }
        }
        let (mut costs, mut against) = ([0f32; LANES], [false; LANES]);
        for k in 0..LANES {
            let known = !FIRST & (turns[k] != NO_ORDER);
            let by_turns = if known { TAU * turns[k] as f32 } else { 0.0 };
            // Not a number where there is no surface.
            let ahead = cells.phase(k, at.right[k], at.down[k]) - (cast + TAU * k as f32);
            let off = (ahead + by_turns) * self.sign;
            let wrapped = wrapped(off);
            let is_other = known & (off.abs() >= PI);
            let hides = is_other & (off > 0.0);
            let is_far = cells.node(k) == CellContent::FAR;
            let differs = !is_other & (wrapped.abs() > CONTRADICTION_RAD);
            against[k] = is_far | hides | differs;
            let of_other = if off > 0.0 { self.before } else { self.behind };
            let there = if is_other { of_other } else { -ln(odds(self.share, self.width, wrapped)) };
            let there = if off.is_nan() { 0.0 } else { there };
            costs[k] = if is_far { self.past } else { there };
        }
        (costs, against)
    }
}
