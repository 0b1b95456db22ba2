//! What the cameras say of a place at which they have looked: eight cameras at once.
//!
//! Each camera says one thing of a place, and what that counts depends on whether it is of the same head as the view that asks. So a
//! word is a number that stands in the camera's lane, and is taken or not; nothing here depends on a branch: what the next camera
//! says is as good as chance. Where no vectors are asked for, nothing but time is lost.

use super::grow::NONE;
use super::lookout::LANES;
use super::settle::{Scene, all_nodes};
use super::witness::{OTHER_RAD, SAME_ELSEWHERE_RAD, SAME_RAD, SightLanes};
use std::f32::consts::TAU;

/// Whole turns that make the phases of the nodes of all views absolute, or [`NONE`]: view after view, and at last those of
/// [`Numbers::nothing`](super::witness::Numbers::nothing) and [`Numbers::past`](super::witness::Numbers::past).
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Known(Vec<i32>);

/// What stands after the nodes of all views: nothing, and past the object.
pub const NO_NODES: usize = 2;

impl Known {
    /// Forgets what was known for what is known now, of each view.
    pub fn update<'a>(&mut self, views: impl Iterator<Item = &'a [i32]>) {
        self.0.clear();
        views.for_each(|turns| self.0.extend_from_slice(turns));
        self.0.extend([NONE; NO_NODES]);
    }

    /// Takes note of the turns of one node, of the nodes of all views.
    pub fn set(&mut self, node: usize, turns: i32) {
        self.0[node] = turns;
    }

    /// All of them.
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
    /// [`Witness::sign`](super::witness::Witness::sign).
    sign: [f32; LANES],
    /// Phases of the same surface differ by less, rad: [`SAME_RAD`] or [`SAME_ELSEWHERE_RAD`].
    same: [f32; LANES],
    agrees: [u32; LANES],
    before: [u32; LANES],
    behind: [u32; LANES],
    past: [u32; LANES],
}

/// All cameras as one view asks them.
#[derive(Debug, Clone)]
pub struct Jury {
    /// [`Numbers::past`](super::witness::Numbers::past).
    past: u32,
    benches: Vec<Bench>,
}

impl Jury {
    /// All cameras, as a view asks them. `weights`: what they count, by whether a camera is of the view's head.
    pub fn new(scenes: &[Scene<'_>], view: usize, weights: impl Fn(bool) -> Weights) -> Self {
        let none = [0; LANES];
        let empty = Bench {
            sign: [1.0; LANES],
            same: [0.0; LANES],
            agrees: none,
            before: none,
            behind: none,
            past: none,
        };
        let mut benches = vec![empty; scenes.len().div_ceil(LANES)];
        for (number, scene) in scenes.iter().enumerate() {
            let (bench, lane) = (&mut benches[number / LANES], number % LANES);
            let partner = scene.witness.head == scenes[view].witness.head;
            let weights = weights(partner);
            bench.sign[lane] = scene.witness.sign();
            bench.same[lane] = if partner { SAME_RAD } else { SAME_ELSEWHERE_RAD };
            bench.agrees[lane] = weights.agrees;
            bench.before[lane] = weights.before;
            bench.behind[lane] = weights.behind;
            bench.past[lane] = if scene.is_dim_beside(&scenes[view]) { 0 } else { weights.past };
        }
        Self { past: all_nodes(scenes) + 1, benches }
    }

    /// What the cameras of a block say, by what is `known`, of a place at which they have `seen` so much.
    #[inline(always)]
    pub fn hear(&self, block: usize, seen: &SightLanes, known: &Known) -> [u32; LANES] {
        let bench = &self.benches[block];
        let mut turns = [NONE; LANES];
        for (turns, &node) in turns.iter_mut().zip(&seen.node) {
            *turns = known.0[node as usize];
        }
        let mut words = [0; LANES];
        for i in 0..LANES {
            // Where no turns are known this is any number that is beyond all.
            let ahead = (seen.ahead[i] + TAU * turns[i] as f32) * bench.sign[i];
            let is_known = turns[i] != NONE;
            let agrees = is_known & (ahead.abs() < bench.same[i]);
            let before = is_known & (ahead >= OTHER_RAD);
            let behind = is_known & (ahead <= -OTHER_RAD);
            let past = seen.node[i] == self.past;
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

#[cfg(test)]
mod tests {
    use super::{Bench, Jury, Known, LANES, NONE, OTHER_RAD, SAME_ELSEWHERE_RAD, SAME_RAD, SightLanes};
    use proptest::prelude::*;
    use std::f32::consts::TAU;

    proptest! {
        /// One camera has the first of two nodes, of which the second is not known, or nothing, or looks past the object.
        #[test]
        fn a_camera_says_what_the_difference_of_the_phases_tells(
            ahead in -9f32..9.0,
            turns in -2i32..3,
            sign in prop_oneof![Just(1f32), Just(-1.0)],
            lane in 0..LANES,
            same in prop_oneof![Just(SAME_RAD), Just(SAME_ELSEWHERE_RAD)],
            node in 0u32..4,
        ) {
            let [agrees, before, behind, past] = [[1; LANES], [2; LANES], [4; LANES], [8; LANES]];
            let bench = Bench { sign: [sign; LANES], same: [same; LANES], agrees, before, behind, past };
            let jury = Jury { past: 3, benches: vec![bench] };
            let mut known = Known::default();
            known.update([[turns, NONE].as_slice()].into_iter());
            let mut seen = SightLanes { node: [2; LANES], ahead: [0.0; LANES] };
            (seen.node[lane], seen.ahead[lane]) = (node, ahead);
            let off = ahead + TAU * turns as f32;
            let farther = (off > 0.0) == (sign > 0.0);
            let word = match node {
                0 if off.abs() < same => 1,
                0 if off.abs() >= OTHER_RAD => if farther { 2 } else { 4 },
                3 => 8,
                _ => 0,
            };
            let mut expected = [0; LANES];
            expected[lane] = word;
            prop_assert_eq!(jury.hear(0, &seen, &known), expected);
        }
    }
}
