// SPDX-License-Identifier: MIT OR Apache-2.0
//! The files of recordings: where they lie, and why one is thought to be unfinished.

use super::layout::{VERDICT_METADATA, segment_number};
use super::scan::metadata_by_index;
use super::segment_file::SegmentFile;
use crate::base::Fault;
use crate::base::ids::NodeId;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

/// Why a recording could not be opened at all.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ReadError {
    /// There is no recording at the path: a mistake in the command.
    #[error("{0}")]
    Absent(String),
    /// There is one that cannot be read, or that is no recording of this program.
    #[error("{0}")]
    Unreadable(String),
}

/// A path without a recording is a mistake of usage, one that cannot be read is corrupt data.
impl From<ReadError> for Fault {
    fn from(error: ReadError) -> Self {
        match error {
            ReadError::Absent(_) => Self::usage(error),
            ReadError::Unreadable(_) => Self::corrupt(error),
        }
    }
}

/// The directory of a node's recording inside a session's directory.
pub fn node_dir(session: &Path, node: &NodeId) -> PathBuf {
    session.join(format!("node-{node}"))
}

/// The segments of one recording, in order.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RecordingFiles {
    /// The recording's directory, or the single file.
    pub path: PathBuf,
    /// Number and path of each segment.
    pub segments: Vec<(u32, PathBuf)>,
    /// Why the directory cannot be listed, if so.
    pub unlisted: Option<String>,
}

impl RecordingFiles {
    fn of(path: &Path, segments: Vec<(u32, PathBuf)>) -> Self {
        Self { path: path.to_owned(), segments, unlisted: None }
    }
}

/// Finds the recordings at `path`: a session's directory, a recording's, or a single segment.
pub(super) fn find(path: &Path) -> Result<Vec<RecordingFiles>, ReadError> {
    let shown = path.display();
    let expected =
        "expected a session (node-*/segment-*.mcap), a recording (segment-*.mcap) or an .mcap file";
    let kind = std::fs::metadata(path).map_err(|e| {
        let message = format!("{shown}: {e}; {expected}");
        match e.kind() {
            ErrorKind::NotFound | ErrorKind::NotADirectory => ReadError::Absent(message),
            _ => ReadError::Unreadable(message),
        }
    })?;
    if kind.is_file() {
        let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        let segments = vec![(segment_number(name).unwrap_or(0), path.to_owned())];
        return Ok(vec![RecordingFiles::of(path, segments)]);
    }
    let own = segments(path).map_err(ReadError::Unreadable)?;
    if !own.is_empty() {
        return Ok(vec![RecordingFiles::of(path, own)]);
    }
    let mut recordings = Vec::new();
    for (name, entry) in entries(path).map_err(ReadError::Unreadable)? {
        if !name.starts_with("node-") {
            continue;
        }
        // One that cannot be listed does not hide the others; a link whose disk is away is not nothing.
        let listed = match std::fs::metadata(&entry) {
            Ok(kind) if !kind.is_dir() => continue,
            Ok(_) => segments(&entry),
            Err(error) => Err(format!("{}: {error}", entry.display())),
        };
        let (segments, unlisted) = match listed {
            Ok(segments) => (segments, None),
            Err(reason) => (Vec::new(), Some(reason)),
        };
        recordings.push(RecordingFiles { path: entry, segments, unlisted });
    }
    if recordings.is_empty() {
        return Err(ReadError::Absent(format!("{shown}: nothing recorded here; {expected}")));
    }
    Ok(recordings)
}

fn segments(dir: &Path) -> Result<Vec<(u32, PathBuf)>, String> {
    let found = entries(dir)?.into_iter();
    let mut segments: Vec<_> =
        found.filter_map(|(name, path)| segment_number(&name).map(|number| (number, path))).collect();
    segments.sort();
    Ok(segments)
}

/// Names and paths in a directory, sorted.
fn entries(dir: &Path) -> Result<Vec<(String, PathBuf)>, String> {
    let error = |e: std::io::Error| format!("{}: {e}", dir.display());
    let mut found = Vec::new();
    for entry in std::fs::read_dir(dir).map_err(error)? {
        let entry = entry.map_err(error)?;
        found.extend(entry.file_name().into_string().ok().map(|name| (name, entry.path())));
    }
    found.sort();
    Ok(found)
}

/// Why the recording in `dir` is thought to be unfinished: its last segment is not closed, or states no verdict, or
/// cannot be read. `None` for a finished one, and where there is no recording.
pub(super) fn unfinished(dir: &Path) -> Option<String> {
    let (_, last) = segments(dir).ok()?.pop()?;
    let name = last.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let file = match SegmentFile::open(&last) {
        Ok(file) => file,
        Err(error) => return Some(format!("{name} cannot be opened: {error}")),
    };
    match metadata_by_index(&file) {
        None => Some(match file.bad_ranges().first() {
            Some(bad) => format!("{name}: {bad}"),
            None => format!("{name} was not closed"),
        }),
        Some(metadata) if metadata.iter().any(|(name, _)| *name == VERDICT_METADATA) => None,
        Some(_) => Some(format!("{name} has no verdict")),
    }
}

/// The node that a recording's directory is named after.
pub(super) fn node_of_dir(path: &Path) -> Option<String> {
    Some(path.file_name()?.to_str()?.strip_prefix("node-")?.to_owned())
}
