// SPDX-License-Identifier: MIT OR Apache-2.0
//! Exposures that were not, or may not have been, at the time of the others: of which camera, at which triggers, and
//! why.
//!
//! Frames of a trigger count as simultaneous where one wire, or one clock, fired all cameras. Action commands can miss
//! that (`docs/design/action-triggers.md`). What missed it is an event for each row of triggers, from which the node,
//! `verify` and `info` make the same lines.

use super::layout::{MAX_TRIGGERS, NodeEvent};
use crate::base::ids::{CameraId, TriggerIndex};
use std::collections::BTreeMap;
use std::fmt;

/// Kind of the events that name a camera and triggers whose exposures were not at one time with those of the others.
pub const NOT_SIMULTANEOUS: &str = "not_simultaneous";

/// Rows that are kept of a camera and a reason; what comes behind them joins the last one.
const ROWS: usize = 32;
/// Rows that a line names; the triggers of the others are counted.
const NAMED: usize = 8;
/// Pairs of camera and reason that are kept: it bounds what a recording's events can cost.
const LINES: usize = 64;

/// Triggers in a row; `count` is less than its length where others lie between them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TriggerRow {
    pub first: u64,
    pub last: u64,
    /// How many triggers of `first` to `last` are meant.
    pub count: u64,
}

impl TriggerRow {
    /// All triggers of `first` to `last`.
    pub fn all(first: u64, last: u64) -> Self {
        Self { first, last, count: last.saturating_sub(first).saturating_add(1) }
    }

    fn length(&self) -> u64 {
        Self::all(self.first, self.last).count
    }

    /// The part of it that is not before `first`.
    pub fn behind(self, first: u64) -> Option<Self> {
        let from = self.first.max(first);
        (from <= self.last).then(|| Self {
            count: self.count.min(Self::all(from, self.last).count),
            first: from,
            ..self
        })
    }

    /// One row that spans both rows.
    fn join(self, other: Self) -> Self {
        let (first, last) = (self.first.min(other.first), self.last.max(other.last));
        let whole = self.count == self.length() && other.count == other.length();
        let count = self.count.saturating_add(other.count).min(Self::all(first, last).count);
        if whole && self.touches(&other) { Self::all(first, last) } else { Self { first, last, count } }
    }

    fn touches(&self, other: &Self) -> bool {
        self.first <= other.last.saturating_add(1) && other.first <= self.last.saturating_add(1)
    }

    /// As an event of a camera has it. The number of the first trigger stands in the event alone, where seconds before
    /// Record can change what it is counted from.
    pub fn event(&self, camera: CameraId, why: &str, host_time_ns: u64) -> NodeEvent {
        let how_many = match (self.count, self.length()) {
            (1, 1) => "1 trigger".to_owned(),
            (count, length) if count == length => format!("{count} triggers"),
            (count, length) => format!("{count} of {length} triggers"),
        };
        NodeEvent {
            host_time_ns,
            kind: NOT_SIMULTANEOUS.to_owned(),
            camera: Some(camera),
            trigger: Some(TriggerIndex(self.first)),
            message: format!("{how_many} from here on: {why}"),
        }
    }

    /// The row of an event and its reason. `None` where it is no such event, or names no trigger that can be.
    pub fn of(event: &NodeEvent) -> Option<(Self, &str)> {
        let first = event.trigger.filter(|_| event.kind == NOT_SIMULTANEOUS)?.0;
        if first >= MAX_TRIGGERS {
            return None;
        }
        let Some((how_many, why)) = event.message.split_once(" from here on: ") else {
            return Some((Self::all(first, first), &event.message));
        };
        let mut numbers = how_many.split(' ').filter_map(|word| word.parse::<u64>().ok());
        let count = numbers.next().unwrap_or(1).max(1);
        let length = numbers.next().unwrap_or(count).max(count);
        let last = first.saturating_add(length - 1).min(MAX_TRIGGERS - 1);
        Some((Self { first, last, count: count.min(Self::all(first, last).count) }, why))
    }
}

impl fmt::Display for TriggerRow {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { first, last, count } = self;
        match (*count, self.length()) {
            (_, 1) => write!(f, "{first}"),
            (count, length) if count == length => write!(f, "{first} to {last}"),
            _ => write!(f, "{count} of {first} to {last}"),
        }
    }
}

/// Rows of triggers, in order and apart from each other; at most [`ROWS`].
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct TriggerRows(Vec<TriggerRow>);

impl TriggerRows {
    /// Adds a row, and joins it with those that it touches.
    pub fn add(&mut self, row: TriggerRow) {
        let rows = &mut self.0;
        let at = rows.partition_point(|other| other.last.saturating_add(1) < row.first);
        let mut joined = row;
        while let Some(other) = rows.get(at).filter(|other| other.touches(&joined)) {
            joined = joined.join(*other);
            rows.remove(at);
        }
        rows.insert(at, joined);
        if rows.len() > ROWS
            && let Some(last) = rows.pop()
            && let Some(before) = rows.last_mut()
        {
            *before = before.join(last);
        }
    }

