// SPDX-License-Identifier: MIT OR Apache-2.0
//! Why a frame that arrived is a gap, and how often frames of a camera were not what was agreed.

use crate::camera::{Breach, Transfer};
use crate::record::GapCause;

/// So many kinds of a camera's breaches are told apart; more are gaps without an event of their own.
const KINDS: usize = 8;

/// How frames of a camera broke their contract, and how many.
#[derive(Debug, Default)]
pub struct Breaches(Vec<(Breach, u64)>);

impl Breaches {
    /// Counts one; says whether it is the first of its kind.
    pub fn count(&mut self, breach: Breach) -> bool {
        if let Some((_, count)) = self.0.iter_mut().find(|(known, _)| *known == breach) {
            *count += 1;
            return false;
        }
        let told = self.0.len() < KINDS;
        if told {
            self.0.push((breach, 1));
        }
        told
    }

    /// What there was of each kind more than once.
    pub fn summary(self) -> impl Iterator<Item = String> {
        let many = self.0.into_iter().filter(|(_, count)| *count > 1);
        many.map(|(breach, count)| format!("{count} frames are not recorded: {breach}"))
    }
}

/// The cause of the gap that stands for a frame; `None` where it is recorded.
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
