// SPDX-License-Identifier: MIT OR Apache-2.0
//! Whether each frame is of its trigger: judged again from the raw samples (`docs/design/recording.md`, V1 to V8).
//!
//! Frames in a row whose ids and stamps go on as their triggers do are judged together, in **parts**. Of each part the
//! counter (ids) and the clock (stamps, by the recorded readings) confirm its triggers, contradict them, or do neither;
//! arrivals refute what would have come too early, and decide between the two where they are in time.

use super::explained::Explained;
use super::findings::{Notes, Severity};
use super::frame::{Frame, Seen, Times, range_of, skipped};
use super::header::severity;
use super::readings::{HostTime, Readings};
use super::rhythm;
use super::rows::{Late, Rows, Wrong, ms};
use super::table::{Table, note_readings};
use crate::base::ids::CameraId;
use crate::layout::WarmUp;
use crate::reader::RecordingReader;
use std::collections::BTreeMap;

/// Frames of a part, at least; the last part of a row has fewer than twice as many.
const PART: usize = 64;
/// Most frames in a row that may have a wrong id or stamp, if those on both sides leave no other triggers for them.
const PASSING: usize = 8;
/// Reciprocal of the largest relative difference between the rates of a camera's clock and the HSU's.
const RATE: i128 = 1_600;
/// Time for which a host can stand still, ns: frames that are all late for longer are of other triggers.
const LATE_NS: i128 = 2_000_000_000;

/// A camera's frames and clocks.
struct Camera<'a> {
    id: &'a CameraId,
    table: &'a Table,
    readings: Readings,
    explained: Explained<'a>,
    /// Whether its frames have timestamps.
    stamped: bool,
    /// From the trigger to the stamp, by the readings, ns.
    delay_ns: Option<i128>,
}

/// Whether a source confirms the triggers that frames are recorded under; `None` where it is no evidence.
type Confirms = Option<bool>;

/// Frames that are judged together.
struct Part<'a> {
    frames: &'a [Frame],
    /// Whether ids go on from those before them.
    begins: bool,
}

/// What each source shows of a part.
struct Evidence {
    counter: Confirms,
    clock: Confirms,
    /// How far ids went beyond triggers.
    skipped: Option<i64>,
    /// How far stamps lie from where they should, ns.
    off_ns: Option<i128>,
    /// How much later than usual the quickest of them came, ns.
    late_ns: Option<i128>,
}

/// Judges all frames, by camera of the header. `whole` is false for a single segment, which has no beginning.
pub fn check(recording: &RecordingReader, times: &[Times], whole: bool, notes: &mut Notes) {
    if recording.header.hsu.is_none() {
        return note_without_hsu(recording, notes);
    }
    if recording.outcomes.iter().all(BTreeMap::is_empty) && recording.triggers.is_empty() {
        return;
    }
    let Some(table) = Table::of(recording, notes) else {
        let message = "neither its header nor a trigger table state when triggers were fired: only the ids show which \
            trigger frames are of";
        return notes.add(Severity::Unconfirmed, None, None, None, message);
    };
    table.check(recording, whole, notes);
    for (place, (camera, times)) in recording.header.cameras.iter().zip(times).enumerate() {
        let id = &camera.id;
        let Some(explained) = Explained::of(recording, place, id, whole) else { continue };
        let samples = recording.clock_samples.iter().filter(|sample| sample.camera.as_ref() == Some(id));
        let frames = times.iter().filter_map(|(&trigger, &seen)| {
            let number = i64::try_from(trigger).ok()?;
            Some(Frame { number, hsu_ns: table.fired_ns(number)?, seen })
        });
        let frames: Vec<Frame> = frames.collect();
        let warm_up = warm_up_of(recording, id);
        let stamped = most_stamped(times.values()) || most_stamped(warm_up.iter());
        let readings = Readings::of(samples);
        let mut camera = Camera { id, table: &table, readings, explained, stamped, delay_ns: None };
        camera.note_untimed(times, frames.len(), notes);
        camera.check(&warm_up, frames, whole, notes);
    }
}

