// SPDX-License-Identifier: MIT OR Apache-2.0
//! The front end of the default method: from a photograph and its mask to wrapped phases and the marker.
//!
//! Two passes over the rows. The first gives the period and finds the marker's ridges, which decide where the second
//! takes its means. That one demodulates row after row and keeps what the following stages look back at in rings of
//! rows, which stay in the cache: only finished rows go to the planes.

use super::kernels::buffer_pool::PlanePools;
use super::kernels::pixel_runs::{Runs, Surroundings, fill_around};
use super::kernels::prefetch::{self, AHEAD};
use super::kernels::simd;
use super::kernels::stage_times::Clock;
use super::kernels::subpixel::{self, LANES, Lanes, Light};
use super::marker;
use super::marker::bias::{self, Ring};
use super::phase::demodulate::{self, Gains};
use super::phase::over_exposed::{self, GoodPixels};
use super::phase::window_quality::{self, Windows};
use super::phase::{period, shading};
use super::triangulate::camera_projector::CameraProjector;
use crate::base::image::{Mono8, Plane};

/// The results of the front end; all planes cover the region of interest.
#[derive(Debug)]
pub struct Front {
    /// Fringe period Pm, px; 0 where it is unknown.
    pub period: Plane<f32>,
    /// Amplitude, light and misfit of the window of each pixel.
    pub windows: Windows,
    /// Wrapped phase Wm, rad; NaN where it is unknown.
    pub wrapped: Plane<f32>,
    /// Not 0 around the marker, where phases are means over its period.
    pub zone: Plane<u8>,
    /// Runs of the pixels on the marker's cores, which name a fringe.
    pub cores: Runs,
    /// The marker's modulation relative to the light, where maps are kept.
    pub energy: Option<Plane<f32>>,
    /// Pixels with a wrapped phase.
    pub known: usize,
}

/// Rows that are used again from frame to frame.
#[derive(Debug, Default)]
pub struct Buffers {
    /// Which columns beside the runs later stages read.
    surroundings: Surroundings,
    period: period::Buffers,
    marker: marker::Buffers,
    /// Rings of rows of C and S: as demodulated, and with the marker's means in its zone.
    raw: [Vec<Vec<f32>>; 2],
    bridged: [Vec<Vec<f32>>; 2],
    /// The phasors of `bridged` with a length of 1, and their lengths.
    units: [Vec<Vec<f32>>; 3],
    /// The misfit of the windows, in a ring of rows.
    misfit: Vec<Vec<f32>>,
    /// C and S of a row before the bias of shading is taken off.
    shaded: [Vec<f32>; 2],
    /// A row of zeros: what stands for rows beyond the frame.
    zeros: Vec<f32>,
    /// Light of a row's pixels, and of their windows, with room to either side.
    light: Light,
    mean: Vec<f32>,
    good_pixels: GoodPixels,
    /// Pixels with a phase so far.
    known: usize,
}

/// Rows in the rings of `bridged` and `units`: as many as are averaged.
const BRIDGED: usize = demodulate::ROWS;

/// Which results are wanted beside those that every frame gives.
#[derive(Debug, Clone, Copy)]
pub(super) struct Keep {
    /// Whether to keep the plane of the marker's energy.
    pub energy: bool,
    /// Whether to define all planes beside the runs, for readers of whole rows: light and misfit become 0, periods and
    /// phases unknown.
    pub define_outside_runs: bool,
}

/// Runs the front end on the part of a frame that holds the object, whose runs these are: all of them, and without what
/// is over-exposed.
pub(super) fn run(
    image: Mono8<'_>,
    (runs, good): (&Runs, &Runs),
    pair: &CameraProjector,
    gains: &Gains,
    keep: Keep,
    (buffers, planes): (&mut Buffers, &PlanePools),
    clock: &mut Clock,
) -> Front {
    let (w, h) = (image.width(), image.height());
    let mut period = planes.floats.take(w, h);
    clock.time("period", || {
        let Buffers { surroundings, period: rows, .. } = &mut *buffers;
        surroundings.find(runs, w, keep.define_outside_runs);
        period::measure(image, (runs, surroundings), pair.period_px, rows, &mut period);
    });
    let mut energy = keep.energy.then(Plane::default);
    let (ridges, zone, zone_runs) = clock.time("marker", || {
        let ridges = marker::ridges(image, good, &period, pair, &mut buffers.marker, energy.as_mut());
        let mut zone = planes.bytes.take(w, h);
        bias::zone(&ridges, &period, &mut zone);
        let zone_runs = Runs::of(&zone);
        bias::bridge_period(&mut period, &zone_runs, pair.period_px);
        (ridges, zone, zone_runs)
    });
    let (strength, light) = (planes.words.take(w, h), planes.words.take(w, h));
    let mut windows = Windows { strength, light, misfit: planes.floats.take(w, h) };
    if keep.define_outside_runs {
        windows.light.as_mut_slice().fill(0);
        windows.misfit.as_mut_slice().fill(0.0);
    }
    let mut wrapped = planes.floats.take(w, h);
    clock.time("phase", || {
        let (zone, zone_runs) = (&zone, &zone_runs);
        let input = Input { image, runs, good, period: &period, zone, zone_runs, pair, gains };
        simd::dispatch(
            #[inline(always)]
            || input.phases(buffers, &mut windows, &mut wrapped),
        );
    });
    let cores = clock.time("anchors", || marker::detect(&ridges, &period, &wrapped, pair));
    let known = buffers.known;
    Front { period, windows, wrapped, zone, cores, energy, known }
}

