// SPDX-License-Identifier: MIT OR Apache-2.0
//! The state of the unit as it tells it, in answers and in every heartbeat.

use crate::codec::{DecodeError, Put, Take};
use crate::ids::SessionId;
use core::fmt;

/// What the unit is doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[repr(u8)]
pub enum State {
    /// Nothing armed since the start.
    #[default]
    Idle = 0,
    /// Some, but not all expected links are armed.
    Arming = 1,
    /// All expected links are armed with the same session.
    Armed = 2,
    /// A train of triggers is running.
    Running = 3,
    /// A session has ended; nothing armed since.
    Finished = 4,
}

impl State {
    pub(crate) fn from_code(code: u8) -> Option<Self> {
        [Self::Idle, Self::Arming, Self::Armed, Self::Running, Self::Finished].get(usize::from(code)).copied()
    }
}

impl fmt::Display for State {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Idle => "idle",
            Self::Arming => "arming",
            Self::Armed => "armed",
            Self::Running => "running",
            Self::Finished => "finished",
        })
    }
}

/// Why the unit ended a session.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[repr(u8)]
pub enum EndReason {
    /// The session has not ended.
    #[default]
    None = 0,
    /// The unit fired all triggers that were requested.
    Completed = 1,
    /// A host asked to stop.
    Stopped = 2,
    /// A host disarmed the unit.
    Aborted = 3,
    /// An armed link fell silent before the start, or all links during a train without a count.
    LinkSilent = 4,
}

impl EndReason {
    pub(crate) fn from_code(code: u8) -> Option<Self> {
        [Self::None, Self::Completed, Self::Stopped, Self::Aborted, Self::LinkSilent]
            .get(usize::from(code))
            .copied()
    }
}

impl fmt::Display for EndReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::None => "not ended",
            Self::Completed => "completed",
            Self::Stopped => "stopped",
            Self::Aborted => "aborted",
            Self::LinkSilent => "link silent",
        })
    }
}

/// The unit's state, links and counters at one time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Status {
    /// The state of its state machine.
    pub state: State,
    /// The session that it is at; when finished, the last one.
    pub session: SessionId,
    /// Time on the unit's clock, ns.
    pub time_ns: u64,
    /// Number of the next trigger; negative in the warm-up.
    pub next_number: i64,
    /// Triggers fired in this session, without warm-up.
    pub emitted: u64,
    /// Why the session ended, if it has.
    pub end: EndReason,
    /// Bit 0: link A is armed, bit 1: link B.
    pub armed_links: u8,
    /// Bit 0: a host was heard on link A within the silence limit, bit 1: on link B.
    pub heard_links: u8,
    /// [`crate::Timing::digest`] of the timing in force; 0: not configured.
    pub timing_digest: u32,
    /// Late triggers since the unit started.
    pub late: u32,
    /// Faults since the unit started.
    pub faults: u32,
    /// Broken frames from this link since the unit started.
    pub frames_bad: u32,
    /// Messages to this link that found no room on the line since the unit started.
    pub unsent: u32,
}

impl Status {
    pub(crate) fn put(&self, put: &mut Put<'_>) {
        put.u8(self.state as u8);
        put.bytes(&self.session.0);
        put.u64(self.time_ns);
        put.i64(self.next_number);
        put.u64(self.emitted);
        put.u8(self.end as u8);
        put.u8(self.armed_links);
        put.u8(self.heard_links);
        put.u32(self.timing_digest);
        put.u32(self.late);
        put.u32(self.faults);
        put.u32(self.frames_bad);
        put.u32(self.unsent);
    }

    pub(crate) fn take(take: &mut Take<'_>) -> Result<Self, DecodeError> {
        Ok(Self {
            state: State::from_code(take.u8()?).ok_or(DecodeError::Value)?,
            session: SessionId(take.array()?),
            time_ns: take.u64()?,
            next_number: take.i64()?,
            emitted: take.u64()?,
            end: EndReason::from_code(take.u8()?).ok_or(DecodeError::Value)?,
            armed_links: take.u8()?,
            heard_links: take.u8()?,
            timing_digest: take.u32()?,
            late: take.u32()?,
            faults: take.u32()?,
            frames_bad: take.u32()?,
            unsent: take.u32()?,
        })
    }
}
