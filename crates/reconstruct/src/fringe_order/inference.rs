// SPDX-License-Identifier: MIT OR Apache-2.0
//! The labels of a view's patches that cost least together: tree-reweighted message passing, one sweep after the other
//! (TRW-S; Kolmogorov, IEEE PAMI 28:1568, 2006).

use super::links::Link;
use super::scene::Scene;
use crate::kernels::simd;
use std::f32::consts::TAU;

/// Labels of a patch at most: fringes from the first in the volume on its line of sight.
pub const LABELS: usize = 64;

/// Costs are whole multiples of this step, in 16 bits, and the least cost of a patch is 0: sums do not depend on their
/// order, and little memory is moved.
pub const STEP: f32 = 1.0 / 128.0;

/// The cost of a label that a patch cannot have, in steps: 100.
pub const NEVER: i16 = 12_800;

/// Sweeps of message passing, each over all patches forwards and backwards.
const SWEEPS: usize = 2;

/// By how much one marker pixel lowers the cost of its patch's label.
const MARKER: f32 = 0.3;

/// By how much all marker pixels of a patch together lower that cost at most.
const MARKER_MOST: f32 = 3.0;

/// A cost for each label, in steps.
pub type Costs = [i16; LABELS];

/// The patches of a view with the costs of their labels and the links between them; after [`Graph::infer`] with their
/// labels and margins.
#[derive(Debug)]
pub struct Graph {
    /// Costs of each label by itself.
    pub unary: Vec<Costs>,
    /// For each label of a patch, the least cost of all patches together with it.
    pub marginal: Vec<Costs>,
    /// The label of each patch.
    pub label: Vec<i32>,
    /// How much more any other label would cost.
    pub margin: Vec<f32>,
    /// Links, with turns between labels.
    pub links: Vec<Link>,
    /// Links of patch `i`: `of[start[i]..start[i + 1]]`.
    start: Vec<u32>,
    of: Vec<u32>,
    /// From `a` to `b`, from `b` to `a`.
    messages: Vec<[Costs; 2]>,
}

/// The patches of a view among those of all.
#[derive(Debug)]
pub struct Field<'a> {
    /// The view whose patches they are.
    pub scene: &'a Scene<'a>,
    /// The number of the view.
    pub number: usize,
    /// Where its patches begin among those of all views.
    pub first: usize,
    /// Whole turns that make a patch's phases absolute are its label less this.
    pub base: Vec<i32>,
    /// How many labels each patch may have.
    pub count: Vec<u32>,
    /// Costs, links, labels and margins of the patches.
    pub graph: Graph,
}

impl<'a> Field<'a> {
    /// A view's patches, of which nothing is known.
    pub fn new(scenes: &'a [Scene<'a>], number: usize) -> Self {
        let scene = &scenes[number];
        let first = scenes[..number].iter().map(|scene| scene.patches.all.len()).sum();
        let n = scene.patches.all.len();
        let (mut base, mut count) = (vec![0; n], vec![0; n]);
        for (i, patch) in scene.patches.all.iter().enumerate() {
            let (u, v) = scene.pixel(patch);
            let [first, last] = scene.projection.table.fringes_in_volume(u, v).map(f32::floor);
            base[i] = (patch.phase / TAU).floor() as i32 - first as i32;
            count[i] = ((last - first) as i32 + 1).clamp(0, LABELS as i32) as u32;
        }
        let between =
            |link: &Link| Link { turns: link.turns + base[link.b as usize] - base[link.a as usize], ..*link };
        let graph = Graph::new(n, scene.patches.links.iter().map(between).collect());
        Self { scene, number, first, base, count, graph }
    }

    /// Whole turns that make a patch's phases absolute.
    pub fn turns(&self, i: usize) -> i32 {
        self.graph.label[i] - self.base[i]
    }

    /// The labels that marker pixels give their patches: patch, label, and how much that lowers the label's cost.
    pub fn votes(&self) -> impl Iterator<Item = (u32, i32, f32)> {
        let votes = self.scene.votes.iter();
        votes.map(|&(patch, turns, px)| {
            (patch, turns + self.base[patch as usize], (MARKER * px as f32).min(MARKER_MOST))
        })
    }
}

impl Graph {
    /// A graph of `n` patches, whose costs are all 0.
    pub fn new(n: usize, links: Vec<Link>) -> Self {
        let mut start = vec![0u32; n + 1];
        links.iter().flat_map(|x| [x.a, x.b]).for_each(|i| start[i as usize + 1] += 1);
        (0..n).for_each(|i| start[i + 1] += start[i]);
        let (mut place, mut of) = (start.clone(), vec![0; 2 * links.len()]);
        for (k, link) in links.iter().enumerate() {
            for i in [link.a, link.b] {
                of[place[i as usize] as usize] = k as u32;
                place[i as usize] += 1;
            }
        }
        let (none, messages) = (vec![[0; LABELS]; n], vec![[[0; LABELS]; 2]; links.len()]);
        let (label, margin) = (vec![0; n], vec![0.0; n]);
        Self { unary: none.clone(), marginal: none, label, margin, links, start, of, messages }
    }

