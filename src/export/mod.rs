//! Point clouds and pictures on their way out: PLY, MCAP, PNG.

mod cloud;

pub use cloud::{Cloud, NO_CAMERA};
