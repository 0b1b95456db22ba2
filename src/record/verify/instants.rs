// SPDX-License-Identifier: MIT OR Apache-2.0
//! Whether frame k is the same instant in all cameras: camera clocks and arrivals against the HSU's triggers, and the
//! nodes' trigger tables against each other.
//!
//! Nothing that the node concluded is believed, its events least of all: all of it is computed again from the raw
//! samples. A frame is its trigger's when its timestamp lies as long after the trigger as those of the warm-up do.
//! Where a camera's clock was set, or a fresh stream began, a new **run** begins; of each run the recorded exchanges
//! with both clocks must give the delay that the warm-up shows, or else the frames must arrive as long after their
//! triggers as they did there.

use super::{Notes, Severity};
use crate::base::clock_fit::{ClockFit, Exchange};
use crate::base::ids::{CameraId, TriggerIndex};
use crate::matcher::anchor::{Anchoring, Early};
use crate::matcher::block_ids::BlockIds;
use crate::matcher::trigger_table::TriggerTable;
use crate::record::layout::{ClockSample, TriggerRecord, WarmUp};
use crate::record::reader::RecordingReader;
use std::collections::BTreeMap;

/// What a frame itself says of its instant.
#[derive(Debug, Clone, Copy)]
pub struct Seen {
    /// Block id.
    pub block: u64,
    /// Camera clock, ns; 0 without a timestamp.
    pub camera_ns: u64,
    /// Arrival, host clock, ns.
    pub host_ns: u64,
}

/// By trigger.
pub type Times = BTreeMap<u64, Seen>;

/// Frames further apart are not compared directly: clocks drift.
const NEAR: i64 = 100;
/// A run is judged by parts of so many frames.
const PART: usize = 64;
/// A clock that was set more often than this is none: what it says behind that is not heard.
const PIECES: usize = 1000;
/// So many of them may be in force at a frame: more are no clock either, and would all be asked at each frame.
const PIECES_IN_FORCE: usize = 16;
/// So few frames in a row may have a wrong timestamp, if the ids on both sides say which triggers they are of.
const PASSING: usize = 8;

/// A frame with its trigger's number (negative in the warm-up), and when that trigger was fired, HSU clock, ns.
#[derive(Debug, Clone, Copy)]
struct Frame {
    number: i64,
    hsu_ns: i128,
    seen: Seen,
}

/// Frames whose timestamps go on as their triggers do.
#[derive(Debug)]
struct Run {
    frames: Vec<Frame>,
}

/// A camera's frames and clocks.
struct Camera<'a> {
    id: &'a CameraId,
    period_ns: i128,
    of_hsu: Option<&'a ClockFit>,
    /// The camera's clock, piece by piece where it was set, each with the host's time of its first and last exchange.
    of_camera: Vec<(ClockFit, u64, u64)>,
}

