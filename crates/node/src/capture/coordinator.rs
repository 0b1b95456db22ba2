// SPDX-License-Identifier: MIT OR Apache-2.0
//! Captures that a node runs for its operators: the browser, or the tablet, may go; the capture goes on.
//!
//! One at a time. It runs the same steps as `fourdbody capture`, on a thread of its own, and keeps what came of it
//! until the next begins. While none runs, it keeps the cameras running for pages that show pictures.

use super::participant::Participant;
use super::report::Captured;
use super::request::{CaptureRequest, Control, Stage};
use super::run::capture;
use super::series::{self, Series};
use crate::base::{Exit, Fault};
use crate::control::interest::Interest;
use crate::control::request::Phase;
use serde::Serialize;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Makes the list of nodes for a capture; called anew for each.
pub type Participants = Arc<dyn Fn() -> Vec<Box<dyn Participant>> + Send + Sync>;

/// The capture under way, or the last one.
#[derive(Debug, Clone, Serialize, utoipa::ToSchema)]
pub struct CaptureState {
    /// Counts the captures that this node has run since it started.
    pub number: u64,
    /// The series as it was requested.
    pub series: Series,
    /// Whose capture it is, as the audit log names them.
    pub operator: String,
    /// The take under way, from 1.
    pub take: u32,
    /// How far that is; `None` between takes and at the end.
    pub stage: Option<Stage>,
    /// It has not ended yet.
    pub running: bool,
    /// The takes that ended, as `capture --json` prints them.
    pub takes: Vec<serde_json::Value>,
    /// Why the series ended with a failure.
    pub fault: Option<Fault>,
    /// Where the operator ended it before its last take: the state of the take under way.
    pub stopped: Option<String>,
    /// Whether the operator requested an end.
    pub asked_to_end: bool,
}

/// Runs the captures of a node's operators, one at a time. The API's server makes it at its start and shares it among
/// requests. Each capture has a thread of its own, which goes on when the browser is closed; its state is kept until
/// the next capture begins.
#[derive(Clone)]
pub struct Coordinator {
    cast: Participants,
    shared: Arc<Mutex<Shared>>,
    /// When a page last showed pictures.
    looking: Arc<Interest>,
}

#[derive(Default)]
struct Shared {
    state: Option<CaptureState>,
    control: Arc<Control>,
    preview: Preview,
}

/// The preview of this node's pages.
#[derive(Default)]
struct Preview {
    runs: bool,
    /// When the last one ended with a failure.
    failed: Option<Instant>,
}

/// Time after a preview that failed in which none begins.
const PREVIEW_PAUSE: Duration = Duration::from_secs(5);

impl Coordinator {
    /// On these nodes. The first of them should be this one: it starts the train.
    pub fn new(cast: Participants) -> Self {
        Self { cast, shared: Arc::default(), looking: Arc::default() }
    }

    /// The capture under way, or the last one.
    pub fn state(&self) -> Option<CaptureState> {
        self.shared().state.clone()
    }

    /// Begins a series; refused while one is under way. Its number.
    pub fn begin(&self, mut series: Series, operator: String) -> Result<u64, Fault> {
        series.check()?;
        series.wish.on_behalf_of = Some(operator.clone());
        let mut shared = self.shared();
        if shared.state.as_ref().is_some_and(|state| state.running) {
            return Err(Fault::new(Exit::Usage, "a capture is under way; stop it, or wait for its end"));
        }
        let number = shared.state.as_ref().map_or(0, |state| state.number) + 1;
        let control = Arc::new(Control::default());
        shared.control = Arc::clone(&control);
        shared.state = Some(CaptureState {
            number,
            series: series.clone(),
            operator,
            take: 1,
            stage: Some(Stage::Preparing),
            running: true,
            takes: Vec::new(),
            fault: None,
            stopped: None,
            asked_to_end: false,
        });
        let this = self.clone();
        let run = move || this.run(&series, &control);
        if let Err(error) = std::thread::Builder::new().name("capture".to_owned()).spawn(run) {
            shared.state = None;
            return Err(Fault::new(Exit::Failure, format!("cannot start a thread: {error}")));
        }
        Ok(number)
    }

