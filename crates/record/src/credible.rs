// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a recording may claim: numbers that its bytes cannot hold are named, and cost nothing.

use super::layout::{Entries, MAX_TRIGGERS, RecordingHeader};
use super::reader::{RecordingReader, SegmentReader};
use crate::base::ids::TriggerIndex;

/// Triggers that are credible for as many bytes: each of them left a frame or a gap record, or its records in a segment
/// of which the others have records. So what is read or written for a recording stays within its size.
pub(super) fn most_triggers(bytes: u64) -> u64 {
    const FLOOR: u64 = 1 << 16;
    const BYTES_EACH: u64 = 64;
    FLOOR + bytes / BYTES_EACH
}

impl RecordingReader {
    /// Leaves out what lies so far behind the beginning that its bytes cannot hold the outcomes between, and names it.
    pub(super) fn leave_out_the_incredible(&mut self) {
        let bytes = self.bytes();
        let start = self.segments.iter().map(|segment| segment.first_trigger).min().unwrap_or(0);
        let end = start.min(MAX_TRIGGERS).saturating_add(most_triggers(bytes));
        let last = self.triggers_end();
        let Some(segment) = self.segments.first().map(|segment| segment.number).filter(|_| last > end) else {
            return;
        };
        let message = format!(
            "records of triggers {end} to {} are left out: a recording of {bytes} bytes cannot have that many triggers",
            last - 1
        );
        self.problem(segment, None, Some(last - 1), message);
        self.outcomes.iter_mut().for_each(|outcomes| drop(outcomes.split_off(&end)));
        drop(self.triggers.split_off(&TriggerIndex(end)));
        if let Some(verdict) = &mut self.verdict {
            verdict.triggers = verdict.triggers.min(end);
        }
    }

    /// Checks what a segment's metadata states beside its header: the same names, and triggers that a session can have.
    pub(super) fn check_names(
        &mut self,
        segment: &SegmentReader,
        entries: &Entries,
        header: &RecordingHeader,
    ) {
        let names = [
            ("session", header.session.as_str()),
            ("session_id", header.session_id.as_str()),
            ("node", header.node.as_str()),
        ];
        for (key, expected) in names {
            if let Some(found) = entries.get(key).filter(|found| *found != expected) {
                let message = format!("its metadata states {key} {found:?}, its header {expected:?}");
                self.wrong(segment.number, message);
            }
        }
        if segment.first_trigger > MAX_TRIGGERS {
            let message = format!(
                "it states that it begins at trigger {}: no session has more than {MAX_TRIGGERS}",
                segment.first_trigger
            );
            self.wrong(segment.number, message);
        }
    }
}
