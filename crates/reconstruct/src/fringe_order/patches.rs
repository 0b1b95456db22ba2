// SPDX-License-Identifier: MIT OR Apache-2.0
//! A view's surface in patches: the nodes of the graph in which fringe orders are sought.
//!
//! The image is cut into cells of 8 x 8 px. The phases of a cell are unwrapped along its carrier, and pixels that
//! continue each other are one patch. Most cells are filled by one smooth patch, a plane of phases.

use super::links::Link;
use super::lookup::{self, CellContent, CellLookup, RimRow};
use crate::base::image::Plane;
use crate::kernels::bit_rows::{self, WORD, bits_where};
use crate::kernels::fast_round::nearest;
use crate::kernels::pixel_runs::Runs;
use crate::kernels::simd;
use crate::kernels::subpixel::{part, put};
use std::f32::consts::TAU;

/// Side of a cell, px.
pub const CELL_PX: usize = 8;

/// Within a cell, pixels whose step differs from the carrier's by less are one patch, rad; the same from row to row.
/// Half as much cuts steep surfaces up, twice as much joins surfaces that touch.
const INNER_RAD: f32 = 0.8;

/// All pixels of a cell, a bit each, row by row.
pub(super) const ALL: u64 = !0;

/// The first row of a cell's bits.
pub(super) const FIRST_ROW: u64 = 0xff;

/// The first column of a cell's bits.
pub(super) const FIRST_COLUMN: u64 = 0x0101_0101_0101_0101;

/// The middle of a cell: that of its pixels which stands for a patch that fills it.
const MIDDLE: usize = (CELL_PX / 2 - 1) * (CELL_PX + 1);

/// A patch of one surface.
#[derive(Debug, Clone, Copy)]
pub struct Patch {
    /// The pixel that stands for it: its place in the region of interest, row by row.
    pub pixel: u32,
    /// Phase of that pixel, rad, unwrapped within its cell.
    pub phase: f32,
    /// How many pixels it has.
    pub size: u32,
    /// Its cell, row by row.
    pub cell: u32,
    /// Its pixels within the cell.
    pub mask: u64,
    /// Mean step to the right beyond the carrier's, and down, rad.
    pub steps: [f32; 2],
    /// Step of the carrier to the right at that pixel, rad.
    pub carrier: f32,
}

impl Patch {
    /// The phase that the patch would have so many columns to the right and rows down, less its own, rad.
    pub fn change(&self, right: f32, down: f32) -> f32 {
        right * (self.carrier + self.steps[0]) + down * self.steps[1]
    }
}

/// What patches are cut from.
#[derive(Debug)]
pub struct Surface<'a> {
    /// Wrapped phase, rad; NaN where it is unknown. It becomes the phase unwrapped within each cell.
    pub phase: &'a mut Plane<f32>,
    /// Local fringe period Pm, px.
    pub period: &'a Plane<f32>,
    /// The object, whether or not it has a phase there.
    pub object: &'a Runs,
    /// Sign of the phase's step along the row.
    pub sign: f32,
}

/// The patches of a view, and how they continue each other.
#[derive(Debug, Default)]
pub struct Patches {
    /// Columns of the region of interest, px.
    pub width: usize,
    /// Cells in a row of the region of interest.
    pub columns: usize,
    /// The patches, cell by cell.
    pub all: Vec<Patch>,
    /// Where surfaces continue from one to another.
    pub links: Vec<Link>,
    /// The patches of each cell, row by row.
    pub(super) grid: Vec<Spot>,
    /// The cells as the other cameras look them up.
    pub lookup: CellLookup,
}

/// A cell: the first of its patches, and how many there are.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Spot {
    pub(super) first: u32,
    pub(super) count: u32,
}

/// Values of a cell's pixels.
pub(super) type Block = [[f32; CELL_PX]; CELL_PX];

/// A cell's phases, unwrapped along its carrier, rad; its periods, px; its steps to the right and down, rad.
struct Cell {
    phase: Block,
    period: Block,
    right: Block,
    down: Block,
    /// A bit for each pixel that is the object's.
    object: u64,
}

