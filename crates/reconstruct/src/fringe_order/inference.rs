// SPDX-License-Identifier: MIT OR Apache-2.0
//! The labels of a view's nodes that cost least together: tree-reweighted message passing, one sweep after the other
//! (TRW-S; Kolmogorov, IEEE PAMI 28:1568, 2006).

use super::links::Link;
use super::projection::Ray;
use super::scene::Scene;
use super::squares::Squares;
use crate::kernels::simd;
use std::f32::consts::TAU;

/// Labels are worked on by so many at once: a node has room for a whole multiple of this.
const LANES: usize = 16;

/// Costs are whole multiples of this step, in 16 bits, and the least cost of a patch is 0: sums do not depend on their
/// order, and little memory is moved.
pub const STEP: f32 = 1.0 / 128.0;

/// The cost of a label that a node cannot have, in steps: 100.
pub const NEVER: i16 = 12_800;

/// By how much one marker pixel lowers the cost of its patch's label.
const MARKER: f32 = 0.3;

/// By how much all marker pixels of a patch together lower that cost at most.
const MARKER_MOST: f32 = 3.0;

/// The nodes of a view with the costs of their labels and the links between them; after [`Graph::infer`] with their
/// labels and margins.
#[derive(Debug)]
pub struct Graph {
    /// Room for the labels of a node: those of the node that has most of all.
    pub labels: usize,
    /// Costs of each label by itself, node by node.
    unary: Vec<i16>,
    /// For each label of a node, the least cost of all nodes together with it.
    marginal: Vec<i16>,
    /// The label of each node.
    pub label: Vec<i32>,
    /// How much more any other label would cost.
    pub margin: Vec<f32>,
    /// Links, with turns between labels.
    pub links: Vec<Link>,
    /// Links of node `i`: `of[start[i]..start[i + 1]]`.
    start: Vec<u32>,
    of: Vec<u32>,
    /// From `a` to `b` of each link, then from `b` to `a`.
    messages: Vec<i16>,
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
    /// The node of each patch.
    pub squares: Squares,
    /// Costs, links, labels and margins of the nodes.
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
            let [first, last] = scene.projection.table.fringes_sought(u, v).map(f32::floor);
            base[i] = (patch.phase / TAU).floor() as i32 - first as i32;
            count[i] = ((last - first) as i32 + 1).max(0) as u32;
        }
        let between =
            |link: &Link| Link { turns: link.turns + base[link.b as usize] - base[link.a as usize], ..*link };
        let links: Vec<Link> = scene.patches.links.iter().map(between).collect();
        let most = count.iter().max().map_or(0, |most| *most as usize);
        let (squares, graph) = if scenes.len() > 1 {
            let squares = Squares::of(&scene.patches, &links);
            let links = squares.between(&links);
            let graph = Graph::new(squares.all.len(), most, links);
            (squares, graph)
        } else {
            // Labels are not compared: there is nothing to compare them with.
            (Squares::single(n), Graph::new(n, 0, links))
        };
        Self { scene, number, first, base, count, squares, graph }
    }

    /// Whole turns that make a patch's phases absolute.
    pub fn turns(&self, i: usize) -> i32 {
        self.graph.label[self.squares.of[i] as usize] + self.squares.ahead[i] - self.base[i]
    }

    /// Where a patch lies by its label.
    pub fn place(&self, i: usize) -> Ray {
        let (patch, table) = (&self.scene.patches.all[i], self.scene.projection.table);
        let (u, v) = self.scene.pixel(patch);
        let line = table.sightline(u, v);
        let [inverse_depth] = table.inverse_depths(&line, patch.phase / TAU + self.turns(i) as f32);
        Ray { direction: line.direction, inverse_depth }
    }

    /// By how much a patch's label leads any other.
    pub fn margin(&self, i: usize) -> f32 {
        self.graph.margin[self.squares.of[i] as usize]
    }

    /// The labels that marker pixels give to nodes by way of their patches: node, label, and how much that lowers the
    /// label's cost.
    pub fn votes(&self) -> impl Iterator<Item = (u32, i32, f32)> {
        self.scene.votes.iter().map(|&(patch, turns, px)| {
            let i = patch as usize;
            let label = turns + self.base[i] - self.squares.ahead[i];
            (self.squares.of[i], label, (MARKER * px as f32).min(MARKER_MOST))
        })
    }
}

