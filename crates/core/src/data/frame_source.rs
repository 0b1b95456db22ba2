// SPDX-License-Identifier: MIT OR Apache-2.0
//! Where frames come from, as the pipeline sees it.

use crate::base::ids::{CameraId, TriggerIndex};
use crate::base::image::{Mono8, Plane};
use crate::geometry::pattern::Pattern;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::ops::Range;
use std::path::PathBuf;

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

impl Frame<'_> {
    /// The image, if there is one.
    pub fn image(&self) -> Option<Mono8<'_>> {
        match self {
            Self::Image(image) => Some(*image),
            Self::Owned(plane) => Some(Mono8::from(plane)),
            Self::Gap(_) => None,
        }
    }

    /// The CRC-32 of its pixels, row by row; `None` for a gap.
    pub fn pixels_crc(&self) -> Option<u32> {
        self.image().map(pixels_crc)
    }
}

/// The CRC-32 of an image's pixels, row by row, as recordings state it.
fn pixels_crc(image: Mono8<'_>) -> u32 {
    crc32fast::hash(image.as_slice())
}

/// A camera as a source states it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StatedCamera {
    /// Its name in the rig.
    pub id: CameraId,
    pub width: usize,
    pub height: usize,
    /// Vendor, model and serial number; empty where unknown.
    pub device: String,
}

/// What a source states about itself, for a calibration to be compared with.
#[derive(Debug, Clone, PartialEq)]
pub struct SourceStatement {
    pub cameras: Vec<StatedCamera>,
    /// What was projected; `None` where it is not known.
    pub pattern: Option<Pattern>,
}

/// Which session a source has the frames of.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SessionIdentity {
    /// The id that the recordings of all its nodes share; of images a digest of their names and sizes.
    pub id: String,
    /// Its name; none of images.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// The nodes whose recordings are there; none of images.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub nodes: Vec<String>,
    /// All cameras that are in it, whichever of them are wanted.
    pub cameras: Vec<CameraId>,
}

impl fmt::Display for SessionIdentity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(name) = &self.name {
            write!(f, "{name} ")?;
        }
        write!(f, "({}", self.id)?;
        if !self.nodes.is_empty() {
            write!(f, ", nodes {}", self.nodes.join(","))?;
        }
        write!(f, ", {} cameras)", self.cameras.len())
    }
}

/// A part of a session that is there and cannot be read at all: the recording of a node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LostPart {
    /// Which, and why, in a sentence.
    pub reason: String,
    /// Its cameras; empty where they are not known.
    pub cameras: Vec<CameraId>,
}

impl fmt::Display for LostPart {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.reason)
    }
}

/// A session's frames by camera and trigger: a recording, or images of another origin.
pub trait FrameSource: Sync {
    /// The cameras, in the rig's order.
    fn cameras(&self) -> &[CameraId];

    /// The triggers of the session.
    fn triggers(&self) -> Range<u64>;

    /// The frame of `camera` at `trigger`. An error means that the source is damaged there: the text states
    /// what was expected, what was found and what to do.
    fn frame(&self, camera: &CameraId, trigger: TriggerIndex) -> Result<Frame<'_>, String>;

    /// Which session it has the frames of. An error where its parts are of several. A source that is no session of any
    /// kind has an empty one.
    fn identity(&self) -> Result<SessionIdentity, String> {
        let cameras = self.cameras().to_vec();
        Ok(SessionIdentity { cameras, ..SessionIdentity::default() })
    }

    /// When it was recorded, host clock, ns since 1970; `None` where the source does not know.
    fn recorded_ns(&self) -> Option<u64> {
        None
    }

    /// The CRC-32 of a frame's pixels, row by row; `None` for a gap. Errors as in [`Self::frame`].
    fn pixels_crc(&self, camera: &CameraId, trigger: TriggerIndex) -> Result<Option<u32>, String> {
        Ok(self.frame(camera, trigger)?.pixels_crc())
    }

    /// Parts of the session that cannot be read. [`Self::frame`] has an error for every frame of their cameras.
    fn lost(&self) -> &[LostPart] {
        &[]
    }

    /// Files that lie beside the frames, are no frames, and are left out.
    fn left_out(&self) -> &[PathBuf] {
        &[]
    }

    /// What it states about its cameras; `None` for images of another origin.
    fn statement(&self) -> Option<SourceStatement> {
        None
    }

    /// When `trigger` was, ns since 1970 on the clock of [`Self::time_base`]; `None` where the source does not know.
    fn trigger_time_ns(&self, _trigger: TriggerIndex) -> Option<u64> {
        None
    }

    /// What clock its triggers' times are of, in words; `None` where it has no times.
    fn time_base(&self) -> Option<String> {
        None
    }
}
