// SPDX-License-Identifier: MIT OR Apache-2.0
//! Work that may take any time and must never be waited for: `fourdbody` in a process of its own, at idle priority.

use std::ffi::OsStr;
use std::io;
use std::process::{Child, Command, Stdio};

/// A command of this program at idle priority (SCHED_IDLE) without input or output. It is killed when the thread that
/// spawns it ends, so that a killed parent leaves no process behind.
pub fn command<S: AsRef<OsStr>>(args: impl IntoIterator<Item = S>) -> io::Result<Command> {
    let program = std::env::current_exe()?;
    // Both tools are of util-linux, which every Debian has.
    let mut command = Command::new("setpriv");
    command.args(["--pdeathsig", "KILL", "chrt", "--idle", "0"]).arg(program).args(args);
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    Ok(command)
}

/// The error of a command that could not be spawned, with the program that was missing.
pub fn not_started(error: io::Error) -> io::Error {
    io::Error::new(error.kind(), format!("`setpriv` (package util-linux): {error}"))
}

/// Ends a process at once and waits until it is gone.
pub fn end(child: &mut Child) {
    // It may have ended by itself.
    let _ = child.kill();
    let _ = child.wait();
}
