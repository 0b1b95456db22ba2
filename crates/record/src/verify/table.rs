// SPDX-License-Identifier: MIT OR Apache-2.0
//! The trigger table as a witness of its own: its rhythm, the header's rate, the HSU's clock and the reports' arrival.

use super::findings::{Notes, Severity};
use super::header::severity;
use super::readings::{HostTime, Readings};
use super::rows::{Rows, ms};
use crate::layout::{TriggerRecord, WarmUp};
use crate::reader::RecordingReader;
use crate::recover::RECOVERED;
use crate::session::parse_rig;
use hsu_firmware_proto::TriggerFlags;
use std::collections::BTreeMap;

/// Rates that a header may state, Hz: what is beyond is a damaged or made-up number.
const RATES_HZ: std::ops::RangeInclusive<f64> = 0.01..=100_000.0;
/// Reciprocal of the largest relative difference between the rates of table and header: 59.94 Hz may be called 60.
const RATE: i128 = 50;
/// Steps of single triggers from which their median is used as the period.
const STEPS: usize = 8;
/// Reports among which one must have arrived without delay.
const REPORTS: usize = 64;
/// Lowest number of a warm-up trigger, negated: it bounds what a wrong number can cost.
const WARM_UP_MAX: i64 = 1 << 40;
/// Largest number of missing triggers between two that times are interpolated for.
const HOLE_MAX: i64 = 1 << 20;

/// When triggers were fired, HSU clock.
///
/// Verification makes one for each recording and drops it at the end. It promises times as they were reported, or
/// between two that were; nothing is extrapolated.
pub struct Table {
    /// Rows by number; those of the warm-up are negative.
    rows: BTreeMap<i64, Row>,
    /// The HSU's clock against the host's.
    pub readings: Readings,
    /// Trigger period, ns; at least 1.
    pub period_ns: i128,
    /// When anything but a frame was recorded last, host clock, ns.
    pub last_ns: i128,
}

#[derive(Debug, Clone, Copy)]
struct Row {
    hsu_ns: i128,
    /// The recorded row; warm-up triggers have none.
    recorded: Option<TriggerRecord>,
}

impl Table {
    /// As recorded; `None` where neither header nor table state a period. Contradictions become findings.
    pub fn of(recording: &RecordingReader, notes: &mut Notes) -> Option<Self> {
        let readings = Readings::of(recording.clock_samples.iter().filter(|sample| sample.camera.is_none()));
        let mut rows: BTreeMap<i64, Row> = BTreeMap::new();
        for event in &recording.events {
            let Some(WarmUp::Trigger { number, hsu_time_ns }) = WarmUp::of(event) else { continue };
            let hsu_ns = i128::from(hsu_time_ns);
            if !(-WARM_UP_MAX..0).contains(&number) {
                let message =
                    format!("a warm-up trigger has number {number}, expected a negative one above -2^40");
                notes.add(Severity::Corrupt, None, None, None, message);
            } else if rows
                .insert(number, Row { hsu_ns, recorded: None })
                .is_some_and(|row| row.hsu_ns != hsu_ns)
            {
                let message = format!("two different times of warm-up trigger {number}");
                notes.add(Severity::Corrupt, None, None, None, message);
            }
        }
        for (index, row) in &recording.triggers {
            if let Ok(number) = i64::try_from(index.0) {
                rows.insert(number, Row { hsu_ns: row.hsu_time_ns.into(), recorded: Some(*row) });
            }
        }
        let mut steps: Vec<i128> = pairs(&rows)
            .filter(|((before, _), (number, _))| *before >= 0 && number - before == 1)
            .map(|((_, row), (_, next))| next.hsu_ns - row.hsu_ns)
            .collect();
        steps.sort_unstable();
        let usual = steps.get(steps.len() / 2).copied().filter(|ns| *ns > 0);
        let period_ns = stated_period(recording, notes);
        if let Some((stated, found)) = period_ns.zip(usual.filter(|_| steps.len() >= STEPS))
            && (stated - found).abs() > stated / RATE
        {
            let message = format!(
                "the header states {} triggers per second, the trigger table has {:.3}",
                recording.header.trigger_rate_hz,
                1e9 / found as f64
            );
            notes.add(severity(recording), None, None, None, message);
        }
        let period_ns = usual.filter(|_| steps.len() >= STEPS).or(period_ns).or(usual)?;
        // The event of a copy has the time at which it was made.
        let events =
            recording.events.iter().filter(|event| event.kind != RECOVERED).map(|event| event.host_time_ns);
        let samples = recording.clock_samples.iter().map(|sample| sample.host_receive_ns);
        let reports = recording.triggers.values().map(|row| row.host_time_ns);
        let last_ns = events.chain(samples).chain(reports).max().unwrap_or(u64::MAX).into();
        Some(Self { rows, readings, period_ns: period_ns.max(1), last_ns })
    }

