//! Where other heads see what has no order, or an order that none of them confirms.
//!
//! A limb before a trunk that grew from the trunk lies at the trunk's distance, hidden from all others: nothing contradicts
//! it there. At its own distance the other heads see it. So each stretch of surface that no other head confirms is
//! tried at every order that the volume allows; where clearly one is confirmed, it takes that.

use super::cells::CELL_PX;
use super::grow::{NONE, View, known, sums};
use super::settle::Scene;
use super::volume;
use super::words::Words;
use rayon::prelude::*;
use std::f32::consts::TAU;

/// Stretches are sought within squares of so many cells.
const SQUARE: usize = 12;

/// Fewest nodes of a stretch.
const MIN_NODES: usize = 4;

/// Nodes of a stretch that are tried, and how many of these say whether an order is worth the rest.
const SAMPLES: usize = 16;
const FIRST_SAMPLES: usize = 3;

/// Nodes smaller than this are not tried, px.
const MIN_SAMPLE_PX: u32 = 40;

/// Nodes that must be confirmed, and share of those that are tried.
const MIN_CONFIRMED: u32 = 6;
const MIN_SHARE: f32 = 0.7;

/// So many times more must be confirmed than contradicted.
const LEAD: u32 = 4;

/// Gives stretches that no other head confirms the order at which other heads see them.
pub fn seek(scenes: &[Scene<'_>], views: &mut [View]) {
    let known = known(views);
    views.par_iter_mut().zip(scenes).filter(|(view, _)| view.partnered).for_each(|(view, scene)| {
        // Of what the others say, only what other heads confirm.
        let heads: Vec<Words> = view
            .words
            .iter()
            .map(|x| Words { heads: (x.heads - x.against - x.hidden).max(0), ..Words::default() })
            .collect();
        let sum = sums(view, &heads);
        let lonely: Vec<bool> =
            view.turns.iter().zip(&sum).map(|(x, sum)| *x == NONE || sum.heads == 0).collect();
        let mut seen = vec![false; lonely.len()];
        for first in 0..lonely.len() {
            if lonely[first] && !seen[first] {
                let stretch = stretch(view, scene, first, &lonely, &mut seen);
                if let Some(order) = confirmed(scenes, scene, view, &stretch, &known) {
                    take(scenes, view, &stretch, order, &known);
                }
            }
        }
    });
}

/// The lonely nodes of a square that continue one another from `first` on, with the turns that each needs beside those of
/// `first`.
fn stretch(
    view: &View,
    scene: &Scene<'_>,
    first: usize,
    lonely: &[bool],
    seen: &mut [bool],
) -> Vec<(u32, i32)> {
    let square = |node: u32| {
        let pixel = scene.witness.cells.nodes[node as usize].pixel as usize;
        let width = scene.witness.phase.width();
        (pixel % width / (CELL_PX * SQUARE), pixel / width / (CELL_PX * SQUARE))
    };
    seen[first] = true;
    let mut found = vec![(first as u32, 0)];
    let mut at = 0;
    while let Some(&(node, turns)) = found.get(at) {
        at += 1;
        for edge in view.graph.of(node as usize) {
            let other = edge.other as usize;
            let continues = edge.good >= 4 && edge.good >= 3 * edge.bad;
            if continues && lonely[other] && !seen[other] && square(edge.other) == square(first as u32) {
                seen[other] = true;
                found.push((edge.other, turns + edge.turns));
            }
        }
    }
    found.sort_unstable();
    found
}

/// The order of a stretch that other heads clearly confirm.
fn confirmed(
    scenes: &[Scene<'_>],
    scene: &Scene<'_>,
    view: &mut View,
    stretch: &[(u32, i32)],
    known: &[Vec<i32>],
) -> Option<i32> {
    if stretch.len() < MIN_NODES {
        return None;
    }
    let size = |node: u32| scene.witness.cells.nodes[node as usize].size;
    let large: Vec<(u32, i32)> = stretch.iter().copied().filter(|x| size(x.0) >= MIN_SAMPLE_PX).collect();
    let step = large.len().div_ceil(SAMPLES).max(1);
    let samples: Vec<(u32, i32)> = large.into_iter().step_by(step).collect();
    if samples.len() < MIN_NODES {
        return None;
    }
    let ends = samples.iter().step_by(samples.len().div_ceil(2)).filter_map(|&(node, turns)| {
        let (u, v, phase) = scene.place(node);
        let phase = phase + TAU * (turns - scene.pieces.turns[node as usize]) as f32;
        volume::orders_inside(scene.triangulator.pair(), u, v, phase)
    });
    let orders = ends.reduce(|a, b| *a.start().min(b.start())..=*a.end().max(b.end()))?;
    let (mut best, mut second) = ((i32::MIN, 0, 0, 0), 0);
    for order in orders {
        let (mut agree, mut against) = (0u32, 0u32);
        for (i, &(node, turns)) in samples.iter().enumerate() {
            let words = view.sights.passing(scenes, node as usize, order + turns, known);
            let bad = words.against + words.hidden;
            agree += u32::from(words.heads > bad);
            against += u32::from(bad > words.good());
            if i + 1 == FIRST_SAMPLES && agree == 0 {
                break;
            }
        }
        let score = agree as i32 - against as i32;
        if score > best.0 {
            second = best.0.max(0);
            best = (score, order, agree, against);
        } else {
            second = second.max(score);
        }
    }
    let (score, order, agree, against) = best;
    let enough = agree >= MIN_CONFIRMED && agree as f32 >= MIN_SHARE * samples.len() as f32;
    (enough && score >= 2 * second.max(1) && against * LEAD <= agree).then_some(order)
}

/// Gives a stretch its order where a place is confirmed; the rest of it is open again.
fn take(scenes: &[Scene<'_>], view: &mut View, stretch: &[(u32, i32)], order: i32, known: &[Vec<i32>]) {
    for &(node, turns) in stretch {
        let (node, turns) = (node as usize, order + turns);
        if view.turns[node] == turns {
            continue;
        }
        let words = view.sights.words(scenes, node, turns, known);
        let good = words.heads > 0 && words.against + words.hidden == 0;
        (view.turns[node], view.words[node]) = if good { (turns, words) } else { (NONE, Words::default()) };
    }
}
