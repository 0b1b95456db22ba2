//! Where other heads see what has no order, or an order that none of them confirms.
//!
//! A limb before a trunk that grew from the trunk lies at the trunk's distance, hidden from all others: nothing contradicts
//! it there. At its own distance the other heads see it. So each stretch of surface that no other head confirms is
//! tried at every order that the volume allows; where clearly one is confirmed, it takes that. From round to round most
//! stretches stay what they are, and so does most of what is known where they would be seen: such a stretch is not tried
//! again. Where something else is known there now, what the cameras have is judged again, not looked at again.

use super::grow::View;
use super::jury::Known;
use super::looks::{Looks, PLACES};
use super::settle::{Scene, all_nodes};
use super::stretch::{self, Member};
use super::words::{Changed, Judges, Words};
use crate::reconstruct::simd;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::ops::Range;

/// Stretches are sought within squares of so many cells.
const SQUARE: usize = 12;

/// Nodes of a stretch that are tried, and how many of these say whether an order is worth the rest.
const SAMPLES: usize = 16;
const FIRST_SAMPLES: usize = 1;
const _: () = assert!(FIRST_SAMPLES <= MIN_CONFIRMED as usize);

/// Nodes smaller than this are not tried, px.
const MIN_SAMPLE_PX: u32 = 40;

/// Nodes that must be confirmed, and share of those that are tried.
const MIN_CONFIRMED: u32 = 6;
const MIN_SHARE: f32 = 0.7;

/// So many times more must be confirmed than contradicted.
const LEAD: u32 = 4;

/// What the other cameras say of a stretch at an order.
#[derive(Debug, Clone, Copy, Default)]
struct Trial {
    /// Places that other heads confirm.
    agree: u32,
    /// Places that are contradicted.
    against: u32,
}

impl Trial {
    #[inline(always)]
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
    /// What the cameras have where it would be seen.
    looks: Seen,
    /// Whether something else is known there now.
    outdated: bool,
}

/// What the cameras have at places of a stretch.
#[derive(Debug, Default)]
struct Seen {
    /// At the first samples, order by order.
    first: Looks,
    /// At those of the others that were looked at last.
    rest: Looks,
}

/// What is kept of a view from round to round.
#[derive(Debug)]
struct Ground {
    /// The square in which each node lies.
    square: Vec<u32>,
    /// The nodes of one square after the other, and where those of each begin.
    nodes: Vec<u32>,
    starts: Vec<usize>,
    /// The squares whose stretches are to be tried, whatever has changed.
    again: Vec<bool>,
    /// Whether each node was one that no other head confirms.
    lonely: Vec<bool>,
    /// By first node.
    failures: BTreeMap<usize, Failure>,
}

impl Ground {
    /// Nothing has been tried yet.
    fn new(scene: &Scene<'_>) -> Self {
        let cells = &scene.witness.cells;
        let (columns, across) = (cells.columns as u32, cells.columns.div_ceil(SQUARE) as u32);
        let of = |cell: u32| cell / columns / SQUARE as u32 * across + cell % columns / SQUARE as u32;
        let square: Vec<u32> = cells.nodes.iter().map(|node| of(node.cell)).collect();
        let squares = square.iter().max().map_or(0, |&last| last as usize + 1);
        let mut starts = vec![0; squares + 1];
        square.iter().for_each(|&square| starts[square as usize + 1] += 1);
        (0..squares).for_each(|i| starts[i + 1] += starts[i]);
        let (mut nodes, mut ends) = (vec![0; square.len()], starts.clone());
        for (node, &square) in square.iter().enumerate() {
            let end = &mut ends[square as usize];
            nodes[*end] = node as u32;
            *end += 1;
        }
        let (again, lonely) = (vec![true; squares], vec![false; square.len()]);
        Self { square, nodes, starts, again, lonely, failures: BTreeMap::new() }
    }

    /// The squares in which something may come of it to try the stretches: in all others they are what they were, and have been tried in
    /// vain. `changed`: where something else is known than in the last round.
    fn squares(&mut self, view: &View<'_>, changed: &Changed) -> Vec<usize> {
        let squares = self.again.len();
        let mut squares = std::mem::replace(&mut self.again, vec![false; squares]);
        for (node, was) in self.lonely.iter_mut().enumerate() {
            // Of what the others say, only what other heads confirm.
            let is = !view.around.is_confirmed(node);
            if *was != is {
                (*was, squares[self.square[node] as usize]) = (is, true);
            }
        }
        for (&first, failure) in &mut self.failures {
            let Seen { first: looks, rest } = &failure.looks;
            failure.outdated |= simd::dispatch(
                #[inline(always)]
                || changed.is_any_seen(looks) || changed.is_any_seen(rest),
            );
            squares[self.square[first] as usize] |= failure.outdated;
        }
        (0..squares.len()).filter(|&i| squares[i]).collect()
    }
}

/// What is kept from round to round.
#[derive(Debug)]
pub struct Seeker {
    /// What was known in the last round, if there was one.
    known: Option<Known>,
    /// View by view.
    grounds: Vec<Ground>,
}