    /// The links of a patch.
    pub fn links_of(&self, i: usize) -> &[u32] {
        &self.of[self.start[i] as usize..self.start[i + 1] as usize]
    }

    /// Finds the labels that cost least together, and their margins.
    pub fn infer(&mut self) {
        simd::dispatch(
            #[inline(always)]
            || {
                let n = self.label.len();
                for _ in 0..SWEEPS {
                    for i in 0..n {
                        self.send(i, true);
                    }
                    for i in (0..n).rev() {
                        self.send(i, false);
                    }
                }
                for i in 0..n {
                    self.decide(i);
                }
            },
        );
    }

    /// The label of a patch, where those before have theirs.
    #[inline(always)]
    fn decide(&mut self, i: usize) {
        let (mut given, mut marginal) = (self.unary[i], self.unary[i]);
        for &k in self.links_of(i) {
            let link = &self.links[k as usize];
            let is_a = link.a as usize == i;
            let message = &self.messages[k as usize][usize::from(is_a)];
            add(&mut marginal, message);
            if is_a {
                add(&mut given, message);
                continue;
            }
            // Any other label than that of the one before costs what the link does.
            let kept = self.label[link.a as usize] + link.turns;
            if let Some(kept) = usize::try_from(kept).ok().and_then(|kept| given.get_mut(kept)) {
                *kept -= in_steps(link.weight);
            }
        }
        let lowest = least(&given);
        let best = given.iter().position(|cost| *cost == lowest).unwrap_or(0);
        let mut others = marginal;
        others[best] = i16::MAX;
        self.label[i] = best as i32;
        self.margin[i] = STEP * (f32::from(least(&others)) - f32::from(marginal[best]));
        self.marginal[i] = marginal;
    }

    /// Sends a patch's messages to those after it, or before it.
    #[inline(always)]
    fn send(&mut self, i: usize, forward: bool) {
        let of = &self.of[self.start[i] as usize..self.start[i + 1] as usize];
        let (mut sum, mut later) = (self.unary[i], 0);
        for &k in of {
            let is_a = self.links[k as usize].a as usize == i;
            later += usize::from(is_a);
            add(&mut sum, &self.messages[k as usize][usize::from(is_a)]);
        }
        // A share, in units of 1/65536.
        let gamma = u32::from(u16::MAX) / later.max(of.len() - later).max(1) as u32;
        for &k in of {
            let link = &self.links[k as usize];
            let is_a = link.a as usize == i;
            if is_a != forward {
                continue;
            }
            let back = &self.messages[k as usize][usize::from(is_a)];
            // Room on both sides, for the turns.
            let mut cost = [i16::MAX; 2 * LABELS];
            let mut own = [0; LABELS];
            for l in 0..LABELS {
                // Sums are not negative.
                let share = (u32::from(sum[l] as u16) * gamma) >> u16::BITS;
                own[l] = share as u16 as i16 - back[l];
            }
            let lowest = least(&own);
            cost[LABELS / 2..LABELS / 2 + LABELS].copy_from_slice(&own);
            /// The largest number of turns between the labels of two patches that a link may have.
            const HALF: i32 = LABELS as i32 / 2;
            let turns = (if is_a { link.turns } else { -link.turns }).clamp(-HALF, HALF);
            let from = &cost[(HALF - turns) as usize..][..LABELS];
            let weight = in_steps(link.weight);
            let to = &mut self.messages[k as usize][usize::from(!is_a)];
            for l in 0..LABELS {
                let x = from[l].saturating_sub(lowest);
                to[l] = if x < weight { x } else { weight };
            }
        }
    }
}

/// A cost as a number of steps.
#[inline(always)]
fn in_steps(cost: f32) -> i16 {
    (cost * (1.0 / STEP)) as i16
}

#[inline(always)]
fn add(to: &mut Costs, from: &Costs) {
    for l in 0..LABELS {
        to[l] = to[l].saturating_add(from[l]);
    }
}

/// The least of all costs.
#[inline(always)]
fn least(costs: &Costs) -> i16 {
    /// Costs that are compared at once.
    const LANES: usize = 16;
    let mut lanes = [i16::MAX; LANES];
    for costs in costs.as_chunks::<LANES>().0 {
        for (least, &cost) in lanes.iter_mut().zip(costs) {
            *least = if cost < *least { cost } else { *least };
        }
    }
    lanes.into_iter().fold(i16::MAX, |a, b| if b < a { b } else { a })
}

#[cfg(test)]
mod tests;
