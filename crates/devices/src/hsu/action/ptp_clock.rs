// SPDX-License-Identifier: MIT OR Apache-2.0
//! The clock that PTP gives all cameras, as this host knows it: by reading it from one of them.

use crate::base::clock_fit::{ClockFit, Exchange};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Shared by who reads the clock and who schedules by it. Host times are those of
/// [`crate::base::time::monotonic_ns`].
#[derive(Debug, Clone, Default)]
pub struct PtpClock(Arc<Mutex<ClockFit>>);

impl PtpClock {
    fn fit(&self) -> MutexGuard<'_, ClockFit> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Forgets what was read: the clocks may have been set since.
    pub fn forget(&self) {
        *self.fit() = ClockFit::new();
    }

    /// Takes a reading into account.
    pub fn read(&self, exchange: &Exchange) {
        // What does not fit is left out; a clock that was set anew is found by the fit itself.
        let _ = self.fit().exchange(exchange);
    }

    /// What the cameras' clock shows at a time of this host, ns; `None` before it was read.
    pub fn at(&self, host_ns: u64) -> Option<u64> {
        u64::try_from(self.fit().device_from_host(host_ns.into())?).ok()
    }
}
