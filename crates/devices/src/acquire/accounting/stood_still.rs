// SPDX-License-Identifier: MIT OR Apache-2.0
//! Pauses of the process or of a thread of the pixel path: what was lost is given up by whole frame sets, and the
//! recorded cause is the host, not the disk.

use super::{Accounting, LONGEST_TURN};
use crate::acquire::pause::Pauses;
use crate::base::time::host_time_ns;
use crate::host::run_delay;
use crate::record::TriggerRecord;
use std::time::{Duration, Instant};

/// Pauses that follow each other within this time are recorded once.
const RECORD_AGAIN: Duration = Duration::from_secs(1);
/// Time between two checks whether threads get a processor; rare, because a check takes a lock.
const LOOK: Duration = Duration::from_millis(200);

impl Accounting {
    /// Begins a turn of the thread, and detects pauses since the last one.
    pub(in crate::acquire) fn begin_turn(&mut self) {
        let now = Instant::now();
        let took = now.saturating_duration_since(self.last_turn);
        self.awake += took.min(LONGEST_TURN);
        self.last_turn = now;
        if took >= Pauses::SHORTEST {
            let why = format!(
                "this process did not run for {} ms (stopped, or without a processor)",
                took.as_millis()
            );
            return self.paused(took, &why, host_time_ns());
        }
        if self.awake < self.next_look {
            return;
        }
        self.next_look = self.awake + LOOK;
        if let Some(starved) = run_delay::starved() {
            self.paused(starved.window, &starved.to_string(), host_time_ns());
        }
    }

    /// Enters a pause of this length that ends now. Any camera may have lost frames of the triggers concerned, so
    /// sets of them that are not complete are given up.
    pub(in crate::acquire) fn paused(&mut self, took: Duration, why: &str, now_ns: u64) {
        if self.draining {
            return;
        }
        if self.table.end() <= 0 {
            let took_ns = u64::try_from(took.as_nanos()).unwrap_or(u64::MAX);
            self.pauses.add_early(now_ns.saturating_sub(took_ns), now_ns);
            return self.record_pause(None, format!("{why}, before any trigger was reported"));
        }
        let periods = (took.as_nanos() / u128::from(self.options.period_ns.max(1))) as u64;
        let here = || self.lanes.iter().filter(|lane| !lane.lost);
        let first = here().map(|lane| lane.next).min().unwrap_or(0).max(self.sets.passed());
        let reported = here().map(|lane| lane.next).max().unwrap_or(0).max(self.table.len());
        // Frames and reports may have been on their way already.
        let end = reported.saturating_add(periods).saturating_add(2);
        self.pauses.add(first..end);
        self.sets.wait_until(end);
        self.record_pause(Some((first, end - first)), why.to_owned());
    }

    /// Assigns the pauses before the first report to triggers, once a first trigger is reported.
    pub(super) fn first_report(&mut self, record: &TriggerRecord) {
        if !self.pauses.has_early() {
            return;
        }
        let period_ns = self.options.period_ns;
        let fired = i128::from(record.hsu_time_ns) - i128::from(record.index.0) * i128::from(period_ns);
        // Without the HSU's clock: a report arrives when its trigger is fired, or later.
        let at_report = || record.host_time_ns.saturating_sub(record.index.0.saturating_mul(period_ns));
        let first_ns =
            self.hsu.host_from_device(fired).and_then(|ns| u64::try_from(ns).ok()).unwrap_or_else(at_report);
        if let Some(concerned) = self.pauses.begin(first_ns, period_ns) {
            self.sets.wait_until(concerned);
            let why = "the pause before any trigger was reported lasted beyond trigger 0".to_owned();
            self.record_pause(Some((0, concerned)), why);
        }
    }

    fn record_pause(&mut self, concerned: Option<(u64, u64)>, why: String) {
        let message = match concerned {
            None => why,
            Some((_, sets)) => {
                format!("{why}: of {sets} frame sets from here on those that are not whole are given up")
            }
        };
        if self.recorded_pause.is_some_and(|at| self.awake < at + RECORD_AGAIN) {
            return;
        }
        self.recorded_pause = Some(self.awake);
        tracing::warn!(kind = "node_paused", "{message}");
        self.event("node_paused", None, concerned.map(|(first, _)| first), message);
    }
}
