// SPDX-License-Identifier: MIT OR Apache-2.0
//! Frames from cameras to the writer: receivers, accounting by trigger, frame sets, bounded hand-offs.

mod accounting;
pub mod assembler;
mod breaches;
pub mod dry_run;
mod hold;
pub mod latencies;
mod pause;
pub mod preview;
pub mod receiver;
pub mod recorder;
mod writer_queue;
