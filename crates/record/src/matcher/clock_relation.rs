// SPDX-License-Identifier: MIT OR Apache-2.0
//! What frames themselves teach of the way from trigger to timestamp and to arrival.

/// Share of a residual by which the offset is corrected; that of the first frames is larger.
const OFFSET_SHARE: f64 = 1.0 / 16.0;
/// Share of a residual, per time since the last frame, by which the drift is corrected: slow enough for 200 us of
/// noise.
const DRIFT_SHARE: f64 = 1.0 / 1024.0;
/// Largest drift between two clocks that is followed, as a share of the rate.
const DRIFT_LIMIT: f64 = 600e-6;

/// A camera's clock against the HSU's, from frames whose trigger is known: a second-order tracking loop.
#[derive(Debug, Clone, Copy)]
pub(super) struct Tracker {
    hsu_ns: i128,
    camera_ns: i128,
    /// Rate of the camera's clock against the HSU's, minus one.
    drift: f64,
    /// Mean size of the residuals, ns.
    pub(super) spread_ns: f64,
    frames: u32,
}

impl Tracker {
    /// A relation that passes through one frame, without drift.
    pub(super) fn new(hsu_ns: u64, camera_ns: u64) -> Self {
        Self { hsu_ns: hsu_ns.into(), camera_ns: camera_ns.into(), drift: 0.0, spread_ns: 0.0, frames: 1 }
    }

    /// Follows a frame of the trigger at `hsu_ns`, or begins with it.
    pub(super) fn learn(tracker: &mut Option<Self>, hsu_ns: u64, camera_ns: u64) {
        match tracker {
            Some(tracker) => tracker.follow(hsu_ns, camera_ns),
            None => *tracker = Some(Self::new(hsu_ns, camera_ns)),
        }
    }

    /// HSU time of a timestamp.
    pub(super) fn hsu_ns(&self, camera_ns: u64) -> i128 {
        let since = i128::from(camera_ns) - self.camera_ns;
        self.hsu_ns + since - (since as f64 * self.drift / (1.0 + self.drift)).round() as i128
    }

    /// Whether enough frames agreed for its residuals to mean something.
    pub(super) fn is_settled(&self) -> bool {
        self.frames >= 4
    }

    /// Follows a frame of the trigger at `hsu_ns`.
    pub(super) fn follow(&mut self, hsu_ns: u64, camera_ns: u64) {
        let since = i128::from(hsu_ns) - self.hsu_ns;
        let expected = self.camera_ns + since + (since as f64 * self.drift).round() as i128;
        let residual = (i128::from(camera_ns) - expected) as f64;
        self.frames = self.frames.saturating_add(1);
        let share = OFFSET_SHARE.max(1.0 / f64::from(self.frames));
        self.hsu_ns = hsu_ns.into();
        self.camera_ns = expected + (residual * share).round() as i128;
        if since > 0 {
            let drift = self.drift + residual * DRIFT_SHARE / since as f64;
            self.drift = drift.clamp(-DRIFT_LIMIT, DRIFT_LIMIT);
        }
        self.spread_ns += (residual.abs() - self.spread_ns) * OFFSET_SHARE;
    }
}

/// From trigger to arrival on the host, in HSU time: a witness that errs only towards late.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Latency {
    /// The last ones, ns, the newest at `frames - 1` modulo their number.
    last: [i64; Self::KEPT],
    frames: usize,
    /// Frames in a row that came two periods later than the quickest.
    late: usize,
}

/// Whether the last frames came as soon behind a trigger, of whichever, as the quickest do: where a host takes frames
/// up at any time, half of them do.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct OnTime {
    /// A bit for each of the last frames, the newest lowest: set where it was late.
    late: u8,
}

impl OnTime {
    pub(super) fn add(&mut self, on_time: bool) {
        self.late = self.late << 1 | u8::from(!on_time);
    }

    /// Whether the last frame was on time, and of those before all but at most one.
    pub(super) fn is_calm(self) -> bool {
        self.late & 1 == 0 && self.late.count_ones() <= 1
    }
}

/// How soon after its trigger a frame arrives at the earliest, and how regularly frames do.
#[derive(Debug, Clone, Copy)]
pub(super) struct Envelope {
    /// Shortest time from trigger to arrival that several frames had, ns.
    pub(super) least_ns: i128,
    /// The share of frames that come within a quarter of a period of it.
    pub(super) quick: f64,
    /// Whether arrivals distinguish one trigger from the next: enough frames come within three quarters of a period of
    /// it.
    pub(super) distinguishes: bool,
}

/// The share of frames that are alike where arrivals are regular.
const REGULAR: f64 = 0.875;

impl Latency {
    const KEPT: usize = 32;
    /// Frames from which on the latency is used.
    const ENOUGH: usize = 5;

    /// Learns from a frame whose trigger two witnesses agree on. A frame that waited in a queue is not used, unless all
    /// wait.
    pub(super) fn follow(&mut self, latency_ns: i128, period_ns: u64) {
        let envelope = self.envelope(period_ns);
        let queued = envelope.is_some_and(|known| latency_ns > known.least_ns + 2 * i128::from(period_ns));
        self.late = if queued { self.late + 1 } else { 0 };
        if queued && self.late <= 2 * Self::KEPT {
            return;
        }
        self.last[self.frames % Self::KEPT] = i64::try_from(latency_ns).unwrap_or(i64::MAX);
        self.frames += 1;
    }

    /// `None` where too little is known.
    pub(super) fn envelope(&self, period_ns: u64) -> Option<Envelope> {
        let mut known = self.last;
        let known = &mut known[..self.frames.min(Self::KEPT)];
        known.sort_unstable();
        let alike = if known.len() < Self::KEPT / 2 { 1 } else { 2 };
        let reach = (period_ns / 4) as i64;
        let quickest =
            known.windows(alike).find(|alike| alike[alike.len() - 1].saturating_sub(alike[0]) <= reach)?;
        let least = quickest[0];
        // Aravis takes packets off its socket every 5 ms where few come.
        let within = |part: u64| {
            let end = least.saturating_add((period_ns / 4 * part) as i64);
            known.iter().filter(|ns| (least..=end).contains(*ns)).count() as f64 / known.len() as f64
        };
        let quick = within(1);
        (known.len() >= Self::ENOUGH).then(|| Envelope {
            least_ns: least.into(),
            quick,
            distinguishes: quick >= REGULAR
                || (known.len() >= 8 && (within(3) >= REGULAR || within(2) >= 0.625)),
        })
    }
}
