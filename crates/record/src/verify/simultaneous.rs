// SPDX-License-Identifier: MIT OR Apache-2.0
//! Whether exposures that were scheduled by PTP rest on a clock that PTP kept: found out from the recorded statuses and
//! times, independent of what the node concluded.

use super::findings::{Notes, Severity};
use crate::base::ids::CameraId;
use crate::layout::{ACTION_UNIT, ACTIONS_AT_ONCE, PTP_STATUS, ptp_keeps};
use crate::reader::RecordingReader;
use crate::simultaneous::{TriggerRow, TriggerRows};

/// Each trigger within a recorded loss of PTP has to be named as not simultaneous.
pub fn check(recording: &RecordingReader, notes: &mut Notes) {
    let by_actions = recording.header.hsu.as_ref().is_some_and(|hsu| hsu.uid.as_bytes() == ACTION_UNIT);
    // Triggers by wire, and actions at once, rest on no clock of the cameras.
    if !by_actions || recording.events.iter().any(|event| event.kind == ACTIONS_AT_ONCE) {
        return;
    }
    for camera in &recording.header.cameras {
        for row in unnamed(recording, &camera.id).iter() {
            let message = "PTP did not keep its clock meanwhile (events ptp_status), and no event states that these \
                exposures were not simultaneous with those of the others";
            notes.add(Severity::Unconfirmed, None, Some(&camera.id), Some((row.first, row.last)), message);
        }
    }
}

/// Triggers while the camera's recorded status was neither Slave nor Master, less those that an event names.
fn unnamed(recording: &RecordingReader, camera: &CameraId) -> TriggerRows {
    let own = || recording.events.iter().filter(|event| event.camera.as_ref() == Some(camera));
    let mut named = TriggerRows::default();
    own().filter_map(TriggerRow::of).for_each(|(row, _)| named.add(row));
    // A status holds up to the next one, host clock.
    let mut statuses: Vec<_> = own().filter(|event| event.kind == PTP_STATUS).collect();
    statuses.sort_by_key(|event| event.host_time_ns);
    let is_kept = |at: u64| {
        let begun = statuses.partition_point(|event| event.host_time_ns <= at);
        statuses[..begun].last().is_none_or(|event| ptp_keeps(&event.message))
    };
    let mut found = TriggerRows::default();
    let rows = || recording.triggers.iter();
    let host_minus_unit =
        rows().map(|(_, row)| i128::from(row.host_time_ns) - i128::from(row.hsu_time_ns)).min().unwrap_or(0);
    for (trigger, row) in rows() {
        let at = u64::try_from(i128::from(row.hsu_time_ns) + host_minus_unit).unwrap_or(0);
        if !is_kept(at) && !named.covers(trigger.0) {
            found.add(TriggerRow::all(trigger.0, trigger.0));
        }
    }
    found
}
