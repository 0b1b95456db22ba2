//! From settled pieces to the fringe order of every node.
//!
//! The cores of settled pieces that other cameras confirm are where it begins. From there the orders grow over the view,
//! node by node, along borders that continue: over wide surfaces first, so that what comes along a limb is there before what
//! comes over the seam on which limb and trunk agree by chance. Then all that has an order is tried against all
//! the others. What is contradicted, or has a neighbour that continues it at another order, loses its order; so does, until the
//! last round, what nobody confirms. What is open then is sought at the places where other heads see it
//! ([`super::elsewhere`]), and the next round begins.

use super::elsewhere::Seeker;
use super::finish;
use super::graph::{Edge, Graph};
use super::jury::{Known, NO_NODES};
use super::settle::Scene;
use super::words::{Sights, Words};
use crate::reconstruct::simd;
use rayon::prelude::*;
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// No order.
pub const NONE: i32 = i32::MIN;

/// Rounds of growing and trying.
const ROUNDS: usize = 5;

/// The least lead of a piece's order for its cores to be a beginning.
const MIN_MARGIN: f32 = 0.5;

/// Pixel pairs that must continue for words to be shared over a border, or for orders to contradict each other there.
const SHARED_PAIRS: u32 = 4;

/// What growth asks of a border, and of the other cameras.
#[derive(Debug, Clone, Copy)]
struct Pass {
    /// Pixel pairs that must continue.
    pairs: u32,
    /// How many times more than those that do not.
    share: u32,
    /// Who must confirm the place.
    support: Support,
    /// How far the node must be from any step, nodes.
    clearance: u8,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Support {
    /// Nobody.
    None,
    /// A camera, there or at the node that it continues.
    Near,
    /// A camera.
    Here,
}

const PASSES: [Pass; 6] = [
    Pass { pairs: 7, share: 5, support: Support::None, clearance: 1 },
    Pass { pairs: 7, share: 5, support: Support::Here, clearance: 0 },
    Pass { pairs: 4, share: 3, support: Support::Here, clearance: 0 },
    Pass { pairs: 7, share: 5, support: Support::Near, clearance: 0 },
    Pass { pairs: 4, share: 3, support: Support::Near, clearance: 0 },
    Pass { pairs: 6, share: 4, support: Support::None, clearance: 0 },
];

/// A view while orders grow over it.
#[derive(Debug)]
pub struct View<'a> {
    /// Its nodes and borders.
    pub graph: &'a Graph,
    /// The borders over which words may be shared, each once: two nodes, and the turns to add to the second.
    shared: Vec<(u32, u32, i32)>,
    /// Those of them whose nodes have orders that continue each other, as of the last sums.
    linked: Vec<(u32, u32)>,
    /// Whole turns that make each node's phases absolute, or [`NONE`].
    pub turns: Vec<i32>,
    /// What the other cameras say of each node, as of the last time that it was tried.
    pub words: Vec<Words>,
    /// Turns and words of each node as of the last check.
    checked: Vec<(i32, Words)>,
    /// The nodes without an order that may get one in this round.
    open: Vec<u32>,
    /// Turns that were contradicted in this round: node, turns.
    pub banned: Vec<Vec<i32>>,
    /// What the cameras have at its places.
    pub sights: Sights,
}

/// What became of a node.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Label {
    /// Whole turns that make its phases absolute, or [`NONE`].
    pub turns: i32,
    /// Whether an order was contradicted. Else it has none because too little tells.
    pub contradicted: bool,
}

