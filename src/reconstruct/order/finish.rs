//! The last word on every node: orders that too little vouches for are refused, and holes are closed.
//!
//! Two ways lead to a node's order: that of its piece, which was settled as a whole, and growth from node to node. Each of
//! them errs, seldom in the same place: where both say the same, one order in 1600 is wrong, where growth has left the
//! piece's order, one in 20. So agreement counts as a witness, and what the two dispute needs more of the others.
//!
//! What has no order then, though all that is known around it continues it at one and the same, takes that: a single
//! camera's contradiction is wrong more often than a surface that closes around a hole.

use super::graph::Graph;
use super::grow::{FIRM, Label, NONE, View};
use super::jury::Known;
use super::settle::Scene;
use super::words::Words;
use super::{confirmed, enclosed};

/// Words of the head's other camera, within two steps, without which an order other than the piece's is refused.
const DISPUTED: i16 = 8;

/// The same where growth puts the place behind the piece's: a limb that has taken the trunk's order.
const DISPUTED_BEHIND: i16 = 12;

/// Rounds of closing holes, at most: from each side they are closed by so many nodes.
const ROUNDS: usize = 20;

/// Pixel pairs on which known neighbours must continue a node: two whole sides of a cell; more than that.
const TWO_SIDES: u32 = 16;
const THREE_SIDES: u32 = 20;

/// What the head's other camera must say for one of these neighbours.
const KNOWN_WELL: i16 = 12;
const KNOWN: i16 = 6;

/// Cameras that contradict a place from which on a hole stays one.
const CONTRADICTED: i16 = 2;

/// The labels of a view's nodes, from what growth has come to. `known`: the orders of all views.
pub fn labels(number: usize, view: &mut View<'_>, scenes: &[Scene<'_>], known: &Known) -> Vec<Label> {
    let scene = &scenes[number];
    let n = view.graph.len();
    let mut sum: Vec<Words> = (0..n).map(|node| view.around.words(node)).collect();
    let mut labels: Vec<Label> = (0..n)
        .map(|node| match view.turns(node) {
            NONE => Label { turns: NONE, contradicted: view.is_contradicted(node) },
            turns => {
                let refused = doubtful(view, scene, node, &sum[node]);
                Label { turns: if refused { NONE } else { turns }, contradicted: false }
            }
        })
        .collect();
    close(view, scenes, scene, known, &mut sum, &mut labels);
    stretches(number, view, scenes, known, &mut labels);
    labels
}

