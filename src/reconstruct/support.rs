//! Rows of phases that may support others, around the row that is worked on.

use crate::image::Plane;
use std::ops::Range;

/// The columns from the first known phase of a row to the last.
#[inline(always)]
pub(super) fn known_part(row: &[f32]) -> Range<usize> {
    match row.iter().position(|x| !x.is_nan()) {
        None => 0..0,
        Some(first) => first..row.iter().rposition(|x| !x.is_nan()).map_or(first, |last| last + 1),
    }
}

/// A ring of rows with room to either side: NaN there, and wherever a phase is no support.
#[derive(Debug, Default)]
pub(super) struct Support {
    rows: Vec<Vec<f32>>,
    /// What is written of each of them.
    written: Vec<Range<usize>>,
    /// Rows above the first and below the last one.
    none: Vec<f32>,
    pad: usize,
    reach: usize,
    /// Rows `0 .. filled` have been filled.
    filled: usize,
    height: usize,
}

impl Support {
    /// Begins a frame: rows up to `reach` away, and `pad` columns beyond either end, can be asked for.
    pub fn begin(&mut self, plane: &Plane<f32>, reach: usize, pad: usize) {
        let width = plane.width() + 2 * pad;
        self.rows.resize_with(2 * reach + 1, Vec::new);
        self.written.clear();
        self.written.resize(self.rows.len(), 0..0);
        for row in self.rows.iter_mut().chain([&mut self.none]) {
            row.clear();
            row.resize(width, f32::NAN);
        }
        (self.pad, self.reach, self.filled, self.height) = (pad, reach, 0, plane.height());
    }

    /// Moves to row `v`, after row `v - 1`: `supports(row, column)` tells which phases of `plane` do.
    #[inline(always)]
    pub fn advance(&mut self, v: usize, plane: &Plane<f32>, supports: impl Fn(usize, usize) -> bool) {
        while self.filled <= v + self.reach && self.filled < self.height {
            let (row, slots) = (self.filled, self.rows.len());
            let to = &mut self.rows[row % slots][self.pad..];
            let known = known_part(plane.row(row));
            let written = std::mem::replace(&mut self.written[row % slots], known.clone());
            to[written].fill(f32::NAN);
            let first = known.start;
            for (i, (to, &phase)) in to[known.clone()].iter_mut().zip(&plane.row(row)[known]).enumerate() {
                *to = if supports(row, first + i) { phase } else { f32::NAN };
            }
            self.filled += 1;
        }
    }

    /// Row `v + below - reach`; column u is at `u + pad`.
    #[inline(always)]
    pub fn row(&self, v: usize, below: usize) -> &[f32] {
        match (v + below).checked_sub(self.reach) {
            Some(row) if row < self.height => &self.rows[row % self.rows.len()],
            _ => &self.none,
        }
    }
}
