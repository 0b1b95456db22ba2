// SPDX-License-Identifier: MIT OR Apache-2.0
//! Phases at the ends of runs, once their fringe orders are known.
//!
//! A mask ends where the light does, in the valley beside the last bright fringe, and the surface often goes on in the
//! dark: windows of whole fringes that reach over the mask's border by a few pixels are good. And the period, which is
//! counted over a window that is shifted at the ends of a run, is not that of a surface which turns away there. From
//! the phases themselves it is known better: their course predicts how the fringe goes on.
//!
//! So the pixels beside the last known phase get windows of the period that its course foretells, one after the other
//! towards the end, as long as what they see agrees with it; and those at the end whose misfit is doubtful are
//! demodulated again. Nothing here has a part in fringe orders: a pixel takes that of the one beside it.

use crate::base::image::Plane;
use crate::kernels::pixel_runs::{Run, Runs};
use crate::kernels::{fast_round, prefetch, simd};
use crate::phase::demodulate::{self, Gains};
use crate::phase::shading;
use crate::phase::window_quality::{self, DOUBTFUL_MISFIT, Windows};
use std::f32::consts::TAU;
use std::ops::Range;

/// How far a window may reach beyond its run, as a share of its period.
const BEYOND: f32 = 0.35;

/// How far a window may reach beyond its run at most, px.
const BEYOND_PX: f32 = 6.0;

/// Largest misfit of a window that reaches beyond its run.
const BEYOND_MISFIT: f32 = 0.2;

/// A hole in a row that is no longer than this, px, may be a dark spot on one surface. Windows must not reach into it:
/// they would see the spot's edge.
const SPOT_PX: usize = 64;

/// A hole is a spot if the phase on its other side is where the carrier leads, but for this share of the way ..
const SPOT_SHARE: f32 = 0.1;

/// .. and this much more, rad.
const SPOT_RAD: f32 = 1.0;

/// Largest difference of a new phase from what the course of those beside it predicts, rad.
const MAX_STEP: f32 = 0.4;

/// Periods that are demodulated here, px: at outlines they are shorter and longer than those that are counted.
const PERIODS_PX: Range<f32> = 4.5..32.0;

/// Least and largest distance of the phases that the course is taken from, px: half a period, as far as these allow.
const COURSE_PX: Range<f32> = 3.0..12.0;

/// Least distance of the phases that a slope is taken from, px: a third of a period where that is more.
const LEAST_SLOPE_PX: f32 = 2.0;

/// Slopes that differ from the carrier's by more than this share are not those of one surface.
const SAME_SLOPE: f32 = 0.6;

/// The bend of the course changes its slope by this share at most.
const MAX_BEND: f32 = 0.3;

/// Doubtful pixels up to this distance from the end of a run are demodulated again, px.
const END_PX: usize = 12;

/// They are if the period by the phases differs from the counted one by no more than this share.
const PERIOD_CHANGE: f32 = 0.3;

/// The new phase is taken if its misfit is less than this share of the old one ..
const LESS_MISFIT: f32 = 0.9;

/// .. and it differs from the old phase by no more than this, rad.
const PHASE_CHANGE: f32 = 0.5;

/// What [`complete`] reads of a frame.
pub(crate) struct Input<'a> {
    pub image: &'a Plane<u8>,
    pub runs: &'a Runs,
    /// Not 0 around the marker, where no phase is changed.
    pub zone: &'a Plane<u8>,
    pub gains: &'a Gains,
    /// Sign of the phase along the columns.
    pub sign: f32,
}

/// Adds phases at the ends of runs to `absolute`, which is known within them only, and improves those that are
/// doubtful there. Returns how many were added.
pub(crate) fn complete(
    input: &Input<'_>,
    absolute: &mut Plane<f32>,
    windows: &mut Windows,
    period: &mut Plane<f32>,
) -> usize {
    simd::dispatch(
        #[inline(always)]
        || {
            let mut added = 0;
            for v in 0..absolute.height() {
                prefetch_ends(input, absolute, windows, period, v + prefetch::AHEAD);
                let mut row = Row {
                    absolute: absolute.row_mut(v),
                    strength: windows.strength.row_mut(v),
                    light: windows.light.row_mut(v),
                    misfit: windows.misfit.row_mut(v),
                    period: period.row_mut(v),
                    zone: input.zone.row(v),
                    image: input.image.row(v),
                    gains: input.gains,
                    sign: input.sign,
                };
                added += row.complete(input.runs.row(v));
            }
            added
        },
    )
}

