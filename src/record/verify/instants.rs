//! Whether frame k is the same instant in all cameras: camera clocks against the HSU's, and the nodes' trigger tables
//! against each other.

use super::{Notes, Severity};
use crate::acquire::clock::{ClockFit, Exchange};
use crate::ids::{CameraId, TriggerIndex};
use crate::record::layout::{GapCause, TriggerRecord};
use crate::record::reader::{Outcome, RecordingReader};
use std::collections::BTreeMap;

/// Camera time by trigger.
pub type Times = BTreeMap<u64, u64>;

/// Where the recording itself says that a camera's clock began anew.
struct Resets<'a> {
    outcomes: Option<&'a BTreeMap<u64, Outcome>>,
    /// Triggers of events that say so.
    at: Vec<u64>,
    /// Such events that do not say where; each explains one step.
    anywhere: usize,
}

impl<'a> Resets<'a> {
    fn of(recording: &'a RecordingReader, camera: usize) -> Self {
        let id = recording.header.cameras.get(camera).map(|camera| &camera.id);
        let events = recording.events.iter();
        let mine: Vec<_> =
            events.filter(|e| e.kind == "camera_clock_reset" && e.camera.as_ref() == id).collect();
        Self {
            outcomes: recording.outcomes.get(camera),
            at: mine.iter().filter_map(|event| event.trigger.map(|trigger| trigger.0)).collect(),
            anywhere: mine.iter().filter(|event| event.trigger.is_none()).count(),
        }
    }

    /// Whether a step of the clock between two frames is one of them.
    fn explain(&mut self, before: u64, trigger: u64) -> bool {
        let between = |outcomes: &BTreeMap<u64, Outcome>| {
            // What stood where something is damaged now is not known any more.
            let gone = [GapCause::Unplugged, GapCause::ControlLost, GapCause::Damaged].map(Outcome::Gap);
            outcomes.range(before + 1..trigger).any(|(_, outcome)| gone.contains(outcome))
        };
        if self.outcomes.is_some_and(between) || self.at.iter().any(|at| (before + 1..=trigger).contains(at))
        {
            return true;
        }
        let explained = self.anywhere > 0;
        self.anywhere = self.anywhere.saturating_sub(1);
        explained
    }
}

/// The second witness: from frame to frame the camera's clock must advance as the HSU's does. Frames that
/// are far apart are not compared, since clocks drift; nor are those between which the recording says that the
/// camera was gone, or that its clock was set anew.
pub fn check_steps(recording: &RecordingReader, camera: usize, times: &Times, notes: &mut Notes) {
    const NEAR: u64 = 100;
    let id = recording.header.cameras.get(camera).map(|camera| &camera.id);
    let half_period_ns = (0.5e9 / recording.header.trigger_rate_hz) as u64;
    let mut resets = Resets::of(recording, camera);
    let hsu = |trigger: u64| recording.triggers.get(&TriggerIndex(trigger)).map(|row| row.hsu_time_ns);
    for ((&before, &time_before), (&trigger, &time)) in times.iter().zip(times.iter().skip(1)) {
        let mut add = |message| {
            if !resets.explain(before, trigger) {
                notes.add(Severity::Corrupt, None, id, Some((trigger, trigger)), message);
            }
        };
        let Some(camera_ns) = time.checked_sub(time_before).filter(|ns| *ns > 0) else {
            add(format!("its camera time {time} ns is not after that of trigger {before}, {time_before} ns"));
            continue;
        };
        let (Some(from), Some(to)) = (hsu(before), hsu(trigger)) else { continue };
        let hsu_ns = to.saturating_sub(from);
        if trigger - before <= NEAR && camera_ns.abs_diff(hsu_ns) > half_period_ns {
            add(format!(
                "{camera_ns} ns after trigger {before} by the camera's clock, {hsu_ns} ns by the HSU's: not the frame of this trigger"
            ));
        }
    }
}

