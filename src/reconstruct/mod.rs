//! One frame to one point cloud: the phase pipeline (paper, section 4.1).
//!
//! Knows nothing of cameras, networks or tokio, and builds without Aravis.

mod source;

pub use source::{Frame, FrameSource};
