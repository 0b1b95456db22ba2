//! What the other cameras say for and against a node at an order.

use super::grow::NONE;
use super::looks::{Looks, PLACES, Place};
use super::settle::Scene;
use super::witness::Sight;
use std::f32::consts::TAU;
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

/// What all cameras have where the nodes of one view would be, kept for the orders that were asked for last.
#[derive(Debug)]
pub struct Sights {
    view: usize,
    cameras: usize,
    /// Whole turns of each slot, two for a node.
    turns: Vec<[i32; SLOTS]>,
    /// Which slot of each node is written next.
    next: Vec<u8>,
    /// What each camera has there; for a place outside of the volume nothing.
    seen: Vec<Sight>,
    inside: Vec<[bool; SLOTS]>,
    looks: Looks,
}

/// Orders of a node that are kept.
const SLOTS: usize = 2;

impl Sights {
    /// None yet.
    pub fn new(scenes: &[Scene<'_>], view: usize) -> Self {
        let n = scenes[view].pieces.of.len();
        Self {
            view,
            cameras: scenes.len(),
            turns: vec![[NONE; SLOTS]; n],
            next: vec![0; n],
            seen: vec![Sight::NONE; n * SLOTS * scenes.len()],
            inside: vec![[false; SLOTS]; n],
            looks: Looks::default(),
        }
    }

    /// Words for a node whose phases are absolute after `turns`, from cameras whose nodes are known by `known`.
    pub fn words(&mut self, scenes: &[Scene<'_>], node: usize, turns: i32, known: &[Vec<i32>]) -> Words {
        let slot = self.turns[node].iter().position(|x| *x == turns);
        let slot = slot.unwrap_or_else(|| {
            self.looks.clear();
            self.looks.add(scenes, self.view, &[place(&scenes[self.view], node, turns)], 0..=0);
            self.keep(0, node, turns)
        });
        if !self.inside[node][slot] {
            return Words::IMPOSSIBLE;
        }
        let first = (node * SLOTS + slot) * self.cameras;
        judge(scenes, self.view, known, &self.seen[first..first + self.cameras])
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

    /// Whether words for a node at `turns` may differ from before, where those of `changed` have other turns than before.
    pub fn may_differ(&self, node: usize, turns: i32, changed: &[Vec<bool>]) -> bool {
        let Some(slot) = self.turns[node].iter().position(|x| *x == turns) else { return true };
        let first = (node * SLOTS + slot) * self.cameras;
        let seen = changed.iter().zip(&self.seen[first..first + self.cameras]);
        let changes = seen.map(|(changed, sight)| changed.get(sight.node as usize).copied().unwrap_or(false));
        self.inside[node][slot] && changes.fold(false, |any, changes| any | changes)
    }

    /// Keeps what the looks have for one of their places: a node at some turns. The slot that has it.
    fn keep(&mut self, place: usize, node: usize, turns: i32) -> usize {
        let slot = usize::from(self.next[node]);
        self.next[node] = ((slot + 1) % SLOTS) as u8;
        let seen = self.looks.at(place);
        (self.turns[node][slot], self.inside[node][slot]) = (turns, seen.is_some());
        if let Some(seen) = seen {
            let first = (node * SLOTS + slot) * self.cameras;
            self.seen[first..first + self.cameras].copy_from_slice(seen);
        }
        slot
    }
}

/// Where a node lies when its phases are absolute after `turns`.
fn place<'a>(scene: &'a Scene<'_>, node: usize, turns: i32) -> Place<'a> {
    let (line, fringes) = scene.at(node as u32);
    (line, fringes + (turns - scene.pieces.turns[node]) as f32)
}

/// Words for a place that was looked at.
pub fn of(scenes: &[Scene<'_>], view: usize, known: &[Vec<i32>], looks: &Looks, place: usize) -> Words {
    looks.at(place).map_or(Words::IMPOSSIBLE, |sights| judge(scenes, view, known, sights))
}

/// Words of what the cameras have.
fn judge(scenes: &[Scene<'_>], view: usize, known: &[Vec<i32>], seen: &[Sight]) -> Words {
    let mut words = Words::default();
    for ((scene, known), sight) in scenes.iter().zip(known).zip(seen) {
        let witness = &scene.witness;
        let partner = witness.head == scenes[view].witness.head;
        // Nothing here depends on a branch: what the next camera says is as good as chance.
        let turns = known.get(sight.node as usize).copied().unwrap_or(NONE);
        let [agrees, before, behind] = witness.compare(sight.ahead + TAU * turns as f32);
        let known = turns != NONE;
        // What faces away from another head's projector is dark for it.
        let past = (sight.node == Sight::PAST) & partner & !scene.is_dim_beside(&scenes[view]);
        words.partner += i16::from(known & agrees & partner);
        words.heads += i16::from(known & agrees & !partner);
        words.against += i16::from(known & before | past);
        words.hidden += i16::from(known & behind & partner);
    }
    words
}