impl Patches {
    /// Cuts a surface into patches, and links them.
    pub fn cut(surface: &mut Surface<'_>) -> Self {
        let (w, h) = (surface.phase.width(), surface.phase.height());
        let (columns, rows) = (w.div_ceil(CELL_PX), h.div_ceil(CELL_PX));
        let (all, links) = (Vec::with_capacity(columns * rows), Vec::with_capacity(2 * columns * rows));
        let grid = vec![Spot::default(); columns * rows];
        let mut patches = Self { width: w, columns, all, links, grid, lookup: CellLookup::new(w, h) };
        simd::dispatch(
            #[inline(always)]
            || {
                let (mut object, mut pairs) = (Object::new(w), Vec::new());
                // Links need the next row of cells: it is cut first, while both are in the cache.
                for row in 0..=rows {
                    if row < rows {
                        object.mark(surface.object, row);
                        for column in band(surface.object, row) {
                            patches.cut_cell(surface, &object, column, row);
                        }
                    }
                    if let Some(above) = row.checked_sub(1) {
                        for column in band(surface.object, above) {
                            patches.link_cell(surface, column, above, &mut pairs);
                        }
                    }
                }
                patches.lookup.mark_outlines(surface.object);
            },
        );
        patches
    }

    /// The patches of one cell.
    #[inline(always)]
    fn cut_cell(&mut self, surface: &mut Surface<'_>, object: &Object, column: usize, row: usize) {
        let object = object.of(column);
        if object == 0 {
            return;
        }
        let (left, top) = (column * CELL_PX, row * CELL_PX);
        let [mut phase, period] = [&*surface.phase, surface.period].map(
            #[inline(always)]
            |plane| block(plane, left, top),
        );
        unwrap(&mut phase, &period, surface.sign);
        let (right, down, largest) = steps(&phase, &period, surface.sign);
        let first = self.all.len();
        if largest < INNER_RAD {
            write(surface.phase, left, top, &phase);
            let plane = plane(&phase);
            let carrier = surface.sign * TAU / period[MIDDLE / CELL_PX][MIDDLE % CELL_PX];
            self.add(ALL, (column, row), &phase, [&right, &down], carrier);
            // The plane through all pixels has less noise than one pixel.
            let (u, v) = (MIDDLE % CELL_PX, MIDDLE / CELL_PX);
            self.all[first].phase = plane.at(u as f32, v as f32);
            self.grid[row * self.columns + column] = Spot { first: first as u32, count: 1 };
            self.lookup.set(column, row, CellContent::of_plane(first as u32, plane));
        } else {
            self.cut_up(surface, (column, row), &Cell { phase, period, right, down, object });
        }
    }

    /// The patches of a cell that no smooth surface fills.
    #[inline(never)]
    fn cut_up(&mut self, surface: &mut Surface<'_>, (column, row): (usize, usize), cell: &Cell) {
        let top = row * CELL_PX;
        let Cell { phase, period, right, down, object } = cell;
        let first = self.all.len();
        write(surface.phase, column * CELL_PX, top, phase);
        each_patch(phase, right, down, |mask| {
            let pixel = middle(mask);
            let carrier = surface.sign * TAU / period[pixel / CELL_PX][pixel % CELL_PX];
            self.add(mask, (column, row), phase, [right, down], carrier);
        });
        let count = self.all.len() - first;
        self.grid[row * self.columns + column] = Spot { first: first as u32, count: count as u32 };
        let mut rim = object.to_le_bytes().map(|object| RimRow::new(first as u32, object));
        for (v, (row, phase)) in rim.iter_mut().zip(phase).enumerate() {
            let line = &mut row.phase;
            line[..CELL_PX].copy_from_slice(phase);
            // The next cell's phases are not unwrapped with this one's.
            let last = CELL_PX - 1;
            let (u, v) = ((column + 1) * CELL_PX, top + v);
            if v < surface.phase.height() && u < surface.phase.width() {
                let carrier =
                    surface.sign * 2.0 * TAU / (period[v % CELL_PX][last] + surface.period.at(u, v));
                let step = surface.phase.at(u, v) - phase[last] - carrier;
                line[CELL_PX] = phase[last] + carrier + (step - TAU * nearest(step / TAU));
            }
        }
        for (i, patch) in self.all[first..].iter().enumerate() {
            for (row, mask) in rim.iter_mut().zip(patch.mask.to_le_bytes()) {
                for u in (0..CELL_PX).filter(|u| mask >> u & 1 != 0) {
                    row.of[u] = i as u8 + 1;
                }
            }
        }
        self.lookup.set_rim(column, row, rim);
    }

