//! One frame to one point cloud: the phase pipeline (paper, section 4.1).
//!
//! Knows nothing of cameras, networks or tokio, and builds without Aravis. Each stage is a file of pure
//! functions over planes; [`pipeline`] composes them for one frame.

mod above;
/// Absolute phase: selection of the pixels that become points.
pub mod absolute;
mod angle;
/// A session to clouds on disk.
pub mod batch;
/// Frames of fewer rows, and their calibration.
pub mod binned;
mod bits;
/// From absolute phase to the cloud.
pub mod cloud;
/// The shards of a session to one result.
pub mod collect;
/// Connected components of a mask.
pub mod components;
/// Bias of the phase on curved surfaces.
pub mod curvature;
/// Whether the marker's dashes lie where the calibration has them.
pub mod dashes;
/// Wrapped phase Wm and modulation.
pub mod demodulate;
/// Maps as pictures.
pub mod dump;
/// Phase at edges of colour, and the error to expect of it.
pub mod edges;
/// Fringe orders of all views of one instant.
pub mod fringe_order;
/// From a photograph and its mask to wrapped phases and the marker.
pub mod front;
/// Directories of images.
pub mod image_tree;
/// What a result is made of.
pub mod key;
/// Marker map Mm.
pub mod marker;
/// Which of several markers it is.
pub mod marker_number;
/// Phase under the marker.
pub mod marker_phase;
/// Pieces of the marker's cores.
pub mod marker_pieces;
/// Object mask Om.
pub mod mask;
/// Normals from neighbouring points.
pub mod normals;
mod opening;
mod outcome;
/// What the pipeline must know of a camera and its projector.
pub mod pair;
/// The paper's method, plain.
pub mod paper;
/// Fringe period Pm of the default method.
pub mod period_fast;
#[cfg(test)]
mod phasors;
/// One frame to one directional cloud.
pub mod pipeline;
/// Frames from PNG files.
pub mod png_source;
mod pool;
mod prefetch;
/// What triangulation comes to along every line of sight.
pub mod rays;
/// What a reconstruction wrote, as clouds.
pub mod result;
/// The part of a frame that holds the object.
pub mod roi;
mod round;
mod run_ends;
/// Runs of a mask's pixels.
pub mod runs;
mod sample;
/// Bias of the phase under a gradient of light.
pub mod shading;
/// Vectors as wide as the processor has.
pub mod simd;
mod source;
/// Stored phase maps to clouds.
pub mod stored;
mod summary;
mod support;
mod timings;
/// From absolute phase to points.
pub mod triangulate;
/// Standard uncertainty of every phase.
pub mod uncertainty;
mod unchecked;
/// What later stages need of the demodulation's windows.
pub mod windows;

pub use source::{Frame, FrameSource, LostPart, SessionIdentity, SourceStatement, StatedCamera};
