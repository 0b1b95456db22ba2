// SPDX-License-Identifier: MIT OR Apache-2.0
//! Counters and times of a session, which other threads read while the recorder runs.

use crate::base::histogram::Histogram;
use crate::record::GapCause;
use std::fmt;
use std::sync::atomic::{AtomicU64, Ordering};

/// Counters that other threads read while the recorder runs. Lists have one entry per camera, in the node's order.
#[derive(Debug, Default)]
pub struct Progress {
    /// Triggers reported; where frames are held, those from the recording's first on.
    pub triggers: AtomicU64,
    /// The oldest trigger whose frames are held before Record.
    pub held_from: AtomicU64,
    /// One more than the newest trigger whose frames are held before Record.
    pub held_to: AtomicU64,
    /// Room for held frames, of all cameras together.
    pub held_room: AtomicU64,
    /// Packets received from each camera, or frames where the transport has no packets.
    pub activity: Vec<AtomicU64>,
    /// Frames taken from each camera's stream, complete or not.
    pub received: Vec<AtomicU64>,
    /// Frames written to the recording, per camera.
    pub frames: Vec<AtomicU64>,
    /// Gap records written, per camera.
    pub gaps: Vec<AtomicU64>,
    /// Gap records written per camera and cause, in the order of [`GapCause::ALL`].
    pub causes: Vec<[AtomicU64; GapCause::ALL.len()]>,
    /// Turns of the matching thread: the count grows as long as the thread lives.
    pub recorder_turns: AtomicU64,
    /// Turns of the writer's thread: the count grows as long as the thread lives.
    pub writer_turns: AtomicU64,
    /// Most frames that were waiting at any time, in the ring or before it.
    pub high_water: AtomicU64,
    /// Most frames that were in the ring at any time, without those that are held for Record.
    pub ring_high_water: AtomicU64,
    /// Frames in the ring now, including those that are held for Record.
    pub ring: AtomicU64,
    /// Frames dropped because the ring was full.
    pub dropped: AtomicU64,
    /// Times that frames took, stage by stage.
    pub latencies: Latencies,
}

impl Progress {
    /// Frames that wait for the writer, without those that are held for Record.
    pub fn in_ring(&self) -> u64 {
        self.ring.load(Ordering::Relaxed).saturating_sub(self.held_room.load(Ordering::Relaxed))
    }

    /// Counts a gap record of a camera.
    pub(super) fn gap(&self, camera: usize, cause: GapCause) {
        if let Some((gaps, causes)) = self.gaps.get(camera).zip(self.causes.get(camera)) {
            gaps.fetch_add(1, Ordering::Relaxed);
            causes[cause as usize].fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Counters at zero for this number of cameras.
    pub fn new(cameras: usize) -> Self {
        let zeros = || (0..cameras).map(|_| AtomicU64::new(0)).collect();
        Self {
            activity: zeros(),
            received: zeros(),
            frames: zeros(),
            gaps: zeros(),
            causes: (0..cameras).map(|_| Default::default()).collect(),
            ..Self::default()
        }
    }
}

/// Times of the stages of a frame's way from the stream to the disk.
#[derive(Debug, Default)]
pub struct Latencies {
    /// From the stream until the frame's trigger is known.
    pub matched: Histogram,
    /// From there until the frame set entered the ring.
    pub assembled: Histogram,
    /// From there until the writer's thread had written the frame.
    pub written: Histogram,
    /// From the stream until the frame was written.
    pub total: Histogram,
}

impl fmt::Display for Latencies {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let stages = [
            ("matched", &self.matched),
            ("assembled", &self.assembled),
            ("written", &self.written),
            ("total", &self.total),
        ];
        let text = stages.map(|(stage, histogram)| {
            let (p50, p99) = (histogram.quantile_ms(0.5), histogram.quantile_ms(0.99));
            format!("{stage}: p50 {p50:.3} ms, p99 {p99:.3} ms, max {:.3} ms", histogram.max_ms())
        });
        f.write_str(&text.join("; "))
    }
}
