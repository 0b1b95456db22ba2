//! Absolute phase Fm, made better pixel by pixel: what is kept, and corrections for curvature and edges of colour.

/// Phase at edges of colour.
pub mod albedo_edges;
/// Phase on curved surfaces.
pub mod curvature;
/// Runs of pixels completed at their ends.
pub(crate) mod extend_runs;
/// Which pixels give a point.
pub mod select;
/// Standard uncertainty of a point.
pub mod uncertainty;
