// SPDX-License-Identifier: MIT OR Apache-2.0
//! Descriptions of a recording: outcomes per camera, events by kind, clocks, segments, and what is missing.
//!
//! Nothing is checked here that opening a recording does not check; that is [`super::verify`].

mod actions;
mod sheet;

pub use actions::{ActionDescription, PtpDescription, actions, ptp};
pub use sheet::{Sheet, Table};

use super::layout::{CameraHeader, ClockSample, GapCause};
use super::reader::{Outcome, RecordingReader, SegmentReader};
use super::scan::End;
use super::time_code::TimeCodeLine;
use crate::base::clock_fit::{ClockFit, Exchange, RESET_RUN};
use crate::base::ids::{CameraId, TriggerIndex};
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};

/// Samples that the residual of a clock fit is computed from: the last ones, which the fit's window covers.
const RESIDUAL_SAMPLES: usize = 60;

/// Outcomes and settings of one camera.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CameraDescription {
    /// The camera in the recording's header: name (`id`), size, device, settings.
    #[serde(flatten)]
    pub header: CameraHeader,
    pub frames: u64,
    /// Triggers with a gap record, by cause.
    pub gaps: BTreeMap<GapCause, u64>,
    /// First trigger with a gap record, by cause.
    pub first_gaps: BTreeMap<GapCause, u64>,
    /// Triggers of the session without any outcome: the recording was interrupted, or is damaged.
    pub absent: u64,
    /// The first trigger without an outcome.
    pub first_absent: Option<u64>,
}

/// All events of one kind, with the first of them.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct EventKind {
    pub kind: String,
    pub count: u64,
    /// The lowest trigger that one of them names.
    pub first_trigger: Option<u64>,
    /// Host time of the first one, ns.
    pub first_host_time_ns: u64,
    pub first_message: String,
}

/// Time code of the session's triggers.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct TimeCodeDescription {
    /// That of the first trigger that has one.
    pub first: Option<String>,
    /// That of the last trigger that has one.
    pub last: Option<String>,
    pub triggers: u64,
    /// Rows of codes of which each follows the one before.
    pub runs: usize,
}

impl std::fmt::Display for TimeCodeDescription {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { first, last, triggers, runs } = self;
        let runs = if *runs == 1 { "without a jump".to_owned() } else { format!("in {runs} pieces") };
        match first.as_ref().zip(last.as_ref()) {
            Some((first, last)) => write!(f, "{first} to {last}, {runs}; {triggers} triggers have one"),
            None => write!(f, "received {runs}, but at no trigger"),
        }
    }
}

/// A device's clock against the host's, fitted again from the recorded exchanges.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ClockDescription {
    /// The camera; `None` for the HSU.
    pub camera: Option<CameraId>,
    pub samples: u64,
    /// Exchanges that the fit uses.
    pub used: u64,
    /// Exchanges that contradict the others and were left out.
    pub left_out: u64,
    /// How often the device's clock was set.
    pub resets: u64,
    /// Shortest time from request to answer, host clock, ns.
    pub round_trip_min_ns: u64,
    /// Device's clock minus host's clock at the last exchange, ns.
    pub offset_ns: Option<i64>,
    /// How much faster the device's clock runs than the host's, parts per million.
    pub skew_ppm: Option<f64>,
    /// Median distance of the last exchanges' midpoints from the fit, ns.
    pub residual_ns: Option<u64>,
    /// Uncertainty of the offset at the last exchange, half width, ns.
    pub uncertainty_ns: Option<u64>,
}

/// One segment of a recording, as its file has it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct SegmentDescription {
    pub number: u32,
    pub path: std::path::PathBuf,
    /// Length of the file when it was opened, bytes.
    pub bytes: u64,
    /// First trigger that belongs to it.
    pub first_trigger: u64,
    /// First trigger of the next segment, as this one states it; not known in the last one and in one that is not
    /// closed.
    pub end_trigger: Option<u64>,
    /// One more than the highest trigger of which it has a frame.
    pub frames_end: Option<u64>,
    /// Whether it ends as a closed segment does.
    pub closed: bool,
    /// If it does not: how far its records go, and what is there.
    pub broken: Option<String>,
}

/// The cameras of a recording, in its order.
pub fn cameras(recording: &RecordingReader) -> Vec<CameraDescription> {
    let end = recording.triggers_end();
    let start = first_trigger(recording);
    let described = recording.header.cameras.iter().zip(&recording.outcomes).zip(recording.counted());
    described
        .map(|((header, outcomes), counted)| {
            let mut first_gaps = BTreeMap::new();
            for (trigger, outcome) in outcomes {
                if let Outcome::Gap(cause) = outcome {
                    first_gaps.entry(*cause).or_insert(*trigger);
                }
            }
            let there = outcomes.range(start..).count() as u64;
            CameraDescription {
                // The whole state of a camera is `fourdbody cameras dump`'s.
                header: CameraHeader { state: BTreeMap::new(), ..header.clone() },
                frames: counted.frames,
                gaps: counted.gaps,
                first_gaps,
                absent: end.saturating_sub(start).saturating_sub(there),
                first_absent: (start..end).find(|trigger| !outcomes.contains_key(trigger)),
            }
        })
        .collect()
}

