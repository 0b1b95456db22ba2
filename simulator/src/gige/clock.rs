// SPDX-License-Identifier: MIT OR Apache-2.0
//! A camera's own clock: it starts somewhere, and it runs a little too fast or too slow, unless PTP sets it.

use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// The clock that PTP gives all cameras of this process: the time of day at its first use, and on from there.
fn common() -> (Instant, u64) {
    static COMMON: OnceLock<(Instant, u64)> = OnceLock::new();
    *COMMON.get_or_init(|| {
        let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        (Instant::now(), u64::try_from(since.as_nanos()).unwrap_or(0))
    })
}

/// Offset and drift of a camera's clock against the host's monotonic clock.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClockOptions {
    /// What the camera's clock shows when the camera starts, ns.
    pub offset_ns: u64,
    /// How much faster than the host's clock it runs, parts per million; negative is slower.
    pub drift_ppm: f64,
}

impl Default for ClockOptions {
    fn default() -> Self {
        Self { offset_ns: 1_000_000_000, drift_ppm: 0.0 }
    }
}

/// The clock itself: host instants to camera nanoseconds. Shared by a camera's threads.
#[derive(Debug)]
pub struct CameraClock {
    epoch: Instant,
    /// What it shows after power-on.
    first_ns: i64,
    offset_ns: AtomicI64,
    drift_ppb: i64,
    common: AtomicBool,
}

impl CameraClock {
    /// A clock that shows `options.offset_ns` at `epoch`.
    pub fn new(epoch: Instant, options: ClockOptions) -> Self {
        let offset_ns = i64::try_from(options.offset_ns).unwrap_or(i64::MAX);
        // `as` saturates, and turns NaN into no drift.
        let first_ns = offset_ns;
        Self {
            epoch,
            first_ns,
            offset_ns: offset_ns.into(),
            drift_ppb: (options.drift_ppm * 1000.0).round() as i64,
            common: AtomicBool::new(false),
        }
    }

    /// Camera time, ns, at a host instant. Instants before the camera's start may show as 0.
    pub fn at(&self, instant: Instant) -> u64 {
        if self.is_common() {
            let (epoch, first_ns) = common();
            let ns = |time: Duration| u64::try_from(time.as_nanos()).unwrap_or(u64::MAX);
            return match instant.checked_duration_since(epoch) {
                Some(after) => first_ns.saturating_add(ns(after)),
                None => first_ns.saturating_sub(ns(epoch.saturating_duration_since(instant))),
            };
        }
        let shown = self.running(instant) + i128::from(self.offset_ns.load(Ordering::Relaxed));
        u64::try_from(shown.max(0)).unwrap_or(u64::MAX)
    }

    /// PTP sets it from now on, or does not any more.
    pub fn set_common(&self, common: bool) {
        self.common.store(common, Ordering::Relaxed);
    }

    /// Whether the clock is set by PTP.
    pub fn is_common(&self) -> bool {
        self.common.load(Ordering::Relaxed)
    }

    /// When the clock that all cameras share shows this, ns; `None` where it is not set to that.
    pub fn instant(&self, ns: u64) -> Option<Instant> {
        let (epoch, first_ns) = common();
        let after = Duration::from_nanos(ns.saturating_sub(first_ns));
        let before = Duration::from_nanos(first_ns.saturating_sub(ns));
        self.is_common().then(|| epoch.checked_add(after)?.checked_sub(before)).flatten()
    }

    /// Sets the clock to zero at a host instant (timestamp control register, bit "reset").
    pub fn reset(&self, instant: Instant) {
        let offset = i64::try_from(-self.running(instant)).unwrap_or(i64::MIN);
        self.offset_ns.store(offset, Ordering::Relaxed);
    }

    /// Starts it anew, as power-on does.
    pub fn restart(&self, instant: Instant) {
        self.set_common(false);
        let offset = i128::from(self.first_ns) - self.running(instant);
        self.offset_ns.store(i64::try_from(offset).unwrap_or(i64::MIN), Ordering::Relaxed);
    }

    /// Nanoseconds since the epoch as this clock counts them, without its offset.
    fn running(&self, instant: Instant) -> i128 {
        let host_ns = match instant.checked_duration_since(self.epoch) {
            Some(after) => after.as_nanos() as i128,
            None => -(self.epoch.saturating_duration_since(instant).as_nanos() as i128),
        };
        host_ns + (host_ns * i128::from(self.drift_ppb)).div_euclid(1_000_000_000)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn offset_and_drift_show() {
        let epoch = Instant::now();
        let clock = CameraClock::new(epoch, ClockOptions { offset_ns: 500, drift_ppm: -20.0 });
        assert_eq!(clock.at(epoch), 500);
        assert_eq!(clock.at(epoch + Duration::from_secs(1)), 1_000_000_500 - 20_000);
        clock.reset(epoch + Duration::from_secs(1));
        assert_eq!(clock.at(epoch + Duration::from_secs(1)), 0);
    }

    #[test]
    fn clocks_that_ptp_sets_show_the_same_and_keep_their_own_time_apart_from_it() {
        let epoch = Instant::now();
        let clock = |offset_ns, drift_ppm| CameraClock::new(epoch, ClockOptions { offset_ns, drift_ppm });
        let (a, b) = (clock(500, -20.0), clock(7_000_000_000, 35.0));
        assert_eq!(a.instant(5), None, "nobody's clock but its own");
        a.set_common(true);
        b.set_common(true);
        let later = epoch + Duration::from_secs(3);
        assert_eq!(a.at(later), b.at(later));
        assert_eq!(a.instant(a.at(later)), Some(later));
        a.set_common(false);
        assert_eq!(a.at(epoch), 500);
    }

    proptest! {
        #[test]
        fn the_clock_never_runs_backwards(
            a in 0u64..1 << 50, step in 0u64..1 << 40, drift_ppm in -500.0..500.0f64, offset_ns: u32,
        ) {
            let epoch = Instant::now();
            let clock = CameraClock::new(epoch, ClockOptions { offset_ns: offset_ns.into(), drift_ppm });
            let (first, second) = (Duration::from_nanos(a), Duration::from_nanos(a + step));
            let elapsed = clock.at(epoch + second) as i128 - clock.at(epoch + first) as i128;
            let expected = step as f64 * (1.0 + drift_ppm * 1e-6);
            prop_assert!((elapsed as f64 - expected).abs() <= 2.0 + step as f64 * 1e-9, "{elapsed} {expected}");
        }
    }
}
