//! The surface of one view in patches: the nodes of the graph in which fringe orders are sought.
//!
//! The image is cut into cells of [`CELL_PX`] squared. Within a cell, pixels whose phases continue each other are one
//! node; where cells meet, the pixel pairs of two nodes tell whether their surfaces continue each other, and by how many
//! whole turns their phases differ.

use super::lookout::BACKGROUND_PX;
use super::sighted::{Pixel, Sighted};
use crate::image::Plane;
use crate::reconstruct::runs::Runs;
use crate::reconstruct::simd;
use std::f32::consts::TAU;

/// Side of a cell, px.
pub const CELL_PX: usize = 8;

/// Within a cell, steps this far from the carrier's still continue, rad. Few pixels agree by chance so often that it
/// matters there.
const INNER_RAD: f32 = 0.8;

/// Between nodes, steps this far from what their own slopes predict still continue, rad.
const BORDER_RAD: f32 = 0.3;

/// All pixels of a cell, a bit each, row by row.
const ALL: u64 = !0;

/// The first column of a cell's bits.
const FIRST_COLUMN: u64 = 0x0101_0101_0101_0101;

/// A patch of one surface.
#[derive(Debug, Clone, Copy)]
pub struct Node {
    /// The pixel that stands for it: its place in the region of interest, row by row.
    pub pixel: u32,
    /// Its phase, rad.
    pub phase: f32,
    /// Its pixels.
    pub size: u32,
    /// Its cell, row by row.
    pub cell: u32,
    /// Its pixels within the cell.
    pub mask: u64,
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

/// What nodes are made of.
#[derive(Debug)]
pub struct Surface<'a> {
    /// Phase unwrapped up to whole turns, rad; NaN where it is unknown.
    pub phase: &'a Plane<f32>,
    /// What replaces it where the tree is not 0.
    pub open: Option<(&'a Plane<f32>, &'a Plane<u32>)>,
    /// Local fringe period, px.
    pub period: &'a Plane<f32>,
    /// Not 0 on the object.
    pub object: &'a Plane<u8>,
    /// The object's runs.
    pub runs: &'a Runs,
    /// Sign of the phase's step along the row.
    pub sign: f32,
}

/// Cells around the region of interest in the grid that is looked at: beyond them there is nothing but background.
pub const PAD_CELLS: usize = 3;

/// Cells of the padded grid along so many pixels.
pub fn padded(px: usize) -> usize {
    px.div_ceil(CELL_PX) + 2 * PAD_CELLS
}

/// What a cell is for those who look at it from elsewhere.
#[derive(Debug, Clone, Copy)]
pub struct Glimpse {
    /// The node that fills it; or one of the following.
    pub node: u32,
    /// The phase of the node's plane at the cell's first pixel, rad.
    pub phase: f32,
    /// Its step from column to column, and from row to row, rad.
    pub steps: [f32; 2],
}

impl Glimpse {
    /// Beside the object, and so is all within [`BACKGROUND_PX`].
    pub const FAR: u32 = u32::MAX;
    /// Beside the object.
    pub const NEAR: u32 = u32::MAX - 1;
    /// Its pixels have to be asked.
    pub const MIXED: u32 = u32::MAX - 2;

    /// A cell that no node fills.
    pub const fn none(kind: u32) -> Self {
        Self { node: kind, phase: f32::NAN, steps: [0.0; 2] }
    }
}

/// The nodes of a view and where they touch.
#[derive(Debug)]
pub struct Cells {
    /// Columns of the region of interest, px.
    pub width: usize,
    /// Cells in a row.
    pub columns: usize,
    /// The pixels with their nodes.
    pub pixels: Sighted,
    /// The nodes, cell by cell.
    pub nodes: Vec<Node>,
    /// Their borders.
    pub borders: Vec<Border>,
    /// First node and number of nodes of each cell.
    grid: Vec<(u32, u32)>,
    /// The cells at a glance, with [`PAD_CELLS`] around. Looks come from anywhere in the image and wait for memory: these
    /// few stay in the cache.
    pub glimpses: Vec<Glimpse>,
}

/// Values of a cell's pixels.
type Patch = [[f32; CELL_PX]; CELL_PX];

