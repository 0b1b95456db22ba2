// SPDX-License-Identifier: MIT OR Apache-2.0
//! Captures come first: is a node in a session?

use crate::base::Fault;
use crate::config::WorkerNode;
use crate::control::client::{Credentials, NodeClient};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

/// Time between two status requests to a node.
const POLL: Duration = Duration::from_millis(150);

/// Threads that ask the nodes; they end when this is dropped.
pub struct GiveWay {
    /// The session of each node, where it is in one.
    sessions: Vec<Arc<Mutex<Option<String>>>>,
    ended: Arc<AtomicBool>,
}

impl GiveWay {
    /// Begins to ask the nodes that have a URL. A node that does not answer runs no capture.
    pub fn start(nodes: &[WorkerNode]) -> Result<Self, Fault> {
        let ended = Arc::new(AtomicBool::new(false));
        let mut sessions = Vec::new();
        for node in nodes {
            let Some(url) = &node.url else { continue };
            let credentials = Credentials { token_file: node.token_file.clone(), ca: node.ca.clone() };
            let client = NodeClient::with(url, &credentials)?;
            let seen = Arc::<Mutex<Option<String>>>::default();
            let (watched, ended, name) = (Arc::clone(&seen), Arc::clone(&ended), node.name.clone());
            let watch = move || {
                while !ended.load(Ordering::Acquire) {
                    let busy = client.status().ok().filter(|status| !status.is_free());
                    let text = busy.map(|status| format!("node {name}: {:?}", status.phase).to_lowercase());
                    *watched.lock().unwrap_or_else(PoisonError::into_inner) = text;
                    std::thread::sleep(POLL);
                }
            };
            let thread = std::thread::Builder::new().name("give-way".to_owned()).spawn(watch);
            thread
                .map_err(|e| Fault::new(crate::base::Exit::Failure, format!("cannot start a thread: {e}")))?;
            sessions.push(seen);
        }
        Ok(Self { sessions, ended })
    }

    /// The capture to give way to, if there is one.
    pub fn to(&self) -> Option<String> {
        let lock =
            |seen: &Arc<Mutex<Option<String>>>| seen.lock().unwrap_or_else(PoisonError::into_inner).clone();
        self.sessions.iter().find_map(lock)
    }
}

impl Drop for GiveWay {
    fn drop(&mut self) {
        // Not waited for: one may be asking a node that does not answer.
        self.ended.store(true, Ordering::Release);
    }
}
