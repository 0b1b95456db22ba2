// SPDX-License-Identifier: MIT OR Apache-2.0
//! Recomputes everything that a recording claims from the files alone.
//!
//! Nothing stored is assumed to be right: every checksum is computed again, outcomes are counted from the records, the
//! stored verdict has to be what comes out, each frame's sources have to agree on its trigger, and so have the nodes of
//! a session.

mod accounting;
mod agreement;
mod explained;
mod findings;
mod frame;
mod header;
mod readings;
mod rhythm;
mod rows;
mod segment;
mod simultaneous;
mod table;
mod witnesses;

use super::files::{ReadError, node_of_dir};
use super::reader::RecordingReader;
use super::session::open_each;
use super::verdict::Verdict;
pub use agreement::{Comparison, compare};
use findings::Notes;
pub use findings::{Finding, Severity};
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

/// One node's recording as it is.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct RecordingReport {
    pub node: String,
    pub path: PathBuf,
    pub bytes: u64,
    /// The verdict, counted from the records again.
    pub verdict: Verdict,
}

/// What `verify` found in a session, a recording or a segment.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Report {
    pub path: PathBuf,
    /// The worst finding that is more than a note.
    pub worst: Option<Severity>,
    /// Whether it is a single segment, of which only the integrity is checked.
    pub single_segment: bool,
    /// Whether images were imported: which trigger one is of rests on its file's name.
    pub imported: bool,
    pub recordings: Vec<RecordingReport>,
    /// The nodes against each other.
    pub compared: Vec<Comparison>,
    /// In the order of node, segment, trigger.
    pub findings: Vec<Finding>,
    /// Findings that are not listed, because there are too many.
    pub findings_omitted: usize,
}

impl Report {
    /// Whether something is not confirmed: which trigger frames are of, or that they were taken as agreed.
    pub fn is_unconfirmed(&self) -> bool {
        self.findings.iter().any(|finding| finding.severity == Severity::Unconfirmed)
    }
}

/// Verifies a session, one recording, or one segment (then only its integrity).
///
/// `progress` is called from several threads with the bytes done and the bytes in all.
pub fn verify(path: &Path, progress: &(dyn Fn(u64, u64) + Sync)) -> Result<Report, ReadError> {
    let (readers, unreadable) = open_each(path)?;
    let single_segment = path.is_file();
    let total = readers.iter().map(RecordingReader::bytes).sum();
    let done = AtomicU64::new(0);
    let advance = |bytes: u64| progress(done.fetch_add(bytes, Ordering::Relaxed) + bytes, total);
    let mut notes = Notes::new("");
    let mut recordings = Vec::new();
    for one in &unreadable {
        notes.node.clone_from(&one.node);
        notes.add(Severity::Corrupt, None, None, None, &one.reason);
    }
    for recording in &readers {
        let node = recording.header.node.as_str();
        let mut own = Notes::new(node);
        for problem in &recording.problems {
            let trigger = problem.trigger.map(|t| (t.0, t.0));
            let segment = Some(problem.segment);
            own.add(Severity::Corrupt, segment, problem.camera.as_ref(), trigger, &problem.message);
        }
        if let Some(named) = node_of_dir(&recording.path).filter(|named| named != node) {
            let message = format!("its recording lies in the directory of node {named}");
            own.add(Severity::Corrupt, None, None, None, message);
        }
        let times = segment::check(recording, &mut own, &advance);
        header::check(recording, &mut own);
        let mut witnessed = Notes::new(node);
        witnesses::check(recording, &times, !single_segment, &mut witnessed);
        if single_segment {
            // What would confirm its frames may be in other segments.
            witnessed.leave_out_unconfirmed();
        }
        own.absorb(witnessed);
        let verdict = accounting::recount(recording);
        if single_segment {
            own.add(Severity::Note, None, None, None, "a single segment: integrity checked, outcomes not");
        } else {
            accounting::check(recording, &verdict, &mut own);
            simultaneous::check(recording, &mut own);
        }
        notes.absorb(own);
        let (path, bytes) = (recording.path.clone(), recording.bytes());
        recordings.push(RecordingReport { node: node.to_owned(), path, bytes, verdict });
    }
    let here: Vec<&RecordingReader> = readers.iter().collect();
    let verdicts: Vec<&Verdict> = recordings.iter().map(|report| &report.verdict).collect();
    let compared = agreement::check(&here, &verdicts, &mut notes);
    let unreadable: Vec<&str> = unreadable.iter().map(|one| one.node.as_str()).collect();
    agreement::note_absent(&here, &unreadable, &mut notes);
    Ok(Report {
        path: path.to_owned(),
        worst: notes.worst,
        single_segment,
        imported: readers.iter().any(|recording| recording.header.hsu.is_none()),
        recordings,
        compared,
        findings: notes.findings,
        findings_omitted: notes.omitted,
    })
}

#[cfg(test)]
mod tests;