/// Prefetches the ends of a row's runs in all planes that are needed there, which lie far from each other in memory.
#[inline(always)]
fn prefetch_ends(input: &Input<'_>, absolute: &Plane<f32>, windows: &Windows, period: &Plane<f32>, v: usize) {
    if v >= absolute.height() {
        return;
    }
    for run in input.runs.row(v) {
        let (start, last) = (run.start(), run.end() - 1);
        // The pixels at an end may lie in two cache lines.
        for u in [start, last, (start + END_PX).min(last), last.saturating_sub(END_PX).max(start)] {
            prefetch::value(windows.strength.row(v), u);
            prefetch::value(windows.light.row(v), u);
            prefetch::value(input.image.row(v), u);
            prefetch::value(input.zone.row(v), u);
            prefetch::value(absolute.row(v), u);
            prefetch::value(windows.misfit.row(v), u);
            prefetch::value(period.row(v), u);
        }
    }
}

/// One row of all planes that are read and written.
struct Row<'a> {
    absolute: &'a mut [f32],
    strength: &'a mut [u16],
    light: &'a mut [u16],
    misfit: &'a mut [f32],
    period: &'a mut [f32],
    zone: &'a [u8],
    image: &'a [u8],
    gains: &'a Gains,
    sign: f32,
}

/// What demodulation gives for a pixel.
struct Found {
    /// The phase, rad, by whole turns nearest to the expected one.
    phase: f32,
    misfit: f32,
    strength: u16,
    light: u16,
}

/// Where the samples of a window lie, in periods from its middle.
const SAMPLES: [f32; 7] = [-3.0 / 6.0, -2.0 / 6.0, -1.0 / 6.0, 0.0, 1.0 / 6.0, 2.0 / 6.0, 3.0 / 6.0];

