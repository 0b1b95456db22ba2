// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which surfaces somebody bears out who could contradict: a camera of another head, the marker, or the other camera of the
//! head where it contradicts every other label.
//!
//! Where the cameras of a head lie alike about their projector, an error of one fringe in one of them looks right to the
//! other, whose phase is a whole period off there: it agrees with several labels, and is no witness. A surface is all nodes
//! that continue each other with equal labels: a few places of it are enough. It bears out what continues it beyond a gap,
//! such as the next stripe of a shirt: one fringe off that would not continue it.

use super::drift::Differences;
use super::evidence::{CameraWeights, NO_ORDER, OrderTable, ln, odds, wrapped};
use super::inference::Field;
use super::observation::{Observations, Observed, PLACES};
use super::projection::{LANES, Ray};
use super::same_head::Mate;
use super::scene::Scene;
use std::f32::consts::{PI, TAU};

/// What a look adds that agrees by chance, in the mean: nothing is learnt from it.
const CHANCE: f32 = 0.3;

/// What all looks and markers of a surface must add up to.
const ENOUGH: f32 = 2.0;

/// How far a gap reaches that a surface may continue beyond, cells.
const GAP_CELLS: usize = 3;

/// By how much the phase beyond a gap may differ from the one that continues it, rad.
const BEYOND_GAP_RAD: f32 = 1.0;

/// Refuses the surfaces of a view that nobody bears out: their margin becomes 0. `known` has the turns of all patches
/// whose margin is at least `least`.
pub fn require(field: &mut Field<'_>, scenes: &[Scene<'_>], known: &OrderTable, least: f32) {
    let nodes = field.squares.all.len();
    let mut surfaces = Surfaces((0..nodes as u32).collect());
    for link in &field.graph.links {
        let [a, b] = [link.a, link.b].map(|i| i as usize);
        let continues = field.graph.label[b] - field.graph.label[a] == link.turns;
        let certain = field.graph.margin[a] >= least && field.graph.margin[b] >= least;
        if continues && certain {
            surfaces.join(link.a, link.b);
        }
    }
    let mut found = vec![0f32; nodes];
    for (node, label, counts) in field.votes() {
        if field.graph.label[node as usize] == label {
            found[surfaces.of(node) as usize] += counts;
        }
    }
    // The nodes of each surface, the largest first: they are seen best.
    let certain = (0..nodes as u32).filter(|&node| field.graph.margin[node as usize] >= least);
    let mut members: Vec<(u32, u32)> = certain.map(|node| (surfaces.of(node), node)).collect();
    members.sort_unstable_by_key(|&(surface, node)| {
        (surface, std::cmp::Reverse(field.squares.all[node as usize].side), node)
    });
    let weights = weights(field.number, scenes, known);
    let mut looks = Looks::new(field, scenes, known, &weights);
    let mut borne_out = vec![false; nodes];
    let mut open = Vec::new();
    for surface in members.chunk_by(|a, b| a.0 == b.0) {
        let mut sum = found[surface[0].0 as usize];
        for places in surface.chunks(PLACES) {
            if sum >= ENOUGH {
                break;
            }
            let patches = || places.iter().map(|&(_, node)| field.squares.all[node as usize].patch as usize);
            sum += looks.of_other_heads(field, patches());
            if sum < ENOUGH {
                sum += looks.of_mate(field, patches());
            }
        }
        if sum >= ENOUGH {
            surface.iter().for_each(|&(_, node)| borne_out[node as usize] = true);
        } else {
            open.push(surface);
        }
    }
    // One may bear out the next, over several gaps.
    loop {
        let before = open.len();
        open.retain(|surface| {
            let continues = surface.iter().any(|&(_, node)| continues(field, node as usize, &borne_out));
            if continues {
                surface.iter().for_each(|&(_, node)| borne_out[node as usize] = true);
            }
            !continues
        });
        if open.len() == before {
            break;
        }
    }
    for (_, node) in open.into_iter().flatten() {
        field.graph.margin[*node as usize] = 0.0;
    }
}

/// Whether a node continues another one beyond a gap that is borne out.
fn continues(field: &Field<'_>, node: usize, borne_out: &[bool]) -> bool {
    let patches = &field.scene.patches;
    let (i, width) = (field.squares.all[node].patch as usize, patches.width);
    let patch = &patches.all[i];
    let absolute = |i: usize| patches.all[i].phase + TAU * field.turns(i) as f32;
    let (column, row) = (patch.cell as usize % patches.columns, patch.cell as usize / patches.columns);
    let columns = column.saturating_sub(GAP_CELLS)..patches.columns.min(column + GAP_CELLS + 1);
    let rows = row.saturating_sub(GAP_CELLS)..(patches.grid.len() / patches.columns).min(row + GAP_CELLS + 1);
    rows.flat_map(|row| columns.clone().map(move |column| (row, column))).any(|(row, column)| {
        let spot = patches.grid[row * patches.columns + column];
        (spot.first as usize..(spot.first + spot.count) as usize).any(|j| {
            let other = &patches.all[j];
            let at = [patch.pixel, other.pixel].map(|pixel| [pixel as usize % width, pixel as usize / width]);
            let [right, down] = [0, 1].map(|axis| at[1][axis] as f32 - at[0][axis] as f32);
            let change = (patch.change(right, down) + other.change(right, down)) / 2.0;
            borne_out[field.squares.of[j] as usize]
                && (absolute(j) - absolute(i) - change).abs() < BEYOND_GAP_RAD
        })
    })
}