/// Gives stretches that are open their orders, by what is known of all views. For what one view finds another may wait, so this is
/// asked again when all have their labels.
pub fn stretches(
    number: usize,
    view: &mut View<'_>,
    scenes: &[Scene<'_>],
    known: &Known,
    labels: &mut [Label],
) {
    confirmed::place(number, view, scenes, known, labels);
    enclosed::close(number, view, scenes, known, labels);
}

/// Whether too little vouches for a node's order. `sum`: words for it and the nodes within two steps.
fn doubtful(view: &View<'_>, scene: &Scene<'_>, node: usize, sum: &Words) -> bool {
    let piece = scene.turns_of(node as u32);
    let agreed = piece == Some(view.turns(node));
    let conflict = view.around.conflict(node);
    let unconfirmed = view.words(node).good() == 0 && sum.good() < 3;
    // What only other heads confirm: the surface behind a limb is seen by them too.
    let alone = sum.partner == 0 && (scene.pieces.core[node] || sum.hidden == 0);
    let torn = conflict > 16 || conflict > 0 && sum.partner <= 15;
    let rim = view.around.is_torn(node) && sum.partner <= FIRM && sum.heads <= FIRM;
    let unvouched = unconfirmed || alone && !agreed;
    let disputed = match piece {
        None => sum.partner < DISPUTED && sum.heads == 0,
        Some(piece) if scene.witness.is_behind(view.turns(node), piece) => sum.partner < DISPUTED_BEHIND,
        Some(_) => !agreed && sum.partner < DISPUTED,
    };
    unvouched || torn || rim || disputed
}

/// Gives nodes the order that all known neighbours propose, ring by ring; it may not be another than the piece's.
fn close(
    view: &mut View<'_>,
    scenes: &[Scene<'_>],
    scene: &Scene<'_>,
    known: &Known,
    sum: &mut [Words],
    labels: &mut [Label],
) {
    let mut open: Vec<usize> = (0..labels.len()).filter(|&node| labels[node].turns == NONE).collect();
    for _ in 0..ROUNDS {
        let mut found = Vec::new();
        for &node in &open {
            let Some(hole) = Hole::around(view.graph, sum, labels, node) else { continue };
            let least = if hole.good >= THREE_SIDES { KNOWN } else { KNOWN_WELL };
            let enough = hole.good >= TWO_SIDES
                && hole.rim.partner >= least
                && scene.turns_of(node as u32).is_none_or(|piece| piece == hole.turns);
            if enough && view.sights.words(scenes, node, hole.turns, known).against < CONTRADICTED {
                found.push((node, hole));
            }
        }
        if found.is_empty() {
            return;
        }
        open.clear();
        for (node, hole) in found {
            // What was no hole is one only if something beside it has changed.
            open.extend(view.graph.of(node).iter().map(|edge| edge.other as usize));
            labels[node] = Label { turns: hole.turns, contradicted: false };
            // The farther from what is confirmed, the less.
            let fade = |words: i16| words * 3 / 4;
            sum[node] = Words { partner: fade(hole.rim.partner), heads: fade(hole.rim.heads), ..sum[node] };
        }
        open.retain(|&node| labels[node].turns == NONE);
        open.sort_unstable();
        open.dedup();
    }
}

/// A node without an order, as the neighbours that have one see it.
struct Hole {
    /// The turns that they propose.
    turns: i32,
    /// Pixel pairs that continue.
    good: u32,
    /// The most that is said for one of them.
    rim: Words,
}

impl Hole {
    /// `None` where they propose none, or several, or do not continue everywhere.
    fn around(graph: &Graph, sum: &[Words], labels: &[Label], node: usize) -> Option<Self> {
        let mut hole: Option<Self> = None;
        for edge in graph.of(node) {
            let other = labels[edge.other as usize].turns;
            if other == NONE {
                continue;
            }
            if edge.bad > 0 {
                return None;
            }
            let (turns, words) = (other - edge.turns, sum[edge.other as usize]);
            let hole = hole.get_or_insert(Self { turns, good: 0, rim: Words::default() });
            if hole.turns != turns {
                return None;
            }
            hole.good += edge.good;
            hole.rim.partner = hole.rim.partner.max(words.partner);
            hole.rim.heads = hole.rim.heads.max(words.heads);
        }
        hole
    }
}

#[cfg(test)]
mod tests {
    use super::{Hole, TWO_SIDES};
    use crate::image::Plane;
    use crate::reconstruct::order::cells::{Cells, Surface};
    use crate::reconstruct::order::graph::Graph;
    use crate::reconstruct::order::grow::{Label, NONE};
    use crate::reconstruct::order::words::Words;
    use crate::reconstruct::runs::Runs;
    use std::f32::consts::TAU;

    /// Five by five cells of a plane; its nodes are numbered row by row.
    const SIDE: usize = 5;
    const MIDDLE: usize = SIDE * SIDE / 2;

    /// The hole in the middle, when `turns` are those of the nodes.
    fn hole(turns: impl Fn(usize) -> i32) -> Option<Hole> {
        let (px, period) = (8 * SIDE, 10.0);
        let data = (0..px * px).map(|i| (i % px) as f32 * TAU / period).collect();
        let phase = Plane::from_vec(px, px, data).expect("the plane's size");
        let (object, period) = (Plane::filled(px, px, 1), Plane::filled(px, px, period));
        let runs = Runs::of(&object);
        let surface = Surface { phase: &phase, period: &period, runs: &runs, sign: 1.0, sensor_rows: 1.0 };
        let graph = Graph::new(&Cells::new(&surface), 1);
        let labels: Vec<Label> =
            (0..SIDE * SIDE).map(|node| Label { turns: turns(node), contradicted: false }).collect();
        let sum = vec![Words { partner: 9, ..Words::default() }; labels.len()];
        Hole::around(&graph, &sum, &labels, MIDDLE)
    }

    #[test]
    fn a_hole_takes_the_order_that_all_around_it_propose() {
        let found =
            hole(|node| if node == MIDDLE { NONE } else { 7 }).expect("a surface that closes around it");
        assert_eq!((found.turns, found.good, found.rim.partner), (7, 2 * TWO_SIDES, 9));
        let half = hole(|node| if node >= MIDDLE { NONE } else { 7 }).expect("two sides that are known");
        assert_eq!((half.turns, half.good), (7, TWO_SIDES));
    }

    #[test]
    fn a_hole_between_two_surfaces_stays_open() {
        assert!(hole(|node| if node == MIDDLE { NONE } else { i32::from(node > MIDDLE) }).is_none());
        assert!(hole(|_| NONE).is_none());
    }
}
