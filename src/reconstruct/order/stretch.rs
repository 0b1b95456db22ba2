//! Stretches: nodes of a view that continue one another, and the orders that are tried for them.

use super::graph::{Edge, Graph};
use super::grow::{Label, NONE};
use super::looks::Place;
use super::settle::Scene;
use super::volume;
use std::f32::consts::TAU;
use std::ops::RangeInclusive;

/// Pixel pairs that must continue for nodes to be one stretch, and how many times more than those that do not.
const MIN_PAIRS: u32 = 2;
const MIN_SHARE: u32 = 3;

/// A node, and the turns that it needs beside those of the stretch's first.
pub type Member = (u32, i32);

/// Stretches of a view.
#[derive(Debug, Default)]
pub struct Stretches {
    /// The members of one after the other.
    members: Vec<Member>,
    ends: Vec<usize>,
}

impl Stretches {
    /// The members of each.
    pub fn iter(&self) -> impl Iterator<Item = &[Member]> {
        let starts = std::iter::once(0).chain(self.ends.iter().copied());
        starts.zip(&self.ends).map(|(start, &end)| &self.members[start..end])
    }
}

/// All stretches of the nodes that are open, none reaching from a node to another that is not `together` with it; those that begin at
/// one of some `nodes`. Members are in the order of their numbers.
pub fn all(
    graph: &Graph,
    nodes: impl Iterator<Item = usize>,
    is_open: impl Fn(usize) -> bool,
    together: impl Fn(usize, usize) -> bool,
) -> Stretches {
    let continues = |edge: &&Edge| edge.good >= MIN_PAIRS && edge.good >= MIN_SHARE * edge.bad;
    let mut seen = vec![false; graph.len()];
    let mut stretches = Stretches::default();
    let found = &mut stretches.members;
    for first in nodes {
        if seen[first] || !is_open(first) {
            continue;
        }
        seen[first] = true;
        let start = found.len();
        let mut at = start;
        found.push((first as u32, 0));
        while let Some(&(node, turns)) = found.get(at) {
            at += 1;
            for edge in graph.of(node as usize).iter().filter(continues) {
                let other = edge.other as usize;
                if !seen[other] && is_open(other) && together(first, other) {
                    seen[other] = true;
                    found.push((edge.other, turns + edge.turns));
                }
            }
        }
        found[start..].sort_unstable();
        stretches.ends.push(found.len());
    }
    stretches
}

/// All stretches of the nodes that have no order.
pub fn open(graph: &Graph, labels: &[Label]) -> Stretches {
    all(graph, 0..graph.len(), |node| labels[node].turns == NONE, |_, _| true)
}

/// The nodes of a stretch that are tried: so many of those of `min_px` pixels and more, evenly.
pub fn places(scene: &Scene<'_>, stretch: &[Member], min_px: u32, samples: usize) -> Vec<Member> {
    let size = |x: &Member| scene.witness.cells.nodes[x.0 as usize].size;
    let large: Vec<Member> = stretch.iter().copied().filter(|x| size(x) >= min_px).collect();
    let step = large.len().div_ceil(samples).max(1);
    large.into_iter().step_by(step).collect()
}

/// Lines of sight of places, and their phases at order 0 of their stretch, in fringes.
pub fn lines<'a>(scene: &'a Scene<'_>, places: &[Member]) -> Vec<Place<'a>> {
    places.iter().map(|&place| (&scene.lines[place.0 as usize], phase(scene, place) / TAU)).collect()
}

/// Phase of a member's pixel at order 0 of its stretch, rad.
fn phase(scene: &Scene<'_>, (node, turns): Member) -> f32 {
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
