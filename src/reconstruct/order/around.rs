//! What is said around each node, kept while orders change: whoever has changed is named, and only what lies within two steps of it
//! is counted anew.

use super::graph::{Edge, Graph};
use super::grow::NONE;
use super::words::Words;

/// Pixel pairs that must continue for words to be shared over a border.
const SHARED_PAIRS: u32 = 4;

/// One in so many nodes that have changed: from there on all are counted anew.
const MANY: usize = 6;

/// A node as its neighbours count it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Own {
    /// [`Words::packed`].
    words: u64,
    turns: i32,
    /// Whether other heads confirm it.
    confirmed: bool,
}

impl Own {
    /// A node without an order.
    const OPEN: Self = Self { words: 0, turns: NONE, confirmed: false };

    fn new(turns: i32, words: Words) -> Self {
        Self { words: words.packed(), turns, confirmed: words.heads > words.against + words.hidden }
    }

    /// Whether the order of a neighbour continues that of a node, which has one, over a border.
    #[inline(always)]
    fn is_continued(&self, other: &Self, edge: &Edge) -> bool {
        other.turns == self.turns + edge.turns
    }
}

/// A node and its neighbours.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Beside {
    /// Words for it and for those that continue it.
    words: u64,
    /// Whether it or one of them is confirmed.
    confirmed: bool,
    /// Whether pixel pairs continue nothing.
    bad: bool,
    /// Pixel pairs on which neighbours continue it, though their order is another; where it has none itself 0.
    conflict: u16,
}

impl Beside {
    fn alone(own: &Own) -> Self {
        Self { words: own.words, confirmed: own.confirmed, bad: false, conflict: 0 }
    }

    /// Adds a neighbour of a node; both have orders. `alike`: whether these continue each other.
    #[inline(always)]
    fn add(&mut self, other: &Own, edge: &Edge, alike: bool) {
        self.bad |= edge.bad > 0;
        if !alike {
            self.conflict += edge.good as u16;
        } else if edge.good >= SHARED_PAIRS {
            self.words += other.words;
            self.confirmed |= other.confirmed;
        }
    }
}

/// A node and those within two steps, along borders that continue.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Within {
    words: u64,
    confirmed: bool,
}

impl Within {
    fn alone(beside: &Beside) -> Self {
        Self { words: beside.words, confirmed: beside.confirmed }
    }

    /// Adds a neighbour that continues the node.
    #[inline(always)]
    fn add(&mut self, other: &Beside) {
        self.words += other.words;
        self.confirmed |= other.confirmed;
    }
}

/// What is said around the nodes of a view.
#[derive(Debug)]
pub struct Around {
    own: Vec<Own>,
    beside: Vec<Beside>,
    within: Vec<Within>,
    /// The nodes around which something has changed since that was asked for, and whether each node is one of them.
    changed: Vec<u32>,
    is_changed: Vec<bool>,
    /// The nodes that are counted anew, and whether each node is one of them.
    ring: Vec<u32>,
    is_in_ring: Vec<bool>,
    /// Borders over which words are shared: while all are counted.
    links: Vec<(u32, u32)>,
}

impl Around {
    /// Around so many nodes without an order.
    pub fn new(nodes: usize) -> Self {
        Self {
            own: vec![Own::OPEN; nodes],
            beside: vec![Beside { words: 0, confirmed: false, bad: false, conflict: 0 }; nodes],
            within: vec![Within { words: 0, confirmed: false }; nodes],
            changed: Vec::new(),
            is_changed: vec![false; nodes],
            ring: Vec::new(),
            is_in_ring: vec![false; nodes],
            links: Vec::new(),
        }
    }

    /// Words for a node and those within two steps, along borders that continue.
    pub fn words(&self, node: usize) -> Words {
        Words::unpacked(self.within[node].words)
    }

    /// Whether other heads confirm it or one of these.
    pub fn is_confirmed(&self, node: usize) -> bool {
        self.within[node].confirmed
    }

    /// Pixel pairs on which neighbours continue a node that has an order, though theirs is another.
    pub fn conflict(&self, node: usize) -> u16 {
        self.beside[node].conflict
    }

    /// Whether pixel pairs between it and neighbours that have an order continue nothing.
    pub fn is_torn(&self, node: usize) -> bool {
        self.beside[node].bad
    }

    /// The nodes for which any of this, or their own words or turns, may have changed since this was last asked.
    pub fn changed(&mut self) -> Vec<u32> {
        self.changed.iter().for_each(|&node| self.is_changed[node as usize] = false);
        std::mem::take(&mut self.changed)
    }

    /// Takes note of the turns and words of some nodes; those of all others must be what they were.
    pub fn update(&mut self, graph: &Graph, nodes: &[u32], turns: &[i32], words: &[Words]) {
        self.ring.clear();
        for &node in nodes {
            let at = node as usize;
            let own = Own::new(turns[at], words[at]);
            if self.own[at] != own {
                self.own[at] = own;
                add(node, &mut self.ring, &mut self.is_in_ring);
            }
        }
        if self.ring.len() * MANY > graph.len() {
            self.is_in_ring.fill(false);
            self.is_changed.fill(true);
            self.changed.clear();
            self.changed.extend(0..graph.len() as u32);
            return self.count(graph);
        }
        self.widen(graph);
        for &node in &self.ring {
            self.beside[node as usize] = beside(graph, &self.own, node as usize);
        }
        self.widen(graph);
        for &node in &self.ring {
            self.within[node as usize] = within(graph, &self.own, &self.beside, node as usize);
            self.is_in_ring[node as usize] = false;
            add(node, &mut self.changed, &mut self.is_changed);
        }
    }

