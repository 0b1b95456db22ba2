// SPDX-License-Identifier: MIT OR Apache-2.0
//! Makes a complete recording of what a crash, a cut or a damaged disk has left.
//!
//! `docs/design/recording.md`, "Recovery", states what this keeps true (R1 to R8). The source is read twice: once to
//! find and check everything ([`salvage`]), once to copy.

mod header;
mod merge;
mod rewrite;
mod salvage;

use super::credible::most_triggers;
use super::direct_io::{rename_new, sync_directory};
use super::files::{RecordingFiles, find, node_dir};
use super::layout::GapCause;
use super::reader::{Extent, RecordingReader};
use super::verdict::Verdict;
use super::writer::RecordError;
use crate::base::ids::{CameraId, NodeId, TriggerIndex};
use merge::{Salvage, salvage};
pub use salvage::Damage;
use serde::Serialize;
use std::collections::BTreeMap;
use std::fmt;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

/// Kind of the event that marks a recovered recording.
pub const RECOVERED: &str = "recovered";

/// Text in its message where places were damaged.
const DAMAGED: &str = "damaged places";
/// Text in its message where small records were lost.
const RECORDS_LOST: &str = "small records lost";

/// Whether a recording is a copy of a damaged one: its header may be wrong, and records may be missing that explain
/// irregularities.
pub(super) fn is_of_damaged(recording: &RecordingReader) -> bool {
    let damaged = |message: &str| message.contains(DAMAGED) || message.contains(RECORDS_LOST);
    recording.events.iter().any(|event| event.kind == RECOVERED && damaged(&event.message))
}

/// Why nothing was recovered; the source is as it was.
#[derive(Debug, thiserror::Error)]
pub enum RecoverError {
    /// There is nothing at the path that could be a recording.
    #[error("{0}")]
    NotFound(String),
    /// The output exists, and nothing is ever overwritten.
    #[error("{path} exists; recovery never overwrites: name a directory that does not exist")]
    Exists { path: PathBuf },
    /// Something is there, but nothing of it can be used.
    #[error("{path}: {reason}; nothing can be recovered")]
    Unusable { path: PathBuf, reason: String },
    /// The output could not be written.
    #[error("{path}: {reason}; nothing was left there, the source is as it was")]
    Output { path: PathBuf, reason: String },
}

/// Gap records that recovery had to add: a run of triggers of one camera.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct AddedGaps {
    pub camera: CameraId,
    pub first: TriggerIndex,
    pub last: TriggerIndex,
    pub cause: GapCause,
}

/// The recovered recording of one node.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct RecoveredRecording {
    pub node: NodeId,
    /// The recording or segment that it was made of.
    pub source: PathBuf,
    pub out: PathBuf,
    /// Whether the source had no verdict.
    pub interrupted: bool,
    /// The verdict of the result.
    pub verdict: Verdict,
    /// Gap records that the source did not have.
    pub added: Vec<AddedGaps>,
    /// Places in the source that are not as they were written.
    pub damage: Vec<Damage>,
    /// Rows of the trigger table, samples, events and gap records that were there, but under no right checksum.
    pub records_lost: u64,
}

impl RecoveredRecording {
    /// Whether it had been finished, nothing was damaged and no gap record had to be added.
    pub fn lossless(&self) -> bool {
        !self.interrupted && self.lossless_until_interrupted()
    }

    /// The same, not counting that it was interrupted.
    pub fn lossless_until_interrupted(&self) -> bool {
        self.added.is_empty() && self.damage.is_empty() && self.records_lost == 0
    }
}

/// What was recovered of a session, a recording or a segment.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Recovery {
    pub source: PathBuf,
    /// The result: a session if the source was one, else a recording.
    pub out: PathBuf,
    pub recordings: Vec<RecoveredRecording>,
    /// Recordings of the session of which nothing can be used, and why.
    pub unusable: Vec<String>,
}

