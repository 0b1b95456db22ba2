// SPDX-License-Identifier: MIT OR Apache-2.0
//! Faults of simulated disks, one JSON line each, and what a recording may state because of them.

use fourdbody::record::{GapCause, RecordingReader};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// A fault of a simulated disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DiskFault {
    /// The first write to a file that took longer than it had to.
    Slow,
    /// The first write to a file on a disk of limited size.
    Limited,
    /// A write was cut short or refused for want of room.
    Full,
    IoError,
}

/// A fault of a disk.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct DiskEvent {
    /// Node whose disk it is.
    pub disk: String,
    /// The file, below the sessions directory.
    pub path: String,
    pub kind: DiskFault,
    /// The call: `write`, `sync`, `create`, `truncate`, ...
    pub operation: String,
    /// Which such call to the disk it was, from 1 on; 0 where they are not counted.
    pub number: u64,
    /// Where in the file, of a write.
    pub offset: u64,
    /// How many bytes were to be written.
    pub bytes: u64,
    /// How many reached the file.
    pub taken: u64,
    /// Of a failed sync: how many bytes of the file were lost.
    pub lost: u64,
    /// The disk is gone: every change fails from here on.
    pub for_good: bool,
}

impl DiskEvent {
    /// A fault without any details beyond its kind.
    pub fn new(node: &str, path: &Path, kind: DiskFault, operation: &str) -> Self {
        Self {
            disk: node.to_owned(),
            path: path.display().to_string(),
            kind,
            operation: operation.to_owned(),
            number: 0,
            offset: 0,
            bytes: 0,
            taken: 0,
            lost: 0,
            for_good: false,
        }
    }

    /// Whether it happened to this recording.
    fn concerns(&self, recording: &RecordingReader) -> bool {
        let session = Path::new(&self.path).iter().next().and_then(|name| name.to_str());
        self.disk == recording.header.node.as_str() && session == Some(recording.header.session.as_str())
    }
}

/// What the disk explains of one recording.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Excuse {
    /// Whole frame sets may be missing: the ring was full.
    slow: bool,
    /// Frames may be missing from the failure on.
    failed: bool,
    /// The books may be missing: there was no room for them, or no disk.
    pub(super) no_books: bool,
}

impl Excuse {
    /// From what was written down.
    pub(super) fn of(events: &[DiskEvent], recording: &RecordingReader) -> Self {
        let mut excuse = Self::default();
        for event in events.iter().filter(|event| event.concerns(recording)) {
            match event.kind {
                DiskFault::Slow => excuse.slow = true,
                // The node stops by itself before the disk is full, and states so.
                DiskFault::Limited => {
                    let aborted = recording.verdict.as_ref().and_then(|verdict| verdict.aborted.as_deref());
                    excuse.failed |= aborted.is_some_and(|reason| reason.contains("the reserve is"));
                }
                DiskFault::Full => (excuse.failed, excuse.no_books) = (true, true),
                DiskFault::IoError => {
                    excuse.failed = true;
                    excuse.no_books |= event.for_good;
                }
            }
        }
        excuse
    }

    /// Whether this outcome is explained.
    pub(super) fn covers(self, found: &str) -> bool {
        let is = |cause: GapCause| found == cause.to_string();
        (self.slow && is(GapCause::DroppedRingFull)) || (self.failed && is(GapCause::DroppedDisk))
    }
}

/// What is wrong with the frames that were dropped for a slow disk: only whole sets may be, and an event must record
/// it.
pub(super) fn judge_dropped_sets(recording: &RecordingReader, outcomes: &[Vec<String>]) -> Vec<String> {
    let dropped = GapCause::DroppedRingFull.to_string();
    let triggers = outcomes.iter().map(Vec::len).max().unwrap_or(0);
    let at = |trigger: usize| outcomes.iter().filter_map(move |camera| camera.get(trigger));
    let any = |trigger: &usize| at(*trigger).any(|found| *found == dropped);
    let torn = |trigger: &usize| any(trigger) && at(*trigger).any(|found| found == super::truth::FRAME);
    let mut wrong: Vec<String> = (0..triggers)
        .filter(torn)
        .map(|trigger| format!("trigger {trigger}: a part of the frame set was dropped, a part recorded"))
        .collect();
    if (0..triggers).any(|trigger| any(&trigger)) && !recording.events.iter().any(|e| e.kind == "ring_full") {
        wrong.push("frame sets were dropped, but there is no event ring_full".to_owned());
    }
    wrong
}
