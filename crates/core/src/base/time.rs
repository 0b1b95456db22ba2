// SPDX-License-Identifier: MIT OR Apache-2.0
//! The host's two clocks, in nanoseconds: the time of day for recordings, a monotonic one for measuring.

use std::sync::OnceLock;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// CLOCK_REALTIME since 1970, ns: what recordings call host time. It may jump, so that no decision of the program
/// rests on it.
pub fn host_time_ns() -> u64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_nanos()).unwrap_or(u64::MAX)
}

/// The day of a host time, UTC: years, months and days of the Gregorian calendar, counted from a first of March.
pub fn day(ns: u64) -> String {
    let days = ns / 86_400_000_000_000 + 719_468;
    let (era, of_era) = (days / 146_097, days % 146_097);
    let year_of_era = (of_era - of_era / 1460 + of_era / 36_524 - of_era / 146_096) / 365;
    let of_year = of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let month = (5 * of_year + 2) / 153;
    let (day, month) = (of_year - (153 * month + 2) / 5 + 1, if month < 10 { month + 3 } else { month - 9 });
    format!("{}-{month:02}-{day:02}", era * 400 + year_of_era + u64::from(month <= 2))
}

/// The host's clock of one session: CLOCK_REALTIME read once, CLOCK_MONOTONIC since. A step of the wall clock
/// during the session does not reach it.
#[derive(Debug, Clone, Copy)]
pub struct HostClock {
    realtime_minus_monotonic_ns: i128,
}

impl HostClock {
    /// Reads the time of day, once.
    pub fn start() -> Self {
        let now = i128::from(monotonic_ns(Instant::now()));
        Self { realtime_minus_monotonic_ns: i128::from(host_time_ns()) - now }
    }

    /// The host time of an instant, ns.
    pub fn at(&self, instant: Instant) -> u64 {
        self.from_monotonic(monotonic_ns(instant))
    }

    /// The host time now, ns.
    pub fn now(&self) -> u64 {
        self.at(Instant::now())
    }

    /// The host time of a reading of [`monotonic_ns`], ns.
    pub fn from_monotonic(&self, ns: u64) -> u64 {
        u64::try_from(i128::from(ns) + self.realtime_minus_monotonic_ns).unwrap_or(0)
    }

    /// The host time of a reading of CLOCK_REALTIME that was made a moment ago, ns: only its age counts.
    ///
    /// A thread that is suspended in between makes it later, never earlier: an arrival errs towards late only.
    pub fn from_recent_realtime(&self, ns: u64) -> u64 {
        let age_ns = host_time_ns().saturating_sub(ns);
        self.now().saturating_sub(age_ns)
    }
}

/// Processor time of the whole process so far, user and system, of all threads.
pub fn process_cpu_time() -> Duration {
    let mut time = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: `time` is a valid place for a timespec; the clock exists since Linux 2.6.12.
    unsafe { libc::clock_gettime(libc::CLOCK_PROCESS_CPUTIME_ID, &raw mut time) };
    Duration::new(time.tv_sec.unsigned_abs(), u32::try_from(time.tv_nsec).unwrap_or(0))
}

/// An instant on CLOCK_MONOTONIC since an arbitrary origin that is the same for the whole process, ns.
pub fn monotonic_ns(instant: Instant) -> u64 {
    static ORIGIN: OnceLock<Instant> = OnceLock::new();
    // Instants from before the first call must not be cut off at zero.
    let origin = *ORIGIN.get_or_init(|| instant.checked_sub(Duration::from_secs(3600)).unwrap_or(instant));
    u64::try_from(instant.saturating_duration_since(origin).as_nanos()).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests {
    use super::day;

    #[test]
    fn days_are_those_of_the_calendar() {
        let of = |s: u64| day(s * 1_000_000_000);
        assert_eq!([of(0), of(951_782_400), of(1_735_689_599)], ["1970-01-01", "2000-02-29", "2024-12-31"]);
        assert_eq!([of(1_740_787_200), of(1_735_689_600)], ["2025-03-01", "2025-01-01"]);
    }
}
