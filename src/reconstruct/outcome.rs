//! What became of a frame: a cloud or a reason why there is none, and the pixel counts that tell how it went.

use super::dashes::Dashes;
use crate::export::Cloud;

/// What became of a frame.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Outcome {
    /// A cloud, which may leave parts unresolved.
    Cloud,
    /// No point can be trusted, for this reason.
    Refused(String),
}

/// Why a frame without light is refused.
pub(super) const NO_OBJECT: &str = "there is no object in the frame";

/// What to ask when dashes lie elsewhere.
pub(super) const WHY_ELSEWHERE: &str =
    "is it the calibration of another camera, or another projector's light, or has a device moved?";

/// Pixel counts that tell how a frame went.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Counts {
    /// Pixels on the object mask.
    pub object: usize,
    /// Pixels with a wrapped phase.
    pub phase: usize,
    /// Pixels on marker cores.
    pub marker: usize,
    /// Whether the marker's dashes lie where the calibration has them.
    pub dashes: Dashes,
    /// Pixels left out because their fringe order is not certain.
    pub refused: usize,
    /// Pixels dropped near depth steps, faint or not like a fringe.
    pub dropped: usize,
}

/// What a frame with this cloud has come to.
pub(super) fn outcome_of(cloud: &Cloud, counts: &Counts) -> Outcome {
    if cloud.is_empty() && counts.marker == 0 && counts.dashes.stretches > 0 {
        let reason = "what looks like the marker does not lie where the calibration has it, so that no fringe order is known";
        Outcome::Refused(format!("{reason}; {WHY_ELSEWHERE}"))
    } else if cloud.is_empty() && counts.marker == 0 {
        Outcome::Refused("no marker was found, so that no fringe order is known".to_owned())
    } else if cloud.is_empty() {
        Outcome::Refused("no pixel has a fringe order that can be trusted".to_owned())
    } else {
        Outcome::Cloud
    }
}
