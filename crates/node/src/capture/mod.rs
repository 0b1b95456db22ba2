// SPDX-License-Identifier: MIT OR Apache-2.0
//! A capture: one session on all nodes, or a series of them, run from the command line or from a node's console.

/// Captures that a node runs for its console.
mod before_record;
pub mod coordinator;
mod countdown;
pub mod numbering;
/// One node that takes part, over HTTP or in this process.
pub mod participant;
/// A node in a session looks after the other nodes of it.
pub mod peer_watch;
/// What a capture has come to.
pub mod report;
/// One capture, from the request to the verdict.
pub mod run;
/// Several captures in a row.
pub mod series;
