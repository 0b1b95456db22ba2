//! From settled pieces to the fringe order of every node.
//!
//! The cores of settled pieces that other cameras confirm are where it begins. From there the orders grow over the view,
//! node by node, along borders that continue: over wide surfaces first, so that what comes along a limb is there before what
//! comes over the seam on which limb and trunk agree by chance. Then all that has an order is tried against all
//! the others. What is contradicted, or has a neighbour that continues it at another order, loses its order; so does, until the
//! last round, what nobody confirms. What is open then is sought at the places where other heads see it
//! ([`super::elsewhere`]), and the next round begins. It ends when all views hold what they have held in an earlier round.

use super::around::Around;
use super::elsewhere::Seeker;
use super::finish;
use super::graph::Graph;
use super::jury::Known;
use super::mutual;
use super::settle::{Scene, all_nodes};
use super::words::{Changed, Sights, Words};
use crate::reconstruct::simd;
use rayon::prelude::*;
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// No order.
pub const NONE: i32 = i32::MIN;

/// Rounds of growing and trying, at most: few triggers need more than ten until nothing is new.
const MAX_ROUNDS: usize = 24;

/// The least lead of a piece's order for its cores to be a beginning.
const MIN_MARGIN: f32 = 0.5;

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

/// What the neighbours of an open node propose for it, as far as it tells in which passes something can come of it: a bit for each
/// pass in which a border is good enough, and these.
type Chance = u8;

/// A neighbour has an order.
const TOUCHED: Chance = 1 << PASSES.len();

/// Nobody has asked since a neighbour has changed.
const UNASKED: Chance = 1 << 7;

/// A view while orders grow over it.
#[derive(Debug)]
pub struct View<'a> {
    /// Its nodes and borders.
    pub graph: &'a Graph,
    /// Whole turns that make each node's phases absolute, or [`NONE`].
    turns: Vec<i32>,
    /// What the other cameras say of each node, as of the last time that it was tried.
    words: Vec<Words>,
    /// Nodes that were given turns, or lost them, since the last check began. What each has is to be noted by [`Known`] from one of
    /// them on.
    touched: Vec<u32>,
    unknown: usize,
    /// Turns and words of each node as of the last check.
    checked: Vec<(i32, Words)>,
    /// What is said around the nodes, as of the end of the last check.
    pub around: Around,
    /// The nodes without an order that may get one in this round, those first that are farthest from any step.
    open: Vec<u32>,
    chances: Vec<Chance>,
    /// Turns that were contradicted in this round: node, turns.
    banned: Banned,
    /// What the cameras have at its places.
    pub sights: Sights,
    /// Steps of growth that lead to each node, and whether nothing has been asked of it since what is around it has changed: while orders
    /// grow; afterwards none.
    steps: Vec<u32>,
    fresh: Vec<bool>,
}

/// Turns that were contradicted: of most nodes none, of few more than one.
#[derive(Debug)]
struct Banned {
    /// The last one of each node, and 1 more than where it stands; 0 for none.
    last: Vec<u32>,
    /// Turns of a node, and the same for the one before.
    turns: Vec<(i32, u32)>,
    nodes: Vec<u32>,
}

impl Banned {
    fn new(nodes: usize) -> Self {
        Self { last: vec![0; nodes], turns: Vec::new(), nodes: Vec::new() }
    }

    fn add(&mut self, node: usize, turns: i32) {
        self.turns.push((turns, self.last[node]));
        self.last[node] = self.turns.len() as u32;
        self.nodes.push(node as u32);
    }

    fn contains(&self, node: usize, turns: i32) -> bool {
        let mut at = self.last[node];
        while at != 0 {
            let (banned, before) = self.turns[at as usize - 1];
            if banned == turns {
                return true;
            }
            at = before;
        }
        false
    }

    fn clear(&mut self) {
        self.nodes.drain(..).for_each(|node| self.last[node as usize] = 0);
        self.turns.clear();
    }
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
    known.update(views.iter().map(|view| &view.turns[..]));
    check(scenes, &mut views, &mut known);
    views.par_iter_mut().for_each(drop_unconfirmed);
    let mut seeker = Seeker::new(scenes);
    // What was known of all nodes after each round.
    let mut held: Vec<Vec<i32>> = Vec::new();
    loop {
        views.par_iter_mut().for_each(View::reopen);
        for pass in 0..PASSES.len() {
            update(&mut known, &mut views);
            views
                .par_iter_mut()
                .zip(scenes)
                .for_each(|(view, scene)| grow(scenes, scene, view, &known, pass));
        }
        check(scenes, &mut views, &mut known);
        update(&mut known, &mut views);
        // As after the round before, or an earlier one: views can also go round in a circle.
        if held.len() + 1 == MAX_ROUNDS || held.iter().any(|before| before == known.turns()) {
            break;
        }
        held.push(known.turns().to_vec());
        seeker.seek(scenes, &mut views, &known);
        views.par_iter_mut().for_each(drop_unconfirmed);
    }
    let labels = views.par_iter_mut().enumerate();
    let mut labels: Vec<Vec<Label>> =
        labels.map(|(number, view)| finish::labels(number, view, scenes, &known)).collect();
    let turns: Vec<Vec<i32>> =
        labels.iter().map(|labels| labels.iter().map(|label| label.turns).collect()).collect();
    known.update(turns.iter().map(|turns| &turns[..]));
    mutual::place(scenes, &mut views, &mut known, &mut labels);
    let views = views.par_iter_mut().zip(&mut labels).enumerate();
    views.for_each(|(number, (view, labels))| finish::stretches(number, view, scenes, &known, labels));
    labels
}

