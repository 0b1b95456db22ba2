//! Where nodes touch: the pixel pairs of two nodes tell whether their surfaces continue each other, and by how many
//! whole turns their phases differ.

use super::cells::{ALL, CELL_PX, Cells, FIRST_COLUMN, FIRST_ROW, Node, Surface};
use crate::reconstruct::sample::part;
use std::f32::consts::TAU;

/// Between nodes, steps this far from what their own slopes predict still continue, rad.
const BORDER_RAD: f32 = 0.3;

/// The last column.
const LAST_COLUMN: u64 = FIRST_COLUMN << (CELL_PX - 1);

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

/// Two nodes, turns, and the pixel pairs that say so; those that do not continue have turns of `i32::MAX`.
type Pairs = (u32, u32, i32, u32);

impl Cells {
    /// The borders between the nodes of one cell, and to those of the cells to the right and below.
    #[inline(always)]
    pub(super) fn touch(&mut self, surface: &Surface<'_>, column: usize, row: usize) {
        let cell = row * self.columns + column;
        let (a, count) = self.grid[cell];
        let whole = |grid: &[(u32, u32)], nodes: &[Node], cell: usize| {
            let (node, count) = grid[cell];
            (count == 1 && nodes[node as usize].mask == ALL).then_some(node)
        };
        let empty = |grid: &[(u32, u32)], cell: usize| grid[cell].1 == 0;
        if count == 0 {
            return;
        }
        let beside = (column + 1 < self.columns).then_some(cell + 1);
        let below = (cell + self.columns < self.grid.len()).then_some(cell + self.columns);
        let whole_or_empty = |at: Option<usize>| {
            at.is_none_or(|x| empty(&self.grid, x) || whole(&self.grid, &self.nodes, x).is_some())
        };
        if whole(&self.grid, &self.nodes, cell).is_none() || !whole_or_empty(beside) || !whole_or_empty(below)
        {
            return self.touch_any(surface, column, row);
        }
        let (left, top) = (column * CELL_PX, row * CELL_PX);
        let from = self.nodes[a as usize];
        if let Some(b) = beside.and_then(|x| whole(&self.grid, &self.nodes, x)) {
            let to = &self.nodes[b as usize];
            let mut rest = [0f32; CELL_PX];
            for (v, rest) in rest.iter_mut().enumerate() {
                let (x, y) = (left + CELL_PX - 1, top + v);
                let expected = surface.carrier(x, y) + (from.right + to.right) / 2.0;
                *rest = surface.phase.at(x + 1, y) - surface.phase.at(x, y) - expected;
            }
            self.borders.push(border(a, b, rest));
        }
        if let Some(b) = below.and_then(|x| whole(&self.grid, &self.nodes, x)) {
            let to = &self.nodes[b as usize];
            let row = |v: usize| -> [f32; CELL_PX] { part(surface.phase.row(v), left, f32::NAN) };
            let (above, below) = (row(top + CELL_PX - 1), row(top + CELL_PX));
            let mut rest = [0f32; CELL_PX];
            for u in 0..CELL_PX {
                rest[u] = below[u] - above[u] - (from.down + to.down) / 2.0;
            }
            self.borders.push(border(a, b, rest));
        }
    }

