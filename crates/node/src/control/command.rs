// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the API asks of the node's thread, and where it reads what that publishes.

use super::request::{ExposureRequest, KeepRequest, SessionRequest};
use super::status::{ExposureSet, NodeStatus, SessionCommand};
use crate::base::Fault;
use std::sync::{Arc, RwLock};
use tokio::sync::oneshot;

/// The channel on which the node's thread answers a command.
pub type Reply<T = ()> = oneshot::Sender<Result<T, Fault>>;

/// What the API asks of the node.
#[derive(Debug)]
pub enum Command {
    /// Prepare a session; answered when the node is ready.
    Prepare(SessionRequest, Reply),
    Start(SessionCommand, Reply),
    /// Record what is held, from a trigger on.
    Keep(KeepRequest, Reply),
    /// End the train after the current trigger.
    Stop(SessionCommand, Reply),
    Abort(SessionCommand, Reply),
    Expose(ExposureRequest, Reply<ExposureSet>),
}

/// The node's status as last published by its thread.
pub type SharedStatus = Arc<RwLock<NodeStatus>>;
