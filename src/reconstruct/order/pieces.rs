//! Pieces of surface: nodes that continue each other over their whole common border.
//!
//! Where the outline of a limb crosses the fringes, the phases on both sides agree over a short stretch by chance, to any
//! precision. What tells chance from surface is the rest of the border: two pieces of one surface continue each other all
//! along it. So the wide parts of a view are grown first (their cores, away from any step, then what continues them), and
//! pieces are joined only where nearly the whole border between them agrees on the same turns.

use super::cells::Cells;
use super::graph::{Graph, is_clean};
use std::collections::BTreeMap;

/// Nodes of a core are so many cells away from any step, where a cell has as many rows of the sensor as columns.
pub const CORE_CLEARANCE: u8 = 2;

/// Pixel pairs on which a node must agree with the piece that takes it in.
const GROW_PAIRS: u32 = 4;

/// Pairs on which it agrees must outnumber those on which it does not so many times.
const GROW_SHARE: u32 = 2;

/// Share of a common border that must agree before two pieces become one.
const MIN_GOOD_SHARE: f32 = 0.85;

/// Pixel pairs that must agree before two pieces become one.
const MIN_GOOD_PAIRS: u32 = 12;

/// Where two pieces touch.
#[derive(Debug, Clone, Default)]
pub struct Contact {
    /// Pixel pairs that continue each other, by the turns to add to the second piece.
    pub good: Vec<(i32, u32)>,
    /// All pixel pairs.
    pub all: u32,
}

impl Contact {
    fn add(&mut self, turns: i32, good: u32, all: u32) {
        self.all += all;
        if good > 0 {
            match self.good.iter_mut().find(|x| x.0 == turns) {
                Some(x) => x.1 += good,
                None => self.good.push((turns, good)),
            }
        }
    }

    /// The turns that most pairs agree on, and how many.
    pub fn best(&self) -> (i32, u32) {
        self.good.iter().copied().max_by_key(|x| (x.1, -x.0.abs(), x.0)).unwrap_or((0, 0))
    }
}

/// A view's pieces.
#[derive(Debug)]
pub struct Pieces {
    /// Piece of each node.
    pub of: Vec<u32>,
    /// Turns to add to each node's phases so that they continue those of its piece.
    pub turns: Vec<i32>,
    /// Nodes of each piece.
    pub nodes: Vec<Vec<u32>>,
    /// Which piece each was part of before it was parted.
    pub origin: Vec<u32>,
    /// Whether a node lies two cells or more away from any step.
    pub core: Vec<bool>,
    /// Marker votes of single nodes: node, order, number.
    node_votes: Vec<(u32, i32, u32)>,
    /// Marker votes of each piece: for each order, how many.
    pub votes: Vec<BTreeMap<i32, u32>>,
    /// Contacts of each piece with others: turns to add to the other.
    pub contacts: Vec<BTreeMap<u32, Contact>>,
}

impl Pieces {
    /// Grows and joins the pieces. `votes` are those of single nodes: node, order, number; nodes of a core are `core_clearance` cells
    /// away from any step.
    pub fn new(
        cells: &Cells,
        graph: &Graph,
        votes: &[(u32, i32, u32)],
        min_votes: u32,
        core_clearance: u8,
    ) -> Self {
        let mut links = Links::new(cells.nodes.len());
        let core: Vec<bool> = graph.clearance.iter().map(|&x| x >= core_clearance).collect();
        for x in cells.borders.iter().filter(|x| core[x.a as usize] && core[x.b as usize]) {
            if is_clean(x.good, x.bad) {
                links.join(x.a as usize, x.b as usize, x.turns);
            }
        }
        grow(&mut links, &core, cells, graph);
        let mut pieces = collect(&mut links, cells, votes);
        pieces.join(min_votes);
        let mut pieces = pieces.compact();
        pieces.origin = (0..pieces.nodes.len() as u32).collect();
        pieces.core = core;
        pieces
    }

    /// The pixels of each piece, px of the sensor, of which a row of the image is so many rows.
    pub fn px(&self, cells: &Cells, sensor_rows: usize) -> Vec<u32> {
        let size = |nodes: &Vec<u32>| nodes.iter().map(|&x| cells.nodes[x as usize].size).sum::<u32>();
        self.nodes.iter().map(|nodes| size(nodes) * sensor_rows as u32).collect()
    }

