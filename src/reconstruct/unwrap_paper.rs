//! The paper's unwrapping (4.1, Figure 9): one spanning tree guided by Qm.
//!
//! The tree is Kruskal's with union-find. An edge is as good as the worse of its two pixels' Qm; the wrapped
//! step between neighbours is taken as the true one. The tree from any seed is the same, so that the paper's
//! random seed pixel, from the best 10 % of Qm, only chooses the component: here the one that holds the pixel
//! of the best Qm. Every pixel's best edge is one of the tree's (Boruvka): these are taken first, in the order of the
//! pixels, and only the edges between the small trees that they make are put into order.

use super::runs::Runs;
use super::simd;
use crate::image::Plane;
use std::f32::consts::{PI, TAU};

/// Steps in which quality orders the edges.
const STEPS: usize = 4096;

/// The step of a pixel without a phase.
const UNKNOWN: u16 = u16::MAX;

/// Ways from a node to its best neighbour.
const UP: u8 = 1;
const LEFT: u8 = 2;
const RIGHT: u8 = 3;
const DOWN: u8 = 4;

/// Um: the phase unwrapped over the tree of the best pixel; NaN elsewhere. Phases are known within `runs` only.
pub fn unwrap(wrapped: &Plane<f32>, quality: &Plane<f32>, runs: &Runs) -> Plane<f32> {
    let mut out = Plane::filled(wrapped.width(), wrapped.height(), f32::NAN);
    let nodes = Nodes::of(wrapped, quality, runs);
    let Some(best) = nodes.best() else { return out };
    let keys = nodes.keys(runs);
    let groups = nodes.groups(&keys, runs);
    let mut tree = Tree::new(groups.number);
    for edge in nodes.edges_by_quality(&keys, &groups, runs) {
        tree.merge(edge);
    }
    // Of each group the turns, where it belongs to the seed's.
    let root = tree.find(groups.places[best].group).0;
    let turns: Vec<f32> = (0..groups.number as u32)
        .map(|group| {
            let (own, turns) = tree.find(group);
            if own == root { turns as f32 } else { f32::NAN }
        })
        .collect();
    let mut node = 0;
    for v in 0..runs.height() {
        for run in runs.row(v) {
            for out in &mut out.row_mut(v)[run.columns()] {
                let place = groups.places[node];
                *out = nodes.phase[node] + TAU * (turns[place.group as usize] + place.turns as f32);
                node += 1;
            }
        }
    }
    out
}

/// The pixels of the runs, one after the other.
struct Nodes {
    phase: Vec<f32>,
    quality: Vec<f32>,
    /// Quality as the edges are ordered by: 0 is the best, [`UNKNOWN`] where there is no phase.
    step: Vec<u16>,
    /// The node that each run begins with.
    first: Vec<u32>,
}

/// An edge: what it joins, and how many turns the second has more.
#[derive(Clone, Copy, Default)]
struct Edge {
    ends: [u32; 2],
    more: i32,
}

/// Trees of the nodes' best edges.
struct Groups {
    /// How many they are.
    number: usize,
    /// Where each node is.
    places: Vec<Place>,
}

/// A node's group, and its turns relative to that.
#[derive(Clone, Copy)]
struct Place {
    group: u32,
    turns: i32,
}

/// Where an edge belongs, in the lower bits, one more than the turns that its second node has more, and in the highest
/// whether it is the best one of one of its nodes.
#[derive(Clone, Copy)]
struct Key(u16);

impl Key {
    /// The first bit of the turns.
    const TURNS: u32 = 13;
    /// The bucket of edges that are not kept.
    const NOT_KEPT: u16 = STEPS as u16;
    const BUCKET: u16 = (1 << Self::TURNS) - 1;
    const BEST: u16 = 1 << 15;

    /// The edge between two nodes, given by their steps and phases.
    #[inline(always)]
    fn new(kept: u8, steps: [u16; 2], phases: [f32; 2]) -> Self {
        // -1, 0 or 1: phases are wrapped.
        let step = phases[1] - phases[0];
        let turns = 1 + u16::from(step <= -PI) - u16::from(step >= PI);
        let bucket = if kept != 0 { steps[0].max(steps[1]) } else { Self::NOT_KEPT };
        Self(bucket | turns << Self::TURNS)
    }

