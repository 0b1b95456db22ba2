//! Where other heads see what has no order, or an order that none of them confirms.
//!
//! A limb before a trunk that grew from the trunk lies at the trunk's distance, hidden from all others: nothing contradicts
//! it there. At its own distance the other heads see it. So each stretch of surface that no other head confirms is
//! tried at every order that the volume allows; where clearly one is confirmed, it takes that. From round to round most
//! stretches stay what they are, and so does most of what is known where they would be seen: such a stretch is not tried
//! again. Where something else is known there now, what the cameras have is judged again, not looked at again.

use super::cells::CELL_PX;
use super::grow::{NONE, View, known, sums};
use super::looks::{Looks, PLACES};
use super::settle::Scene;
use super::stretch::{self, Member};
use super::words::{self, Words};
use rayon::prelude::*;
use std::collections::BTreeMap;

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

/// Nodes that stand for each other where it is asked whether what a camera knows has changed.
const BLOCK_NODES: usize = 8;

/// Blocks of nodes of all views.
#[derive(Debug, Clone, Default)]
struct Blocks(Vec<u64>);

impl Blocks {
    fn mark(&mut self, block: usize) {
        if self.0.len() <= block / 64 {
            self.0.resize(block / 64 + 1, 0);
        }
        self.0[block / 64] |= 1 << (block % 64);
    }

    fn meet(&self, other: &Self) -> bool {
        self.0.iter().zip(&other.0).any(|(a, b)| a & b != 0)
    }
}

/// What the other cameras say of a stretch at an order.
#[derive(Debug, Clone, Copy, Default)]
struct Trial {
    /// Places that other heads confirm.
    agree: u32,
    /// Places that are contradicted.
    against: u32,
}

impl Trial {
    fn add(&mut self, words: Words) {
        let bad = words.against + words.hidden;
        self.agree += u32::from(words.heads > bad);
        self.against += u32::from(bad > words.good());
    }

    fn score(&self) -> i32 {
        self.agree as i32 - self.against as i32
    }
}

/// What was tried in vain.
#[derive(Debug)]
struct Failure {
    stretch: Vec<Member>,
    /// What the cameras have at the first samples, order by order.
    looks: Looks,
    /// The blocks in which it would have been seen.
    seen: Blocks,
    /// Whether something else is known there now.
    outdated: bool,
}

/// What is kept from round to round.
#[derive(Debug)]
pub struct Seeker {
    /// Where the blocks of each view begin.
    first_block: Vec<usize>,
    /// What was known in the last round.
    known: Vec<Vec<i32>>,
    /// By view and first node.
    failures: Vec<BTreeMap<usize, Failure>>,
}

impl Seeker {
    /// Nothing has been tried yet.
    pub fn new(scenes: &[Scene<'_>]) -> Self {
        let mut blocks = 0;
        let first_block = scenes.iter().map(|scene| {
            let first = blocks;
            blocks += scene.pieces.of.len().div_ceil(BLOCK_NODES);
            first
        });
        let first_block = first_block.collect();
        let failures = scenes.iter().map(|_| BTreeMap::new()).collect();
        Self { first_block, known: Vec::new(), failures }
    }

    /// Gives stretches that no other head confirms the order at which other heads see them.
    pub fn seek(&mut self, scenes: &[Scene<'_>], views: &mut [View<'_>]) {
        let known = known(views);
        let mut changed = Blocks::default();
        for (first, (is, was)) in self.first_block.iter().zip(known.iter().zip(&self.known)) {
            for (node, _) in is.iter().zip(was).enumerate().filter(|(_, (is, was))| is != was) {
                changed.mark(first + node / BLOCK_NODES);
            }
        }
        let search = Search { scenes, known: &known, first_block: &self.first_block };
        let views = views.par_iter_mut().zip(&mut self.failures).enumerate();
        views.for_each(|(number, (view, failures))| {
            failures.values_mut().for_each(|failure| failure.outdated |= failure.seen.meet(&changed));
            search.view(number, view, failures);
        });
        self.known = known;
    }
}

/// One round.
struct Search<'a> {
    scenes: &'a [Scene<'a>],
    known: &'a [Vec<i32>],
    first_block: &'a [usize],
}