    /// Counts votes and contacts anew.
    fn count(&mut self, cells: &Cells) {
        self.votes = vec![BTreeMap::new(); self.nodes.len()];
        self.contacts = vec![BTreeMap::new(); self.nodes.len()];
        for &(node, order, count) in &self.node_votes {
            let (piece, turns) = (self.of[node as usize], self.turns[node as usize]);
            *self.votes[piece as usize].entry(order - turns).or_default() += count;
        }
        for x in &cells.borders {
            let (a, b) = (self.of[x.a as usize], self.of[x.b as usize]);
            if a == b {
                continue;
            }
            let turns = self.turns[x.a as usize] + x.turns - self.turns[x.b as usize];
            self.contacts[a as usize].entry(b).or_default().add(turns, x.good, x.good + x.bad);
            self.contacts[b as usize].entry(a).or_default().add(-turns, x.good, x.good + x.bad);
        }
    }

    /// Makes pieces of the parts of one: the first keeps its number, the others get new ones.
    pub fn part(&mut self, piece: usize, parts: Vec<Vec<u32>>, cells: &Cells) {
        for (i, nodes) in parts.into_iter().enumerate() {
            let number = if i == 0 { piece } else { self.nodes.len() };
            for &node in &nodes {
                self.of[node as usize] = number as u32;
            }
            if i == 0 {
                self.nodes[piece] = nodes;
            } else {
                self.nodes.push(nodes);
                self.origin.push(self.origin[piece]);
            }
        }
        self.count(cells);
    }

    /// Joins pieces whose common border agrees, the longest first.
    fn join(&mut self, min_votes: u32) {
        loop {
            let mut best: Option<(u32, usize, u32, i32)> = None;
            for (a, contacts) in self.contacts.iter().enumerate() {
                for (&b, contact) in contacts.range(a as u32 + 1..) {
                    let (turns, good) = contact.best();
                    if good >= MIN_GOOD_PAIRS
                        && good as f32 >= MIN_GOOD_SHARE * contact.all as f32
                        && best.is_none_or(|x| good > x.0)
                        && !self.contradict(a, b as usize, turns, min_votes)
                    {
                        best = Some((good, a, b, turns));
                    }
                }
            }
            let Some((_, a, b, turns)) = best else { return };
            self.absorb(a, b as usize, turns);
        }
    }

    /// Whether markers say that two pieces are not one surface.
    fn contradict(&self, a: usize, b: usize, turns: i32, min_votes: u32) -> bool {
        let of =
            |piece: usize| self.votes[piece].iter().max_by_key(|x| (x.1, x.0)).filter(|x| *x.1 >= min_votes);
        // Phases of `b` gain `turns` in `a`: the order that its votes give loses as many.
        of(a).zip(of(b)).is_some_and(|(x, y)| *x.0 != *y.0 - turns)
    }

    /// Makes `b` part of `a`.
    fn absorb(&mut self, a: usize, b: usize, turns: i32) {
        let nodes = std::mem::take(&mut self.nodes[b]);
        for &node in &nodes {
            self.of[node as usize] = a as u32;
            self.turns[node as usize] += turns;
        }
        self.nodes[a].extend(nodes);
        for (order, votes) in std::mem::take(&mut self.votes[b]) {
            *self.votes[a].entry(order - turns).or_default() += votes;
        }
        for (c, contact) in std::mem::take(&mut self.contacts[b]) {
            self.contacts[c as usize].remove(&(b as u32));
            if c as usize == a {
                continue;
            }
            // From b's turns to a's, and the same seen from c.
            let to = self.contacts[a].entry(c).or_default();
            to.all += contact.all;
            for &(t, good) in &contact.good {
                to.add(t + turns, good, 0);
            }
            let back = self.contacts[c as usize].entry(a as u32).or_default();
            back.all += contact.all;
            for &(t, good) in &contact.good {
                back.add(-(t + turns), good, 0);
            }
        }
    }

    /// Leaves out the numbers of absorbed pieces.
    fn compact(mut self) -> Self {
        let mut number = vec![u32::MAX; self.nodes.len()];
        let mut next = 0;
        for (piece, nodes) in self.nodes.iter().enumerate() {
            if !nodes.is_empty() {
                number[piece] = next;
                next += 1;
            }
        }
        for piece in &mut self.of {
            *piece = number[*piece as usize];
        }
        let keep = |piece: usize| number[piece] != u32::MAX;
        let (mut i, mut j, mut k) = (0..number.len(), 0..number.len(), 0..number.len());
        self.nodes.retain(|_| i.next().is_some_and(keep));
        self.votes.retain(|_| j.next().is_some_and(keep));
        self.contacts.retain(|_| k.next().is_some_and(keep));
        for contacts in &mut self.contacts {
            *contacts = std::mem::take(contacts).into_iter().map(|(c, x)| (number[c as usize], x)).collect();
        }
        self
    }
}