/// Images that were imported, or recorded without a trigger unit.
fn note_without_hsu(recording: &RecordingReader, notes: &mut Notes) {
    let warm_up = recording.events.iter().any(|event| WarmUp::of(event).is_some());
    if !recording.triggers.is_empty() || !recording.clock_samples.is_empty() || warm_up {
        let message = "its header names no HSU, but there are trigger times or readings of clocks";
        return notes.add(severity(recording), None, None, None, message);
    }
    let message = "imported: that images of one index are of one instant rests on their files' names alone";
    notes.add(Severity::Note, None, None, None, message);
}

/// Whether most of a camera's frames have a timestamp.
fn most_stamped<'a>(seen: impl Iterator<Item = &'a Seen>) -> bool {
    let (stamped, all) =
        seen.fold((0, 0), |(stamped, all), seen| (stamped + usize::from(seen.camera_ns != 0), all + 1));
    stamped * 2 > all
}

/// The frames of a camera in the warm-up, in the order of arrival.
fn warm_up_of(recording: &RecordingReader, id: &CameraId) -> Vec<Seen> {
    let own = recording.events.iter().filter(|event| event.camera.as_ref() == Some(id));
    let frame = |sample| match sample {
        WarmUp::Frame { block, camera_time_ns, host_time_ns } => {
            Some(Seen { block, camera_ns: camera_time_ns, host_ns: host_time_ns })
        }
        WarmUp::Trigger { .. } => None,
    };
    own.filter_map(WarmUp::of).filter_map(frame).collect()
}

