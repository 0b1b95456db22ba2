// SPDX-License-Identifier: MIT OR Apache-2.0
//! Why a frame that arrived becomes a gap, and how often frames of a camera broke their contract.

use crate::camera::{Breach, Transfer};
use crate::record::GapCause;

/// Kinds of breaches that are counted per camera; further kinds become gaps without an event of their own.
const KINDS: usize = 8;

/// Counts of a camera's broken contracts, by kind.
#[derive(Debug, Default)]
pub struct Breaches(Vec<(Breach, u64)>);

impl Breaches {
    /// Counts a breach; `true` for the first of its kind.
    pub fn count(&mut self, breach: Breach) -> bool {
        if let Some((_, count)) = self.0.iter_mut().find(|(known, _)| *known == breach) {
            *count += 1;
            return false;
        }
        let is_new = self.0.len() < KINDS;
        if is_new {
            self.0.push((breach, 1));
        }
        is_new
    }

    /// A line for each kind that occurred more than once.
    pub fn summary(self) -> impl Iterator<Item = String> {
        let many = self.0.into_iter().filter(|(_, count)| *count > 1);
        many.map(|(breach, count)| format!("{count} frames are not recorded: {breach}"))
    }
}

/// The cause of the gap record in place of a frame; `None` where the frame is recorded.
pub fn gap_cause(transfer: Transfer) -> Option<GapCause> {
    match transfer {
        Transfer::Complete => None,
        Transfer::MissingPackets | Transfer::Unwritten => Some(GapCause::MissingPackets),
        Transfer::Timeout => Some(GapCause::Timeout),
        Transfer::Breach(
            Breach::Payload(_) | Breach::PixelFormat { .. } | Breach::TooLarge(_) | Breach::Chunks { .. },
        ) => Some(GapCause::WrongFormat),
        Transfer::SizeMismatch | Transfer::Breach(_) => Some(GapCause::SizeMismatch),
        Transfer::Aborted => Some(GapCause::Aborted),
    }
}
