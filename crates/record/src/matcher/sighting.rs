// SPDX-License-Identifier: MIT OR Apache-2.0
//! The input of the matcher, and its answers.

use crate::base::ids::BlockId;

/// What is seen of one frame: its id, its timestamp and its arrival.
#[derive(Debug, Clone, Copy)]
pub struct Sighting {
    pub id: BlockId,
    /// Camera clock, ns, at whatever point of the frame the camera stamps; `None` where the leader was lost or there
    /// is no stamp.
    pub camera_ns: Option<u64>,
    /// First packet seen, host clock, ns.
    pub host_ns: u64,
    /// Whether all of it arrived: the timestamp of a torn frame does not overrule its id.
    pub complete: bool,
}

/// The number of sources that a match rests on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Witness {
    /// Two of block id, timestamp and arrival agree, and the third does not refute them.
    Two,
    /// Only one of them names the trigger.
    One,
}

/// An irregularity that a frame's sources show.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Finding {
    /// The id jumped by this many more than frames were lost (negative: it fell back).
    IdJump(i64),
    /// The id is that of the frame before.
    IdRepeated,
    /// The camera's clock was set, by about this many ns.
    ClockReset(i128),
    /// Its timestamp alone is wrong, by this many ns; `None`: it has none, and the camera's other frames have.
    StampWrong(Option<i128>),
}

/// A frame's place, and what happened since the frame before.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Matched {
    /// The trigger's number; negative in the warm-up.
    pub number: i64,
    pub witness: Witness,
    /// Triggers before it whose frames were lost on the way.
    pub lost: u64,
    /// Triggers before it that the camera ignored.
    pub ignored: u64,
    pub finding: Option<Finding>,
}

/// The answer of the matcher for one frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Match {
    /// The frame of a trigger.
    Trigger(Matched),
    /// Not known yet: ask again when there is a new report or frame.
    Wait,
    /// No trigger explains it; it lies this far from the nearest (ns).
    Spurious(i64),
    /// Packets, no frame: its id is that of a trigger that has its outcome, or that had not been fired when it arrived.
    Stray,
    /// Its witnesses contradict each other, and nothing decides which of them is right.
    Undecided,
    /// It came before the first trigger.
    BeforeTrain,
    /// It was seen before: same id, same timestamp, or an earlier one.
    Repeated,
}