/// The first trigger that a recording is to have: 0, unless it is a single segment.
fn first_trigger(recording: &RecordingReader) -> u64 {
    let single = recording.path.is_file();
    recording.segments.first().filter(|_| single).map_or(0, |segment| segment.first_trigger)
}

/// Events by kind, in the order of the kinds' names.
pub fn events(recording: &RecordingReader) -> Vec<EventKind> {
    let mut kinds: BTreeMap<&str, EventKind> = BTreeMap::new();
    for event in &recording.events {
        let trigger = event.trigger.map(|trigger| trigger.0);
        let kind = kinds.entry(event.kind.as_str()).or_insert_with(|| EventKind {
            kind: event.kind.clone(),
            count: 0,
            first_trigger: trigger,
            first_host_time_ns: event.host_time_ns,
            first_message: event.message.clone(),
        });
        kind.count += 1;
        kind.first_trigger = kind.first_trigger.into_iter().chain(trigger).min();
    }
    kinds.into_values().collect()
}

/// The time code; `None` where none was received.
pub fn time_code(recording: &RecordingReader) -> Option<TimeCodeDescription> {
    let line = TimeCodeLine::of(&recording.events);
    let runs: BTreeSet<u64> = line.heard().map(|heard| heard.run).collect();
    let codes: Vec<_> = recording.triggers.values().filter_map(|row| line.at(row.hsu_time_ns)).collect();
    (!runs.is_empty()).then(|| TimeCodeDescription {
        first: codes.first().map(ToString::to_string),
        last: codes.last().map(ToString::to_string),
        triggers: codes.len() as u64,
        runs: runs.len(),
    })
}

/// The clocks of which there are exchanges: the HSU's, then the cameras' in the recording's order.
pub fn clocks(recording: &RecordingReader) -> Vec<ClockDescription> {
    let cameras = recording.header.cameras.iter().map(|camera| Some(&camera.id));
    let devices = std::iter::once(None).chain(cameras);
    devices.filter_map(|device| clock(device, &recording.clock_samples)).collect()
}

fn clock(device: Option<&CameraId>, samples: &[ClockSample]) -> Option<ClockDescription> {
    let exchanges: Vec<Exchange> = samples
        .iter()
        .filter(|sample| sample.camera.as_ref() == device)
        .map(|sample| Exchange {
            host_send_ns: sample.host_send_ns,
            host_receive_ns: sample.host_receive_ns,
            device_ns: sample.device_time_ns,
        })
        .collect();
    let last = exchanges.last()?;
    let mut fit = ClockFit::new();
    // The fit has dropped the exchanges before the clock was set.
    let mut since = 0;
    for (i, exchange) in exchanges.iter().enumerate() {
        let resets = fit.resets();
        fit.exchange(exchange);
        if fit.resets() > resets {
            since = (i + 1).saturating_sub(RESET_RUN);
        }
    }
    let device_ns = i128::from(last.device_ns);
    let offset = fit.host_from_device(device_ns).and_then(|host| i64::try_from(device_ns - host).ok());
    let round_trips = exchanges.iter().map(|e| e.host_receive_ns.saturating_sub(e.host_send_ns));
    let mut residuals: Vec<u64> = exchanges[since..]
        .iter()
        .rev()
        .take(RESIDUAL_SAMPLES)
        .filter_map(|e| {
            let middle = (i128::from(e.host_send_ns) + i128::from(e.host_receive_ns)) / 2;
            let off = (middle - fit.host_from_device(i128::from(e.device_ns))?).unsigned_abs();
            u64::try_from(off).ok()
        })
        .collect();
    residuals.sort_unstable();
    Some(ClockDescription {
        camera: device.cloned(),
        samples: exchanges.len() as u64,
        used: fit.used(),
        left_out: fit.left_out(),
        resets: fit.resets(),
        round_trip_min_ns: round_trips.min().unwrap_or(0),
        offset_ns: offset,
        skew_ppm: fit.drift_ppm(),
        residual_ns: residuals.get(residuals.len() / 2).copied(),
        uncertainty_ns: fit.uncertainty_ns(device_ns),
    })
}

/// The segments of a recording, in the order of their numbers.
pub fn segments(recording: &RecordingReader) -> Vec<SegmentDescription> {
    let ends = frames_ends(recording);
    let describe = |(place, segment): (usize, &SegmentReader)| SegmentDescription {
        number: segment.number,
        path: segment.path.clone(),
        bytes: segment.length() as u64,
        first_trigger: segment.first_trigger,
        end_trigger: segment.end_trigger,
        frames_end: ends.get(place).copied().flatten(),
        closed: segment.end == End::Closed,
        broken: segment.broken(),
    };
    recording.segments.iter().enumerate().map(describe).collect()
}

