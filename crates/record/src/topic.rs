// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which kind of record a channel of a segment carries.

use super::layout::{CLOCK_TOPIC, EVENTS_TOPIC, GAPS_TOPIC, RecordingHeader, TRIGGERS_TOPIC, image_topic};
use std::collections::BTreeMap;

/// The kind of records that a channel carries.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Topic {
    /// Frames of the camera at this place in the header.
    Image(usize),
    Gaps,
    Triggers,
    Clock,
    Events,
    /// The frame index, and what later versions add.
    Other,
}

/// What the channels of a segment carry, as far as they are announced.
pub(crate) struct Topics {
    images: Vec<String>,
    channels: BTreeMap<u16, Topic>,
}

impl Topics {
    pub(crate) fn of(header: &RecordingHeader) -> Self {
        let images = header.cameras.iter().map(|camera| image_topic(&camera.id)).collect();
        Self { images, channels: BTreeMap::new() }
    }

    /// Takes note of a channel.
    pub(crate) fn announce(&mut self, channel: u16, topic: &str) {
        let topic = match topic {
            GAPS_TOPIC => Topic::Gaps,
            TRIGGERS_TOPIC => Topic::Triggers,
            CLOCK_TOPIC => Topic::Clock,
            EVENTS_TOPIC => Topic::Events,
            _ => self.images.iter().position(|image| image == topic).map_or(Topic::Other, Topic::Image),
        };
        self.channels.insert(channel, topic);
    }

    pub(crate) fn carried_by(&self, channel: u16) -> Topic {
        self.channels.get(&channel).copied().unwrap_or(Topic::Other)
    }
}
