// SPDX-License-Identifier: MIT OR Apache-2.0
//! The accounting: outcomes counted again, and the trigger table.

use super::findings::{Notes, Severity};
use crate::layout::MAX_TRIGGERS;
use crate::noted::{Noted, REFUSED, SETTING_CHANGED, UNCONFIRMED};
use crate::reader::{GapRun, RecordingReader};
use crate::simultaneous::TriggerRow;
use crate::verdict::{Status, TriggerSet, Verdict};

/// The verdict as the records give it. What records cannot show (the HSU's count, why it was aborted) comes
/// from the stored one.
pub fn recount(recording: &RecordingReader) -> Verdict {
    let stored = recording.verdict.as_ref();
    let emitted = stored.and_then(|verdict| verdict.triggers_emitted);
    let mut noted = Noted::default();
    recording.events.iter().for_each(|event| noted.note(event));
    let mut verdict = Verdict {
        status: Status::Incomplete,
        triggers: recording.known_end().max(emitted.unwrap_or(0)),
        triggers_expected: recording.header.expected_triggers,
        triggers_emitted: emitted,
        cameras: recording.counted(),
        untimed: 0,
        refused: noted.refused,
        unconfirmed: noted.unconfirmed,
        changed: noted.changed,
        not_simultaneous: noted.not_simultaneous.lines(),
        aborted: stored.and_then(|verdict| verdict.aborted.clone()),
        advice: recording.advice(),
    };
    let mut rows = TriggerSet::default();
    for index in recording.triggers.keys() {
        rows.insert(index.0);
    }
    verdict.untimed = Verdict::untimed(&recording.header, &rows, verdict.triggers);
    verdict.status = verdict.judge();
    verdict
}

/// The verdict without the count of missing rows, which earlier versions did not store: rows that are missing are noted by
/// themselves.
fn without_rows(verdict: &Verdict) -> Verdict {
    let mut without = Verdict { untimed: 0, ..verdict.clone() };
    without.status = without.judge();
    without
}

/// Compares the accounting with what was stored and with itself.
pub fn check(recording: &RecordingReader, verdict: &Verdict, notes: &mut Notes) {
    if let Some(first) = recording.segments.first().filter(|segment| segment.number != 0) {
        let message = format!("expected segment 0 first, found segment {}", first.number);
        notes.add(Severity::Corrupt, None, None, None, message);
    }
    match &recording.verdict {
        None => {
            let message = "no verdict: the recording was not finished; run `fourdbody recover`";
            notes.add(Severity::Corrupt, None, None, None, message);
        }
        Some(stored) if stored != verdict && *stored != without_rows(verdict) => {
            let message =
                format!("the stored verdict differs from the records; stored: {stored}; counted: {verdict}");
            notes.add(Severity::Corrupt, None, None, None, message);
        }
        Some(_) => {}
    }
    if recording.belonging.written().is_none() {
        let message = "its records have no mark of their session, as in earlier versions: only the headers show that \
            none of another session is among them";
        notes.add(Severity::Note, None, None, None, message);
    }
    for range in recording.numbers.absent(recording.numbered().min(MAX_TRIGGERS)) {
        let message = format!(
            "{} small records are missing (rows of the trigger table, gap records, samples or events), numbers {} to \
             {}",
            range.end - range.start,
            range.start,
            range.end - 1
        );
        notes.add(Severity::Corrupt, None, None, None, message);
    }
    if verdict.status == Status::Aborted || verdict.triggers_expected.is_some_and(|n| n != verdict.triggers) {
        let first_line = verdict.to_string().lines().next().unwrap_or_default().to_owned();
        notes.add(Severity::Loss, None, None, None, first_line);
    }
    if verdict.triggers_emitted.is_some_and(|n| n < verdict.triggers) {
        let (triggers, emitted) = (verdict.triggers, verdict.triggers_emitted.unwrap_or(0));
        let message = format!("outcomes for {triggers} triggers, but the HSU emitted {emitted}");
        notes.add(Severity::Corrupt, None, None, None, message);
    } else if verdict.triggers_emitted.is_none() && recording.verdict.is_some() {
        notes.add(Severity::Loss, None, None, None, "the HSU's trigger count is missing");
    }
    for event in &recording.events {
        let trigger = event.trigger.map(|t| (t.0, t.0));
        let severity = match event.kind.as_str() {
            REFUSED => Some(Severity::Loss),
            UNCONFIRMED | SETTING_CHANGED => Some(Severity::Unconfirmed),
            _ => None,
        };
        if let Some(severity) = severity {
            notes.add(severity, None, event.camera.as_ref(), trigger, &event.message);
        }
        if let Some((row, why)) = TriggerRow::of(event) {
            let triggers = Some((row.first, row.last));
            let whole = row == TriggerRow::all(row.first, row.last);
            let some = if whole { String::new() } else { format!("{} of these are ", row.count) };
            let message = format!("{some}not simultaneous with the others: {why}");
            notes.add(Severity::Unconfirmed, None, event.camera.as_ref(), triggers, message);
        }
    }
    check_outcomes(recording, verdict.triggers, notes);
    check_table(recording, verdict.triggers, notes);
}

/// A line for each run of triggers with the same cause, and for each run without any outcome.
fn check_outcomes(recording: &RecordingReader, triggers: u64, notes: &mut Notes) {
    let cameras = recording.header.cameras.iter().zip(&recording.outcomes).zip(recording.gap_runs());
    for ((camera, outcomes), runs) in cameras {
        for range in absent(outcomes.keys().copied(), triggers) {
            let message = "neither a frame nor a gap record";
            notes.add(Severity::Corrupt, None, Some(&camera.id), Some(range), message);
        }
        for GapRun { triggers, cause } in runs {
            let range = (triggers.start, triggers.end - 1);
            notes.add(Severity::Loss, None, Some(&camera.id), Some(range), format!("gap: {cause}"));
        }
    }
}

/// First and last of each row of triggers below `end` that are not among those, which are in order.
fn absent(there: impl Iterator<Item = u64>, end: u64) -> Vec<(u64, u64)> {
    let (mut rows, mut next) = (Vec::new(), 0);
    for trigger in there.chain([end]) {
        if next < trigger {
            rows.push((next, trigger - 1));
        }
        next = next.max(trigger.saturating_add(1));
    }
    rows
}

/// The trigger table has a row for every trigger. Imported images have no table.
fn check_table(recording: &RecordingReader, triggers: u64, notes: &mut Notes) {
    if recording.header.hsu.is_none() {
        return;
    }
    let rows = recording.triggers.keys().map(|index| index.0).filter(|index| *index <= triggers);
    for range in absent(rows, triggers) {
        notes.add(Severity::Loss, None, None, Some(range), "no row in the HSU's trigger table");
    }
}