impl Camera<'_> {
    /// When a trigger was fired, host clock, ns.
    fn fired_ns(&self, frame: &Frame) -> Option<i128> {
        self.of_hsu?.host_from_device(frame.hsu_ns)
    }

    /// From the trigger to the arrival, ns.
    fn arrival_ns(&self, frame: &Frame) -> Option<i128> {
        Some(i128::from(frame.seen.host_ns) - self.fired_ns(frame)?)
    }

    /// From the trigger to the timestamp, ns, by each piece of the camera's clock that was in force, and what the
    /// exchanges leave open.
    fn delays_ns(&self, frame: &Frame) -> Vec<(i128, i128)> {
        const BETWEEN_EXCHANGES_NS: u64 = 5_000_000_000;
        let (Some(fired), camera_ns) = (self.fired_ns(frame), i128::from(frame.seen.camera_ns)) else {
            return Vec::new();
        };
        let hsu_open = self.of_hsu.and_then(|fit| fit.uncertainty_ns(frame.hsu_ns)).unwrap_or(u64::MAX);
        let in_force = self.of_camera.iter().filter(|(_, first, last)| {
            let host_ns = frame.seen.host_ns;
            if self.of_camera.len() == 1 {
                return true;
            }
            host_ns.saturating_add(BETWEEN_EXCHANGES_NS) >= *first
                && host_ns <= last.saturating_add(BETWEEN_EXCHANGES_NS)
        });
        let delay = |fit: &ClockFit| {
            let open = fit.uncertainty_ns(camera_ns)?.saturating_add(hsu_open);
            (i128::from(open) < self.period_ns / 2)
                .then_some((fit.host_from_device(camera_ns)? - fired, i128::from(open)))
        };
        let in_force = in_force.take(PIECES_IN_FORCE);
        in_force.filter(|_| frame.seen.camera_ns != 0).filter_map(|(fit, ..)| delay(fit)).collect()
    }

    /// How far frames' timestamps lie from where `usual` has them, ns: the middle of what they say, beyond what is
    /// open; `None` where the exchanges say nothing.
    fn off_by_clock(&self, frames: &[Frame], usual: i128) -> Option<i128> {
        let nearest = |frame: &Frame| {
            let off = |(ns, open): (i128, i128)| (ns - usual).signum() * ((ns - usual).abs() - open).max(0);
            self.delays_ns(frame).into_iter().map(off).min_by_key(|ns| ns.abs())
        };
        middle(frames.iter().filter_map(nearest).collect())
    }

    /// The usual way to the arrival, ns: arrivals err towards late, so it is that of the quicker ones.
    fn usual_arrival(&self, frames: &[Frame]) -> Option<i128> {
        let mut ways: Vec<i128> = frames.iter().filter_map(|frame| self.arrival_ns(frame)).collect();
        ways.sort_unstable();
        ways.get(ways.len() / 4).copied()
    }

    /// Whether two frames follow each other by the camera's clock as their triggers do by the HSU's; `None` where
    /// that is not to be told.
    fn follows(&self, before: &Frame, frame: &Frame) -> Option<bool> {
        let stamped = before.seen.camera_ns != 0 && frame.seen.camera_ns != 0;
        let near = frame.number - before.number <= NEAR;
        (stamped && near).then(|| {
            let camera = i128::from(frame.seen.camera_ns) - i128::from(before.seen.camera_ns);
            (camera - (frame.hsu_ns - before.hsu_ns)).abs() <= self.period_ns / 2 && camera > 0
        })
    }

    fn runs(&self, frames: &[Frame]) -> Vec<Run> {
        let mut runs: Vec<Run> = Vec::new();
        for frame in frames {
            let last = runs.last_mut().and_then(|run| run.frames.last().copied().map(|last| (run, last)));
            match last {
                Some((run, last)) if self.follows(&last, frame) != Some(false) => run.frames.push(*frame),
                _ => runs.push(Run { frames: vec![*frame] }),
            }
        }
        runs
    }
}

fn middle(mut all: Vec<i128>) -> Option<i128> {
    all.sort_unstable();
    all.get(all.len() / 2).copied()
}

/// The second witnesses of all frames, by camera of the header.
pub fn check(recording: &RecordingReader, times: &[Times], notes: &mut Notes) {
    if recording.header.hsu.is_none() {
        return;
    }
    let samples = |of: Option<&CameraId>| {
        recording.clock_samples.iter().filter(|sample| sample.camera.as_ref() == of).collect::<Vec<_>>()
    };
    let period_ns = (1e9 / recording.header.trigger_rate_hz) as i128;
    let of_hsu = pieces(&samples(None)).into_iter().next().map(|(fit, ..)| fit);
    let begin = Begin::of(recording);
    for (camera, times) in recording.header.cameras.iter().zip(times) {
        let of_camera = pieces(&samples(Some(&camera.id)));
        let witness = Camera { id: &camera.id, period_ns, of_hsu: of_hsu.as_ref(), of_camera };
        check_camera(recording, &witness, &begin, times, notes);
    }
}

fn check_camera(
    recording: &RecordingReader,
    witness: &Camera<'_>,
    begin: &Begin<'_>,
    times: &Times,
    notes: &mut Notes,
) {
    let warm_up = begin.warm_up(witness);
    let began = warm_up.len();
    let fired = |trigger: u64| Some(i128::from(recording.triggers.get(&TriggerIndex(trigger))?.hsu_time_ns));
    let recorded = times.iter().filter_map(|(&trigger, &seen)| {
        Some(Frame { number: i64::try_from(trigger).ok()?, hsu_ns: fired(trigger)?, seen })
    });
    let frames: Vec<Frame> = warm_up.into_iter().chain(recorded).collect();
    let reference = &frames[..if began > 0 { began } else { frames.len().min(PART) }];
    if began == 0 {
        check_assumed(witness, &frames, notes);
    }
    let delays = reference.iter().filter_map(|frame| witness.delays_ns(frame).first().map(|(ns, _)| *ns));
    let usual = Usual { delay: middle(delays.collect()), arrival: witness.usual_arrival(reference) };
    let runs = witness.runs(&frames);
    for (place, run) in runs.iter().enumerate() {
        let before = place.checked_sub(1).and_then(|place| runs[place].frames.last());
        let after = runs.get(place + 1).and_then(|run| run.frames.first());
        if run.frames.len() <= PASSING && passes(&run.frames, before, after, witness) {
            continue;
        }
        for part in run.frames.chunks(PART) {
            check_part(witness, part, &usual, place == 0, notes);
        }
    }
}