/// Takes note of the orders of all views that have changed since this was done last.
fn update(known: &mut Known, views: &mut [View<'_>]) {
    let mut first = 0;
    for view in views {
        for &node in &view.touched[view.unknown..] {
            known.set(first + node as usize, view.turns[node as usize]);
        }
        view.unknown = view.touched.len();
        first += view.turns.len();
    }
}

impl View<'_> {
    /// The turns of a node, or [`NONE`].
    pub fn turns(&self, node: usize) -> i32 {
        self.turns[node]
    }

    /// What the other cameras say of it.
    pub fn words(&self, node: usize) -> Words {
        self.words[node]
    }

    /// Gives a node turns, for which the other cameras have these words.
    pub fn set(&mut self, node: usize, turns: i32, words: Words) {
        (self.turns[node], self.words[node]) = (turns, words);
        self.touched.push(node as u32);
        for edge in self.graph.of(node) {
            self.chances[edge.other as usize] = UNASKED;
        }
    }

    /// Takes its turns from it.
    pub fn unset(&mut self, node: usize) {
        self.set(node, NONE, Words::default());
    }

    /// Whether an order of it was contradicted in the last round.
    pub fn is_contradicted(&self, node: usize) -> bool {
        self.banned.last[node] != 0
    }

    /// Begins a round: nothing is contradicted yet.
    fn reopen(&mut self) {
        self.banned.clear();
        self.open.clear();
        let nodes = self.turns.iter().enumerate().filter(|(_, turns)| **turns == NONE);
        self.open.extend(nodes.map(|(node, _)| node as u32));
        self.open.sort_by_key(|&node| Reverse(self.graph.clearance[node as usize]));
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
    let mut sights = Sights::new(scenes, view);
    // Most nodes are asked at their piece's order at last.
    sights.prepare(scenes, &scene.settled, 0..n as u32);
    let turns: Vec<i32> = (0..n).map(order).collect();
    let touched: Vec<u32> = (0..n as u32).filter(|&node| turns[node as usize] != NONE).collect();
    View {
        graph: &scene.graph,
        turns,
        words: vec![Words::default(); n],
        unknown: touched.len(),
        touched,
        checked: vec![(NONE, Words::default()); n],
        around: Around::new(n),
        open: Vec::new(),
        chances: vec![UNASKED; n],
        banned: Banned::new(n),
        sights,
        steps: vec![0; n],
        fresh: vec![false; n],
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

impl Proposal {
    /// Whether the border is as good as a pass asks.
    fn is_enough(&self, pass: Pass) -> bool {
        self.good >= pass.pairs && self.good >= pass.share * self.bad
    }
}

/// Lets the orders grow over a view: always to the node that is farthest from any step.
fn grow(scenes: &[Scene<'_>], scene: &Scene<'_>, view: &mut View<'_>, known: &Known, number: usize) {
    let (pass, graph) = (PASSES[number], view.graph);
    let mut proposals = Vec::new();
    let mut open = std::mem::take(&mut view.open);
    let mut first = Vec::with_capacity(open.len());
    for &node in &open {
        let at = node as usize;
        if graph.clearance[at] < pass.clearance {
            break;
        }
        if view.chances[at] == UNASKED {
            propose(view, at, &mut proposals);
        }
        if view.chances[at] & TOUCHED != 0 {
            view.fresh[at] = true;
            first.push(priority(graph.clearance[at], 0, node));
        }
    }
    // These are in order already; the others come between them.
    let mut first = first.into_iter().peekable();
    let mut heap = BinaryHeap::new();
    let begin = view.touched.len();
    while let Some(next) = first.peek().max(heap.peek()).copied() {
        if first.next_if_eq(&next).is_none() {
            heap.pop();
        }
        let node = node_of(next);
        if view.turns[node] != NONE || !std::mem::take(&mut view.fresh[node]) {
            continue;
        }
        let chance = view.chances[node];
        if chance != UNASKED && chance >> number & 1 == 0 {
            continue;
        }
        let step = propose(view, node, &mut proposals) + 1;
        for proposal in &proposals {
            if !proposal.is_enough(pass) || view.banned.contains(node, proposal.turns) {
                continue;
            }
            let own = view.sights.words(scenes, node, proposal.turns, known);
            let mut sum = own;
            sum += proposal.around;
            if contradicted(own, sum, scene.pieces.core[node]) {
                view.banned.add(node, proposal.turns);
                continue;
            }
            let supported = match pass.support {
                Support::None => true,
                Support::Near => sum.good() > 0,
                Support::Here => own.good() > 0,
            };
            if supported {
                view.set(node, proposal.turns, own);
                view.steps[node] = step;
                for edge in graph.of(node) {
                    let other = edge.other as usize;
                    if view.turns[other] == NONE && graph.clearance[other] >= pass.clearance {
                        view.fresh[other] = true;
                        heap.push(priority(graph.clearance[other], step, edge.other));
                    }
                }
                break;
            }
        }
    }
    view.touched[begin..].iter().for_each(|&node| view.steps[node as usize] = 0);
    open.retain(|&node| view.turns[node as usize] == NONE);
    view.open = open;
}

/// The orders that the neighbours of an open node propose, those of most pixel pairs first, and what chance it has; the steps that the
/// farthest of these neighbours is from where growth began.
fn propose(view: &mut View<'_>, node: usize, proposals: &mut Vec<Proposal>) -> u32 {
    proposals.clear();
    let (mut chance, mut farthest) = (0, 0);
    for edge in view.graph.of(node) {
        let at = edge.other as usize;
        let other = view.turns[at];
        if other == NONE {
            continue;
        }
        chance = TOUCHED;
        if edge.good == 0 {
            continue;
        }
        farthest = farthest.max(view.steps[at]);
        let (turns, around) = (other - edge.turns, view.words[at]);
        match proposals.iter_mut().find(|x| x.turns == turns) {
            Some(x) => {
                (x.good, x.bad) = (x.good + edge.good, x.bad + edge.bad);
                x.around += around;
            }
            None => proposals.push(Proposal { turns, good: edge.good, bad: edge.bad, around }),
        }
    }
    if proposals.len() > 1 {
        proposals.sort_unstable_by_key(|x| (Reverse(x.good), x.turns));
    }
    for proposal in &*proposals {
        for (number, &pass) in PASSES.iter().enumerate() {
            chance |= Chance::from(proposal.is_enough(pass)) << number;
        }
    }
    view.chances[node] = chance;
    farthest
}

/// Whether the other cameras contradict: what they say of the place itself, and of it and what is around.
fn contradicted(own: Words, sum: Words, core: bool) -> bool {
    if sum.against >= 3 && sum.against > sum.good() {
        return true;
    }
    !core && own.against > 0 && own.against >= own.good()
}

/// Words, of the head's other camera or at an outline of other heads, that stand against a neighbour of another order.
pub const FIRM: i16 = 6;

/// Tries all that has an order against all that has, and takes it from what is contradicted.
fn check(scenes: &[Scene<'_>], views: &mut [View<'_>], known: &mut Known) {
    update(known, views);
    let known = &*known;
    let mut changed = Changed::new(all_nodes(scenes) as usize, views.len());
    let mut first = 0;
    for (number, view) in views.iter().enumerate() {
        for node in view.touched.iter().map(|&node| node as usize) {
            if view.turns[node] != view.checked[node].0 {
                changed.add(number, first + node);
            }
        }
        first += view.turns.len();
    }
    views.par_iter_mut().zip(scenes).for_each(|(view, scene)| try_all(scenes, scene, view, known, &changed));
}

/// The same of one view. `changed`: the nodes of all views that have other turns than at the last check.
fn try_all(scenes: &[Scene<'_>], scene: &Scene<'_>, view: &mut View<'_>, known: &Known, changed: &Changed) {
    let mut touched = std::mem::take(&mut view.touched);
    view.unknown = 0;
    touched.sort_unstable();
    touched.dedup();
    view.sights.prepare(scenes, &view.turns, touched.iter().copied());
    simd::dispatch(
        #[inline(always)]
        || view.sights.renew(&view.turns, &mut view.checked, changed, known, &mut touched),
    );
    for node in touched.iter().map(|&node| node as usize) {
        let (turns, checked) = view.checked[node];
        view.words[node] = if turns == NONE { Words::default() } else { checked };
    }
    view.around.update(view.graph, &touched, &view.turns, &view.words);
    for node in view.around.changed().into_iter().map(|node| node as usize) {
        if view.turns[node] == NONE {
            continue;
        }
        let sum = view.around.words(node);
        if contradicted(view.words[node], sum, scene.pieces.core[node])
            || sum.partner <= FIRM && view.around.conflict(node) > 0
        {
            view.banned.add(node, view.turns[node]);
            view.unset(node);
        }
    }
    view.around.update(view.graph, &view.touched, &view.turns, &view.words);
}

/// Takes the order from nodes that no camera confirms: the next round may reach them from a better side.
fn drop_unconfirmed(view: &mut View<'_>) {
    for node in 0..view.turns.len() {
        if view.words[node].good() == 0 && view.turns[node] != NONE {
            view.unset(node);
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
