// SPDX-License-Identifier: MIT OR Apache-2.0
//! Room on the disk: whether a session fits, when to stop, and what to set aside.

use super::Recording;
use super::error::RecordError;
use super::options::WriterOptions;
use super::segments::{NextSegment, OpenSegment};
use crate::direct_io::free_bytes;
use std::path::Path;

const MIB: u64 = 1 << 20;
/// What segments need beyond pixels (headers, indexes, gap records), for the space check.
const ACCOUNTING_BYTES: u64 = 16 << 20;
/// Disk space that is set aside for a segment at most.
const MOST_AHEAD: u64 = 4 << 30;
/// Checks of the free space while as many bytes as the reserve are written, at least.
const CHECKS: u64 = 4;

impl Recording {
    /// Whether enough was written since the last check that a small reserve may be used up before the next sync.
    pub(super) fn is_check_due(&self) -> bool {
        self.options.reserve_bytes > 0 && self.unchecked >= self.options.reserve_bytes / CHECKS
    }

    /// Stops the recording of frames when the reserve is reached.
    pub(super) fn check_free_space(&mut self) -> Result<(), RecordError> {
        self.unchecked = 0;
        // What is set aside for us counts as free.
        let free = free_bytes(&self.dir).unwrap_or(u64::MAX).saturating_add(self.set_aside());
        if free < self.options.reserve_bytes && self.stopped.is_none() {
            let (path, reserve_mib) = (self.dir.clone(), self.options.reserve_bytes / MIB);
            let error = RecordError::ReserveReached { path, free_mib: free / MIB, reserve_mib };
            self.stopped = Some(error.to_string());
            return Err(error);
        }
        Ok(())
    }

    /// Disk space set aside and not used yet.
    fn set_aside(&self) -> u64 {
        let next = self.next.as_ref().map_or(0, NextSegment::ahead);
        self.segments.iter().map(OpenSegment::ahead).fold(next, u64::saturating_add)
    }

    /// Space to set aside for a segment that begins when the session has `written` bytes: never more than it
    /// will need, and never of the reserve.
    pub(super) fn ahead(&self, written: u64) -> u64 {
        if !self.options.preallocate || self.stopped.is_some() {
            return 0;
        }
        let expected = self.header.expected_bytes().map_or(u64::MAX, |bytes| bytes.saturating_sub(written));
        let kept = self.options.reserve_bytes.saturating_add(ACCOUNTING_BYTES);
        let free = free_bytes(&self.dir).unwrap_or(0).saturating_sub(kept);
        // Other recorders on the same disk must not find it full because of what is only set aside.
        let most = expected.min(free / 8).min(MOST_AHEAD);
        self.options.segment_bytes.saturating_add(self.options.segment_bytes / 64).min(most)
    }
}

/// Refuses a session of `bytes` bytes of frames if it would not fit.
pub(super) fn check_space(dir: &Path, bytes: u64, options: &WriterOptions) -> Result<(), RecordError> {
    let free = free_bytes(dir).map_err(|source| RecordError::Disk { path: dir.to_owned(), source })?;
    let needed = bytes.saturating_add(ACCOUNTING_BYTES);
    if needed.saturating_add(options.reserve_bytes) > free {
        return Err(RecordError::NoSpace {
            path: dir.to_owned(),
            needed_mib: needed.div_ceil(MIB),
            reserve_mib: options.reserve_bytes / MIB,
            free_mib: free / MIB,
        });
    }
    Ok(())
}
