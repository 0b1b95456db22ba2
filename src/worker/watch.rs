// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the worker of a node's machine does, for the node's status.

use super::state::WorkerState;
use std::path::PathBuf;
use std::sync::{Arc, PoisonError, RwLock, Weak};
use std::time::Duration;

/// How often the worker's state is read.
const POLL: Duration = Duration::from_secs(1);

/// A thread that reads the worker's state: the disk or share where it is may take its time, and nothing must wait for it. It ends
/// when this is dropped.
#[derive(Debug, Default)]
pub struct WorkerWatch {
    seen: Arc<RwLock<Option<WorkerState>>>,
}

impl WorkerWatch {
    /// Begins to read; without results there is nothing to see.
    pub fn start(results: Option<PathBuf>) -> std::io::Result<Self> {
        let watch = Self::default();
        let Some(results) = results else { return Ok(watch) };
        let seen: Weak<RwLock<Option<WorkerState>>> = Arc::downgrade(&watch.seen);
        let run = move || {
            while let Some(seen) = seen.upgrade() {
                let state = WorkerState::load(&results);
                *seen.write().unwrap_or_else(PoisonError::into_inner) = state;
                drop(seen);
                std::thread::sleep(POLL);
            }
        };
        std::thread::Builder::new().name("worker-watch".to_owned()).spawn(run)?;
        Ok(watch)
    }

    /// What it does, if there is one.
    pub fn state(&self) -> Option<WorkerState> {
        self.seen.read().unwrap_or_else(PoisonError::into_inner).clone()
    }
}
