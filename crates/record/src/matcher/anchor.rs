// SPDX-License-Identifier: MIT OR Apache-2.0
//! Where a stream begins: which trigger its first frames are of.
//!
//! Three sources are evidence of it, and two must agree. An armed stream is silent before the train starts, so by its
//! **counter** the first block is the first warm-up trigger's, unless the camera ignored that. The HSU leaves longer
//! pauses before some triggers of the warm-up (`hsu-protocol.md`), so the **clock** of the camera and the **arrivals**
//! each show a rhythm: only at the right place is the way from trigger to timestamp, or to arrival, the same for all
//! frames. How long that way is, is not assumed, and neither is it that the camera takes every trigger.

use super::sighting::Sighting;
use super::trigger_table::TriggerTable;

/// Frames of a stream that are kept: the first [`FIRST`], which have the rhythm, and the last.
const FRAMES: usize = 48;
/// Frames at the beginning of a stream that are never dropped: the rhythm of the warm-up is in them.
const FIRST: usize = 16;
/// Frames that need not fit the place that is found: one may have been held up or torn.
const MISFITS: usize = 1;
/// Frames by which the best place must lead the second best.
const MARGIN: usize = 2;
/// The same for arrivals alone, which may be regular by chance.
const MARGIN_ALONE: usize = 3;
/// Frames before a place can be found: fewer show too little of the rhythm.
const ENOUGH: usize = 5;
/// Periods around a place within which other places are compared with it.
const AROUND: i64 = 4;
/// Time that a host may stand still, ns: a frame may be of any trigger that long before its arrival. `verify` judges by the
/// same.
pub(crate) const STALL_NS: u64 = 400_000_000;

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

impl Early {
    /// The times of a frame that came `count` blocks after the first.
    pub fn of(frame: &Sighting, count: i64, arrived_ns: Option<i128>) -> Self {
        Self { count, camera_ns: frame.camera_ns, arrived_ns }
    }
}

/// The times in which a rhythm is sought.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Source {
    Clock,
    /// The arrivals on the host.
    Arrivals,
}

impl Source {
    fn ns(self, frame: &Early) -> Option<i128> {
        match self {
            Self::Clock => frame.camera_ns.map(i128::from),
            Self::Arrivals => frame.arrived_ns,
        }
    }
}

/// The trigger of each frame, as far as it is known.
type Numbers = Vec<Option<i64>>;

/// The triggers of a stream's first frames.
#[derive(Debug, Clone)]
pub struct Placed {
    /// The trigger of each frame by the better of the two sources that agree, as far as it gives one.
    pub numbers: Vec<Option<i64>>,
    /// Whether the other source gives that frame the same.
    pub agreed: Vec<bool>,
}

/// Finds a stream's place from its first frames.
#[derive(Debug, Clone, Default)]
pub struct Anchoring {
    frames: Vec<Early>,
}

impl Anchoring {
    /// Adds a frame; of many, the first and the last ones are kept.
    pub fn add(&mut self, frame: Early) {
        if self.frames.len() == FRAMES {
            self.frames.remove(FIRST);
        }
        self.frames.push(frame);
    }

    /// The frame that was added last.
    pub fn last(&self) -> Option<&Early> {
        self.frames.last()
    }

    /// The frames that are kept, in the order of arrival.
    pub fn frames(&self) -> &[Early] {
        &self.frames
    }

    /// Whether a frame, `count` ids after the stream's first, is the last one once more.
    pub fn is_copy(&self, frame: &Sighting, count: i64) -> bool {
        self.last().is_some_and(|last| {
            count <= last.count && (frame.camera_ns.is_none() || frame.camera_ns == last.camera_ns)
        })
    }

    /// The triggers of the frames, where two sources agree on them. `first` is the number of the first trigger.
    pub fn place(&self, first: i64, table: &TriggerTable, period_ns: u64) -> Option<Placed> {
        let by_clock = self.rhythm(Source::Clock, MARGIN, table, period_ns);
        // Beside the clock as much is enough; alone arrivals may be regular by chance.
        let margin = if by_clock.is_some() { MARGIN } else { MARGIN_ALONE };
        let by_arrivals = self.rhythm(Source::Arrivals, margin, table, period_ns);
        let by_count: Numbers = self.frames.iter().map(|frame| first.checked_add(frame.count)).collect();
        let agree = |one: &[Option<i64>], other: &[Option<i64>]| {
            let both = || one.iter().zip(other).filter_map(|(one, other)| one.as_ref().zip(other.as_ref()));
            let alike = both().filter(|(one, other)| one == other).count();
            // What holds of the last frames counts: a camera that ignored a trigger meanwhile stands elsewhere now.
            let last = both().next_back().is_some_and(|(one, other)| one == other);
            last && alike >= ENOUGH.min(self.frames.len()) && alike * 4 >= both().count() * 3
        };
        // Of a counter that went back nothing is known.
        let counts = self.frames.windows(2).all(|two| two[0].count < two[1].count);
        let by_count = if counts { by_count } else { Vec::new() };
        let placed = |numbers: Numbers, other: Numbers| {
            let agreed = numbers.iter().zip(other).map(|(one, other)| one.is_some() && *one == other);
            Some(Placed { agreed: agreed.collect(), numbers })
        };
        match (by_clock, by_arrivals) {
            (Some(clock), Some(arrivals)) if agree(&clock, &arrivals) => placed(clock, arrivals),
            (None, Some(arrivals)) if agree(&by_count, &arrivals) => {
                let refuted = self.has_stamps() && self.clock_speaks_against(&arrivals, table, period_ns);
                if refuted { None } else { placed(by_count, arrivals) }
            }
            (Some(clock), None) if agree(&by_count, &clock) => placed(by_count, clock),
            _ => None,
        }
    }

