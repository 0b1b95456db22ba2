// SPDX-License-Identifier: MIT OR Apache-2.0
//! Frames from cameras to the writer: receivers, accounting by trigger, frame sets, bounded hand-offs.

mod accounting;
pub mod assembler;
mod breaches;
mod commands;
pub mod dry_run;
mod hold;
mod pause;
pub mod preview;
mod progress;
pub mod receiver;
pub mod recorder;
mod writer_queue;