    /// The rows in the order of their triggers.
    pub fn iter(&self) -> impl Iterator<Item = TriggerRow> + '_ {
        self.0.iter().copied()
    }

    /// Whether a row spans a trigger.
    pub fn covers(&self, trigger: u64) -> bool {
        self.0.iter().any(|row| (row.first..=row.last).contains(&trigger))
    }
}

impl fmt::Display for TriggerRows {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let one = matches!(self.0[..], [TriggerRow { first, last, .. }] if first == last);
        let named: Vec<String> = self.0.iter().take(NAMED).map(ToString::to_string).collect();
        write!(f, "{} {}", if one { "trigger" } else { "triggers" }, named.join(", "))?;
        let more = self.0.iter().skip(NAMED).fold(0, |sum: u64, row| sum.saturating_add(row.count));
        if more > 0 { write!(f, " and {more} more") } else { Ok(()) }
    }
}

/// All events of this kind of a recording, joined to rows.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct NotSimultaneous {
    rows: BTreeMap<(String, String), TriggerRows>,
}

impl NotSimultaneous {
    /// Takes an event into account.
    pub fn note(&mut self, event: &NodeEvent) {
        let Some((row, why)) = TriggerRow::of(event) else { return };
        let camera = event.camera.as_ref().map_or("", CameraId::as_str);
        let key = (camera.to_owned(), why.to_owned());
        if self.rows.len() < LINES || self.rows.contains_key(&key) {
            self.rows.entry(key).or_default().add(row);
        }
    }

    /// A line for each camera and reason.
    pub fn lines(&self) -> Vec<String> {
        self.rows.iter().map(|((camera, why), rows)| format!("{camera}, {rows}: {why}")).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::{NotSimultaneous, TriggerRow, TriggerRows};
    use crate::base::ids::{CameraId, TriggerIndex};
    use crate::layout::NodeEvent;
    use proptest::prelude::*;
    use std::collections::BTreeSet;

    fn rows(triggers: impl IntoIterator<Item = u64>) -> TriggerRows {
        let mut rows = TriggerRows::default();
        triggers.into_iter().for_each(|trigger| rows.add(TriggerRow::all(trigger, trigger)));
        rows
    }

    proptest! {
        #[test]
        fn rows_are_the_triggers_while_they_are_few(triggers in prop::collection::vec(0u64..60, 0..60)) {
            let rows = rows(triggers.iter().copied());
            let model: BTreeSet<u64> = triggers.into_iter().collect();
            prop_assert!((0..70).all(|trigger| rows.covers(trigger) == model.contains(&trigger)));
            prop_assert_eq!(rows.iter().map(|row| row.count).sum::<u64>(), model.len() as u64);
        }
    }

    #[test]
    fn many_rows_are_counted_and_cost_no_more() {
        let rows = rows((0..100_000).map(|i| i * 2));
        assert_eq!(rows.iter().count(), 32);
        assert_eq!(rows.iter().map(|row| row.count).sum::<u64>(), 100_000);
        assert_eq!(rows.to_string(), "triggers 0, 2, 4, 6, 8, 10, 12, 14 and 99992 more");
        assert!(rows.covers(199_998), "the last one spans what it stands for");
    }

    #[test]
    fn an_event_gives_its_row_back() {
        let camera = CameraId::from("h1_low");
        for row in
            [TriggerRow::all(7, 7), TriggerRow::all(7, 30), TriggerRow { first: 7, last: 30, count: 5 }]
        {
            let event = row.event(camera.clone(), "its clock is its own: since 5", 0);
            assert_eq!(TriggerRow::of(&event), Some((row, "its clock is its own: since 5")));
        }
        assert_eq!(TriggerRow::all(3, 9).behind(5), Some(TriggerRow::all(5, 9)));
        assert_eq!(TriggerRow::all(3, 9).behind(10), None);
    }

    #[test]
    fn lines_name_camera_triggers_and_reason_and_no_crafted_number_costs_time() {
        let mut noted = NotSimultaneous::default();
        let event = |trigger: u64, message: &str| NodeEvent {
            trigger: Some(TriggerIndex(trigger)),
            message: message.to_owned(),
            ..TriggerRow::all(0, 0).event(CameraId::from("h1_low"), "", 0)
        };
        noted.note(&event(13, "1 trigger from here on: late"));
        noted.note(&event(11, "2 triggers from here on: late"));
        noted.note(&event(20, "1 trigger from here on: late"));
        assert_eq!(noted.lines(), ["h1_low, triggers 11 to 13, 20: late"]);
        noted.note(&event(u64::MAX, "1 trigger from here on: late"));
        noted.note(&event(5, "18446744073709551615 triggers from here on: odd"));
        noted.note(&event(5, "words"));
        assert_eq!(noted.lines()[1..], ["h1_low, triggers 5 to 16777215: odd", "h1_low, trigger 5: words"]);
        (0..1000).for_each(|i| noted.note(&event(i, &format!("1 trigger from here on: {i}"))));
        assert_eq!(noted.lines().len(), 64);
    }
}
