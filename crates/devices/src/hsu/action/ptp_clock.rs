// SPDX-License-Identifier: MIT OR Apache-2.0
//! The clock that all cameras share by PTP, as this host knows it from readings of one camera.

use crate::base::clock_fit::{ClockFit, Exchange};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// A fit of the cameras' clock, shared by the thread that reads it and the one that schedules actions. Host times are
/// those of [`crate::base::time::monotonic_ns`].
#[derive(Debug, Clone, Default)]
pub struct PtpClock(Arc<Mutex<ClockFit>>);

impl PtpClock {
    fn fit(&self) -> MutexGuard<'_, ClockFit> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Forgets all readings, because the clocks may have been set since.
    pub fn forget(&self) {
        *self.fit() = ClockFit::new();
    }

    /// Adds a reading to the fit.
    pub fn read(&self, exchange: &Exchange) {
        // The fit leaves out readings that do not fit, and detects a clock that was set.
        let _ = self.fit().exchange(exchange);
    }

    /// The cameras' time at a time of this host, ns; `None` before the first reading.
    pub fn at(&self, host_ns: u64) -> Option<u64> {
        u64::try_from(self.fit().device_from_host(host_ns.into())?).ok()
    }
}