impl Search<'_> {
    fn view(&self, number: usize, view: &mut View<'_>, failures: &mut BTreeMap<usize, Failure>) {
        let scene = &self.scenes[number];
        // Of what the others say, only what other heads confirm.
        let heads: Vec<Words> = view
            .words
            .iter()
            .map(|x| Words { heads: (x.heads - x.against - x.hidden).max(0), ..Words::default() })
            .collect();
        let sum = sums(view, &heads);
        let lonely: Vec<bool> =
            view.turns.iter().zip(&sum).map(|(x, sum)| *x == NONE || sum.heads == 0).collect();
        let together = |first: usize, other: usize| square(scene, first) == square(scene, other);
        for stretch in stretch::all(view.graph, |node| lonely[node], together) {
            let first = stretch[0].0 as usize;
            if stretch.len() < MIN_NODES {
                continue;
            }
            let mut looks = Looks::default();
            if let Some(failure) = failures.get_mut(&first).filter(|x| x.stretch == stretch) {
                if !failure.outdated {
                    continue;
                }
                looks = std::mem::take(&mut failure.looks);
            }
            let mut seen = Blocks::default();
            match self.confirmed(number, &stretch, &mut looks, &mut seen) {
                Some(order) => {
                    failures.remove(&first);
                    take(self.scenes, view, &stretch, order, self.known);
                }
                None => drop(failures.insert(first, Failure { stretch, looks, seen, outdated: false })),
            }
        }
    }

    /// The order of a stretch that other heads clearly confirm. `first_looks`: what the cameras have at its first samples, or nothing
    /// yet. Where they would see it is marked.
    fn confirmed(
        &self,
        number: usize,
        stretch: &[Member],
        first_looks: &mut Looks,
        seen: &mut Blocks,
    ) -> Option<i32> {
        let scene = &self.scenes[number];
        let places = stretch::places(scene, stretch, MIN_SAMPLE_PX, SAMPLES);
        if places.len() < MIN_NODES {
            return None;
        }
        let orders = stretch::orders(scene, &places)?;
        let samples = stretch::lines(scene, &places);
        let (first, rest) = samples.split_at(samples.len().min(FIRST_SAMPLES));
        if first_looks.len() == 0 {
            first_looks.add(self.scenes, number, first, orders.clone());
        }
        let mut trials: Vec<(i32, Trial)> = orders.map(|order| (order, Trial::default())).collect();
        for (i, (_, trial)) in trials.iter_mut().enumerate() {
            for place in i * first.len()..(i + 1) * first.len() {
                trial.add(self.words(number, first_looks, place, seen));
            }
        }
        let mut looks = Looks::default();
        let (mut best, mut second) = ((i32::MIN, Trial::default()), 0);
        for (order, mut trial) in trials {
            let mut left = rest.len() as i32;
            for places in rest.chunks(PLACES) {
                // Either nothing speaks for it, or what is left cannot make it the best or the second.
                if trial.agree == 0 || trial.score() + left <= second {
                    break;
                }
                left -= places.len() as i32;
                looks.clear();
                looks.add(self.scenes, number, places, order..=order);
                (0..places.len()).for_each(|place| trial.add(self.words(number, &looks, place, seen)));
            }
            if best.1.score() < trial.score() {
                second = best.1.score();
                best = (order, trial);
            } else {
                second = second.max(trial.score());
            }
        }
        let (order, trial) = best;
        let enough = trial.agree >= MIN_CONFIRMED && trial.agree as f32 >= MIN_SHARE * samples.len() as f32;
        (enough && trial.score() >= 2 * second.max(1) && trial.against * LEAD <= trial.agree).then_some(order)
    }

    /// Words for a place that was looked at. Where it would be seen is marked.
    fn words(&self, number: usize, looks: &Looks, place: usize, seen: &mut Blocks) -> Words {
        for (first, sight) in self.first_block.iter().zip(looks.at(place).into_iter().flatten()) {
            if sight.is_node() {
                seen.mark(first + sight.node as usize / BLOCK_NODES);
            }
        }
        words::of(self.scenes, number, self.known, looks, place)
    }
}

/// The square in which a node lies.
fn square(scene: &Scene<'_>, node: usize) -> (usize, usize) {
    let cells = &scene.witness.cells;
    let pixel = cells.nodes[node].pixel as usize;
    (pixel % cells.width / (CELL_PX * SQUARE), pixel / cells.width / (CELL_PX * SQUARE))
}

/// Gives a stretch its order where a place is confirmed; the rest of it is open again.
fn take(scenes: &[Scene<'_>], view: &mut View<'_>, stretch: &[Member], order: i32, known: &[Vec<i32>]) {
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
