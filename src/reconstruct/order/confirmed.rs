//! Stretches without an order that the other cameras see at one order alone.
//!
//! A foot behind the other one continues nothing that is known, and the head's other camera does not see it: for that one it lies
//! hidden, at whichever order. [`super::elsewhere`] takes that for half a contradiction, because it puts surfaces where growth comes
//! from. At last, when all that can be known is known, it is none: a large stretch whose places the other heads see at one order, and at
//! no other, is there. Small ones are seen at wrong orders by chance.

use super::grow::{Label, View};
use super::settle::Scene;
use super::stretch::{self, Member};
use super::words;

/// Places of a stretch that are tried, at most and at least, and the pixels of a node that counts as a place.
const SAMPLES: usize = 24;
const MIN_PLACES: usize = 12;
const MIN_SAMPLE_PX: u32 = 24;

/// So many places say whether an order is worth the rest.
const FIRST_SAMPLES: usize = 3;

/// Words for the best order, relative to the places, and to those for any other order.
const MIN_WORDS: i32 = 1;
const LEAD: i32 = 3;

/// Places are contradicted at the best order once in so many, at most.
const CONTRADICTED: i32 = 10;

/// Gives such stretches of a view their order, where a place is confirmed and not contradicted.
pub fn place(
    number: usize,
    view: &mut View<'_>,
    scenes: &[Scene<'_>],
    known: &[Vec<i32>],
    labels: &mut [Label],
) {
    let scene = &scenes[number];
    for stretch in stretch::open(view.graph, labels) {
        let places = stretch::places(scene, &stretch, MIN_SAMPLE_PX, SAMPLES);
        let Some(order) = only_order(number, scenes, known, &places) else { continue };
        for (node, own) in stretch {
            let words = view.sights.words(scenes, node as usize, order + own, known);
            if words.good() > 0 && words.against == 0 {
                labels[node as usize] = Label { turns: order + own, contradicted: false };
            }
        }
    }
}

/// The order at which the other cameras see these places, if there is one alone.
fn only_order(number: usize, scenes: &[Scene<'_>], known: &[Vec<i32>], places: &[Member]) -> Option<i32> {
    if places.len() < MIN_PLACES {
        return None;
    }
    let scene = &scenes[number];
    let (mut best, mut second) = ((0, 0, 0), 0);
    let mut sights = Vec::new();
    let lines = stretch::lines(scene, places);
    for order in stretch::orders(scene, places)? {
        let (mut good, mut against) = (0, 0);
        for (i, &(line, fringes)) in lines.iter().enumerate() {
            let place = (line, fringes + order as f32);
            let words = words::along(scenes, number, known, place, &mut sights);
            good += i32::from(words.good());
            against += i32::from(words.against > 0);
            if i + 1 == FIRST_SAMPLES && good == 0 {
                break;
            }
        }
        if good > best.0 {
            (second, best) = (best.0, (good, against, order));
        } else {
            second = second.max(good);
        }
    }
    let ((good, against, order), n) = (best, places.len() as i32);
    (good >= MIN_WORDS * n && good >= LEAD * second && against * CONTRADICTED <= n).then_some(order)
}
