//! Point clouds and pictures on their way out: PLY, MCAP, PNG.

mod cloud;
/// Binary PLY files.
pub mod ply;

pub use cloud::{Cloud, NO_CAMERA};
