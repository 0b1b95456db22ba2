// SPDX-License-Identifier: MIT OR Apache-2.0
//! One session on all nodes, as its coordinator sees it: prepare all, count down, start, follow, verdict.
//!
//! Two phases: nothing starts unless every node is ready, and the HSU itself refuses a start until every link has
//! armed the same session. Whatever fails on the way, every node receives an abort.

use super::before_record::Span;
use super::countdown::{Watch, count_down};
use super::participant::Participant;
use super::peer_watch::UNSERVED_PATIENCE;
use super::report::{Captured, ended_early, failure_of_all};
use crate::base::ids::NodeId;
use crate::base::{Exit, Fault};
use crate::control::request::{Phase, SessionRequest, StartOn};
use crate::control::status::{NodeStatus, Outcome, SessionStatus};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::fmt;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// What to capture: one take.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields, default)]
pub struct CaptureRequest {
    /// Seconds; or `triggers`; or neither: until stopped.
    pub duration_s: Option<f64>,
    /// Triggers, 0 until stopped; or `duration_s`.
    pub triggers: Option<u64>,
    /// Also the session's directory; by default made from the time.
    pub name: Option<String>,
    /// A pseudonym of the subject, never a name.
    pub subject: Option<String>,
    /// A free text of the operator.
    pub note: Option<String>,
    /// The train starts at this edge of one of the HSU's inputs; nodes wait 120 s for it.
    pub start_on: Option<StartOn>,
    /// Seconds before Record that are kept: the train starts, and nothing is recorded before it. Then `duration_s` or
    /// `triggers` is counted from Record.
    pub pre_trigger_s: Option<f64>,
    /// Seconds that are recorded after a stop.
    pub post_trigger_s: Option<f64>,
    /// Everything is done as in a session, but nothing is recorded.
    pub dry_run: bool,
    /// A part of the rig is meant: without this all nodes of the rig take part.
    pub partial: bool,
    /// Seconds from the moment at which every node is ready to the first trigger.
    pub countdown_s: u32,
    /// The operator for whom the node runs the capture; never taken from a request.
    #[serde(skip)]
    pub on_behalf_of: Option<String>,
}

/// Longest countdown, s: half of the 120 s that nodes which are ready wait.
pub const COUNTDOWN_MAX_S: u32 = 60;

/// The operator's requests to a capture that runs: Record, Stop and Abort.
#[derive(Debug, Default)]
pub struct Control {
    stop: AtomicBool,
    record: AtomicBool,
    holding: AtomicBool,
    abort: Mutex<Option<String>>,
    /// An end was requested at some time.
    end_requested: AtomicBool,
}

impl Control {
    /// After the current trigger; what was recorded is a session as any other. Before the start: nothing is recorded.
    pub fn stop(&self) {
        self.end_requested.store(true, Ordering::Release);
        self.stop.store(true, Ordering::Release);
    }

    /// What is held is kept, and recorded with what comes. `false`: nothing is held, now or any more.
    pub fn record(&self) -> bool {
        let holding = self.holding.load(Ordering::Acquire);
        self.record.fetch_or(holding, Ordering::AcqRel);
        holding
    }

    pub(crate) fn holds(&self, holding: bool) {
        self.holding.store(holding, Ordering::Release);
    }

    pub(crate) fn record_is_pressed(&self) -> bool {
        self.record.load(Ordering::Acquire)
    }

    /// Now; what was recorded is kept, with the reason.
    pub fn abort(&self, reason: &str) {
        self.end_requested.store(true, Ordering::Release);
        let mut abort = self.abort.lock().unwrap_or_else(PoisonError::into_inner);
        abort.get_or_insert_with(|| reason.to_owned());
    }

    /// Whether the operator requested an end at any time, carried out or not.
    pub fn end_was_requested(&self) -> bool {
        self.end_requested.load(Ordering::Acquire)
    }

    /// Whether an end was requested; a stop is not forgotten.
    pub fn ends(&self) -> bool {
        self.stop.load(Ordering::Acquire)
            || self.abort.lock().unwrap_or_else(PoisonError::into_inner).is_some()
    }

    fn take_abort(&self) -> Option<String> {
        self.abort.lock().unwrap_or_else(PoisonError::into_inner).take()
    }
}