impl Recovery {
    /// Whether everything that was there is saved.
    pub fn lossless(&self) -> bool {
        self.unusable.is_empty() && self.recordings.iter().all(RecoveredRecording::lossless)
    }
}

/// How the session ended, as all its recordings together know.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct SessionExtent {
    /// Triggers of every recording; `None` leaves each one's own.
    triggers: Option<u64>,
    /// The HSU's count, if `triggers` is given.
    emitted: Option<u64>,
}

/// Recovers a session, a recording or a segment into the directory `out`, which must not exist.
///
/// `progress` is called from several threads with the bytes done and the bytes in all.
pub fn recover(
    path: &Path,
    out: &Path,
    progress: &(dyn Fn(u64, u64) + Sync),
) -> Result<Recovery, RecoverError> {
    let files = find(path).map_err(|e| RecoverError::NotFound(e.to_string()))?;
    if out.symlink_metadata().is_ok() {
        return Err(RecoverError::Exists { path: out.to_owned() });
    }
    let size = |files: &RecordingFiles| -> u64 {
        files.segments.iter().filter_map(|(_, path)| std::fs::metadata(path).ok()).map(|m| m.len()).sum()
    };
    // Everything is read twice.
    let total = files.iter().map(size).sum::<u64>().saturating_mul(2);
    let done = AtomicU64::new(0);
    let advance = |bytes: u64| progress(done.fetch_add(bytes, Ordering::Relaxed) + bytes, total);

    let (mut salvaged, mut unusable) = (Vec::new(), Vec::new());
    for files in &files {
        match salvage(files, &advance) {
            Ok(one) => salvaged.push(one),
            Err(reason) => unusable.push(RecoverError::Unusable { path: files.path.clone(), reason }),
        }
    }
    if salvaged.is_empty() {
        let nothing = RecoverError::Unusable { path: path.to_owned(), reason: "no segments".to_owned() };
        return Err(unusable.into_iter().next().unwrap_or(nothing));
    }
    adopt_headers(&mut salvaged);
    leave_out_other_sessions(&mut salvaged, &mut unusable);
    let is_session = files.iter().all(|files| files.path != path);
    let extent = extent_of(&salvaged, path, is_session);
    let partial = partial_path(out);
    let write = || -> Result<Vec<RecoveredRecording>, RecoverError> {
        let mut recordings = Vec::new();
        for source in &salvaged {
            let place =
                |dir: &Path| if is_session { node_dir(dir, &source.header.node) } else { dir.to_owned() };
            let mut recovered =
                rewrite::write(source, &place(&partial), extent, &advance).map_err(|e| output(out, e))?;
            recovered.out = place(out);
            recordings.push(recovered);
        }
        publish(&partial, out).map_err(|e| output(out, e))?;
        Ok(recordings)
    };
    let recordings = write().inspect_err(|_| {
        // Ours alone, and incomplete.
        let _ = std::fs::remove_dir_all(&partial);
    })?;
    let unusable = unusable.iter().map(ToString::to_string).collect();
    Ok(Recovery { source: path.to_owned(), out: out.to_owned(), recordings, unusable })
}

/// A header that was rebuilt, or that no checksum proves, is completed from a better one of the same session.
fn adopt_headers(salvaged: &mut [Salvage]) {
    let proven = salvaged.iter().find(|one| one.proven).map(|one| one.header.clone());
    if let Some(proven) = &proven {
        salvaged.iter_mut().filter(|one| !one.proven).for_each(|one| header::adopt(&mut one.header, proven));
    } else if let Some(readable) = salvaged.iter().find(|one| !one.rebuilt).map(|one| one.header.clone()) {
        let rebuilt = salvaged.iter_mut().filter(|one| one.rebuilt);
        rebuilt.for_each(|one| header::adopt(&mut one.header, &readable));
    }
}