/// What the neighbours of a node in one piece say about it.
#[derive(Debug, Default)]
struct Sum {
    /// Root of the piece, and the turns that the node would need there.
    to: (usize, i32),
    good: u32,
    bad: u32,
    /// One of them, and the turns that continue it.
    other: u32,
    turns: i32,
}

/// Lets the cores take in what continues them, ring by ring; what no core reaches is joined among itself.
fn grow(links: &mut Links, core: &[bool], cells: &Cells, graph: &Graph) {
    let mut taken = core.to_vec();
    let mut sums: Vec<Sum> = Vec::new();
    let mut grow = |links: &mut Links, taken: &mut [bool], from: &[bool], pairs: u32| {
        // Sought from what is open, which is less than what is taken.
        let open = (0..taken.len() as u32).filter(|&i| !taken[i as usize]);
        let is_beside = |&i: &u32| graph.of(i as usize).iter().any(|x| from[x.other as usize]);
        let mut next: Vec<u32> = open.filter(is_beside).collect();
        while !next.is_empty() {
            // All of a ring are decided before any is taken in: the result does not depend on their order.
            let mut ring = Vec::new();
            for &node in &next {
                sums.clear();
                for edge in graph.of(node as usize).iter().filter(|x| taken[x.other as usize]) {
                    let (root, own) = links.find(edge.other as usize);
                    let to = (root, own - edge.turns);
                    let place = sums.iter().position(|x| x.to == to).unwrap_or(sums.len());
                    if place == sums.len() {
                        sums.push(Sum { to, ..Sum::default() });
                    }
                    let sum = &mut sums[place];
                    (sum.good, sum.bad) = (sum.good + edge.good, sum.bad + edge.bad);
                    (sum.other, sum.turns) = (edge.other, edge.turns);
                }
                let best = sums.iter().max_by_key(|x| (x.good, x.to));
                let best = best.filter(|x| x.good >= pairs && (pairs == 1 || x.good >= GROW_SHARE * x.bad));
                ring.extend(best.map(|x| (node, x.other, x.turns)));
            }
            for &(node, other, turns) in &ring {
                // `turns` continue the other from this node; the link says the reverse.
                links.join(other as usize, node as usize, -turns);
                taken[node as usize] = true;
            }
            let beside = ring.iter().flat_map(|x| graph.of(x.0 as usize)).map(|x| x.other);
            next.clear();
            next.extend(beside.filter(|&i| !taken[i as usize]));
            next.sort_unstable();
            next.dedup();
        }
    };
    grow(links, &mut taken, core, GROW_PAIRS);
    for x in &cells.borders {
        if !taken[x.a as usize] && !taken[x.b as usize] && x.good >= GROW_PAIRS && x.good > x.bad {
            links.join(x.a as usize, x.b as usize, x.turns);
        }
    }
    // Crumbs on outlines belong to no surface. They must not stand between pieces as if these did not touch. What is not taken is joined
    // to nothing that is.
    let reached = taken.clone();
    let open = || (0..reached.len()).filter(|&i| !reached[i]);
    let mut size = vec![0u32; taken.len()];
    open().for_each(|node| size[links.find(node).0] += cells.nodes[node].size);
    open().for_each(|node| taken[node] = size[links.find(node).0] >= 64);
    grow(links, &mut taken, &reached, 1);
}

fn collect(links: &mut Links, cells: &Cells, votes: &[(u32, i32, u32)]) -> Pieces {
    let n = cells.nodes.len();
    let mut number = vec![u32::MAX; n];
    let mut pieces = Pieces {
        of: vec![0; n],
        turns: vec![0; n],
        nodes: Vec::new(),
        origin: Vec::new(),
        core: Vec::new(),
        node_votes: votes.to_vec(),
        votes: Vec::new(),
        contacts: Vec::new(),
    };
    for node in 0..n {
        let (root, turns) = links.find(node);
        if number[root] == u32::MAX {
            number[root] = pieces.nodes.len() as u32;
            pieces.nodes.push(Vec::new());
        }
        pieces.of[node] = number[root];
        pieces.turns[node] = turns;
        pieces.nodes[number[root] as usize].push(node as u32);
    }
    pieces.count(cells);
    pieces
}

/// Union-find whose links carry whole turns.
struct Links {
    parent: Vec<u32>,
    /// Turns to add to a node so that it continues its parent.
    turns: Vec<i32>,
}

impl Links {
    fn new(n: usize) -> Self {
        Self { parent: (0..n as u32).collect(), turns: vec![0; n] }
    }

