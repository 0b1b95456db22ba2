// SPDX-License-Identifier: MIT OR Apache-2.0
//! What was wrong with the photographs of a calibration, by camera and position.

use crate::base::ids::{CameraId, TriggerIndex};
use std::fmt;

/// Something that was left out, or looks wrong.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct Finding {
    pub camera: CameraId,
    /// The frame; `None` where it is about many.
    pub trigger: Option<TriggerIndex>,
    /// The position of the board, counted from 1 by its white frames; `None` where it is about many or none.
    pub position: Option<usize>,
    pub kind: Kind,
    /// Whether the frame was left out; otherwise it was used as far as it goes.
    pub left_out: bool,
    /// What was found and what to do.
    pub message: String,
}

/// Why a frame cannot be used.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Refusal {
    pub kind: Kind,
    /// What was found and what to do, for people.
    pub message: String,
}

impl Refusal {
    pub(super) fn new(kind: Kind, message: impl Into<String>) -> Self {
        Self { kind, message: message.into() }
    }
}

impl Finding {
    /// A frame that is left out; `place` is its position of the board, counted from 0.
    pub(super) fn left_out(
        camera: &CameraId,
        trigger: TriggerIndex,
        place: Option<usize>,
        kind: Kind,
        message: impl Into<String>,
    ) -> Self {
        let (camera, position) = (camera.clone(), place.map(|place| place + 1));
        Self { camera, trigger: Some(trigger), position, kind, left_out: true, message: message.into() }
    }

    /// The same of a frame that is used as far as it goes.
    pub(super) fn used(self) -> Self {
        Self { left_out: false, ..self }
    }
}

/// Kinds of findings, for programs: their names are in the JSON result.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    NoFrames,
    /// No grid of circles in a white frame.
    NoBoard,
    /// The larger circles do not lie as in the board file.
    WrongBoard,
    /// The board is seen mirrored.
    Mirrored,
    /// Too little of the code is visible.
    Ambiguous,
    /// Fewer circles than a view needs.
    FewCircles,
    Blurred,
    /// The white is at the sensor's limit.
    Saturated,
    /// Circles that should be seen are not.
    Hidden,
    /// Circles are larger or smaller than in the board file.
    CircleSize,
    /// Fringes in which no marker was found; their orders are those that the board gives.
    NoMarker,
    /// Fringes whose marker is not where the board has it; likewise.
    MarkerMisread,
    /// Fringes too dark to find the circles in.
    TooDark,
    /// Fringes that the phase pipeline refused.
    NoPhase,
    /// Fringes without a white frame of the same position.
    Unpaired,
    /// The fringes came before the white frame; used.
    OrderSwapped,
    /// The board moved between the white frame and the fringes.
    Moved,
    /// The position contradicts the others.
    Disagrees,
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.camera)?;
        match (self.position, self.trigger) {
            (Some(position), Some(trigger)) => write!(f, " position {position} (trigger {trigger})")?,
            (Some(position), None) => write!(f, " position {position}")?,
            (None, Some(trigger)) => write!(f, " trigger {trigger}")?,
            (None, None) => {}
        }
        write!(f, ": {}; {}", self.message, if self.left_out { "left out" } else { "used" })
    }
}
