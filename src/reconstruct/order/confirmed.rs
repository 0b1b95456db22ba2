//! Stretches without an order that the other cameras see at one order alone.
//!
//! A foot behind the other one continues nothing that is known, and the head's other camera does not see it: for that one it lies
//! hidden, at whichever order. [`super::elsewhere`] takes that for half a contradiction, because it puts surfaces where growth comes
//! from. At last, when all that can be known is known, it is none: a large stretch whose places the other heads see at one order, and at
//! no other, is there. Small ones are seen at wrong orders by chance.

use super::grow::{Label, View};
use super::jury::Known;
use super::looks::Looks;
use super::settle::Scene;
use super::stretch::{self, Member};
use super::words::Judges;
use crate::reconstruct::simd;

/// Places of a stretch that are tried, at most and at least, and the pixels of a node that counts as a place.
const SAMPLES: usize = 48;
const MIN_PLACES: usize = 12;
const MIN_SAMPLE_PX: u32 = 24;

/// So many places say whether an order is worth the rest.
const FIRST_SAMPLES: usize = 6;

/// What a word of the head's other camera counts, one of another head 1: at wrong orders that camera agrees the least often.
const PARTNER: i32 = 2;

/// Words for the best order, for so many places, and relative to those for any other order.
const MIN_WORDS: i32 = 3;
const PER_PLACES: i32 = 5;
const LEAD: i32 = 3;

/// Places are contradicted at the best order once in so many, at most.
const CONTRADICTED: i32 = 10;

/// Gives such stretches of a view their order, where a place is confirmed and not contradicted.
pub fn place(number: usize, view: &mut View<'_>, scenes: &[Scene<'_>], known: &Known, labels: &mut [Label]) {
    let scene = &scenes[number];
    for stretch in stretch::open(view.graph, labels).iter().filter(|stretch| stretch.len() >= MIN_PLACES) {
        let places = stretch::places(scene, stretch, MIN_SAMPLE_PX, SAMPLES);
        let Some(order) = only_order(number, scenes, &view.sights.judges, known, &places) else { continue };
        for &(node, own) in stretch {
            let words = view.sights.words(scenes, node as usize, order + own, known);
            if words.good() > 0 && words.against == 0 {
                labels[node as usize] = Label { turns: order + own, contradicted: false };
            }
        }
    }
}

/// The order at which the other cameras see these places, if there is one alone.
fn only_order(
    number: usize,
    scenes: &[Scene<'_>],
    judges: &Judges,
    known: &Known,
    places: &[Member],
) -> Option<i32> {
    if places.len() < MIN_PLACES {
        return None;
    }
    let scene = &scenes[number];
    let lines = stretch::lines(scene, places);
    let mut looks = Looks::default();
    let trials = stretch::orders(scene, places)?.map(|order| {
        let mut trial = Trial { order, good: 0, against: 0 };
        let (first, rest) = lines.split_at(FIRST_SAMPLES);
        for places in [first, rest] {
            looks.clear();
            looks.add(scenes, number, places, order..=order);
            simd::dispatch(
                #[inline(always)]
                || {
                    for place in 0..places.len() {
                        let words = judges.of(&looks, place, known);
                        trial.good += PARTNER * i32::from(words.partner) + i32::from(words.heads);
                        trial.against += i32::from(words.against > 0);
                    }
                },
            );
            if trial.good == 0 {
                break;
            }
        }
        trial
    });
    clear(trials, places.len() as i32)
}

/// What the other cameras say of a stretch at an order.
#[derive(Debug, Clone, Copy, Default)]
struct Trial {
    order: i32,
    /// Words for it.
    good: i32,
    /// Places that are contradicted.
    against: i32,
}

/// The order that stands out of these, if one does.
fn clear(trials: impl Iterator<Item = Trial>, places: i32) -> Option<i32> {
    let (mut best, mut second) = (Trial::default(), 0);
    for trial in trials {
        if trial.good > best.good {
            (second, best) = (best.good, trial);
        } else {
            second = second.max(trial.good);
        }
    }
    let seen = best.good * PER_PLACES >= MIN_WORDS * places && best.good >= LEAD * second;
    (seen && best.against * CONTRADICTED <= places).then_some(best.order)
}

#[cfg(test)]
mod tests {
    use super::{Trial, clear};

    /// The order that stands out of these words for orders 5, 6, 7, of 20 places; `against` of them are contradicted at order 6.
    fn of_three(good: [i32; 3], against: i32) -> Option<i32> {
        let trials = good.into_iter().zip(5..).map(|(good, order)| {
            let against = if order == 6 { against } else { 0 };
            Trial { order, good, against }
        });
        clear(trials, 20)
    }

    #[test]
    fn one_order_that_is_seen_everywhere_stands_out() {
        assert_eq!(of_three([6, 20, 0], 0), Some(6));
        assert_eq!(of_three([0, 20, 6], 2), Some(6));
    }

    #[test]
    fn what_is_seen_at_two_orders_or_hardly_at_all_stays_open() {
        assert_eq!(of_three([7, 20, 0], 0), None);
        assert_eq!(of_three([0, 20, 7], 0), None);
        assert_eq!(of_three([20, 20, 20], 0), None);
        assert_eq!(of_three([0, 12, 0], 0), Some(6));
        assert_eq!(of_three([0, 11, 0], 0), None);
        assert_eq!(of_three([0; 3], 0), None);
        assert_eq!(clear(std::iter::empty(), 20), None);
    }

    #[test]
    fn what_is_contradicted_stays_open() {
        assert_eq!(of_three([0, 60, 0], 3), None);
    }
}
