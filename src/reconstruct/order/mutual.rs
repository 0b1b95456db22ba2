//! Stretches without an order that both cameras of a head have, at the same place.
//!
//! What only one head sees, and what no marker crosses there, has nobody to confirm it as long as it is open in both of that head's
//! cameras: each waits for the other, and an order that one of them got by chance contradicts the right one of the other, for good. But
//! the two cameras see one projector. At the right order each place of the stretch lies where the other camera has the same phase up
//! to whole turns, and these turns are the same for all places of one stretch of that camera. At a wrong order the stretch is shifted
//! against what that camera sees, and its phases differ by anything, wherever the surface is not a plane that faces the projector.

use super::grow::{Label, NONE, View};
use super::jury::Known;
use super::lookout::LANES;
use super::looks::Looks;
use super::settle::{Scene, all_nodes};
use super::stretch::{self, Member};
use super::witness::SAME_RAD;
use super::words::Judges;
use crate::reconstruct::simd;
use std::collections::BTreeMap;
use std::f32::consts::TAU;

/// Places of a stretch that are tried, at most and at least, and the pixels of a node that counts as a place.
const SAMPLES: usize = 48;
const MIN_PLACES: usize = 6;
const MIN_SAMPLE_PX: u32 = 12;

/// So many places say whether an order is worth the rest.
const FIRST_SAMPLES: usize = 6;
const _: () = assert!(FIRST_SAMPLES <= MIN_PLACES);

/// Places that must agree: so many, one in so many of those that are tried, one in so many of those at which the other camera has a
/// stretch that is open, and so many times as many as at any other order.
const MIN_SAME: u32 = 4;
const PER_PLACES: u32 = 5;
const PER_SEEN: u32 = 2;
const LEAD: u32 = 2;

/// Of ten places so many may be contradicted by what is known: by what is wrong itself, beside what is right.
const CONTRADICTED: u32 = 3;

/// One view of a head, as the other one asks it: which open stretch each node belongs to, and the turns that it needs there.
struct Open {
    of: Vec<Option<(u32, i32)>>,
    stretches: Vec<Vec<Member>>,
}

impl Open {
    fn new(view: &View<'_>, labels: &[Label]) -> Self {
        let all = stretch::open(view.graph, labels);
        let large = all.iter().filter(|stretch| stretch.len() >= MIN_PLACES);
        let stretches: Vec<Vec<Member>> = large.map(<[Member]>::to_vec).collect();
        let mut of = vec![None; labels.len()];
        for (number, stretch) in stretches.iter().enumerate() {
            stretch.iter().for_each(|&(node, turns)| of[node as usize] = Some((number as u32, turns)));
        }
        Self { of, stretches }
    }
}

/// What is found of two stretches: the order of the one, and the other with its order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Match {
    order: i32,
    other: (u32, i32),
}

/// What the head's other camera and all others say of a stretch at an order.
#[derive(Debug, Default)]
struct Trial {
    order: i32,
    /// Places at which the other camera has an open stretch at the same phase, by this stretch and its order.
    same: BTreeMap<(u32, i32), u32>,
    /// Places at which it has an open stretch.
    seen: u32,
    /// Places that are contradicted by what is known.
    against: u32,
}

impl Trial {
    /// Adds a place at which the other camera has this stretch, with these turns within it, and a phase so far ahead of the one that is
    /// cast there, rad.
    fn add(&mut self, (stretch, own): (u32, i32), ahead: f32) {
        self.seen += 1;
        let turns = -(ahead / TAU).round();
        if (ahead + TAU * turns).abs() < SAME_RAD {
            *self.same.entry((stretch, turns as i32 - own)).or_default() += 1;
        }
    }

    /// The stretch with which most places agree, its order, and how many do.
    fn best(&self) -> Option<((u32, i32), u32)> {
        self.same.iter().map(|(&other, &count)| (other, count)).max_by_key(|x| (x.1, x.0))
    }
}

/// Gives such stretches their orders in both views, where a place is confirmed then and not contradicted. `known`: the orders of all
/// views, kept up to date.
pub fn place(scenes: &[Scene<'_>], views: &mut [View<'_>], known: &mut Known, labels: &mut [Vec<Label>]) {
    for view in 0..scenes.len() {
        let head = scenes[view].witness.head;
        for partner in (view + 1..scenes.len()).filter(|&x| scenes[x].witness.head == head) {
            let own = Open::new(&views[view], &labels[view]);
            let mut other = Open::new(&views[partner], &labels[partner]);
            for stretch in &own.stretches {
                let found = find(scenes, &views[view].sights.judges, [view, partner], known, stretch, &other);
                let Some(Match { order, other: (number, turns) }) = found else { continue };
                let theirs = &other.stretches[number as usize];
                take(scenes, views, known, labels, [(view, stretch, order), (partner, theirs, turns)]);
                theirs.iter().for_each(|&(node, _)| other.of[node as usize] = None);
            }
        }
    }
}

