// SPDX-License-Identifier: MIT OR Apache-2.0
//! One capture on one node: the pure state machine, and the driver that carries out its actions. And one capture on all
//! nodes: what coordinates them, from the command line or from a node.

mod actions;
mod camera_keeper;
pub mod devices;
mod event_kind;
mod events;
/// Frame sets of the last seconds, until Record.
pub mod hold;
mod hsu_keeper;
mod input_lines;
pub mod node_thread;
mod prepare;
mod ptp_watch;
mod session;
mod session_lock;
pub mod silence;
mod silence_gate;
pub mod state_machine;
mod time_code;