/// From a trigger to its frame's timestamp and to its arrival, as the beginning of the session shows.
struct Usual {
    delay: Option<i128>,
    arrival: Option<i128>,
}

/// Frames whose timestamps contradict those around them: the ids on both sides leave no other triggers for them.
fn passes(frames: &[Frame], before: Option<&Frame>, after: Option<&Frame>, camera: &Camera<'_>) -> bool {
    let (Some(before), Some(after)) = (before, after) else { return false };
    let ids = BlockIds::default();
    let continuous =
        |from: &Frame, to: &Frame| ids.between(from.seen.block, to.seen.block) == to.number - from.number;
    let around: Vec<&Frame> = std::iter::once(before).chain(frames).chain(std::iter::once(after)).collect();
    around.windows(2).all(|pair| continuous(pair[0], pair[1])) && camera.follows(before, after) == Some(true)
}

/// A part of a run, against what is usual.
fn check_part(camera: &Camera<'_>, part: &[Frame], usual: &Usual, first: bool, notes: &mut Notes) {
    let half = camera.period_ns / 2;
    let by_clock = usual.delay.and_then(|delay| camera.off_by_clock(part, delay));
    let arrival = camera.usual_arrival(part);
    let by_arrival = arrival.zip(usual.arrival).map(|(found, usual)| found - usual);
    let good = match (by_clock, by_arrival) {
        (Some(off), _) if off.abs() <= half => true,
        // A clock that was set between two exchanges, or one that cannot be read: arrivals tell.
        (_, Some(late)) => late.abs() <= half || (by_clock.is_none() && first),
        (Some(_), None) => false,
        (None, None) => first,
    };
    let recorded = || part.iter().filter_map(|frame| u64::try_from(frame.number).ok());
    let (Some(from), Some(to)) = (recorded().next(), recorded().next_back()) else { return };
    if good {
        return;
    }
    let ms = |ns: i128| ns as f64 / 1e6;
    let clock = by_clock.map_or("unknown".to_owned(), |ns| format!("{:.3} ms", ms(ns)));
    let late = by_arrival.map_or("unknown".to_owned(), |ns| format!("{:.3} ms", ms(ns)));
    let message = format!(
        "not the frames of these triggers: further from them than at the session's beginning, by their timestamps {clock}, by their arrival {late}; expected less than half a period, {:.3} ms",
        ms(half)
    );
    notes.add(Severity::Corrupt, None, Some(camera.id), Some((from, to)), message);
}

/// A recording without its warm-up: all frames could be those of the next trigger without a wrong step. That a camera
/// stamps within half a period is assumed then.
fn check_assumed(camera: &Camera<'_>, frames: &[Frame], notes: &mut Notes) {
    let Some(last) = frames.chunks(PART).next_back() else { return };
    let Some(off) = camera.off_by_clock(last, 0).filter(|off| off.abs() > camera.period_ns / 2) else {
        return;
    };
    let number = |frame: &Frame| u64::try_from(frame.number).unwrap_or(0);
    let message = format!(
        "its last frames were exposed {:.3} ms after their triggers, by the recorded exchanges with both clocks: not the frames of these triggers",
        off as f64 / 1e6
    );
    let range = frames.first().zip(frames.last()).map(|(first, last)| (number(first), number(last)));
    notes.add(Severity::Corrupt, None, Some(camera.id), range, message);
}

/// What was seen in the warm-up, by any camera, and the triggers of it and behind it.
struct Begin<'a> {
    table: TriggerTable,
    first: i64,
    seen: BTreeMap<&'a CameraId, Vec<Seen>>,
}

