//! Where frames come from, as the pipeline sees it.

use crate::ids::{CameraId, TriggerIndex};
use crate::image::{Mono8, Plane};
use std::ops::Range;

/// What a source has at one trigger of one camera.
#[derive(Debug)]
pub enum Frame<'a> {
    /// The image, mapped from a recording.
    Image(Mono8<'a>),
    /// The image, decoded from a file.
    Owned(Plane<u8>),
    /// There is no image, for this reason (a gap record's cause).
    Gap(String),
}

/// A session's frames by camera and trigger: a recording, or images of another origin.
pub trait FrameSource: Sync {
    /// The cameras, in the rig's order.
    fn cameras(&self) -> &[CameraId];

    /// The triggers of the session.
    fn triggers(&self) -> Range<u64>;

    /// The frame of `camera` at `trigger`. An error means that the source is damaged there: the text says
    /// what was expected, what was found and what to do.
    fn frame(&self, camera: &CameraId, trigger: TriggerIndex) -> Result<Frame<'_>, String>;

    /// When `trigger` was, ns since the UNIX epoch or the session's start; `None` where the source does not
    /// know.
    fn trigger_time_ns(&self, _trigger: TriggerIndex) -> Option<u64> {
        None
    }
}
