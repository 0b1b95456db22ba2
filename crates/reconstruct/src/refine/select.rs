// SPDX-License-Identifier: MIT OR Apache-2.0
//! Absolute phase Fm: which of the unwrapped pixels are good enough to become points.
//!
//! A demodulation window that crosses a depth step mixes two surfaces; its phase is neither's. Such pixels are
//! dropped with a margin, unless it is certain that their own has not: completeness may suffer, truth may not.

use super::FrameMaps;
use crate::base::image::Plane;
use crate::kernels::pixel_runs::{Run, each_not_0};
use crate::kernels::{prefetch, simd};
use crate::phase::window_quality::DOUBTFUL_MISFIT;
use std::f32::consts::TAU;

/// Neighbours whose phases differ from the carrier by more are on two surfaces, rad.
const STEP_RAD: f32 = 1.2;

/// Windows of a larger misfit do not look like a fringe, relative to B. Fringes that are lost in noise have one, too: how
/// faint a fringe may be depends on the noise alone.
const MAX_MISFIT: f32 = 0.6;

/// Rows of marks around the row that is worked on.
#[derive(Debug, Default)]
struct Buffers {
    /// 1 near a step, for three rows.
    near: [Vec<u8>; 3],
    /// 1 where the step to the row below is one between surfaces.
    down: Vec<u8>,
    /// 1 beside such a step.
    beside: Vec<u8>,
    right: Vec<u8>,
}

/// Drops pixels that do not look like a fringe, or lie near a depth step; `absolute`, which is known within
/// `runs` only, becomes NaN there. Returns how many were dropped.
pub fn select(
    absolute: &mut Plane<f32>,
    FrameMaps { runs, period, windows, sign, .. }: FrameMaps<'_>,
) -> usize {
    let (w, h) = (absolute.width(), absolute.height());
    let mut buffers = Buffers::default();
    for row in buffers.near.iter_mut().chain([&mut buffers.down, &mut buffers.beside, &mut buffers.right]) {
        row.clear();
        row.resize(w, 0);
    }
    let mut dropped = 0;
    simd::dispatch(
        #[inline(always)]
        || {
            for next in 0..h + 1 {
                let soon = next + prefetch::AHEAD;
                prefetch::row(absolute, runs, soon);
                prefetch::row(period, runs, soon);
                prefetch::row(&windows.misfit, runs, soon);
                if next < h {
                    buffers.near[(next + 1) % 3].fill(0);
                    let below = (next + 1 < h).then(|| absolute.row(next + 1));
                    for run in runs.row(next) {
                        let rows = (absolute.row(next), below, period.row(next));
                        buffers.mark(run, rows, sign);
                    }
                }
                let Some(v) = next.checked_sub(1) else { continue };
                for run in runs.row(v) {
                    let columns = run.columns();
                    let misfit = &windows.misfit.row(v)[columns.clone()];
                    let near = &buffers.near[v % 3][columns.clone()];
                    let phase = &mut absolute.row_mut(v)[columns];
                    dropped += drop_from(phase, misfit, near);
                }
            }
        },
    );
    dropped
}

impl Buffers {
    /// Marks what lies within half a period along the row, in this row and those beside it, of the pixels of a run that
    /// have a neighbour on another surface. `rows`: the phases of the row and of that below, and the row's periods.
    #[inline(always)]
    fn mark(&mut self, run: &Run, (row, below, period): (&[f32], Option<&[f32]>, &[f32]), sign: f32) {
        let (start, n) = (run.start(), run.columns().len());
        let (row, p) = (&row[run.columns()][..n], &period[run.columns()][..n]);
        let (right, beside) = (&mut self.right[..n], &mut self.beside[..n]);
        for i in 0..n - 1 {
            // The carrier's step is a turn per mean period. Both sides are multiplied by the periods: division is slow.
            let both = p[i] + p[i + 1];
            right[i] = u8::from(((row[i + 1] - row[i]) * both - sign * 2.0 * TAU).abs() > STEP_RAD * both);
        }
        right[n - 1] = 0;
        // Steps from the row above. Unknown phases have no step, so that pixels beside other runs are 0.
        let down = &mut self.down[run.columns()][..n];
        beside.copy_from_slice(down);
        match below {
            None => down.fill(0),
            Some(below) => {
                let below = &below[run.columns()][..n];
                for i in 0..n {
                    down[i] = u8::from((below[i] - row[i]).abs() > STEP_RAD);
                }
            }
        }
        for i in 0..n {
            beside[i] |= down[i] | right[i];
        }
        for i in 1..n {
            beside[i] |= right[i - 1];
        }
        // The stretch that is marked next; the marks of neighbouring pixels overlap and are joined.
        let (mut first, mut end) = (0, 0);
        let near = &mut self.near;
        let mut fill = |first: usize, end: usize| {
            for row in near.iter_mut() {
                let end = end.min(row.len());
                row[first..end].fill(1);
            }
        };
        each_not_0(beside, |i| {
            let reach = (p[i] / 2.0).ceil() as usize;
            let from = (start + i).saturating_sub(reach);
            if from > end {
                fill(first, end);
                first = from;
            }
            first = first.min(from);
            end = end.max(start + i + reach + 1);
        });
        fill(first, end);
    }
}

/// Drops the pixels of a run that are unlike a fringe or near a step; returns how many.
#[inline(always)]
fn drop_from(phase: &mut [f32], misfit: &[f32], near: &[u8]) -> usize {
    let n = phase.len();
    let (misfit, near) = (&misfit[..n], &near[..n]);
    let mut dropped = 0u32;
    for i in 0..n {
        let apart = (near[i] == 0) | (misfit[i] < DOUBTFUL_MISFIT);
        let good = (misfit[i] <= MAX_MISFIT) & apart;
        dropped += u32::from(!good & !phase[i].is_nan());
        phase[i] = if good { phase[i] } else { f32::NAN };
    }
    dropped as usize
}
