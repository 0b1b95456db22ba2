//! One session on all nodes, as the operator's client sees it: prepare all, start, follow, verdict.
//!
//! Two phases: nothing starts unless every node is ready, and the HSU itself refuses a start until every
//! link has armed the same session. Whatever fails on the way, every node is told to give the session up.

use super::state::{Fault, Phase, SessionRequest};
use crate::api::client::NodeClient;
use crate::api::dto::{NodeStatus, Outcome, SessionStatus};
use crate::cmds::Exit;
use crate::ids::SessionName;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// What to capture.
#[derive(Debug, Clone)]
pub struct CaptureOptions {
    /// The nodes' URLs.
    pub nodes: Vec<String>,
    /// Seconds; or `triggers`.
    pub duration_s: Option<f64>,
    /// Triggers, 0 until stopped; or `duration_s`.
    pub triggers: Option<u64>,
    /// By default made from the time.
    pub name: Option<String>,
    /// Pseudonymous.
    pub subject: Option<String>,
    /// Free text.
    pub note: Option<String>,
}

/// A session that ended on every node.
#[derive(Debug)]
pub struct Captured {
    name: String,
    /// Per node: its name, and its session as it ended.
    nodes: Vec<(String, SessionStatus)>,
}

impl Captured {
    /// 0 when every frame of every camera is there, 3 otherwise.
    pub fn exit(&self) -> Exit {
        if self.nodes.iter().all(|(_, session)| status_word(session) == "complete") {
            Exit::Done
        } else {
            Exit::DataLoss
        }
    }

    /// The recordings.
    pub fn directories(&self) -> Vec<PathBuf> {
        self.nodes.iter().map(|(_, session)| session.directory.clone()).collect()
    }

    /// For people.
    pub fn lines(&self) -> Vec<String> {
        let mut lines = vec![format!("session {}: {}", self.name, self.verdict())];
        for (node, session) in &self.nodes {
            lines.push(format!("  node {node}: {}, {} triggers", status_word(session), session.triggers));
            match &session.outcome {
                Some(Outcome::Recorded(verdict)) => lines.extend(camera_lines(verdict)),
                _ => lines.push("    nothing recorded".to_owned()),
            }
            if let Some(reason) = aborted(session) {
                lines.push(format!("    ended early: {reason}"));
            }
        }
        lines
    }

    /// For scripts.
    pub fn to_json(&self) -> serde_json::Value {
        let nodes =
            self.nodes.iter().map(|(node, session)| serde_json::json!({ "node": node, "session": session }));
        serde_json::json!({ "name": self.name, "verdict": self.verdict(), "nodes": nodes.collect::<Vec<_>>() })
    }

    fn verdict(&self) -> &'static str {
        let words: Vec<&str> = self.nodes.iter().map(|(_, session)| status_word(session)).collect();
        let is = |word| words.contains(&word);
        if is("failed") || is("aborted") {
            "aborted"
        } else if is("incomplete") {
            "incomplete"
        } else {
            "complete"
        }
    }
}

/// One line a camera of a node's verdict, with the causes of its gaps.
fn camera_lines(verdict: &serde_json::Value) -> Vec<String> {
    let line = |camera: &serde_json::Value| {
        let causes = camera["gaps"].as_object().into_iter().flatten();
        let causes: Vec<String> = causes.map(|(cause, count)| format!("{count} {cause}")).collect();
        let gaps =
            if causes.is_empty() { "no gaps".to_owned() } else { format!("gaps: {}", causes.join(", ")) };
        format!("    {}: {} frames, {gaps}", camera["camera"].as_str().unwrap_or("?"), camera["frames"])
    };
    verdict["cameras"].as_array().into_iter().flatten().map(line).collect()
}

fn status_word(session: &SessionStatus) -> &str {
    match &session.outcome {
        Some(Outcome::Recorded(verdict)) => verdict["status"].as_str().unwrap_or("incomplete"),
        Some(Outcome::Failed(_)) | None => "failed",
    }
}

fn aborted(session: &SessionStatus) -> Option<&str> {
    match &session.outcome {
        Some(Outcome::Recorded(verdict)) => verdict["aborted"].as_str(),
        Some(Outcome::Failed(fault)) => Some(&fault.message),
        None => None,
    }
}

