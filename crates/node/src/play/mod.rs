// SPDX-License-Identifier: MIT OR Apache-2.0
//! A reconstructed session as frame sets for a player: inside the page of `fourdbody report --play`, or one by one
//! from a node.
//!
//! [`sequence`] is what of a result can be played, [`packed`] a frame set as bytes. A node has them made by a process
//! of its own ([`process`]), which [`desk`] starts, asks and ends.

pub mod desk;
pub mod packed;
pub mod process;
pub mod sequence;

pub use sequence::{Described, Hole, Sequence};
