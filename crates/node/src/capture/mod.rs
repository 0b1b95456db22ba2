// SPDX-License-Identifier: MIT OR Apache-2.0
//! A capture: one session on all nodes, or a series of them, run from the command line or from a node's console.

mod before_record;
/// Captures that a node runs for its console.
pub mod coordinator;
mod countdown;
/// Names of takes that are still free.
pub mod numbering;
/// One node that takes part, over HTTP or in this process.
pub mod participant;
/// A node in a session watches the other nodes of it.
pub mod peer_watch;
/// The result of a capture, as text and as JSON.
pub mod report;
/// What an operator requests of a capture, and its stages.
pub mod request;
/// One capture, from the request to the verdict.
pub mod run;
/// Several captures in a row.
pub mod series;