    /// Quality step of its worse node, or [`Key::NOT_KEPT`].
    #[inline(always)]
    fn bucket(self) -> u16 {
        self.0 & Self::BUCKET
    }

    /// Turns that its second node has more.
    #[inline(always)]
    fn more(self) -> i32 {
        i32::from(self.0 >> Self::TURNS & 3) - 1
    }

    #[inline(always)]
    fn is_best(self) -> bool {
        self.0 & Self::BEST != 0
    }
}

impl Nodes {
    fn of(wrapped: &Plane<f32>, quality: &Plane<f32>, runs: &Runs) -> Self {
        let area = runs.area();
        let mut nodes = Self {
            phase: Vec::with_capacity(area),
            quality: Vec::with_capacity(area),
            step: Vec::with_capacity(area),
            first: Vec::with_capacity(runs.all().len()),
        };
        for v in 0..runs.height() {
            for run in runs.row(v) {
                nodes.first.push(nodes.phase.len() as u32);
                let (phase, quality) = (&wrapped.row(v)[run.columns()], &quality.row(v)[run.columns()]);
                nodes.phase.extend_from_slice(phase);
                nodes.quality.extend_from_slice(quality);
                let step = |(q, phase): (&f32, &f32)| {
                    let step = ((1.0 - q).clamp(0.0, 1.0) * (STEPS - 1) as f32) as u16;
                    if phase.is_nan() { UNKNOWN } else { step }
                };
                nodes.step.extend(quality.iter().zip(phase).map(step));
            }
        }
        nodes
    }

    /// The node of the best quality whose phase is known, the first of them.
    fn best(&self) -> Option<usize> {
        let known = (0..self.phase.len()).filter(|&i| !self.phase[i].is_nan());
        known.max_by(|&a, &b| self.quality[a].total_cmp(&self.quality[b]).then(b.cmp(&a)))
    }

    /// The trees of the edges that are the best of one of their nodes.
    fn groups(&self, keys: &[Vec<Key>; 2], runs: &Runs) -> Groups {
        let mut tree = Tree::new(self.step.len());
        self.each_edge(keys, runs, |key, a, b| {
            if key.is_best() {
                tree.merge(Edge { ends: [a as u32, b as u32], more: key.more() });
            }
        });
        let mut numbers = vec![u32::MAX; self.step.len()];
        let mut number = 0;
        let places = (0..self.step.len() as u32).map(|node| {
            let (root, turns) = tree.find(node);
            let group = &mut numbers[root as usize];
            if *group == u32::MAX {
                *group = number;
                number += 1;
            }
            Place { group: *group, turns }
        });
        let places = places.collect();
        Groups { number: number as usize, places }
    }

    /// The edges between groups by falling quality; ties in the order of the pixels, that to the right before that down.
    fn edges_by_quality(&self, keys: &[Vec<Key>; 2], groups: &Groups, runs: &Runs) -> Vec<Edge> {
        let mut found = Vec::new();
        let mut start = [0u32; STEPS];
        self.each_edge(keys, runs, |key, a, b| {
            // The last node has none to its right.
            if key.bucket() == Key::NOT_KEPT {
                return;
            }
            let (from, to) = (groups.places[a], groups.places[b]);
            if from.group != to.group {
                let more = from.turns + key.more() - to.turns;
                found.push((key.bucket(), Edge { ends: [from.group, to.group], more }));
                start[usize::from(key.bucket())] += 1;
            }
        });
        let mut before = 0;
        for start in &mut start {
            (*start, before) = (before, before + *start);
        }
        let mut edges = vec![Edge::default(); found.len()];
        for (bucket, edge) in found {
            let place = &mut start[usize::from(bucket)];
            edges[*place as usize] = edge;
            *place += 1;
        }
        edges
    }

    /// Where the edges to the right and down of each node belong.
    fn keys(&self, runs: &Runs) -> [Vec<Key>; 2] {
        let [right, down] = self.kept(runs);
        let mut keys = [(); 2].map(|()| vec![Key(Key::NOT_KEPT); self.step.len()]);
        simd::dispatch(
            #[inline(always)]
            || {
                self.keys_beside(0, 1, &right, &mut keys[0]);
                self.each_overlap(
                    runs,
                    #[inline(always)]
                    |a, b, n| self.keys_beside(a, b, &down[a..a + n], &mut keys[1][a..a + n]),
                );
                self.mark_best(&mut keys, runs);
            },
        );
        keys
    }

