// SPDX-License-Identifier: MIT OR Apache-2.0
//! The kinds of events that a node's threads put into a recording.

use crate::base::ids::CameraId;
use crate::record::NodeEvent;
use serde::Serialize;
use std::fmt;

/// What an event is about. The serialized names are part of the recording's format: readers search for them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum EventKind {
    ActionCommands,
    CameraBack,
    CameraHeardAgain,
    CameraLost,
    CameraOwned,
    CameraRefused,
    CameraSetting,
    CameraSilent,
    HsuEventsDropped,
    HsuFault,
    HsuInputLevels,
    HsuInputsLost,
    HsuLinkBack,
    HsuLinkLost,
    HsuLost,
    NoCameraClock,
    NodeAsleep,
    NodeNotAsked,
    PlaceFound,
    PtpStatus,
    RingFull,
    SettingChanged,
    StreamCounters,
    TimeCodeAbsent,
    TimeCodeLost,
    TimeCodeRefused,
    TriggersMissing,
}

impl fmt::Display for EventKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

impl EventKind {
    /// An event of this kind at a time of the session's host clock, ns.
    pub fn event(self, host_time_ns: u64, camera: Option<CameraId>, message: impl Into<String>) -> NodeEvent {
        NodeEvent { host_time_ns, kind: self.to_string(), camera, trigger: None, message: message.into() }
    }
}

/// Logs an event as a warning; the caller puts it into the recording.
pub fn warn(event: &NodeEvent) {
    let (camera, trigger) = (event.camera.as_ref(), event.trigger.map(|trigger| trigger.0));
    tracing::warn!(
        camera = camera.map(tracing::field::display),
        trigger,
        kind = event.kind,
        "{}",
        event.message
    );
}

#[cfg(test)]
mod tests {
    use super::EventKind;
    use crate::record::{ACTION_COMMANDS, NOT_ASKED, PTP_STATUS, SETTING_CHANGED};

    #[test]
    fn kinds_have_the_names_that_readers_of_recordings_search_for() {
        let shared = [
            (EventKind::ActionCommands, ACTION_COMMANDS),
            (EventKind::NodeNotAsked, NOT_ASKED),
            (EventKind::PtpStatus, PTP_STATUS),
            (EventKind::SettingChanged, SETTING_CHANGED),
            (EventKind::CameraBack, "camera_back"),
            (EventKind::CameraHeardAgain, "camera_heard_again"),
            (EventKind::NoCameraClock, "no_camera_clock"),
        ];
        for (kind, name) in shared {
            assert_eq!(kind.to_string(), name);
        }
    }
}
