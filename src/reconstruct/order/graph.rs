//! The nodes of a view as a graph: what touches each of them, and how wide the surface around it is.

use super::borders::Border;
use super::cells::Cells;

/// Pixels of a node that fills its cell. Where a row of the image is several of the sensor, a cell covers as many times the surface,
/// and what is narrow fills fewer of its pixels.
const FULL_NODE_PX: u32 = 60;
const FULL_NODE_PX_OF_PAIRS: u32 = 40;

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

/// Whether nearly all pixel pairs of a border continue.
pub fn is_clean(good: u32, bad: u32) -> bool {
    good >= CLEAN_PAIRS && bad <= 1
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
    /// Sorts the borders by node. A row of the image is `sensor_rows` of the sensor.
    pub fn new(cells: &Cells, sensor_rows: usize) -> Self {
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
        graph.measure(cells, if sensor_rows > 1 { FULL_NODE_PX_OF_PAIRS } else { FULL_NODE_PX });
        graph
    }

    /// Finds the clearance of all nodes, ring by ring from those that have none. A node of so many pixels fills its cell.
    fn measure(&mut self, cells: &Cells, full_px: u32) {
        let n = cells.nodes.len();
        let full: Vec<bool> = cells.nodes.iter().map(|x| x.size >= full_px).collect();
        let continues = |e: &&Edge| is_clean(e.good, e.bad) && full[e.other as usize];
        let mut inside: Vec<bool> =
            (0..n).map(|i| full[i] && self.of(i).iter().filter(continues).count() == 4).collect();
        self.clearance = inside.iter().map(|&inside| if inside { WIDEST } else { 0 }).collect();
        let mut ring: Vec<u32> = (0..n as u32).filter(|&i| !inside[i as usize]).collect();
        for step in 1..WIDEST {
            let mut next = Vec::new();
            for &node in &ring {
                let place = self.start[node as usize] as usize..self.start[node as usize + 1] as usize;
                for edge in self.edges[place].iter().filter(|e| is_clean(e.good, e.bad)) {
                    let other = edge.other as usize;
                    if inside[other] && full[node as usize] {
                        inside[other] = false;
                        self.clearance[other] = step;
                        next.push(edge.other);
                    }
                }
            }
            ring = next;
        }
    }

    /// Nodes.
    pub fn len(&self) -> usize {
        self.clearance.len()
    }

    /// The borders of a node.
    pub fn of(&self, node: usize) -> &[Edge] {
        &self.edges[self.start[node] as usize..self.start[node + 1] as usize]
    }
}
