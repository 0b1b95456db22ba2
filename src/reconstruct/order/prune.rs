//! Parts of settled pieces that nothing vouches for.
//!
//! A piece may still have grown over two surfaces. Each of its nodes is tried against all other cameras; where around a
//! node most of what they say is against it, the node is refused. So is a node that hangs on its piece by a narrow part
//! and that no other camera confirms.

use super::settle::{Scene, look};
use super::split::{cell, words_of};
use std::collections::BTreeMap;

/// Cells to each side over which the words for and against are summed.
const REACH: usize = 2;

/// Words against from which a node may be refused.
const MIN_AGAINST: i32 = 3;

/// A node this many steps from its piece's core hangs on a narrow part.
const FAR_STEPS: u8 = 4;

/// From here on a node's own word counts: seams lie away from the cores.
const EDGE_STEPS: u8 = 2;

/// What speaks for a node.
#[derive(Debug, Clone, Copy, Default)]
pub struct Standing {
    /// Words of the other cameras for it and against.
    pub own: (i32, i32),
    /// Those for the nodes around it.
    pub words: (i32, i32),
    /// Steps over nodes of its piece to the piece's core; [`FAR_STEPS`] where it takes more.
    pub steps: u8,
}

impl Standing {
    /// Whether the other cameras contradict.
    pub fn contradicted(&self) -> bool {
        let (good, bad) = self.words;
        let here = self.steps >= EDGE_STEPS && self.own.1 > 0 && self.own.1 >= self.own.0;
        here || (bad >= MIN_AGAINST && bad > good)
    }

    /// Whether nothing vouches for it.
    pub fn unsupported(&self) -> bool {
        self.steps >= FAR_STEPS && self.words.0 <= 2 * self.words.1
    }
}

/// The standing of each node of a view.
pub fn standings(scenes: &[Scene<'_>], view: usize) -> Vec<Standing> {
    let scene = &scenes[view];
    // By piece and cell: words for and against.
    let mut words: BTreeMap<(u32, usize, usize), (i32, i32)> = BTreeMap::new();
    let mut own = vec![(0, 0); scene.pieces.of.len()];
    let mut sights = Vec::new();
    for (node, &piece) in scene.pieces.of.iter().enumerate() {
        let Ok(order) = scene.states[piece as usize].order else { continue };
        sights.clear();
        look(scenes, view, node as u32, order, &mut sights);
        let (good, bad) = words_of(scenes, view, &sights);
        own[node] = (good, bad);
        let (x, y) = cell(scene, node as u32);
        let sum = words.entry((piece, x, y)).or_default();
        *sum = (sum.0 + good, sum.1 + bad);
    }
    let around = |piece: u32, x: usize, y: usize| {
        let mut sum = (0, 0);
        for x in x.saturating_sub(REACH)..=x + REACH {
            for (_, word) in words.range((piece, x, y.saturating_sub(REACH))..=(piece, x, y + REACH)) {
                sum = (sum.0 + word.0, sum.1 + word.1);
            }
        }
        sum
    };
    let steps = steps(scene);
    let standing = |(node, &piece): (usize, &u32)| {
        let (x, y) = cell(scene, node as u32);
        Standing { own: own[node], words: around(piece, x, y), steps: steps[node] }
    };
    scene.pieces.of.iter().enumerate().map(standing).collect()
}

/// Steps from each node to the core of its piece, at most [`FAR_STEPS`].
fn steps(scene: &Scene<'_>) -> Vec<u8> {
    let pieces = &scene.pieces;
    let mut steps: Vec<u8> = pieces.core.iter().map(|&core| if core { 0 } else { FAR_STEPS }).collect();
    let same = |a: u32, b: u32| pieces.of[a as usize] == pieces.of[b as usize];
    for step in 1..FAR_STEPS {
        let before = steps.clone();
        for x in
            scene.witness.cells.borders.iter().filter(|x| same(x.a, x.b) && x.good >= 4 && x.good > x.bad)
        {
            for (near, far) in [(x.a as usize, x.b as usize), (x.b as usize, x.a as usize)] {
                if before[near] < step {
                    steps[far] = steps[far].min(step);
                }
            }
        }
    }
    steps
}
