// SPDX-License-Identifier: MIT OR Apache-2.0
//! Rows of phases that may support others, around the row that is worked on.

use super::pixel_runs::{Run, Runs};
use crate::base::image::Plane;

/// A ring of rows with room to either side: NaN there, and wherever a phase is no support.
#[derive(Debug, Default)]
pub(crate) struct Support {
    rows: Vec<Vec<f32>>,
    /// Rows above the first and below the last one.
    none: Vec<f32>,
    pad: usize,
    reach: usize,
    /// Rows `0 .. filled` have been filled.
    filled: usize,
    height: usize,
}

impl Support {
    /// Begins a frame: rows up to `reach` away, and `pad` columns beyond either end, can be read.
    pub fn begin(&mut self, plane: &Plane<f32>, reach: usize, pad: usize) {
        let width = plane.width() + 2 * pad;
        self.rows.resize_with(2 * reach + 1, Vec::new);
        for row in self.rows.iter_mut().chain([&mut self.none]) {
            row.clear();
            row.resize(width, f32::NAN);
        }
        (self.pad, self.reach, self.filled, self.height) = (pad, reach, 0, plane.height());
    }

    /// Moves to row `v`, after row `v - 1`. Phases of `plane` are known within `runs`; `choose` is given a run's row
    /// and columns, its phases, and where those of them go that are support, NaN for the others.
    #[inline(always)]
    pub fn advance(
        &mut self,
        v: usize,
        plane: &Plane<f32>,
        runs: &Runs,
        choose: impl Fn(usize, &Run, &[f32], &mut [f32]),
    ) {
        while self.filled <= v + self.reach && self.filled < self.height {
            let (row, slots) = (self.filled, self.rows.len());
            let to = &mut self.rows[row % slots][self.pad..];
            if let Some(before) = row.checked_sub(slots) {
                for run in runs.row(before) {
                    to[run.columns()].fill(f32::NAN);
                }
            }
            for run in runs.row(row) {
                choose(row, run, &plane.row(row)[run.columns()], &mut to[run.columns()]);
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
