// SPDX-License-Identifier: MIT OR Apache-2.0
//! A capture as its operator sees it: the request, the buttons while it runs, and its stages.

use crate::control::request::StartOn;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};

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
    /// A dry run for those who look at the pictures, which gives way to everything else; never taken from a request.
    #[serde(skip)]
    pub preview: bool,
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

    /// A take begins: nothing is held, and Record was not pressed.
    pub(super) fn begin(&self) {
        self.record.store(false, Ordering::Release);
        self.holds(false);
    }

    /// Whether a stop was requested since the last call.
    pub(super) fn take_stop(&self) -> bool {
        self.stop.swap(false, Ordering::AcqRel)
    }

    pub(super) fn take_abort(&self) -> Option<String> {
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
