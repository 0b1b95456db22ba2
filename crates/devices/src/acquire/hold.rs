// SPDX-License-Identifier: MIT OR Apache-2.0
//! Frame sets before Record: those of the last seconds wait in memory, and the oldest are dropped.
//!
//! Until Record is pressed, nothing that belongs to a trigger is written. Then the recording begins at a past
//! trigger, which becomes trigger 0, and all numbers are counted from it. The warm-up is kept with its numbers, so
//! that `verify` finds the beginning of every stream as in any other session.

use super::writer_queue::{ReadyFrame, ToWriter};
use crate::base::ids::TriggerIndex;
use crate::record::{FrameMeta, NodeEvent, TriggerRecord, WarmUp};
use std::collections::VecDeque;

/// Triggers behind the warm-up whose times are kept with it, because its last frames arrive among them.
const EARLY: u64 = 64;
/// Events of dropped triggers that are still recorded: the last ones.
const PAST_EVENTS: usize = 256;

/// The records that wait for Record, in order. The ring owns it; after Record it is emptied and passes everything on.
#[derive(Debug)]
pub(super) struct Hold {
    items: VecDeque<ToWriter>,
    /// Largest number of triggers that are held.
    most: u64,
    /// The warm-up: its triggers and frames, and the first triggers behind it.
    begin: Vec<NodeEvent>,
    /// Events of triggers that were dropped.
    past: VecDeque<NodeEvent>,
    /// The trigger of the train that the recording begins with; `None` before Record.
    first: Option<u64>,
    /// One more than the newest trigger with a frame or a gap record.
    end: u64,
}

/// The outcome of [`Hold::take`] for an item.
pub(super) enum Passed {
    /// The item is passed on, with the recording's trigger index.
    On(ToWriter),
    /// The item is held, or not part of the recording; the number of older frames that were dropped.
    Held(usize),
}

impl Hold {
    /// A hold for the last `most` triggers.
    pub(super) fn new(most: u64) -> Self {
        let (items, past) = (VecDeque::new(), VecDeque::new());
        Self { items, most: most.max(1), begin: Vec::new(), past, first: None, end: 0 }
    }

    /// The trigger that the recording begins with, once Record was pressed.
    pub(super) fn first(&self) -> Option<u64> {
        self.first
    }

    /// The held triggers of the train: the oldest, and one more than the newest.
    pub(super) fn held(&self) -> (u64, u64) {
        (self.end.saturating_sub(self.most), self.end)
    }

    /// Takes the next item of the session.
    pub(super) fn take(&mut self, item: ToWriter) -> Passed {
        if let Some(first) = self.first {
            return match counted_from(first, item) {
                None => Passed::Held(0),
                Some(item) if self.items.is_empty() => Passed::On(item),
                Some(item) => {
                    self.items.push_back(item);
                    Passed::Held(0)
                }
            };
        }
        match &item {
            ToWriter::Event(event) if WarmUp::of(event).is_some() => self.begin.push(event.clone()),
            ToWriter::Trigger(TriggerRecord { index, hsu_time_ns, host_time_ns, .. }) if index.0 < EARLY => {
                let number = i64::try_from(index.0).unwrap_or(i64::MAX);
                let row = WarmUp::Trigger { number, hsu_time_ns: *hsu_time_ns };
                self.begin.push(row.event(None, *host_time_ns));
                self.items.push_back(item);
            }
            other => match trigger_of(other) {
                None => return Passed::On(item),
                Some(trigger) => {
                    if matches!(item, ToWriter::Frame(_) | ToWriter::Gap(..)) {
                        self.end = self.end.max(trigger + 1);
                    }
                    self.items.push_back(item);
                }
            },
        }
        Passed::Held(self.give_way())
    }

    /// Drops the items of triggers that are too old; returns the number of frames among them.
    fn give_way(&mut self) -> usize {
        let (oldest, _) = self.held();
        let mut frames = 0;
        let gives_way = |item: &mut ToWriter| trigger_of(item).is_none_or(|trigger| trigger < oldest);
        while let Some(item) = self.items.pop_front_if(gives_way) {
            match item {
                ToWriter::Frame(_) => frames += 1,
                ToWriter::Event(event) => {
                    if self.past.len() == PAST_EVENTS {
                        self.past.pop_front();
                    }
                    self.past.push_back(event);
                }
                _ => {}
            }
        }
        frames
    }

    /// Record was pressed: the recording begins with this trigger of the train. Returns the number of held frames
    /// that are older, and the triggers from `first` on that are not held any more. A second call changes nothing.
    pub(super) fn keep(&mut self, first: u64) -> (usize, std::ops::Range<u64>) {
        if self.first.is_some() {
            return (0, 0..0);
        }
        let (oldest, _) = self.held();
        let frames = |items: &VecDeque<ToWriter>| {
            items.iter().filter(|item| matches!(item, ToWriter::Frame(_))).count()
        };
        let before = frames(&self.items);
        let events = std::mem::take(&mut self.begin).into_iter().chain(std::mem::take(&mut self.past));
        let all = events.map(ToWriter::Event).chain(std::mem::take(&mut self.items));
        self.items = all.filter_map(|item| counted_from(first, item)).collect();
        self.first = Some(first);
        (before - frames(&self.items), first..oldest.max(first))
    }

    /// The next item to pass on; none before Record.
    pub(super) fn next(&mut self) -> Option<ToWriter> {
        self.items.pop_front_if(|_| self.first.is_some())
    }
}

/// The trigger of an item; `None` for items without one.
fn trigger_of(item: &ToWriter) -> Option<u64> {
    match item {
        ToWriter::Frame(frame) => Some(frame.meta.trigger.0),
        ToWriter::Gap(_, trigger, _) => Some(trigger.0),
        ToWriter::Trigger(record) => Some(record.index.0),
        ToWriter::Event(event) => event.trigger.map(|trigger| trigger.0),
        ToWriter::Clock(_) | ToWriter::End(_) => None,
    }
}

/// An item of a recording whose trigger 0 is `first` of the train; `None` where its trigger is earlier.
fn counted_from(first: u64, item: ToWriter) -> Option<ToWriter> {
    let index = |trigger: TriggerIndex| trigger.0.checked_sub(first).map(TriggerIndex);
    Some(match item {
        ToWriter::Frame(frame) => {
            let trigger = index(frame.meta.trigger)?;
            ToWriter::Frame(ReadyFrame { meta: FrameMeta { trigger, ..frame.meta }, ..frame })
        }
        ToWriter::Gap(camera, trigger, cause) => ToWriter::Gap(camera, index(trigger)?, cause),
        ToWriter::Trigger(record) => {
            ToWriter::Trigger(TriggerRecord { index: index(record.index)?, ..record })
        }
        ToWriter::Event(event) => match (WarmUp::of(&event), event.trigger) {
            (Some(WarmUp::Trigger { number, hsu_time_ns }), _) => {
                let number = number.checked_sub(i64::try_from(first).ok()?).filter(|number| *number < 0)?;
                let row = WarmUp::Trigger { number, hsu_time_ns };
                ToWriter::Event(row.event(event.camera, event.host_time_ns))
            }
            // An earlier event stays, without its trigger, which the recording does not have.
            (_, Some(trigger)) => ToWriter::Event(NodeEvent { trigger: index(trigger), ..event }),
            _ => ToWriter::Event(event),
        },
        other @ (ToWriter::Clock(_) | ToWriter::End(_)) => other,
    })
}

#[cfg(test)]
mod tests;
