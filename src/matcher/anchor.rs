// SPDX-License-Identifier: MIT OR Apache-2.0
//! Where a stream begins: which trigger its first block id stands for.
//!
//! A stream is silent before the train starts, so its first block is the first warm-up trigger's. That alone would be
//! one witness: a camera may ignore its first trigger, or lose its first frame. The second one is the rhythm of the
//! warm-up: the HSU leaves longer pauses before some of its triggers (`hsu-protocol.md`), and only the right place
//! makes the way from trigger to timestamp the same for all frames. How long that way is, is not assumed.

use super::sighting::Sighting;
use super::trigger_table::TriggerTable;

/// The last frames that are looked at.
const FRAMES: usize = 32;
/// Places that are tried, in triggers after the one that silence gives.
const SHIFTS: std::ops::RangeInclusive<i64> = -4..=16;
/// A place is confirmed where three quarters of the frames fit, and so many more than at any other.
const MARGIN: usize = 2;
/// Frames before a place can be confirmed.
const ENOUGH: usize = 5;
/// A frame may come so many periods after its trigger and no later.
const DELAY_PERIODS: i128 = 4;

/// A frame of the warm-up.
#[derive(Debug, Clone, Copy)]
pub struct Early {
    /// Block ids after the stream's first.
    pub count: i64,
    /// Its timestamp, camera clock, ns; `None` where the camera gives none.
    pub camera_ns: Option<u64>,
    /// When it arrived, HSU clock, ns; `None` while that clock is not known.
    pub arrived_ns: Option<i128>,
}

/// Where a stream stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Place {
    /// A frame's trigger is its count and this.
    pub offset: i64,
    /// Whether the rhythm of the warm-up says so, too.
    pub confirmed: bool,
}

/// Finds a stream's place from its first frames.
#[derive(Debug, Clone, Default)]
pub struct Anchoring {
    frames: Vec<Early>,
}

impl Anchoring {
    /// A frame came.
    pub fn add(&mut self, frame: Early) {
        if self.frames.len() == FRAMES {
            self.frames.remove(0);
        }
        self.frames.push(frame);
    }

    /// The last frame.
    pub fn last(&self) -> Option<&Early> {
        self.frames.last()
    }

    /// Whether a frame, so many ids after the stream's first, is the last one once more.
    pub fn is_copy(&self, frame: &Sighting, count: i64) -> bool {
        self.last().is_some_and(|last| {
            count <= last.count && (frame.camera_ns.is_none() || frame.camera_ns == last.camera_ns)
        })
    }