    /// Somebody looks at the pictures: cameras run on all nodes that are idle, without recording, until two seconds after
    /// the last call. `true`: a preview begins with this call.
    pub fn preview(&self, operator: String) -> Result<bool, Fault> {
        self.looking.note();
        let mut shared = self.shared();
        let captures = shared.state.as_ref().is_some_and(|state| state.running);
        let waits = shared.preview.failed.is_some_and(|failed| failed.elapsed() < PREVIEW_PAUSE);
        if captures || shared.preview.runs || waits {
            return Ok(false);
        }
        let this = self.clone();
        let run = move || this.run_preview(operator);
        std::thread::Builder::new()
            .name("pictures".to_owned())
            .spawn(run)
            .map_err(|error| Fault::new(Exit::Failure, format!("cannot start a thread: {error}")))?;
        shared.preview.runs = true;
        Ok(true)
    }

    fn run_preview(&self, operator: String) {
        let nodes = (self.cast)();
        // One of another node's pages shows the same pictures.
        let all_idle = nodes.iter().all(|node| node.status().is_ok_and(|status| status.phase == Phase::Idle));
        let wish = CaptureRequest {
            name: Some("preview".to_owned()),
            dry_run: true,
            preview: true,
            on_behalf_of: Some(operator),
            ..CaptureRequest::default()
        };
        let control = Control::default();
        let ended = all_idle.then(|| {
            capture(&nodes, &wish, &control, |_| {
                if !self.looking.is_fresh() {
                    control.stop();
                }
            })
        });
        let mut shared = self.shared();
        shared.preview.runs = false;
        shared.preview.failed = match ended {
            Some(Err(fault)) if !control.end_was_requested() => {
                tracing::info!("the preview ended: {}", fault.message);
                Some(Instant::now())
            }
            _ => None,
        };
    }

    /// Ends the capture after the current trigger.
    pub fn stop(&self) -> Result<(), Fault> {
        self.running_control().map(|control| control.stop())
    }

    /// Keeps what is held, and records.
    pub fn record(&self) -> Result<(), Fault> {
        let nothing = || Fault::new(Exit::Usage, "nothing is held for Record at this node");
        self.running_control()?.record().then_some(()).ok_or_else(nothing)
    }

    /// Gives the capture up on all nodes.
    pub fn abort(&self, reason: &str) -> Result<(), Fault> {
        self.running_control().map(|control| control.abort(reason))
    }

    fn running_control(&self) -> Result<Arc<Control>, Fault> {
        let shared = self.shared();
        match &shared.state {
            Some(state) if state.running => Ok(Arc::clone(&shared.control)),
            _ => Err(Fault::new(Exit::Usage, "no capture of this node is under way")),
        }
    }

    fn run(&self, series: &Series, control: &Control) {
        let nodes = (self.cast)();
        let progress = |take: u32, stage: &Stage| {
            self.change(|state| {
                state.take = take;
                state.stage = Some(stage.clone());
            });
        };
        let taken = |captured: &Captured| {
            let told = captured.to_json();
            self.change(|state| {
                state.stage = None;
                state.takes.push(told);
            });
        };
        let ended = series::run(&nodes, series, control, progress, taken);
        self.change(|state| {
            state.stage = None;
            state.running = false;
            state.asked_to_end = control.end_was_requested();
            match ended {
                Ok(ended) => state.stopped = ended.stopped,
                Err((_, fault)) => state.fault = Some(fault),
            }
        });
    }

    fn change(&self, change: impl FnOnce(&mut CaptureState)) {
        if let Some(state) = &mut self.shared().state {
            change(state);
        }
    }

    fn shared(&self) -> MutexGuard<'_, Shared> {
        // Fields are assigned whole: what a panic left is usable.
        self.shared.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::Coordinator;
    use crate::capture::request::CaptureRequest;
    use crate::capture::series::Series;
    use std::sync::Arc;
    use std::time::{Duration, Instant};

    #[test]
    fn a_capture_without_nodes_fails_and_leaves_the_coordinator_free() {
        let coordinator = Coordinator::new(Arc::new(Vec::new));
        assert!(coordinator.state().is_none());
        assert!(coordinator.stop().is_err());
        for number in 1..3 {
            let wish = CaptureRequest { triggers: Some(3), ..CaptureRequest::default() };
            let begun = coordinator.begin(Series::single(wish), "test".to_owned());
            assert_eq!(begun.expect("free"), number);
            let deadline = Instant::now() + Duration::from_secs(30);
            while coordinator.state().expect("begun").running {
                assert!(Instant::now() < deadline);
                std::thread::sleep(Duration::from_millis(5));
            }
            assert!(coordinator.state().expect("ended").fault.is_some());
        }
    }
}
