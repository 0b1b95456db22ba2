//! Steps between the pixels of a row of cells, for all of its cells at once.
//!
//! Most cells are filled by one smooth surface. Of these nobody asks for single pixels: the largest step of each column
//! and the sums of columns tell all that their nodes need.

use super::cells::{CELL_PX, Patch, Surface};
use crate::reconstruct::prefetch;
use crate::reconstruct::sample::chunk;
use std::f32::consts::TAU;
use std::ops::Range;

/// Columns, and rows, of a cell's half.
pub(super) const HALF: usize = CELL_PX / 2;

/// A value for each column of a cell.
type Columns<T> = [T; CELL_PX];

/// What is known of each pixel column of a row of cells. Steps to the right are those beyond the carrier's, from the column before.
/// The largest ones are bits of numbers without a sign: these are ordered as the numbers are, and NaN is above all.
#[derive(Debug, Default)]
pub(super) struct Steps {
    /// Largest step to the right.
    largest_right: Vec<u32>,
    /// Largest step down from row to row of the sensor within the cells.
    largest_down: Vec<u32>,
    /// The step down from the row above the cells.
    from_above: Vec<u32>,
    /// Steps to the right, row by row.
    rows: [Vec<f32>; CELL_PX],
    /// Their sums.
    right: Vec<f32>,
    /// Sums of steps down within the cells.
    down: Vec<f32>,
    /// Sums of phases: of the upper rows, and of the lower ones.
    phases: [Vec<f32>; 2],
}

impl Steps {
    /// For rows of so many cells.
    pub(super) fn new(columns: usize) -> Self {
        let (bits, sums) = (vec![0; columns * CELL_PX], vec![0.0; columns * CELL_PX]);
        Self {
            largest_right: bits.clone(),
            largest_down: bits.clone(),
            from_above: bits,
            rows: [(); CELL_PX].map(|()| vec![f32::NAN; columns * CELL_PX]),
            right: sums.clone(),
            down: sums.clone(),
            phases: [sums.clone(), sums],
        }
    }

    /// Looks at some cells of a row, as far as the region of interest goes.
    #[inline(always)]
    pub(super) fn measure(&mut self, surface: &Surface<'_>, row: usize, cells: Range<usize>) {
        let columns = cells.start * CELL_PX..(cells.end * CELL_PX).min(surface.phase.width());
        let top = row * CELL_PX;
        self.largest_right[columns.clone()].fill(0);
        self.largest_down[columns.clone()].fill(0);
        for sums in [&mut self.right, &mut self.down].into_iter().chain(&mut self.phases) {
            sums[columns.clone()].fill(0.0);
        }
        let end = surface.phase.height().min(top + CELL_PX);
        for beyond in &mut self.rows[end - top..] {
            beyond[columns.clone()].fill(f32::NAN);
        }
        for v in top..end {
            let soon = v + prefetch::AHEAD;
            prefetch::row(surface.phase, surface.runs, soon);
            prefetch::row(surface.period, surface.runs, soon);
            self.right(surface, v, columns.start.max(1)..columns.end);
            let phase = &surface.phase.row(v)[columns.clone()];
            let sums = &mut self.phases[(v - top) / HALF][columns.clone()];
            sums.iter_mut().zip(phase).for_each(|(sum, phase)| *sum += phase);
            let Some(above) = v.checked_sub(1) else { continue };
            let above = &surface.phase.row(above)[columns.clone()];
            if v == top {
                let out = self.from_above[columns.clone()].iter_mut();
                for (out, (phase, above)) in out.zip(phase.iter().zip(above)) {
                    *out = (phase - above).abs().to_bits();
                }
            } else {
                let (n, per_row) = (columns.len(), 1.0 / surface.sensor_rows);
                let (phase, above) = (&phase[..n], &above[..n]);
                let sums = &mut self.down[columns.clone()][..n];
                let largest = &mut self.largest_down[columns.clone()][..n];
                for i in 0..n {
                    let step = phase[i] - above[i];
                    sums[i] += step;
                    largest[i] = largest[i].max((per_row * step).abs().to_bits());
                }
            }
        }
    }

    /// The steps to the right of pixel row `v`.
    #[inline(always)]
    fn right(&mut self, surface: &Surface<'_>, v: usize, columns: Range<usize>) {
        let n = columns.len();
        let (start, before) = (columns.start, columns.start - 1);
        let (phase, period) = (surface.phase.row(v), surface.period.row(v));
        let (a, b) = (&phase[before..][..n], &phase[start..][..n]);
        let (p, q) = (&period[before..][..n], &period[start..][..n]);
        let (sums, largest) = (&mut self.right[start..][..n], &mut self.largest_right[start..][..n]);
        let out = &mut self.rows[v % CELL_PX][start..][..n];
        let turn = surface.sign * 2.0 * TAU;
        for i in 0..n {
            let step = b[i] - a[i] - turn / (p[i] + q[i]);
            out[i] = step;
            sums[i] += step;
            largest[i] = largest[i].max(step.abs().to_bits());
        }
    }

    /// The largest step within a cell of all rows, to the right or down.
    #[inline(always)]
    pub(super) fn largest(&self, left: usize) -> f32 {
        let (right, down): (&Columns<u32>, &Columns<u32>) =
            (chunk(&self.largest_right, left), chunk(&self.largest_down, left));
        let mut largest = down[0];
        for u in 1..CELL_PX {
            largest = largest.max(right[u]).max(down[u]);
        }
        f32::from_bits(largest)
    }

    /// The largest step to a cell from that to its left, and from that above it.
    #[inline(always)]
    pub(super) fn into(&self, left: usize) -> [f32; 2] {
        let above: &Columns<u32> = chunk(&self.from_above, left);
        let mut largest = 0;
        for &step in above {
            largest = largest.max(step);
        }
        [self.largest_right[left], largest].map(f32::from_bits)
    }

    /// The steps to the right of a cell; 0 where these are from another, and NaN beyond the region of interest.
    #[inline(always)]
    pub(super) fn to_the_right(&self, left: usize) -> Patch {
        let mut out = [[0.0; CELL_PX]; CELL_PX];
        for (out, row) in out.iter_mut().zip(&self.rows) {
            *out = *chunk(row, left);
            out[0] = 0.0;
        }
        out
    }

    /// Sums of the steps to the right and down between the pixels of a cell.
    #[inline(always)]
    pub(super) fn sums(&self, left: usize) -> [f32; 2] {
        let (mut right, down): (Columns<f32>, &Columns<f32>) =
            (*chunk(&self.right, left), chunk(&self.down, left));
        right[0] = 0.0;
        [sum(&right), sum(down)]
    }

    /// Sums of the phases of a cell's quarters: above on the left and on the right, and below.
    #[inline(always)]
    pub(super) fn quarters(&self, left: usize) -> [[f32; 2]; 2] {
        let [above, below] = &self.phases;
        [halves(chunk(above, left)), halves(chunk(below, left))]
    }
}

/// The sums of the left and the right half of a cell's columns.
#[inline(always)]
fn halves(columns: &Columns<f32>) -> [f32; 2] {
    let [a, b, c, d, e, f, g, h] = *columns;
    [(a + b) + (c + d), (e + f) + (g + h)]
}

/// The sum of a cell's columns.
#[inline(always)]
pub(super) fn sum(columns: &Columns<f32>) -> f32 {
    let [left, right] = halves(columns);
    left + right
}