/// Runs a session; `progress` gets a line to show now and then.
pub fn capture(options: &CaptureOptions, mut progress: impl FnMut(&str)) -> Result<Captured, Fault> {
    let nodes: Vec<NodeClient> = options.nodes.iter().map(|url| NodeClient::new(url)).collect();
    let statuses = nodes.iter().map(NodeClient::status).collect::<Result<Vec<_>, _>>()?;
    let request = request(options, &statuses)?;
    let stop = stop_on_ctrl_c()?;
    progress("preparing cameras and HSU on all nodes");
    if let Err(fault) = prepare_all(&nodes, &statuses, &request) {
        abort_all(&nodes, request.session_id, "another node could not get ready");
        return Err(fault);
    }
    if stop.load(Ordering::Acquire) {
        abort_all(&nodes, request.session_id, "stopped by the operator before the start");
        return Err(Fault::new(Exit::Failure, "stopped before the start; nothing was recorded"));
    }
    if let Err(fault) = nodes[0].start(request.session_id) {
        abort_all(&nodes, request.session_id, &fault.message);
        return Err(fault);
    }
    let sessions = follow(&nodes, &request, &stop, &mut progress)?;
    let named = statuses.iter().map(|status| status.node.to_string()).zip(sessions);
    let captured = Captured { name: request.name, nodes: named.collect() };
    match failure_of_all(&captured.nodes) {
        Some(fault) => Err(fault),
        None => Ok(captured),
    }
}

/// A session that recorded nothing anywhere is a failure, not a verdict. Every node's reason is told: one of them may
/// only know that the train was empty, which is what the failure of another looks like from there.
fn failure_of_all(nodes: &[(String, SessionStatus)]) -> Option<Fault> {
    let failure = |(node, session): &(String, SessionStatus)| match &session.outcome {
        Some(Outcome::Failed(fault)) => Some((fault.exit, format!("node {node}: {}", fault.message))),
        _ => None,
    };
    let (exits, messages): (Vec<u8>, Vec<String>) =
        nodes.iter().map(failure).collect::<Option<Vec<_>>>()?.into_iter().unzip();
    let device = Exit::Device as u8;
    let first = exits.first().copied()?;
    let exit = exits.into_iter().find(|exit| *exit != device).unwrap_or(first);
    Some(Fault { exit, message: messages.join("; ") })
}

fn request(options: &CaptureOptions, statuses: &[NodeStatus]) -> Result<SessionRequest, Fault> {
    let usage = |message: String| Fault::new(Exit::Usage, message);
    for (i, status) in statuses.iter().enumerate() {
        if status.phase != Phase::Idle {
            return Err(usage(format!(
                "node {} is busy with a session ({:?}); wait or abort it",
                status.node, status.phase
            )));
        }
        if statuses[..i].iter().any(|other| other.node == status.node) {
            return Err(usage(format!("node {} is named twice in --nodes", status.node)));
        }
        if status.rig != statuses[0].rig
            || (status.trigger_rate_hz - statuses[0].trigger_rate_hz).abs() > 1e-9
        {
            return Err(usage(format!(
                "nodes {} and {} have different rig files ({} at {} Hz, {} at {} Hz); copy one to both",
                statuses[0].node,
                status.node,
                statuses[0].rig,
                statuses[0].trigger_rate_hz,
                status.rig,
                status.trigger_rate_hz
            )));
        }
    }
    let rate = statuses.first().map_or(1.0, |status| status.trigger_rate_hz);
    let triggers = options
        .triggers
        .unwrap_or_else(|| (options.duration_s.unwrap_or(0.0) * rate).round().max(1.0) as u64);
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    let name = options.name.clone().unwrap_or_else(|| format!("session-{}", now.as_secs()));
    let name = SessionName::parse(&name).map_err(usage)?;
    let nodes = statuses.iter().map(|status| status.node.clone()).collect();
    Ok(SessionRequest {
        session_id: random_id(now),
        name: name.0,
        triggers,
        nodes,
        subject: options.subject.clone(),
        note: options.note.clone(),
    })
}

/// Two sessions must not share an id: the hasher's keys are random per process.
fn random_id(now: Duration) -> u64 {
    use std::hash::{BuildHasher, RandomState};
    RandomState::new().hash_one((now, std::process::id())).max(1)
}

fn prepare_all(nodes: &[NodeClient], statuses: &[NodeStatus], request: &SessionRequest) -> Result<(), Fault> {
    std::thread::scope(|scope| {
        let asked: Vec<_> = nodes.iter().map(|node| scope.spawn(move || node.prepare(request))).collect();
        let mut first = Ok(());
        for (thread, status) in asked.into_iter().zip(statuses) {
            let answer =
                thread.join().unwrap_or_else(|_| Err(Fault::new(Exit::Failure, "preparing panicked")));
            let answer = answer
                .map_err(|f| Fault { exit: f.exit, message: format!("node {}: {}", status.node, f.message) });
            first = first.and(answer);
        }
        first
    })
}