/// Which of the other camera's stretches a stretch is, and at which orders, if that is clear.
fn find(
    scenes: &[Scene<'_>],
    judges: &Judges,
    [view, partner]: [usize; 2],
    known: &Known,
    stretch: &[Member],
    other: &Open,
) -> Option<Match> {
    let scene = &scenes[view];
    let places = stretch::places(scene, stretch, MIN_SAMPLE_PX, SAMPLES);
    if places.len() < MIN_PLACES || other.stretches.is_empty() {
        return None;
    }
    let lines = stretch::lines(scene, &places);
    let (block, lane) = (partner / LANES, partner % LANES);
    let first = all_nodes(&scenes[..partner]);
    let mut looks = Looks::default();
    let trials = stretch::orders(scene, &places)?.map(|order| {
        let mut trial = Trial { order, ..Trial::default() };
        let (some, rest) = lines.split_at(FIRST_SAMPLES);
        for lines in [some, rest] {
            looks.clear();
            looks.add(scenes, view, lines, order..=order);
            for seen in (0..lines.len()).filter_map(|place| looks.at(place)) {
                let words = simd::dispatch(
                    #[inline(always)]
                    || judges.words(seen, known),
                );
                trial.against += u32::from(words.against > 0);
                let node = seen[block].node[lane].checked_sub(first);
                if let Some(&Some(member)) = node.and_then(|node| other.of.get(node as usize)) {
                    trial.add(member, seen[block].ahead[lane]);
                }
            }
            if trial.seen == 0 {
                break;
            }
        }
        trial
    });
    clear(trials, places.len() as u32)
}

/// The order that stands out of these, if one does.
fn clear(trials: impl Iterator<Item = Trial>, places: u32) -> Option<Match> {
    let (mut best, mut most, mut second) = (None, 0, 0);
    for trial in trials {
        let Some((other, same)) = trial.best() else { continue };
        if same > most {
            (second, most, best) = (most, same, Some((trial, other)));
        } else {
            second = second.max(same);
        }
    }
    let (trial, other) = best?;
    let enough = most >= MIN_SAME && most * PER_PLACES >= places && most * PER_SEEN >= trial.seen;
    let alone = most >= LEAD * second && trial.against * 10 <= CONTRADICTED * places;
    (enough && alone).then_some(Match { order: trial.order, other })
}

/// Gives two stretches their orders, and keeps those nodes of both that are confirmed then.
fn take(
    scenes: &[Scene<'_>],
    views: &mut [View<'_>],
    known: &mut Known,
    labels: &mut [Vec<Label>],
    both: [(usize, &[Member], i32); 2],
) {
    for (view, stretch, order) in both {
        let first = all_nodes(&scenes[..view]) as usize;
        stretch.iter().for_each(|&(node, own)| known.set(first + node as usize, order + own));
    }
    for (view, stretch, order) in both {
        let first = all_nodes(&scenes[..view]) as usize;
        for &(node, own) in stretch {
            let words = views[view].sights.words(scenes, node as usize, order + own, known);
            if words.good() > 0 && words.against == 0 {
                labels[view][node as usize] = Label { turns: order + own, contradicted: false };
            }
        }
        let dropped = stretch.iter().filter(|x| labels[view][x.0 as usize].turns == NONE);
        dropped.for_each(|&(node, _)| known.set(first + node as usize, NONE));
    }
}

#[cfg(test)]
mod tests {
    use super::{Match, SAME_RAD, Trial, clear};
    use std::f32::consts::TAU;

    /// Which match there is when stretch 4 of the other camera is seen at `same` of `seen` of 20 places at its order 7, at orders 1, 2,
    /// 3; at order 2 so many places are contradicted.
    fn of_three(same: [u32; 3], seen: u32, against: u32) -> Option<Match> {
        let trials = same.into_iter().zip(1..).map(|(same, order)| {
            let mut trial =
                Trial { order, against: if order == 2 { against } else { 0 }, ..Trial::default() };
            // A place whose node has 5 turns more than the first of its stretch, and just the phase; and one of another phase.
            (0..same).for_each(|_| trial.add((4, 5), -12.0 * TAU + 0.9 * SAME_RAD));
            (same..seen).for_each(|_| trial.add((4, 5), -12.0 * TAU + 1.1 * SAME_RAD));
            trial
        });
        clear(trials, 20)
    }

    #[test]
    fn a_stretch_that_both_cameras_have_at_one_order_alone_is_found() {
        let found = Some(Match { order: 2, other: (4, 7) });
        assert_eq!(of_three([0, 16, 0], 20, 0), found);
        assert_eq!(of_three([8, 16, 8], 20, 6), found);
        assert_eq!(of_three([0, 4, 0], 8, 0), found);
    }

    #[test]
    fn what_is_the_same_at_two_orders_or_at_few_places_is_not() {
        assert_eq!(of_three([9, 16, 0], 20, 0), None);
        assert_eq!(of_three([0, 16, 9], 20, 0), None);
        assert_eq!(of_three([0, 9, 0], 20, 0), None);
        assert_eq!(of_three([0, 3, 0], 3, 0), None);
        assert_eq!(of_three([0; 3], 20, 0), None);
        assert_eq!(clear(std::iter::empty(), 20), None);
    }

    #[test]
    fn what_is_contradicted_is_not() {
        assert_eq!(of_three([0, 16, 0], 20, 7), None);
    }

    /// Turns that differ from place to place are no one stretch's order.
    #[test]
    fn the_turns_must_be_the_same_everywhere() {
        let mut trial = Trial::default();
        (0..12).for_each(|turns| trial.add((4, 0), -TAU * turns as f32));
        assert_eq!(trial.best().map(|x| x.1), Some(1));
        assert_eq!(clear(std::iter::once(trial), 12), None);
    }
}
