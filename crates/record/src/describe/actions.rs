// SPDX-License-Identifier: MIT OR Apache-2.0
//! Results of each camera's action commands, and its PTP statuses.

use crate::action_counts::ActionCounts;
use crate::base::ids::CameraId;
use crate::layout::PTP_STATUS;
use crate::reader::RecordingReader;
use crate::time_scale::ScaleFound;
use serde::Serialize;
use std::collections::BTreeMap;

/// Results of the action commands of one camera.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct ActionDescription {
    pub camera: CameraId,
    /// Counts of all commands, those of the warm-up included.
    pub commands: ActionCounts,
}

/// The PTP statuses of a camera.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct PtpDescription {
    pub camera: CameraId,
    /// Each status, and how often it is recorded: when the session began, at each change, and when it ended.
    pub statuses: BTreeMap<String, u64>,
    /// Time scale of its clock; `None` where the clock was not read.
    #[serde(flatten)]
    pub scale: Option<ScaleFound>,
}

/// The cameras that were triggered by action commands, in the recording's order.
pub fn actions(recording: &RecordingReader) -> Vec<ActionDescription> {
    let of = |camera: &CameraId| {
        let mut own = recording.events.iter().filter(|event| event.camera.as_ref() == Some(camera));
        let commands = own.find_map(ActionCounts::of)?;
        Some(ActionDescription { camera: camera.clone(), commands })
    };
    recording.header.cameras.iter().filter_map(|camera| of(&camera.id)).collect()
}

/// The cameras in which PTP was on, in the recording's order.
pub fn ptp(recording: &RecordingReader) -> Vec<PtpDescription> {
    let of = |camera: &CameraId| {
        let own = recording.events.iter().filter(|event| event.camera.as_ref() == Some(camera));
        let mut statuses = BTreeMap::new();
        for event in own.filter(|event| event.kind == PTP_STATUS) {
            *statuses.entry(event.message.clone()).or_default() += 1;
        }
        let scale = ScaleFound::of(camera, &recording.clock_samples);
        (!statuses.is_empty()).then(|| PtpDescription { camera: camera.clone(), statuses, scale })
    };
    recording.header.cameras.iter().filter_map(|camera| of(&camera.id)).collect()
}