impl Row<'_> {
    /// Completes and improves the ends of all runs; how many phases were added.
    #[inline(always)]
    fn complete(&mut self, runs: &[Run]) -> usize {
        let mut added = 0;
        // Nothing is done at an end beside a spot.
        let mut spot_before = false;
        for (i, run) in runs.iter().enumerate() {
            let spot_behind = runs.get(i + 1).is_some_and(|next| self.is_spot(run, next));
            let columns = run.columns();
            let end = columns.len().min(END_PX);
            let before = (spot_before, -1, columns.start..columns.start + end);
            // In a short run the two ends must not overlap.
            let behind = (spot_behind, 1, (columns.end - end).max(columns.start + end)..columns.end);
            for (spot, step, part) in [before, behind] {
                if !spot {
                    added += self.go_on(&columns, step);
                    self.improve(&columns, part);
                }
            }
            spot_before = spot_behind;
        }
        added
    }

    /// Whether the hole between two runs may be a spot on one surface. Beside pixels without an order it is none.
    #[inline(always)]
    fn is_spot(&self, run: &Run, next: &Run) -> bool {
        if next.start() - run.end() > SPOT_PX {
            return false;
        }
        let known = |u: &usize| !self.absolute[*u].is_nan();
        let Some((a, b)) = run.columns().rev().find(known).zip(next.columns().find(known)) else {
            return false;
        };
        let way = self.sign * TAU * (b - a) as f32 * 2.0 / (self.period[a] + self.period[b]);
        let off = self.absolute[b] - self.absolute[a] - way;
        // Also where the difference is NaN.
        !(off.abs() > SPOT_RAD + SPOT_SHARE * way.abs())
    }

    /// From the last known phase of a run towards its end, which is behind (`step` 1) or before it (-1).
    #[inline(always)]
    fn go_on(&mut self, columns: &Range<usize>, step: isize) -> usize {
        let (mut from, mut count) = (if step > 0 { columns.end - 1 } else { columns.start }, 0);
        while self.strength[from] == 0 {
            match from.checked_add_signed(-step).filter(|u| columns.contains(u)) {
                Some(next) => (from, count) = (next, count + 1),
                None => return 0,
            }
        }
        if count == 0 || self.absolute[from].is_nan() || self.zone[from] != 0 {
            return 0;
        }
        let course = self.course(columns, from, step);
        for done in 0..count {
            let u = from.wrapping_add_signed(step * (done + 1) as isize);
            let (distance, zone) = ((done + 1) as f32, self.zone[u]);
            let (period, expected) = (TAU / course.slope(distance).abs(), course.phase(distance));
            let Some(found) = self.demodulate(columns, u, period, expected) else { return done };
            let beyond = period / 2.0 > to_end(columns, u) as f32;
            // False where there is no phase.
            let agrees =
                (found.phase - expected).abs() <= MAX_STEP && !(beyond && found.misfit > BEYOND_MISFIT);
            if !agrees || zone != 0 {
                return done;
            }
            self.set(u, period, &found);
        }
        count
    }

    /// Demodulates doubtful pixels of a part of a run again, at the period by the phases around them.
    #[inline(always)]
    fn improve(&mut self, columns: &Range<usize>, part: Range<usize>) {
        let mut better: [Option<(f32, Found)>; END_PX] = [const { None }; END_PX];
        // All pixels are demodulated before any is changed.
        for (better, u) in better.iter_mut().zip(part.clone()) {
            let (before, misfit) = (self.absolute[u], self.misfit[u]);
            let is_doubtful = misfit >= DOUBTFUL_MISFIT && !before.is_nan() && self.zone[u] == 0;
            let period = if is_doubtful { TAU / self.slope(columns, u).abs() } else { f32::NAN };
            // False where there is no slope.
            let is_near = (period / self.period[u] - 1.0).abs() <= PERIOD_CHANGE;
            if !is_near {
                continue;
            }
            let found = self.demodulate(columns, u, period, before);
            let is_better = |found: &Found| {
                (found.phase - before).abs() <= PHASE_CHANGE && found.misfit < LESS_MISFIT * misfit
            };
            *better = found.filter(is_better).map(|found| (period, found));
        }
        for (better, u) in better.iter().zip(part) {
            if let Some((period, found)) = better {
                self.set(u, *period, found);
            }
        }
    }

    /// Gives a pixel what was found for it.
    #[inline(always)]
    fn set(&mut self, u: usize, period: f32, found: &Found) {
        (self.absolute[u], self.misfit[u], self.period[u]) = (found.phase, found.misfit, period);
        (self.strength[u], self.light[u]) = (found.strength, found.light);
    }

    /// Whether a pixel can be demodulated at a period: not where the window reaches too far beyond the run, or the
    /// period is none.
    #[inline(always)]
    fn has_window(&self, columns: &Range<usize>, u: usize, period: f32) -> bool {
        let (half, beyond) = (period / 2.0, (BEYOND * period).min(BEYOND_PX));
        PERIODS_PX.contains(&period)
            && half - beyond <= to_end(columns, u) as f32
            && u as f32 - half >= 0.0
            && u as f32 + half + 1.0 < self.image.len() as f32
    }

    /// Demodulates a pixel at a period and takes off the bias of shading; `None` where it has no window. The phase is
    /// by whole turns nearest to `expected`.
    #[inline(always)]
    fn demodulate(&self, columns: &Range<usize>, u: usize, period: f32, expected: f32) -> Option<Found> {
        if !self.has_window(columns, u, period) {
            return None;
        }
        let (mut samples, mut ends) = ([0f32; 7], [f32::NAN; 7]);
        for (k, (sample, end)) in samples.iter_mut().zip(&mut ends).enumerate() {
            let place = u as f32 + SAMPLES[k] * period;
            let low = fast_round::floor(place);
            let share = place - low as f32;
            let pair = &self.image[low as usize..][..2];
            let (a, b) = (f32::from(pair[0]), f32::from(pair[1]));
            *sample = a + share * (b - a);
            if k == 0 || k == 6 {
                *end = self.light_between(columns, low as usize, share);
            }
        }
        let (s, c, light, misfit) = demodulate::of_samples(&samples, self.gains.of(period));
        let [c, s] = shading::correct_one(c, s, [ends[0], light, ends[6]]);
        let phase = demodulate::phase(c, self.sign * s);
        Some(Found {
            phase: phase + TAU * ((expected - phase) / TAU).round(),
            misfit,
            strength: window_quality::strength_steps(c, self.sign * s),
            light: window_quality::light_steps(light),
        })
    }

    /// The light between two pixels, NaN where it is not known or the marker's.
    #[inline(always)]
    fn light_between(&self, columns: &Range<usize>, low: usize, share: f32) -> f32 {
        let (light, zone) = (&self.light[low..low + 2], &self.zone[low..low + 2]);
        let known = (light[0] > 0) & (light[1] > 0) & (zone[0] == 0) & (zone[1] == 0);
        let inside = (low >= columns.start) & (low + 1 < columns.end);
        let (a, b) = (window_quality::light(light[0]), window_quality::light(light[1]));
        if known & inside { a + share * (b - a) } else { f32::NAN }
    }

    /// A pixel's phase, NaN beyond the run.
    #[inline(always)]
    fn at(&self, columns: &Range<usize>, u: usize, steps: isize) -> f32 {
        // Before the first column there is none, but a number too large.
        let u = u.wrapping_add_signed(steps);
        if columns.contains(&u) { self.absolute[u] } else { f32::NAN }
    }

    /// How the phase goes on from a pixel towards `step`.
    #[inline(always)]
    fn course(&self, columns: &Range<usize>, from: usize, step: isize) -> Course {
        let period = self.period[from];
        let carrier = self.sign * step as f32 * TAU / period;
        let reach = (period / 2.0).round().clamp(COURSE_PX.start, COURSE_PX.end);
        let steps = step * fast_round::whole(reach) as isize;
        let (near, far) = (self.at(columns, from, -steps), self.at(columns, from, -2 * steps));
        let phase = self.absolute[from];
        let [own, before] = [(phase - near) / reach, (near - far) / reach];
        let (slope, bend) = match (is_same(own, carrier), is_same(before, carrier)) {
            (true, true) => (own, (own - before) / reach),
            (true, false) => (own, 0.0),
            (false, _) => (carrier, 0.0),
        };
        Course { phase, slope, bend, behind: reach / 2.0 }
    }

    /// Slope of the phase at a pixel, rad/px; NaN where there is none.
    #[inline(always)]
    fn slope(&self, columns: &Range<usize>, u: usize) -> f32 {
        let (phase, period) = (self.absolute[u], self.period[u]);
        let (reach, carrier) = ((period / 3.0).round().max(LEAST_SLOPE_PX), self.sign * TAU / period);
        let steps = fast_round::whole(reach) as isize;
        let at = |k: isize| self.at(columns, u, k * steps);
        let [before, after] = [(phase - at(-1)) / reach, (at(1) - phase) / reach];
        match (is_same(before, carrier), is_same(after, carrier)) {
            (true, true) => (before + after) / 2.0,
            (false, true) => from_side(after, (at(2) - at(1)) / reach, carrier),
            (true, false) => from_side(before, (at(-1) - at(-2)) / reach, carrier),
            (false, false) => f32::NAN,
        }
    }
}

