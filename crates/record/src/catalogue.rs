// SPDX-License-Identifier: MIT OR Apache-2.0
//! A session on a node's disk in short: the entry of the console's list, which the worker reads, too.
//!
//! Of a recording only the header of its first segment and the summary of its last are read.

use super::files::{RecordingFiles, find, node_dir, unfinished};
use super::layout::{KEY_JSON, VERDICT_METADATA};
use super::metadata::read_header;
use super::remark::Remark;
use super::scan::metadata_by_index;
use super::segment_file::SegmentFile;
use super::verdict::Verdict;
use crate::base::ids::NodeId;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

/// A node's recording of a session.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct CatalogueEntry {
    /// The session's name: its directory's.
    pub name: String,
    /// The id that all recordings of a session share, hexadecimal; `None` where the header cannot be read.
    pub session_id: Option<String>,
    /// Directory of this node's recording of the session.
    #[cfg_attr(feature = "schema", schema(value_type = String))]
    pub path: PathBuf,
    /// Size of all its segments together, bytes.
    pub bytes: u64,
    /// When it was begun, host clock, ns; where that cannot be read, when its directory was made.
    pub created_ns: u64,
    /// Triggers per second; `None` where the header cannot be read.
    pub trigger_rate_hz: Option<f64>,
    /// Names of the cameras that this node records.
    pub cameras: Vec<String>,
    /// Pseudonym of the subject, where one was given.
    pub subject: Option<String>,
    /// Free text that was given when the session was started.
    pub note: Option<String>,
    /// Rating and note of the operator, where they were given.
    #[serde(default)]
    pub remark: Option<Remark>,
    /// The stored verdict; `None` when the recording was not finished.
    pub verdict: Option<Verdict>,
    /// Why it counts as unfinished, or what is wrong with it.
    pub problem: Option<String>,
}

/// One recording of a node; `None` when there is none of this name.
pub fn entry(sessions_dir: &Path, node: &NodeId, name: &str) -> Option<CatalogueEntry> {
    // A session's name is one component of a path: nothing else is looked up.
    crate::base::ids::SessionName::parse(name).ok()?;
    let path = node_dir(&sessions_dir.join(name), node);
    let made = modified(&path)?;
    let mut entry = describe(path, made);
    entry.remark = Remark::load(&sessions_dir.join(name), node);
    Some(entry)
}

fn modified(path: &Path) -> Option<SystemTime> {
    std::fs::metadata(path).ok()?.modified().ok()
}

fn describe(path: PathBuf, made: SystemTime) -> CatalogueEntry {
    let name = path.parent().and_then(Path::file_name).unwrap_or_default().to_string_lossy().into_owned();
    let made_ns = made.duration_since(UNIX_EPOCH).map_or(0, |t| u64::try_from(t.as_nanos()).unwrap_or(0));
    let mut entry = CatalogueEntry {
        name,
        session_id: None,
        bytes: 0,
        created_ns: made_ns,
        trigger_rate_hz: None,
        cameras: Vec::new(),
        subject: None,
        note: None,
        remark: None,
        verdict: None,
        problem: unfinished(&path),
        path,
    };
    match find(&entry.path) {
        Ok(found) => found.iter().for_each(|files| read(&mut entry, files)),
        Err(error) => entry.problem = Some(error.to_string()),
    }
    entry
}

fn read(entry: &mut CatalogueEntry, files: &RecordingFiles) {
    let sizes = files.segments.iter().filter_map(|(_, path)| std::fs::metadata(path).ok());
    entry.bytes = sizes.map(|metadata| metadata.len()).sum();
    // All segments have the same header: the first one that can be read is used.
    for (_, path) in &files.segments {
        let named = |reason: String| format!("{}: {reason}", path.display());
        match SegmentFile::open(path)
            .map_err(|e| format!("cannot be opened: {e}"))
            .and_then(|f| read_header(&f))
        {
            Ok(stated) => {
                entry.session_id = Some(stated.header.session_id);
                entry.created_ns = stated.header.created_ns;
                entry.trigger_rate_hz = Some(stated.header.trigger_rate_hz);
                entry.cameras = stated.header.cameras.iter().map(|camera| camera.id.to_string()).collect();
                entry.subject = stated.header.subject;
                entry.note = stated.header.note;
                break;
            }
            Err(reason) => {
                entry.problem.get_or_insert(named(reason));
            }
        }
    }
    let last = files.segments.last().and_then(|(_, path)| SegmentFile::open(path).ok());
    let metadata = last.as_ref().and_then(metadata_by_index).unwrap_or_default();
    let stated = metadata.iter().find(|(name, _)| *name == VERDICT_METADATA);
    entry.verdict = stated
        .and_then(|(_, entries)| entries.get(KEY_JSON))
        .and_then(|json| serde_json::from_str(json).ok());
}

#[cfg(test)]
mod tests {
    use super::entry;
    use crate::base::ids::NodeId;

    #[test]
    fn what_is_not_a_session_of_this_node_is_not_described() {
        let dir = tempfile::tempdir().expect("a directory");
        for path in ["walk/node-a", "other/node-b", "empty"] {
            std::fs::create_dir_all(dir.path().join(path)).expect("made");
        }
        std::fs::write(dir.path().join("walk/node-a/segment-000000.mcap"), b"").expect("written");
        let walk = entry(dir.path(), &NodeId::from("a"), "walk").expect("a recording");
        assert_eq!((walk.name.as_str(), &walk.verdict), ("walk", &None));
        assert!(walk.problem.as_deref().is_some_and(|problem| problem.contains("not closed")), "{walk:?}");
        for name in ["other", "../walk", "", "walk/node-a"] {
            assert_eq!(entry(dir.path(), &NodeId::from("a"), name), None, "{name:?}");
        }
    }
}
