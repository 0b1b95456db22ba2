// SPDX-License-Identifier: MIT OR Apache-2.0
//! Reports to the service manager: that the node is ready, how it is, and that its data path moves.
//!
//! Ready means that every camera and the HSU link are verified. The watchdog is fed by counters that the threads of
//! the data path themselves drive, never by a timer alone: a thread that hangs lets the watchdog expire. See systemd/.

use crate::control::request::Phase;
use crate::control::status::{NodeStatus, Outcome};
use crate::telemetry::Telemetry;
use sd_notify::NotifyState;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, PoisonError, RwLock};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Turns of the loops that everything depends on: the node's thread, and in a session those that match and that write.
fn turns(telemetry: &Telemetry, phase: Phase) -> Vec<u64> {
    let load = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
    let mut counts = vec![load(&telemetry.node_turns)];
    // While it prepares there is no recorder yet; while it closes, the last writes may take what the disk takes.
    if matches!(phase, Phase::Ready | Phase::Holding | Phase::Running | Phase::Draining)
        && let Some(current) = telemetry.current()
    {
        counts.extend([load(&current.progress.recorder_turns), load(&current.progress.writer_turns)]);
    }
    counts
}

/// Whether every counter has moved since `before`. A session that began or ended meanwhile is movement.
fn moved(before: &[u64], now: &[u64]) -> bool {
    before.len() != now.len() || before.iter().zip(now).all(|(before, now)| before != now)
}

/// The thread that reports to the service manager; it ends when this is dropped.
#[derive(Debug)]
pub struct Notifier {
    ended: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

/// Time between two looks at the status.
const LOOK: Duration = Duration::from_millis(200);

impl Notifier {
    /// Starts telling; `None` when no service manager asks.
    pub fn start(
        status: Arc<RwLock<NodeStatus>>,
        telemetry: Arc<Telemetry>,
    ) -> std::io::Result<Option<Self>> {
        if std::env::var_os("NOTIFY_SOCKET").is_none() {
            return Ok(None);
        }
        let ended = Arc::new(AtomicBool::new(false));
        let seen = Arc::clone(&ended);
        let run = move || Reporter { status, telemetry, ready: false, shown: String::new() }.run(&seen);
        let thread = std::thread::Builder::new().name("service".to_owned()).spawn(run)?;
        Ok(Some(Self { ended, thread: Some(thread) }))
    }
}

impl Drop for Notifier {
    fn drop(&mut self) {
        self.ended.store(true, Ordering::Release);
        if self.thread.take().is_some_and(|thread| thread.join().is_err()) {
            tracing::error!("the thread that tells the service manager panicked");
        }
    }
}

struct Reporter {
    status: Arc<RwLock<NodeStatus>>,
    telemetry: Arc<Telemetry>,
    ready: bool,
    shown: String,
}

impl Reporter {
    fn run(mut self, ended: &AtomicBool) {
        // Fed four times in the watchdog's time.
        let watchdog = sd_notify::watchdog_enabled().map(|time| time / 4);
        let (mut fed, mut before) = (Instant::now(), self.turns());
        while !ended.load(Ordering::Acquire) {
            self.report_status();
            if watchdog.is_some_and(|period| fed.elapsed() >= period) {
                let now = self.turns();
                if moved(&before, &now) {
                    notify(&[NotifyState::Watchdog]);
                } else {
                    tracing::error!(?before, ?now, "a thread of the data path does not move");
                }
                (fed, before) = (Instant::now(), now);
            }
            std::thread::sleep(LOOK);
        }
        notify(&[NotifyState::Stopping, NotifyState::Status("ending the session in progress")]);
    }

    fn turns(&self) -> Vec<u64> {
        let phase = self.status.read().unwrap_or_else(PoisonError::into_inner).phase;
        turns(&self.telemetry, phase)
    }

    fn report_status(&mut self) {
        let (ready, text) = {
            let status = self.status.read().unwrap_or_else(PoisonError::into_inner);
            (is_ready(&status), in_words(&status))
        };
        if ready && !self.ready {
            notify(&[NotifyState::Ready]);
            self.ready = true;
        }
        if text != self.shown {
            notify(&[NotifyState::Status(&text)]);
            self.shown = text;
        }
    }
}

fn notify(what: &[NotifyState<'_>]) {
    if let Err(error) = sd_notify::notify(what) {
        tracing::debug!("the service manager was not notified: {error}");
    }
}

/// Every camera is verified, and the HSU answers.
fn is_ready(status: &NodeStatus) -> bool {
    let cameras = status.cameras.iter().all(|camera| camera.identity.is_some() && camera.problem.is_none());
    cameras && status.hsu.identity.is_some() && status.hsu.problem.is_none()
}

/// A line for `systemctl status`.
fn in_words(status: &NodeStatus) -> String {
    let cameras = status.cameras.iter().filter_map(|camera| camera.problem.as_deref());
    let problems: Vec<&str> = cameras.chain(status.hsu.problem.as_deref()).collect();
    let session = status.session.as_ref().map_or_else(String::new, |session| match &session.outcome {
        None => format!("; session {}", session.name),
        Some(Outcome::Recorded(verdict)) => {
            format!("; last session {}: {}", session.name, verdict["status"].as_str().unwrap_or("recorded"))
        }
        Some(Outcome::Failed(_)) => format!("; last session {}: failed", session.name),
    });
    let state = match (status.phase, problems.is_empty()) {
        (Phase::Idle, true) => format!("ready: {} cameras and the HSU", status.cameras.len()),
        (Phase::Idle, false) => format!("not ready: {}", problems.join("; ")),
        _ if status.is_in_preview() => "preview".to_owned(),
        (phase, _) => format!("{phase:?}").to_lowercase(),
    };
    state + &session
}

#[cfg(test)]
mod tests {
    use super::{moved, turns};
    use crate::acquire::recorder::Progress;
    use crate::control::request::Phase;
    use crate::telemetry::{Current, Telemetry};
    use std::sync::Arc;
    use std::sync::atomic::Ordering;

    #[test]
    fn one_counter_that_stands_still_is_enough_to_starve_the_watchdog() {
        let (telemetry, progress) = (Telemetry::default(), Arc::new(Progress::new(4)));
        telemetry.begin(Current { progress: Arc::clone(&progress), disk: None, ring_capacity: 1 });
        let before = turns(&telemetry, Phase::Running);
        telemetry.node_turns.fetch_add(1, Ordering::Relaxed);
        progress.recorder_turns.fetch_add(3, Ordering::Relaxed);
        assert!(!moved(&before, &turns(&telemetry, Phase::Running)), "the writer hangs");
        progress.writer_turns.fetch_add(1, Ordering::Relaxed);
        assert!(moved(&before, &turns(&telemetry, Phase::Running)));
        let before = turns(&telemetry, Phase::Running);
        assert!(moved(&before, &turns(&telemetry, Phase::Idle)), "the session has ended");
        let before = turns(&telemetry, Phase::Idle);
        assert!(!moved(&before, &turns(&telemetry, Phase::Idle)), "the node's thread hangs");
    }
}