fn abort_all(nodes: &[NodeClient], session_id: u64, reason: &str) {
    for node in nodes {
        // A node that is not in this session says so; there is nothing more to do for it.
        if let Err(fault) = node.abort(session_id, reason) {
            tracing::debug!(url = node.url(), "abort: {}", fault.message);
        }
    }
}

/// A node that is silent about the session for this long is lost.
const LOST_PATIENCE: Duration = Duration::from_secs(5);

fn lost(node: &NodeClient) -> Fault {
    let message = format!(
        "the node at {} does not answer any more; what it recorded is on its disk, see `fourdbody verify` there",
        node.url()
    );
    Fault::new(Exit::Device, message)
}

/// Polls until every node has an outcome for this session.
fn follow(
    nodes: &[NodeClient],
    request: &SessionRequest,
    stop: &AtomicBool,
    progress: &mut impl FnMut(&str),
) -> Result<Vec<SessionStatus>, Fault> {
    const POLL: Duration = Duration::from_millis(100);
    let mut seen = vec![Instant::now(); nodes.len()];
    let mut latest: Vec<Option<SessionStatus>> = vec![None; nodes.len()];
    let mut told = false;
    loop {
        if stop.swap(false, Ordering::AcqRel) {
            progress("stopping after the current trigger");
            // Any link will do: the first node may be the one that is gone.
            nodes.iter().map(|node| node.stop(request.session_id)).find(Result::is_ok).unwrap_or(Ok(()))?;
        }
        for (i, node) in nodes.iter().enumerate() {
            if latest[i].as_ref().is_some_and(|session| session.outcome.is_some()) {
                continue;
            }
            let answer =
                node.status().map(|status| status.session.filter(|s| s.session_id == request.session_id));
            match answer {
                Ok(Some(session)) => {
                    seen[i] = Instant::now();
                    latest[i] = Some(session);
                }
                _ if seen[i].elapsed() < LOST_PATIENCE => {}
                // It died, or was restarted and knows nothing of the session.
                _ => match &mut latest[i] {
                    Some(session) => session.outcome = Some(Outcome::Failed(lost(node))),
                    None => {
                        abort_all(nodes, request.session_id, "the other node does not answer any more");
                        return Err(lost(node));
                    }
                },
            }
        }
        let ended = |s: &Option<SessionStatus>| s.as_ref().is_some_and(|s| s.outcome.is_some());
        if latest.iter().all(ended) {
            return Ok(latest.into_iter().flatten().collect());
        }
        // A node that broke off ends the session for all: frames of some cameras alone are of no use.
        let broken = latest.iter().flatten().find_map(aborted);
        if let Some(reason) = broken.filter(|_| !told) {
            let reason = format!("another node ended early: {reason}");
            told = true;
            abort_all(nodes, request.session_id, &reason);
        }
        let triggers = latest.iter().flatten().map(|s| s.triggers).max().unwrap_or(0);
        let frames: u64 = latest.iter().flatten().flat_map(|s| &s.cameras).map(|c| c.frames).sum();
        let gaps: u64 = latest.iter().flatten().flat_map(|s| &s.cameras).map(|c| c.gaps).sum();
        let of = if request.triggers == 0 { String::new() } else { format!(" of {}", request.triggers) };
        progress(&format!("trigger {triggers}{of}: {frames} frames, {gaps} gaps"));
        std::thread::sleep(POLL);
    }
}

/// A flag that Ctrl-C sets.
fn stop_on_ctrl_c() -> Result<Arc<AtomicBool>, Fault> {
    let flag = Arc::new(AtomicBool::new(false));
    let set = Arc::clone(&flag);
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .map_err(|e| Fault::new(Exit::Failure, format!("cannot watch for Ctrl-C: {e}")))?;
    // Registered before the thread runs: from here on no Ctrl-C kills the process.
    let mut interrupts = {
        let _inside = runtime.enter();
        use tokio::signal::unix::{SignalKind, signal};
        signal(SignalKind::interrupt())
            .map_err(|e| Fault::new(Exit::Failure, format!("cannot watch for Ctrl-C: {e}")))?
    };
    std::thread::spawn(move || {
        runtime.block_on(async {
            while interrupts.recv().await.is_some() {
                set.store(true, Ordering::Release);
            }
        });
    });
    Ok(flag)
}
