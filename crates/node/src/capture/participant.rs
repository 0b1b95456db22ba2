// SPDX-License-Identifier: MIT OR Apache-2.0
//! A node as the coordinator of a session sees it: over the API, or from inside the node that coordinates.

use super::numbering;
use crate::base::ids::SessionName;
use crate::base::{Exit, Fault};
use crate::control::client::{NodeClient, TIMEOUT};
use crate::control::command::{Command, Reply, SharedStatus};
use crate::control::request::{KeepRequest, SessionRequest};
use crate::control::status::{FreeName, NodeStatus, SessionCommand, path};
use crossbeam_channel::Sender;
use std::sync::PoisonError;
use std::time::Duration;
use tokio::sync::oneshot;

/// One node of a session.
pub trait Participant: Send + Sync {
    /// Where it is, for messages.
    fn place(&self) -> String;
    /// The status of the node now.
    fn status(&self) -> Result<NodeStatus, Fault>;
    /// Whether it takes connections at all, for a node that gave no status: one that is only busy goes on.
    fn is_there(&self) -> bool;
    /// The first name from this one on under which nothing is recorded there.
    fn free_name(&self, wanted: &str) -> Result<String, Fault>;
    /// Prepares a session and waits until the node is ready.
    fn prepare(&self, request: &SessionRequest) -> Result<(), Fault>;
    /// Starts the train of triggers.
    fn start(&self, session_id: u64) -> Result<(), Fault>;
    /// Records what is held, from a trigger on.
    fn keep(&self, request: &KeepRequest) -> Result<(), Fault>;
    /// Ends the train after the current trigger.
    fn stop(&self, session_id: u64) -> Result<(), Fault>;
    /// Gives the session up; the reason is stored in the recording.
    fn abort(&self, session_id: u64, reason: &str) -> Result<(), Fault>;
}

/// The nodes of one session, in the order of its request.
pub type Nodes<'a> = &'a [Box<dyn Participant>];

/// Time without a status of the session after which a node counts as lost.
pub const LOST_PATIENCE: Duration = Duration::from_secs(5);

pub(crate) fn abort_all(nodes: Nodes<'_>, session_id: u64, reason: &str) {
    for node in nodes {
        // A node that is not in this session refuses; there is nothing more to do for it.
        if let Err(fault) = node.abort(session_id, reason) {
            tracing::debug!(place = node.place(), "abort: {}", fault.message);
        }
    }
}

/// Longest time that a node may take to prepare: it waits for absent cameras, 2.5 s each.
const PREPARE_TIMEOUT: Duration = Duration::from_secs(60);
/// The same for a node that allocates memory for the seconds before Record.
const PREPARE_TO_HOLD_TIMEOUT: Duration = Duration::from_secs(110);

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
        // A name that leads elsewhere in the path is none of a session.
        let wanted = SessionName::parse(wanted).map_err(|e| Fault::new(Exit::Usage, e))?;
        let free: FreeName = self.get(&path::FREE_NAME.replace("{name}", wanted.as_str()))?;
        Ok(free.name)
    }

    fn prepare(&self, request: &SessionRequest) -> Result<(), Fault> {
        let patience = if request.pre_triggers > 0 { PREPARE_TO_HOLD_TIMEOUT } else { PREPARE_TIMEOUT };
        self.post(path::PREPARE, request, patience)
    }

    fn start(&self, session_id: u64) -> Result<(), Fault> {
        self.post(path::START, &SessionCommand { session_id, reason: None }, TIMEOUT)
    }

    fn keep(&self, request: &KeepRequest) -> Result<(), Fault> {
        self.post(path::KEEP, request, TIMEOUT)
    }

    fn stop(&self, session_id: u64) -> Result<(), Fault> {
        self.post(path::STOP, &SessionCommand { session_id, reason: None }, TIMEOUT)
    }

    fn abort(&self, session_id: u64, reason: &str) -> Result<(), Fault> {
        let command = SessionCommand { session_id, reason: Some(reason.to_owned()) };
        self.post(path::ABORT, &command, TIMEOUT)
    }
}

/// The node that this process is.
#[derive(Debug, Clone)]
pub struct LocalNode {
    commands: Sender<Command>,
    status: SharedStatus,
}

impl LocalNode {
    /// A node in this process, by the channel and status that its API uses.
    pub fn new(commands: Sender<Command>, status: SharedStatus) -> Self {
        Self { commands, status }
    }

    /// Sends a command to the node's thread and waits for the answer. Must not be called from a thread of the API's
    /// runtime.
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