    /// Adds a patch: these pixels of a cell, with the steps to the right and down of its pixels.
    #[inline(always)]
    fn add(
        &mut self,
        mask: u64,
        (column, row): (usize, usize),
        phase: &Block,
        [right, down]: [&Block; 2],
        carrier: f32,
    ) {
        let place = if mask == ALL { MIDDLE } else { middle(mask) };
        let (u, v) = (place % CELL_PX, place / CELL_PX);
        let inner = [mask & (mask << 1) & !FIRST_COLUMN, mask & (mask << CELL_PX)];
        self.all.push(Patch {
            pixel: ((row * CELL_PX + v) * self.width + column * CELL_PX + u) as u32,
            phase: phase[v][u],
            size: mask.count_ones(),
            cell: (row * self.columns + column) as u32,
            mask,
            steps: [mean(inner[0], right), mean(inner[1], down)],
            carrier,
        });
    }

    /// Adds to the phases of every patch what `by` has for it; NaN takes them away.
    #[inline(always)]
    pub fn shift(&self, phase: &mut Plane<f32>, by: &[f32]) {
        for (cell, &Spot { first, count }) in self.grid.iter().enumerate().filter(|(_, spot)| spot.count > 0)
        {
            let (left, top) = (cell % self.columns * CELL_PX, cell / self.columns * CELL_PX);
            let mut add = [[f32::NAN; CELL_PX]; CELL_PX];
            for patch in first as usize..(first + count) as usize {
                let (mask, by) = (self.all[patch].mask, by[patch]);
                if mask == ALL {
                    add = [[by; CELL_PX]; CELL_PX];
                    break;
                }
                for (add, row) in add.iter_mut().zip(mask.to_le_bytes()) {
                    for (u, add) in add.iter_mut().enumerate() {
                        *add = if row >> u & 1 != 0 { by } else { *add };
                    }
                }
            }
            for (v, add) in (top..phase.height()).zip(&add) {
                let row = phase.row_mut(v);
                let mut sum: [f32; CELL_PX] = part(row, left, f32::NAN);
                sum.iter_mut().zip(add).for_each(|(sum, add)| *sum += add);
                put(row, left, &sum);
            }
        }
    }
}

/// Values of a cell; NaN beyond the region of interest.
#[inline(always)]
pub(super) fn block(plane: &Plane<f32>, left: usize, top: usize) -> Block {
    let mut out = [[f32::NAN; CELL_PX]; CELL_PX];
    for (v, out) in (top..plane.height()).zip(&mut out) {
        *out = part(plane.row(v), left, f32::NAN);
    }
    out
}

/// Writes a cell's values, as far as the region of interest goes.
#[inline(always)]
fn write(plane: &mut Plane<f32>, left: usize, top: usize, values: &Block) {
    for (v, values) in (top..plane.height()).zip(values) {
        put(plane.row_mut(v), left, values);
    }
}

/// Unwraps the phases of a cell along the carrier of its middle.
#[inline(always)]
fn unwrap(phase: &mut Block, period: &Block, sign: f32) {
    let (mut u0, mut v0) = (MIDDLE % CELL_PX, MIDDLE / CELL_PX);
    if phase[v0][u0].is_nan() {
        let known = bits_of_cell(
            #[inline(always)]
            |u, v| !phase[v][u].is_nan(),
        );
        (u0, v0) = (middle(known) % CELL_PX, middle(known) / CELL_PX);
    }
    let (centre, step) = (phase[v0][u0], sign * TAU / period[v0][u0]);
    let mut ramp = [0.0; CELL_PX];
    for (u, ramp) in ramp.iter_mut().enumerate() {
        *ramp = centre + step * (u as f32 - u0 as f32);
    }
    for row in phase.iter_mut() {
        for u in 0..CELL_PX {
            row[u] -= TAU * nearest((row[u] - ramp[u]) * (1.0 / TAU));
        }
    }
}