impl Camera<'_> {
    fn note_untimed(&self, times: &Times, timed: usize, notes: &mut Notes) {
        if timed < times.len() {
            let message = format!(
                "{} frames are of triggers whose time is not known: only their ids show which trigger they are of",
                times.len() - timed
            );
            notes.add(Severity::Unconfirmed, None, Some(self.id), None, message);
        }
    }

    fn check(&mut self, seen: &[Seen], recorded: Vec<Frame>, whole: bool, notes: &mut Notes) {
        note_readings(&self.readings, Some(self.id), "its clock", notes);
        let Some(range) = range_of(&recorded) else { return };
        if let Some((at, by)) = self.readings.settings().next().filter(|_| !self.explained.clock_set()) {
            let message = format!(
                "its clock was set by {:.3} ms at {at} ns of the host's clock, by its readings, and no event states it",
                ms(by)
            );
            notes.add(Severity::Corrupt, None, Some(self.id), Some(range), message);
        }
        if self.stamped
            && self.readings.epochs.is_empty()
            && !self.table.readings.epochs.is_empty()
            && !self.explained.has_no_clock()
        {
            let message = "its clock was never read, and no event states that it cannot be read: its timestamps rest \
                on the warm-up alone";
            notes.add(Severity::Unconfirmed, None, Some(self.id), Some(range), message);
        }
        self.check_order(&recorded, notes);
        let begin = rhythm::warm_up(seen, self.table);
        let began = begin.len();
        let frames: Vec<Frame> = begin.into_iter().chain(recorded).collect();
        let reference = &frames[..if began > 0 { began } else { frames.len().min(PART) }];
        self.delay_ns = middle(reference.iter().filter_map(|frame| self.stamped_after(frame)).collect());
        if whole || began > 0 {
            self.check_place(reference, began > 0, range, notes);
        }
        self.judge(&frames, began, notes);
    }

    /// When a trigger was fired, host clock.
    fn fired(&self, frame: &Frame) -> Option<HostTime> {
        self.table.host_time(frame.hsu_ns, frame.number)
    }

    /// From a trigger to the frame's arrival, and what is open, ns.
    fn arrived_after(&self, frame: &Frame) -> Option<(i128, i128)> {
        let fired = self.fired(frame)?;
        Some((i128::from(frame.seen.host_ns) - fired.ns, fired.open_ns))
    }

    /// From a trigger to the frame's stamp, by the first readings that were in force, ns.
    fn stamped_after(&self, frame: &Frame) -> Option<i128> {
        let fired = self.fired(frame)?;
        let camera_ns = i128::from(frame.seen.camera_ns);
        let mut found = self.readings.host_times(camera_ns, frame.seen.host_ns.into());
        let found = found.find(|found| found.open_ns + fired.open_ns < self.table.period_ns / 4);
        found.filter(|_| camera_ns != 0).map(|found| found.ns - fired.ns)
    }

    /// How far the middle of frames' stamps lies from the usual delay beyond what the readings leave open, ns; `None`
    /// where the readings are no evidence.
    fn off_by_readings(&self, frames: &[Frame]) -> Option<i128> {
        let usual = self.delay_ns?;
        let off = |frame: &Frame| {
            let fired = self.fired(frame)?;
            let camera_ns = i128::from(frame.seen.camera_ns);
            let found = self.readings.host_times(camera_ns, frame.seen.host_ns.into());
            let off = found.filter_map(|found| {
                let open = found.open_ns + fired.open_ns;
                let off = found.ns - fired.ns - usual;
                (open < self.table.period_ns / 2).then_some(off.signum() * (off.abs() - open).max(0))
            });
            off.min_by_key(|ns| ns.abs()).filter(|_| camera_ns != 0)
        };
        middle(frames.iter().filter_map(off).collect())
    }

    /// Frames of one camera arrive in the order of their triggers, and none before its own.
    fn check_order(&self, frames: &[Frame], notes: &mut Notes) {
        let slack = self.table.period_ns / 8;
        // Time after everything else behind which no frame is recorded any more, ns.
        const BEHIND_NS: i128 = 10_000_000_000;
        let (mut early, mut back, mut behind) = (Rows::default(), Rows::default(), Rows::default());
        let mut latest = 0;
        for frame in frames {
            if let Some((way, open)) = self.arrived_after(frame)
                && way + open + slack < 0
            {
                early.add(frame.number, way);
            }
            // Frames that waited together come at once, and a thread that reads a clock may stand still.
            let arrived = i128::from(frame.seen.host_ns);
            if arrived + self.table.period_ns / 2 < latest {
                back.add(frame.number, arrived - latest);
            }
            latest = arrived.max(latest);
            if arrived > self.table.last_ns + BEHIND_NS {
                behind.add(frame.number, arrived - self.table.last_ns);
            }
        }
        behind.note(Some(self.id), notes, |by| {
            format!("not the frames of this session: arrived {by:.3} ms after everything else was recorded")
        });
        early.note(Some(self.id), notes, |way| {
            let before = -way;
            format!("not the frames of these triggers: arrived {before:.3} ms before the trigger was fired")
        });
        back.note(Some(self.id), notes, |by| {
            let before = -by;
            format!(
                "arrived {before:.3} ms before a frame of an earlier trigger: one of them is not of its trigger"
            )
        });
    }

    /// The beginning: a stamp lies between trigger and arrival, and the rhythm of the warm-up shows which trigger it
    /// is. Where it is not found, it is assumed that a camera stamps within a period.
    fn check_place(&self, reference: &[Frame], found: bool, range: (u64, u64), notes: &mut Notes) {
        let period = self.table.period_ns;
        let arrived =
            reference.iter().filter_map(|frame| self.arrived_after(frame)).map(|(way, _)| way).min();
        if let Some(delay) = self.delay_ns {
            let slack = period / 4;
            if delay < -slack || arrived.is_some_and(|way| delay > way + slack) {
                let message = format!(
                    "its timestamps are not of the clock whose readings are recorded: by them they lie {:.3} ms after \
                     the triggers{}",
                    ms(delay),
                    arrived.map_or(String::new(), |way| format!(
                        ", and frames arrive {:.3} ms after them",
                        ms(way)
                    ))
                );
                notes.add(Severity::Corrupt, None, Some(self.id), Some(range), message);
            } else if !found && delay > period * 7 / 8 {
                let message = format!(
                    "its frames were exposed {:.3} ms after their triggers, by the recorded readings of both clocks: \
                     not the frames of these triggers",
                    ms(delay)
                );
                notes.add(Severity::Corrupt, None, Some(self.id), Some(range), message);
            }
        }
        if !found {
            let message = if self.delay_ns.is_some() {
                "the rhythm of the warm-up is not found in its frames: its place in the train rests on its clock, and \
                 on the assumption that it stamps and sends within a period of a trigger"
            } else {
                "the rhythm of the warm-up is not found in its frames, and its clock was not read: its place in the \
                 train rests on its ids alone"
            };
            notes.add(Severity::Unconfirmed, None, Some(self.id), Some(range), message);
        }
    }

    /// Whether two frames follow each other by the camera's clock as their triggers do by the HSU's; `None` where that
    /// cannot be decided.
    fn follows(&self, before: &Frame, frame: &Frame) -> Confirms {
        let hsu = frame.hsu_ns - before.hsu_ns;
        let allowed = self.table.period_ns / 4 + hsu.abs() / RATE;
        let stamped = before.seen.camera_ns != 0 && frame.seen.camera_ns != 0;
        (stamped && allowed <= self.table.period_ns / 2).then(|| {
            let camera = i128::from(frame.seen.camera_ns) - i128::from(before.seen.camera_ns);
            (camera - hsu).abs() <= allowed
        })
    }

    /// Frames in a row whose ids and stamps go on, in parts.
    fn parts<'f>(&self, frames: &'f [Frame], began: usize) -> Vec<Part<'f>> {
        let mut parts = Vec::new();
        let mut start = 0;
        // The last frame with a stamp.
        let mut stamped: Option<&Frame> = None;
        for end in 1..=frames.len() {
            let last = &frames[end - 1];
            stamped = if last.seen.camera_ns != 0 { Some(last) } else { stamped };
            let goes_on = frames.get(end).is_some_and(|next| {
                let follows = stamped.is_none_or(|stamped| self.follows(stamped, next) != Some(false));
                end != began && skipped(last, next) == 0 && follows
            });
            if goes_on {
                continue;
            }
            let run = &frames[start..end];
            let count = (run.len() / PART).max(1);
            for place in 0..count {
                let to = if place + 1 == count { run.len() } else { (place + 1) * PART };
                parts.push(Part { frames: &run[place * PART..to], begins: place > 0 });
            }
            (start, stamped) = (end, None);
        }
        parts
    }

    fn judge(&self, frames: &[Frame], began: usize, notes: &mut Notes) {
        let parts = self.parts(frames, began);
        // The last frame whose trigger is known, by its id and by its stamp.
        let (mut counted, mut clocked): (Option<Frame>, Option<Frame>) = (None, None);
        // The quickest way of frames that ids and stamps confirm: arrivals err towards late.
        let mut usual = parts.first().and_then(|first| self.usual_arrival(first.frames));
        // The same of more frames in a row than a host can stand still for.
        let mut proven: Option<i128> = None;
        let (mut late, mut wrong, mut single) = (Late::default(), Wrong::default(), Wrong::default());
        for (place, part) in parts.iter().enumerate() {
            let evidence = self.evidence_of(part, counted, clocked, usual, place == 0);
            let next = parts.get(place + 1).and_then(|next| next.frames.first());
            let enclosed = part.frames.len() <= PASSING
                && counted.zip(next).is_some_and(|(before, next)| skipped(&before, next) == 0)
                && clocked.zip(next).is_some_and(|(before, next)| self.follows(&before, next) == Some(true));
            let ends = part.frames.first().zip(part.frames.last());
            let Some((first, last)) = ends else { continue };
            let before = counted.map_or(first.number - 1, |frame| frame.number);
            let accepted = self.accept(part, &evidence, before, enclosed, (&mut wrong, &mut single));
            late.add(
                part.frames,
                accepted && evidence.late_ns.is_some_and(|ns| ns > self.table.period_ns / 2),
            );
            if accepted {
                counted = Some(*last);
                if (evidence.counter, evidence.clock) == (Some(true), Some(true)) {
                    let own = self.usual_arrival(part.frames);
                    let early = |(own, proven): (i128, i128)| own - proven < -self.table.period_ns * 3 / 4;
                    if let Some(range) = range_of(part.frames).filter(|_| own.zip(proven).is_some_and(early))
                    {
                        let message =
                            "arrive a period earlier than the frames before: arrivals do not confirm them";
                        single.add(range, || message.to_owned());
                    }
                    usual = usual.into_iter().chain(own).min();
                    if part.frames.len() >= PART && proven.is_none() {
                        proven = own;
                    }
                }
                if evidence.clock != Some(false) || self.explained.clock_set_at(before, first.number) {
                    let stamped = part.frames.iter().rev().find(|frame| frame.seen.camera_ns != 0);
                    clocked = stamped.copied().or(clocked);
                }
            }
        }
        for range in late.long(LATE_NS, PART) {
            let message = "all of its frames arrive later than at the beginning by more than half a period: arrivals \
                do not confirm them";
            notes.add(Severity::Unconfirmed, None, Some(self.id), Some(range), message);
        }
        for (range, message) in wrong.0 {
            notes.add(Severity::Corrupt, None, Some(self.id), Some(range), message);
        }
        for (range, message) in single.0 {
            notes.add(Severity::Unconfirmed, None, Some(self.id), Some(range), message);
        }
        self.note_unstamped(frames, notes);
    }

    /// The usual way to the arrival, ns: that of the quicker frames.
    fn usual_arrival(&self, frames: &[Frame]) -> Option<i128> {
        let mut ways: Vec<i128> =
            frames.iter().filter_map(|frame| self.arrived_after(frame)).map(|(way, _)| way).collect();
        ways.sort_unstable();
        ways.get(ways.len() / 16).copied()
    }

    fn evidence_of(
        &self,
        part: &Part<'_>,
        counted: Option<Frame>,
        clocked: Option<Frame>,
        usual: Option<i128>,
        first: bool,
    ) -> Evidence {
        let half = self.table.period_ns / 2;
        let begin = part.frames.first();
        let away = counted
            .zip(begin)
            .is_some_and(|(before, begin)| self.explained.was_away(before.number, begin.number));
        let skip = counted.zip(begin).map(|(before, begin)| skipped(&before, begin));
        let counter = match (skip, away) {
            (_, true) => None,
            (Some(skip), false) => Some(skip == 0),
            // The place of the first part was checked with the beginning.
            (None, false) => Some(true),
        };
        let off_ns = self.off_by_readings(part.frames);
        let stamped = part.frames.iter().find(|frame| frame.seen.camera_ns != 0);
        let relative = match (clocked.zip(stamped), first) {
            (Some((before, frame)), _) => self.follows(&before, frame),
            (None, true) => stamped.map(|_| true),
            (None, false) => None,
        };
        let absolute = off_ns.map(|off| off.abs() <= half);
        // A stamp that jumps is off, even where the readings leave the jump open.
        let set = counted.zip(begin).is_some_and(|(before, begin)| {
            self.explained.clock_set_at(before.number, begin.number)
                || self.readings.was_set_around(begin.seen.host_ns.into())
        });
        let jumped = relative == Some(false) && !part.begins && !away && !set;
        let clock = match absolute {
            Some(true) if jumped => Some(false),
            Some(near) => Some(near),
            None if away => None,
            None => relative,
        };
        let ways = part.frames.iter().filter_map(|frame| self.arrived_after(frame)).map(|(way, _)| way);
        let late_ns = ways.min().zip(usual).map(|(way, usual)| way - usual);
        Evidence { counter, clock, skipped: skip.filter(|_| !away), off_ns, late_ns }
    }

    /// Whether a part's triggers are confirmed by two sources, or at least by one; where not, that is a finding.
    fn accept(
        &self,
        part: &Part<'_>,
        evidence: &Evidence,
        before: i64,
        enclosed: bool,
        (wrong, single): (&mut Wrong, &mut Wrong),
    ) -> bool {
        let half = self.table.period_ns / 2;
        let most = if part.frames.len() <= PASSING { half * 3 / 2 } else { half };
        let early = evidence.late_ns.is_some_and(|ns| ns < -half);
        let in_time = evidence.late_ns.is_some_and(|ns| (-half..=most).contains(&ns));
        let decided = in_time || (enclosed && !early);
        let Some(begin) = part.frames.first() else { return true };
        let skip = evidence.skipped.unwrap_or(0);
        let counts = skip == 0
            || self.explained.counts(before, begin.number, skip)
            || (before < 0 && self.may_have_ignored(before, begin.number, skip));
        // Where ids fell behind, the other explanation is a clock that went ahead: then frames would arrive early.
        let borne_out = if skip < 0 { !early } else { decided };
        let stamps = self.explained.clock_set_at(before, begin.number)
            || part
                .frames
                .iter()
                .filter(|frame| frame.seen.camera_ns != 0)
                .all(|frame| self.explained.stamp(frame.number));
        let (confirmed, possible) = match (evidence.counter, evidence.clock) {
            (Some(true), Some(true)) => (true, true),
            (Some(true), Some(false)) => (stamps && decided, stamps && !early),
            (Some(false), Some(true)) => (counts && borne_out, counts && borne_out),
            (Some(true), None) => (in_time, !early),
            (Some(false), None) => (false, counts && !early),
            (None, Some(true)) => (in_time, !early),
            (None, None) => (false, in_time),
            (Some(false) | None, Some(false)) => (false, false),
        };
        let Some(range) = range_of(part.frames) else { return possible };
        if possible {
            if !confirmed {
                let source = if evidence.clock == Some(true) { "their timestamps" } else { "their ids" };
                single.add(range, || format!("only {source} show which trigger these frames are of"));
            }
            return true;
        }
        wrong.add(range, || self.message(evidence, counts, stamps));
        false
    }

    /// Triggers of the warm-up, and those before Record, have no gap records: the camera may have ignored any of them.
    fn may_have_ignored(&self, before: i64, number: i64, skip: i64) -> bool {
        const UNRECORDED: i64 = 64;
        let between = number.saturating_sub(before).saturating_sub(1);
        between > UNRECORDED || (skip < 0 && between.saturating_add(skip) >= 0)
    }

    fn message(&self, evidence: &Evidence, counts: bool, stamps: bool) -> String {
        let off = |ns: Option<i128>| ns.map_or("unknown".to_owned(), |ns| format!("{:.3} ms", ms(ns)));
        let ids = match evidence.skipped {
            None => "count anew".to_owned(),
            Some(0) => "go on".to_owned(),
            Some(skip) if counts => format!("went {skip} further than triggers"),
            Some(skip) => format!("went {skip} further than triggers, and no record states why"),
        };
        let clock = match evidence.clock {
            Some(true) => "agree".to_owned(),
            Some(false) if stamps => format!("are off by {}", off(evidence.off_ns)),
            Some(false) => format!("are off by {}, and no record states why", off(evidence.off_ns)),
            None => "cannot be compared".to_owned(),
        };
        format!(
            "not the frames of these triggers: their ids {ids}; their timestamps {clock}; the quickest arrives {} \
             later than usual; expected two sources to agree, within half a period, {:.3} ms",
            off(evidence.late_ns),
            ms(self.table.period_ns / 2)
        )
    }

    /// Frames without a stamp, of a camera that stamps the others, where no event names them.
    fn note_unstamped(&self, frames: &[Frame], notes: &mut Notes) {
        let without = frames.iter().filter(|frame| {
            self.stamped
                && frame.seen.camera_ns == 0
                && frame.number >= 0
                && !self.explained.stamp(frame.number)
        });
        let mut triggers = Rows::default();
        without.for_each(|frame| triggers.add(frame.number, 0));
        for (range, _) in triggers.0 {
            let message = "have no timestamp, and no record states why; the camera's other frames have";
            notes.add(Severity::Unconfirmed, None, Some(self.id), Some(range), message);
        }
    }
}

fn middle(mut all: Vec<i128>) -> Option<i128> {
    all.sort_unstable();
    all.get(all.len() / 2).copied()
}