/// Nodes that are one surface: for each another one of it, or itself.
struct Surfaces(Vec<u32>);

impl Surfaces {
    /// The node that stands for a node's surface.
    fn of(&mut self, mut node: u32) -> u32 {
        while self.0[node as usize] != node {
            let next = self.0[node as usize];
            self.0[node as usize] = self.0[next as usize];
            node = next;
        }
        node
    }

    fn join(&mut self, a: u32, b: u32) {
        let [a, b] = [self.of(a), self.of(b)];
        self.0[a.max(b) as usize] = a.min(b);
    }
}

/// The weights of all cameras for a view, in blocks.
fn weights(view: usize, scenes: &[Scene<'_>], known: &OrderTable) -> Vec<CameraWeights> {
    let differences = known.differences[view].iter().enumerate();
    differences.map(|(block, x)| CameraWeights::new(scenes, view, block * LANES, x, 1.0)).collect()
}

/// What other cameras observe where nodes lie by their labels.
struct Looks<'a> {
    looks: Observations<'a>,
    known: &'a OrderTable,
    weights: &'a [CameraWeights],
    /// A bit for each camera of a block that belongs to another head.
    others: Vec<[bool; LANES]>,
    /// The other camera of the head.
    mate: Option<Mate<'a>>,
}

impl<'a> Looks<'a> {
    fn new(
        field: &Field<'_>,
        scenes: &'a [Scene<'a>],
        known: &'a OrderTable,
        weights: &'a [CameraWeights],
    ) -> Self {
        let view = field.number;
        let other = |i: usize| scenes.get(i).is_some_and(|scene| scene.head != scenes[view].head);
        let blocks = scenes.len().div_ceil(LANES);
        Self {
            looks: Observations::new(scenes),
            known,
            weights,
            others: (0..blocks).map(|block| std::array::from_fn(|i| other(block * LANES + i))).collect(),
            mate: Mate::new(scenes, view, weights, known),
        }
    }

    /// The sum of what the other camera of the head says for the labels of some patches.
    fn of_mate(&mut self, field: &Field<'_>, patches: impl Iterator<Item = usize>) -> f32 {
        self.mate.as_mut().map_or(0.0, |mate| patches.map(|i| alone(mate, field, i)).sum())
    }

    /// The sum of what the cameras of other heads say for the labels of some patches, [`PLACES`] at most.
    fn of_other_heads(&mut self, field: &Field<'_>, patches: impl Iterator<Item = usize>) -> f32 {
        let mut rays = [Ray { direction: [0.0; 3], inverse_depth: 0.0 }; PLACES];
        let (mut sights, mut terms, mut count) = ([Observed::NONE; PLACES], [[0.0; 3]; PLACES], 0);
        for i in patches {
            rays[count] = field.place(i);
            terms[count] = Differences::terms_of(field.scene.pixel(&field.scene.patches.all[i]));
            count += 1;
        }
        let mut sum = 0.0;
        for (block, (weights, others)) in self.weights.iter().zip(&self.others).enumerate() {
            let nothing = self.looks.at(field.number, block, &rays[..count], &mut sights);
            let differences = &self.known.differences[field.number][block];
            for (seen, terms) in sights.iter().zip(&terms).take(count) {
                for i in (0..LANES).filter(|&i| others[i] && seen.node[i] < nothing) {
                    let bias: f32 = terms.iter().zip(&differences.terms).map(|(term, by)| term * by[i]).sum();
                    let turns = self.known.turns[seen.node[i] as usize];
                    let known = turns != NO_ORDER;
                    let off = seen.ahead[i] - bias + if known { TAU * turns as f32 } else { 0.0 };
                    // Another surface hides this one, or is hidden: nothing is said about it.
                    sum += if known && off.abs() >= PI {
                        0.0
                    } else {
                        ln(odds(weights.share[i], weights.width[i], wrapped(off))) - CHANCE
                    };
                }
            }
        }
        sum
    }
}

/// What the other camera of the head says for the label of a patch: nothing where it does not contradict all others.
fn alone(mate: &mut Mate<'_>, field: &Field<'_>, i: usize) -> f32 {
    let (patch, table) = (&field.scene.patches.all[i], field.scene.projection.table);
    let (u, v) = field.scene.pixel(patch);
    let line = table.sightline(u, v);
    let (count, first) = (field.count[i] as usize, patch.phase / TAU - field.base[i] as f32);
    let label = (field.turns(i) + field.base[i]) as usize;
    let mut inverse = Vec::with_capacity(count.next_multiple_of(PLACES));
    for block in (0..count).step_by(PLACES) {
        inverse.extend(table.inverse_depths::<PLACES>(&line, first + block as f32));
    }
    let terms = Differences::terms_of((u, v));
    mate.judge::<false>(line.direction, first, &inverse, &terms);
    let says = -mate.costs[label] - CHANCE;
    // Its own orders were found with these labels: they are no reason against the others. It agrees nowhere where it sees
    // no surface, but a dark part of one looks so, too: of the neighbouring labels it has to see what it contradicts.
    mate.judge::<true>(line.direction, first, &inverse, &terms);
    let contradicts = |l: usize| {
        let sees_surface = mate.costs[l] < 0.0;
        l == label || (-mate.costs[l] <= CHANCE && (sees_surface || l.abs_diff(label) > 1))
    };
    if (0..count).all(contradicts) { says.max(0.0) } else { 0.0 }
}
