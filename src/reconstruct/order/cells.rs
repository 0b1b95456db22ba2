//! The surface of one view in patches: the nodes of the graph in which fringe orders are sought.
//!
//! The image is cut into cells of [`CELL_PX`] squared. Within a cell, pixels whose phases continue each other are one
//! node. Where they touch each other: [`borders`](super::borders).

use super::borders::Border;
use super::glimpse::{Glimpse, Glimpses, Rim};
use super::steps::{HALF, Steps, sum};
use crate::image::Plane;
use crate::reconstruct::bits::{self, WORD, bits_where};
use crate::reconstruct::runs::Runs;
use crate::reconstruct::sample::part;
use crate::reconstruct::simd;

/// Side of a cell, px.
pub const CELL_PX: usize = 8;

/// Within a cell, steps this far from the carrier's, or from row to row of the sensor, still continue, rad. Few pixels agree by
/// chance so often that it matters there.
const INNER_RAD: f32 = 0.8;

/// All pixels of a cell, a bit each, row by row.
pub(super) const ALL: u64 = !0;

/// The first row of a cell's bits.
pub(super) const FIRST_ROW: u64 = 0xff;

/// The first column of a cell's bits.
pub(super) const FIRST_COLUMN: u64 = 0x0101_0101_0101_0101;

/// The middle of a cell: that of its pixels which stands for a node that fills it.
const MIDDLE: usize = (CELL_PX / 2 - 1) * (CELL_PX + 1);

/// Steps to the right within a cell, and as many down.
const STEPS: usize = CELL_PX * (CELL_PX - 1);

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
    pub(super) right: f32,
    /// Mean step down, rad.
    pub(super) down: f32,
}

/// What nodes are made of.
#[derive(Debug)]
pub struct Surface<'a> {
    /// Phase unwrapped up to whole turns, rad; NaN where it is unknown.
    pub phase: &'a Plane<f32>,
    /// Local fringe period, px.
    pub period: &'a Plane<f32>,
    /// The object, whether or not it has a phase there.
    pub runs: &'a Runs,
    /// Sign of the phase's step along the row.
    pub sign: f32,
    /// Rows of the sensor that a row is the mean of: steps down are as many times as large.
    pub sensor_rows: f32,
}

/// The nodes of a view and where they touch.
#[derive(Debug)]
pub struct Cells {
    /// Columns of the region of interest, px.
    pub width: usize,
    /// Cells in a row.
    pub columns: usize,
    /// The nodes, cell by cell.
    pub nodes: Vec<Node>,
    /// Their borders.
    pub borders: Vec<Border>,
    /// What each cell has.
    pub(super) grid: Vec<Spot>,
    /// The cells at a glance.
    pub glimpses: Glimpses,
}

/// A cell.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Spot {
    /// The first of its nodes.
    pub(super) first: u32,
    /// Its nodes.
    pub(super) count: u32,
    /// The largest step to it from the cell to its left, beyond the carrier's, and from that above it, rad; NaN where one is not known.
    pub(super) into: [f32; 2],
}

/// Values of a cell's pixels.
pub(super) type Patch = [[f32; CELL_PX]; CELL_PX];

impl Cells {
    /// Cuts a surface into nodes.
    pub fn new(surface: &Surface<'_>) -> Self {
        let (w, h) = (surface.phase.width(), surface.phase.height());
        let (columns, rows) = (w.div_ceil(CELL_PX), h.div_ceil(CELL_PX));
        let (nodes, borders) = (Vec::with_capacity(columns * rows), Vec::with_capacity(2 * columns * rows));
        let mut cells = Self {
            width: w,
            columns,
            nodes,
            borders,
            grid: vec![Spot::default(); columns * rows],
            glimpses: Glimpses::new(w, h),
        };
        simd::dispatch(
            #[inline(always)]
            || {
                let (mut steps, mut object, mut pairs) = (Steps::new(columns), Object::new(w), Vec::new());
                // Rows touch the next one, which is in the cache yet.
                for row in 0..=rows {
                    if row < rows {
                        let band = band(surface.runs, row);
                        object.mark(surface.runs, row);
                        steps.measure(surface, row, band.clone());
                        for column in band {
                            cells.cut(surface, &steps, &object, column, row);
                        }
                    }
                    if let Some(above) = row.checked_sub(1) {
                        for column in band(surface.runs, above) {
                            cells.touch(surface, column, above, &mut pairs);
                        }
                    }
                }
                cells.glimpses.mark_outlines(surface.runs);
            },
        );
        cells
    }

