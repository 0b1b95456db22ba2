// SPDX-License-Identifier: MIT OR Apache-2.0
//! Phases at the ends of runs, once their fringe orders are known.
//!
//! A mask ends where the light does, in the valley beside the last bright fringe, and the surface often goes on in the
//! dark: windows of whole fringes that reach over the mask's border by a few pixels are good. And the period, which is
//! counted over a window that is shifted at the ends of a run, is not that of a surface which turns away there. From
//! the phases themselves it is known better: their course predicts how the fringe goes on.
//!
//! So the pixels beside the last known phase get windows of the period that its course foretells, one after the other
//! towards the end. Nothing here has a part in fringe orders: a pixel takes that of the one beside it.

use crate::base::image::Plane;
use crate::kernels::pixel_runs::{Run, Runs};
use crate::kernels::{fast_round, prefetch, simd};
use crate::phase::demodulate::{self, Gains};
use crate::phase::shading;
use crate::phase::window_quality::{self, Windows};
use std::f32::consts::TAU;
use std::ops::Range;

/// How far a window may reach beyond its run, as a share of its period.
const BEYOND: f32 = 0.35;

/// Largest misfit of a window that reaches beyond its run.
const BEYOND_MISFIT: f32 = 0.2;

/// A hole in a row that is no longer than this, px, may be a dark spot on one surface. Windows must not reach into it:
/// they would see the spot's edge.
const SPOT_PX: usize = 64;

/// A hole is a spot if the phase on its other side is where the carrier leads, but for this share of the way ..
const SPOT_SHARE: f32 = 0.1;

/// .. and this much more, rad.
const SPOT_RAD: f32 = 1.0;

/// Periods that are demodulated here, px: at outlines they are shorter and longer than those that are counted.
const PERIODS_PX: Range<f32> = 4.5..32.0;

/// Least and largest distance of the phases that the course is taken from, px: half a period, as far as these allow.
const COURSE_PX: Range<f32> = 3.0..12.0;

/// What [`complete`] reads of a frame.
pub(crate) struct Input<'a> {
    pub image: &'a Plane<u8>,
    pub runs: &'a Runs,
    /// Not 0 around the marker, where no phase is changed.
    pub zone: &'a Plane<u8>,
    pub gains: &'a Gains,
    /// Sign of the phase's slope along the columns.
    pub sign: f32,
}

/// Adds phases at the ends of runs to `absolute`, which is known within them only. Returns how many were added.
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

