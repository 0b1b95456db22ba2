// SPDX-License-Identifier: MIT OR Apache-2.0
//! Prefetches of memory that is needed soon.
//!
//! Rows of planes lie far from each other, and only a part of each is used: the processor, which looks ahead along one
//! stretch of memory, sees each run's beginning too late. A prefetch costs one instruction, and nothing waits for it.

use super::pixel_runs::Runs;
use crate::base::image::Plane;

/// How many rows ahead of the one that is worked on memory is prefetched.
pub(crate) const AHEAD: usize = 2;

/// Bytes of a cache line.
pub(crate) const LINE: usize = 64;

/// Prefetches a value of a row, if there is such a value.
#[inline(always)]
pub(crate) fn value<T>(row: &[T], at: usize) {
    if let Some(value) = row.get(at) {
        line(value);
    }
}

/// Prefetches what the runs of row `v` hold of a plane, if there is such a row.
#[inline(always)]
pub(crate) fn row<T: Copy>(plane: &Plane<T>, runs: &Runs, v: usize) {
    if v >= plane.height() {
        return;
    }
    for run in runs.row(v) {
        // By chunks: of steps the compiler makes ten instructions for each.
        for values in plane.row(v)[run.columns()].chunks(LINE / size_of::<T>()) {
            line(&values[0]);
        }
    }
}

/// Prefetches the cache line of a value.
#[inline(always)]
pub(crate) fn line<T>(value: &T) {
    #[cfg(target_arch = "x86_64")]
    // SAFETY: a hint, which reads nothing and faults nowhere. The standard library has no safe function for it.
    unsafe {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        _mm_prefetch::<_MM_HINT_T0>(std::ptr::from_ref(value).cast());
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = value;
}
