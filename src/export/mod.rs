//! Point clouds and pictures on their way out: PLY, MCAP, PNG.

mod cloud;
/// Binary PLY files.
pub mod ply;
/// Sequences of clouds as MCAP.
pub mod sequence;
/// Pictures of clouds.
pub mod view;

pub use cloud::{Cloud, NO_CAMERA};
