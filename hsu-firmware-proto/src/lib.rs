// SPDX-License-Identifier: MIT OR Apache-2.0
//! Wire contract and behaviour of the hardware synchronization unit (HSU).
//!
//! The HSU fires the projectors and cameras of the rig; each acquisition PC ("node") talks to it over a
//! serial link of its own. This crate is everything that both ends must agree on: framing ([`frame`]), the
//! messages by direction ([`host_to_unit`], [`unit_to_host`]), and the unit's own state machine ([`unit`]),
//! which the firmware and the simulator both run. No `std`, no allocation, no dependency.
//!
//! `docs/design/hsu-protocol.md` in the repository has the invariants, the message table and the states.
#![cfg_attr(not(feature = "std"), no_std)]
#![forbid(unsafe_code)]

mod codec;
pub mod frame;
pub mod host_to_unit;
pub mod ids;
pub mod inputs;
pub mod ltc;
mod records;
mod refusal;
mod status;
pub mod time_code;
pub mod timing;
pub mod unit;
pub mod unit_to_host;

pub use codec::DecodeError;
pub use host_to_unit::{Arm, Hello, HostToUnit, Request};
pub use ids::{LinkId, NodeName, SessionId};
pub use inputs::{Edge, Edges, Slope};
pub use ltc::Ltc;
pub use records::Records;
pub use time_code::{TimeCode, TimeCodeFrame, TimeCodeFrames};
pub use timing::{HeadTiming, Sync, Timing, TimingError};
pub use unit::{PAUSE_BEFORE, Unit, UnitOutputs};
pub use unit_to_host::{
    EndReason, Fault, Identity, Refusal, State, Status, TriggerFlags, TriggerRecord, TriggerRecords,
    UnitToHost, Welcome,
};

/// Protocol versions.
///
/// Policy:
/// - Discriminants (message kinds, reason, fault and state codes, flag bits) are append-only: never
///   renumbered, never reused, never removed.
/// - A message's layout never changes within a version. To change one, add a kind or raise `CURRENT`.
/// - The header of every message from the host (version, kind, request id) and the whole of `Hello`,
///   `Welcome` and `Refusal` are the same in all versions, for ever: two ends that do not understand each
///   other can still say so, with both numbers.
/// - Both ends state the range that they speak; the session uses the highest version in both ranges. Without
///   one the unit refuses the `Hello` and the host names both ranges in its error.
/// - Version 255 will never be: the header's first byte cannot be [`crate::frame::NO_MESSAGE`].
/// - Every released version has golden bytes in `tests/it/versioning/`; those files are never edited.
pub mod version {
    /// Oldest version that this code still speaks.
    pub const MIN: u8 = 1;
    /// Newest version that this code speaks.
    pub const CURRENT: u8 = 1;

    const _: () = assert!(CURRENT < crate::frame::NO_MESSAGE);

    /// The highest version in both ranges.
    pub fn agree(theirs_min: u8, theirs_current: u8) -> Option<u8> {
        let best = if theirs_current < CURRENT { theirs_current } else { CURRENT };
        (best >= MIN && best >= theirs_min).then_some(best)
    }
}

/// Longest message, bytes, before CRC and stuffing.
pub const MAX_MESSAGE: usize = 248;
/// Heads that one unit can serve.
pub const MAX_HEADS: usize = 8;
/// Serial links that one unit has.
pub const LINKS: usize = 2;
/// Triggers that the unit remembers for [`Request::QueryTriggers`]: 4.2 s at 120 Hz.
pub const HISTORY: usize = 512;
/// Input lines that one unit has.
pub const INPUTS: usize = 8;
/// Edges of inputs that the unit remembers for [`Request::QueryEdges`].
pub const EDGE_HISTORY: usize = 96;
/// Edges that the unit keeps in a quarter of a second, all lines together; more are counted.
pub const EDGES_KEPT: u8 = 64;
/// Time codes that the unit remembers for [`Request::QueryTimeCodes`]: 2.1 s at 30 frames a second.
pub const TIME_CODE_HISTORY: usize = 64;
/// Triggers in one answer to [`Request::QueryTriggers`]; time codes likewise.
pub const MAX_RECORDS: usize = 12;
/// Edges in one answer to [`Request::QueryEdges`]: a twelfth would make it longer than [`MAX_MESSAGE`].
pub const MAX_EDGES: usize = 11;
/// Most warm-up triggers before a train.
pub const MAX_WARM_UP: u32 = 10_000;
/// Time between two heartbeats of the unit, ns.
pub const HEARTBEAT_NS: u64 = 250_000_000;