/// Steps to the right beyond the carrier's, and steps down, of a cell's pixels, 0 where these are from another cell;
/// and the largest of all, NaN where one is not known.
#[inline(always)]
fn steps(phase: &Block, period: &Block, sign: f32) -> (Block, Block, f32) {
    let (mut right, mut down) = ([[0.0; CELL_PX]; CELL_PX], [[0.0; CELL_PX]; CELL_PX]);
    // Positive floats are ordered as their bits are, with NaN above all.
    let mut largest = [0u32; CELL_PX];
    let turn = sign * 2.0 * TAU;
    for v in 0..CELL_PX {
        for u in 1..CELL_PX {
            right[v][u] = phase[v][u] - phase[v][u - 1] - turn / (period[v][u] + period[v][u - 1]);
        }
        for u in 0..CELL_PX {
            largest[u] = largest[u].max(right[v][u].abs().to_bits());
        }
    }
    for v in 1..CELL_PX {
        for u in 0..CELL_PX {
            down[v][u] = phase[v][u] - phase[v - 1][u];
            largest[u] = largest[u].max(down[v][u].abs().to_bits());
        }
    }
    let mut most = 0;
    for largest in largest {
        most = most.max(largest);
    }
    (right, down, f32::from_bits(most))
}

/// Which pixels of a row of cells are the object's, a bit for each.
#[derive(Debug)]
struct Object {
    /// A bit for each pixel, row by row.
    bits: Vec<u64>,
    words: usize,
}

impl Object {
    /// For a region of interest of `width` pixels.
    fn new(width: usize) -> Self {
        let words = width.div_ceil(WORD);
        Self { bits: vec![0; CELL_PX * words], words }
    }

