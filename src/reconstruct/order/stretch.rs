//! Stretches: nodes of a view that continue one another, and the orders that are tried for them.

use super::graph::{Edge, Graph};
use super::settle::Scene;
use super::volume;
use std::f32::consts::TAU;
use std::ops::RangeInclusive;

/// Pixel pairs that must continue for nodes to be one stretch, and how many times more than those that do not.
const MIN_PAIRS: u32 = 4;
const MIN_SHARE: u32 = 3;

/// A node, and the turns that it needs beside those of the stretch's first.
pub type Member = (u32, i32);

/// The nodes that continue one another from `first` on, of those that `belongs` admits and that are not in `seen` yet; in the order
/// of their numbers.
pub fn from(graph: &Graph, first: usize, seen: &mut [bool], belongs: impl Fn(usize) -> bool) -> Vec<Member> {
    let continues = |edge: &&Edge| edge.good >= MIN_PAIRS && edge.good >= MIN_SHARE * edge.bad;
    seen[first] = true;
    let mut found = vec![(first as u32, 0)];
    let mut at = 0;
    while let Some(&(node, turns)) = found.get(at) {
        at += 1;
        for edge in graph.of(node as usize).iter().filter(continues) {
            let other = edge.other as usize;
            if !seen[other] && belongs(other) {
                seen[other] = true;
                found.push((edge.other, turns + edge.turns));
            }
        }
    }
    found.sort_unstable();
    found
}

/// The nodes of a stretch that are tried: so many of those of `min_px` pixels and more, evenly.
pub fn places(scene: &Scene<'_>, stretch: &[Member], min_px: u32, samples: usize) -> Vec<Member> {
    let size = |x: &Member| scene.witness.cells.nodes[x.0 as usize].size;
    let large: Vec<Member> = stretch.iter().copied().filter(|x| size(x) >= min_px).collect();
    let step = large.len().div_ceil(samples).max(1);
    large.into_iter().step_by(step).collect()
}

/// Phase of a member's pixel at order 0 of its stretch, rad.
pub fn phase(scene: &Scene<'_>, (node, turns): Member) -> f32 {
    scene.phase(node) + TAU * (turns - scene.pieces.turns[node as usize]) as f32
}

/// The orders that put a stretch with these places into the volume.
pub fn orders(scene: &Scene<'_>, places: &[Member]) -> Option<RangeInclusive<i32>> {
    let ends = places.iter().step_by(places.len().div_ceil(2).max(1)).map(|&place| {
        let (u, v, _) = scene.place(place.0);
        (u, v, phase(scene, place))
    });
    volume::orders_of(scene.triangulator.pair(), ends)
}