    /// The nodes of one cell.
    #[inline(always)]
    fn cut(&mut self, surface: &Surface<'_>, steps: &Steps, object: &Object, column: usize, row: usize) {
        let (left, top) = (column * CELL_PX, row * CELL_PX);
        let place = row * self.columns + column;
        let first = self.nodes.len() as u32;
        // A comparison with NaN is false: unknown neighbours do not continue.
        let inside = left + CELL_PX <= self.width && top + CELL_PX <= surface.phase.height();
        if inside && steps.largest(left) < INNER_RAD {
            let (u, v) = (MIDDLE % CELL_PX, MIDDLE / CELL_PX);
            let pixel = (top + v) * self.width + left + u;
            let [right, down] = steps.sums(left).map(|sum| sum / STEPS as f32);
            self.nodes.push(Node {
                pixel: pixel as u32,
                phase: surface.phase.at(left + u, top + v),
                size: ALL.count_ones(),
                cell: place as u32,
                mask: ALL,
                right,
                down,
            });
            self.grid[place] = Spot { first, count: 1, into: steps.into(left) };
            self.glimpses.set(column, row, plane(first, steps.quarters(left)));
            return;
        }
        let object = object.of(column);
        if object != 0 {
            let into = if inside { steps.into(left) } else { [f32::NAN; 2] };
            self.grid[place] = Spot { first, count: 0, into };
            self.cut_up(surface, steps, column, row, object);
        }
    }

    /// The nodes of a cell that no smooth surface fills. `object`: a bit for each pixel that is the object's.
    #[inline(always)]
    fn cut_up(&mut self, surface: &Surface<'_>, steps: &Steps, column: usize, row: usize, object: u64) {
        let (left, top) = (column * CELL_PX, row * CELL_PX);
        let phase = surface.patch(left, top);
        let place = row * self.columns + column;
        let first = self.nodes.len();
        let (right_steps, down_steps) = (steps.to_the_right(left), steps_down(&phase));
        each_patch(
            &phase,
            &right_steps,
            &down_steps,
            surface.sensor_rows,
            #[inline(always)]
            |mask| self.add(mask, (column, row), &phase, &right_steps, &down_steps),
        );
        let nodes = &self.nodes[first..];
        self.grid[place].count = nodes.len() as u32;
        if let [node] = nodes
            && node.mask == ALL
        {
            self.glimpses.set(column, row, plane(first as u32, steps.quarters(left)));
        } else {
            self.rim(surface, column, row, &phase, object);
        }
    }

    /// Adds a node: these pixels of a cell.
    #[inline(always)]
    fn add(&mut self, mask: u64, (column, row): (usize, usize), phase: &Patch, right: &Patch, down: &Patch) {
        let (inner_right, inner_down) = (mask & (mask << 1) & !FIRST_COLUMN, mask & (mask << CELL_PX));
        let place = middle(mask);
        let (u, v) = (place % CELL_PX, place / CELL_PX);
        self.nodes.push(Node {
            pixel: ((row * CELL_PX + v) * self.width + column * CELL_PX + u) as u32,
            phase: phase[v][u],
            size: mask.count_ones(),
            cell: (row * self.columns + column) as u32,
            mask,
            right: mean(inner_right, right),
            down: mean(inner_down, down),
        });
    }