/// Prefetches the ends of a row's runs in all planes that are needed there. These lie far from each other in memory, and the
/// processor would wait for each by itself.
#[inline(always)]
fn prefetch_ends(input: &Input<'_>, absolute: &Plane<f32>, windows: &Windows, period: &Plane<f32>, v: usize) {
    if v >= absolute.height() {
        return;
    }
    for run in input.runs.row(v) {
        for u in [run.start(), run.end() - 1] {
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

/// One row of what is read and written.
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

/// Pixels that are worked on at once. Windows are read one by one, the rest is computed for all: pixel by pixel this stage is
/// half slower.
const LANES: usize = 16;
type Lanes = [f32; LANES];

/// Sums over the windows of several pixels at once.
struct Seen {
    samples: [Lanes; 7],
    /// Factors of the sums of these samples.
    gains: [Lanes; 2],
    /// Light half a period before and behind, NaN where it is not known.
    light: [Lanes; 2],
}

impl Seen {
    #[inline(always)]
    fn nothing() -> Self {
        Self { samples: [[0.0; LANES]; 7], gains: [[1.0; LANES]; 2], light: [[f32::NAN; LANES]; 2] }
    }
}

/// What demodulation gives for some pixels.
struct Found {
    /// The phase, by whole turns nearest to what is expected, rad.
    phase: Lanes,
    misfit: Lanes,
    strength: [u16; LANES],
    light: [u16; LANES],
}

/// Where the samples of a window lie, in periods from its middle.
const SAMPLES: [f32; 7] = [-3.0 / 6.0, -2.0 / 6.0, -1.0 / 6.0, 0.0, 1.0 / 6.0, 2.0 / 6.0, 3.0 / 6.0];

impl Row<'_> {
    /// Completes the ends of all runs; how many phases were added.
    #[inline(always)]
    fn complete(&mut self, runs: &[Run]) -> usize {
        let mut added = 0;
        // An end at a spot stays as it is.
        let mut spot_before = false;
        for (i, run) in runs.iter().enumerate() {
            let spot_behind = runs.get(i + 1).is_some_and(|next| self.is_spot(run, next));
            for (spot, step) in [(spot_before, -1), (spot_behind, 1)] {
                if !spot {
                    added += self.go_on(&run.columns(), step);
                }
            }
            spot_before = spot_behind;
        }
        added
    }

    /// Whether what lies between two runs may be a spot on one surface: where a side has no fringe order that is unknown.
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
        // Not where that is no number.
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
        let mut done = 0;
        while done < count {
            let (mut period, mut expected, mut known) = ([0f32; LANES], [0f32; LANES], 0);
            let next = from.wrapping_add_signed(step * (done + 1) as isize);
            // A window that sees the light of one of these pixels has to wait until that has some.
            while known < LANES.min(count - done) {
                let k = (done + known + 1) as f32;
                period[known] = TAU / course.slope(k).abs();
                expected[known] = course.phase(k);
                let waits = known as f32 >= period[known] / 2.0 - 1.0;
                let u = next.wrapping_add_signed(step * known as isize);
                if waits && known > 0 || !self.has_window(columns, u, period[known]) {
                    break;
                }
                known += 1;
            }
            if known == 0 {
                return done;
            }
            let places: [usize; LANES] = std::array::from_fn(|i| i);
            let seen = self.look(columns, (next, step), &places[..known], &period);
            let found = self.demodulate(&seen, &expected);
            for (i, &period) in period.iter().enumerate().take(known) {
                let u = from.wrapping_add_signed(step * (done + 1) as isize);
                let beyond = period / 2.0 > to_end(columns, u) as f32;
                let no_fringe = found.phase[i].is_nan() || (beyond && found.misfit[i] > BEYOND_MISFIT);
                if no_fringe || self.zone[u] != 0 {
                    return done;
                }
                self.set(u, i, period, &found);
                done += 1;
            }
        }
        count
    }

    /// Stores the result of one lane for its pixel.
    #[inline(always)]
    fn set(&mut self, u: usize, lane: usize, period: f32, found: &Found) {
        self.absolute[u] = found.phase[lane];
        self.strength[u] = found.strength[lane];
        self.light[u] = found.light[lane];
        (self.misfit[u], self.period[u]) = (found.misfit[lane], period);
    }

    /// Whether a pixel can be demodulated at a period: not where the window reaches too far beyond the run, or the period is
    /// none.
    #[inline(always)]
    fn has_window(&self, columns: &Range<usize>, u: usize, period: f32) -> bool {
        let (half, beyond) = (period / 2.0, BEYOND * period);
        PERIODS_PX.contains(&period)
            && half - beyond <= to_end(columns, u) as f32
            && u as f32 - half >= 0.0
            && u as f32 + half + 1.0 < self.image.len() as f32
    }

    /// Reads the windows of some of the pixels from `first` on, or before it (`step` -1), which have them, at their periods.
    #[inline(always)]
    fn look(
        &self,
        columns: &Range<usize>,
        (first, step): (usize, isize),
        pixels: &[usize],
        period: &Lanes,
    ) -> Seen {
        let mut seen = Seen::nothing();
        // All places before the first look, because vectors find these together.
        let (mut low, mut share) = ([[0i32; LANES]; 7], [[0f32; LANES]; 7]);
        for k in 0..7 {
            for i in 0..LANES {
                let place = (first as i32 + step as i32 * i as i32) as f32 + SAMPLES[k] * period[i];
                low[k][i] = fast_round::floor(place);
                share[k][i] = place - low[k][i] as f32;
            }
        }
        let [mut before, mut behind] = [[[0u8; LANES]; 7]; 2];
        for &i in pixels {
            for k in 0..7 {
                let pair = &self.image[low[k][i] as usize..][..2];
                (before[k][i], behind[k][i]) = (pair[0], pair[1]);
            }
            [seen.gains[0][i], seen.gains[1][i]] = self.gains.of(period[i]);
            seen.light[0][i] = self.light_between(columns, low[0][i] as usize, share[0][i]);
            seen.light[1][i] = self.light_between(columns, low[6][i] as usize, share[6][i]);
        }
        for k in 0..7 {
            for i in 0..LANES {
                let (a, b) = (f32::from(before[k][i]), f32::from(behind[k][i]));
                seen.samples[k][i] = a + share[k][i] * (b - a);
            }
        }
        seen
    }

    /// Demodulates what was seen and takes off the bias of shading.
    #[inline(always)]
    fn demodulate(&self, seen: &Seen, expected: &Lanes) -> Found {
        let [mut cos, mut sin, mut mean, mut misfit] = [[0f32; LANES]; 4];
        for i in 0..LANES {
            // Not by `map`: that would be a call, compiled for the narrowest processor.
            let [a, b, c, d, e, f, g] = &seen.samples;
            let samples = [a[i], b[i], c[i], d[i], e[i], f[i], g[i]];
            let (s, c, light, rest) = demodulate::of_samples(&samples, [seen.gains[0][i], seen.gains[1][i]]);
            let [c, s] = shading::correct_one(c, s, [seen.light[0][i], light, seen.light[1][i]]);
            (cos[i], sin[i], mean[i], misfit[i]) = (c, self.sign * s, light, rest);
        }
        let mut phase = [0f32; LANES];
        for i in 0..LANES {
            phase[i] = nearest(demodulate::phase(cos[i], sin[i]), expected[i]);
        }
        let [mut strength, mut light] = [[0u16; LANES]; 2];
        for i in 0..LANES {
            strength[i] = window_quality::strength_steps(cos[i], sin[i]);
            light[i] = window_quality::light_steps(mean[i]);
        }
        Found { phase, misfit, strength, light }
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
        // NaN where the run is too short.
        let (slope, bend) = match (own.is_nan(), before.is_nan()) {
            (false, false) => (own, (own - before) / reach),
            (false, true) => (own, 0.0),
            (true, _) => (carrier, 0.0),
        };
        Course { phase, slope, bend, behind: reach / 2.0 }
    }
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
        self.slope + self.bend * (distance + self.behind)
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

/// A wrapped phase by whole turns nearest to another.
#[inline(always)]
fn nearest(wrapped: f32, to: f32) -> f32 {
    wrapped + TAU * ((to - wrapped) / TAU).round()
}

#[cfg(test)]
mod tests;