impl Seeker {
    /// Nothing has been tried yet.
    pub fn new(scenes: &[Scene<'_>]) -> Self {
        Self { known: None, grounds: scenes.iter().map(Ground::new).collect() }
    }

    /// Gives stretches that no other head confirms the order at which other heads see them.
    pub fn seek(&mut self, scenes: &[Scene<'_>], views: &mut [View<'_>], known: &Known) {
        let mut changed = Changed::new(all_nodes(scenes) as usize, scenes.len());
        if let Some(was) = &self.known {
            let mut first = 0;
            for (view, scene) in scenes.iter().enumerate() {
                let nodes = first..first + scene.graph.len();
                first = nodes.end;
                nodes
                    .filter(|&node| known.turns()[node] != was.turns()[node])
                    .for_each(|node| changed.add(view, node));
            }
        }
        let search = Search { scenes, known };
        let views = views.par_iter_mut().zip(&mut self.grounds).enumerate();
        views.for_each(|(number, (view, ground))| search.view(number, view, ground, &changed));
        self.known = Some(known.clone());
    }
}

/// One round.
struct Search<'a> {
    scenes: &'a [Scene<'a>],
    known: &'a Known,
}

impl Search<'_> {
    fn view(&self, number: usize, view: &mut View<'_>, ground: &mut Ground, changed: &Changed) {
        let squares = ground.squares(view, changed);
        let Ground { square, nodes, starts, again, lonely, failures } = ground;
        let nodes = squares.iter().flat_map(|&i| &nodes[starts[i]..starts[i + 1]]);
        let stretches = stretch::all(
            view.graph,
            nodes.map(|&node| node as usize),
            |node| lonely[node],
            |first, other| square[first] == square[other],
        );
        for stretch in stretches.iter().filter(|stretch| stretch.len() >= MIN_CONFIRMED as usize) {
            let first = stretch[0].0 as usize;
            let mut looks = Seen::default();
            if let Some(failure) = failures.get_mut(&first).filter(|x| x.stretch == stretch) {
                if !failure.outdated {
                    continue;
                }
                looks = std::mem::take(&mut failure.looks);
            }
            match self.confirmed(number, &view.sights.judges, stretch, &mut looks) {
                Some(order) => {
                    failures.remove(&first);
                    again[square[first] as usize] = true;
                    take(self.scenes, view, stretch, order, self.known);
                }
                None => {
                    let stretch = stretch.to_vec();
                    failures.insert(first, Failure { stretch, looks, outdated: false });
                }
            }
        }
    }

    /// The order of a stretch that other heads clearly confirm. `looks`: what the cameras have at its places, or nothing yet.
    fn confirmed(&self, number: usize, judges: &Judges, stretch: &[Member], looks: &mut Seen) -> Option<i32> {
        let scene = &self.scenes[number];
        let places = stretch::places(scene, stretch, MIN_SAMPLE_PX, SAMPLES);
        if places.len() < MIN_CONFIRMED as usize {
            return None;
        }
        let orders = stretch::orders(scene, &places)?;
        let samples = stretch::lines(scene, &places);
        let (first, rest) = samples.split_at(FIRST_SAMPLES);
        if looks.first.len() == 0 {
            looks.first.add(self.scenes, number, first, orders.clone());
        }
        let mut trials: Vec<(i32, Trial)> = orders.map(|order| (order, Trial::default())).collect();
        for (i, (_, trial)) in trials.iter_mut().enumerate() {
            self.hear(judges, &looks.first, i * first.len()..(i + 1) * first.len(), trial);
        }
        looks.rest.clear();
        let (mut best, mut second) = ((i32::MIN, Trial::default()), 0);
        for (order, mut trial) in trials {
            let mut left = rest.len() as i32;
            for places in rest.chunks(PLACES) {
                // Either nothing speaks for it, or what is left cannot make it the best or the second.
                if trial.agree == 0 || trial.score() + left <= second {
                    break;
                }
                left -= places.len() as i32;
                let from = looks.rest.len();
                looks.rest.add(self.scenes, number, places, order..=order);
                self.hear(judges, &looks.rest, from..looks.rest.len(), &mut trial);
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

    /// Adds the words for places that were looked at to a trial.
    fn hear(&self, judges: &Judges, looks: &Looks, places: Range<usize>, trial: &mut Trial) {
        simd::dispatch(
            #[inline(always)]
            || {
                for place in places {
                    trial.add(judges.of(looks, place, self.known));
                }
            },
        );
    }
}

/// Gives a stretch its order where a place is confirmed; the rest of it is open again.
fn take(scenes: &[Scene<'_>], view: &mut View<'_>, stretch: &[Member], order: i32, known: &Known) {
    for &(node, turns) in stretch {
        let (node, turns) = (node as usize, order + turns);
        if view.turns(node) == turns {
            continue;
        }
        let words = view.sights.words(scenes, node, turns, known);
        let good = words.heads > 0 && words.against + words.hidden == 0;
        if good {
            view.set(node, turns, words);
        } else {
            view.unset(node);
        }
    }
}