/// What the second pass reads.
struct Input<'a> {
    image: Mono8<'a>,
    runs: &'a Runs,
    /// The runs without what is over-exposed.
    good: &'a Runs,
    period: &'a Plane<f32>,
    zone: &'a Plane<u8>,
    zone_runs: &'a Runs,
    pair: &'a CameraProjector,
    gains: &'a Gains,
}

impl Input<'_> {
    /// Values of a row with room for a block behind its end.
    #[inline(always)]
    fn room(&self) -> usize {
        self.image.width() + LANES
    }

    /// A plane from row `v` on: blocks that end behind a row's end are written whole, because the row below is written
    /// later.
    #[inline(always)]
    fn rest<'p, T: Copy>(&self, plane: &'p mut Plane<T>, v: usize) -> &'p mut [T] {
        let (w, h) = (self.image.width(), self.image.height());
        &mut plane.as_mut_slice()[v * w..][..(h - v) * w]
    }

    /// The second pass: phasors and wrapped phases of all rows.
    #[inline(always)]
    fn phases(&self, buffers: &mut Buffers, windows: &mut Windows, wrapped: &mut Plane<f32>) {
        let (w, h) = (self.image.width(), self.image.height());
        let average = bias::Average::new(self.pair);
        let reach = average.reach();
        const LATER: usize = demodulate::ROWS_EACH_SIDE;
        buffers.raw.iter_mut().for_each(|ring| empty(ring, 2 * reach + 1, w));
        buffers.bridged.iter_mut().for_each(|ring| empty(ring, BRIDGED, w));
        buffers.units.iter_mut().for_each(|ring| empty(ring, BRIDGED, w));
        empty(&mut buffers.misfit, reach + BRIDGED, w);
        buffers.shaded.iter_mut().for_each(|row| subpixel::with_room(row, w));
        subpixel::with_room(&mut buffers.zeros, w);
        buffers.known = 0;
        for next in 0..h + reach + LATER {
            prefetch::row(self.period, self.runs, next + AHEAD);
            prefetch::row(&windows.light, self.runs, next + AHEAD);
            if next < h {
                self.demodulate(next, buffers, windows);
            }
            if let Some(v) = next.checked_sub(reach)
                && v < h
            {
                self.bridge(v, &average, buffers);
            }
            if let Some(v) = next.checked_sub(reach + LATER) {
                prefetch::row(wrapped, self.runs, v + AHEAD);
                prefetch::row(&windows.strength, self.runs, v + AHEAD);
                prefetch::row(&windows.misfit, self.runs, v + AHEAD);
                self.finish(v, buffers, windows, wrapped);
            }
        }
    }

    /// Demodulates row `v` and takes off the bias of shading.
    #[inline(always)]
    fn demodulate(&self, v: usize, buffers: &mut Buffers, windows: &mut Windows) {
        let Buffers { raw: [c, s], misfit, shaded, light, mean, good_pixels, .. } = buffers;
        let (length, misfits) = (c.len(), misfit.len());
        // Slices of one length: the compiler then checks once whether a block fits.
        let room = ..self.room();
        let (c, s) = (&mut c[v % length][room], &mut s[v % length][room]);
        let misfit = &mut misfit[v % misfits][room];
        clear([c, s], self.runs, v, length);
        clear([misfit], self.runs, v, misfits);
        let [shaded_c, shaded_s] = shaded;
        let (shaded_c, shaded_s) = (&mut shaded_c[room], &mut shaded_s[room]);
        clear([shaded_c, shaded_s], self.runs, v, 1);
        let (runs, period) = (self.runs.row(v), self.period.row(v));
        shading::clear_light(mean, self.image.width(), self.runs.span(v));
        let steps = self.rest(&mut windows.light, v);
        let (row, good_runs) = (self.image.row(v), self.good.row(v));
        let is_over_exposed = runs != good_runs;
        if is_over_exposed {
            for run in runs {
                [&mut *shaded_c, shaded_s, misfit].into_iter().for_each(|row| row[run.columns()].fill(0.0));
                steps[run.columns()].fill(0);
            }
        }
        demodulate::demodulate_row(
            row,
            good_runs,
            period,
            self.gains,
            self.pair.sign,
            light,
            #[inline(always)]
            |at, block| {
                let first = at.start;
                subpixel::put(shaded_c, first, &block[0]);
                subpixel::put(shaded_s, first, &block[1]);
                subpixel::put(misfit, first, &block[3]);
                shading::keep_light(mean, first, &block[2]);
                subpixel::put_each(
                    steps,
                    first,
                    #[inline(always)]
                    |i| window_quality::light_steps(block[2][i]),
                );
            },
        );
        if is_over_exposed {
            over_exposed::fit_row(
                row,
                (runs, good_runs),
                period,
                self.pair.sign,
                good_pixels,
                #[inline(always)]
                |u, [c, s, mean, rest]| {
                    if shaded_c[u] == 0.0 && shaded_s[u] == 0.0 {
                        // The slope of the light is a part of the fit. `mean` stays unknown, so that the slope is not taken
                        // off again.
                        (shaded_c[u], shaded_s[u], misfit[u]) = (c, s, rest);
                        steps[u] = window_quality::light_steps(mean);
                    }
                },
            );
        }
        self.zone_runs.row(v).iter().for_each(|run| shading::skip_light(mean, run.columns()));
        shading::correct_row([shaded_c, shaded_s], mean, period, runs, self.pair.sign, [c, s]);
    }

    /// Row `v` of the phasors with the marker's means in its zone, and their directions.
    #[inline(always)]
    fn bridge(&self, v: usize, average: &bias::Average, buffers: &mut Buffers) {
        let Buffers { raw: [raw_c, raw_s], bridged: [c, s], units: [unit_c, unit_s, length], misfit, .. } =
            buffers;
        let (from, to, misfits) = (v % raw_c.len(), v % BRIDGED, misfit.len());
        let room = ..self.room();
        let (c, s, misfit) = (&mut c[to][room], &mut s[to][room], &mut misfit[v % misfits][room]);
        let (unit_c, unit_s, length) = (&mut unit_c[to][room], &mut unit_s[to][room], &mut length[to][room]);
        let (own_c, own_s) = (&raw_c[from][room], &raw_s[from][room]);
        clear([c, s, unit_c, unit_s, length], self.runs, v, BRIDGED);
        for run in self.runs.row(v) {
            for first in run.columns().step_by(LANES) {
                let block = [subpixel::chunk(own_c, first), subpixel::chunk(own_s, first)];
                subpixel::put(c, first, block[0]);
                subpixel::put(s, first, block[1]);
                put_units([unit_c, unit_s, length], first, block);
            }
        }
        let (reach, height) = (average.reach(), self.image.height());
        let whole = v >= reach && v + reach < height;
        let ring = Ring { c: raw_c, s: raw_s };
        for run in self.zone_runs.row(v) {
            for first in run.columns().step_by(LANES) {
                let count = LANES.min(run.end() - first);
                let mut block = if whole { average.block(&ring, v, first) } else { [[0.0; LANES]; 2] };
                for i in 0..count {
                    let known = (own_c[first + i] != 0.0) | (own_s[first + i] != 0.0);
                    for lanes in &mut block {
                        lanes[i] = if known { lanes[i] } else { 0.0 };
                    }
                    // A lobe of other height than its neighbours is no misfit here.
                    let at = &mut misfit[first + i];
                    *at = if known { 0.0 } else { *at };
                }
                subpixel::store(c, first, count, &block[0]);
                subpixel::store(s, first, count, &block[1]);
                put_units(
                    [unit_c, unit_s, length],
                    first,
                    [subpixel::chunk(c, first), subpixel::chunk(s, first)],
                );
            }
        }
    }

    /// Averages row `v` with up to `REACH` above and below it, and takes its phases.
    #[inline(always)]
    fn finish(&self, v: usize, buffers: &mut Buffers, windows: &mut Windows, wrapped: &mut Plane<f32>) {
        let Buffers {
            bridged: [c, s],
            units: [unit_c, unit_s, length],
            misfit,
            zeros,
            known,
            surroundings,
            ..
        } = buffers;
        let room = ..self.room();
        let rows = |v: usize| {
            let row = v % BRIDGED;
            [&unit_c[row][room], &unit_s[row][room], &length[row][room], &misfit[v % misfit.len()][room]]
        };
        let reach = demodulate::row_reach(v, self.image.height());
        const REACH: usize = demodulate::ROWS_EACH_SIDE;
        // Rows beyond the frame take no part.
        let beyond = [&zeros[room]; 4];
        let mut around = [[beyond; 2]; REACH];
        for (k, around) in (1..=reach).zip(&mut around) {
            *around = [rows(v - k), rows(v + k)];
        }
        let [_, _, length, misfit] = rows(v);
        let own = [&c[v % BRIDGED][room], &s[v % BRIDGED][room], length, misfit];
        // Later stages read phases beside the runs, but no windows.
        fill_around(self.runs.row(v), wrapped.row_mut(v), surroundings.columns(v), f32::NAN);
        let (strength, misfit) = (self.rest(&mut windows.strength, v), self.rest(&mut windows.misfit, v));
        let phases = self.rest(wrapped, v);
        // Few rows cross the marker's zone: for the others the plane need not be loaded.
        let marked = !self.zone_runs.row(v).is_empty();
        for run in self.runs.row(v) {
            for first in run.columns().step_by(LANES) {
                let mut pairs = [pair(&around[0], first); REACH];
                for (pairs, around) in pairs.iter_mut().zip(&around) {
                    *pairs = pair(around, first);
                }
                let skip = if marked { subpixel::load(self.zone.row(v), first) } else { [0; LANES] };
                let own = block(&own, first);
                let [c, s] = demodulate::average_block(own, &pairs, &skip);
                let mut angles = [0.0; LANES];
                for i in 0..LANES {
                    angles[i] = demodulate::phase(c[i], s[i]);
                }
                subpixel::put(misfit, first, own[3]);
                subpixel::put_each(
                    strength,
                    first,
                    #[inline(always)]
                    |i| window_quality::strength_steps(c[i], s[i]),
                );
                subpixel::put(phases, first, &angles);
            }
            let phases = &phases[run.columns()];
            *known += phases.iter().map(|x| u32::from(!x.is_nan())).sum::<u32>() as usize;
        }
    }
}

