// SPDX-License-Identifier: MIT OR Apache-2.0
//! The serial link to the hardware synchronization unit.
//!
//! Without an HSU, [`action`] takes its place in this process: the same state machine, whose triggers are action
//! commands over the network. [`TriggerUnit`] is one or the other.
//!
//! [`Hsu`] is the unit as this node sees it: blocking commands, each answered or refused, and a stream of
//! [`HsuEvent`]s. Below it, [`link`] does framing, request ids, timeouts and retries over any byte stream, and
//! `order` puts the trigger telemetry back into a gapless sequence. The wire contract is the crate
//! `hsu-firmware-proto`; its reasons are in `docs/design/hsu-protocol.md`.

pub mod action;
mod conversation;
mod error;
mod event;
pub mod link;
mod order;
#[cfg(test)]
mod tests;
mod timing;
mod trigger_unit;
mod unit;

pub use error::HsuError;
pub use event::{HsuEvent, LinkLoss};
pub use link::HsuTimeouts;
pub use timing::{ArmRequest, HsuTiming, session_id, trigger_index};
pub use trigger_unit::TriggerUnit;
pub use unit::{ClockSample, HeardTimeCodes, Hsu, InputEdges, UnderWay};

pub use hsu_firmware_proto::{
    EDGE_HISTORY, Edge, Edges, EndReason, Fault, HeadTiming, INPUTS, Identity, LinkId, Refusal, SessionId,
    Slope, State, Status, Sync, TIME_CODE_HISTORY, TimeCode, TimeCodeFrame, TimeCodeFrames, TriggerFlags,
    TriggerRecord,
};