impl<'a> Begin<'a> {
    fn of(recording: &'a RecordingReader) -> Self {
        let mut begin = Self { table: TriggerTable::default(), first: 0, seen: BTreeMap::new() };
        for event in &recording.events {
            match (WarmUp::of(event), &event.camera) {
                (Some(WarmUp::Trigger { number, hsu_time_ns }), _) => begin.trigger(number, hsu_time_ns),
                (Some(WarmUp::Frame { block, camera_time_ns, host_time_ns }), Some(camera)) => {
                    let seen = Seen { block, camera_ns: camera_time_ns, host_ns: host_time_ns };
                    begin.seen.entry(camera).or_default().push(seen);
                }
                _ => {}
            }
        }
        begin.first = begin.table.first();
        for (index, row) in recording.triggers.iter().take(PART) {
            if let Ok(number) = i64::try_from(index.0) {
                begin.trigger(number, row.hsu_time_ns);
            }
        }
        begin
    }

    /// The table fills holes with rows of its own: one that is far from all others is none, or each would cost a million.
    fn trigger(&mut self, number: i64, hsu_ns: u64) {
        let near = self.table.first().saturating_sub(NEAR)..=self.table.end().saturating_add(NEAR);
        if self.table.is_empty() || near.contains(&number) {
            self.table.insert(number, hsu_ns);
        }
    }

    /// The frames of a camera in the warm-up, at the triggers that they are found to be of.
    fn warm_up(&self, camera: &Camera<'_>) -> Vec<Frame> {
        let none = Vec::new();
        let seen = self.seen.get(camera.id).unwrap_or(&none);
        let (table, first) = (&self.table, self.first);
        let (Some(begin), Ok(period_ns)) =
            (seen.first().map(|seen| seen.block), u64::try_from(camera.period_ns))
        else {
            return Vec::new();
        };
        let (mut anchoring, ids) = (Anchoring::default(), BlockIds::default());
        let count = |seen: &Seen| ids.between(begin, seen.block);
        for seen in seen {
            let camera_ns = Some(seen.camera_ns).filter(|ns| *ns != 0);
            let arrived_ns = camera.of_hsu.and_then(|fit| fit.device_from_host(seen.host_ns.into()));
            anchoring.add(Early { count: count(seen), camera_ns, arrived_ns });
        }
        let Some(place) = anchoring.place(first, table, period_ns) else { return Vec::new() };
        let frame = |seen: &Seen| {
            let number = count(seen).checked_add(place.offset)?;
            Some(Frame { number, hsu_ns: table.time_ns(number)?.into(), seen: *seen })
        };
        seen.iter().filter_map(frame).collect()
    }
}

/// A device's clock against the host's, from the recorded exchanges with it: in pieces, where it was set between two
/// of them.
fn pieces(samples: &[&ClockSample]) -> Vec<(ClockFit, u64, u64)> {
    /// Rates differ by no more; and what an exchange may be wrong by beyond its round trip, ns.
    const DRIFT: i128 = 1_000;
    const SLACK_NS: i128 = 100_000;
    let middle_ns =
        |sample: &ClockSample| (i128::from(sample.host_send_ns) + i128::from(sample.host_receive_ns)) / 2;
    let open_ns =
        |sample: &ClockSample| i128::from(sample.host_receive_ns.saturating_sub(sample.host_send_ns));
    let mut pieces: Vec<(ClockFit, u64, u64)> = Vec::new();
    let mut last: Option<&ClockSample> = None;
    for sample in samples {
        let set = last.is_none_or(|last| {
            let host = middle_ns(sample) - middle_ns(last);
            let device = i128::from(sample.device_time_ns) - i128::from(last.device_time_ns);
            (device - host).abs() > open_ns(sample) + open_ns(last) + SLACK_NS + host.abs() / DRIFT
        });
        if set {
            if pieces.len() == PIECES {
                break;
            }
            pieces.push((ClockFit::new(), sample.host_send_ns, sample.host_receive_ns));
        }
        if let Some((fit, _, end)) = pieces.last_mut() {
            let (host_send_ns, host_receive_ns) = (sample.host_send_ns, sample.host_receive_ns);
            fit.exchange(&Exchange { host_send_ns, host_receive_ns, device_ns: sample.device_time_ns });
            *end = sample.host_receive_ns;
        }
        last = Some(*sample);
    }
    pieces.retain(|(fit, ..)| fit.is_ready());
    pieces
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
