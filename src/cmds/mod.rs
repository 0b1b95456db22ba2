//! One file per command of the command line: its arguments, and what it prints.
//!
//! Results go to standard output, diagnostics to standard error. Everything a command does lives in the
//! library's other modules; here is only the talking.

use crate::config::ConfigError;
use crate::reconstruct::LostPart;
use crate::record::ReadError;
use crate::session::state::Fault;
use std::fmt;
use std::io::ErrorKind;
use std::path::Path;
use std::process::ExitCode;

pub mod board;
pub mod calibrate;
mod calibrate_live;
pub mod cameras;
pub mod capture;
pub mod check_config;
mod cli;
pub mod cluster;
pub mod connect;
pub mod doctor;
pub mod export;
pub mod import;
pub mod info;
pub mod node;
pub mod pattern;
mod progress;
pub mod prune;
pub mod reconstruct;
pub mod recover;
pub mod report;
pub mod status;
pub mod token;
pub mod validate;
pub mod verify;
pub mod view;
pub mod worker;

pub use cli::{Cli, Command};

/// How a command ended (brief, section 7: a contract with scripts).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Exit {
    /// Done.
    Done = 0,
    /// Any other failure.
    Failure = 1,
    /// Wrong usage or configuration.
    Usage = 2,
    /// Done, with data loss that is accounted for.
    DataLoss = 3,
    /// Data corrupt, or a verification failed.
    Corrupt = 4,
    /// A device or a link failed.
    Device = 5,
}

impl Exit {
    /// The exit that a code of a fault means.
    pub fn from_code(code: u8) -> Self {
        let known = [Self::Done, Self::Usage, Self::DataLoss, Self::Corrupt, Self::Device];
        known.into_iter().find(|exit| *exit as u8 == code).unwrap_or(Self::Failure)
    }
}

impl From<Exit> for ExitCode {
    fn from(exit: Exit) -> Self {
        ExitCode::from(exit as u8)
    }
}

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

/// A file that a command reads, likewise.
fn unreadable(path: &Path, error: impl fmt::Display) -> Failure {
    let there = std::fs::metadata(path).map_err(|e| e.kind());
    let absent = matches!(there, Err(ErrorKind::NotFound | ErrorKind::NotADirectory));
    Failure::new(if absent { Exit::Usage } else { Exit::Corrupt }, error)
}

/// The directory of a reconstruction, likewise: one that has clouds and is not as `reconstruct` leaves it is damaged.
fn unusable_clouds(directory: &Path, error: impl fmt::Display) -> Failure {
    let some = ["phases", "clouds", "merged"].iter().any(|folder| directory.join(folder).is_dir());
    Failure::new(if some { Exit::Corrupt } else { Exit::Usage }, error)
}

/// Says which parts of a session cannot be read; returns whether there are any.
fn tell_lost(lost: &[LostPart]) -> bool {
    lost.iter().for_each(|part| eprintln!("NOT READABLE  {part}"));
    !lost.is_empty()
}

impl From<ConfigError> for Failure {
    fn from(error: ConfigError) -> Self {
        Self::new(Exit::Usage, error)
    }
}
