// SPDX-License-Identifier: MIT OR Apache-2.0
//! Reconstructs the recordings of the nodes by itself, at idle priority.
//!
//! `docs/design/worker.md` states what it must keep true. [`run::Worker`] does the work; [`queue`] lists the sessions,
//! [`state`] keeps their jobs; [`retention`] is for `fourdbody prune`, which checks by `second_copy` whether an
//! archive has a copy.

pub mod done;
pub mod give_way;
pub mod queue;
pub mod retention;
pub mod run;
mod second_copy;
pub mod state;
pub mod watch;
