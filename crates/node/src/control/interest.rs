// SPDX-License-Identifier: MIT OR Apache-2.0
//! Whether somebody looks: nothing is computed, and no camera runs, that no client asks about.

use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Time without a request after which a client no longer counts as looking.
const INTEREST: Duration = Duration::from_secs(2);

/// When something was last requested: nothing is computed that no client looks at.
#[derive(Debug, Default)]
pub(crate) struct Interest(Mutex<Option<Instant>>);

impl Interest {
    /// Notes a request that arrives now.
    pub(crate) fn note(&self) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = Some(Instant::now());
    }

    /// Whether the last request is recent enough.
    pub(crate) fn is_fresh(&self) -> bool {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).is_some_and(|at| at.elapsed() < INTEREST)
    }
}