/// One more than the highest trigger of which each segment has a frame: a single way through the outcomes, however many
/// segments there are.
fn frames_ends(recording: &RecordingReader) -> Vec<Option<u64>> {
    let mut ends = vec![None; recording.segments.len()];
    for (trigger, outcome) in recording.outcomes.iter().flatten() {
        if let Outcome::Frame { segment, .. } = outcome
            && let Some(end) = ends.get_mut(*segment)
        {
            *end = (*end).max(Some(trigger + 1));
        }
    }
    ends
}

/// Triggers per second by the HSU's clock, over the whole trigger table.
pub fn measured_rate_hz(recording: &RecordingReader) -> Option<f64> {
    let ((first, from), (last, to)) =
        recording.triggers.first_key_value().zip(recording.triggers.last_key_value())?;
    let ns = to.hsu_time_ns.checked_sub(from.hsu_time_ns).filter(|ns| *ns > 0)?;
    let periods = last.0.checked_sub(first.0).filter(|periods| *periods > 0)?;
    Some(periods as f64 * 1e9 / ns as f64)
}

/// From the first to the last trigger, seconds: by the HSU's table where there is one.
pub fn duration_s(recording: &RecordingReader) -> f64 {
    let rows = recording.triggers.first_key_value().zip(recording.triggers.last_key_value());
    let by_table = rows.and_then(|((_, first), (_, last))| last.hsu_time_ns.checked_sub(first.hsu_time_ns));
    let by_rate = || {
        let periods = recording.triggers_end().saturating_sub(first_trigger(recording)).saturating_sub(1);
        periods as f64 / recording.header.trigger_rate_hz
    };
    by_table.filter(|ns| *ns > 0).map_or_else(by_rate, |ns| ns as f64 / 1e9)
}

/// What is missing from a recording or wrong with it, as far as opening it shows; a line each. Empty for a good one.
pub fn missing(recording: &RecordingReader) -> Vec<String> {
    let mut lines = Vec::new();
    let single = recording.path.is_file();
    if let Some(first) = recording.segments.first().filter(|segment| segment.number != 0 && !single) {
        lines.push(format!("segments before segment {}", first.number));
    }
    for segment in segments(recording) {
        if let Some(broken) = segment.broken {
            lines.push(format!("segment {}: {broken}", segment.number));
        }
    }
    for segment in &recording.segments {
        let bad = segment.bad_ranges().into_iter();
        lines.extend(bad.map(|bad| format!("segment {}: {bad}", segment.number)));
    }
    lines.extend(recording.problems.iter().map(|problem| {
        let camera = problem.camera.as_ref().map(|camera| format!(" camera {camera}")).unwrap_or_default();
        let trigger = problem.trigger.map(|trigger| format!(" trigger {trigger}")).unwrap_or_default();
        format!("segment {}{camera}{trigger}: {}", problem.segment, problem.message)
    }));
    for camera in cameras(recording) {
        if let Some(first) = camera.first_absent {
            let (id, count) = (&camera.header.id, camera.absent);
            lines.push(format!(
                "camera {id}: {count} triggers have neither a frame nor a gap record, the first is {first}"
            ));
        }
    }
    if recording.verdict.is_none() && !single {
        lines.push("the verdict: the recording was not finished".to_owned());
    }
    let (start, end) = (first_trigger(recording), recording.triggers_end());
    if recording.header.hsu.is_some() && !single {
        let rows = recording.triggers.range(TriggerIndex(start)..TriggerIndex(end)).count() as u64;
        match end.saturating_sub(start).saturating_sub(rows) {
            0 => {}
            count => lines.push(format!("{count} rows of the HSU's trigger table")),
        }
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::clock;
    use crate::layout::ClockSample;

    /// A device that was switched off and on in between: the residual is that of the clock as it is now.
    #[test]
    fn the_residual_is_that_of_the_clock_since_it_was_set() {
        let sample = |second: u64| {
            let host_send_ns = 1_000_000_000_000 + second * 1_000_000_000;
            let set_at = if second < 40 { 0 } else { 40 };
            ClockSample {
                camera: None,
                host_send_ns,
                host_receive_ns: host_send_ns + 100_000,
                device_time_ns: 7_000_050_000 + (second - set_at) * 1_000_000_000,
            }
        };
        let samples: Vec<ClockSample> = (0..60).map(sample).collect();
        let described = clock(None, &samples).expect("samples");
        assert_eq!((described.resets, described.samples), (1, 60));
        let residual = described.residual_ns.expect("a fit");
        assert!(residual < 50_000, "half a round trip at most: {residual} ns");
    }
}