/// A device's clock against the host's, from the recorded exchanges with it.
fn fit(recording: &RecordingReader, camera: Option<&CameraId>) -> Option<ClockFit> {
    let mut fit = ClockFit::new();
    for sample in recording.clock_samples.iter().filter(|sample| sample.camera.as_ref() == camera) {
        let (host_send_ns, host_receive_ns) = (sample.host_send_ns, sample.host_receive_ns);
        fit.exchange(&Exchange { host_send_ns, host_receive_ns, device_ns: sample.device_time_ns });
    }
    fit.is_ready().then_some(fit)
}

/// All frames of a camera could be those of the next trigger without a wrong step: the recorded exchanges with both
/// devices show when the last frames were exposed, by the HSU's clock. What the exchanges leave open is allowed for.
pub fn check_offset(recording: &RecordingReader, camera: usize, times: &Times, notes: &mut Notes) {
    const FRAMES: usize = 64;
    const ENOUGH: usize = 4;
    let Some(id) = recording.header.cameras.get(camera).map(|camera| &camera.id) else { return };
    let (Some(of_camera), Some(of_hsu)) = (fit(recording, Some(id)), fit(recording, None)) else { return };
    // A camera that was gone comes back with another clock.
    let gaps = recording.outcomes.get(camera).into_iter().flatten();
    let last_gap =
        gaps.filter(|(_, outcome)| matches!(outcome, Outcome::Gap(_))).map(|(t, _)| *t).next_back();
    let last = times.range(last_gap.map_or(0, |gap| gap + 1)..).rev().take(FRAMES);
    let mut late: Vec<(i128, u64)> = last
        .filter_map(|(trigger, camera_ns)| {
            let hsu_ns = i128::from(recording.triggers.get(&TriggerIndex(*trigger))?.hsu_time_ns);
            let camera_ns = i128::from(*camera_ns);
            let ns = of_camera.host_from_device(camera_ns)? - of_hsu.host_from_device(hsu_ns)?;
            let open = of_camera.uncertainty_ns(camera_ns)?.checked_add(of_hsu.uncertainty_ns(hsu_ns)?)?;
            Some((ns, open))
        })
        .collect();
    late.sort_unstable();
    let Some(&(ns, open)) = late.get(late.len() / 2).filter(|_| late.len() >= ENOUGH) else { return };
    let half_period_ns = (0.5e9 / recording.header.trigger_rate_hz) as u128;
    if ns.unsigned_abs() > half_period_ns + u128::from(open) {
        let (first, last) = (times.keys().next().copied(), times.keys().next_back().copied());
        let message = format!(
            "its last frames were exposed {:.3} ms after their triggers, by the recorded exchanges with both clocks (which leave {:.3} ms open): not the frames of these triggers",
            ns as f64 / 1e6,
            open as f64 / 1e6
        );
        notes.add(Severity::Corrupt, None, Some(id), first.zip(last), message);
    }
}

/// Both nodes hear the same HSU: a trigger has one time, and one set of flags. Returns how many triggers both tables have,
/// and in how many the rows differ.
pub fn check_tables(first: &RecordingReader, other: &RecordingReader, notes: &mut Notes) -> (u64, u64) {
    let both =
        other.triggers.iter().filter_map(|(index, row)| Some((index.0, row, first.triggers.get(index)?)));
    let (mut rows, mut differ) = (0, Vec::new());
    for (index, found, expected) in both {
        rows += 1;
        if (found.hsu_time_ns, found.flags) != (expected.hsu_time_ns, expected.flags) {
            differ.push((index, found, expected));
        }
    }
    if let (Some((index, found, expected)), Some((last, ..))) = (differ.first(), differ.last()) {
        let (count, node) = (differ.len(), &first.header.node);
        let told = |row: &TriggerRecord| format!("{} ns with flags {:#x}", row.hsu_time_ns, row.flags);
        let message = format!(
            "{count} triggers have another HSU time than on node {node}; trigger {index}: {}, there {}",
            told(found),
            told(expected)
        );
        notes.add(Severity::Corrupt, None, None, Some((*index, *last)), message);
    }
    (rows, differ.len() as u64)
}
