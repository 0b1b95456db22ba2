// SPDX-License-Identifier: MIT OR Apache-2.0
//! Why a command failed: what it says on standard error, and its exit code.

use crate::base::ids::one_line;
use crate::base::{Exit, Fault};
use crate::config::ConfigError;
use crate::data::LostPart;
use crate::record::ReadError;
use std::fmt;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

/// A command's failure: what was expected, what was found, what to do; and the exit code.
#[derive(Debug)]
pub struct Failure {
    /// The exit code.
    pub exit: Exit,
    /// For the user.
    pub message: String,
}

impl Failure {
    /// A failure with this exit code.
    pub fn new(exit: Exit, message: impl fmt::Display) -> Self {
        Self { exit, message: message.to_string() }
    }

    /// Wrong usage or configuration: exit code 2.
    pub(super) fn usage(message: impl fmt::Display) -> Self {
        Self::new(Exit::Usage, message)
    }

    /// Corrupt data, or a verification that failed: exit code 4.
    pub(super) fn corrupt(message: impl fmt::Display) -> Self {
        Self::new(Exit::Corrupt, message)
    }

    /// A device or a link that failed: exit code 5.
    pub(super) fn device(message: impl fmt::Display) -> Self {
        Self::new(Exit::Device, message)
    }

    /// Any other failure: exit code 1.
    pub(super) fn failed(message: impl fmt::Display) -> Self {
        Self::new(Exit::Failure, message)
    }

    /// A failure of the file system at this path: exit code 1.
    pub(super) fn at(path: &Path, error: impl fmt::Display) -> Self {
        Self::failed(format!("{}: {error}", path.display()))
    }
}

impl fmt::Display for Failure {
    /// As it is printed: it may quote a file, a camera or another node.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&crate::base::print::harmless(&self.message))
    }
}

impl From<Fault> for Failure {
    fn from(fault: Fault) -> Self {
        Self::new(Exit::from_code(fault.exit), fault.message)
    }
}

/// Whatever opens a session: a path without one is a mistake of usage, one that cannot be read is corrupt data.
impl From<ReadError> for Failure {
    fn from(error: ReadError) -> Self {
        let exit = match error {
            ReadError::Absent(_) => Exit::Usage,
            ReadError::Unreadable(_) => Exit::Corrupt,
        };
        Self::new(exit, error)
    }
}

impl From<ConfigError> for Failure {
    fn from(error: ConfigError) -> Self {
        Self::new(Exit::Usage, error)
    }
}

/// A file that a command reads, likewise.
pub(super) fn unreadable(path: &Path, error: impl fmt::Display) -> Failure {
    let there = std::fs::metadata(path).map_err(|e| e.kind());
    let absent = matches!(there, Err(ErrorKind::NotFound | ErrorKind::NotADirectory));
    Failure::new(if absent { Exit::Usage } else { Exit::Corrupt }, error)
}

/// The directory of a reconstruction, likewise: one that has clouds and is not as `reconstruct` leaves it is damaged.
pub(super) fn unusable_clouds(directory: &Path, error: impl fmt::Display) -> Failure {
    let some = ["phases", "clouds", "merged"].iter().any(|folder| directory.join(folder).is_dir());
    Failure::new(if some { Exit::Corrupt } else { Exit::Usage }, error)
}

/// Prints which files a command has written: a line each, or JSON.
pub(super) fn print_files(files: &[PathBuf], json: bool) {
    if json {
        println!("{}", serde_json::json!({ "files": files }));
    } else {
        files.iter().for_each(|path| println!("{}", one_line(path.display())));
    }
}

/// Says which parts of a session cannot be read; returns whether there are any.
pub(super) fn tell_lost(lost: &[LostPart]) -> bool {
    lost.iter().for_each(|part| eprintln!("NOT READABLE  {part}"));
    !lost.is_empty()
}

/// Names what of a result is missing or left out; returns whether there is anything.
pub(super) fn tell_amiss(amiss: &[String]) -> bool {
    amiss.iter().for_each(|sentence| eprintln!("{sentence}"));
    !amiss.is_empty()
}

/// Names the times of a sequence for what they are, where nothing says when the triggers were.
pub(super) fn tell_made_up_times(rate_hz: f64) {
    eprintln!(
        "MADE UP  times: the result does not state when its triggers were; they are by index at {rate_hz} Hz (--rate-hz), from 1970 on"
    );
}