/// How far a capture is.
#[derive(Debug, Clone, PartialEq, Serialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case", tag = "stage")]
pub enum Stage {
    /// Cameras and HSU of all nodes.
    Preparing,
    /// Every node is ready; the countdown runs.
    CountingDown {
        /// Seconds until the first trigger.
        left_s: u32,
    },
    /// Every node is ready, and the HSU waits for an edge of an input.
    AwaitingEdge {
        /// The edge that starts the train.
        edge: StartOn,
    },
    /// Triggers are coming, frames are held, and nothing is recorded before Record.
    Holding {
        /// Triggers that all nodes hold.
        triggers: u64,
        /// Those that are to be kept.
        asked: u64,
        /// The same as in [`Self::Recording`].
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        notices: Vec<String>,
    },
    /// Triggers are coming, or their frames are.
    Recording {
        /// Number of triggers recorded so far.
        triggers: u64,
        /// Number of requested triggers; 0: until stopped.
        asked: u64,
        /// Frames of all cameras so far.
        frames: u64,
        /// Gap records of all cameras.
        gaps: u64,
        /// What nodes find that must be known now, with their names.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        notices: Vec<String>,
    },
    /// The train ends after the current trigger.
    Stopping,
    /// A node takes connections and gives no status; the session goes on there, and its verdict is waited for.
    Unanswered {
        /// The URL of the node.
        place: String,
        /// Seconds since its last status.
        since_s: u64,
    },
}

impl fmt::Display for Stage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Preparing => write!(f, "preparing cameras and HSU on all nodes"),
            Self::CountingDown { left_s } => {
                write!(f, "every node is ready; {left_s} s to the first trigger")
            }
            Self::AwaitingEdge { edge } => write!(f, "every node is ready; waiting for a {edge}"),
            Self::Holding { triggers, asked, .. } => {
                write!(f, "{triggers} of {asked} triggers before Record are held; nothing is recorded yet")
            }
            Self::Recording { triggers, asked: 0, frames, gaps, .. } => {
                write!(f, "trigger {triggers}: {frames} frames, {gaps} gaps")
            }
            Self::Recording { triggers, asked, frames, gaps, .. } => {
                write!(f, "trigger {triggers} of {asked}: {frames} frames, {gaps} gaps")
            }
            Self::Stopping => write!(f, "stopping after the current trigger"),
            Self::Unanswered { place, since_s } => {
                write!(f, "no status from {place} for {since_s} s; its session goes on")
            }
        }
    }
}

/// The nodes of one session, in the order of its request.
pub type Nodes<'a> = &'a [Box<dyn Participant>];

/// Runs one session on all nodes, from the request to the verdict; `progress` receives each stage.
pub fn capture(
    nodes: Nodes<'_>,
    wish: &CaptureRequest,
    control: &Control,
    mut progress: impl FnMut(&Stage),
) -> Result<Captured, Fault> {
    let statuses = nodes.iter().map(|node| node.status()).collect::<Result<Vec<_>, _>>()?;
    let (request, mut span) = request(wish, &statuses)?;
    control.record.store(false, Ordering::Release);
    control.holds(false);
    progress(&Stage::Preparing);
    if let Err(fault) = prepare_all(nodes, &statuses, &request) {
        abort_all(nodes, request.session_id, "another node could not get ready");
        return Err(fault);
    }
    let mut watch = Watch::new(nodes, request.session_id);
    if let Err(fault) = count_down(wish.countdown_s, control, &mut progress, &mut watch) {
        return Err(watch.give_up(fault));
    }
    if control.ends() {
        let reason = control.take_abort();
        let reason = reason.unwrap_or_else(|| "stopped by the operator before the start".to_owned());
        abort_all(nodes, request.session_id, &reason);
        return Err(not_begun(&reason));
    }
    let first = nodes.first().ok_or_else(|| Fault::new(Exit::Usage, "no nodes"))?;
    if let Err(refused) = first.start(request.session_id) {
        // The own reason of a node that has given up since is more precise.
        let fault = watch.look().err().unwrap_or(refused);
        return Err(watch.give_up(fault));
    }
    let rate = statuses.first().map_or(1.0, |status| status.trigger_rate_hz);
    let train = Duration::try_from_secs_f64(request.triggers as f64 / rate).unwrap_or(Duration::MAX);
    let sessions = follow(nodes, &request, train, &mut span, control, &mut progress)?;
    let named = statuses.iter().map(|status| status.node.to_string()).zip(sessions);
    let captured = Captured::new(request.name, wish.dry_run, absent(&statuses), named.collect());
    match failure_of_all(captured.nodes()) {
        Some(_) if request.start_on.is_some() && control.end_was_requested() => {
            Err(not_begun("stopped by the operator before the edge came"))
        }
        Some(_) if !span.records() && control.end_was_requested() => {
            Err(not_begun("stopped by the operator before Record was pressed"))
        }
        Some(fault) => Err(fault),
        None => Ok(captured),
    }
}

fn not_begun(reason: &str) -> Fault {
    Fault::new(Exit::Failure, format!("stopped before the start; nothing was recorded ({reason})"))
}