    /// When a trigger was fired, HSU clock, ns: as reported, or between two that were.
    pub fn fired_ns(&self, number: i64) -> Option<i128> {
        if let Some(row) = self.rows.get(&number) {
            return Some(row.hsu_ns);
        }
        let (before, row) = self.rows.range(..number).next_back()?;
        let (after, next) = self.rows.range(number..).next()?;
        let all = after.checked_sub(*before).filter(|all| *all <= HOLE_MAX)?;
        Some(row.hsu_ns + (next.hsu_ns - row.hsu_ns) * i128::from(number - before) / i128::from(all))
    }

    /// The host's time of a time of the HSU: by its readings, or where there are none, by the quickest report around
    /// it.
    pub fn host_time(&self, hsu_ns: i128, number: i64) -> Option<HostTime> {
        if let Some(found) = self.readings.longest().and_then(|epoch| epoch.host_time(hsu_ns)) {
            return Some(found);
        }
        const AROUND: i64 = 32;
        let around = number.saturating_sub(AROUND)..=number.saturating_add(AROUND);
        let reports = self
            .rows
            .range(around)
            .filter_map(|(_, row)| Some(i128::from(row.recorded?.host_time_ns) - row.hsu_ns));
        reports.min().map(|ns| HostTime { ns: hsu_ns + ns, open_ns: self.period_ns / 4 })
    }

    /// Warm-up triggers and those right behind them, with their times: at most `most`.
    pub fn begin(&self, most: usize) -> Vec<(i64, i128)> {
        match self.rows.first_key_value() {
            Some((first, _)) if *first < 0 => {
                self.rows.iter().take(most).map(|(number, row)| (*number, row.hsu_ns)).collect()
            }
            _ => Vec::new(),
        }
    }

    /// Checks the table against its own rhythm and flags, and against the arrival of its reports. A single segment is
    /// not the `whole`: it does not have the beginning.
    pub fn check(&self, recording: &RecordingReader, whole: bool, notes: &mut Notes) {
        self.check_steps(notes);
        self.check_flags(recording, notes);
        self.check_reports(recording, notes);
        self.check_clock(notes);
        if whole {
            check_created(recording, notes);
        }
    }

    /// Triggers are at least 7/8 of a period apart, and one that is late is flagged (`hsu-protocol.md`, invariant 5).
    fn check_steps(&self, notes: &mut Notes) {
        let period = self.period_ns;
        let slack = period / RATE + 1_000;
        let (mut close, mut silent) = (Rows::default(), Rows::default());
        for ((before, row), (number, next)) in pairs(&self.rows) {
            let (count, step) = (i128::from(number - before), next.hsu_ns - row.hsu_ns);
            if step < count * (period - period / 8 - slack) {
                if number < 0 {
                    let message =
                        format!("warm-up trigger {number} was fired {:.3} ms after the one before", ms(step));
                    notes.add(Severity::Corrupt, None, None, None, message);
                }
                close.add(number, step);
            }
            let late = next.recorded.is_some_and(|row| row.flags & u32::from(TriggerFlags::LATE.0) == 0)
                && count == 1
                && step > period + period / 16 + slack;
            if late {
                silent.add(number, step);
            }
        }
        let period = ms(period);
        close.note(None, notes, |step| {
            if step <= 0.0 {
                return format!("HSU time is not after that of the trigger before: {:.0} ns", step * 1e6);
            }
            format!(
                "fired {step:.3} ms after the trigger before; expected at least 7/8 of a period of {period:.3} ms"
            )
        });
        silent.note(None, notes, |step| {
            format!(
                "fired {step:.3} ms after the trigger before, and the HSU did not flag it as late; expected a period \
                 of {period:.3} ms"
            )
        });
    }