/// Writes the directions of a block of phasors, and their lengths.
#[inline(always)]
fn put_units([unit_c, unit_s, length]: [&mut [f32]; 3], first: usize, [c, s]: [&Lanes; 2]) {
    let units = demodulate::units(c, s);
    subpixel::put(unit_c, first, &units[0]);
    subpixel::put(unit_s, first, &units[1]);
    subpixel::put(length, first, &units[2]);
}

/// The block of each of four rows that begins at this column.
#[inline(always)]
fn block<'a>(rows: &[&'a [f32]; 4], first: usize) -> demodulate::Row<'a> {
    // Not by `map`: that would be a call, compiled for the narrowest processor.
    let [a, b, c, d] = rows;
    [
        subpixel::chunk(a, first),
        subpixel::chunk(b, first),
        subpixel::chunk(c, first),
        subpixel::chunk(d, first),
    ]
}

/// The blocks of a row above and of one below.
#[inline(always)]
fn pair<'a>([above, below]: &[[&'a [f32]; 4]; 2], first: usize) -> [demodulate::Row<'a>; 2] {
    [block(above, first), block(below, first)]
}

/// Makes a ring of rows of zeros.
fn empty(ring: &mut Vec<Vec<f32>>, length: usize, width: usize) {
    ring.resize(length, Vec::new());
    ring.iter_mut().for_each(|row| subpixel::with_room(row, width));
}

/// Prepares rows of rings of `length` rows for row `v`: clears what they hold of row `v - length`, except where the
/// runs of row `v` will be written.
#[inline(always)]
fn clear<const N: usize>(mut rows: [&mut [f32]; N], runs: &Runs, v: usize, length: usize) {
    let Some(before) = v.checked_sub(length) else { return };
    for old in runs.row(before) {
        let mut from = old.start();
        let own = runs.row(v).iter().filter(|run| run.end() > old.start() && run.start() < old.end());
        for [start, end] in own.map(|run| [run.start(), run.end()]).chain([[old.end(); 2]]) {
            if from < start {
                rows.iter_mut().for_each(|row| row[from..start].fill(0.0));
            }
            from = end;
        }
    }
}