    /// Keeps the pixels of a cell that no node fills. `object`: a bit for each that is the object's.
    #[inline(never)]
    fn rim(&mut self, surface: &Surface<'_>, column: usize, row: usize, phase: &Patch, object: u64) {
        let (left, top) = (column * CELL_PX, row * CELL_PX);
        let Spot { first, count, .. } = self.grid[row * self.columns + column];
        let of = [0; CELL_PX * CELL_PX];
        let mut rim = Rim { object, first, of, phase: [[f32::NAN; CELL_PX + 1]; CELL_PX] };
        for (v, (line, phase)) in rim.phase.iter_mut().zip(phase).enumerate() {
            line[..CELL_PX].copy_from_slice(phase);
            if top + v < surface.phase.height() {
                line[CELL_PX] = surface.phase.row(top + v).get(left + CELL_PX).copied().unwrap_or(f32::NAN);
            }
        }
        let nodes = &self.nodes[first as usize..(first + count) as usize];
        for (i, node) in nodes.iter().enumerate() {
            let mut rest = node.mask;
            while rest != 0 {
                rim.of[rest.trailing_zeros() as usize] = i as u8 + 1;
                rest &= rest - 1;
            }
        }
        self.glimpses.set_rim(column, row, rim);
    }

    /// Adds to the phases of every node what `by` has for it; NaN takes them away.
    #[inline(always)]
    pub fn shift(&self, phase: &mut Plane<f32>, by: &[f32]) {
        for (cell, &Spot { first, count, .. }) in
            self.grid.iter().enumerate().filter(|(_, spot)| spot.count > 0)
        {
            let (left, top) = (cell % self.columns * CELL_PX, cell / self.columns * CELL_PX);
            let mut add = [[f32::NAN; CELL_PX]; CELL_PX];
            if self.nodes[first as usize].mask == ALL {
                // Most have been unwrapped from the marker.
                if by[first as usize] == 0.0 {
                    continue;
                }
                add = [[by[first as usize]; CELL_PX]; CELL_PX];
            } else {
                for node in first as usize..(first + count) as usize {
                    let (rows, by) = (self.nodes[node].mask.to_le_bytes(), by[node]);
                    for (add, row) in add.iter_mut().zip(rows) {
                        for (u, add) in add.iter_mut().enumerate() {
                            *add = if row >> u & 1 != 0 { by } else { *add };
                        }
                    }
                }
            }
            for (v, add) in (top..phase.height()).zip(&add) {
                let row = &mut phase.row_mut(v)[left..];
                match row.first_chunk_mut::<CELL_PX>() {
                    Some(to) => to.iter_mut().zip(add).for_each(|(to, add)| *to += add),
                    None => row.iter_mut().zip(add).for_each(|(to, add)| *to += add),
                }
            }
        }
    }
}

impl Surface<'_> {
    /// Phases of a cell; NaN beyond the region of interest.
    #[inline(always)]
    fn patch(&self, left: usize, top: usize) -> Patch {
        let mut out = [[f32::NAN; CELL_PX]; CELL_PX];
        for (v, out) in (top..self.phase.height()).zip(&mut out) {
            *out = part(self.phase.row(v), left, f32::NAN);
        }
        out
    }
}

/// Steps down to each pixel of a cell; 0 where these are from another cell.
#[inline(always)]
fn steps_down(phase: &Patch) -> Patch {
    let mut down = [[0.0; CELL_PX]; CELL_PX];
    for v in 1..CELL_PX {
        for u in 0..CELL_PX {
            down[v][u] = phase[v][u] - phase[v - 1][u];
        }
    }
    down
}

/// Which pixels of a row of cells are the object's, a bit for each.
#[derive(Debug)]
struct Object {
    /// Row by row.
    bits: Vec<u64>,
    words: usize,
}

