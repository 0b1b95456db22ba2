//! Recomputes everything that a recording claims from the files alone.
//!
//! Nothing stored is believed: every checksum is computed again, outcomes are counted from the records, the
//! stored verdict has to be what comes out, and the nodes of a session have to agree.

mod accounting;
mod instants;
mod segment;

use super::reader::{ReadError, RecordingReader};
use super::session::{SessionReader, parse_rig};
use super::verdict::Verdict;
use crate::ids::CameraId;
use serde::Serialize;
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

/// Findings beyond this many are counted, not listed.
const MAX_FINDINGS: usize = 10_000;

/// How bad a finding is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Severity {
    /// Worth knowing; nothing is wrong.
    Note,
    /// Data is missing, and the recording says what and why.
    Loss,
    /// Data is damaged, contradicts itself, or is missing without a word.
    Corrupt,
}

/// One thing that was found.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// How bad it is.
    pub severity: Severity,
    /// The node.
    pub node: String,
    /// The segment's number.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub segment: Option<u32>,
    /// The camera.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub camera: Option<CameraId>,
    /// First and last trigger concerned.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub triggers: Option<(u64, u64)>,
    /// What was expected and found.
    pub message: String,
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let word = match self.severity {
            Severity::Note => "note",
            Severity::Loss => "loss",
            Severity::Corrupt => "corrupt",
        };
        write!(f, "{word}: node {}", self.node)?;
        if let Some(segment) = self.segment {
            write!(f, " segment {segment}")?;
        }
        if let Some(camera) = &self.camera {
            write!(f, " camera {camera}")?;
        }
        match self.triggers {
            Some((first, last)) if first == last => write!(f, " trigger {first}")?,
            Some((first, last)) => write!(f, " triggers {first} to {last}")?,
            None => {}
        }
        write!(f, ": {}", self.message)
    }
}

/// One node's recording as it is.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct RecordingReport {
    /// The node.
    pub node: String,
    /// Its directory.
    pub path: PathBuf,
    /// Bytes of all segments.
    pub bytes: u64,
    /// Counted from the records.
    pub verdict: Verdict,
}

/// What `verify` found.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Report {
    /// What was verified.
    pub path: PathBuf,
    /// The worst finding that is more than a note.
    pub worst: Option<Severity>,
    /// Per node.
    pub recordings: Vec<RecordingReport>,
    /// In the order of node, segment, trigger.
    pub findings: Vec<Finding>,
    /// Findings that are not listed, because there are too many.
    pub findings_omitted: usize,
}

/// Findings of one recording in the making.
struct Notes {
    node: String,
    findings: Vec<Finding>,
    omitted: usize,
    worst: Option<Severity>,
}

impl Notes {
    fn new(node: &str) -> Self {
        Self { node: node.to_owned(), findings: Vec::new(), omitted: 0, worst: None }
    }

    fn add(
        &mut self,
        severity: Severity,
        segment: Option<u32>,
        camera: Option<&CameraId>,
        triggers: Option<(u64, u64)>,
        message: impl Into<String>,
    ) {
        if severity > Severity::Note {
            self.worst = self.worst.max(Some(severity));
        }
        if self.findings.len() >= MAX_FINDINGS {
            self.omitted += 1;
            return;
        }
        let (node, camera, message) = (self.node.clone(), camera.cloned(), message.into());
        self.findings.push(Finding { severity, node, segment, camera, triggers, message });
    }

    fn absorb(&mut self, other: Self) {
        self.worst = self.worst.max(other.worst);
        let room = MAX_FINDINGS.saturating_sub(self.findings.len());
        self.omitted += other.omitted + other.findings.len().saturating_sub(room);
        self.findings.extend(other.findings.into_iter().take(room));
    }
}

