//! Pieces that have grown over two surfaces, parted by what the other cameras say about their nodes.
//!
//! A seam along which two surfaces agree by chance does not show in the view itself. But their nodes agree with the other
//! cameras at different orders. Nodes whose surroundings clearly agree at one order are seeds of it; from them the orders
//! spread over the piece, through its wide parts first, so that they meet at its necks.

use super::jury::{Jury, Known, Weights};
use super::looks::{Looks, PieceLooks};
use super::settle::Scene;
use super::witness::SightLanes;
use crate::reconstruct::simd;
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// Cells to each side over which the words for and against an order are summed.
const REACH: usize = 2;

/// Words for an order that make a seed.
const MIN_FOR: u32 = 4;

/// Words for must outnumber those against, and those for any other order, so many times.
const LEAD: u32 = 3;

/// Nodes that are asked at most.
const MAX_ASKED: usize = 1600;

/// Pixel pairs that must continue for an order to spread.
const SPREAD_PAIRS: u32 = 4;

/// The smallest part, nodes.
const MIN_PART: usize = 6;

/// Parts a piece of a view into those that agree with the other cameras at different ones of `orders`: for each part its
/// nodes. `None` where there are no two. `asked` keeps what the cameras have at the nodes that are asked.
pub fn parts(
    scenes: &[Scene<'_>],
    (view, piece): (usize, usize),
    orders: &[i32],
    known: &Known,
    asked: &mut PieceLooks,
) -> Option<Vec<Vec<u32>>> {
    let scene = &scenes[view];
    let seeds = seeds(scenes, (view, piece), orders, known, asked);
    let first = seeds.first()?.1;
    if seeds.iter().all(|seed| seed.1 == first) {
        return None;
    }
    let label = spread(scene, piece, &seeds);
    let mut parts = vec![Vec::new(); orders.len() + 1];
    for &node in &scene.pieces.nodes[piece] {
        parts[label[node as usize].unwrap_or(orders.len())].push(node);
    }
    parts.retain(|x| !x.is_empty());
    let large = parts.iter().filter(|x| x.len() >= MIN_PART).count();
    (large >= 2).then_some(parts)
}

/// Nodes that agree with the other cameras, and the place of their order in `orders`.
fn seeds(
    scenes: &[Scene<'_>],
    (view, piece): (usize, usize),
    orders: &[i32],
    known: &Known,
    looked: &mut PieceLooks,
) -> Vec<(u32, usize)> {
    let scene = &scenes[view];
    let nodes = &scene.pieces.nodes[piece];
    let step = nodes.len().div_ceil(MAX_ASKED).max(1);
    let asked: Vec<u32> = nodes.iter().step_by(step).copied().collect();
    let at: Vec<(usize, usize)> = asked.iter().map(|&node| cell(scene, node)).collect();
    let ends = |of: fn(&(usize, usize)) -> usize| {
        let all = || at.iter().map(of);
        (all().min().unwrap_or(0), all().max().map_or(0, |last| last + 1))
    };
    let ((left, right), (top, bottom)) = (ends(|at| at.0), ends(|at| at.1));
    // For and against, by row, column and order, with nothing around.
    let stride = (right - left + 2 * REACH) * orders.len();
    let mut words = vec![0u32; (bottom - top + 2 * REACH) * stride];
    let of = |(x, y): (usize, usize)| (y - top + REACH) * stride + (x - left + REACH) * orders.len();
    let jury = Jury::new(scenes, view, weights);
    let places: Vec<_> = asked.iter().map(|&node| scene.at(node)).collect();
    for (number, &order) in orders.iter().enumerate() {
        let looks = looked.entry((view, piece, order)).or_insert_with(|| {
            let mut looks = Looks::default();
            looks.add(scenes, view, &places, order..=order);
            looks
        });
        let mut heard = Vec::with_capacity(asked.len());
        simd::dispatch(
            #[inline(always)]
            || {
                for place in 0..asked.len() {
                    heard.push(match looks.at(place) {
                        Some(seen) => words_of(&jury, seen, known),
                        None => AGAINST,
                    });
                }
            },
        );
        for (&at, heard) in at.iter().zip(heard) {
            words[of(at) + number] += heard;
        }
    }
    let sums = around(&around(&words, orders.len()), stride);
    let mut seeds = Vec::new();
    for (&node, &at) in asked.iter().zip(&at) {
        let first = of(at);
        let sums = sums[first..first + orders.len()].iter().map(|sum| (sum % AGAINST, sum / AGAINST));
        let Some((best, (good, bad))) = sums.clone().enumerate().max_by_key(|x| (x.1.0, Reverse(x.0))) else {
            continue;
        };
        let second = sums.enumerate().filter(|x| x.0 != best).map(|x| x.1.0).max().unwrap_or(0);
        if good >= MIN_FOR && good >= LEAD * bad && good >= LEAD * second {
            seeds.push((node, best));
        }
    }
    seeds
}

/// Sums of the words of [`REACH`] cells to each side, which lie `step` words from each other. Those at the ends have none.
fn around(words: &[u32], step: usize) -> Vec<u32> {
    const { assert!(REACH == 2) };
    let mut sums = vec![0; words.len()];
    let inner = words.len() - 2 * REACH * step;
    let [a, b, c, d, e] = [0, 1, 2, 3, 4].map(|side| &words[side * step..][..inner]);
    let to = &mut sums[REACH * step..][..inner];
    simd::dispatch(
        #[inline(always)]
        || {
            for (i, to) in to.iter_mut().enumerate() {
                *to = a[i] + b[i] + c[i] + d[i] + e[i];
            }
        },
    );
    sums
}

/// Place of a node in the grid of cells.
fn cell(scene: &Scene<'_>, node: u32) -> (usize, usize) {
    let cells = &scene.witness.cells;
    let at = cells.nodes[node as usize].cell as usize;
    (at % cells.columns, at / cells.columns)
}

/// What a camera says for and against a place, the half of a word each: the nodes of so many cells are not so many that a sum would reach
/// the other half.
fn weights(partner: bool) -> Weights {
    let against = if partner { AGAINST } else { 0 };
    Weights { agrees: 1, before: AGAINST, behind: against, past: against }
}

/// A word against a place.
const AGAINST: u32 = 1 << 16;

/// What the other cameras say for and against a place.
#[inline(always)]
fn words_of(jury: &Jury, seen: &[SightLanes], known: &Known) -> u32 {
    let mut sum = 0;
    for (block, seen) in seen.iter().enumerate() {
        for word in jury.hear(block, seen, known) {
            sum += word;
        }
    }
    sum
}

/// Spreads the seeds' labels over the piece, from wide parts to narrow ones: the label of each node of the view.
fn spread(scene: &Scene<'_>, piece: usize, seeds: &[(u32, usize)]) -> Vec<Option<usize>> {
    let inner = Inner { scene, piece };
    let clearance = inner.clearance();
    let mut label = vec![None; clearance.len()];
    let mut is_seed = vec![false; clearance.len()];
    let mut heap = BinaryHeap::new();
    for &(node, seed) in seeds {
        is_seed[node as usize] = true;
        heap.push((clearance[node as usize], Reverse(0u32), Reverse(node), seed));
    }
    while let Some((_, Reverse(distance), Reverse(node), seed)) = heap.pop() {
        if label[node as usize].is_some() {
            continue;
        }
        label[node as usize] = Some(seed);
        for next in inner.beside(node) {
            // A seed keeps its own label.
            if label[next as usize].is_none() && !is_seed[next as usize] {
                heap.push((clearance[next as usize], Reverse(distance + 1), Reverse(next), seed));
            }
        }
    }
    label
}

/// A piece as a graph of its own.
struct Inner<'a> {
    scene: &'a Scene<'a>,
    piece: usize,
}

impl Inner<'_> {
    /// The nodes of the piece that a node continues.
    fn beside(&self, node: u32) -> impl Iterator<Item = u32> {
        let (of, turns) = (&self.scene.pieces.of, &self.scene.pieces.turns);
        let edges = self.scene.graph.of(node as usize).iter().filter(move |x| {
            of[x.other as usize] as usize == self.piece
                && x.turns == turns[x.other as usize] - turns[node as usize]
                && x.good >= SPREAD_PAIRS
                && x.good > x.bad
        });
        edges.map(|x| x.other)
    }

    /// Steps from each node to the nearest that does not continue on all four sides; 0 where there is none.
    fn clearance(&self) -> Vec<u32> {
        let nodes = &self.scene.pieces.nodes[self.piece];
        let mut clearance = vec![0; self.scene.pieces.of.len()];
        let narrow = |&node: &u32| (1..4).contains(&self.beside(node).count());
        let mut front: Vec<u32> = nodes.iter().copied().filter(narrow).collect();
        let mut reached = vec![false; clearance.len()];
        front.iter().for_each(|&node| reached[node as usize] = true);
        let mut steps = 0;
        while !front.is_empty() {
            steps += 1;
            let mut next = Vec::new();
            for node in front {
                for other in self.beside(node) {
                    if !std::mem::replace(&mut reached[other as usize], true) {
                        clearance[other as usize] = steps;
                        next.push(other);
                    }
                }
            }
            front = next;
        }
        clearance
    }
}
