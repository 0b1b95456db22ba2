// SPDX-License-Identifier: MIT OR Apache-2.0
//! This host's network interfaces, and the GigE Vision cameras that answer on them, whatever addresses they have.
//!
//! Aravis lists cameras by their addresses; a camera in a wrong subnet cannot be opened, without a reason being given.
//! Here a camera is identified by its MAC, and by the interface on which it answered.

mod action;
mod discover;
mod gvcp;
mod interface;
mod registers;
pub mod wire;

pub use action::{ActionKeys, ActionStatus, action, action_reply};
pub use discover::{Answer, Mac, discover, force_address};
pub(crate) use gvcp::receive_until;
pub use gvcp::{ForceIp, PORT as GVCP_PORT};
pub use interface::{Interface, Subnet, interfaces, shared_subnets, without_link};
pub use registers::{KeptAddress, keep_address, read_kept_address};