    /// Goes to a row of cells.
    #[inline(always)]
    fn mark(&mut self, runs: &Runs, row: usize) {
        self.bits.fill(0);
        for (v, bits) in (row * CELL_PX..runs.height()).zip(self.bits.chunks_exact_mut(self.words)) {
            runs.row(v).iter().for_each(|run| bit_rows::set(bits, run.columns()));
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

/// All pixels that are connected with `seed`: `right` and `down` have a bit for each pixel that continues the one to
/// its left and above it.
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

/// The pixel of a patch that is nearest to the cell's middle, the first of several.
#[inline(always)]
fn middle(mask: u64) -> usize {
    /// The pixels of a cell by their distance from its middle, along rows and columns together.
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

/// Calls `each` with the connected pixels of a cell, patch by patch.
#[inline(always)]
fn each_patch(phase: &Block, right_steps: &Block, down_steps: &Block, mut each: impl FnMut(u64)) {
    let mut rest = bits_of_cell(
        #[inline(always)]
        |u, v| !phase[v][u].is_nan(),
    );
    let right = bits_of_cell(
        #[inline(always)]
        |u, v| right_steps[v][u].abs() < INNER_RAD,
    );
    let down = bits_of_cell(
        #[inline(always)]
        |u, v| down_steps[v][u].abs() < INNER_RAD,
    );
    while rest != 0 {
        let mask = flood(rest & rest.wrapping_neg(), right & !FIRST_COLUMN, down & !FIRST_ROW);
        rest &= !mask;
        each(mask);
    }
}

/// The mean of some values over the pixels of a mask; 0 where there are none.
#[inline(always)]
fn mean(mask: u64, values: &Block) -> f32 {
    let mut sums = [0f32; CELL_PX];
    for (values, bits) in values.iter().zip(mask.to_le_bytes()) {
        for (u, (sum, value)) in sums.iter_mut().zip(values).enumerate() {
            *sum += if bits >> u & 1 != 0 { *value } else { 0.0 };
        }
    }
    sum(&sums) / mask.count_ones().max(1) as f32
}

/// The plane of a cell that one patch fills.
#[inline(always)]
fn plane(phase: &Block) -> lookup::Plane {
    /// Rows and columns of half a cell, px.
    const HALF: usize = CELL_PX / 2;
    let mut halves = [[0f32; CELL_PX]; 2];
    for (v, row) in phase.iter().enumerate() {
        for u in 0..CELL_PX {
            halves[v / HALF][u] += row[u];
        }
    }
    let quarters = |row: &[f32; CELL_PX]| {
        let [a, b, c, d, e, f, g, h] = *row;
        [(a + b) + (c + d), (e + f) + (g + h)]
    };
    let ([a, b], [c, d]) = (quarters(&halves[0]), quarters(&halves[1]));
    // Halves are four pixels apart, and have 32.
    let per = 1.0 / (HALF * HALF * CELL_PX) as f32;
    let steps = [((b + d) - (a + c)) * per, ((c + d) - (a + b)) * per];
    let middle = ((a + b) + (c + d)) / (CELL_PX * CELL_PX) as f32;
    let corner = middle - (steps[0] + steps[1]) * (CELL_PX - 1) as f32 / 2.0;
    lookup::Plane { phase: corner, steps }
}

/// The sum of a row's values.
#[inline(always)]
fn sum(row: &[f32; CELL_PX]) -> f32 {
    let [a, b, c, d, e, f, g, h] = *row;
    ((a + b) + (c + d)) + ((e + f) + (g + h))
}

#[cfg(test)]
mod tests {
    use super::{CELL_PX, Patches, Surface};
    use crate::base::image::Plane;
    use crate::kernels::pixel_runs::Runs;
    use proptest::prelude::{ProptestConfig, prop_assert, prop_assert_eq, proptest};
    use std::f32::consts::TAU;

    const W: usize = 140;
    const H: usize = 90;
    const PERIOD: f32 = 11.0;

    /// A tilted, gently curved surface: absolute phases, rad.
    fn surface(tilt: f32, curve: f32) -> Plane<f32> {
        let mut truth = Plane::filled(W, H, f32::NAN);
        for v in 0..H {
            for u in 0..W {
                let (x, y) = (u as f32 - 60.0, v as f32 - 45.0);
                truth.set(u, v, 80.0 * TAU + TAU * x / PERIOD + tilt * y + curve * (x * x + y * y));
            }
        }
        truth
    }

    /// The patches of a planted absolute phase, and the whole turns that make each of them absolute.
    fn cut(truth: &Plane<f32>) -> (Patches, Vec<i32>) {
        let wrapped = truth.as_slice().iter().map(|&x: &f32| x - TAU * (x / TAU).round()).collect();
        let mut phase = Plane::from_vec(W, H, wrapped).expect("same size");
        let (period, object) = (Plane::filled(W, H, PERIOD), Runs::of(&Plane::filled(W, H, 1u8)));
        let mut surface = Surface { phase: &mut phase, period: &period, object: &object, sign: 1.0 };
        let patches = Patches::cut(&mut surface);
        let turns = |pixel: u32, phase: f32| {
            let turns = (truth.as_slice()[pixel as usize] - phase) / TAU;
            assert!((turns - turns.round()).abs() < 0.02, "{turns}");
            turns.round() as i32
        };
        let turns: Vec<i32> = patches.all.iter().map(|patch| turns(patch.pixel, patch.phase)).collect();
        // What is written back lacks the same turns.
        for (patch, turns) in patches.all.iter().zip(&turns) {
            let pixel = patch.pixel as usize;
            let found = phase.as_slice()[pixel] + TAU * *turns as f32;
            assert!((found - truth.as_slice()[pixel]).abs() < 0.05, "{found}");
        }
        (patches, turns)
    }

    /// How many patches are linked with the first, directly or not.
    fn joined(patches: &Patches) -> usize {
        let mut of: Vec<usize> = (0..patches.all.len()).collect();
        loop {
            let before = of.clone();
            for link in &patches.links {
                let least = of[link.a as usize].min(of[link.b as usize]);
                (of[link.a as usize], of[link.b as usize]) = (least, least);
            }
            if of == before {
                return of.iter().filter(|&&x| x == 0).count();
            }
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]
        #[test]
        fn a_smooth_surface_hangs_together_with_the_turns_that_it_has(
            tilt in -0.4f32..0.4,
            curve in -0.0005f32..0.0005,
        ) {
            let (patches, turns) = cut(&surface(tilt, curve));
            for link in &patches.links {
                prop_assert_eq!(turns[link.b as usize] - turns[link.a as usize], link.turns);
            }
            prop_assert_eq!(joined(&patches), patches.all.len());
            // The last columns and rows are parts of cells.
            prop_assert_eq!(patches.all.len(), W.div_ceil(CELL_PX) * H.div_ceil(CELL_PX));
        }

        // A step of 0.98 rad between two planes that do not bend is as likely on one surface as between two; nearer
        // ones are links.
        #[test]
        fn no_link_leads_over_a_depth_step(step in 1.0f32..5.28, tilt in -0.1f32..0.1, at in 40usize..60) {
            let mut truth = surface(tilt, 0.0);
            for v in at..H {
                truth.row_mut(v).iter_mut().for_each(|x| *x += step + 2.0 * TAU);
            }
            let (patches, _) = cut(&truth);
            let is_below = |patch: u32| patches.all[patch as usize].pixel as usize / W >= at;
            for link in &patches.links {
                prop_assert!(is_below(link.a) == is_below(link.b), "{link:?}");
            }
        }
    }
}
