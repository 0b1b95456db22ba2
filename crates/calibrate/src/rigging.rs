// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the stages of a calibration work on, and their result for a head.

use super::board::Board;
use super::bundle::{Adjusted, Observation};
use super::findings::Finding;
use super::observed::{Position, View};
use crate::data::Calibration;
use std::collections::BTreeSet;

/// Fewest positions for a head: fewer leave lens and distance entangled.
const LEAST_POSITIONS: usize = 6;

/// Why the photographs give no calibration.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum StageError {
    /// A head has too few usable positions; 0 where none of its cameras saw the board.
    #[error(
        "head {head}: {found} usable positions of the board that differ, expected at least {LEAST_POSITIONS}. Photograph the board at more places and tilts"
    )]
    Positions {
        /// The head's identifier in the rig file.
        head: String,
        /// How many usable positions differ from each other.
        found: usize,
    },
    /// A declared vertical contradicts the photographs: the command line is wrong, not the photographs.
    #[error("{0}")]
    World(String),
    /// Any other reason: what was expected, what was found, and what to do.
    #[error("{0}")]
    Refused(String),
}

/// The rig as planned, the board, and its positions in a session. Whoever calibrates makes one; it changes nothing in
/// them.
#[derive(Clone, Copy)]
pub struct Rigging<'a> {
    /// The rig's nominal geometry, from the rig file.
    pub nominal: &'a Calibration,
    /// The board that was photographed.
    pub board: &'a Board,
    /// The positions of the board in the session.
    pub positions: &'a [Position],
}

/// A head after stages 1 and 2. Devices: cameras in the rig's order, then the projector. The frame is the nominal
/// world.
#[derive(Debug, Clone)]
pub struct HeadResult {
    /// Place of the head in the rig.
    pub head: usize,
    /// Positions used, as places in the list of positions.
    pub positions: Vec<usize>,
    /// Cameras, projector and boards as adjusted together.
    pub all: Adjusted,
    /// Circle observations, then phase observations, as in `all`.
    pub observations: Vec<Observation>,
    /// How many of the observations are circles.
    pub circles: usize,
    /// By phase observation, the camera that saw it, as its place in the head.
    pub phase_cameras: Vec<usize>,
    /// Views whose markers are elsewhere than the board has them.
    pub misread: Vec<Misread>,
    /// What was left out because it contradicts the rest, and what looked wrong.
    pub findings: Vec<Finding>,
}

/// A view whose marker is some whole fringes from where the board has it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Misread {
    /// The camera, as its place in its head.
    pub camera: usize,
    /// The position, as its place in the list of positions.
    pub position: usize,
    /// Whole fringes by which the phase is too large.
    pub fringes: i64,
}

/// Views, by camera (place in its head) and position, that are left out of an adjustment.
#[derive(Debug, Clone, Default)]
pub(super) struct Excluded {
    /// Views of which nothing is used.
    pub(super) views: BTreeSet<(usize, usize)>,
    /// Views of which the circles are used, but not the phase.
    pub(super) phases: BTreeSet<(usize, usize)>,
}

impl Rigging<'_> {
    pub(super) fn head_name(&self, head: usize) -> &str {
        self.nominal.heads[head].id.as_str()
    }

    /// What a camera (place in its head) sees at a position.
    pub(super) fn view(&self, head: usize, camera: usize, position: usize) -> Option<&View> {
        self.positions[position].views[self.nominal.cameras_of(head).start + camera].as_ref()
    }

    /// The error of a head with fewer than the least positions.
    pub(super) fn check_positions(&self, head: usize, found: usize) -> Result<(), StageError> {
        let head = self.head_name(head).to_owned();
        if found < LEAST_POSITIONS { Err(StageError::Positions { head, found }) } else { Ok(()) }
    }
}