/// Whether a slope may be that of the surface whose fringes have the carrier's.
#[inline(always)]
fn is_same(slope: f32, carrier: f32) -> bool {
    (slope / carrier - 1.0).abs() < SAME_SLOPE
}

/// The slope at a pixel from the differences on one side, the farther one for how it bends.
#[inline(always)]
fn from_side(near: f32, far: f32, carrier: f32) -> f32 {
    if is_same(far, carrier) { near + (near - far) / 2.0 } else { near }
}

/// The phase as it goes on from a pixel: a parabola whose slope was measured `behind` px before it.
struct Course {
    phase: f32,
    slope: f32,
    bend: f32,
    behind: f32,
}

impl Course {
    /// Slope of the phase at this distance, px, from the pixel, in rad/px.
    #[inline(always)]
    fn slope(&self, distance: f32) -> f32 {
        let most = MAX_BEND * self.slope.abs();
        self.slope + (self.bend * (distance + self.behind)).clamp(-most, most)
    }

    /// Phase at this distance, px, from the pixel, in rad.
    #[inline(always)]
    fn phase(&self, distance: f32) -> f32 {
        self.phase + distance * self.slope(distance / 2.0)
    }
}

/// Pixels from `u` to the nearer end of a run.
#[inline(always)]
fn to_end(columns: &Range<usize>, u: usize) -> usize {
    (u - columns.start).min(columns.end - 1 - u)
}

#[cfg(test)]
mod tests;
