//! Point clouds and pictures on their way out: PLY, MCAP, PNG.

mod cloud;
/// Phase maps as files.
pub mod phase_file;
mod phase_map;
/// Binary PLY files.
pub mod ply;
/// Sequences of clouds as MCAP.
pub mod sequence;
/// Pictures of clouds.
pub mod view;
mod whole;

pub use cloud::{Cloud, NO_CAMERA};
pub use phase_map::{PhaseMap, Run, STEPS_PER_FRINGE, STEPS_PER_LEVEL, doubt_of, doubt_rad};
pub use whole::{STALE, remove_stale, write_whole, write_whole_cached};
