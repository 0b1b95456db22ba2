//! Parts of settled pieces that the other cameras contradict.
//!
//! A piece may still have grown over two surfaces. Each of its nodes is tried against all other cameras; where around a
//! node most of what they say is against it, the node is refused.

use super::cells::CELL_PX;
use super::settle::{Scene, look, verdict};
use super::witness::Verdict;
use std::collections::BTreeMap;

/// Cells to each side over which the words for and against are summed.
const REACH: usize = 2;

/// Words against from which a node may be refused.
const MIN_AGAINST: i32 = 5;

/// So many words against outweigh one for.
const AGAINST_PER_FOR: i32 = 2;

/// For each view, which of its nodes are contradicted.
pub fn contradicted(scenes: &[Scene<'_>]) -> Vec<Vec<bool>> {
    (0..scenes.len()).map(|view| of_view(scenes, view)).collect()
}

fn of_view(scenes: &[Scene<'_>], view: usize) -> Vec<bool> {
    let scene = &scenes[view];
    let width = scene.witness.phase.width();
    let cell = |node: usize| {
        let pixel = scene.witness.cells.nodes[node].pixel as usize;
        (pixel % width / CELL_PX, pixel / width / CELL_PX)
    };
    // By piece and cell: words for and against.
    let mut words: BTreeMap<(u32, usize, usize), (i32, i32)> = BTreeMap::new();
    let mut sights = Vec::new();
    for (node, &piece) in scene.pieces.of.iter().enumerate() {
        let Ok(order) = scene.states[piece as usize].order else { continue };
        sights.clear();
        look(scenes, view, node as u32, order, &mut sights);
        let (mut good, mut bad) = (0, 0);
        for &(other, sight) in &sights {
            let partner = scenes[usize::from(other)].witness.head == scene.witness.head;
            match verdict(scenes, other, sight) {
                Verdict::Agrees => good += 1,
                Verdict::Before => bad += 1,
                Verdict::Behind | Verdict::Past => bad += i32::from(partner),
                Verdict::Nothing => {}
            }
        }
        let (x, y) = cell(node);
        let sum = words.entry((piece, x, y)).or_default();
        *sum = (sum.0 + good, sum.1 + bad);
    }
    let around = |piece: u32, x: usize, y: usize| {
        let mut sum = (0, 0);
        for y in y.saturating_sub(REACH)..=y + REACH {
            for x in x.saturating_sub(REACH)..=x + REACH {
                let word = words.get(&(piece, x, y)).copied().unwrap_or_default();
                sum = (sum.0 + word.0, sum.1 + word.1);
            }
        }
        sum
    };
    let refused = |(node, &piece): (usize, &u32)| {
        let (x, y) = cell(node);
        let (good, bad) = around(piece, x, y);
        bad >= MIN_AGAINST && bad > AGAINST_PER_FOR * good
    };
    scene.pieces.of.iter().enumerate().map(refused).collect()
}