fn request(wish: &CaptureRequest, statuses: &[NodeStatus]) -> Result<(SessionRequest, Span), Fault> {
    let usage = |message: String| Fault::new(Exit::Usage, message);
    for (i, status) in statuses.iter().enumerate() {
        if status.phase != Phase::Idle {
            return Err(usage(format!(
                "node {} is busy with a session ({:?}); wait or abort it",
                status.node, status.phase
            )));
        }
        if statuses[..i].iter().any(|other| other.node == status.node) {
            return Err(usage(format!("node {} is named twice", status.node)));
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
    let absent = absent(statuses);
    // A dry run records nothing, and its report lists the absent nodes.
    if !absent.is_empty() && !wish.partial && !wish.dry_run {
        return Err(usage(format!(
            "the rig has node {}, which does not take part; add it to --nodes (on a node: to its peers), or record \
             a part of the rig with --partial",
            absent.join(" and node ")
        )));
    }
    if wish.countdown_s > COUNTDOWN_MAX_S {
        return Err(usage(format!(
            "a countdown of {} s; expected at most {COUNTDOWN_MAX_S}",
            wish.countdown_s
        )));
    }
    let rate = statuses.first().map_or(1.0, |status| status.trigger_rate_hz);
    let triggers = triggers(wish, rate).map_err(usage)?;
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    let name = wish.name.clone().unwrap_or_else(|| format!("session-{}", now.as_secs()));
    let nodes = statuses.iter().map(|status| status.node.clone()).collect();
    let session_id = random_id(now);
    let span = Span::new(wish, session_id, triggers, rate, statuses.len()).map_err(usage)?;
    let request = SessionRequest {
        session_id,
        name,
        // How many there are in all is known when Record is pressed.
        triggers: if span.before() > 0 { 0 } else { triggers },
        nodes,
        subject: wish.subject.clone(),
        note: wish.note.clone(),
        start_on: wish.start_on,
        pre_triggers: span.before(),
        dry_run: wish.dry_run,
        on_behalf_of: wish.on_behalf_of.clone(),
    };
    request.check().map_err(usage)?;
    Ok((request, span))
}

/// Nodes of the rig that are not among these.
fn absent(statuses: &[NodeStatus]) -> Vec<String> {
    let rig = statuses.iter().flat_map(|status| &status.rig_nodes);
    let absent = rig.filter(|node| !statuses.iter().any(|status| status.node == **node));
    absent.map(ToString::to_string).collect::<BTreeSet<_>>().into_iter().collect()
}

/// Number of requested triggers, 0: until stopped.
fn triggers(wish: &CaptureRequest, rate_hz: f64) -> Result<u64, String> {
    match (wish.triggers, wish.duration_s) {
        (Some(_), Some(_)) => Err("both triggers and a duration; expected one of them".to_owned()),
        (Some(triggers), None) => Ok(triggers),
        (None, Some(seconds)) if seconds > 0.0 && seconds < 1e6 => {
            Ok((seconds * rate_hz).round().max(1.0) as u64)
        }
        (None, Some(seconds)) => Err(format!("a duration of {seconds} s; expected seconds above 0")),
        (None, None) => Ok(0),
    }
}

/// Two sessions must not share an id: the hasher's keys are random per process.
fn random_id(now: Duration) -> u64 {
    use std::hash::{BuildHasher, RandomState};
    RandomState::new().hash_one((now, std::process::id())).max(1)
}

fn prepare_all(nodes: Nodes<'_>, statuses: &[NodeStatus], request: &SessionRequest) -> Result<(), Fault> {
    std::thread::scope(|scope| {
        let asked: Vec<_> = nodes.iter().map(|node| scope.spawn(move || node.prepare(request))).collect();
        let mut all: Option<Fault> = None;
        for (thread, status) in asked.into_iter().zip(statuses) {
            let answer =
                thread.join().unwrap_or_else(|_| Err(Fault::new(Exit::Failure, "preparing panicked")));
            let answer = answer
                .map_err(|f| Fault { exit: f.exit, message: format!("node {}: {}", status.node, f.message) });
            // All nodes' faults are reported, not only the first.
            if let Err(fault) = answer {
                all = Some(match all {
                    None => fault,
                    Some(first) => {
                        Fault { exit: first.exit, message: format!("{}\n{}", first.message, fault.message) }
                    }
                });
            }
        }
        all.map_or(Ok(()), Err)
    })
}

pub(crate) fn abort_all(nodes: Nodes<'_>, session_id: u64, reason: &str) {
    for node in nodes {
        // A node that is not in this session refuses; there is nothing more to do for it.
        if let Err(fault) = node.abort(session_id, reason) {
            tracing::debug!(place = node.place(), "abort: {}", fault.message);
        }
    }
}

/// Time without a status of the session after which a node counts as lost.
pub const LOST_PATIENCE: Duration = Duration::from_secs(5);

fn lost(node: &dyn Participant) -> Fault {
    let message = format!(
        "the node at {} stopped answering; its part of the recording is on its disk, see `fourdbody verify` there",
        node.place()
    );
    Fault::new(Exit::Device, message)
}

/// Polls until every node has an outcome for this session; `train` is how long its triggers take, 0 where that is not
/// known.
fn follow(
    nodes: Nodes<'_>,
    request: &SessionRequest,
    train: Duration,
    span: &mut Span,
    control: &Control,
    progress: &mut impl FnMut(&Stage),
) -> Result<Vec<SessionStatus>, Fault> {
    const POLL: Duration = Duration::from_millis(100);
    let mut seen = vec![Instant::now(); nodes.len()];
    let mut latest: Vec<Option<SessionStatus>> = vec![None; nodes.len()];
    let (mut aborted, mut stopping, mut triggers, started) = (false, false, 0, Instant::now());
    loop {
        stopping |= span.stops(control.stop.swap(false, Ordering::AcqRel), triggers);
        if stopping {
            progress(&Stage::Stopping);
            // Any link will do: the first node may be the one that is gone. Where no node takes it, it is sent again.
            stopping = !nodes.iter().any(|node| node.stop(request.session_id).is_ok());
        }
        if let Some(reason) = control.take_abort() {
            aborted = true;
            abort_all(nodes, request.session_id, &reason);
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
                // Other clients may take all that it can serve: that ends no session.
                Err(_)
                    if seen[i].elapsed().min(started.elapsed().saturating_sub(train)) < UNSERVED_PATIENCE
                        && node.is_there() =>
                {
                    progress(&Stage::Unanswered {
                        place: node.place(),
                        since_s: seen[i].elapsed().as_secs(),
                    });
                }
                // It died, or was restarted and knows nothing of the session.
                _ => match &mut latest[i] {
                    Some(session) => session.outcome = Some(Outcome::Failed(lost(node.as_ref()))),
                    None => {
                        abort_all(nodes, request.session_id, "the other node stopped answering");
                        return Err(lost(node.as_ref()));
                    }
                },
            }
        }
        span.pass_record_on(nodes, &latest, control);
        let ended = |s: &Option<SessionStatus>| s.as_ref().is_some_and(|s| s.outcome.is_some());
        if latest.iter().all(ended) {
            return Ok(latest.into_iter().flatten().collect());
        }
        // A node that broke off ends the session for all: frames of some cameras alone are of no use.
        let broken = latest.iter().flatten().find_map(ended_early);
        if let Some(reason) = broken.filter(|_| !aborted) {
            let reason = format!("another node ended early: {reason}");
            aborted = true;
            abort_all(nodes, request.session_id, &reason);
        }
        let sum = |count: fn(&crate::control::status::CameraProgress) -> u64| -> u64 {
            latest.iter().flatten().flat_map(|s| &s.cameras).map(count).sum()
        };
        triggers = latest.iter().flatten().map(|s| s.triggers).max().unwrap_or(0);
        let held = span.held(&latest);
        control.holds(held.is_some());
        let notices = notices(request, &latest);
        progress(&match (request.start_on.filter(|_| triggers == 0), held) {
            (Some(edge), _) => Stage::AwaitingEdge { edge },
            (None, Some(triggers)) => Stage::Holding { triggers, asked: span.before(), notices },
            (None, None) => Stage::Recording {
                triggers,
                asked: span.total().unwrap_or(request.triggers),
                frames: sum(|c| c.frames),
                gaps: sum(|c| c.gaps),
                notices,
            },
        });
        std::thread::sleep(POLL);
    }
}

/// What the nodes of a session find that must be known now.
fn notices(request: &SessionRequest, latest: &[Option<SessionStatus>]) -> Vec<String> {
    let named = request.nodes.iter().zip(latest);
    let of = |(node, session): (&NodeId, &Option<SessionStatus>)| -> Vec<String> {
        let notices = session.iter().flat_map(|session| &session.notices);
        notices.map(|notice| format!("node {node}: {notice}")).collect()
    };
    named.flat_map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::{CaptureRequest, triggers};

    #[test]
    fn a_wish_without_an_end_runs_until_it_is_stopped() {
        let wish =
            |triggers, duration_s| CaptureRequest { triggers, duration_s, ..CaptureRequest::default() };
        assert_eq!(triggers(&wish(None, None), 120.0), Ok(0));
        assert_eq!(triggers(&wish(None, Some(0.5)), 120.0), Ok(60));
        assert_eq!(triggers(&wish(None, Some(1e-9)), 120.0), Ok(1));
        assert_eq!(triggers(&wish(Some(7), None), 120.0), Ok(7));
        for bad in [wish(Some(1), Some(1.0)), wish(None, Some(0.0)), wish(None, Some(f64::NAN))] {
            assert!(triggers(&bad, 120.0).is_err(), "{bad:?}");
        }
    }
}