impl Graph {
    /// A graph of `n` nodes that have `labels` labels at most, whose costs are all 0.
    pub fn new(n: usize, labels: usize, links: Vec<Link>) -> Self {
        let labels = labels.max(1).next_multiple_of(LANES);
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
        let (unary, marginal) = (vec![0; n * labels], vec![0; n * labels]);
        let messages = vec![0; 2 * links.len() * labels];
        let (label, margin) = (vec![0; n], vec![0.0; n]);
        Self { labels, unary, marginal, label, margin, links, start, of, messages }
    }

    /// The links of a node.
    pub fn links_of(&self, i: usize) -> &[u32] {
        &self.of[self.start[i] as usize..self.start[i + 1] as usize]
    }

    /// The costs of a node's labels by themselves, in steps; the least of them is 0.
    pub fn unary_mut(&mut self, i: usize) -> &mut [i16] {
        &mut self.unary[i * self.labels..][..self.labels]
    }

    #[cfg(test)]
    fn unary(&self, i: usize) -> &[i16] {
        &self.unary[i * self.labels..][..self.labels]
    }

    /// For each label of a node the least cost of all nodes together with it, in steps, after [`Graph::infer`].
    pub fn marginal(&self, i: usize) -> &[i16] {
        &self.marginal[i * self.labels..][..self.labels]
    }

    /// Where the message of a link to its node begins: to `a`, or to `b`.
    #[inline(always)]
    fn message(&self, link: usize, to_a: bool) -> usize {
        (2 * link + usize::from(to_a)) * self.labels
    }

    /// Finds the labels that cost least together, and their margins, by this many sweeps, each over all nodes forwards
    /// and backwards.
    pub fn infer(&mut self, sweeps: usize) {
        simd::dispatch(
            #[inline(always)]
            || {
                let n = self.label.len();
                let mut room = Room {
                    sum: vec![0; self.labels],
                    // On both sides of the costs there is nothing that a link could lead to.
                    padded: vec![i16::MAX; 3 * self.labels],
                };
                for _ in 0..sweeps {
                    for i in 0..n {
                        self.send(i, true, &mut room);
                    }
                    for i in (0..n).rev() {
                        self.send(i, false, &mut room);
                    }
                }
                for i in 0..n {
                    self.decide(i, &mut room.sum);
                }
            },
        );
    }

    /// The label of a node, where those before have theirs. `given` is room for costs.
    #[inline(always)]
    fn decide(&mut self, i: usize, given: &mut [i16]) {
        let own = i * self.labels..(i + 1) * self.labels;
        given.copy_from_slice(&self.unary[own.clone()]);
        self.marginal[own.clone()].copy_from_slice(&self.unary[own.clone()]);
        for &k in &self.of[self.start[i] as usize..self.start[i + 1] as usize] {
            let link = &self.links[k as usize];
            let is_a = link.a as usize == i;
            let message = &self.messages[self.message(k as usize, is_a)..][..self.labels];
            add(&mut self.marginal[own.clone()], message);
            if is_a {
                add(given, message);
                continue;
            }
            // Any other label than that of the one before costs what the link does.
            let kept = self.label[link.a as usize] + link.turns;
            if let Some(kept) = usize::try_from(kept).ok().and_then(|kept| given.get_mut(kept)) {
                *kept = kept.saturating_sub(in_steps(link.weight));
            }
        }
        let lowest = least(given);
        let best = given.iter().position(|cost| *cost == lowest).unwrap_or(0);
        let marginal = &self.marginal[own];
        given.copy_from_slice(marginal);
        given[best] = i16::MAX;
        self.label[i] = best as i32;
        self.margin[i] = STEP * (f32::from(least(given)) - f32::from(marginal[best]));
    }

