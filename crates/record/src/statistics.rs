// SPDX-License-Identifier: MIT OR Apache-2.0
//! How the disk kept up: latencies in logarithmic classes, cheap enough for every frame.

use crate::base::histogram::Histogram;
pub use crate::base::histogram::Latency;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::sync::atomic::AtomicU64;

/// Counted while a recording is written; other threads may read it meanwhile.
#[derive(Debug, Default)]
pub struct DiskProgress {
    /// From a frame's handing over until it is in the file.
    pub written: Histogram,
    /// From a frame's handing over until it survives a power cut.
    pub durable: Histogram,
    /// Bytes of frames handed over.
    pub bytes: AtomicU64,
}

/// How bytes go to the disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DiskAccess {
    /// Past the page cache (`O_DIRECT`).
    Direct,
    /// Through the page cache: the file system refuses `O_DIRECT`.
    PageCache,
}

impl fmt::Display for DiskAccess {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Direct => "past the page cache (O_DIRECT)",
            Self::PageCache => "through the page cache (the file system refuses O_DIRECT)",
        })
    }
}

/// How the disk kept up with a recording.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct WriteStatistics {
    /// Frames handed over and not refused.
    pub frames: u64,
    /// Bytes of all segments, without what closes the last one.
    pub bytes: u64,
    /// From a frame's handing over until it is in the file.
    pub written: Latency,
    /// From a frame's handing over until it survives a power cut.
    pub durable: Latency,
    /// Frame blocks that the writer held at the same time, at most.
    pub blocks_high_water: usize,
    /// Frames in blocks that were copied, because they were not where the disk can take them.
    pub copied_frames: u64,
    /// How the segments were written, the last one to be opened; not known of older recordings.
    #[serde(default)]
    pub access: Option<DiskAccess>,
}