    /// Marks the edges that are the first of one of their nodes'.
    #[inline(always)]
    fn mark_best(&self, [right, down]: &mut [Vec<Key>; 2], runs: &Runs) {
        let nodes = self.step.len();
        // Buckets of the edges to the left of each node and above it.
        let [mut left, mut up] = [(); 2].map(|()| vec![Key::NOT_KEPT; nodes]);
        for (left, key) in left[1..].iter_mut().zip(&*right) {
            *left = key.bucket();
        }
        self.each_overlap(
            runs,
            #[inline(always)]
            |a, b, n| {
                for (up, key) in up[b..b + n].iter_mut().zip(&down[a..a + n]) {
                    *up = key.bucket();
                }
            },
        );
        // Which one is the first: that of the least bucket, and of these the one up, left, right, down.
        let mut way = vec![0u8; nodes];
        let (up, left, right_of, down_of) = (&up[..nodes], &left[..nodes], &right[..nodes], &down[..nodes]);
        for i in 0..nodes {
            let (mut least, mut first) = (up[i], UP);
            let (right, down) = (right_of[i].bucket(), down_of[i].bucket());
            first = if left[i] < least { LEFT } else { first };
            least = least.min(left[i]);
            first = if right < least { RIGHT } else { first };
            least = least.min(right);
            first = if down < least { DOWN } else { first };
            least = least.min(down);
            way[i] = if least < Key::NOT_KEPT { first } else { 0 };
        }
        for (key, way) in right.iter_mut().zip(way.windows(2)) {
            let best = (way[0] == RIGHT) | (way[1] == LEFT);
            key.0 |= if best { Key::BEST } else { 0 };
        }
        self.each_overlap(
            runs,
            #[inline(always)]
            |a, b, n| {
                let (keys, above, below) = (&mut down[a..a + n], &way[a..a + n], &way[b..b + n]);
                for i in 0..n {
                    let best = (above[i] == DOWN) | (below[i] == UP);
                    keys[i].0 |= if best { Key::BEST } else { 0 };
                }
            },
        );
    }

    /// Keys of the edges from the nodes from `a` on to those from `b` on.
    #[inline(always)]
    fn keys_beside(&self, a: usize, b: usize, kept: &[u8], keys: &mut [Key]) {
        let n = kept.len().min(self.step.len() - b);
        let (kept, keys) = (&kept[..n], &mut keys[..n]);
        let [from, to] = [a, b].map(|first| (&self.step[first..first + n], &self.phase[first..first + n]));
        for i in 0..n {
            keys[i] = Key::new(kept[i], [from.0[i], to.0[i]], [from.1[i], to.1[i]]);
        }
    }

    /// Which of the edges to the right and down of each node may be taken. Of the four around a square of pixels the last
    /// in order never is: the others have joined its ends before. That leaves few more than a tree has.
    fn kept(&self, runs: &Runs) -> [Vec<u8>; 2] {
        let nodes = self.step.len();
        let [mut right, mut down] = [(); 2].map(|()| vec![0u8; nodes]);
        simd::dispatch(
            #[inline(always)]
            || {
                let first = self.first.iter().map(|&first| first as usize);
                for (run, first) in runs.all().iter().zip(first) {
                    let step = &self.step[first..first + run.columns().len()];
                    for (right, pair) in right[first..].iter_mut().zip(step.windows(2)) {
                        *right = u8::from((pair[0] != UNKNOWN) & (pair[1] != UNKNOWN));
                    }
                }
                self.each_overlap(
                    runs,
                    #[inline(always)]
                    |a, b, n| {
                        let (above, below) = (&self.step[a..a + n], &self.step[b..b + n]);
                        drop_last(above, below, &mut right[b..b + n], &mut down[a..a + n]);
                    },
                );
            },
        );
        [right, down]
    }

    /// Calls `each` for all stretches that lie above one of the next row: their first nodes, and their length.
    #[inline(always)]
    fn each_overlap(&self, runs: &Runs, mut each: impl FnMut(usize, usize, usize)) {
        for v in 0..runs.height().saturating_sub(1) {
            self.each_overlap_of(v, runs, &mut each);
        }
    }

