// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which kind of record a channel of a segment carries.

use super::layout::{CLOCK_TOPIC, EVENTS_TOPIC, GAPS_TOPIC, TRIGGERS_TOPIC};

/// What a channel carries.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Topic {
    /// Frames of the camera at this place in the header.
    Image(usize),
    /// Gap records.
    Gaps,
    /// The trigger table.
    Triggers,
    /// Clock samples.
    Clock,
    /// Events.
    Events,
    /// The frame index, and what later versions add.
    Other,
}

impl Topic {
    pub(crate) fn of(topic: &str, images: &[String]) -> Self {
        match topic {
            GAPS_TOPIC => Self::Gaps,
            TRIGGERS_TOPIC => Self::Triggers,
            CLOCK_TOPIC => Self::Clock,
            EVENTS_TOPIC => Self::Events,
            _ => images.iter().position(|image| image == topic).map_or(Self::Other, Self::Image),
        }
    }
}
