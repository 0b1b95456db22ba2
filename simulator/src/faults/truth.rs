// SPDX-License-Identifier: MIT OR Apache-2.0
//! What was injected, one JSON line per fault, and what a recording has to state about it.

use super::disk::DiskEvent;
use super::plan::{Fault, Kind, Part, Resend};
use fourdbody::record::GapCause;
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::io::{self, Write};
use std::path::Path;
use std::sync::{Mutex, PoisonError};

/// One injected fault, as a line of the truth file.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Injected {
    /// Which train of triggers of this camera it was, from 1 on.
    pub train: u64,
    /// The camera's name in the rig; empty where it was none.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub camera: String,
    /// The node whose link it was; without camera and node it was the HSU itself.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub node: Option<String>,
    pub trigger: u64,
    /// The frame's block id, where there is a frame.
    pub block: Option<u64>,
    pub kind: String,
    /// Accepted outcomes of this trigger: `frame`, or causes of a gap.
    pub expected: Vec<String>,
    /// Kinds of the events that must be in the recording.
    pub events: Vec<String>,
    /// How many triggers from this one on may have these outcomes, where it is more than one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lasts: Option<u64>,
}

impl Injected {
    /// A fault of no camera, without any effect.
    pub fn at(train: u64, trigger: u64, kind: &str) -> Self {
        Self { train, trigger, kind: kind.to_owned(), ..Self::default() }
    }
}

/// The outcome of a trigger whose frame is recorded.
pub const FRAME: &str = "frame";

/// Outcomes that are right for this kind, and events that must be there.
pub fn expectation(kind: Kind) -> (Vec<String>, Vec<String>) {
    let missing = GapCause::MissingPackets.to_string();
    let timeout = GapCause::Timeout.to_string();
    let (outcomes, event) = match kind {
        Kind::FrameLost | Kind::Stall => (vec![missing], Some("frames_lost")),
        Kind::Lost(_, Resend::Answered) => (vec![FRAME.to_owned()], None),
        // The trailer carries no pixels, but a frame without it is not known to be complete.
        Kind::Lost(Part::Packet | Part::Burst | Part::Leader | Part::Trailer, _) => {
            (vec![missing, timeout], None)
        }
        Kind::Truncated => (vec![missing], None),
        Kind::WrongFormat | Kind::ChunksAppended => {
            (vec![GapCause::WrongFormat.to_string()], Some("frame_refused"))
        }
        Kind::PaddedRows | Kind::ShortPackets => {
            (vec![GapCause::SizeMismatch.to_string()], Some("frame_refused"))
        }
        Kind::TriggerIgnored => (vec![GapCause::NotTriggered.to_string()], Some("trigger_ignored")),
        Kind::ExtraFrame => (vec![FRAME.to_owned()], Some("spurious_frame")),
        Kind::IdJump => (vec![FRAME.to_owned()], Some("id_jump")),
        Kind::ClockReset => (vec![FRAME.to_owned()], Some("camera_clock_reset")),
        Kind::StampGlitch | Kind::StampAbsent => (vec![FRAME.to_owned()], Some("stamp_wrong")),
        // Between two triggers, a trigger ignored and a frame without one would look the same.
        Kind::StampNear => (vec![FRAME.to_owned(), GapCause::IdentityMismatch.to_string()], None),
        // Aravis takes some for packets; then the marks in the block show that a part was not written.
        Kind::Malformed => (vec![FRAME.to_owned(), missing], None),
        Kind::Reordered | Kind::Duplicated | Kind::RepeatedFrame | Kind::RogueClient => {
            (vec![FRAME.to_owned()], None)
        }
        // The filter of the stream's socket lets none of them through.
        Kind::ForeignFar | Kind::ForeignAhead | Kind::ForeignPixels | Kind::ForeignSmall => {
            (vec![FRAME.to_owned()], None)
        }
        // A camera that is back before the node has queried it looks like one whose control was lost.
        Kind::Unplugged => {
            let causes = [GapCause::Unplugged, GapCause::ControlLost];
            (causes.map(|cause| cause.to_string()).to_vec(), Some("camera_lost"))
        }
        // It sends on until its node has looked, and is gone from then on.
        Kind::Nonsense => {
            let causes = [GapCause::Unplugged, GapCause::ControlLost];
            let gone = causes.iter().map(ToString::to_string);
            (std::iter::once(FRAME.to_owned()).chain(gone).collect(), Some("camera_lost"))
        }
        Kind::ControlTaken => (vec![GapCause::ControlLost.to_string()], Some("camera_lost")),
    };
    (outcomes, event.map(str::to_owned).into_iter().collect())
}

/// The file in which all cameras write down what they injected.
#[derive(Debug)]
pub struct TruthLog(Mutex<File>);

impl TruthLog {
    /// A new file.
    ///
    /// # Errors
    /// What the system says.
    pub fn create(path: &Path) -> io::Result<Self> {
        Ok(Self(Mutex::new(File::create(path)?)))
    }

    /// Writes one fault down, at once: the simulator may be killed at any time.
    pub fn record(&self, train: u64, camera: &str, trigger: u64, block: Option<u64>, fault: Fault) {
        let (expected, events) = expectation(fault.kind);
        let (camera, kind) = (camera.to_owned(), fault.kind.to_string());
        let lasts = match fault.kind {
            kind if kind.is_absence() || kind == Kind::Nonsense => Some(fault.count),
            _ => None,
        };
        self.write_down(&Injected {
            camera,
            block,
            expected,
            events,
            lasts,
            ..Injected::at(train, trigger, &kind)
        });
    }

    /// Writes a line of JSON to the truth file.
    pub fn write_down(&self, what: &impl Serialize) {
        let line = serde_json::to_string(what).map(|line| line + "\n").map_err(io::Error::from);
        let mut file = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Err(error) = line.and_then(|line| file.write_all(line.as_bytes())) {
            tracing::error!(%error, "an injected fault could not be written down");
        }
    }
}

/// A line of the file.
#[derive(Deserialize)]
#[serde(untagged)]
enum Line {
    Camera(Injected),
    Disk(DiskEvent),
}

/// Reads a file of [`TruthLog`]: what was injected into the cameras' frames.
///
/// # Errors
/// A file that cannot be read, or a line that is none of a truth file, with its number.
pub fn read_truth(path: &Path) -> Result<Vec<Injected>, String> {
    let camera = |line| if let Line::Camera(injected) = line { Some(injected) } else { None };
    Ok(read_lines(path)?.into_iter().filter_map(camera).collect())
}

/// Reads a file of [`TruthLog`]: what the disks did.
///
/// # Errors
/// As [`read_truth`].
pub fn read_disk_truth(path: &Path) -> Result<Vec<DiskEvent>, String> {
    let disk = |line| if let Line::Disk(event) = line { Some(event) } else { None };
    Ok(read_lines(path)?.into_iter().filter_map(disk).collect())
}

fn read_lines(path: &Path) -> Result<Vec<Line>, String> {
    let text = std::fs::read_to_string(path).map_err(|e| format!("{}: {e}", path.display()))?;
    let lines = text.lines().enumerate().filter(|(_, line)| !line.is_empty());
    lines
        .map(|(number, line)| {
            let wrong = |e| format!("{} line {}: {e}", path.display(), number + 1);
            serde_json::from_str(line).map_err(wrong)
        })
        .collect()
}
