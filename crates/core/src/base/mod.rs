// SPDX-License-Identifier: MIT OR Apache-2.0
//! What everything stands on: identifiers, images, clocks, histograms, files that are written whole, files and
//! JSON of other programs, faults, printing.

mod atomic_file;
/// A straight line from one clock's time to another's, from samples of both.
pub mod clock_fit;
mod fault;
/// Histograms of durations, counted without locks.
pub mod histogram;
/// Identifiers that must not be mixed up.
pub mod ids;
/// Row-major image planes and grey PNG files.
pub mod image;
/// JSON of other programs, in which an object is an object.
pub mod json;
/// Photographs in the formats of other recorders.
#[cfg(feature = "photographs")]
pub mod photograph;
/// Text that may be printed to a terminal, or put into a page.
pub mod print;
/// Files of other programs: regular, of a bounded size, without waiting.
pub mod regular;
mod scratch;
/// The host's clocks: time of day and monotonic time.
pub mod time;

pub use atomic_file::{STALE, remove_stale, write_new, write_whole, write_whole_cached};
pub use fault::{Exit, Fault, FileError};
pub use scratch::Scratch;