impl Cells {
    /// Cuts a surface into nodes.
    pub fn new(surface: &Surface<'_>) -> Self {
        let (w, h) = (surface.phase.width(), surface.phase.height());
        let (columns, rows) = (w.div_ceil(CELL_PX), h.div_ceil(CELL_PX));
        let pixels = Sighted::new(surface.runs);
        let (nodes, borders) = (Vec::with_capacity(columns * rows), Vec::with_capacity(2 * columns * rows));
        let mut cells = Self {
            width: w,
            columns,
            pixels,
            nodes,
            borders,
            grid: vec![(0, 0); columns * rows],
            glimpses: vec![Glimpse::none(Glimpse::FAR); padded(w) * padded(h)],
        };
        simd::dispatch(
            #[inline(always)]
            || {
                for row in 0..rows {
                    for column in band(surface.runs, row) {
                        cells.cut(surface, column, row);
                    }
                }
                for row in 0..rows {
                    for column in band(surface.runs, row) {
                        cells.touch(surface, column, row);
                    }
                }
                cells.blur_outlines(surface.runs);
            },
        );
        cells
    }

    /// Marks the background around the object.
    #[inline(always)]
    fn blur_outlines(&mut self, runs: &Runs) {
        const REACH: usize = (BACKGROUND_PX as usize).div_ceil(CELL_PX);
        let stride = padded(self.width);
        for row in 0..self.grid.len() / self.columns.max(1) {
            for column in band(runs, row) {
                let at = (row + PAD_CELLS) * stride + column + PAD_CELLS;
                if self.glimpses[at].node >= Glimpse::NEAR {
                    continue;
                }
                for step in 1..=REACH {
                    for other in [at - step, at + step, at - step * stride, at + step * stride] {
                        let node = &mut self.glimpses[other].node;
                        *node = if *node == Glimpse::FAR { Glimpse::NEAR } else { *node };
                    }
                }
            }
        }
    }

    /// The nodes of one cell.
    #[inline(always)]
    fn cut(&mut self, surface: &Surface<'_>, column: usize, row: usize) {
        let (left, top) = (column * CELL_PX, row * CELL_PX);
        let phase = surface.patch(left, top);
        let cell = row * self.columns + column;
        let first = self.nodes.len();
        let known = bits(
            #[inline(always)]
            |u, v| !phase[v][u].is_nan(),
        );
        if known != 0 {
            let carrier = surface.carriers(left, top);
            // A comparison with NaN is false: unknown neighbours do not continue.
            let right = !FIRST_COLUMN
                & bits(
                    #[inline(always)]
                    |u, v| (phase[v][u] - phase[v][u.max(1) - 1] - carrier[v][u]).abs() < INNER_RAD,
                );
            let down = bits(
                #[inline(always)]
                |u, v| v > 0 && (phase[v][u] - phase[v.max(1) - 1][u]).abs() < INNER_RAD,
            );
            let mut rest = known;
            while rest != 0 {
                let mask = flood(rest & rest.wrapping_neg(), right, down);
                rest &= !mask;
                let (inner_right, inner_down) =
                    (mask & (mask << 1) & !FIRST_COLUMN, mask & (mask << CELL_PX));
                let place = middle(mask);
                let (u, v) = (place % CELL_PX, place / CELL_PX);
                self.nodes.push(Node {
                    pixel: ((top + v) * self.width + left + u) as u32,
                    phase: phase[v][u],
                    size: mask.count_ones(),
                    cell: cell as u32,
                    mask,
                    right: mean(
                        inner_right,
                        #[inline(always)]
                        |u, v| phase[v][u] - phase[v][u.max(1) - 1] - carrier[v][u],
                    ),
                    down: mean(
                        inner_down,
                        #[inline(always)]
                        |u, v| phase[v][u] - phase[v.max(1) - 1][u],
                    ),
                });
            }
        }
        let nodes = &self.nodes[first..];
        self.grid[cell] = (first as u32, nodes.len() as u32);
        let mut shows = false;
        for (v, line) in phase.iter().enumerate().take(surface.phase.height() - top) {
            let object = &surface.object.row(top + v)[left..surface.phase.width().min(left + CELL_PX)];
            for (pixel, u) in self.pixels.part(top + v, left, object.len()) {
                shows |= object[u] != 0;
                let bit = 1 << (v * CELL_PX + u);
                let node = match nodes {
                    [node] if node.mask == ALL => Some(0),
                    nodes => nodes.iter().position(|node| node.mask & bit != 0),
                };
                *pixel = Pixel::new(line[u], object[u] != 0, node.map(|i| (first + i) as u32));
            }
        }
        let place = (row + PAD_CELLS) * padded(self.width) + column + PAD_CELLS;
        self.glimpses[place] = match nodes {
            [node] if node.mask == ALL => plane(first as u32, &phase),
            _ => Glimpse::none(if shows { Glimpse::MIXED } else { Glimpse::FAR }),
        };
    }