    /// The same for those of row `v`.
    #[inline(always)]
    fn each_overlap_of(&self, v: usize, runs: &Runs, each: &mut impl FnMut(usize, usize, usize)) {
        let (mut above, mut below) = (runs.places(v), runs.places(v + 1));
        while !above.is_empty() && !below.is_empty() {
            let (upper, lower) = (runs.all()[above.start], runs.all()[below.start]);
            let (from, to) = (upper.start().max(lower.start()), upper.end().min(lower.end()));
            if from < to {
                let node = |place: usize, start: usize| self.first[place] as usize + from - start;
                each(node(above.start, upper.start()), node(below.start, lower.start()), to - from);
            }
            if upper.end() <= lower.end() {
                above.start += 1;
            } else {
                below.start += 1;
            }
        }
    }

    /// Calls `each` with every edge: its key and its nodes.
    #[inline(always)]
    fn each_edge(&self, [right, down]: &[Vec<Key>; 2], runs: &Runs, mut each: impl FnMut(Key, usize, usize)) {
        let mut stretch = |from: usize, to: usize, apart: usize| {
            for a in from..to {
                each(right[a], a, a + 1);
                if apart != 0 {
                    each(down[a], a, a + apart);
                }
            }
        };
        let mut done = 0;
        for v in 0..runs.height() {
            if v + 1 < runs.height() {
                self.each_overlap_of(v, runs, &mut |a, b, n| {
                    stretch(done, a, 0);
                    stretch(a, a + n, b - a);
                    done = a + n;
                });
            }
            let end = runs.places(v).end;
            let end = self.first.get(end).map_or(self.step.len(), |&first| first as usize);
            stretch(done, end, 0);
            done = end;
        }
    }
}

/// Keeps the edges down of a stretch whose ends are known, and drops the last edge of every square that it spans with what
/// lies `below`. Edges of the square's worst pixel are its last ones; of these, that to the right below, then that down on
/// the right.
#[inline(always)]
fn drop_last(above: &[u16], below: &[u16], right: &mut [u8], down: &mut [u8]) {
    let n = above.len();
    let (below, right, down) = (&below[..n], &mut right[..n], &mut down[..n]);
    for i in 0..n {
        down[i] = u8::from((above[i] != UNKNOWN) & (below[i] != UNKNOWN));
    }
    for i in 0..n - 1 {
        let (top, bottom) = (above[i].max(above[i + 1]), below[i].max(below[i + 1]));
        right[i] &= u8::from((bottom < top) | (bottom == UNKNOWN));
    }
    for i in 0..n - 1 {
        let (top, bottom) = (above[i].max(above[i + 1]), below[i].max(below[i + 1]));
        let last = (bottom < top) & (top != UNKNOWN) & (above[i + 1] == top);
        down[i + 1] &= u8::from(!last);
    }
    for i in 0..n - 1 {
        let (top, bottom) = (above[i].max(above[i + 1]), below[i].max(below[i + 1]));
        let last = (bottom < top) & (top != UNKNOWN) & (above[i + 1] != top);
        down[i] &= u8::from(!last);
    }
}

/// Union-find whose links carry whole turns.
struct Tree {
    links: Vec<Link>,
}

/// A node's way to its root; a root has itself for a parent and, in place of turns, its tree's nodes.
#[derive(Clone, Copy)]
struct Link {
    parent: u32,
    turns: i32,
}

impl Tree {
    fn new(n: usize) -> Self {
        Self { links: (0..n as u32).map(|parent| Link { parent, turns: 1 }).collect() }
    }

    /// Root of a node, and the node's turns relative to it.
    #[inline(always)]
    fn find(&mut self, mut node: u32) -> (u32, i32) {
        let mut turns = 0;
        loop {
            let link = self.links[node as usize];
            if link.parent == node {
                return (node, turns);
            }
            let parent = self.links[link.parent as usize];
            if parent.parent == link.parent {
                return (link.parent, turns + link.turns);
            }
            // Path halving: skip the parent, with its turns.
            let both = link.turns + parent.turns;
            self.links[node as usize] = Link { parent: parent.parent, turns: both };
            turns += both;
            node = parent.parent;
        }
    }

    #[inline(always)]
    fn merge(&mut self, Edge { ends: [a, b], more }: Edge) {
        let (mut root, turns_a) = self.find(a);
        let (mut other, turns_b) = self.find(b);
        if root == other {
            return;
        }
        let mut shift = turns_a + more - turns_b;
        if self.links[root as usize].turns < self.links[other as usize].turns {
            (root, other, shift) = (other, root, -shift);
        }
        let nodes = self.links[other as usize].turns;
        self.links[other as usize] = Link { parent: root, turns: shift };
        self.links[root as usize].turns += nodes;
    }
}

