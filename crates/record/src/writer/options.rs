// SPDX-License-Identifier: MIT OR Apache-2.0
//! What can be chosen about how a recording is written.

use std::time::Duration;

/// Sizes and intervals of the segments of a recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WriterOptions {
    /// A segment is closed at the first trigger after this many bytes.
    pub segment_bytes: u64,
    /// Frames are no longer accepted when less than this is free; gap records and verdict still are.
    pub reserve_bytes: u64,
    /// `fdatasync` after this many bytes at the latest.
    pub sync_bytes: u64,
    /// `fdatasync` after this time at the latest; at most a second.
    pub sync_interval: Duration,
    /// Whether a segment's disk space is set aside before it is used.
    pub preallocate: bool,
}

impl WriterOptions {
    /// What would break a promise.
    pub(super) fn check(&self) -> Result<(), String> {
        if self.sync_interval > Duration::from_secs(1) {
            let found = self.sync_interval.as_millis();
            return Err(format!(
                "sync_interval is {found} ms, expected at most 1000: it bounds what a power cut costs"
            ));
        }
        if self.sync_bytes == 0 || self.segment_bytes == 0 {
            let (sync, segment) = (self.sync_bytes, self.segment_bytes);
            return Err(format!("sync_bytes is {sync} and segment_bytes {segment}, expected at least 1"));
        }
        Ok(())
    }
}

impl Default for WriterOptions {
    fn default() -> Self {
        Self {
            segment_bytes: 16 << 30,
            reserve_bytes: 1 << 30,
            sync_bytes: 512 << 20,
            sync_interval: Duration::from_millis(500),
            preallocate: true,
        }
    }
}
