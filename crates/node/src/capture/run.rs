// SPDX-License-Identifier: MIT OR Apache-2.0
//! One session on all nodes, as its coordinator sees it: prepare all, count down, start, follow, verdict.
//!
//! Two phases: nothing starts unless every node is ready, and the HSU itself refuses a start until every link has
//! armed the same session. Whatever fails on the way, every node receives an abort.

use super::before_record::Span;
use super::countdown::{Watch, count_down};
use super::participant::{LOST_PATIENCE, Nodes, Participant, abort_all};
use super::peer_watch::UNSERVED_PATIENCE;
use super::report::{Captured, ended_early, failure_of_all};
use super::request::{COUNTDOWN_MAX_S, CaptureRequest, Control, Stage};
use crate::base::ids::NodeId;
use crate::base::{Exit, Fault};
use crate::control::request::{Phase, SessionRequest};
use crate::control::status::{NodeStatus, Outcome, SessionStatus};
use std::collections::BTreeSet;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// Runs one session on all nodes, from the request to the verdict; `progress` receives each stage.
pub fn capture(
    nodes: Nodes<'_>,
    wish: &CaptureRequest,
    control: &Control,
    mut progress: impl FnMut(&Stage),
) -> Result<Captured, Fault> {
    let statuses = nodes.iter().map(|node| node.status()).collect::<Result<Vec<_>, _>>()?;
    let (request, mut span) = request(wish, &statuses)?;
    control.begin();
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
    let (name, dry_run, absent) = (request.name, wish.dry_run, absent(&statuses));
    let captured = Captured { name, dry_run, absent, nodes: named.collect() };
    match failure_of_all(&captured.nodes) {
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
        // A preview gives way to all but another preview.
        if status.phase != Phase::Idle && (wish.preview || !status.is_free()) {
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
        triggers: if span.before > 0 { 0 } else { triggers },
        nodes,
        subject: wish.subject.clone(),
        note: wish.note.clone(),
        start_on: wish.start_on,
        pre_triggers: span.before,
        dry_run: wish.dry_run,
        preview: wish.preview,
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
        stopping |= span.stops(control.take_stop(), triggers);
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
            let answer = node.status().map(|status| status.session_of(request.session_id).cloned());
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
            (None, Some(triggers)) => Stage::Holding { triggers, asked: span.before, notices },
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
