// SPDX-License-Identifier: MIT OR Apache-2.0
//! A process of `fourdbody` at idle priority, which its caller may end at any moment.

use crate::base::regular;
use crate::host::idle_process;
use std::io;
use std::path::Path;
use std::time::{Duration, Instant};

/// Time between two looks at the process, and at possible reasons to end it.
const POLL: Duration = Duration::from_millis(50);
/// Length of the end of a process's output that is quoted, bytes.
const QUOTED_BYTES: usize = 600;

/// How a process came to its end.
#[derive(Debug, PartialEq, Eq)]
pub enum Ended<R> {
    /// By itself, with this exit code; `None`: by a signal.
    ByItself(Option<i32>),
    /// By its caller, for this reason.
    Interrupted(R),
}

/// Runs `fourdbody` with these arguments at idle priority; its output goes to `log`. `look` receives many times a
/// second how long the process has been running, and may return a reason to end it.
pub fn run<R>(
    args: Vec<std::ffi::OsString>,
    log: &Path,
    mut look: impl FnMut(Duration) -> Option<R>,
) -> io::Result<Ended<R>> {
    let output = regular::create(log)?;
    let started = idle_process::command(args)?.stdout(output.try_clone()?).stderr(output).spawn();
    let mut child = started.map_err(idle_process::not_started)?;
    let began = Instant::now();
    loop {
        match child.try_wait() {
            Ok(Some(status)) => return Ok(Ended::ByItself(status.code())),
            Ok(None) => {}
            Err(error) => {
                idle_process::end(&mut child);
                return Err(error);
            }
        }
        if let Some(interruption) = look(began.elapsed()) {
            idle_process::end(&mut child);
            return Ok(Ended::Interrupted(interruption));
        }
        std::thread::sleep(POLL);
    }
}

/// The end of a process's output.
pub fn last_output(log: &Path) -> String {
    let bytes = regular::read(log, regular::STATEMENT_BYTES).unwrap_or_default();
    let text = String::from_utf8_lossy(&bytes);
    let text = text.trim();
    let start = text.char_indices().map(|(i, _)| i).find(|i| text.len() - i <= QUOTED_BYTES).unwrap_or(0);
    text[start..].to_owned()
}
