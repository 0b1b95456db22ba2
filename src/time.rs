//! The host's two clocks, in nanoseconds: one for the record, one for measuring.

use std::sync::OnceLock;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// CLOCK_REALTIME since 1970, ns: what recordings call host time. It may jump; only people compare it.
pub fn host_time_ns() -> u64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_nanos()).unwrap_or(u64::MAX)
}

/// An instant on CLOCK_MONOTONIC since an arbitrary origin that is the same for the whole process, ns.
pub fn monotonic_ns(instant: Instant) -> u64 {
    static ORIGIN: OnceLock<Instant> = OnceLock::new();
    // Instants from before the first call must not be cut off at zero.
    let origin = *ORIGIN.get_or_init(|| instant.checked_sub(Duration::from_secs(3600)).unwrap_or(instant));
    u64::try_from(instant.saturating_duration_since(origin).as_nanos()).unwrap_or(u64::MAX)
}
