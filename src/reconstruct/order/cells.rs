//! The surface of one view in patches: the nodes of the graph in which fringe orders are sought.
//!
//! The image is cut into cells of [`CELL_PX`] squared. Within a cell, pixels whose phases continue each other are one
//! node; where cells meet, the pixel pairs of two nodes tell whether their surfaces continue each other, and by how many
//! whole turns their phases differ.

use crate::image::Plane;
use std::f32::consts::TAU;

/// Side of a cell, px.
pub const CELL_PX: usize = 8;

/// Within a cell, steps this far from the carrier's still continue, rad. Few pixels agree by chance so often that it
/// matters there.
const INNER_RAD: f32 = 0.8;

/// Between nodes, steps this far from what their own slopes predict still continue, rad.
const BORDER_RAD: f32 = 0.3;

/// A patch of one surface.
#[derive(Debug, Clone, Copy)]
pub struct Node {
    /// The pixel that stands for it: its place in the planes.
    pub pixel: u32,
    /// Its pixels.
    pub size: u32,
    /// Mean step to the right beyond the carrier's, rad.
    right: f32,
    /// Mean step down, rad.
    down: f32,
}

/// Where two nodes touch.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Border {
    /// One node.
    pub a: u32,
    /// The other.
    pub b: u32,
    /// Whole turns to add to the phases of `b` so that they continue those of `a`.
    pub turns: i32,
    /// Pixel pairs that continue with these turns.
    pub good: u32,
    /// Pixel pairs that do not.
    pub bad: u32,
}

/// The nodes of a view and where they touch.
#[derive(Debug)]
pub struct Cells {
    /// Number of each pixel's node, plus one; 0 where the phase is unknown.
    pub node: Plane<u32>,
    /// The nodes, cell by cell.
    pub nodes: Vec<Node>,
    /// Their borders.
    pub borders: Vec<Border>,
}

impl Cells {
    /// Cuts `phase` (unwrapped up to whole turns, NaN: unknown) into nodes. `sign` is that of the phase's step along the
    /// row, `period` the local fringe period, px.
    pub fn new(phase: &Plane<f32>, period: &Plane<f32>, sign: f32) -> Self {
        let (w, h) = (phase.width(), phase.height());
        let mut cells = Self { node: Plane::filled(w, h, 0), nodes: Vec::new(), borders: Vec::new() };
        for top in (0..h).step_by(CELL_PX) {
            for left in (0..w).step_by(CELL_PX) {
                cells.cut(phase, period, sign, left, top);
            }
        }
        for top in (0..h).step_by(CELL_PX) {
            for left in (0..w).step_by(CELL_PX) {
                cells.touch(phase, period, sign, left, top);
            }
        }
        cells
    }

    /// The nodes of one cell.
    fn cut(&mut self, phase: &Plane<f32>, period: &Plane<f32>, sign: f32, left: usize, top: usize) {
        let (right, bottom) = ((left + CELL_PX).min(phase.width()), (top + CELL_PX).min(phase.height()));
        let mut parent = [0u8; CELL_PX * CELL_PX];
        let place = |u: usize, v: usize| (v - top) * CELL_PX + (u - left);
        let mut known = false;
        for v in top..bottom {
            let row = phase.row(v);
            for u in left..right {
                let at = place(u, v);
                parent[at] = at as u8;
                if row[u].is_nan() {
                    continue;
                }
                known = true;
                // A comparison with NaN is false: unknown neighbours are not joined.
                if u > left && (row[u] - row[u - 1] - carrier(period, sign, u - 1, v)).abs() < INNER_RAD {
                    join(&mut parent, at - 1, at);
                }
                if v > top && (row[u] - phase.at(u, v - 1)).abs() < INNER_RAD {
                    join(&mut parent, at - CELL_PX, at);
                }
            }
        }
        if !known {
            return;
        }
        let mut number = [0u32; CELL_PX * CELL_PX];
        let first = self.nodes.len();
        let mut sums: [(f32, u32, f32, u32); CELL_PX * CELL_PX] = [(0.0, 0, 0.0, 0); CELL_PX * CELL_PX];
        for v in top..bottom {
            for u in left..right {
                let here = phase.at(u, v);
                if here.is_nan() {
                    continue;
                }
                let root = root(&parent, place(u, v));
                if number[root] == 0 {
                    let pixel = (v * phase.width() + u) as u32;
                    self.nodes.push(Node { pixel, size: 0, right: 0.0, down: 0.0 });
                    number[root] = self.nodes.len() as u32;
                }
                self.node.set(u, v, number[root]);
                let i = number[root] as usize - 1 - first;
                let node = &mut self.nodes[first + i];
                node.size += 1;
                let middle = |pixel: u32| {
                    let (x, y) = (pixel as usize % phase.width(), pixel as usize / phase.width());
                    (2 * x).abs_diff(2 * left + CELL_PX - 1) + (2 * y).abs_diff(2 * top + CELL_PX - 1)
                };
                let pixel = (v * phase.width() + u) as u32;
                if middle(pixel) < middle(node.pixel) {
                    node.pixel = pixel;
                }
                if u > left && self.node.at(u - 1, v) == number[root] {
                    sums[i].0 += here - phase.at(u - 1, v) - carrier(period, sign, u - 1, v);
                    sums[i].1 += 1;
                }
                if v > top && self.node.at(u, v - 1) == number[root] {
                    sums[i].2 += here - phase.at(u, v - 1);
                    sums[i].3 += 1;
                }
            }
        }
        for (node, (right, n, down, m)) in self.nodes[first..].iter_mut().zip(sums) {
            node.right = right / n.max(1) as f32;
            node.down = down / m.max(1) as f32;
        }
    }