    fn check_flags(&self, recording: &RecordingReader, notes: &mut Notes) {
        let last = recording.triggers.keys().next_back().copied();
        let pressed = recording.events.iter().any(|event| event.kind == RECORD_PRESSED);
        for (index, row) in &recording.triggers {
            let has = |flag: TriggerFlags| row.flags & u32::from(flag.0) != 0;
            let at = Some((index.0, index.0));
            if has(TriggerFlags::WARM_UP) {
                let message =
                    "the HSU flags it as a trigger of the warm-up, but it has a place in the session";
                notes.add(Severity::Corrupt, None, None, at, message);
            }
            if !has(TriggerFlags::LAST) {
                continue;
            }
            let requested = recording.header.expected_triggers.filter(|_| !pressed);
            if Some(*index) != last {
                let message = "the HSU flags it as the last trigger, but there are later ones";
                notes.add(Severity::Corrupt, None, None, at, message);
            } else if let Some(requested) = requested.filter(|requested| *requested != index.0 + 1) {
                let message =
                    format!("the HSU flags it as the last trigger; the header requests {requested} triggers");
                notes.add(Severity::Corrupt, None, None, at, message);
            }
        }
    }

    /// A report does not arrive before its trigger is fired; and of many, one arrives without delay.
    fn check_reports(&self, recording: &RecordingReader, notes: &mut Notes) {
        let (mut early, mut quickest, mut count) = (Rows::default(), i128::MAX, 0);
        for (number, row) in &self.rows {
            let Some(recorded) = row.recorded.filter(|_| !self.readings.epochs.is_empty()) else { continue };
            let Some(fired) = self.host_time(row.hsu_ns, *number) else { continue };
            let way = i128::from(recorded.host_time_ns) - fired.ns;
            if way + fired.open_ns + self.period_ns / 8 < 0 {
                early.add(*number, way);
            }
            quickest = quickest.min(way - fired.open_ns);
            count += 1;
        }
        early.note(None, notes, |way| {
            let before = -way;
            format!(
                "reported {before:.3} ms before it was fired, by the recorded readings of the HSU's clock"
            )
        });
        if count >= REPORTS && quickest > self.period_ns * 3 / 4 {
            let message = format!(
                "the quickest of {count} reports came {:.3} ms after its trigger: the trigger times, or the readings \
                 of the HSU's clock, are early",
                ms(quickest)
            );
            let rows = recording.triggers.first_key_value().zip(recording.triggers.last_key_value());
            let rows = rows.map(|((first, _), (last, _))| (first.0, last.0));
            notes.add(Severity::Corrupt, None, None, rows, message);
        }
    }

    /// The HSU's clock is not set during a session.
    fn check_clock(&self, notes: &mut Notes) {
        for (at, by) in self.readings.settings() {
            let message = format!(
                "the HSU's clock was set by {:.3} ms at {at} ns of the host's clock, by its readings; its triggers go \
                 on",
                ms(by)
            );
            notes.add(Severity::Corrupt, None, None, None, message);
        }
        note_readings(&self.readings, None, "the HSU's clock", notes);
    }

    /// Compares what two nodes recorded of the same HSU: a trigger has one time, and one set of flags. Returns how many
    /// triggers both tables have, and in how many the rows differ.
    pub fn compare(first: &RecordingReader, other: &RecordingReader, notes: &mut Notes) -> (u64, u64) {
        let both =
            other.triggers.iter().filter_map(|(index, row)| Some((index.0, row, first.triggers.get(index)?)));
        let (mut rows, mut differ) = (0, Vec::new());
        for (index, found, expected) in both {
            rows += 1;
            if (found.hsu_time_ns, found.flags) != (expected.hsu_time_ns, expected.flags) {
                differ.push((index, found, expected));
            }
        }
        let node = &first.header.node;
        if let (Some((index, found, expected)), Some((last, ..))) = (differ.first(), differ.last()) {
            let count = differ.len();
            let shown = |row: &TriggerRecord| format!("{} ns with flags {:#x}", row.hsu_time_ns, row.flags);
            let message = format!(
                "{count} triggers have another HSU time than on node {node}; trigger {index}: {}, there {}",
                shown(found),
                shown(expected)
            );
            notes.add(Severity::Corrupt, None, None, Some((*index, *last)), message);
        }
        let warm_up = |recording: &RecordingReader| -> BTreeMap<i64, u64> {
            let events = recording.events.iter().filter_map(WarmUp::of);
            let triggers = events.filter_map(|sample| match sample {
                WarmUp::Trigger { number, hsu_time_ns } => Some((number, hsu_time_ns)),
                WarmUp::Frame { .. } => None,
            });
            triggers.collect()
        };
        let here = warm_up(other);
        let mut there = warm_up(first).into_iter();
        if let Some((number, ns)) = there.find(|(number, ns)| here.get(number).is_some_and(|own| own != ns)) {
            let message = format!(
                "warm-up trigger {number} has another HSU time than on node {node}, which has {ns} ns"
            );
            notes.add(Severity::Corrupt, None, None, None, message);
        }
        (rows, differ.len() as u64)
    }
}

