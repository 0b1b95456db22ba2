// SPDX-License-Identifier: MIT OR Apache-2.0
//! Reconstructs what the nodes have recorded, by itself, on time that nobody else wants.
//!
//! `docs/design/worker.md` states what it must keep true. [`run::Worker`] does the work; what it finds is in [`queue`], what has
//! become of it in [`state`]; [`retention`] is for `fourdbody prune`, which asks `second_copy` whether an archive
//! has one.

pub mod done;
pub mod give_way;
pub mod queue;
pub mod retention;
pub mod run;
mod second_copy;
pub mod state;
mod task;
pub mod watch;
