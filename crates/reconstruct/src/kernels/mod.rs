// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the stages are computed with: vectors of the processor, fast functions, runs of pixels, buffers, stage times.

pub(crate) mod bit_rows;
pub(crate) mod buffer_pool;
/// Connected parts of a map.
pub mod connected_components;
pub(crate) mod fast_atan2;
pub(crate) mod fast_round;
pub(crate) mod pixel_runs;
pub(crate) mod prefetch;
/// The part of a frame that is worked on.
pub mod region_of_interest;
pub(crate) mod row_support;
/// Which vector instructions are used.
pub mod simd;
pub(crate) mod sliding;
pub(crate) mod stage_times;
pub(crate) mod subpixel;