    /// Root of a node, and the turns to add to the node so that it continues the root.
    #[inline]
    fn find(&mut self, node: usize) -> (usize, i32) {
        // Most are linked to their root.
        let next = self.parent[node] as usize;
        if self.parent[next] as usize == next { (next, self.turns[node]) } else { self.shorten(node) }
    }

    /// The same, along as many links as there are, each of which leads to the root then.
    fn shorten(&mut self, node: usize) -> (usize, i32) {
        let (mut root, mut turns) = (node, 0);
        while self.parent[root] as usize != root {
            turns += self.turns[root];
            root = self.parent[root] as usize;
        }
        let (mut at, mut rest) = (node, turns);
        while at != root {
            let (next, own) = (self.parent[at] as usize, self.turns[at]);
            (self.parent[at], self.turns[at]) = (root as u32, rest);
            rest -= own;
            at = next;
        }
        (root, turns)
    }

    /// Joins the trees of `a` and `b`, where `b` needs `turns` to continue `a`. Nothing happens where they are one.
    fn join(&mut self, a: usize, b: usize, turns: i32) {
        let ((x, turns_a), (y, turns_b)) = (self.find(a), self.find(b));
        if x != y {
            self.parent[y] = x as u32;
            self.turns[y] = turns_a + turns - turns_b;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::cells::Surface;
    use super::{CORE_CLEARANCE, Cells, Graph, Pieces};
    use crate::image::Plane;
    use crate::reconstruct::runs::Runs;
    use std::f32::consts::TAU;

    const W: usize = 240;
    const H: usize = 240;
    const PERIOD: f32 = 10.0;

    /// Pieces of at least ten nodes of a phase that rises by a fringe every ten columns, plus `extra`.
    fn pieces(extra: impl Fn(usize, usize) -> f32) -> (Cells, Pieces, Vec<usize>) {
        let data = (0..W * H).map(|i| (i % W) as f32 * TAU / PERIOD + extra(i % W, i / W)).collect();
        let phase = Plane::from_vec(W, H, data).expect("the plane's size");
        let (object, period) = (Plane::filled(W, H, 1), Plane::filled(W, H, PERIOD));
        let runs = Runs::of(&object);
        let surface = Surface { phase: &phase, period: &period, runs: &runs, sign: 1.0, sensor_rows: 1.0 };
        let cells = Cells::new(&surface);
        let pieces = Pieces::new(&cells, &Graph::new(&cells, 1), &[], 20, CORE_CLEARANCE);
        let large = (0..pieces.nodes.len()).filter(|&i| pieces.nodes[i].len() >= 10).collect();
        (cells, pieces, large)
    }

    #[test]
    fn a_smooth_surface_is_one_piece_though_its_trees_differ_by_whole_turns() {
        let (_, pieces, large) = pieces(|u, v| {
            let bend = ((u as f32 / 60.0).sin() + (v as f32 / 50.0).cos()) * 2.0;
            bend + if v > 120 { 3.0 * TAU } else { 0.0 }
        });
        assert_eq!(large.len(), 1);
        let (upper, lower) = (pieces.turns[0], pieces.turns[pieces.turns.len() - 1]);
        assert_eq!(upper - lower, 3);
    }

    /// Along their border, the phases of the two halves drift through two whole turns: over some 20 px, twice, they agree
    /// to 0.3 rad. Neighbouring pixels alone cannot tell that this is chance.
    #[test]
    fn surfaces_that_agree_over_part_of_their_border_stay_apart() {
        let (_, pieces, large) =
            pieces(|u, v| if v >= 120 { (u as f32 / W as f32 - 0.5) * 2.0 * TAU } else { 0.0 });
        assert_eq!(large.len(), 2, "{:?}", large.iter().map(|&i| pieces.nodes[i].len()).collect::<Vec<_>>());
    }

    #[test]
    fn parts_keep_their_nodes_and_know_where_they_come_from() {
        let (cells, mut pieces, large) = pieces(|_, _| 0.0);
        let piece = large[0];
        let nodes = pieces.nodes[piece].clone();
        let (left, right): (Vec<u32>, Vec<u32>) = nodes.iter().partition(|&&x| x % 30 < 15);
        pieces.part(piece, vec![left.clone(), right.clone()], &cells);
        let new = pieces.nodes.len() - 1;
        assert_eq!((&pieces.nodes[piece], &pieces.nodes[new]), (&left, &right));
        assert_eq!(pieces.origin[new], pieces.origin[piece]);
        assert!(right.iter().all(|&x| pieces.of[x as usize] as usize == new));
        let contact = &pieces.contacts[piece][&(new as u32)];
        assert_eq!(contact.best(), (0, contact.all));
    }
}
