//! What the other cameras say for and against a node at an order.

use super::grow::NONE;
use super::jury::{Jury, Known, Weights};
use super::lookout::LANES;
use super::looks::{Looks, PLACES, Place};
use super::settle::Scene;
use super::witness::SightLanes;
use crate::reconstruct::simd;
use std::ops::AddAssign;

/// Words for and against a place. One camera has one word for a place; sums are those of several places.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Words {
    /// The head's other camera sees the same surface.
    pub partner: i16,
    /// Cameras of other heads see the same surface.
    pub heads: i16,
    /// Cameras that would see the place if it were there, and see something else.
    pub against: i16,
    /// The head's other camera sees something before it. Where limbs cross, that is so for what is right too.
    pub hidden: i16,
}

impl Words {
    /// A place that cannot be.
    pub const IMPOSSIBLE: Self = Self { partner: 0, heads: 0, against: 9, hidden: 0 };

    /// All four side by side. Of the nodes around one there are not so many that a sum would reach the next: a node has at most 32
    /// neighbours along borders of four pixel pairs.
    pub fn packed(&self) -> u64 {
        let part = |words: i16, place: u32| u64::from(words as u16) << (16 * place);
        part(self.partner, 0) | part(self.heads, 1) | part(self.against, 2) | part(self.hidden, 3)
    }

    /// The reverse.
    pub fn unpacked(all: u64) -> Self {
        let part = |place: u32| (all >> (16 * place)) as i16;
        Self { partner: part(0), heads: part(1), against: part(2), hidden: part(3) }
    }

    /// Words for the place.
    pub fn good(&self) -> i16 {
        self.partner + self.heads
    }
}

impl AddAssign for Words {
    fn add_assign(&mut self, other: Self) {
        self.partner = self.partner.saturating_add(other.partner);
        self.heads = self.heads.saturating_add(other.heads);
        self.against = self.against.saturating_add(other.against);
        self.hidden = self.hidden.saturating_add(other.hidden);
    }
}

/// Words of one place as the members of a jury give them: a byte each.
const PARTNER: u32 = 1;
const HEADS: u32 = 1 << 8;
const AGAINST: u32 = 1 << 16;
const HIDDEN: u32 = 1 << 24;

/// What cameras say of the nodes of one view.
#[derive(Debug)]
pub struct Judges(Jury);