    /// The frames that a place explains, with their triggers.
    pub fn explained<'a>(
        &'a self,
        place: Place,
        table: &'a TriggerTable,
        period_ns: u64,
    ) -> impl Iterator<Item = (i64, u64, &'a Early)> + 'a {
        let fits = self.fits(place.offset, table, period_ns);
        self.frames.iter().filter_map(move |frame| {
            let number = frame.count.checked_add(place.offset)?;
            let due = table.reported_ns(number)?;
            let usual = fits?.usual_ns;
            let residual = self.seen_ns(frame)? - i128::from(due) - usual;
            (residual.abs() <= self.tolerance_ns(period_ns)).then_some((number, due, frame))
        })
    }

    /// The place, where the frames so far allow one. `first` is the number of the first trigger.
    pub fn place(&self, first: i64, table: &TriggerTable, period_ns: u64) -> Option<Place> {
        let (mut best, mut second): (Option<(i64, Fit)>, usize) = (None, 0);
        // By distance from what silence says: of equals the nearest wins.
        let mut shifts: Vec<i64> = SHIFTS.collect();
        shifts.sort_by_key(|shift| shift.abs());
        for shift in shifts {
            let Some(fit) = self.fits(first.checked_add(shift)?, table, period_ns) else { continue };
            match &best {
                Some((_, found)) if fit.frames <= found.frames => second = second.max(fit.frames),
                found => {
                    second = second.max(found.as_ref().map_or(0, |(_, fit)| fit.frames));
                    best = Some((shift, fit));
                }
            }
        }
        let (shift, fit) = best?;
        let most = fit.frames * 4 >= self.frames.len() * 3;
        // Arrivals alone may be regular by chance.
        let margin = if self.has_stamps() { MARGIN } else { 2 * MARGIN };
        let confirmed = most && fit.frames >= ENOUGH && fit.frames >= second + margin;
        if fit.unknown > 0 {
            return None;
        }
        let in_time = fit.arrival_ns.is_none_or(|ns| ns <= DELAY_PERIODS * i128::from(period_ns));
        (in_time && (confirmed || shift == 0)).then_some(Place { offset: first + shift, confirmed })
    }

    /// How well the frames fit a place; `None` where it cannot be, or where the last frames speak against it.
    fn fits(&self, offset: i64, table: &TriggerTable, period_ns: u64) -> Option<Fit> {
        let way = |frame: &Early| {
            let due = i128::from(table.reported_ns(frame.count.checked_add(offset)?)?);
            Some((self.seen_ns(frame)? - due, frame.arrived_ns.map(|ns| ns - due)))
        };
        let open = |frame: &&Early| {
            let number = frame.count.saturating_add(offset);
            number >= table.end() || (table.time_ns(number).is_some() && table.reported_ns(number).is_none())
        };
        let open = self.frames.iter().filter(open);
        // A trigger without a report may have been fired all the same, if it is not too early for it.
        let latest = i128::from(table.latest_ns()?);
        let fired = |frame: &Early| {
            // Of a file's block ids anything may come.
            let ahead = frame.count.saturating_add(offset).saturating_sub(table.end()).saturating_add(1);
            let earliest = latest + i128::from(ahead) * i128::from(period_ns) * 7 / 8;
            ahead <= 0
                || frame.arrived_ns.is_none_or(|arrived| arrived + i128::from(period_ns / 8) >= earliest)
        };
        if !open.clone().all(fired) {
            return None;
        }
        let unknown = open.count();
        let arrival_of = |frame: &Early| way(frame).and_then(|(_, arrival)| arrival);
        // What holds of the last frames counts: a camera that ignored a trigger meanwhile stands elsewhere now.
        let mut known = self.frames.iter().rev().filter_map(way).map(|(way, _)| way);
        let Some(usual_ns) = known.next() else {
            return Some(Fit { frames: unknown, unknown, usual_ns: 0, arrival_ns: None });
        };
        let tolerance = self.tolerance_ns(period_ns);
        if known.next().is_some_and(|before| (before - usual_ns).abs() > tolerance) {
            return None;
        }
        let near = |frame: &&Early| way(frame).is_some_and(|(way, _)| (way - usual_ns).abs() <= tolerance);
        let mut arrivals: Vec<i128> = self.frames.iter().filter(near).filter_map(arrival_of).collect();
        arrivals.sort_unstable();
        // Nothing arrives before its trigger.
        if arrivals.first().is_some_and(|ns| *ns < -i128::from(period_ns / 8)) {
            return None;
        }
        let frames = self.frames.iter().filter(near).count() + unknown;
        Some(Fit { frames, unknown, usual_ns, arrival_ns: arrivals.get(arrivals.len() / 2).copied() })
    }

    /// When a frame was seen: by its timestamp, or where the camera gives none, by its arrival.
    fn seen_ns(&self, frame: &Early) -> Option<i128> {
        if self.has_stamps() { frame.camera_ns.map(i128::from) } else { frame.arrived_ns }
    }

    /// Whether the camera gives timestamps.
    pub fn has_stamps(&self) -> bool {
        self.frames.iter().filter(|frame| frame.camera_ns.is_some()).count() * 2 > self.frames.len()
    }

    /// Ways that differ by no more are the same: a third of the pause that the rhythm adds.
    fn tolerance_ns(&self, period_ns: u64) -> i128 {
        i128::from(period_ns) / 6
    }
}

/// How well frames fit a place.
#[derive(Debug, Clone, Copy)]
struct Fit {
    /// Those whose way from the trigger is the same, or may be.
    frames: usize,
    /// Of these, the ones whose triggers are not reported yet.
    unknown: usize,
    /// That way, ns: to the timestamp, of the camera's clock, or to the arrival.
    usual_ns: i128,
    /// The median way to the arrival, ns.
    arrival_ns: Option<i128>,
}

impl Early {
    /// What a frame shows, `count` blocks after the first.
    pub fn of(frame: &Sighting, count: i64, arrived_ns: Option<i128>) -> Self {
        Self { count, camera_ns: frame.camera_ns, arrived_ns }
    }
}
