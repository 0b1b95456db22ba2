// SPDX-License-Identifier: MIT OR Apache-2.0
//! A new bench, step by step: from who answers a broadcast to a node file whose cameras are named, wired and measured.
//!
//! `run.rs` takes the steps in their order; each is a file of its own, and what it decides is a pure function.

mod addresses;
mod begun;
mod delays;
mod found;
mod lines;
mod node_file;
mod options;
mod outcome;
mod packets;
mod pulses;
mod roles;
mod run;
mod who;

pub use delays::Delays;
pub use found::Found;
pub use node_file::Given;
pub use options::{Operator, Options};
pub use outcome::{NamedCamera, Outcome};
pub use roles::{Claim, Known};
pub use run::set_up;
