// SPDX-License-Identifier: MIT OR Apache-2.0
//! A node in a session watches the other nodes of it: frames of some cameras alone are of no use.
//!
//! The coordinator of the session does the same, but may be gone. A node that answers and is not in the session any
//! more (it was restarted, or broke off) ends it at once; one that does not answer is waited for, because only the
//! network may have failed. What was recorded is kept, with the reason.

use super::participant::{LocalNode, Participant};
use crate::base::ids::NodeId;
use crate::control::client::NodeClient;
use crate::control::request::Phase;
use crate::control::status::{NodeStatus, Outcome, SessionStatus};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Another node that has not answered for this time ends the session here.
pub const PEER_PATIENCE: Duration = Duration::from_secs(15);
/// The same for a node that takes connections, and only does not serve them.
pub const UNSERVED_PATIENCE: Duration = Duration::from_secs(60);
/// Time between two status requests to a node.
const POLL: Duration = Duration::from_millis(500);
/// Time within which a node that answers must be in the session, or report that it has ended it.
const RESTART_PATIENCE: Duration = Duration::from_secs(2);

/// The thread that looks; it ends when dropped.
#[derive(Debug)]
pub struct PeerWatch {
    ended: Arc<AtomicBool>,
}

impl PeerWatch {
    /// Looks after these nodes while the node `here` is in a session with them.
    pub fn start(peers: Vec<(NodeId, NodeClient)>, here: LocalNode) -> std::io::Result<Self> {
        let ended = Arc::new(AtomicBool::new(false));
        let (seen, has_peers) = (Arc::clone(&ended), !peers.is_empty());
        let run = move || {
            let mut watch = Watch { peers, here, session: None };
            while !seen.load(Ordering::Acquire) {
                watch.look();
                std::thread::sleep(POLL);
            }
        };
        if has_peers {
            std::thread::Builder::new().name("peers".to_owned()).spawn(run)?;
        }
        Ok(Self { ended })
    }
}

impl Drop for PeerWatch {
    fn drop(&mut self) {
        // Not waited for: it may be waiting for a node that does not answer.
        self.ended.store(true, Ordering::Release);
    }
}

struct Watch {
    peers: Vec<(NodeId, NodeClient)>,
    here: LocalNode,
    /// The session that is watched, and since when each peer was not seen in it.
    session: Option<(u64, Vec<Instant>)>,
}

impl Watch {
    fn look(&mut self) {
        let Ok(status) = self.here.status() else { return };
        let waits_for_all = matches!(status.phase, Phase::Ready | Phase::Holding | Phase::Running);
        let current = if status.is_in_preview() { &status.preview } else { &status.session };
        let Some(session) = current.as_ref().filter(|_| waits_for_all) else {
            self.session = None;
            return;
        };
        let id = session.session_id;
        if self.session.as_ref().is_none_or(|(watched, _)| *watched != id) {
            self.session = Some((id, vec![Instant::now(); self.peers.len()]));
        }
        let Some((_, seen)) = &mut self.session else { return };
        for ((name, peer), seen) in self.peers.iter().zip(seen) {
            if !session.nodes.contains(name) {
                continue;
            }
            let status_there = peer.status().ok();
            let theirs = status_there.as_ref().and_then(|status| status.session.as_ref()?.kept);
            // The coordinator may be gone before all nodes received Record.
            if let Some(keep) = theirs.filter(|keep| keep.session_id == id && session.held.is_some())
                && let Err(fault) = self.here.keep(&keep)
            {
                tracing::warn!("Record, as node {name} has it: {}", fault.message);
            }
            let reason = match judge(id, status_there.as_ref()) {
                Seen::InSession => {
                    *seen = Instant::now();
                    continue;
                }
                Seen::Ended(reason) => Some(format!("node {name} ended early: {reason}")),
                Seen::NotInSession => (seen.elapsed() > RESTART_PATIENCE)
                    .then(|| format!("node {name} left the session: it was restarted")),
                Seen::Silent => {
                    let silent = seen.elapsed();
                    let gone = silent > UNSERVED_PATIENCE || silent > PEER_PATIENCE && !peer.is_there();
                    gone.then(|| format!("node {name} has not answered for {} s", silent.as_secs()))
                }
            };
            if let Some(reason) = reason {
                tracing::warn!("{reason}");
                // A session that ended meanwhile needs no telling.
                let _ = self.here.abort(id, &reason);
            }
        }
    }
}

/// What another node's answer shows about a session.
#[derive(Debug, PartialEq, Eq)]
enum Seen {
    InSession,
    Ended(String),
    NotInSession,
    Silent,
}

fn judge(session_id: u64, status: Option<&NodeStatus>) -> Seen {
    let Some(status) = status else { return Seen::Silent };
    match status.session_of(session_id) {
        // It ends its preview, and prepares then: no preview begins while a node is in a session.
        None if status.is_in_preview() => Seen::InSession,
        None => Seen::NotInSession,
        Some(SessionStatus { outcome: Some(Outcome::Failed(fault)), .. }) => {
            Seen::Ended(fault.message.clone())
        }
        Some(SessionStatus { outcome: Some(Outcome::Recorded(verdict)), .. }) => {
            match verdict["aborted"].as_str() {
                Some(reason) => Seen::Ended(reason.to_owned()),
                // Its train has ended; the end is on its way here as well.
                None => Seen::InSession,
            }
        }
        Some(_) => Seen::InSession,
    }
}