    /// Counts all anew: each border once.
    fn count(&mut self, graph: &Graph) {
        let Self { own, beside, within, links, .. } = self;
        for (beside, own) in beside.iter_mut().zip(&*own) {
            *beside = Beside::alone(own);
        }
        links.clear();
        for (node, is) in own.iter().enumerate().filter(|(_, is)| is.turns != NONE) {
            let mut all = beside[node];
            for edge in graph.of(node).iter().filter(|edge| edge.other as usize > node) {
                let (at, other) = (edge.other as usize, &own[edge.other as usize]);
                if other.turns != NONE {
                    let alike = is.is_continued(other, edge);
                    all.add(other, edge, alike);
                    beside[at].add(is, edge, alike);
                    if alike && edge.good >= SHARED_PAIRS {
                        links.push((node as u32, edge.other));
                    }
                }
            }
            beside[node] = all;
        }
        within.clear();
        within.extend(beside.iter().map(Within::alone));
        for &(a, b) in &*links {
            within[a as usize].add(&beside[b as usize]);
            within[b as usize].add(&beside[a as usize]);
        }
    }

    /// Adds the neighbours of the ring to it.
    fn widen(&mut self, graph: &Graph) {
        for at in 0..self.ring.len() {
            for edge in graph.of(self.ring[at] as usize) {
                add(edge.other, &mut self.ring, &mut self.is_in_ring);
            }
        }
    }
}

/// Adds a node to a list, if it is none of these.
fn add(node: u32, list: &mut Vec<u32>, is_in: &mut [bool]) {
    if !std::mem::replace(&mut is_in[node as usize], true) {
        list.push(node);
    }
}

fn beside(graph: &Graph, own: &[Own], node: usize) -> Beside {
    let is = &own[node];
    let mut all = Beside::alone(is);
    if is.turns != NONE {
        for edge in graph.of(node) {
            let other = &own[edge.other as usize];
            if other.turns != NONE {
                all.add(other, edge, is.is_continued(other, edge));
            }
        }
    }
    all
}

fn within(graph: &Graph, own: &[Own], beside: &[Beside], node: usize) -> Within {
    let (is, mut all) = (&own[node], Within::alone(&beside[node]));
    if is.turns != NONE {
        for edge in graph.of(node) {
            if edge.good >= SHARED_PAIRS && is.is_continued(&own[edge.other as usize], edge) {
                all.add(&beside[edge.other as usize]);
            }
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use super::{Around, NONE};
    use crate::image::Plane;
    use crate::reconstruct::order::cells::{CELL_PX, Cells, Surface};
    use crate::reconstruct::order::graph::Graph;
    use crate::reconstruct::order::words::Words;
    use crate::reconstruct::runs::Runs;
    use proptest::prelude::*;
    use std::f32::consts::TAU;

    /// So many cells in a row and in a column.
    const SIDE: usize = 8;
    const NODES: usize = SIDE * SIDE;

    /// The nodes of a plane with a step, that is somewhere a whole turn and elsewhere part of one.
    fn graph() -> Graph {
        let (px, period) = (CELL_PX * SIDE, 10.0);
        let step = |u: usize, v: usize| if u >= 30 { v as f32 / px as f32 * 2.0 * TAU } else { 0.0 };
        let data = (0..px * px).map(|i| (i % px) as f32 * TAU / period + step(i % px, i / px)).collect();
        let phase = Plane::from_vec(px, px, data).expect("the plane's size");
        let (object, period) = (Plane::filled(px, px, 1), Plane::filled(px, px, period));
        let runs = Runs::of(&object);
        let surface = Surface { phase: &phase, period: &period, runs: &runs, sign: 1.0, sensor_rows: 1.0 };
        Graph::new(&Cells::new(&surface), 1)
    }

    /// A node that changes: which one, its turns, and words.
    fn change() -> impl Strategy<Value = (usize, i32, [i16; 4])> {
        let turns = prop_oneof![1 => Just(NONE), 2 => -1..2i32, 4 => Just(0)];
        (0..NODES, turns, [0i16..3, 0..4, 0..3, 0..2])
    }

    proptest! {
        /// Whatever changes, and in whatever steps.
        #[test]
        fn what_is_kept_is_what_counting_all_anew_gives(
            steps in proptest::collection::vec(proptest::collection::vec(change(), 0..20), 1..12),
        ) {
            let graph = graph();
            let n = graph.len();
            let (mut turns, mut words) = (vec![NONE; n], vec![Words::default(); n]);
            let mut kept = Around::new(n);
            for step in steps {
                let mut nodes = Vec::new();
                for (node, is, [partner, heads, against, hidden]) in step {
                    let said = Words { partner, heads, against, hidden };
                    nodes.push(node as u32);
                    (turns[node], words[node]) = (is, if is == NONE { Words::default() } else { said });
                }
                let was = (kept.own.clone(), kept.beside.clone(), kept.within.clone());
                kept.update(&graph, &nodes, &turns, &words);
                let mut anew = Around::new(n);
                let all: Vec<u32> = (0..n as u32).collect();
                anew.update(&graph, &all, &turns, &words);
                prop_assert_eq!((&kept.own, &kept.beside, &kept.within), (&anew.own, &anew.beside, &anew.within));
                let changed = kept.changed();
                for node in 0..n {
                    let same = was.0[node] == kept.own[node]
                        && was.1[node] == kept.beside[node]
                        && was.2[node] == kept.within[node];
                    prop_assert!(same || changed.contains(&(node as u32)), "node {node} has changed");
                }
            }
        }
    }
}