/// A session has one id. Of several, the one that most recordings have stays, then one that a checksum proves; the
/// others can be recovered alone.
fn leave_out_other_sessions(salvaged: &mut Vec<Salvage>, unusable: &mut Vec<RecoverError>) {
    let alike = |id: &str| salvaged.iter().filter(|one| one.header.session_id == id).count();
    let chosen = salvaged.iter().rev().max_by_key(|one| (alike(&one.header.session_id), one.proven));
    let Some(own) = chosen.map(|one| one.header.clone()) else { return };
    let (stay, others) = std::mem::take(salvaged).into_iter().partition(|one: &Salvage| {
        one.header.session_id == own.session_id || one.header.session_id.is_empty()
    });
    *salvaged = stay;
    unusable.extend(others.into_iter().map(|one: Salvage| {
        let (session, id) = (&one.header.session, &one.header.session_id);
        let reason = format!(
            "it is of session {session} ({id}), the others are of {} ({}): recover it by itself",
            own.session, own.session_id
        );
        RecoverError::Unusable { path: one.path, reason }
    }));
}

fn output(out: &Path, error: impl fmt::Display) -> RecoverError {
    RecoverError::Output { path: out.to_owned(), reason: error.to_string() }
}

/// Gives the finished directory its name.
fn publish(partial: &Path, out: &Path) -> io::Result<()> {
    sync_directory(partial)?;
    rename_new(partial, out)?;
    sync_directory(out.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new(".")))
}

/// Path of the output while it is incomplete: beside its place, hidden, with the number of this process.
fn partial_path(out: &Path) -> PathBuf {
    let name = out.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    out.with_file_name(format!(".{name}.partial-{}", std::process::id()))
}

/// The nodes of a session end at the same trigger; who was interrupted learns it from the others.
fn extent_of(salvaged: &[Salvage], path: &Path, is_session: bool) -> SessionExtent {
    let own = SessionExtent { triggers: None, emitted: None };
    let Some(first) = salvaged.iter().find(|one| one.interrupted() && !one.fragment) else { return own };
    let same = |id: &str| id == first.header.session_id;
    let group = salvaged.iter().filter(|one| same(&one.header.session_id));
    let (mut ends, mut counts): (Vec<u64>, Vec<Option<u64>>) =
        group.map(|one| (one.end(), one.emitted())).unzip();
    for other in if is_session { Vec::new() } else { siblings(path) } {
        if same(&other.header.session_id) && other.header.node != first.header.node {
            ends.push(other.triggers_end().min(most_triggers(other.bytes())));
            counts.push(other.verdict.as_ref().and_then(|verdict| verdict.triggers_emitted));
        }
    }
    let end = ends.iter().copied().max().unwrap_or(0);
    let stated: Vec<u64> = counts.into_iter().flatten().collect();
    let agreed = stated.first().copied().filter(|n| *n >= end && stated.iter().all(|other| other == n));
    SessionExtent { triggers: Some(agreed.unwrap_or(end)), emitted: agreed }
}

/// The other recordings in the session's directory, if a recording in one is recovered alone.
fn siblings(path: &Path) -> Vec<RecordingReader> {
    let name = |path: &Path| path.file_name().map(|name| name.to_string_lossy().into_owned());
    let absolute = path.canonicalize().ok().filter(|path| path.is_dir());
    let Some(absolute) = absolute.filter(|path| name(path).is_some_and(|n| n.starts_with("node-"))) else {
        return Vec::new();
    };
    let files = absolute.parent().and_then(|session| find(session).ok()).unwrap_or_default();
    let others = files.iter().filter(|files| files.path != absolute);
    others.filter_map(|files| RecordingReader::open(files, Extent::Outcomes).ok()).collect()
}

/// The result of writing a part of the copy.
type WriteResult<T> = Result<T, RecordError>;

/// Counts of added gap records, by cause.
fn by_cause(added: &[AddedGaps]) -> BTreeMap<GapCause, u64> {
    let mut counts = BTreeMap::new();
    for run in added {
        *counts.entry(run.cause).or_default() += run.last.0 - run.first.0 + 1;
    }
    counts
}