    /// The borders between the nodes of one cell, and to those of the cells to the right and below.
    #[inline(always)]
    fn touch(&mut self, surface: &Surface<'_>, column: usize, row: usize) {
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
                *rest = surface.phase(x + 1, y) - surface.phase(x, y) - expected;
            }
            self.borders.push(border(a, b, rest));
        }
        if let Some(b) = below.and_then(|x| whole(&self.grid, &self.nodes, x)) {
            let to = &self.nodes[b as usize];
            let (above, below) = (surface.row(left, top + CELL_PX - 1), surface.row(left, top + CELL_PX));
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
        let (w, h) = (surface.phase.width(), surface.phase.height());
        let (left, top) = (column * CELL_PX, row * CELL_PX);
        // (a, b, turns, pairs); pairs that do not continue have turns of `i32::MAX`.
        let mut found: Vec<(u32, u32, i32, u32)> = Vec::with_capacity(8);
        for v in top..(top + CELL_PX).min(h) {
            for u in left..(left + CELL_PX).min(w) {
                let (here, right) = self.pixels.at(u, v);
                let Some(a) = here.node() else { continue };
                let below = if v + 1 < h { self.pixels.at(u, v + 1).0 } else { Pixel::BESIDE };
                for (down, there) in [(false, right), (true, below)] {
                    let Some(b) = there.node().filter(|b| *b != a) else { continue };
                    let (from, to) = (&self.nodes[a as usize], &self.nodes[b as usize]);
                    let expected = if down {
                        (from.down + to.down) / 2.0
                    } else {
                        surface.carrier(u, v) + (from.right + to.right) / 2.0
                    };
                    let (turns, good) = turns(there.phase - here.phase - expected);
                    let (a, b, turns) = if a < b { (a, b, turns) } else { (b, a, -turns) };
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

impl Surface<'_> {
    /// The phase of a pixel.
    #[inline(always)]
    fn phase(&self, u: usize, v: usize) -> f32 {
        match self.open {
            Some((relative, tree)) if tree.at(u, v) != 0 => relative.at(u, v),
            _ => self.phase.at(u, v),
        }
    }

    /// Phases of a row of a cell; NaN beyond the last column.
    #[inline(always)]
    fn row(&self, left: usize, v: usize) -> [f32; CELL_PX] {
        let mut out = part(self.phase.row(v), left, f32::NAN);
        if let Some((relative, tree)) = self.open {
            let (relative, tree) = (part(relative.row(v), left, f32::NAN), part(tree.row(v), left, 0));
            for u in 0..CELL_PX {
                out[u] = if tree[u] != 0 { relative[u] } else { out[u] };
            }
        }
        out
    }

    /// Phases of a cell; NaN beyond the region of interest.
    #[inline(always)]
    fn patch(&self, left: usize, top: usize) -> Patch {
        let mut out = [[f32::NAN; CELL_PX]; CELL_PX];
        for (v, out) in (top..self.phase.height()).zip(&mut out) {
            *out = self.row(left, v);
        }
        out
    }

    /// The step that the period predicts from the pixel to the left, for the pixels of a cell, rad; any number where
    /// there is none in the cell.
    #[inline(always)]
    fn carriers(&self, left: usize, top: usize) -> Patch {
        let mut out = [[0.0; CELL_PX]; CELL_PX];
        for (v, out) in (top..self.phase.height()).zip(&mut out) {
            let period = part(self.period.row(v), left, f32::NAN);
            for u in 1..CELL_PX {
                out[u] = self.sign * 2.0 * TAU / (period[u - 1] + period[u]);
            }
        }
        out
    }

    /// The step that the period predicts between a pixel and the next in its row, rad.
    #[inline(always)]
    fn carrier(&self, u: usize, v: usize) -> f32 {
        self.sign * 2.0 * TAU / (self.period.at(u, v) + self.period.at(u + 1, v))
    }
}

/// Eight values of a row, `beyond` behind its end.
#[inline(always)]
fn part<T: Copy>(row: &[T], left: usize, beyond: T) -> [T; CELL_PX] {
    match row[left..].first_chunk() {
        Some(part) => *part,
        None => std::array::from_fn(|i| row.get(left + i).copied().unwrap_or(beyond)),
    }
}

/// Columns of the cells of a row that the object touches.
#[inline(always)]
fn band(runs: &Runs, row: usize) -> std::ops::Range<usize> {
    let spans = (row * CELL_PX..runs.height().min((row + 1) * CELL_PX)).map(|v| runs.span(v));
    let (mut first, mut end) = (usize::MAX, 0);
    for span in spans.filter(|span| !span.is_empty()) {
        (first, end) = (first.min(span.start), end.max(span.end));
    }
    if first < end { first / CELL_PX..end.div_ceil(CELL_PX) } else { 0..0 }
}

/// A bit for every pixel (u, v) of a cell.
#[inline(always)]
fn bits(is: impl Fn(usize, usize) -> bool) -> u64 {
    let mut rows = [0u8; CELL_PX];
    for (v, row) in rows.iter_mut().enumerate() {
        for u in 0..CELL_PX {
            *row |= u8::from(is(u, v)) << u;
        }
    }
    u64::from_le_bytes(rows)
}

/// All pixels that hang together with some: `right` and `down` tell which continue the one to their left and above.
#[inline(always)]
fn flood(seed: u64, right: u64, down: u64) -> u64 {
    let mut mask = seed;
    loop {
        let mut next = mask | mask << 1 & right | (mask & right) >> 1;
        next |= next << CELL_PX & down | (next & down) >> CELL_PX;
        if next == mask {
            return mask;
        }
        mask = next;
    }
}

/// The pixel of a node that is nearest to the cell's middle, the first of several.
#[inline(always)]
fn middle(mask: u64) -> usize {
    /// Pixels within so many half steps of the middle, counted along rows and columns.
    const RINGS: [u64; 8] = {
        let mut rings = [0; 8];
        let mut at = 0;
        while at < CELL_PX * CELL_PX {
            let (u, v) = (at % CELL_PX, at / CELL_PX);
            let distance = (2 * u).abs_diff(CELL_PX - 1) + (2 * v).abs_diff(CELL_PX - 1);
            rings[distance / 2] |= 1 << at;
            at += 1;
        }
        rings
    };
    let ring = RINGS.iter().find(|ring| **ring & mask != 0).map_or(mask, |ring| ring & mask);
    (ring.trailing_zeros() as usize).min(CELL_PX * CELL_PX - 1)
}

/// The mean of a value over the pixels of a mask; 0 where there are none.
#[inline(always)]
fn mean(mask: u64, value: impl Fn(usize, usize) -> f32) -> f32 {
    let mut sums = [0f32; CELL_PX];
    for (v, bits) in mask.to_le_bytes().into_iter().enumerate() {
        for (u, sum) in sums.iter_mut().enumerate() {
            *sum += if bits >> u & 1 != 0 { value(u, v) } else { 0.0 };
        }
    }
    let [a, b, c, d, e, f, g, h] = sums;
    ((a + b) + (c + d) + ((e + f) + (g + h))) / mask.count_ones().max(1) as f32
}

/// The plane of a cell that one node fills: means of its halves.
#[inline(always)]
fn plane(node: u32, phase: &Patch) -> Glimpse {
    const HALF: usize = CELL_PX / 2;
    let (mut above, mut below) = ([0f32; CELL_PX], [0f32; CELL_PX]);
    for v in 0..HALF {
        for u in 0..CELL_PX {
            above[u] += phase[v][u];
            below[u] += phase[v + HALF][u];
        }
    }
    let sum = |part: &[f32]| (part[0] + part[1]) + (part[2] + part[3]);
    let [a, b] = [sum(&above[..HALF]), sum(&above[HALF..])];
    let [c, d] = [sum(&below[..HALF]), sum(&below[HALF..])];
    // Halves are four pixels apart, and have 32.
    let per = 1.0 / (HALF * HALF * CELL_PX) as f32;
    let steps = [((b + d) - (a + c)) * per, ((c + d) - (a + b)) * per];
    let middle = ((a + b) + (c + d)) / (CELL_PX * CELL_PX) as f32;
    let phase = middle - (steps[0] + steps[1]) * (CELL_PX - 1) as f32 / 2.0;
    Glimpse { node, phase, steps }
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
