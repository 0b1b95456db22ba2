//! Where nodes touch: the pixel pairs of two nodes tell whether their surfaces continue each other, and by how many
//! whole turns their phases differ.

use super::cells::{ALL, CELL_PX, Cells, FIRST_COLUMN, FIRST_ROW, Spot, Surface};
use crate::reconstruct::sample::part;
use std::f32::consts::TAU;

/// Between nodes, steps this far from what their own slopes predict still continue, rad.
const BORDER_RAD: f32 = 0.3;

/// Steps below this continue whatever the order in which differences are rounded.
const CLEAR_RAD: f32 = BORDER_RAD - 1e-3;

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
pub(super) type Pairs = (u32, u32, i32, u32);

impl Cells {
    /// The borders between the nodes of one cell, and to those of the cells to the right and below. `found` is room to count in.
    #[inline(always)]
    pub(super) fn touch(&mut self, surface: &Surface<'_>, column: usize, row: usize, found: &mut Vec<Pairs>) {
        let place = row * self.columns + column;
        let spot = self.grid[place];
        if spot.count == 0 {
            return;
        }
        let mut touches = [None; 2];
        let mut all = self.is_whole(&spot);
        let beside = (column + 1 < self.columns).then_some(place + 1);
        for (touches, at) in touches.iter_mut().zip([beside, Some(place + self.columns)]) {
            if let Some(other) = at.and_then(|at| self.grid.get(at))
                && other.count > 0
            {
                *touches = Some(*other);
                all &= self.is_whole(other);
            }
        }
        if !all {
            return self.touch_any(surface, column, row, found);
        }
        let (a, from) = (spot.first, self.nodes[spot.first as usize]);
        let [beside, below] = touches;
        if let Some(Spot { first: b, into: [into, _], .. }) = beside {
            let mean = (from.right + self.nodes[b as usize].right) / 2.0;
            self.borders.push(between_whole(a, b, (into, mean), || surface.rest_beside(column, row, mean)));
        }
        if let Some(Spot { first: b, into: [_, into], .. }) = below {
            let mean = (from.down + self.nodes[b as usize].down) / 2.0;
            self.borders.push(between_whole(a, b, (into, mean), || surface.rest_below(column, row, mean)));
        }
    }

    /// Whether one node fills a cell.
    #[inline(always)]
    fn is_whole(&self, spot: &Spot) -> bool {
        spot.count == 1 && self.nodes[spot.first as usize].mask == ALL
    }

    /// The same where a cell has several nodes, or nodes with holes.
    #[inline(never)]
    fn touch_any(&mut self, surface: &Surface<'_>, column: usize, row: usize, found: &mut Vec<Pairs>) {
        let cell = row * self.columns + column;
        let none = Spot::default();
        let beside = if column + 1 < self.columns { self.grid[cell + 1] } else { none };
        let below = self.grid.get(cell + self.columns).copied().unwrap_or(none);
        let nodes = |spot: Spot| spot.first..spot.first + spot.count;
        found.clear();
        for a in nodes(self.grid[cell]) {
            let mask = self.nodes[a as usize].mask;
            let at = (column * CELL_PX, row * CELL_PX);
            let mut touches = |b, right, down| {
                for (down, pixels) in [(false, right), (true, down)] {
                    self.pairs(surface, at, (a, b), down, pixels, found);
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
        if pixels == 0 {
            return;
        }
        let (from, to) = (&self.nodes[a as usize], &self.nodes[b as usize]);
        let mean = if down { (from.down + to.down) / 2.0 } else { (from.right + to.right) / 2.0 };
        let (first, second) = (a.min(b), a.max(b));
        let mut count =
            |turns, pairs| match found.iter_mut().find(|x| (x.0, x.1, x.2) == (first, second, turns)) {
                Some(x) => x.3 += pairs,
                None => found.push((first, second, turns, pairs)),
            };
        // Nearly everywhere no turn lies between them.
        let mut level = 0;
        while pixels != 0 {
            let pixel = pixels.trailing_zeros() as usize;
            pixels &= pixels - 1;
            let (u, v) = (at.0 + pixel % CELL_PX, at.1 + pixel / CELL_PX);
            let (x, y) = if down { (u, v + 1) } else { (u + 1, v) };
            let expected = if down { mean } else { surface.carrier(u, v) + mean };
            let rest = surface.phase.at(x, y) - surface.phase.at(u, v) - expected;
            if rest.abs() < BORDER_RAD {
                level += 1;
                continue;
            }
            let (turns, good) = turns(rest);
            let turns = if a < b { turns } else { -turns };
            count(if good { turns } else { i32::MAX }, 1);
        }
        if level > 0 {
            count(0, level);
        }
    }
}

impl Surface<'_> {
    /// How far the steps from a cell to that beside it are from the carrier's and `mean`.
    #[inline(always)]
    fn rest_beside(&self, column: usize, row: usize, mean: f32) -> [f32; CELL_PX] {
        let (x, top) = ((column + 1) * CELL_PX - 1, row * CELL_PX);
        let mut rest = [0f32; CELL_PX];
        for (y, rest) in (top..).zip(&mut rest) {
            let expected = self.carrier(x, y) + mean;
            *rest = self.phase.at(x + 1, y) - self.phase.at(x, y) - expected;
        }
        rest
    }

    /// How far the steps from a cell to that below it are from `mean`.
    #[inline(always)]
    fn rest_below(&self, column: usize, row: usize, mean: f32) -> [f32; CELL_PX] {
        let (left, bottom) = (column * CELL_PX, (row + 1) * CELL_PX);
        let line = |v: usize| -> [f32; CELL_PX] { part(self.phase.row(v), left, f32::NAN) };
        let (above, below) = (line(bottom - 1), line(bottom));
        let mut rest = [0f32; CELL_PX];
        for u in 0..CELL_PX {
            rest[u] = below[u] - above[u] - mean;
        }
        rest
    }

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

/// The border of two nodes that fill their cells. The largest of its steps and the mean that is expected tell mostly that all continue
/// without a turn; else `rest` has what is left of each.
#[inline(always)]
fn between_whole(
    a: u32,
    b: u32,
    (largest, mean): (f32, f32),
    rest: impl FnOnce() -> [f32; CELL_PX],
) -> Border {
    if largest + mean.abs() < CLEAR_RAD { continued(a, b, 0) } else { border(a, b, rest()) }
}

/// The border of two nodes whose eight pixel pairs all continue with these turns.
#[inline(always)]
fn continued(a: u32, b: u32, turns: i32) -> Border {
    Border { a, b, turns, good: CELL_PX as u32, bad: 0 }
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
        return continued(a, b, first);
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
