//! Stretches without an order that surfaces with one enclose.
//!
//! What no other camera sees is refused, node by node: a limb that has taken the trunk's order hangs on the trunk along one side.
//! But what is continued at one and the same order along most of its outline, by all that is known beside it, can hardly be
//! anything else than a part of that surface. The smaller a stretch, the less of its outline has to: a few cells are no limb.
//! Without the head's other camera whole limbs are open, and enclosed in the same way by the trunk before which they cross: there
//! nothing is closed.

use super::graph::Graph;
use super::grow::{Label, NONE, View};
use super::jury::Known;
use super::settle::Scene;
use super::stretch::{self, Member};

/// Pixel pairs along which a stretch is continued, relative to the root of its pixels: a square has an outline of 4. Of a small stretch
/// one for so many of its pixels is enough: a square whose sides are 25 px may hang on a surface along one of them, of 50 px along two.
const ENCLOSED: f32 = 2.5;
const PX_PER_PAIR: f32 = 25.0;

/// Fewest of these pairs.
const MIN_PAIRS: u32 = 6;

/// Of the pairs with what is known one in so many may say something else, and as many may not continue.
const UNLIKE: u32 = 12;

/// Places of a stretch that are tried, at most, and the pixels of a node that counts as a place.
const SAMPLES: usize = 48;
const MIN_SAMPLE_PX: u32 = 12;

/// Gives enclosed stretches of a view their order; not those of which the other cameras contradict more than half of the places.
pub fn close(number: usize, view: &mut View<'_>, scenes: &[Scene<'_>], known: &Known, labels: &mut [Label]) {
    let scene = &scenes[number];
    if scene.lone {
        return;
    }
    let size = |node: u32| scene.witness.cells.nodes[node as usize].size;
    let mut found = Vec::new();
    let stretches = stretch::open(view.graph, labels);
    for stretch in stretches.iter() {
        let Some(turns) = enclosing(view.graph, stretch, size, labels) else { continue };
        let places = stretch::places(scene, stretch, MIN_SAMPLE_PX, SAMPLES);
        let mut words = |&(node, own): &Member| view.sights.words(scenes, node as usize, turns + own, known);
        let against = places.iter().filter(|place| words(place).against > 0).count();
        if !places.is_empty() && 2 * against <= places.len() {
            found.push((stretch, turns));
        }
    }
    for (stretch, turns) in found {
        for &(node, own) in stretch {
            labels[node as usize] = Label { turns: turns + own, contradicted: false };
        }
    }
}

/// The turns that what is known around a stretch proposes for its first node, where it encloses the stretch.
fn enclosing(graph: &Graph, stretch: &[Member], size: impl Fn(u32) -> u32, labels: &[Label]) -> Option<i32> {
    let mut proposals: Vec<(i32, u32)> = Vec::new();
    let (mut good, mut bad) = (0, 0);
    for &(node, own) in stretch {
        for edge in graph.of(node as usize) {
            let other = labels[edge.other as usize].turns;
            if other == NONE {
                continue;
            }
            let turns = other - edge.turns - own;
            match proposals.iter_mut().find(|x| x.0 == turns) {
                Some(x) => x.1 += edge.good,
                None => proposals.push((turns, edge.good)),
            }
            (good, bad) = (good + edge.good, bad + edge.bad);
        }
    }
    let &(turns, alike) = proposals.iter().max_by_key(|x| (x.1, x.0))?;
    let px = stretch.iter().map(|x| size(x.0)).sum::<u32>() as f32;
    let least = (ENCLOSED * px.sqrt()).min(px / PX_PER_PAIR);
    (alike >= MIN_PAIRS && alike as f32 >= least && (good - alike) * UNLIKE <= good && bad * UNLIKE <= good)
        .then_some(turns)
}

#[cfg(test)]
mod tests {
    use super::enclosing;
    use crate::image::Plane;
    use crate::reconstruct::order::cells::{CELL_PX, Cells, Surface};
    use crate::reconstruct::order::graph::Graph;
    use crate::reconstruct::order::grow::{Label, NONE};
    use crate::reconstruct::order::stretch;
    use crate::reconstruct::runs::Runs;
    use std::f32::consts::TAU;

    /// Eight by eight cells of a plane; its nodes are numbered row by row.
    const SIDE: usize = 8;

    /// The order of the open stretch, and its nodes, when `turns` are those of the nodes by column and row.
    fn found(turns: impl Fn(usize, usize) -> i32) -> (Option<i32>, usize) {
        let (px, period) = (CELL_PX * SIDE, 10.0);
        let data = (0..px * px).map(|i| (i % px) as f32 * TAU / period).collect();
        let phase = Plane::from_vec(px, px, data).expect("the plane's size");
        let (object, period) = (Plane::filled(px, px, 1), Plane::filled(px, px, period));
        let runs = Runs::of(&object);
        let surface = Surface { phase: &phase, period: &period, runs: &runs, sign: 1.0, sensor_rows: 1.0 };
        let graph = Graph::new(&Cells::new(&surface), 1);
        let label = |node: usize| Label { turns: turns(node % SIDE, node / SIDE), contradicted: false };
        let labels: Vec<Label> = (0..SIDE * SIDE).map(label).collect();
        let stretches = stretch::open(&graph, &labels);
        let stretches: Vec<_> = stretches.iter().collect();
        let [stretch] = &stretches[..] else { panic!("one stretch, not {stretches:?}") };
        (enclosing(&graph, stretch, |_| (CELL_PX * CELL_PX) as u32, &labels), stretch.len())
    }

    /// Whether a cell is one of the four by four in the middle.
    fn in_middle(u: usize, v: usize) -> bool {
        (2..6).contains(&u) && (2..6).contains(&v)
    }

    #[test]
    fn what_is_enclosed_takes_the_order_around_it() {
        assert_eq!(found(|u, v| if in_middle(u, v) { NONE } else { 7 }), (Some(7), 16));
        // Open to one side: three quarters of the outline.
        let bay = |u: usize, v: usize| (2..6).contains(&u) && v >= 4;
        assert_eq!(found(|u, v| if bay(u, v) { NONE } else { 7 }), (Some(7), 16));
    }

    #[test]
    fn what_is_large_and_hangs_on_a_surface_along_one_side_stays_open() {
        assert_eq!(found(|_, v| if v >= 1 { NONE } else { 7 }), (None, 56));
        assert_eq!(found(|_, v| if v >= 4 { NONE } else { 7 }), (None, 32));
        // The same side of a stretch that is not so deep; two sides of a corner.
        assert_eq!(found(|_, v| if v >= 6 { NONE } else { 7 }), (Some(7), 16));
        assert_eq!(found(|u, v| if u >= 4 && v >= 4 { NONE } else { 7 }), (Some(7), 16));
    }

    #[test]
    fn what_lies_between_two_orders_stays_open() {
        assert_eq!(found(|u, v| if in_middle(u, v) { NONE } else { 7 + i32::from(u >= 6) }), (None, 16));
        // One of the two sides of a corner.
        assert_eq!(found(|u, v| if u >= 4 && v >= 4 { NONE } else { 7 + i32::from(v >= 4) }), (None, 16));
    }
}
