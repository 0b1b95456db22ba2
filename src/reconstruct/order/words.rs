//! What the other cameras say for and against a node at an order.

use super::grow::NONE;
use super::jury::{Jury, Known, NO_NODES, Weights};
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
    /// Where it stands in `seen` what the cameras have there, or [`OUTSIDE`].
    place: Vec<[u32; SLOTS]>,
    seen: Vec<SightLanes>,
    looks: Looks,
}

/// Of a place outside of the volume nothing is kept.
const OUTSIDE: u32 = u32::MAX;

/// Nodes that are looked at before what there is is kept.
const AT_ONCE: usize = 8 * PLACES;

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
            place: vec![[OUTSIDE; SLOTS]; n],
            // Most nodes are looked at once.
            seen: Vec::with_capacity(n * blocks * 9 / 8),
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
        let first = self.place[node][slot];
        (first != OUTSIDE).then(|| &self.seen[first as usize..first as usize + self.blocks])
    }

    /// Words for nodes that were looked at, at their `turns`. Those that were asked for at the same turns before, `old`, are the same
    /// where what the cameras see is none of the `changed`. Adds the nodes whose words are others than before at the same turns to
    /// `renewed`.
    #[inline(always)]
    pub fn renew(
        &self,
        turns: &[i32],
        old: &mut [(i32, Words)],
        changed: &Changed,
        known: &Known,
        renewed: &mut Vec<u32>,
    ) {
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
            if !same || changed.is_any(seen) {
                let words = self.judges.words(seen, known);
                if same && words != old.1 {
                    renewed.push(node as u32);
                }
                old.1 = words;
            }
        }
    }

    /// Looks at some nodes of the view at their `turns`, where that has not been done: several at once take less time.
    pub fn prepare(&mut self, scenes: &[Scene<'_>], turns: &[i32], nodes: impl Iterator<Item = u32>) {
        let all = nodes.map(|node| (node as usize, turns[node as usize]));
        let new: Vec<(usize, i32)> =
            all.filter(|&(node, x)| x != NONE && !self.turns[node].contains(&x)).collect();
        let places: Vec<Place<'_>> =
            new.iter().map(|&(node, x)| place(&scenes[self.view], node, x)).collect();
        for (new, places) in new.chunks(AT_ONCE).zip(places.chunks(AT_ONCE)) {
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
        self.turns[node][slot] = turns;
        let first = &mut self.place[node][slot];
        match self.looks.at(place) {
            None => *first = OUTSIDE,
            Some(seen) if *first == OUTSIDE => {
                *first = self.seen.len() as u32;
                self.seen.extend_from_slice(seen);
            }
            Some(seen) => self.seen[*first as usize..][..self.blocks].copy_from_slice(seen),
        }
    }
}

/// Nodes of all views that have changed.
#[derive(Debug)]
pub struct Changed {
    /// Whether each node is one, and what is none.
    is: Vec<bool>,
    /// Blocks of nodes in which some have: a bit each, by camera.
    blocks: Vec<[u32; LANES]>,
}

/// Nodes that stand for each other where it is asked whether any has changed: so many bits of their number. As the blocks are counted
/// by 5 bits, some of them share one.
const BLOCK_BITS: u32 = 6;

impl Changed {
    /// None of so many nodes of so many views.
    pub fn new(nodes: usize, views: usize) -> Self {
        Self { is: vec![false; nodes + NO_NODES], blocks: vec![[0; LANES]; views.div_ceil(LANES)] }
    }

    /// Adds a node, of the nodes of all views.
    pub fn add(&mut self, view: usize, node: usize) {
        self.is[node] = true;
        self.blocks[view / LANES][view % LANES] |= 1 << ((node as u32 >> BLOCK_BITS) % u32::BITS);
    }

    /// Whether any of the nodes that the cameras see at some places is one of them.
    #[inline(always)]
    pub fn is_any_seen(&self, looks: &Looks) -> bool {
        for place in 0..looks.len() {
            if let Some(seen) = looks.at(place)
                && self.is_any(seen)
            {
                return true;
            }
        }
        false
    }

    /// Whether any of the nodes that the cameras see is one of them.
    #[inline(always)]
    fn is_any(&self, seen: &[SightLanes]) -> bool {
        let mut maybe = 0;
        for (seen, blocks) in seen.iter().zip(&self.blocks) {
            for (blocks, node) in blocks.iter().zip(seen.node) {
                maybe |= blocks >> ((node >> BLOCK_BITS) % u32::BITS) & 1;
            }
        }
        if maybe == 0 {
            return false;
        }
        let mut any = false;
        for seen in seen {
            for node in seen.node {
                any |= self.is[node as usize];
            }
        }
        any
    }
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
