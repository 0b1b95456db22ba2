// SPDX-License-Identifier: MIT OR Apache-2.0
//! A node as whoever runs a session sees it: over the API, or from inside the node that coordinates.

use super::numbering;
use crate::base::{Exit, Fault};
use crate::control::client::NodeClient;
use crate::control::command::{Command, Reply, SharedStatus};
use crate::control::request::{KeepRequest, SessionRequest};
use crate::control::status::{NodeStatus, SessionCommand};
use crossbeam_channel::Sender;
use std::sync::PoisonError;
use tokio::sync::oneshot;

/// One node of a session.
pub trait Participant: Send + Sync {
    /// Where it is, for messages.
    fn place(&self) -> String;
    /// Its status.
    fn status(&self) -> Result<NodeStatus, Fault>;
    /// Whether it takes connections at all, asked when it gave no status: a node that is only busy goes on.
    fn is_there(&self) -> bool;
    /// The first name from this one on under which nothing is recorded there.
    fn free_name(&self, wanted: &str) -> Result<String, Fault>;
    /// Prepares a session and waits until the node is ready.
    fn prepare(&self, request: &SessionRequest) -> Result<(), Fault>;
    /// Starts the train.
    fn start(&self, session_id: u64) -> Result<(), Fault>;
    /// Records what is held, from a trigger on.
    fn keep(&self, request: &KeepRequest) -> Result<(), Fault>;
    /// Ends the train after the current trigger.
    fn stop(&self, session_id: u64) -> Result<(), Fault>;
    /// Gives the session up.
    fn abort(&self, session_id: u64, reason: &str) -> Result<(), Fault>;
}

impl Participant for NodeClient {
    fn place(&self) -> String {
        self.url().to_owned()
    }

    fn status(&self) -> Result<NodeStatus, Fault> {
        Self::status(self)
    }

    fn is_there(&self) -> bool {
        Self::is_there(self)
    }

    fn free_name(&self, wanted: &str) -> Result<String, Fault> {
        Self::free_name(self, wanted)
    }

    fn prepare(&self, request: &SessionRequest) -> Result<(), Fault> {
        Self::prepare(self, request)
    }

    fn start(&self, session_id: u64) -> Result<(), Fault> {
        Self::start(self, session_id)
    }

    fn keep(&self, request: &KeepRequest) -> Result<(), Fault> {
        Self::keep(self, request)
    }

    fn stop(&self, session_id: u64) -> Result<(), Fault> {
        Self::stop(self, session_id)
    }

    fn abort(&self, session_id: u64, reason: &str) -> Result<(), Fault> {
        Self::abort(self, session_id, reason)
    }
}

/// The node that this process is.
#[derive(Debug, Clone)]
pub struct LocalNode {
    commands: Sender<Command>,
    status: SharedStatus,
}

impl LocalNode {
    /// By what the API's server also uses.
    pub fn new(commands: Sender<Command>, status: SharedStatus) -> Self {
        Self { commands, status }
    }

    /// Must not be called from a thread of the API's runtime: it waits.
    fn ask(&self, command: impl FnOnce(Reply) -> Command) -> Result<(), Fault> {
        let gone = || Fault::new(Exit::Failure, "the node is shutting down");
        let (reply, answer) = oneshot::channel();
        self.commands.send(command(reply)).map_err(|_| gone())?;
        answer.blocking_recv().unwrap_or_else(|_| Err(gone()))
    }
}

impl Participant for LocalNode {
    fn place(&self) -> String {
        "this node".to_owned()
    }

    fn status(&self) -> Result<NodeStatus, Fault> {
        // The writer only assigns: what a panic left is whole.
        Ok(self.status.read().unwrap_or_else(PoisonError::into_inner).clone())
    }

    fn is_there(&self) -> bool {
        true
    }

    fn free_name(&self, wanted: &str) -> Result<String, Fault> {
        let sessions_dir = self.status()?.sessions_dir;
        numbering::free_in(&sessions_dir, wanted).map_err(|e| Fault::new(Exit::Usage, e))
    }

    fn prepare(&self, request: &SessionRequest) -> Result<(), Fault> {
        self.ask(|reply| Command::Prepare(request.clone(), reply))
    }

    fn start(&self, session_id: u64) -> Result<(), Fault> {
        self.ask(|reply| Command::Start(SessionCommand { session_id, reason: None }, reply))
    }

    fn keep(&self, request: &KeepRequest) -> Result<(), Fault> {
        self.ask(|reply| Command::Keep(*request, reply))
    }

    fn stop(&self, session_id: u64) -> Result<(), Fault> {
        self.ask(|reply| Command::Stop(SessionCommand { session_id, reason: None }, reply))
    }

    fn abort(&self, session_id: u64, reason: &str) -> Result<(), Fault> {
        let reason = Some(reason.to_owned());
        self.ask(|reply| Command::Abort(SessionCommand { session_id, reason }, reply))
    }
}
