// SPDX-License-Identifier: MIT OR Apache-2.0
//! The fringe orders of a camera alone, which no other camera can confirm: the best path of links from each patch to a
//! marker.
//!
//! Margins of all costs together dilute with the distance from the marker; the weakest link of the best path does not.
//! On a seam where two surfaces touch, single links look strong by chance: a link counts as far as a way around it,
//! through the patches beside it, confirms it.

use super::inference::Field;
use super::links::Link;
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// Labels and margins: how much stronger the best path to a marker is than any to another label.
pub fn infer(field: &mut Field<'_>) {
    let n = field.graph.label.len();
    let strength: Vec<f32> = field.graph.links.iter().map(|link| supported(field, link)).collect();
    // The best label of each patch, and the strength of the second.
    let mut best: Vec<Option<(i32, f32)>> = vec![None; n];
    let mut second: Vec<Option<f32>> = vec![None; n];
    // The strongest first, then the first patch. Bits of positive numbers are ordered as the numbers are.
    let entry = |strength: f32, patch: u32, label: i32| (strength.to_bits(), Reverse(patch), Reverse(label));
    let mut heap: BinaryHeap<_> =
        field.votes().map(|(patch, label, strength)| entry(strength, patch, label)).collect();
    while let Some((bits, Reverse(patch), Reverse(label))) = heap.pop() {
        let (reached, i) = (f32::from_bits(bits), patch as usize);
        match best[i] {
            None => best[i] = Some((label, reached)),
            Some((known, _)) if known != label && second[i].is_none() => second[i] = Some(reached),
            Some(_) => continue,
        }
        for &k in field.graph.links_of(i) {
            let Link { a, b, turns, .. } = field.graph.links[k as usize];
            let (other, label) = if a == patch { (b, label + turns) } else { (a, label - turns) };
            let strength = reached.min(strength[k as usize]);
            if strength > 0.0 && second[other as usize].is_none() {
                heap.push(entry(strength, other, label));
            }
        }
    }
    for i in 0..n {
        (field.graph.label[i], field.graph.margin[i]) = match best[i] {
            Some((label, strength)) => (label, strength - second[i].unwrap_or(0.0)),
            None => (0, 0.0),
        };
    }
}

/// The strength of a link as far as a way around it confirms it.
fn supported(field: &Field<'_>, link: &Link) -> f32 {
    let from = |patch: u32| {
        field.graph.links_of(patch as usize).iter().map(move |&k| {
            let Link { a, b, turns, weight } = field.graph.links[k as usize];
            if a == patch { (b, turns, weight) } else { (a, -turns, weight) }
        })
    };
    let mut around = 0f32;
    for (c, to_c, first) in from(link.a).filter(|x| x.0 != link.b) {
        for (d, to_d, last) in from(link.b).filter(|x| x.0 != link.a) {
            if c == d {
                around = if to_c == link.turns + to_d { around.max(first.min(last)) } else { around };
                continue;
            }
            // From `c` to `d` by way of `a` and `b`.
            let turns = link.turns + to_d - to_c;
            let between = from(c).find(|x| x.0 == d && x.1 == turns);
            around = around.max(between.map_or(0.0, |x| x.2.min(first).min(last)));
        }
    }
    link.weight.min(around)
}
