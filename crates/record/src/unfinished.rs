// SPDX-License-Identifier: MIT OR Apache-2.0
//! Recordings that were not finished: what a node looks for when it starts.
//!
//! Cheap enough for a start: of a finished recording only the last segment's summary is read; of an unfinished
//! one the records are walked, which touches a page for each frame, and nothing is hashed.

use super::files::{RecordingFiles, find, unfinished};
use super::metadata::read_header;
use super::reader::{Extent, Outcome, RecordingReader};
use super::scan::open_segment;
use crate::base::ids::{NodeId, SessionName};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// A recording without a verdict.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Interrupted {
    /// Directory of the recording that was not finished.
    #[cfg_attr(feature = "schema", schema(value_type = String))]
    pub path: PathBuf,
    /// Name of the session, that of its directory.
    #[cfg_attr(feature = "schema", schema(value_type = String))]
    pub session: SessionName,
    /// Name of the node that recorded it.
    #[cfg_attr(feature = "schema", schema(value_type = String))]
    pub node: NodeId,
    /// Frames of all cameras in it, not checked.
    pub frames: u64,
    /// The last trigger that its frames, gap records or trigger table know.
    pub last_trigger: Option<u64>,
    /// Why it counts as interrupted.
    pub reason: String,
}

impl Interrupted {
    /// The command that saves what is in it, as it can be typed.
    pub fn command(&self) -> String {
        let session = self.path.parent().unwrap_or(&self.path);
        let name = session.file_name().unwrap_or_default().to_string_lossy();
        let out = session.with_file_name(format!("{name}-recovered"));
        format!("fourdbody recover {} --out {}", quoted(session), quoted(&out))
    }
}

/// For a shell; names of sessions need no quotes, the directories above them may.
fn quoted(path: &Path) -> String {
    let text = path.display().to_string();
    let plain = |c: char| c.is_ascii_alphanumeric() || "/._-".contains(c);
    if text.chars().all(plain) { text } else { format!("'{}'", text.replace('\'', r"'\''")) }
}

/// Recordings below `sessions_dir` (`SESSION/node-*`) that were not finished, but for those of which a finished copy,
/// as `fourdbody recover` makes it, is there as well.
///
/// One that is being recorded at this moment looks the same: a node asks before it records, for its own name.
pub fn interrupted(sessions_dir: &Path) -> Vec<Interrupted> {
    let entries = std::fs::read_dir(sessions_dir).into_iter().flatten().flatten();
    let mut sessions: Vec<PathBuf> = entries.map(|entry| entry.path()).filter(|path| path.is_dir()).collect();
    sessions.sort();
    let (mut finished, mut open) = (Vec::new(), Vec::new());
    for files in sessions.iter().filter_map(|session| find(session).ok()).flatten() {
        match unfinished(&files.path) {
            Some(reason) => open.push((files, reason)),
            None => finished.push(files),
        }
    }
    if open.is_empty() {
        return Vec::new();
    }
    let saved: BTreeSet<(String, NodeId)> = finished.iter().filter_map(identity).collect();
    let open = open.into_iter().filter(|(files, _)| identity(files).is_none_or(|id| !saved.contains(&id)));
    open.map(|(files, reason)| describe(&files, reason)).collect()
}

/// The session's id and the node.
fn identity(files: &RecordingFiles) -> Option<(String, NodeId)> {
    let (_, first) = files.segments.first()?;
    let header = read_header(&open_segment(first).ok()?).ok()?.header;
    Some((header.session_id, header.node))
}

fn describe(files: &RecordingFiles, reason: String) -> Interrupted {
    let name = |path: Option<&Path>| {
        path.and_then(Path::file_name).map(|name| name.to_string_lossy().into_owned()).unwrap_or_default()
    };
    let named = Interrupted {
        path: files.path.clone(),
        session: SessionName(name(files.path.parent())),
        node: NodeId(name(Some(&files.path)).trim_start_matches("node-").to_owned()),
        frames: 0,
        last_trigger: None,
        reason,
    };
    match RecordingReader::open(files, Extent::Outcomes) {
        Err(error) => Interrupted { reason: format!("{}; {error}", named.reason), ..named },
        Ok(recording) => {
            let outcomes = recording.outcomes.iter().flat_map(|outcomes| outcomes.values());
            let frames = outcomes.filter(|outcome| matches!(outcome, Outcome::Frame { .. })).count() as u64;
            let last_trigger = recording.known_end().checked_sub(1);
            Interrupted {
                session: recording.header.session,
                node: recording.header.node,
                frames,
                last_trigger,
                ..named
            }
        }
    }
}
