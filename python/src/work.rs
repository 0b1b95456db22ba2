// SPDX-License-Identifier: MIT OR Apache-2.0
//! Work that takes long: without the interpreter's lock, with its progress, and ended by Ctrl-C.

use crate::error::raise;
use fourdbody_core::base::{Exit, Fault};
use pyo3::prelude::*;
use std::ops::ControlFlow;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// Gets how much is done and of how much, and tells whether to go on.
pub type At<'a> = &'a (dyn Fn(usize, usize) -> ControlFlow<()> + Sync);

/// Does the work on a thread of its own. This one waits, hears of Ctrl-C meanwhile, and calls `progress` when there is
/// some; what either raises ends the work, and is raised once it has ended.
pub fn watched<T: Send>(
    py: Python<'_>,
    progress: Option<&Py<PyAny>>,
    work: impl FnOnce(At<'_>) -> Result<T, Fault> + Send,
) -> PyResult<T> {
    let (stop, reached) = (AtomicBool::new(false), Mutex::new(None));
    let at = |done: usize, of: usize| {
        *reached.lock().unwrap_or_else(|e| e.into_inner()) = Some((done, of));
        if stop.load(Ordering::Relaxed) { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    };
    let (made, interrupted) = py.detach(|| {
        std::thread::scope(|scope| {
            let worker = scope.spawn(|| work(&at));
            let (mut interrupted, mut shown) = (None, None);
            while !worker.is_finished() {
                std::thread::sleep(Duration::from_millis(20));
                let now = *reached.lock().unwrap_or_else(|e| e.into_inner());
                let heard = Python::attach(|py| {
                    py.check_signals()?;
                    match (progress, now) {
                        (Some(progress), Some(now)) if shown != Some(now) => {
                            progress.bind(py).call1(now).map(drop)
                        }
                        _ => Ok(()),
                    }
                });
                shown = now;
                if let Err(error) = heard {
                    stop.store(true, Ordering::Relaxed);
                    interrupted.get_or_insert(error);
                }
            }
            (worker.join(), interrupted)
        })
    });
    if let Some(error) = interrupted {
        return Err(error);
    }
    let made = made.unwrap_or_else(|_| Err(Fault::new(Exit::Failure, "the work ended by a panic")));
    made.map_err(|fault| raise(py, &fault))
}
