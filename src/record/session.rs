//! Where things are: a session's directory, its recordings, their segments.

use super::layout::segment_number;
use crate::ids::NodeId;
use std::path::{Path, PathBuf};

/// The directory of a node's recording inside a session's directory.
pub fn node_dir(session: &Path, node: &NodeId) -> PathBuf {
    session.join(format!("node-{node}"))
}

/// The segments of one recording, in order.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RecordingFiles {
    /// The recording's directory, or the single file.
    pub path: PathBuf,
    /// Number and path.
    pub segments: Vec<(u32, PathBuf)>,
}

/// Finds the recordings at `path`: a session's directory, a recording's, or a single segment.
pub fn find(path: &Path) -> Result<Vec<RecordingFiles>, String> {
    let shown = path.display();
    let expected =
        "expected a session (node-*/segment-*.mcap), a recording (segment-*.mcap) or an .mcap file";
    let kind = std::fs::metadata(path).map_err(|e| format!("{shown}: {e}; {expected}"))?;
    if kind.is_file() {
        let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        let segments = vec![(segment_number(name).unwrap_or(0), path.to_owned())];
        return Ok(vec![RecordingFiles { path: path.to_owned(), segments }]);
    }
    let own = segments(path)?;
    if !own.is_empty() {
        return Ok(vec![RecordingFiles { path: path.to_owned(), segments: own }]);
    }
    let mut recordings = Vec::new();
    for (name, entry) in entries(path)? {
        if name.starts_with("node-") && entry.is_dir() {
            recordings.push(RecordingFiles { segments: segments(&entry)?, path: entry });
        }
    }
    if recordings.is_empty() {
        return Err(format!("{shown}: nothing recorded here; {expected}"));
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
