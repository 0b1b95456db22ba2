// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a run is to do: of which frames what is made, how, and where it goes.

use crate::base::ids::CameraId;
use crate::reconstruct::fringe_order::{self, MostDifference};
use crate::reconstruct::pipeline::Method;
use std::ops::Range;
use std::path::PathBuf;

/// What is written of each frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Format {
    /// Phase maps, of which `from_phase_maps::export` makes the same clouds.
    Phase,
    /// Clouds, merged clouds and the sequence.
    Ply,
}

impl Format {
    /// As the command line calls it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Phase => "phase",
            Self::Ply => "ply",
        }
    }

    /// The names of some, with commas between them.
    pub fn names(formats: &[Self]) -> String {
        formats.iter().map(|format| format.name()).collect::<Vec<_>>().join(",")
    }

    pub(super) fn folders(self) -> &'static [&'static str] {
        match self {
            Self::Phase => &["phases"],
            Self::Ply => &["clouds", "merged"],
        }
    }
}

/// What a run is to do. The command line makes it of its options and of what session and calibration have; it does not
/// change while the run lasts.
#[derive(Debug)]
pub struct Plan {
    /// The directory that the results go to.
    pub out: PathBuf,
    pub triggers: Range<u64>,
    /// Which cameras; all are in the calibration.
    pub cameras: Vec<CameraId>,
    /// This share of the triggers: those whose index leaves `shard.0` when divided by `shard.1`.
    pub shard: (u64, u64),
    /// How the absolute phase is found.
    pub method: Method,
    /// By how much a fringe order must lead any other.
    pub margin: f32,
    /// Cameras that differ by more contradict the calibration, and the trigger is refused.
    pub most_difference: MostDifference,
    /// Rows of the photographs that make one row of the source's frames ([`super::binned`]).
    pub bin_rows: usize,
    /// What is written, each once, in order.
    pub formats: Vec<Format>,
    /// Whether every point gets its standard uncertainty.
    pub uncertainty: bool,
    /// Where the maps of every frame go, if anywhere.
    pub maps: Option<PathBuf>,
    /// Makes the clouds and keeps none, and merges nothing: for measurements of the reconstruction itself.
    pub discard: bool,
}

impl Default for Plan {
    /// What the command line does without options, of no frames.
    fn default() -> Self {
        Self {
            out: PathBuf::new(),
            triggers: 0..0,
            cameras: Vec::new(),
            shard: (0, 1),
            method: Method::Joint,
            margin: fringe_order::MARGIN,
            most_difference: MostDifference::of_rows(1),
            bin_rows: 1,
            formats: vec![Format::Phase],
            uncertainty: false,
            maps: None,
            discard: false,
        }
    }
}

impl Plan {
    /// The triggers of this shard, in order.
    pub fn shard_triggers(&self) -> impl Iterator<Item = u64> + '_ {
        self.triggers.clone().filter(|t| t % self.shard.1.max(1) == self.shard.0)
    }

    /// Whether the clouds of a trigger are put together: else they are dropped once they are made.
    pub fn merges(&self) -> bool {
        self.formats.contains(&Format::Ply) && !self.discard
    }
}

/// The name of a method on the command line and in files.
pub fn method_name(method: Method) -> &'static str {
    match method {
        Method::Joint => "joint",
        Method::Paper => "paper",
    }
}
