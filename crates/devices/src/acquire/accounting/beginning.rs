// SPDX-License-Identifier: MIT OR Apache-2.0
//! The beginning of a session: frames that come before anything is triggered, and cameras whose place in the train is
//! not known after the warm-up.

use super::Accounting;
use crate::acquire::commands::RecorderEvent;
use crate::acquire::receiver::Arrival;
use std::collections::VecDeque;
use std::sync::atomic::Ordering;
use std::time::Duration;

/// Time after trigger 0 by which every camera's place in the train must be known, in periods and at least: a host may
/// stand still for 300 ms.
const PATIENCE: (u32, Duration) = (12, Duration::from_millis(400));
/// Frames without a report of any trigger that show a missing link to the HSU; fewer may be chance.
const UNREPORTED: u64 = 3;

/// What is known of the beginning.
#[derive(Debug, Default)]
pub(super) struct Beginning {
    /// Time before which nothing was triggered, host clock, ns; 0: not known.
    silent_until: u64,
    /// Number of reports of warm-up triggers.
    pub(super) reports: u64,
    /// Number of frames that came before any trigger was reported.
    pub(super) early: u64,
    /// When the warm-up ended, by [`Accounting::awake`].
    over: Option<Duration>,
    /// Per camera, whether its place was not known then and still is not.
    unknown: Option<Vec<bool>>,
}

impl Beginning {
    /// Whether a frame arrived before anything was triggered.
    pub(super) fn is_stray(&self, arrival: &Arrival) -> bool {
        arrival.host_ns < self.silent_until
    }
}

impl Accounting {
    /// Nothing was triggered before this time: earlier frames belong to no trigger, and block ids count from behind
    /// them.
    pub(super) fn silent_until(&mut self, host_ns: u64) {
        (self.beginning.silent_until, self.beginning.early) = (host_ns, 0);
        for camera in 0..self.lanes.len() {
            let pending = std::mem::take(&mut self.lanes[camera].pending);
            let (early, rest) = pending.into_iter().partition(|one| self.beginning.is_stray(&one.arrival));
            self.lanes[camera].pending = rest;
            let early: VecDeque<super::Pending> = early;
            early.iter().for_each(|one| self.stray(&one.arrival));
        }
    }

    /// Reports a frame that a camera had left over, and sent when its acquisition started.
    pub(super) fn stray(&mut self, arrival: &Arrival) {
        let text = format!(
            "block {} came at the start of the acquisition, when nothing had been triggered: a stray frame; not \
             recorded",
            arrival.block_id
        );
        self.note(arrival.camera, "stray_frame", None, text);
    }

    /// Reports the cameras whose place in the train is not known when the warm-up is over, and each one later when it
    /// is.
    pub(super) fn look_at_places(&mut self) {
        if self.draining {
            return;
        }
        if self.beginning.unknown.is_some() {
            return self.look_for_places();
        }
        let begun = self.table.end() > 0
            || (self.beginning.silent_until > 0
                && self.table.is_empty()
                && self.beginning.early >= UNREPORTED);
        if !begun {
            return;
        }
        let (periods, floor) = PATIENCE;
        let patience = Duration::from_nanos(self.options.period_ns.saturating_mul(periods.into())).max(floor);
        let over = *self.beginning.over.get_or_insert(self.awake);
        if self.awake - over < patience {
            return;
        }
        let unknown: Vec<bool> =
            self.lanes.iter().map(|lane| !lane.lost && !lane.matcher.is_placed()).collect();
        for camera in (0..unknown.len()).filter(|i| unknown[*i]) {
            let why = self.why_unknown(camera);
            self.note(camera, "place_unknown", self.table.len().checked_sub(1), why.clone());
            drop(self.events.send(RecorderEvent::Place { camera, unknown: Some(why) }));
        }
        self.beginning.unknown = Some(unknown);
    }

    fn look_for_places(&mut self) {
        let Some(unknown) = &mut self.beginning.unknown else { return };
        for (camera, unknown) in unknown.iter_mut().enumerate().filter(|(_, unknown)| **unknown) {
            if self.lanes[camera].matcher.is_placed() {
                *unknown = false;
                drop(self.events.send(RecorderEvent::Place { camera, unknown: None }));
            }
        }
    }

    fn why_unknown(&self, camera: usize) -> String {
        let frames = self.progress.received.get(camera).map_or(0, |count| count.load(Ordering::Relaxed));
        let reports = self.beginning.reports;
        if self.table.is_empty() {
            return "frames come, but the HSU has reported no trigger: check the serial link to the HSU, and what \
                    else drives the trigger line"
                .to_owned();
        }
        let remedy = match (frames, reports) {
            (0, _) => {
                "no frame has come from it; check its trigger line, and raise warm_up_triggers in the rig file if \
                 it needs longer to wake up"
                    .to_owned()
            }
            (_, 0) => "no report of the warm-up has come; check the serial link to the HSU".to_owned(),
            _ => format!(
                "{reports} reports of the warm-up and {frames} frames have come so far; check the link to the HSU, or \
                 raise warm_up_triggers in the rig file"
            ),
        };
        format!(
            "the warm-up is over, and which triggers its frames are of is not known: {remedy}; they are given up \
             until it is"
        )
    }
}
