// SPDX-License-Identifier: MIT OR Apache-2.0
//! A camera's clock, read when its frames are in doubt: the witness that knows what was done to it.
//!
//! Ids and timestamps show that something changed, not what. Arrivals distinguish triggers only where the host takes
//! packets up at once, and Aravis does so every 5 ms where few come. A reading that is requested after a frame has come
//! shows whether the camera's clock runs as before: then its timestamp is right; if not, the reading shows how it runs
//! now.

use super::sighting::Sighting;
use crate::base::clock_fit::{ClockFit, Exchange, Judged};

/// No frame that is placed by readings arrives later after its trigger, periods.
pub(super) const LATE_PERIODS: u64 = 8;
/// Time after a frame's arrival during which its camera's clock is read for it, ns.
const PATIENCE_NS: u64 = 50_000_000;
/// Time within which a reading that a frame requested has been made, ns.
const PROMPT_NS: u64 = 25_000_000;
/// Periods that a frame waits for the frames before it.
const PROMPT_PERIODS: u64 = 4;
/// Frames that the way to the timestamp is measured by.
const MEASURED: usize = 4;

/// A camera's clock against the host's, and what is known of it.
#[derive(Debug)]
pub(super) struct CameraClock {
    pub(super) fit: ClockFit,
    period_ns: u64,
    /// From a trigger to its frame's timestamp, ns, by the fit: measured once.
    pub(super) stamp_delay_ns: Option<i128>,
    /// Frames to measure it by, once the clock has been read behind them: their triggers' times and themselves.
    to_measure: Vec<(u64, Sighting)>,
    /// When the last exchange that agrees with the fit was requested, host clock, ns.
    read_ns: Option<u64>,
    /// From when on the fit holds, host clock, ns.
    holds_from_ns: u64,
    /// When the clock was set last, host clock, ns.
    set_ns: u64,
    /// Whether it can be read, as far as is known.
    answers: bool,
    /// Whether it should be read now.
    wanted: bool,
}

impl CameraClock {
    /// A clock of which there is no reading yet.
    pub(super) fn new(period_ns: u64) -> Self {
        Self {
            fit: ClockFit::new(),
            period_ns,
            stamp_delay_ns: None,
            to_measure: Vec::new(),
            read_ns: None,
            holds_from_ns: 0,
            set_ns: 0,
            answers: false,
            wanted: false,
        }
    }

    /// Takes a reading of the clock into account.
    pub(super) fn exchange(&mut self, exchange: &Exchange) -> Judged {
        let ready = self.fit.is_ready();
        let judged = self.fit.exchange(exchange);
        self.answers = true;
        match judged {
            Judged::LeftOut => return judged,
            Judged::Reset { step_ns } => {
                self.to_measure.clear();
                self.set_ns = exchange.host_receive_ns;
                // Set by much, a stamp from before cannot be taken for one from behind. Of frames from long before the
                // reading that is not enough: the clock may have been set twice since.
                let far = step_ns.unsigned_abs() > u128::from((LATE_PERIODS + 1) * self.period_ns);
                let before =
                    if far { (LATE_PERIODS + PROMPT_PERIODS) * self.period_ns + PROMPT_NS } else { 0 };
                self.holds_from_ns = exchange.host_receive_ns.saturating_sub(before);
            }
            // Nothing to hold it against yet.
            Judged::Used if !ready => return judged,
            Judged::Used => {}
        }
        self.read_ns = Some(exchange.host_send_ns);
        judged
    }

    /// The camera is back, and its clock may be another. How long it takes to stamp a frame stays.
    pub(super) fn restart(&mut self) {
        *self =
            Self { stamp_delay_ns: self.stamp_delay_ns, answers: self.answers, ..Self::new(self.period_ns) };
    }

    /// Frames show that it was set: what was read before holds no longer.
    pub(super) fn was_set(&mut self) {
        self.read_ns = None;
        self.to_measure.clear();
    }

    /// Requests a reading, if the clock answers.
    pub(super) fn ask(&mut self) {
        self.wanted = self.answers;
    }

