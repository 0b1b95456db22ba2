//! What the cameras say of a place at which they have looked: eight cameras at once.
//!
//! Each camera says one thing of a place, and what that counts depends on whether it is of the same head as the view that asks. So a
//! word is a number that stands in the camera's lane, and is taken or not; nothing here depends on a branch: what the next camera
//! says is as good as chance. Where no vectors are asked for, nothing but time is lost.

use super::grow::NONE;
use super::lookout::LANES;
use super::settle::Scene;
use super::witness::{OTHER_RAD, SAME_RAD, Sight, SightLanes};
use std::f32::consts::TAU;

/// Whole turns that make the phases of the nodes of all views absolute, or [`NONE`]: view after view, and a last one that
/// stands for what is no node.
#[derive(Debug, Clone)]
pub struct Known(Vec<i32>);

impl Known {
    /// Nothing.
    pub fn new() -> Self {
        Self(vec![NONE])
    }

    /// Forgets what was known for what is known now, of each view.
    pub fn update<'a>(&mut self, views: impl Iterator<Item = &'a [i32]>) {
        self.0.clear();
        views.for_each(|turns| self.0.extend_from_slice(turns));
        self.0.push(NONE);
    }

    /// All of them, and the last one.
    pub fn turns(&self) -> &[i32] {
        &self.0
    }
}

/// What a camera's words count.
#[derive(Debug, Clone, Copy)]
pub struct Weights {
    /// It sees the same surface.
    pub agrees: u32,
    /// It would not see its surface if the place were there.
    pub before: u32,
    /// It sees something before the place.
    pub behind: u32,
    /// It looks past the object, and can tell.
    pub past: u32,
}

/// The cameras of a block, as one view asks them.
#[derive(Debug, Clone)]
struct Bench {
    /// Where the nodes of each begin among those of all.
    first: [u32; LANES],
    /// [`Witness::sign`](super::witness::Witness::sign).
    sign: [f32; LANES],
    agrees: [u32; LANES],
    before: [u32; LANES],
    behind: [u32; LANES],
    past: [u32; LANES],
}

/// All cameras as one view asks them.
#[derive(Debug, Clone)]
pub struct Jury {
    /// Nodes of all views.
    nodes: u32,
    benches: Vec<Bench>,
}

impl Jury {
    /// All cameras, as a view asks them. `weights`: what they count, by whether a camera is of the view's head.
    pub fn new(scenes: &[Scene<'_>], view: usize, weights: impl Fn(bool) -> Weights) -> Self {
        let none = [0; LANES];
        let empty =
            Bench { first: none, sign: [1.0; LANES], agrees: none, before: none, behind: none, past: none };
        let mut benches = vec![empty; scenes.len().div_ceil(LANES)];
        let mut nodes = 0;
        for (number, scene) in scenes.iter().enumerate() {
            let (bench, lane) = (&mut benches[number / LANES], number % LANES);
            let weights = weights(scene.witness.head == scenes[view].witness.head);
            bench.first[lane] = nodes;
            bench.sign[lane] = scene.witness.sign();
            bench.agrees[lane] = weights.agrees;
            bench.before[lane] = weights.before;
            bench.behind[lane] = weights.behind;
            bench.past[lane] = if scene.is_dim_beside(&scenes[view]) { 0 } else { weights.past };
            nodes += scene.settled.len() as u32;
        }
        Self { nodes, benches }
    }

    /// The places of the nodes that a block sees, among those of all; the last one where it sees none.
    #[inline(always)]
    pub fn places(&self, block: usize, seen: &SightLanes) -> [u32; LANES] {
        let first = &self.benches[block].first;
        let mut places = [0; LANES];
        for i in 0..LANES {
            let node = seen.node[i];
            places[i] = if node < Sight::NOTHING { first[i] + node } else { self.nodes };
        }
        places
    }

    /// What the cameras of a block say, by what is `known`, of a place at which they have `seen` so much.
    #[inline(always)]
    pub fn hear(&self, block: usize, seen: &SightLanes, known: &Known) -> [u32; LANES] {
        let bench = &self.benches[block];
        let places = self.places(block, seen);
        let mut turns = [NONE; LANES];
        for i in 0..LANES {
            turns[i] = known.0[places[i] as usize];
        }
        let mut words = [0; LANES];
        for i in 0..LANES {
            // Where no turns are known this is any number that is beyond all.
            let ahead = (seen.ahead[i] + TAU * turns[i] as f32) * bench.sign[i];
            let is_known = turns[i] != NONE;
            let agrees = is_known & (ahead.abs() < SAME_RAD);
            let before = is_known & (ahead >= OTHER_RAD);
            let behind = is_known & (ahead <= -OTHER_RAD);
            let past = seen.node[i] == Sight::PAST;
            words[i] = take(agrees, bench.agrees[i])
                | take(before, bench.before[i])
                | take(behind, bench.behind[i])
                | take(past, bench.past[i]);
        }
        words
    }
}

#[inline(always)]
fn take(is: bool, word: u32) -> u32 {
    if is { word } else { 0 }
}
