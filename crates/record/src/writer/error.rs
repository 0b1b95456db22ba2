// SPDX-License-Identifier: MIT OR Apache-2.0
//! Why something could not be recorded.

use crate::verdict::Verdict;
use std::io;
use std::path::PathBuf;

/// Why something could not be recorded.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// The header describes a recording that cannot be.
    #[error("recording cannot start: {0}")]
    Header(String),
    /// The directory exists, and nothing is ever overwritten.
    #[error("{path} exists; a recording is never overwritten: choose another session name")]
    Exists { path: PathBuf },
    /// The session would not fit.
    #[error(
        "{path}: the session needs {needed_mib} MiB and {reserve_mib} MiB stay reserved, but only {free_mib} MiB are \
         free; delete or move sessions, or ask for fewer triggers"
    )]
    NoSpace {
        /// Where the recording would be.
        path: PathBuf,
        needed_mib: u64,
        reserve_mib: u64,
        free_mib: u64,
    },
    /// The reserve is reached: frames become gap records with cause `dropped_disk`, the rest goes on.
    #[error(
        "{path}: {free_mib} MiB are free, the reserve is {reserve_mib} MiB: frames are no longer recorded; stop the \
         session"
    )]
    ReserveReached { path: PathBuf, free_mib: u64, reserve_mib: u64 },
    /// The disk failed. What was flushed before is readable; the frame is accounted for as `dropped_disk`.
    #[error("{path}: cannot be written ({source}); frames are no longer recorded; stop the session")]
    Disk { path: PathBuf, source: io::Error },
    /// A file may not become as long as it has to: the disk has room.
    #[error(
        "{path}: a file may not grow beyond the limit that this process has ({source}); the disk is not full; raise \
         LimitFSIZE= of the unit, or `ulimit -f`; frames are no longer recorded; stop the session"
    )]
    FileLimit { path: PathBuf, source: io::Error },
    /// An earlier error ended the recording of frames; this one is accounted for as `dropped_disk`.
    #[error("frames are no longer recorded since an earlier error: {reason}")]
    Stopped { reason: String },
    /// Message and description differ: a mistake of the caller. Nothing was recorded.
    #[error("frame of camera {camera}: {reason}")]
    Frame {
        /// Its place in the header.
        camera: usize,
        /// What was expected and found.
        reason: String,
    },
    /// The accounting could not be completed on disk; this is the verdict.
    #[error("{path}: the verdict could not be written ({source}); it is: {verdict}")]
    Unfinished {
        path: PathBuf,
        source: io::Error,
        /// What could not be written.
        verdict: Box<Verdict>,
    },
}

impl RecordError {
    /// What refused a write, by its name: the disk, or a limit of this process.
    pub(super) fn refused(path: PathBuf, source: io::Error) -> Self {
        match source.raw_os_error() {
            Some(libc::EFBIG) => Self::FileLimit { path, source },
            _ => Self::Disk { path, source },
        }
    }
}