/// The order of every node of every view. The same for any number of threads: in each step all views go by what was known
/// before it.
pub fn labels(scenes: &[Scene<'_>]) -> Vec<Vec<Label>> {
    let mut views: Vec<View<'_>> =
        (0..scenes.len()).into_par_iter().map(|view| begin(scenes, view)).collect();
    let mut known = Known::default();
    check(scenes, &mut views, &mut known);
    views.par_iter_mut().for_each(drop_unconfirmed);
    let mut seeker = Seeker::new(scenes);
    for round in 0..ROUNDS {
        views.par_iter_mut().for_each(View::reopen);
        for pass in PASSES {
            update(&mut known, &views);
            views
                .par_iter_mut()
                .zip(scenes)
                .for_each(|(view, scene)| grow(scenes, scene, view, &known, pass));
        }
        check(scenes, &mut views, &mut known);
        update(&mut known, &views);
        if round + 1 < ROUNDS {
            seeker.seek(scenes, &mut views, &known);
            views.par_iter_mut().for_each(drop_unconfirmed);
        }
    }
    let labels = views.par_iter_mut().enumerate();
    let mut labels: Vec<Vec<Label>> =
        labels.map(|(number, view)| finish::labels(number, view, scenes, &known)).collect();
    let turns: Vec<Vec<i32>> =
        labels.iter().map(|labels| labels.iter().map(|label| label.turns).collect()).collect();
    known.update(turns.iter().map(|turns| &turns[..]));
    let views = views.par_iter_mut().zip(&mut labels).enumerate();
    views.for_each(|(number, (view, labels))| finish::stretches(number, view, scenes, &known, labels));
    labels
}

/// Takes note of the orders of all nodes of all views.
fn update(known: &mut Known, views: &[View<'_>]) {
    known.update(views.iter().map(|view| &view.turns[..]));
}

impl View<'_> {
    /// Finds the borders over which words are shared.
    fn link(&mut self) {
        self.linked.clear();
        for &(a, b, turns) in &self.shared {
            let known = self.turns[a as usize];
            if known != NONE && self.turns[b as usize] == known.wrapping_add(turns) {
                self.linked.push((a, b));
            }
        }
    }

    /// Begins a round: nothing is contradicted yet.
    fn reopen(&mut self) {
        self.banned.iter_mut().for_each(Vec::clear);
        self.open.clear();
        let nodes = self.turns.iter().enumerate().filter(|(_, turns)| **turns == NONE);
        self.open.extend(nodes.map(|(node, _)| node as u32));
    }
}

/// The cores of the settled pieces.
fn begin<'a>(scenes: &'a [Scene<'_>], view: usize) -> View<'a> {
    let scene = &scenes[view];
    let order = |node: usize| {
        let state = &scene.states[scene.pieces.of[node] as usize];
        let begins = state.margin >= MIN_MARGIN && scene.pieces.core[node];
        let order = state.order.ok().filter(|_| begins);
        order.map_or(NONE, |order| order + scene.pieces.turns[node])
    };
    let n = scene.pieces.of.len();
    let mut shared = Vec::with_capacity(2 * n);
    for node in 0..n as u32 {
        let shares = |edge: &&Edge| edge.other > node && edge.good >= SHARED_PAIRS;
        let edges = scene.graph.of(node as usize).iter().filter(shares);
        shared.extend(edges.map(|edge| (node, edge.other, edge.turns)));
    }
    let mut sights = Sights::new(scenes, view);
    // Most nodes are asked at their piece's order at last.
    sights.prepare(scenes, &scene.settled);
    View {
        graph: &scene.graph,
        shared,
        linked: Vec::new(),
        turns: (0..n).map(order).collect(),
        words: vec![Words::default(); n],
        checked: vec![(NONE, Words::default()); n],
        open: Vec::new(),
        banned: vec![Vec::new(); n],
        sights,
    }
}

/// Which node is grown to next: the one that is farthest from any step; of several the one that the fewest steps of growth lead to, then
/// the first. One number, greater for what comes before.
fn priority(clearance: u8, steps: u32, node: u32) -> u64 {
    u64::from(clearance) << 56 | u64::from(MOST_STEPS - steps.min(MOST_STEPS)) << 32 | u64::from(!node)
}

/// Steps from where growth began, at most: more are counted as so many.
const MOST_STEPS: u32 = (1 << 24) - 1;

/// The node whose [`priority`] it is.
fn node_of(priority: u64) -> usize {
    !(priority as u32) as usize
}

/// An order that the neighbours of a node propose for it.
struct Proposal {
    turns: i32,
    good: u32,
    bad: u32,
    /// Words for the neighbours.
    around: Words,
}

/// Lets the orders grow over a view: always to the node that is farthest from any step.
fn grow(scenes: &[Scene<'_>], scene: &Scene<'_>, view: &mut View<'_>, known: &Known, pass: Pass) {
    let mut steps = vec![0u32; view.turns.len()];
    // Nodes of which nothing has been asked since what is around them has changed.
    let mut fresh = vec![false; view.turns.len()];
    let open = |view: &View<'_>, node: usize| {
        view.turns[node] == NONE && view.graph.clearance[node] >= pass.clearance
    };
    let mut first = Vec::new();
    for &node in &view.open {
        let at = node as usize;
        if open(view, at) && view.graph.of(at).iter().any(|e| view.turns[e.other as usize] != NONE) {
            fresh[at] = true;
            first.push(priority(view.graph.clearance[at], 0, node));
        }
    }
    let mut heap = BinaryHeap::from(first);
    let mut proposals = Vec::new();
    while let Some(next) = heap.pop() {
        let node = node_of(next);
        if view.turns[node] != NONE || !std::mem::take(&mut fresh[node]) {
            continue;
        }
        let step = propose(view, node, &steps, &mut proposals) + 1;
        for proposal in &proposals {
            let enough = proposal.good >= pass.pairs && proposal.good >= pass.share * proposal.bad;
            if !enough || view.banned[node].contains(&proposal.turns) {
                continue;
            }
            let own = view.sights.words(scenes, node, proposal.turns, known);
            let mut sum = own;
            sum += proposal.around;
            if contradicted(own, sum, scene.pieces.core[node]) {
                view.banned[node].push(proposal.turns);
                continue;
            }
            let supported = match pass.support {
                Support::None => true,
                Support::Near => sum.good() > 0,
                Support::Here => own.good() > 0,
            };
            if supported {
                (view.turns[node], view.words[node], steps[node]) = (proposal.turns, own, step);
                for edge in view.graph.of(node) {
                    let other = edge.other as usize;
                    if open(view, other) {
                        fresh[other] = true;
                        heap.push(priority(view.graph.clearance[other], step, edge.other));
                    }
                }
                break;
            }
        }
    }
    let View { open, turns, .. } = view;
    open.retain(|&node| turns[node as usize] == NONE);
}

/// The orders that the neighbours of a node propose, those of most pixel pairs first; the steps that the farthest of
/// these neighbours is from where growth began.
fn propose(view: &View<'_>, node: usize, steps: &[u32], proposals: &mut Vec<Proposal>) -> u32 {
    proposals.clear();
    let mut farthest = 0;
    for edge in view.graph.of(node) {
        let other = view.turns[edge.other as usize];
        if other == NONE || edge.good == 0 {
            continue;
        }
        farthest = farthest.max(steps[edge.other as usize]);
        let (turns, around) = (other - edge.turns, view.words[edge.other as usize]);
        match proposals.iter_mut().find(|x| x.turns == turns) {
            Some(x) => {
                (x.good, x.bad) = (x.good + edge.good, x.bad + edge.bad);
                x.around += around;
            }
            None => proposals.push(Proposal { turns, good: edge.good, bad: edge.bad, around }),
        }
    }
    proposals.sort_unstable_by_key(|x| (Reverse(x.good), x.turns));
    farthest
}

/// Whether the other cameras contradict: what they say of the place itself, and of it and what is around.
fn contradicted(own: Words, sum: Words, core: bool) -> bool {
    if sum.against >= 3 && sum.against > sum.good() {
        return true;
    }
    !core && own.against > 0 && own.against >= own.good()
}

/// Words of the nodes within two steps, along borders that continue.
pub fn sums(view: &mut View<'_>) -> Vec<Words> {
    view.link();
    let mut sum: Vec<u64> = view.words.iter().map(Words::packed).collect();
    for _ in 0..2 {
        let before = sum.clone();
        for &(a, b) in &view.linked {
            sum[a as usize] += before[b as usize];
            sum[b as usize] += before[a as usize];
        }
    }
    sum.into_iter().map(Words::unpacked).collect()
}

/// Which nodes are some of these, or have one within two steps, along borders that continue. Since the sums were taken nodes may have
/// lost their orders, but none may have got one.
pub fn near(view: &View<'_>, mut near: Vec<bool>) -> Vec<bool> {
    for _ in 0..2 {
        let before = near.clone();
        for &(a, b) in &view.linked {
            near[a as usize] |= before[b as usize];
            near[b as usize] |= before[a as usize];
        }
        near.iter_mut().zip(&view.turns).for_each(|(near, turns)| *near &= *turns != NONE);
    }
    near
}

/// Pixel pairs on which neighbours continue a node, though their order is another, and those that continue nothing.
pub fn conflict(view: &View<'_>, node: usize) -> (u32, u32) {
    let (mut conflict, mut bad) = (0, 0);
    for edge in view.graph.of(node) {
        let other = view.turns[edge.other as usize];
        if other != NONE {
            bad += edge.bad;
            conflict += if other == view.turns[node] + edge.turns { 0 } else { edge.good };
        }
    }
    (conflict, bad)
}

/// Words of the head's other camera that stand against a neighbour of another order.
pub const FIRM: i16 = 11;

/// Tries all that has an order against all that has, and takes it from what is contradicted.
fn check(scenes: &[Scene<'_>], views: &mut [View<'_>], known: &mut Known) {
    update(known, views);
    let known = &*known;
    let mut changed: Vec<bool> = Vec::with_capacity(known.turns().len());
    for view in &*views {
        changed.extend(view.turns.iter().zip(&view.checked).map(|(is, was)| *is != was.0));
    }
    changed.extend([false; NO_NODES]);
    views.par_iter_mut().zip(scenes).for_each(|(view, scene)| {
        view.sights.prepare(scenes, &view.turns);
        simd::dispatch(
            #[inline(always)]
            || view.sights.renew(&view.turns, &mut view.checked, &changed, known),
        );
        for (words, &(turns, checked)) in view.words.iter_mut().zip(&view.checked) {
            *words = if turns == NONE { Words::default() } else { checked };
        }
        let sum = sums(view);
        let gone = |&node: &usize| {
            view.turns[node] != NONE
                && (contradicted(view.words[node], sum[node], scene.pieces.core[node])
                    || sum[node].partner <= FIRM && conflict(view, node).0 > 0)
        };
        let gone: Vec<usize> = (0..view.turns.len()).filter(gone).collect();
        for node in gone {
            let turns = std::mem::replace(&mut view.turns[node], NONE);
            view.banned[node].push(turns);
            view.words[node] = Words::default();
        }
    });
}

/// Takes the order from nodes that no camera confirms: the next round may reach them from a better side.
fn drop_unconfirmed(view: &mut View<'_>) {
    for (turns, words) in view.turns.iter_mut().zip(&mut view.words) {
        if words.good() == 0 {
            (*turns, *words) = (NONE, Words::default());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{MOST_STEPS, node_of, priority};
    use proptest::prelude::*;
    use std::cmp::Reverse;

    proptest! {
        /// Far from steps first, then few steps, then the first node: whatever the numbers, also where they are equal.
        #[test]
        fn priorities_are_in_the_order_that_they_stand_for(
            a in (0u8..=10, 0u32..40, 0u32..40),
            b in (0u8..=10, prop_oneof![0u32..40, Just(MOST_STEPS)], prop_oneof![0u32..40, Just(u32::MAX)]),
        ) {
            let order = |(clearance, steps, node): (u8, u32, u32)| (clearance, Reverse(steps), Reverse(node));
            let of = |(clearance, steps, node)| priority(clearance, steps, node);
            prop_assert_eq!(of(a).cmp(&of(b)), order(a).cmp(&order(b)));
            prop_assert_eq!((node_of(of(a)), node_of(of(b))), (a.2 as usize, b.2 as usize));
        }
    }
}
