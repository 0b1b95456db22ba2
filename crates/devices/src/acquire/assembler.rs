// SPDX-License-Identifier: MIT OR Apache-2.0
//! Frame sets: the frames of one trigger are passed on together, in the order of triggers.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// Assembles frame sets of frames `F`. The accounting owns it for one session. A set leaves when all expected cameras
/// have an outcome, or when it has waited long enough.
#[derive(Debug)]
pub struct Assembler<F> {
    /// Cameras whose outcomes a set waits for, one bit each.
    expected: u64,
    open: VecDeque<Open<F>>,
    /// Sets of triggers below this have been passed on.
    passed: u64,
    patience: Duration,
    most_open: usize,
    /// Sets before this trigger wait for their patience, however many are open.
    patient_until: u64,
    spare: Vec<Vec<F>>,
}

#[derive(Debug)]
struct Open<F> {
    trigger: u64,
    outcomes: u64,
    frames: Vec<F>,
    since: Instant,
}

impl<F> Assembler<F> {
    /// An assembler for up to 64 cameras. A set waits for its last outcome at most for `patience`, and only while
    /// there are at most `most_open` sets.
    pub fn new(cameras: usize, patience: Duration, most_open: usize) -> Self {
        let expected = if cameras >= 64 { u64::MAX } else { (1 << cameras) - 1 };
        Self {
            expected,
            open: VecDeque::new(),
            passed: 0,
            patience,
            most_open,
            patient_until: 0,
            spare: Vec::new(),
        }
    }

    /// Sets whether a set waits for this camera's outcome.
    pub fn expect(&mut self, camera: usize, expected: bool) {
        let bit = 1u64.checked_shl(camera as u32).unwrap_or(0);
        if expected { self.expected |= bit } else { self.expected &= !bit }
    }

    /// Lets sets before this trigger wait, however many are open: their frames come all at once, camera by camera.
    pub fn wait_until(&mut self, trigger: u64) {
        self.patient_until = self.patient_until.max(trigger);
    }

    /// Enters a camera's outcome for a trigger: its frame, or none.
    pub fn outcome(&mut self, camera: usize, trigger: u64, frame: Option<F>, now: Instant) {
        if frame.is_none() && trigger < self.passed {
            return;
        }
        let place = self.open.partition_point(|open| open.trigger < trigger);
        if self.open.get(place).is_none_or(|open| open.trigger != trigger) {
            let frames = self.spare.pop().unwrap_or_default();
            self.open.insert(place, Open { trigger, outcomes: 0, frames, since: now });
        }
        let open = &mut self.open[place];
        open.outcomes |= 1u64.checked_shl(camera as u32).unwrap_or(0);
        open.frames.extend(frame);
    }

    /// The next set that is complete or has waited long enough, with its trigger; sets leave in order. Frames that
    /// come after their set has left form a set of their own. `all`: complete or not.
    pub fn next(&mut self, now: Instant, all: bool) -> Option<(u64, Vec<F>)> {
        let first = self.open.front()?;
        let complete = first.outcomes & self.expected == self.expected || first.trigger < self.passed;
        let late = now.saturating_duration_since(first.since) >= self.patience;
        let crowded = self.open.len() > self.most_open && first.trigger >= self.patient_until;
        if !(all || complete || late || crowded) {
            return None;
        }
        let open = self.open.pop_front()?;
        self.passed = self.passed.max(open.trigger + 1);
        Some((open.trigger, open.frames))
    }

    /// Takes an emptied set's memory back.
    pub fn recycle(&mut self, mut frames: Vec<F>) {
        frames.clear();
        self.spare.push(frames);
    }

    /// Sets of triggers below this have been passed on.
    pub fn passed(&self) -> u64 {
        self.passed
    }

    /// Number of frames that wait in sets.
    pub fn waiting(&self) -> usize {
        self.open.iter().map(|open| open.frames.len()).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::Assembler;
    use std::time::{Duration, Instant};

    const PATIENCE: Duration = Duration::from_millis(50);

    #[test]
    fn a_set_leaves_when_every_camera_has_an_outcome() {
        let (now, mut sets) = (Instant::now(), Assembler::new(3, PATIENCE, 8));
        sets.outcome(0, 5, Some("a5"), now);
        sets.outcome(1, 5, Some("b5"), now);
        sets.outcome(0, 6, Some("a6"), now);
        assert!(sets.next(now, false).is_none());
        sets.outcome(2, 5, None, now);
        let set = sets.next(now, false).expect("complete");
        assert_eq!(set, (5, vec!["a5", "b5"]));
        assert!(sets.next(now, false).is_none());
    }

    #[test]
    fn a_late_frame_follows_alone() {
        let (now, mut sets) = (Instant::now(), Assembler::new(2, PATIENCE, 8));
        sets.outcome(0, 0, Some("a0"), now);
        sets.outcome(0, 1, Some("a1"), now);
        let later = now + PATIENCE;
        let numbers: Vec<u64> =
            std::iter::from_fn(|| sets.next(later, false)).map(|(trigger, _)| trigger).collect();
        assert_eq!(numbers, [0, 1]);
        sets.outcome(1, 0, Some("b0"), later);
        let set = sets.next(later, false).expect("it follows at once");
        assert_eq!(set, (0, vec!["b0"]));
    }

    #[test]
    fn open_sets_are_bounded_and_lost_cameras_not_waited_for() {
        let (now, mut sets) = (Instant::now(), Assembler::new(2, PATIENCE, 2));
        (0..5).for_each(|trigger| sets.outcome(0, trigger, Some(trigger), now));
        assert_eq!(std::iter::from_fn(|| sets.next(now, false)).count(), 3);
        sets.expect(1, false);
        assert_eq!(std::iter::from_fn(|| sets.next(now, false)).count(), 2);
    }
}