    /// The same where a cell has several nodes, or nodes with holes.
    #[inline(never)]
    fn touch_any(&mut self, surface: &Surface<'_>, column: usize, row: usize) {
        let cell = row * self.columns + column;
        let none = (0, 0);
        let beside = if column + 1 < self.columns { self.grid[cell + 1] } else { none };
        let below = self.grid.get(cell + self.columns).copied().unwrap_or(none);
        let nodes = |(first, count): (u32, u32)| first..first + count;
        let mut found = Vec::with_capacity(8);
        for a in nodes(self.grid[cell]) {
            let mask = self.nodes[a as usize].mask;
            let at = (column * CELL_PX, row * CELL_PX);
            let mut touches = |b, right, down| {
                for (down, pixels) in [(false, right), (true, down)] {
                    self.pairs(surface, at, (a, b), down, pixels, &mut found);
                }
            };
            for b in nodes(self.grid[cell]).filter(|b| *b != a) {
                let other = self.nodes[b as usize].mask;
                touches(b, mask & other >> 1 & !LAST_COLUMN, mask & other >> CELL_PX);
            }
            for b in nodes(beside) {
                let other = self.nodes[b as usize].mask & FIRST_COLUMN;
                touches(b, mask & other << (CELL_PX - 1), 0);
            }
            for b in nodes(below) {
                let other = self.nodes[b as usize].mask & FIRST_ROW;
                touches(b, 0, mask & other << (CELL_PX * (CELL_PX - 1)));
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

    /// Counts what the pixel pairs of two nodes say. `pixels` are those of the first node, in the cell that begins at `at`, which have one of the
    /// second to their right or below them.
    #[inline(always)]
    fn pairs(
        &self,
        surface: &Surface<'_>,
        at: (usize, usize),
        (a, b): (u32, u32),
        down: bool,
        mut pixels: u64,
        found: &mut Vec<Pairs>,
    ) {
        let (from, to) = (&self.nodes[a as usize], &self.nodes[b as usize]);
        while pixels != 0 {
            let pixel = pixels.trailing_zeros() as usize;
            pixels &= pixels - 1;
            let (u, v) = (at.0 + pixel % CELL_PX, at.1 + pixel / CELL_PX);
            let (x, y) = if down { (u, v + 1) } else { (u + 1, v) };
            let expected = if down {
                (from.down + to.down) / 2.0
            } else {
                surface.carrier(u, v) + (from.right + to.right) / 2.0
            };
            let (turns, good) = turns(surface.phase.at(x, y) - surface.phase.at(u, v) - expected);
            let (a, b, turns) = if a < b { (a, b, turns) } else { (b, a, -turns) };
            let turns = if good { turns } else { i32::MAX };
            match found.iter_mut().find(|x| (x.0, x.1, x.2) == (a, b, turns)) {
                Some(x) => x.3 += 1,
                None => found.push((a, b, turns, 1)),
            }
        }
    }
}

impl Surface<'_> {
    /// The step that the period predicts between a pixel and the next in its row, rad.
    #[inline(always)]
    fn carrier(&self, u: usize, v: usize) -> f32 {
        self.sign * 2.0 * TAU / (self.period.at(u, v) + self.period.at(u + 1, v))
    }
}

/// Whole turns to add so that nothing but a small rest stays, and whether it is small enough.
#[inline(always)]
fn turns(rest: f32) -> (i32, bool) {
    let turns = -(rest / TAU).round();
    (turns as i32, (rest + turns * TAU).abs() < BORDER_RAD)
}

/// The border of two nodes by what their eight pixel pairs say.
#[inline(always)]
fn border(a: u32, b: u32, rest: [f32; CELL_PX]) -> Border {
    // Nearly everywhere all say the same.
    let (first, _) = turns(rest[0]);
    let mut same = true;
    for rest in rest {
        let (turns, good) = turns(rest);
        same &= good & (turns == first);
    }
    if same {
        return Border { a, b, turns: first, good: CELL_PX as u32, bad: 0 };
    }
    let mut counts = [(0i32, 0u32); CELL_PX];
    let mut kinds = 0;
    for rest in rest {
        let (turns, good) = turns(rest);
        if !good {
            continue;
        }
        let at = counts[..kinds].iter().position(|x| x.0 == turns).unwrap_or(kinds);
        kinds = kinds.max(at + 1);
        counts[at] = (turns, counts[at].1 + 1);
    }
    let best = counts[..kinds].iter().max_by_key(|x| (x.1, -x.0.abs(), x.0));
    let (turns, good) = best.copied().unwrap_or((0, 0));
    Border { a, b, turns, good, bad: CELL_PX as u32 - good }
}