    /// The borders between the nodes of one cell, and to those of the cells to the right and below.
    fn touch(&mut self, phase: &Plane<f32>, period: &Plane<f32>, sign: f32, left: usize, top: usize) {
        let (w, h) = (phase.width(), phase.height());
        // (a, b, turns, pairs); pairs that do not continue have turns of `i32::MAX`.
        let mut found: Vec<(u32, u32, i32, u32)> = Vec::new();
        for v in top..(top + CELL_PX).min(h) {
            for u in left..(left + CELL_PX).min(w) {
                let a = self.node.at(u, v);
                if a == 0 {
                    continue;
                }
                for down in [false, true] {
                    let (x, y) = if down { (u, v + 1) } else { (u + 1, v) };
                    let b = if x < w && y < h { self.node.at(x, y) } else { 0 };
                    if b == 0 || a == b {
                        continue;
                    }
                    let (a, b) = (a - 1, b - 1);
                    let (from, to) = (&self.nodes[a as usize], &self.nodes[b as usize]);
                    let expected = if down {
                        (from.down + to.down) / 2.0
                    } else {
                        carrier(period, sign, u, v) + (from.right + to.right) / 2.0
                    };
                    let rest = phase.at(x, y) - phase.at(u, v) - expected;
                    let turns = -(rest / TAU).round();
                    let good = (rest + turns * TAU).abs() < BORDER_RAD;
                    let (a, b, turns) = if a < b { (a, b, turns as i32) } else { (b, a, -turns as i32) };
                    let turns = if good { turns } else { i32::MAX };
                    match found.iter_mut().find(|x| (x.0, x.1, x.2) == (a, b, turns)) {
                        Some(x) => x.3 += 1,
                        None => found.push((a, b, turns, 1)),
                    }
                }
            }
        }
        found.sort_unstable();
        for pair in found.chunk_by(|x, y| (x.0, x.1) == (y.0, y.1)) {
            let all: u32 = pair.iter().map(|x| x.3).sum();
            let best = pair.iter().filter(|x| x.2 != i32::MAX).max_by_key(|x| (x.3, -x.2.abs(), x.2));
            let (turns, good) = best.map_or((0, 0), |x| (x.2, x.3));
            self.borders.push(Border { a: pair[0].0, b: pair[0].1, turns, good, bad: all - good });
        }
    }
}

/// The step that the period predicts between a pixel and the next in its row, rad.
fn carrier(period: &Plane<f32>, sign: f32, u: usize, v: usize) -> f32 {
    sign * 2.0 * TAU / (period.at(u, v) + period.at(u + 1, v))
}

fn root(parent: &[u8], mut at: usize) -> usize {
    while usize::from(parent[at]) != at {
        at = usize::from(parent[at]);
    }
    at
}

fn join(parent: &mut [u8], a: usize, b: usize) {
    let (a, b) = (root(parent, a), root(parent, b));
    parent[a.max(b)] = a.min(b) as u8;
}
