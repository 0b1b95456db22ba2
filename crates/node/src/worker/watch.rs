// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the worker of a node's machine does, for the node's status.

use super::done::{Done, DoneSessions};
use super::state::{OWN_DIR, WorkerState};
use crate::calibrate::drift::history::{self, Checked, LINES, PLOT, Verdict};
use crate::control::status::{
    CalibrationLight, CalibrationLights, PlayableTake, PlayableTakes, SessionLight,
};
use std::path::{Path, PathBuf};
use std::sync::{Arc, PoisonError, RwLock, RwLockReadGuard, Weak};
use std::time::{Duration, SystemTime};

/// Time between two reads of the worker's files.
const POLL: Duration = Duration::from_secs(1);
/// Number of these reads from one look at all results to the next.
const LOOKS_APART: u32 = 3;

/// A thread that reads the worker's files: the disk or share where they are may take its time, and nothing must wait
/// for it. It ends when this is dropped.
#[derive(Debug, Default)]
pub struct WorkerWatch {
    results: Option<PathBuf>,
    seen: Arc<RwLock<Seen>>,
}

#[derive(Debug, Default)]
struct Seen {
    state: Option<WorkerState>,
    history: Vec<Checked>,
    done: Arc<DoneSessions>,
    /// Of the history's lines: read again when they are others.
    written: Option<(SystemTime, u64)>,
}

impl Seen {
    /// The sessions that the worker cannot work on, each with the reason.
    fn waiting(&self) -> impl Iterator<Item = &(String, String)> {
        self.state.iter().flat_map(|state| state.set_aside.iter().chain(&state.not_yet))
    }
}

impl WorkerWatch {
    /// Begins to read; without results there is nothing to see.
    pub fn start(results: Option<PathBuf>) -> std::io::Result<Self> {
        let watch = Self { results, ..Self::default() };
        let Some(results) = watch.results.clone() else { return Ok(watch) };
        let seen: Weak<RwLock<Seen>> = Arc::downgrade(&watch.seen);
        let run = move || {
            for look in (0..LOOKS_APART).cycle() {
                let Some(seen) = seen.upgrade() else { return };
                read(&results.join(OWN_DIR), WorkerState::load(&results), &seen);
                if look == 0 {
                    look_for_done(&results, &seen);
                }
                drop(seen);
                std::thread::sleep(POLL);
            }
        };
        std::thread::Builder::new().name("worker-watch".to_owned()).spawn(run)?;
        Ok(watch)
    }

    fn seen(&self) -> RwLockReadGuard<'_, Seen> {
        self.seen.read().unwrap_or_else(PoisonError::into_inner)
    }

    /// What it does, if there is one.
    pub fn state(&self) -> Option<WorkerState> {
        self.seen().state.clone()
    }

    /// Where the plot of its history is, once there is one.
    pub fn plot(&self) -> Option<PathBuf> {
        self.seen().written?;
        self.results.as_ref().map(|results| results.join(OWN_DIR).join(PLOT))
    }

    /// The session of this name, if it has done it.
    pub fn done(&self, session: &str) -> Option<Done> {
        self.seen().done.of(session).cloned()
    }

    /// The sessions that can be played, and why others cannot.
    pub fn playable(&self) -> PlayableTakes {
        let seen = self.seen();
        let done = seen.done.all().map(|done| PlayableTake {
            session: done.session.clone(),
            session_id: Some(done.session_id.clone()),
            why_not: None,
        });
        let not = seen.waiting().map(|(session, reason)| PlayableTake {
            session: session.clone(),
            session_id: None,
            why_not: Some(format!("not reconstructed: {reason}")),
        });
        let otherwise = match seen.state.as_ref().is_some_and(WorkerState::is_running) {
            true => "not reconstructed yet: the worker does it when no node is in a session",
            false => "not reconstructed: the worker is not running",
        };
        PlayableTakes {
            worker: self.results.is_some(),
            sessions: done.chain(not).collect(),
            otherwise: otherwise.to_owned(),
        }
    }

    /// The results of the calibration checks, for at most the last `most` sessions; and why there are none of the
    /// others.
    pub fn lights(&self, most: usize) -> CalibrationLights {
        let seen = self.seen();
        let checked = seen.history.iter().rev().take(most).map(|one| SessionLight {
            session: one.session.clone(),
            session_id: Some(one.session_id.clone()),
            light: light(one.verdict),
            said: one.said.clone(),
        });
        let unknown = |(session, reason): &(String, String)| SessionLight {
            session: session.clone(),
            session_id: None,
            light: CalibrationLight::Grey,
            said: format!("not checked: {reason}"),
        };
        let otherwise = match (&self.results, &seen.state) {
            (None, _) => "not checked: this node's file names no worker ([worker])".to_owned(),
            (Some(results), None) => {
                format!("not checked: no worker has run on {}", results.display())
            }
            (_, Some(state)) if state.is_running() => {
                "not checked yet: the worker does it when no node is in a session".to_owned()
            }
            (_, Some(_)) => "not checked: the worker is not running".to_owned(),
        };
        let sessions = checked.chain(seen.waiting().take(most).map(unknown)).collect();
        CalibrationLights { worker: self.results.is_some(), sessions, otherwise }
    }
}

fn light(verdict: Verdict) -> CalibrationLight {
    match verdict {
        Verdict::Stands => CalibrationLight::Green,
        Verdict::Turned => CalibrationLight::Amber,
        Verdict::CalibrateAgain => CalibrationLight::Red,
        Verdict::NotKnown => CalibrationLight::Grey,
    }
}

fn look_for_done(results: &Path, seen: &RwLock<Seen>) {
    let before = Arc::clone(&seen.read().unwrap_or_else(PoisonError::into_inner).done);
    let found = Arc::new(DoneSessions::look(results, &before));
    seen.write().unwrap_or_else(PoisonError::into_inner).done = found;
}

fn read(own: &Path, state: Option<WorkerState>, seen: &RwLock<Seen>) {
    let written = std::fs::metadata(own.join(LINES)).and_then(|m| Ok((m.modified()?, m.len()))).ok();
    let known = seen.read().unwrap_or_else(PoisonError::into_inner).written;
    let history = (written != known).then(|| history::load(own));
    let mut seen = seen.write().unwrap_or_else(PoisonError::into_inner);
    seen.state = state;
    if let Some(history) = history {
        (seen.history, seen.written) = (history, written);
    }
}
