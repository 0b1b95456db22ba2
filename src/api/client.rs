//! The API's client, blocking: what `capture` and `status` use.

use super::dto::{NodeStatus, SessionCommand, path};
use crate::cmds::Exit;
use crate::session::state::{Fault, SessionRequest};
use serde::Serialize;
use std::time::Duration;

/// One node, by its URL.
#[derive(Debug, Clone)]
pub struct NodeClient {
    url: String,
    agent: ureq::Agent,
}

/// Preparing waits for absent cameras, 2.5 s each.
const PREPARE_TIMEOUT: Duration = Duration::from_secs(60);
const TIMEOUT: Duration = Duration::from_secs(10);

impl NodeClient {
    /// A client for `http://HOST:PORT` (the scheme may be left out).
    pub fn new(url: &str) -> Self {
        let url = url.trim_end_matches('/');
        let url = if url.contains("://") { url.to_owned() } else { format!("http://{url}") };
        let config = ureq::Agent::config_builder().http_status_as_error(false).proxy(None).build();
        Self { url, agent: config.into() }
    }

    /// The URL.
    pub fn url(&self) -> &str {
        &self.url
    }

    /// The node's status.
    pub fn status(&self) -> Result<NodeStatus, Fault> {
        let request = self.agent.get(format!("{}{}", self.url, path::STATUS));
        let request = request.config().timeout_global(Some(TIMEOUT)).build();
        let mut response = request.call().map_err(|e| self.unreachable(&e))?;
        response.body_mut().read_json().map_err(|e| self.unreachable(&e))
    }

    /// Prepares a session and waits until the node is ready.
    pub fn prepare(&self, request: &SessionRequest) -> Result<(), Fault> {
        self.post(path::PREPARE, request, PREPARE_TIMEOUT)
    }

    /// Starts the train.
    pub fn start(&self, session_id: u64) -> Result<(), Fault> {
        self.post(path::START, &SessionCommand { session_id, reason: None }, TIMEOUT)
    }

    /// Ends the train after the current trigger.
    pub fn stop(&self, session_id: u64) -> Result<(), Fault> {
        self.post(path::STOP, &SessionCommand { session_id, reason: None }, TIMEOUT)
    }

    /// Gives the session up.
    pub fn abort(&self, session_id: u64, reason: &str) -> Result<(), Fault> {
        let command = SessionCommand { session_id, reason: Some(reason.to_owned()) };
        self.post(path::ABORT, &command, TIMEOUT)
    }

    fn post(&self, path: &str, body: &impl Serialize, timeout: Duration) -> Result<(), Fault> {
        let request = self.agent.post(format!("{}{path}", self.url));
        let request = request.config().timeout_global(Some(timeout)).build();
        let mut response = request.send_json(body).map_err(|e| self.unreachable(&e))?;
        if response.status().is_success() {
            return Ok(());
        }
        let status = response.status();
        let text = response.body_mut().read_to_string().unwrap_or_default();
        Err(serde_json::from_str(&text)
            .unwrap_or_else(|_| Fault::new(Exit::Failure, format!("{} answered {status}: {text}", self.url))))
    }

    fn unreachable(&self, error: &ureq::Error) -> Fault {
        Fault::new(
            Exit::Device,
            format!("no node answers at {} ({error}); is `fourdbody node` running there?", self.url),
        )
    }
}
