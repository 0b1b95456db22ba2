//! Point clouds, meshes, pictures and tables on their way out: files that other programs read.

mod cloud;
mod e57_file;
mod format;
/// Frames to pictures.
pub mod frames;
mod glb;
/// Clouds to files of other formats, many at a time.
pub mod job;
/// Directional clouds to merged ones.
pub mod merge;
/// Triangle meshes.
pub mod mesh;
mod pcd;
/// Phase maps as files.
pub mod phase_file;
mod phase_map;
/// Binary PLY files.
pub mod ply;
/// Sequences of clouds as MCAP.
pub mod sequence;
mod shape;
mod source;
mod text;
/// When every frame was.
pub mod timing;
/// Pictures of clouds.
pub mod view;
mod whole;

pub use cloud::{Cloud, NO_CAMERA};
pub use format::Format;
pub use job::merged_cloud;
pub use phase_map::{PhaseMap, Run, STEPS_PER_FRINGE, STEPS_PER_LEVEL, doubt_of, doubt_rad};
pub use shape::Shape;
pub use source::{CloudSource, Commented, PlyDirectory};
pub use whole::{STALE, remove_stale, write_new, write_whole, write_whole_cached};
