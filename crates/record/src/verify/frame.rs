// SPDX-License-Identifier: MIT OR Apache-2.0
//! Frames as verification sees them: what they show of their instant, and the trigger they are recorded under.

use crate::matcher::block_ids::BlockIds;
use std::collections::BTreeMap;

/// Steps after which 16-bit ids repeat: they skip 0.
const CYCLE: i64 = 65_535;
/// What a frame itself shows of its instant.
#[derive(Debug, Clone, Copy)]
pub struct Seen {
    pub block: u64,
    /// Camera clock, ns; 0 without a timestamp.
    pub camera_ns: u64,
    /// Arrival of its first packet, host clock, ns.
    pub host_ns: u64,
}

/// What the frames of one camera show, by trigger.
pub type Times = BTreeMap<u64, Seen>;

/// A frame with its trigger's number (negative in the warm-up), and when that trigger was fired, HSU clock, ns.
#[derive(Debug, Clone, Copy)]
pub struct Frame {
    pub number: i64,
    /// When the trigger was fired, HSU clock, ns.
    pub hsu_ns: i128,
    pub seen: Seen,
}

/// How many more ids than triggers lie between two frames.
pub fn skipped(before: &Frame, frame: &Frame) -> i64 {
    let (from, to) = (before.seen.block, frame.seen.block);
    let triggers = frame.number.saturating_sub(before.number);
    let narrow = CYCLE as u64;
    if from > narrow || to > narrow {
        return BlockIds::default().between(from, to).saturating_sub(triggers);
    }
    // 16-bit ids wrap, once or several times, where many triggers lie between.
    let more = (to as i64 - from as i64 - triggers % CYCLE).rem_euclid(CYCLE);
    if more > CYCLE / 2 { more - CYCLE } else { more }
}

/// The recorded triggers of frames.
pub fn range_of(frames: &[Frame]) -> Option<(u64, u64)> {
    let mut recorded = frames.iter().filter_map(|frame| u64::try_from(frame.number).ok());
    let first = recorded.next()?;
    Some((first, recorded.next_back().unwrap_or(first)))
}
