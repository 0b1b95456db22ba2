// SPDX-License-Identifier: MIT OR Apache-2.0
//! The beginning of a session: frames that come before anything is triggered, and whether the warm-up was heard.

use super::Accounting;
use crate::acquire::receiver::Arrival;
use crate::acquire::recorder::RecorderEvent;
use std::time::Duration;

/// By this number of periods behind trigger 0, and this time, every camera's place in the train is known: a host may stand
/// still for 300 ms.
const PATIENCE: (u32, Duration) = (12, Duration::from_millis(400));
/// This number of frames without a report of any trigger is no chance.
const UNREPORTED: u64 = 3;

/// What is known of it.
#[derive(Debug, Default)]
pub(super) struct Beginning {
    /// Nothing was triggered before this, host clock, ns; 0: that is not known.
    silent_until: u64,
    /// Reports of triggers of the warm-up.
    pub(super) reports: u64,
    /// Frames that came before any trigger was reported.
    pub(super) early: u64,
    /// Since when the warm-up is over, at this point of [`Accounting::awake`].
    over: Option<Duration>,
    /// Cameras whose place was not known then, and still is not.
    unknown: Option<Vec<bool>>,
}

impl Accounting {
    /// Until then nothing was triggered: what has arrived before is no trigger's, and ids count from behind it.
    pub(super) fn silent_until(&mut self, host_ns: u64) {
        (self.beginning.silent_until, self.beginning.early) = (host_ns, 0);
        for camera in 0..self.lanes.len() {
            let pending = std::mem::take(&mut self.lanes[camera].pending);
            let (early, rest) = pending.into_iter().partition(|one| self.is_stray(&one.arrival));
            self.lanes[camera].pending = rest;
            let early: std::collections::VecDeque<super::Pending> = early;
            early.iter().for_each(|one| self.stray(&one.arrival));
        }
    }

    pub(super) fn is_stray(&self, arrival: &Arrival) -> bool {
        arrival.host_ns < self.beginning.silent_until
    }

    /// What a camera has left over from before goes out when its acquisition starts.
    pub(super) fn stray(&mut self, arrival: &Arrival) {
        let text = format!(
            "block {} came at the start of the acquisition, when nothing had been triggered: a stray frame; not recorded",
            arrival.block_id
        );
        self.note(arrival.camera, "stray_frame", None, text);
    }

    /// Names the cameras whose place in the train is not known when the warm-up is over, and each when it is.
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
        let heard = self.progress.received.get(camera);
        let frames = heard.map_or(0, |heard| heard.load(std::sync::atomic::Ordering::Relaxed));
        let reports = self.beginning.reports;
        if self.table.is_empty() {
            return "frames come, and the HSU has reported no trigger: check the serial link to the HSU, and what else drives the \
                    trigger line"
                .to_owned();
        }
        let remedy = match (frames, reports) {
            (0, _) => "no frame has come from it; check its trigger line, and raise warm_up_triggers in the rig file if it \
                       needs longer to wake up"
                .to_owned(),
            (_, 0) => "no report of the warm-up has come; check the serial link to the HSU".to_owned(),
            _ => format!(
                "{reports} reports of the warm-up were heard, and {frames} frames so far; check the link to the HSU, or \
                 raise warm_up_triggers in the rig file"
            ),
        };
        format!(
            "the warm-up is over, and which triggers its frames are of is not known: {remedy}; they are given up until it is"
        )
    }
}
