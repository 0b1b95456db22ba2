//! What frames themselves teach of the way from trigger to timestamp and to arrival.

/// Share of a residual that the offset takes; the first frames' share is larger.
const OFFSET_SHARE: f64 = 1.0 / 16.0;
/// Share of a residual, by the time it took to arise, that the drift takes: slow enough for 200 us of noise.
const DRIFT_SHARE: f64 = 1.0 / 1024.0;
/// No pair of clocks drifts by more.
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
    /// Anchored at one frame.
    pub(super) fn new(hsu_ns: u64, camera_ns: u64) -> Self {
        Self { hsu_ns: hsu_ns.into(), camera_ns: camera_ns.into(), drift: 0.0, spread_ns: 0.0, frames: 1 }
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

    /// HSU time of the last frame.
    pub(super) fn last_hsu_ns(&self) -> i128 {
        self.hsu_ns
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

/// Two clocks' relation from arrivals alone: believed when frames in a row agree. Of a burst that was held up together
/// no two do, for their exposures were a period apart.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Anchor {
    hsu_minus_camera_ns: i128,
    agreeing: u32,
}

impl Anchor {
    /// Frames in a row that must agree.
    const AGREEING: u32 = 8;

    /// A frame whose trigger was fired at about `hsu_ns` by its arrival. The relation once it is believed.
    pub(super) fn sighted(&mut self, hsu_ns: i128, camera_ns: u64, slack_ns: i128) -> Option<i128> {
        let offset = hsu_ns - i128::from(camera_ns);
        let agrees = self.agreeing > 0 && (offset - self.hsu_minus_camera_ns).abs() <= slack_ns;
        // Arrivals err towards late only: the earliest is nearest.
        self.hsu_minus_camera_ns = if agrees { offset.min(self.hsu_minus_camera_ns) } else { offset };
        self.agreeing = if agrees { self.agreeing + 1 } else { 1 };
        (self.agreeing >= Self::AGREEING).then_some(self.hsu_minus_camera_ns)
    }
}

/// From trigger to arrival on the host, in HSU time: a witness that errs only towards late.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Latency {
    mean_ns: f64,
    spread_ns: f64,
    frames: u32,
}

impl Latency {
    /// Learns from a frame whose trigger two witnesses agree on.
    pub(super) fn follow(&mut self, latency_ns: i128) {
        let latency = latency_ns as f64;
        self.frames = self.frames.saturating_add(1);
        // A straggler must not pull the mean along: what exceeds a few spreads counts as that much.
        let limit = if self.frames > 16 { self.spread_ns * 4.0 + 1e5 } else { f64::INFINITY };
        let residual = (latency - self.mean_ns).clamp(-limit, limit);
        let share = (1.0f64 / 32.0).max(1.0 / f64::from(self.frames));
        self.mean_ns += residual * share;
        self.spread_ns += (residual.abs() - self.spread_ns) * share;
    }

    /// The usual latency, where arrivals are regular enough to tell triggers a period apart.
    pub(super) fn usual_ns(&self, period_ns: u64) -> Option<i128> {
        let regular = self.frames >= 16 && self.spread_ns * 8.0 < period_ns as f64;
        regular.then_some(self.mean_ns as i128)
    }
}