impl Object {
    /// For rows of so many pixels.
    fn new(width: usize) -> Self {
        let words = width.div_ceil(WORD);
        Self { bits: vec![0; CELL_PX * words], words }
    }

    /// Goes to a row of cells.
    #[inline(always)]
    fn mark(&mut self, runs: &Runs, row: usize) {
        self.bits.fill(0);
        for (v, bits) in (row * CELL_PX..runs.height()).zip(self.bits.chunks_exact_mut(self.words)) {
            runs.row(v).iter().for_each(|run| bits::set(bits, run.columns()));
        }
    }

    /// The pixels of one cell, row by row.
    #[inline(always)]
    fn of(&self, column: usize) -> u64 {
        let (word, shift) = (column * CELL_PX / WORD, column * CELL_PX % WORD);
        let mut rows = [0; CELL_PX];
        for (v, row) in rows.iter_mut().enumerate() {
            *row = (self.bits[v * self.words + word] >> shift) as u8;
        }
        u64::from_le_bytes(rows)
    }
}

/// Columns of the cells of a row that the object touches.
#[inline(always)]
pub fn band(runs: &Runs, row: usize) -> std::ops::Range<usize> {
    let span = runs.span_of(row * CELL_PX..runs.height().min((row + 1) * CELL_PX));
    span.start / CELL_PX..span.end.div_ceil(CELL_PX)
}

/// A bit for every pixel (u, v) of a cell.
#[inline(always)]
fn bits_of_cell(is: impl Fn(usize, usize) -> bool) -> u64 {
    const { assert!(CELL_PX * CELL_PX == WORD) };
    bits_where(
        #[inline(always)]
        |i| is(i % CELL_PX, i / CELL_PX),
    )
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

/// Calls `each` with the pixels of a cell that hang together, patch by patch.
#[inline(always)]
fn each_patch(
    phase: &Patch,
    right_steps: &Patch,
    down_steps: &Patch,
    sensor_rows: f32,
    mut each: impl FnMut(u64),
) {
    let mut rest = bits_of_cell(
        #[inline(always)]
        |u, v| !phase[v][u].is_nan(),
    );
    if rest == 0 {
        return;
    }
    let right = bits_of_cell(
        #[inline(always)]
        |u, v| right_steps[v][u].abs() < INNER_RAD,
    );
    let down = bits_of_cell(
        #[inline(always)]
        |u, v| down_steps[v][u].abs() < INNER_RAD * sensor_rows,
    );
    while rest != 0 {
        let mask = flood(rest & rest.wrapping_neg(), right & !FIRST_COLUMN, down & !FIRST_ROW);
        rest &= !mask;
        each(mask);
    }
}

/// The mean of some values over the pixels of a mask; 0 where there are none.
#[inline(always)]
fn mean(mask: u64, values: &Patch) -> f32 {
    let mut sums = [0f32; CELL_PX];
    for (values, bits) in values.iter().zip(mask.to_le_bytes()) {
        for (u, (sum, value)) in sums.iter_mut().zip(values).enumerate() {
            *sum += if bits >> u & 1 != 0 { *value } else { 0.0 };
        }
    }
    sum(&sums) / mask.count_ones().max(1) as f32
}

/// The plane of a cell that one node fills, of sums of its quarters.
#[inline(always)]
fn plane(node: u32, [[a, b], [c, d]]: [[f32; 2]; 2]) -> Glimpse {
    // Halves are four pixels apart, and have 32.
    let per = 1.0 / (HALF * HALF * CELL_PX) as f32;
    let steps = [((b + d) - (a + c)) * per, ((c + d) - (a + b)) * per];
    let middle = ((a + b) + (c + d)) / (CELL_PX * CELL_PX) as f32;
    let phase = middle - (steps[0] + steps[1]) * (CELL_PX - 1) as f32 / 2.0;
    Glimpse::plane(node, phase, steps)
}
