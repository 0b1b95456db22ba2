// SPDX-License-Identifier: MIT OR Apache-2.0
//! Triggers in a row: so that a fault which lasts is one finding.

use super::findings::{Notes, Severity};
use super::frame::{Frame, range_of};
use crate::base::ids::CameraId;

/// Triggers in a row with the same fault, each with the ns of the first.
#[derive(Default)]
pub struct Rows(pub Vec<((u64, u64), i128)>);

impl Rows {
    /// One more; those of the warm-up have no place in the session and are left out.
    pub fn add(&mut self, number: i64, ns: i128) {
        let Ok(trigger) = u64::try_from(number) else { return };
        match self.0.last_mut() {
            Some(((_, last), _)) if *last + 1 == trigger => *last = trigger,
            _ => self.0.push(((trigger, trigger), ns)),
        }
    }

    /// A finding for each row: data is corrupt. The message is made of the first one's time, ms.
    pub fn note(self, camera: Option<&CameraId>, notes: &mut Notes, message: impl Fn(f64) -> String) {
        for (range, ns) in self.0 {
            notes.add(Severity::Corrupt, None, camera, Some(range), message(ms(ns)));
        }
    }
}

/// Parts whose triggers no two sources confirm, with the message of the first of a row.
#[derive(Default)]
pub struct Wrong(pub Vec<((u64, u64), String)>);

impl Wrong {
    /// Adds a part, to the last row if it continues it.
    pub fn add(&mut self, range: (u64, u64), message: impl FnOnce() -> String) {
        match self.0.last_mut() {
            Some(((_, last), _)) if *last + 1 == range.0 => *last = range.1,
            _ => self.0.push((range, message())),
        }
    }
}

/// Frames that come later than usual, in a row.
#[derive(Default)]
pub struct Late {
    runs: Vec<(Frame, Frame, usize)>,
    open: bool,
}

impl Late {
    /// The next ones, and whether all of them are late.
    pub fn add(&mut self, frames: &[Frame], late: bool) {
        let Some((first, last)) = frames.first().zip(frames.last()).filter(|_| late) else {
            self.open = false;
            return;
        };
        match self.runs.last_mut().filter(|_| self.open) {
            Some((_, end, count)) => (*end, *count) = (*last, *count + frames.len()),
            None => self.runs.push((*first, *last, frames.len())),
        }
        self.open = true;
    }

    /// Rows of at least `count` frames that are late for at least `ns`.
    pub fn long(&self, ns: i128, count: usize) -> Vec<(u64, u64)> {
        let long = |(first, last, frames): &&(Frame, Frame, usize)| {
            *frames >= count && last.hsu_ns - first.hsu_ns >= ns
        };
        let ends = self.runs.iter().filter(long);
        ends.filter_map(|(first, last, _)| range_of(&[*first, *last])).collect()
    }
}

/// Nanoseconds as milliseconds, for messages.
pub fn ms(ns: i128) -> f64 {
    ns as f64 / 1e6
}
