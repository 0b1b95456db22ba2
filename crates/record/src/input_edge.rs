// SPDX-License-Identifier: MIT OR Apache-2.0
//! Edges of the HSU's input lines in a recording: an event each, whose message is JSON.

use super::layout::NodeEvent;
use serde::{Deserialize, Serialize};

/// An edge of an input line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct InputEdge {
    /// Consecutive since the HSU was switched on, over all lines.
    pub number: u64,
    /// The HSU's input, from 0.
    pub line: u8,
    /// Whether the line went from low to high.
    pub rising: bool,
    /// When it came, HSU clock, ns.
    pub hsu_time_ns: u64,
    /// Edges of any line since the one before this that were too many to be kept.
    pub skipped: u16,
}

/// Kind of the events that hold an [`InputEdge`].
const KIND: &str = "hsu_input";

impl InputEdge {
    /// The event that records it; `host_time_ns` is when the node received it.
    pub fn event(&self, host_time_ns: u64) -> NodeEvent {
        NodeEvent::of_json(KIND, host_time_ns, self)
    }

    /// The edge that an event holds; `None` for other kinds.
    pub fn of(event: &NodeEvent) -> Option<Self> {
        event.json(KIND)
    }
}