impl Judges {
    /// All cameras, as a view asks them.
    pub fn new(scenes: &[Scene<'_>], view: usize) -> Self {
        let weights = |partner: bool| match partner {
            true => Weights { agrees: PARTNER, before: AGAINST, behind: HIDDEN, past: AGAINST },
            // What faces away from another head's projector is dark for it.
            false => Weights { agrees: HEADS, before: AGAINST, behind: 0, past: 0 },
        };
        Self(Jury::new(scenes, view, weights))
    }

    /// Words of what the cameras have at a place.
    #[inline(always)]
    pub fn words(&self, seen: &[SightLanes], known: &Known) -> Words {
        let mut words = Words::default();
        for (block, seen) in seen.iter().enumerate() {
            let mut sum = 0;
            for word in self.0.hear(block, seen, known) {
                sum += word;
            }
            let [partner, heads, against, hidden] = sum.to_le_bytes();
            words += Words {
                partner: i16::from(partner),
                heads: i16::from(heads),
                against: i16::from(against),
                hidden: i16::from(hidden),
            };
        }
        words
    }

    /// Words of a place that was looked at.
    #[inline(always)]
    pub fn of(&self, looks: &Looks, place: usize, known: &Known) -> Words {
        match looks.at(place) {
            Some(seen) => self.words(seen, known),
            None => Words::IMPOSSIBLE,
        }
    }
}

/// What all cameras have where the nodes of one view would be, kept for the orders that were asked for last.
#[derive(Debug)]
pub struct Sights {
    view: usize,
    /// Who says what of it.
    pub judges: Judges,
    /// Blocks of cameras.
    blocks: usize,
    /// Whole turns of each slot, two for a node.
    turns: Vec<[i32; SLOTS]>,
    /// Which slot of each node is written next.
    next: Vec<u8>,
    /// What the cameras have there; for a place outside of the volume nothing.
    seen: Vec<SightLanes>,
    inside: Vec<[bool; SLOTS]>,
    looks: Looks,
}

/// Orders of a node that are kept.
const SLOTS: usize = 2;

impl Sights {
    /// None yet.
    pub fn new(scenes: &[Scene<'_>], view: usize) -> Self {
        let n = scenes[view].pieces.of.len();
        let blocks = scenes.len().div_ceil(LANES);
        Self {
            view,
            judges: Judges::new(scenes, view),
            blocks,
            turns: vec![[NONE; SLOTS]; n],
            next: vec![0; n],
            seen: vec![SightLanes::NONE; n * SLOTS * blocks],
            inside: vec![[false; SLOTS]; n],
            looks: Looks::default(),
        }
    }

    /// Words for a node whose phases are absolute after `turns`, from cameras whose nodes are known by `known`.
    pub fn words(&mut self, scenes: &[Scene<'_>], node: usize, turns: i32, known: &Known) -> Words {
        if !self.turns[node].contains(&turns) {
            self.looks.clear();
            self.looks.add(scenes, self.view, &[place(&scenes[self.view], node, turns)], 0..=0);
            self.keep(0, node, turns);
        }
        let seen = self.at(node, turns);
        simd::dispatch(
            #[inline(always)]
            || match seen {
                Some(seen) => self.judges.words(seen, known),
                None => Words::IMPOSSIBLE,
            },
        )
    }

    /// What the cameras have at a node that was looked at, at these turns; `None` outside of the volume.
    #[inline(always)]
    fn at(&self, node: usize, turns: i32) -> Option<&[SightLanes]> {
        let slot = usize::from(self.turns[node][0] != turns);
        let first = (node * SLOTS + slot) * self.blocks;
        self.inside[node][slot].then(|| &self.seen[first..first + self.blocks])
    }

    /// Words for nodes that were looked at, at their `turns`. Those that were asked for at the same turns before, `old`, are the same
    /// where what the cameras see is none of the `changed`: nodes of all views, and what is none.
    #[inline(always)]
    pub fn renew(&self, turns: &[i32], old: &mut [(i32, Words)], changed: &[bool], known: &Known) {
        for (node, (&turns, old)) in turns.iter().zip(old).enumerate() {
            let same = turns == old.0;
            old.0 = turns;
            if turns == NONE {
                continue;
            }
            let Some(seen) = self.at(node, turns) else {
                old.1 = Words::IMPOSSIBLE;
                continue;
            };
            if !same || differs(seen, changed) {
                old.1 = self.judges.words(seen, known);
            }
        }
    }

    /// Looks at all nodes of the view at their `turns`, where that has not been done: several at once take less time.
    pub fn prepare(&mut self, scenes: &[Scene<'_>], turns: &[i32]) {
        let all = turns.iter().copied().enumerate();
        let new: Vec<(usize, i32)> =
            all.filter(|&(node, x)| x != NONE && !self.turns[node].contains(&x)).collect();
        let places: Vec<Place<'_>> =
            new.iter().map(|&(node, x)| place(&scenes[self.view], node, x)).collect();
        for (new, places) in new.chunks(PLACES).zip(places.chunks(PLACES)) {
            self.looks.clear();
            self.looks.add(scenes, self.view, places, 0..=0);
            for (i, &(node, turns)) in new.iter().enumerate() {
                self.keep(i, node, turns);
            }
        }
    }

    /// Keeps what the looks have for one of their places: a node at some turns.
    fn keep(&mut self, place: usize, node: usize, turns: i32) {
        let slot = usize::from(self.next[node]);
        self.next[node] = ((slot + 1) % SLOTS) as u8;
        let seen = self.looks.at(place);
        (self.turns[node][slot], self.inside[node][slot]) = (turns, seen.is_some());
        if let Some(seen) = seen {
            let first = (node * SLOTS + slot) * self.blocks;
            self.seen[first..first + self.blocks].copy_from_slice(seen);
        }
    }
}

/// Whether any of the nodes that the cameras see is one of those that have changed.
#[inline(always)]
fn differs(seen: &[SightLanes], changed: &[bool]) -> bool {
    let mut any = false;
    for seen in seen {
        for node in seen.node {
            any |= changed[node as usize];
        }
    }
    any
}

/// Where a node lies when its phases are absolute after `turns`.
fn place<'a>(scene: &'a Scene<'_>, node: usize, turns: i32) -> Place<'a> {
    let (line, fringes) = scene.at(node as u32);
    (line, fringes + (turns - scene.pieces.turns[node]) as f32)
}

#[cfg(test)]
mod tests {
    use super::Words;
    use proptest::prelude::{prop_assert_eq, proptest};

    proptest! {
        /// As many as lie within two steps of a node, each with as many words as there can be.
        #[test]
        fn packed_words_add_up_as_words_do(all in proptest::collection::vec([0i16..10, 0..10, 0..10, 0..10], 0..1089)) {
            let (mut sum, mut packed) = (Words::default(), 0);
            for [partner, heads, against, hidden] in all {
                let words = Words { partner, heads, against, hidden };
                sum += words;
                packed += words.packed();
            }
            prop_assert_eq!(Words::unpacked(packed), sum);
        }
    }
}