    /// Sends a node's messages to those after it, or before it.
    #[inline(always)]
    fn send(&mut self, i: usize, forward: bool, Room { sum, padded }: &mut Room) {
        let labels = self.labels;
        let of = &self.of[self.start[i] as usize..self.start[i + 1] as usize];
        sum.copy_from_slice(&self.unary[i * labels..][..labels]);
        let mut later = 0;
        for &k in of {
            let is_a = self.links[k as usize].a as usize == i;
            later += usize::from(is_a);
            add(sum, &self.messages[self.message(k as usize, is_a)..][..labels]);
        }
        // A share, in units of 1/65536.
        let gamma = u32::from(u16::MAX) / later.max(of.len() - later).max(1) as u32;
        for sum in as_lanes_mut(sum) {
            // Sums are not negative.
            for sum in sum {
                *sum = ((u32::from(*sum as u16) * gamma) >> u16::BITS) as u16 as i16;
            }
        }
        for &k in of {
            let link = &self.links[k as usize];
            let is_a = link.a as usize == i;
            if is_a != forward {
                continue;
            }
            let back = self.message(k as usize, is_a);
            let mut lowest = [i16::MAX; LANES];
            let back = as_lanes(&self.messages[back..][..labels]);
            for ((own, sum), back) in
                as_lanes_mut(&mut padded[labels..2 * labels]).iter_mut().zip(as_lanes(sum)).zip(back)
            {
                let (mut cost, back) = (*sum, *back);
                for l in 0..LANES {
                    cost[l] -= back[l];
                    lowest[l] = lowest[l].min(cost[l]);
                }
                *own = cost;
            }
            let lowest = lowest.into_iter().fold(i16::MAX, i16::min);
            let turns = if is_a { link.turns } else { -link.turns };
            // Beyond all labels one turn is as far as another.
            let turns = (turns as isize).clamp(-(labels as isize), labels as isize);
            let from = as_lanes(&padded[(labels as isize - turns) as usize..][..labels]);
            let weight = in_steps(link.weight);
            let to = self.message(k as usize, !is_a);
            for (to, from) in as_lanes_mut(&mut self.messages[to..][..labels]).iter_mut().zip(from) {
                let mut message = *from;
                for message in &mut message {
                    *message = message.saturating_sub(lowest).min(weight);
                }
                *to = message;
            }
        }
    }
}

/// Room for the work on one node.
struct Room {
    /// The costs of the labels of that node.
    sum: Vec<i16>,
    /// The same between two times as many that no label has.
    padded: Vec<i16>,
}

/// A cost as a number of steps.
#[inline(always)]
fn in_steps(cost: f32) -> i16 {
    ((cost * (1.0 / STEP)) as i16).min(NEVER)
}

#[inline(always)]
fn as_lanes(costs: &[i16]) -> &[[i16; LANES]] {
    costs.as_chunks().0
}

#[inline(always)]
fn as_lanes_mut(costs: &mut [i16]) -> &mut [[i16; LANES]] {
    costs.as_chunks_mut().0
}

#[inline(always)]
fn add(to: &mut [i16], from: &[i16]) {
    // Values, not places: nothing that is written changes what is read.
    for (to, from) in as_lanes_mut(to).iter_mut().zip(as_lanes(from)) {
        let (mut sum, from) = (*to, *from);
        for l in 0..LANES {
            sum[l] = sum[l].saturating_add(from[l]);
        }
        *to = sum;
    }
}

/// The least of all costs.
#[inline(always)]
pub fn least(costs: &[i16]) -> i16 {
    let mut lanes = [i16::MAX; LANES];
    for costs in as_lanes(costs) {
        for l in 0..LANES {
            lanes[l] = lanes[l].min(costs[l]);
        }
    }
    lanes.into_iter().fold(i16::MAX, i16::min)
}

#[cfg(test)]
mod tests;
