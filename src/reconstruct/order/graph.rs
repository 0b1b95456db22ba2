//! The nodes of a view as a graph: what touches each of them, and how wide the surface around it is.

use super::cells::{Border, Cells};

/// Pixels of a node that fills its cell.
const FULL_NODE_PX: u32 = 60;

/// Pixel pairs on which a border between cells must agree to be clean, of eight.
const CLEAN_PAIRS: u32 = 7;

/// Surfaces wider than this are all alike, nodes.
const WIDEST: u8 = 10;

/// A border as one of its nodes sees it.
#[derive(Debug, Clone, Copy, Default)]
pub struct Edge {
    /// The node on the other side.
    pub other: u32,
    /// Whole turns to add to the phases of the other so that they continue this one's.
    pub turns: i32,
    /// Pixel pairs that continue with these turns.
    pub good: u32,
    /// Pixel pairs that do not.
    pub bad: u32,
}

/// The borders of every node.
#[derive(Debug)]
pub struct Graph {
    start: Vec<u32>,
    edges: Vec<Edge>,
    /// Steps from each node to the nearest that is not whole, or that does not continue on all four sides.
    pub clearance: Vec<u8>,
}

impl Graph {
    /// Sorts the borders by node.
    pub fn new(cells: &Cells) -> Self {
        let n = cells.nodes.len();
        let mut start = vec![0u32; n + 1];
        for x in &cells.borders {
            start[x.a as usize + 1] += 1;
            start[x.b as usize + 1] += 1;
        }
        for i in 0..n {
            start[i + 1] += start[i];
        }
        let mut place = start.clone();
        let mut edges = vec![Edge::default(); start[n] as usize];
        for &Border { a, b, turns, good, bad } in &cells.borders {
            for (from, other, turns) in [(a, b, turns), (b, a, -turns)] {
                let at = &mut place[from as usize];
                edges[*at as usize] = Edge { other, turns, good, bad };
                *at += 1;
            }
        }
        let mut graph = Self { start, edges, clearance: vec![0; n] };
        let mut inside: Vec<bool> = cells.nodes.iter().map(|x| x.size >= FULL_NODE_PX).collect();
        for step in 1..=WIDEST {
            let clean = |e: &&Edge| e.good >= CLEAN_PAIRS && e.bad <= 1 && inside[e.other as usize];
            let next: Vec<bool> =
                (0..n).map(|i| inside[i] && graph.of(i).iter().filter(clean).count() == 4).collect();
            for (clearance, _) in graph.clearance.iter_mut().zip(&next).filter(|x| *x.1) {
                *clearance = step;
            }
            inside = next;
        }
        graph
    }

    /// The borders of a node.
    pub fn of(&self, node: usize) -> &[Edge] {
        &self.edges[self.start[node] as usize..self.start[node + 1] as usize]
    }
}
