//! Where frames come from, as the pipeline sees it.

use crate::ids::{CameraId, TriggerIndex};
use crate::image::{Mono8, Plane};
use crate::pattern::Pattern;
use std::ops::Range;

/// What a source has at one trigger of one camera.
#[derive(Debug)]
pub enum Frame<'a> {
    /// The image, in memory that the source keeps.
    Image(Mono8<'a>),
    /// The image, read or decoded from a file.
    Owned(Plane<u8>),
    /// There is no image, for this reason (a gap record's cause).
    Gap(String),
}

/// A camera as a source states it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StatedCamera {
    /// Its name in the rig.
    pub id: CameraId,
    /// Columns of its frames.
    pub width: usize,
    /// Rows of its frames.
    pub height: usize,
    /// Vendor, model and serial number; empty where unknown.
    pub device: String,
}

/// What a source states about itself, for a calibration to be compared with.
#[derive(Debug, Clone, PartialEq)]
pub struct SourceStatement {
    /// Its cameras.
    pub cameras: Vec<StatedCamera>,
    /// What was projected; `None` where it is not known.
    pub pattern: Option<Pattern>,
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

    /// What it states about its cameras; `None` for images of another origin.
    fn statement(&self) -> Option<SourceStatement> {
        None
    }

    /// When `trigger` was, ns since the UNIX epoch or the session's start; `None` where the source does not
    /// know.
    fn trigger_time_ns(&self, _trigger: TriggerIndex) -> Option<u64> {
        None
    }
}
