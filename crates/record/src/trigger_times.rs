// SPDX-License-Identifier: MIT OR Apache-2.0
//! When the triggers of a session were: by the HSU's own clock, put on the clock of a node.
//!
//! From trigger to trigger the HSU's times are right to a microsecond; arrivals of reports and frames are late by
//! whatever held them up. So the table gives the rhythm, and the one report that was held up least places it on the
//! host's clock.

use super::layout::TriggerRecord;
use super::reader::RecordingReader;
use super::time_scale::host_scale;
use crate::base::ids::TriggerIndex;

/// Where the trigger table lies on a host's clock: the recording that has it, and host time minus HSU time of the
/// report that arrived soonest, ns. `None` where no recording has a table, as of imported images: then times are
/// nominal, from the creation of the first recording on.
#[derive(Debug)]
pub(super) struct TriggerTimes(Option<(usize, i128)>);

impl TriggerTimes {
    pub(super) fn of(recordings: &[RecordingReader]) -> Self {
        let delay = |row: &TriggerRecord| i128::from(row.host_time_ns) - i128::from(row.hsu_time_ns);
        let least = |recording: &RecordingReader| recording.triggers.values().map(delay).min();
        let mut tables = recordings.iter().enumerate();
        Self(tables.find_map(|(place, one)| Some((place, least(one)?))))
    }

    /// Host time of a trigger, ns since 1970. One that no node has in its table lies whole nominal periods from its
    /// neighbour.
    pub(super) fn at(&self, recordings: &[RecordingReader], trigger: TriggerIndex) -> Option<u64> {
        let Some((recording, host_minus_hsu_ns)) = self.0 else {
            let header = &recordings.first()?.header;
            let since = (trigger.0 as f64 * 1e9 / header.trigger_rate_hz).round() as u64;
            return header.created_ns.checked_add(since);
        };
        // All nodes receive the reports of the same HSU, and what one of them missed another may have.
        let known = recordings.iter().find_map(|recording| recording.triggers.get(&trigger));
        let hsu_ns = known.map(|row| i128::from(row.hsu_time_ns)).or_else(|| {
            let recording = recordings.get(recording)?;
            let before = recording.triggers.range(..trigger).next_back();
            let (near, row) = before.or_else(|| recording.triggers.range(trigger..).next())?;
            let periods = trigger.0 as f64 - near.0 as f64;
            Some(
                i128::from(row.hsu_time_ns)
                    + (periods * 1e9 / recording.header.trigger_rate_hz).round() as i128,
            )
        });
        u64::try_from(hsu_ns? + host_minus_hsu_ns).ok()
    }

    /// Describes the clock that the times are of.
    pub(super) fn name(&self, recordings: &[RecordingReader]) -> String {
        let (place, _) = self.0.unwrap_or_default();
        let Some(header) = recordings.get(place).map(|one| &one.header) else { return String::new() };
        let (clock, node) = (host_scale(&header.host_clock), &header.node);
        match self.0 {
            Some(_) => {
                format!("the HSU's times, put on {clock} of node {node} by the report that arrived soonest")
            }
            None => format!(
                "trigger index at {} Hz since the recording of node {node} was created ({clock})",
                header.trigger_rate_hz
            ),
        }
    }
}