/// Verifies a session, one recording, or one segment (then only its integrity).
///
/// `progress` is called from several threads with the bytes done and the bytes in all.
pub fn verify(path: &Path, progress: &(dyn Fn(u64, u64) + Sync)) -> Result<Report, ReadError> {
    let session = SessionReader::open(path)?;
    let single_segment = path.is_file();
    let length = |recording: &RecordingReader| -> u64 {
        recording.segments.iter().map(|segment| segment.bytes().len() as u64).sum()
    };
    let total = session.recordings().iter().map(length).sum();
    let done = AtomicU64::new(0);
    let advance = |bytes: u64| progress(done.fetch_add(bytes, Ordering::Relaxed) + bytes, total);
    let mut notes = Notes::new("");
    let mut recordings = Vec::new();
    for recording in session.recordings() {
        let node = recording.header.node.as_str();
        let mut own = Notes::new(node);
        for problem in &recording.problems {
            let trigger = problem.trigger.map(|t| (t.0, t.0));
            let segment = Some(problem.segment);
            own.add(Severity::Corrupt, segment, problem.camera.as_ref(), trigger, &problem.message);
        }
        segment::check(recording, &mut own, &advance);
        let verdict = accounting::recount(recording);
        if single_segment {
            own.add(Severity::Note, None, None, None, "a single segment: integrity checked, outcomes not");
        } else {
            accounting::check(recording, &verdict, &mut own);
        }
        notes.absorb(own);
        let (path, bytes) = (recording.path.clone(), length(recording));
        recordings.push(RecordingReport { node: node.to_owned(), path, bytes, verdict });
    }
    check_agreement(&session, &recordings, &mut notes);
    Ok(Report {
        path: path.to_owned(),
        worst: notes.worst,
        recordings,
        findings: notes.findings,
        findings_omitted: notes.omitted,
    })
}

/// The nodes of one session must tell the same story.
fn check_agreement(session: &SessionReader, reports: &[RecordingReport], notes: &mut Notes) {
    let Some((first, others)) = session.recordings().split_first() else { return };
    for (recording, report) in others.iter().zip(reports.iter().skip(1)) {
        notes.node = recording.header.node.to_string();
        let (a, b) = (&first.header, &recording.header);
        let mut differs = |what: &str, found: String, expected: String| {
            if found != expected {
                let message = format!("{what} is {found}, but {expected} on node {}", a.node);
                notes.add(Severity::Corrupt, None, None, None, message);
            }
        };
        differs("the session's id", b.session_id.clone(), a.session_id.clone());
        differs("the session's name", b.session.to_string(), a.session.to_string());
        differs("the trigger rate", b.trigger_rate_hz.to_string(), a.trigger_rate_hz.to_string());
        let asked = |n: Option<u64>| n.map_or("until stop".to_owned(), |n| n.to_string());
        differs("the number of triggers asked for", asked(b.expected_triggers), asked(a.expected_triggers));
        let emitted = |v: &Verdict| v.triggers_emitted.map_or("missing".to_owned(), |n| n.to_string());
        let counts = [report.verdict.triggers_emitted, reports[0].verdict.triggers_emitted];
        // One that is missing has been found to be loss.
        if counts.iter().all(Option::is_some) {
            differs("the HSU's trigger count", emitted(&report.verdict), emitted(&reports[0].verdict));
        }
        differs(
            "the number of triggers",
            report.verdict.triggers.to_string(),
            reports[0].verdict.triggers.to_string(),
        );
        if a.rig_text != b.rig_text {
            let message = format!("its rig file differs from that of node {}", a.node);
            notes.add(Severity::Corrupt, None, None, None, message);
        }
        instants::check_tables(first, recording, notes);
        for camera in &b.cameras {
            if a.cameras.iter().any(|other| other.id == camera.id) {
                let message = format!("is recorded on node {} as well", a.node);
                notes.add(Severity::Corrupt, None, Some(&camera.id), None, message);
            }
        }
    }
    let Ok(rig) = parse_rig(&first.header.rig_text) else { return };
    let here = |node: &str| session.recordings().iter().any(|r| r.header.node.as_str() == node);
    for node in rig.nodes().iter().filter(|node| !here(node.as_str())) {
        notes.node = node.to_string();
        notes.add(Severity::Note, None, None, None, "its recording is not here; agreement was not checked");
    }
}