/// Kind of the event at the trigger at which Record was pressed.
const RECORD_PRESSED: &str = "record_pressed";

/// A recording is created when its devices are prepared: their clocks are read then, and no trigger comes before.
fn check_created(recording: &RecordingReader, notes: &mut Notes) {
    const SLACK_NS: u64 = 1_000_000_000;
    const PREPARED_NS: u64 = 60_000_000_000;
    let created = recording.header.created_ns;
    let report = recording.triggers.first_key_value().map(|(_, row)| row.host_time_ns);
    let reading = recording.clock_samples.iter().map(|sample| sample.host_send_ns).min();
    let late = report.is_some_and(|first| created > first.saturating_add(SLACK_NS));
    if late || reading.is_some_and(|first| created.abs_diff(first) > PREPARED_NS) {
        let shown = |ns: Option<u64>| ns.map_or("none".to_owned(), |ns| format!("at {ns} ns"));
        let message = format!(
            "created at {created} ns of the host's clock, but its first reading of a clock is {}, its first report of \
             a trigger {}",
            shown(reading),
            shown(report)
        );
        notes.add(severity(recording), None, None, None, message);
    }
}

/// Findings for readings of a clock that are impossible, and for those that the others contradict.
pub fn note_readings(
    readings: &Readings,
    camera: Option<&crate::base::ids::CameraId>,
    of: &str,
    notes: &mut Notes,
) {
    if let Some(at) = readings.impossible.first() {
        let count = readings.impossible.len();
        let message = format!(
            "{count} readings of {of} were answered before they were requested, the first at {at} ns"
        );
        notes.add(Severity::Corrupt, None, camera, None, message);
    }
    if let Some((at, _)) = readings.strays.first() {
        let count = readings.strays.len();
        let message = format!(
            "{count} readings of {of} contradict those around them and are not used, the first at {at} ns of the \
             host's clock"
        );
        notes.add(Severity::Unconfirmed, None, camera, None, message);
    }
}

/// The header's period, ns; `None` where it states none that is possible.
fn stated_period(recording: &RecordingReader, notes: &mut Notes) -> Option<i128> {
    let rate = recording.header.trigger_rate_hz;
    if rate == 0.0 {
        // Such a header was rebuilt by `recover`.
        let message = "its header states no trigger rate; the trigger table's own is used";
        notes.add(Severity::Unconfirmed, None, None, None, message);
        return None;
    }
    if !RATES_HZ.contains(&rate) {
        let message = format!(
            "its header states {rate} triggers per second, expected {} to {}",
            RATES_HZ.start(),
            RATES_HZ.end()
        );
        notes.add(severity(recording), None, None, None, message);
        return None;
    }
    if let Ok(rig) = parse_rig(&recording.header.rig_text)
        && rig.trigger_rate_hz != rate
    {
        let message =
            format!("its header states {rate} triggers per second, its rig file {}", rig.trigger_rate_hz);
        notes.add(severity(recording), None, None, None, message);
    }
    Some((1e9 / rate) as i128)
}

/// Each row with the one behind it.
fn pairs(rows: &BTreeMap<i64, Row>) -> impl Iterator<Item = ((i64, Row), (i64, Row))> + '_ {
    let rows = || rows.iter().map(|(number, row)| (*number, *row));
    rows().zip(rows().skip(1))
}
