// SPDX-License-Identifier: MIT OR Apache-2.0
//! How a command ends, and why something failed: the exit code, and a message of what was expected, what was found and
//! what to do.

use serde::{Deserialize, Serialize};
use std::fmt::Display;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// How a command ended (a contract with scripts).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Exit {
    Done = 0,
    /// Any failure that the other codes do not cover.
    Failure = 1,
    Usage = 2,
    /// Done, with data loss that is accounted for.
    DataLoss = 3,
    /// Data corrupt, or a verification failed.
    Corrupt = 4,
    /// A device or a link failed.
    Device = 5,
}

impl Exit {
    /// The exit of the code that a fault has.
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

/// Why something failed, with the exit code that it means on the command line.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, thiserror::Error)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[error("{message}")]
pub struct Fault {
    /// As a process exit code.
    pub exit: u8,
    /// What was expected, what was found, what to do.
    pub message: String,
}

impl Fault {
    /// A fault with this exit code.
    pub fn new(exit: Exit, message: impl ToString) -> Self {
        Self { exit: exit as u8, message: message.to_string() }
    }

    /// Wrong usage or configuration: exit code 2.
    pub fn usage(message: impl ToString) -> Self {
        Self::new(Exit::Usage, message)
    }

    /// Corrupt data, or a verification that failed: exit code 4.
    pub fn corrupt(message: impl ToString) -> Self {
        Self::new(Exit::Corrupt, message)
    }

    /// A device or a link that failed: exit code 5.
    pub fn device(message: impl ToString) -> Self {
        Self::new(Exit::Device, message)
    }

    /// Any other failure: exit code 1.
    pub fn failed(message: impl ToString) -> Self {
        Self::new(Exit::Failure, message)
    }

    /// A failure of the file system at this path: exit code 1.
    pub fn at(path: &Path, error: impl Display) -> Self {
        Self::failed(format!("{}: {error}", path.display()))
    }
}

impl From<String> for Fault {
    fn from(message: String) -> Self {
        Self::new(Exit::Failure, message)
    }
}

/// Why a file cannot be used: which one, what was expected of it and what was found.
#[derive(Debug, thiserror::Error)]
#[error("{}: {reason}", path.display())]
pub struct FileError {
    pub path: PathBuf,
    /// What was expected, what was found, what to do.
    pub reason: String,
}

impl FileError {
    /// A function that makes a reason an error of this file.
    pub fn of<E: Display>(path: &Path) -> impl Fn(E) -> Self + Copy + '_ {
        |reason| Self { path: path.to_owned(), reason: reason.to_string() }
    }
}