#[cfg(test)]
mod tests {
    use super::{STEPS, unwrap};
    use crate::image::Plane;
    use crate::reconstruct::runs::Runs;
    use proptest::prelude::{any, prop_assert, proptest};
    use std::f32::consts::{PI, TAU};

    const W: usize = 13;
    const H: usize = 9;

    /// Turns of each pixel of the best one's tree, relative to that one, by Kruskal's algorithm as it is written down.
    fn plain(wrapped: &Plane<f32>, quality: &Plane<f32>) -> Vec<Option<i32>> {
        let (phase, quality) = (wrapped.as_slice(), quality.as_slice());
        let step = |i: usize| ((1.0 - quality[i]).clamp(0.0, 1.0) * (STEPS - 1) as f32) as u16;
        let mut edges = Vec::new();
        for a in 0..W * H {
            let right = (a % W + 1 < W).then_some(a + 1);
            let down = (a + W < W * H).then_some(a + W);
            for (side, b) in [right, down].into_iter().enumerate() {
                if let Some(b) = b.filter(|&b| !phase[a].is_nan() && !phase[b].is_nan()) {
                    edges.push((step(a).max(step(b)), a, side, b));
                }
            }
        }
        edges.sort_unstable();
        let mut tree: Vec<(usize, i32)> = (0..W * H).map(|i| (i, 0)).collect();
        for (_, a, _, b) in edges {
            let ((from, turns_a), (to, turns_b)) = (tree[a], tree[b]);
            if from == to {
                continue;
            }
            let difference = phase[b] - phase[a];
            let more = i32::from(difference <= -PI) - i32::from(difference >= PI);
            for place in tree.iter_mut().filter(|place| place.0 == to) {
                *place = (from, place.1 + turns_a + more - turns_b);
            }
        }
        let known = (0..W * H).filter(|&i| !phase[i].is_nan());
        let Some(best) = known.max_by(|&a, &b| quality[a].total_cmp(&quality[b]).then(b.cmp(&a))) else {
            return vec![None; W * H];
        };
        let (root, own) = tree[best];
        let turns = |i: usize| (tree[i].0 == root && !phase[i].is_nan()).then(|| tree[i].1 - own);
        (0..W * H).map(turns).collect()
    }

    proptest! {
        /// Whatever the mask, with ties of quality and without.
        #[test]
        fn the_tree_is_that_of_kruskal(
            phases in proptest::collection::vec(-PI..PI, W * H),
            qualities in proptest::collection::vec(0.0f32..1.0, W * H),
            object in proptest::collection::vec(0u8..5, W * H),
            unknown in proptest::collection::vec(0u8..9, W * H),
            levels in 1u8..9,
            coarse in any::<bool>(),
        ) {
            let mask: Vec<u8> = object.iter().map(|&x| u8::from(x > 0)).collect();
            let mask = Plane::from_vec(W, H, mask).expect("as many");
            let level = |q: f32| if coarse { (q * f32::from(levels)).floor() / f32::from(levels) } else { q };
            let quality: Vec<f32> = qualities.into_iter().map(level).collect();
            let quality = Plane::from_vec(W, H, quality).expect("as many");
            let known = |i: usize| unknown[i] > 0 && mask.as_slice()[i] > 0;
            let phases: Vec<f32> =
                phases.into_iter().enumerate().map(|(i, x)| if known(i) { x } else { f32::NAN }).collect();
            let wrapped = Plane::from_vec(W, H, phases).expect("as many");
            let found = unwrap(&wrapped, &quality, &Runs::of(&mask));
            let expected = plain(&wrapped, &quality);
            let turns = |i: usize| (found.as_slice()[i] - wrapped.as_slice()[i]) / TAU;
            let seed = (0..W * H).find(|&i| expected[i] == Some(0));
            for i in 0..W * H {
                let value = found.as_slice()[i];
                match (expected[i], seed) {
                    (Some(expected), Some(seed)) => {
                        let here = turns(i) - turns(seed);
                        prop_assert!((here - expected as f32).abs() < 1e-3, "{here} and not {expected} at {i}");
                    }
                    _ => prop_assert!(value.is_nan(), "{value} at {i}"),
                }
            }
        }
    }
}