    /// Whether a reading was requested since the last call.
    pub(super) fn takes_wish(&mut self) -> bool {
        std::mem::take(&mut self.wanted)
    }

    /// Whether readings distinguish triggers: the clock answers, and the delay to the timestamp is measured.
    pub(super) fn distinguishes(&self) -> bool {
        self.answers && self.stamp_delay_ns.is_some()
    }

    /// A frame of the trigger at `due`, HSU time, to measure the way to its timestamp by.
    pub(super) fn learn(&mut self, due: u64, frame: &Sighting) {
        // One that was sent before the clock was set may arrive later.
        let since = self.set_ns.saturating_add(LATE_PERIODS * self.period_ns);
        let wanted = self.stamp_delay_ns.is_none() && self.answers && frame.host_ns > since;
        if wanted && self.to_measure.len() < MEASURED {
            self.to_measure.push((due, *frame));
            self.wanted |= self.to_measure.len() == MEASURED;
        }
    }

    /// Measures the way from trigger to timestamp: by frames on both sides of which the clock was read, and ran on.
    pub(super) fn measure(&mut self, hsu: &ClockFit) {
        let read = |frame: &Sighting| self.read_ns.is_some_and(|requested| requested > frame.host_ns);
        if self.to_measure.len() < MEASURED || !self.to_measure.iter().all(|(_, frame)| read(frame)) {
            return;
        }
        let delay =
            |(due, frame): &(u64, Sighting)| Some(self.stamped_ns(frame.camera_ns?, hsu)? - i128::from(*due));
        let mut delays: Vec<i128> = self.to_measure.iter().filter_map(delay).collect();
        delays.sort_unstable();
        self.stamp_delay_ns = delays.get(delays.len() / 2).copied();
        self.to_measure.clear();
    }

    /// HSU time of a timestamp, where the readings of both clocks are sure enough.
    fn stamped_ns(&self, camera_ns: u64, hsu: &ClockFit) -> Option<i128> {
        let host_ns = self.fit.host_from_device(camera_ns.into())?;
        let hsu_ns = hsu.device_from_host(host_ns)?;
        let unsure = self.fit.uncertainty_ns(camera_ns.into())?.saturating_add(hsu.uncertainty_ns(hsu_ns)?);
        (unsure < self.period_ns / 4).then_some(hsu_ns)
    }

    /// When a frame's trigger was fired by the fit as it is, HSU time.
    pub(super) fn fired_ns(&self, frame: &Sighting, hsu: &ClockFit) -> Option<i128> {
        Some(self.stamped_ns(frame.camera_ns?, hsu)? - self.stamp_delay_ns?)
    }

    /// The same by readings that were requested after the frame had come: they include whatever was done to the clock
    /// before.
    pub(super) fn read_fired_ns(&self, frame: &Sighting, hsu: &ClockFit) -> Option<i128> {
        let read = self.read_ns.is_some_and(|requested| requested > frame.host_ns);
        if read && self.holds(frame) { self.fired_ns(frame, hsu) } else { None }
    }

    /// Whether the clock ran since before this frame as it does now, or was set by so much that the stamp would show
    /// it.
    fn holds(&self, frame: &Sighting) -> bool {
        self.holds_from_ns.saturating_add(LATE_PERIODS * self.period_ns) <= frame.host_ns
    }

    /// Whether a reading for this frame is still to come; if so it is requested.
    pub(super) fn awaits(&mut self, frame: &Sighting, hsu: &ClockFit) -> bool {
        let after = |ns: u64| self.read_ns.is_some_and(|requested| requested > ns);
        // Again where the first readings took too long to distinguish triggers, but only for a while.
        let no_more = after(frame.host_ns.saturating_add(PATIENCE_NS)) || !self.holds(frame);
        let done = after(frame.host_ns) && (no_more || self.read_fired_ns(frame, hsu).is_some());
        let awaited = self.distinguishes() && frame.camera_ns.is_some() && !done;
        self.wanted |= awaited;
        awaited
    }
}