    /// The triggers that a rhythm gives the frames; `None` where no place stands out by `margin` frames.
    fn rhythm(&self, source: Source, margin: usize, table: &TriggerTable, period_ns: u64) -> Option<Numbers> {
        let known = |frame: &&Early| source.ns(frame).is_some() && frame.arrived_ns.is_some();
        let reference = self.frames.iter().rev().find(known)?;
        let (arrived, at) = (reference.arrived_ns?, source.ns(reference)?);
        let period = i128::from(period_ns);
        let (latest, behind) = table.nearest(arrived + period / 8)?;
        // Whatever was fired by then must be reported: of the others it is not known whether they fit better.
        let oldest = latest.saturating_sub(2 * FRAMES as i64).max(table.first());
        let reported = (oldest..=latest).all(|number| table.reported_ns(number).is_some());
        if !reported || behind > period * 5 / 4 {
            return None;
        }
        let (mut best, mut second): (Option<(usize, Numbers)>, usize) = (None, 0);
        // Ids count no more than was fired.
        let slowest = latest.saturating_sub((STALL_NS / period_ns.max(1)) as i64);
        let counted = table.first().saturating_add(reference.count).min(latest).max(slowest);
        for number in (counted.saturating_sub(AROUND)..=latest).rev() {
            let Some(due) = table.reported_ns(number) else { continue };
            if arrived - i128::from(due) < -period / 8 {
                continue;
            }
            let numbers = self.fit(source, at - i128::from(due), table, period_ns);
            let fit = numbers.iter().flatten().count();
            match &best {
                Some((found, _)) if fit <= *found => second = second.max(fit),
                found => {
                    second = second.max(found.as_ref().map_or(0, |(found, _)| *found));
                    best = Some((fit, numbers));
                }
            }
        }
        let (fit, numbers) = best?;
        let seen = self.frames.iter().filter(known).count();
        let most = seen - fit <= MISFITS;
        (most && fit >= ENOUGH && fit >= second + margin).then_some(numbers)
    }

    /// Whether the clock fits another place better than the one that counter and arrivals give.
    fn clock_speaks_against(&self, place: &[Option<i64>], table: &TriggerTable, period_ns: u64) -> bool {
        let ns = |frame: &Early| Source::Clock.ns(frame);
        let placed = self.frames.iter().zip(place).rev().find_map(|(frame, number)| ns(frame).zip(*number));
        let Some((at, due)) = placed.and_then(|(ns, number)| Some((ns, table.reported_ns(number)?))) else {
            return true;
        };
        let fit = |way_ns: i128| self.fit(Source::Clock, way_ns, table, period_ns).iter().flatten().count();
        let (way, period) = (at - i128::from(due), i128::from(period_ns));
        let here = fit(way);
        (-AROUND..=AROUND).any(|by| fit(way + i128::from(by) * period) > here)
    }

    /// The triggers of the frames, if the time from trigger to frame were `way_ns`.
    fn fit(&self, source: Source, way_ns: i128, table: &TriggerTable, period_ns: u64) -> Numbers {
        let period = i128::from(period_ns);
        let mut taken = i64::MIN;
        let mut fit = |frame: &Early| {
            let (number, residual) = table.nearest(source.ns(frame)? - way_ns)?;
            let due = i128::from(table.reported_ns(number)?);
            let caused = frame.arrived_ns.is_some_and(|ns| ns >= due - period / 8);
            // A third of the pause that the rhythm adds.
            let fits = residual.abs() <= period / 6 && caused && number > taken;
            if fits {
                taken = number;
            }
            fits.then_some(number)
        };
        self.frames.iter().map(&mut fit).collect()
    }

    /// Whether the camera gives timestamps.
    pub fn has_stamps(&self) -> bool {
        self.frames.iter().filter(|frame| frame.camera_ns.is_some()).count() * 2 > self.frames.len()
    }
}

/// Triggers from one id to the next, where that is the same number above one for all of these frames (count of ids,
/// trigger).
pub fn pace_of(frames: impl Iterator<Item = (i64, i64)>) -> Option<i64> {
    let frames: Vec<(i64, i64)> = frames.collect();
    let steps =
        frames.windows(2).map(|two| (two[1].0.saturating_sub(two[0].0), two[1].1.saturating_sub(two[0].1)));
    let (ids, triggers) = steps.clone().next()?;
    let pace = triggers.checked_div(ids).filter(|pace| *pace > 1)?;
    let mut holds = steps.map(|(ids, triggers)| ids.checked_mul(pace) == Some(triggers));
    (holds.len() >= ENOUGH - 1 && holds.all(|holds| holds)).then_some(pace)
}
