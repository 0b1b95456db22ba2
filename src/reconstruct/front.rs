//! The front end of the default method: from a photograph and its mask to wrapped phases and the marker.
//!
//! Two passes over the rows. The first gives the period and finds the marker's ridges, which decide where the second
//! takes its means. That one demodulates row after row and keeps what the following stages look back at in rings of
//! rows, which stay in the cache: only finished rows go to the planes.

use super::demodulate::{self, Gains, PhasorRow};
use super::marker_phase::{self, Ring};
use super::pair::Pair;
use super::pipeline::Clock;
use super::pool::Pool;
use super::runs::{Runs, fill_beside};
use super::sample::{self, LANES};
use super::windows::{self, Windows};
use super::{marker, period_fast, shading, simd};
use crate::image::{Mono8, Plane};
use std::sync::atomic::{AtomicUsize, Ordering};

/// What the front end gives, on the region of interest.
#[derive(Debug)]
pub struct Front {
    /// Runs of the object: nothing is known outside of them.
    pub runs: Runs,
    /// Pm, px; 0 where it is unknown.
    pub period: Plane<f32>,
    /// What is left of the windows of Wm.
    pub windows: Windows,
    /// Wm, rad; NaN where it is unknown.
    pub wrapped: Plane<f32>,
    /// Around the marker: not 0.
    pub zone: Plane<u8>,
    /// The marker's cores.
    pub cores: Runs,
    /// The marker's modulation relative to the light, where it was asked for.
    pub energy: Option<Plane<f32>>,
    /// Pixels with a wrapped phase.
    pub known: usize,
}

/// Rows that are used again from frame to frame.
#[derive(Debug, Default)]
pub struct Buffers {
    period: period_fast::Buffers,
    marker: marker::Buffers,
    /// C and S of each row as demodulated, and with the marker's means.
    raw: [Vec<Vec<f32>>; 2],
    bridged: [Vec<Vec<f32>>; 2],
    /// The latter with a length of 1, and their lengths.
    units: [Vec<Vec<f32>>; 3],
    /// Light of a row's pixels, and of their windows, and that with room to either side.
    light: Vec<f32>,
    mean: Vec<f32>,
    padded_mean: Vec<f32>,
    /// Phases found so far.
    known: usize,
}

/// Rows of `bridged`: five that are averaged.
const BRIDGED: usize = demodulate::ROWS;

/// Planes that are used again from frame to frame, by whichever stage comes next.
#[derive(Debug)]
pub(super) struct Planes<T> {
    pool: Pool<Plane<T>>,
    /// Pixels that every plane has room for.
    room: AtomicUsize,
}

impl<T: Copy + Default> Planes<T> {
    /// None yet.
    pub(super) const fn new() -> Self {
        Self { pool: Pool::new(), room: AtomicUsize::new(0) }
    }

    /// From now on planes have room for so many pixels at least, of which memory is taken only as they are used: a
    /// plane that had to grow with each larger object would be copied to new pages.
    pub(super) fn make_room(&self, pixels: usize) {
        self.room.fetch_max(pixels, Ordering::Relaxed);
    }

    /// A plane for a stage that writes every value: those that it holds are any.
    pub(super) fn take(&self, width: usize, height: usize) -> Plane<T> {
        let mut plane = self.pool.take();
        plane.reserve(self.room.load(Ordering::Relaxed).max(width * height), T::default());
        plane.reshape(width, height, T::default());
        plane
    }

    /// Gives a plane back.
    pub(super) fn give(&self, plane: Plane<T>) {
        self.pool.give(plane);
    }
}

/// What is wanted besides.
#[derive(Debug, Clone, Copy)]
pub(super) struct Keep {
    /// The marker's energy.
    pub energy: bool,
    /// Light and misfit of 0 beside the runs, where they are any otherwise.
    pub beside: bool,
}

/// Runs the front end on the part of a frame that holds the object, whose runs these are.
pub(super) fn run(
    image: Mono8<'_>,
    runs: Runs,
    pair: &Pair,
    gains: &Gains,
    keep: Keep,
    (buffers, planes, words, bytes): (&mut Buffers, &Planes<f32>, &Planes<u16>, &Planes<u8>),
    clock: &mut Clock,
) -> Front {
    let (w, h) = (image.width(), image.height());
    let mut period = planes.take(w, h);
    clock.time("period", || {
        period_fast::measure(image, &runs, pair.period_px, &mut buffers.period, &mut period);
    });
    let mut energy = keep.energy.then(Plane::default);
    let (ridges, zone, zone_runs) = clock.time("marker", || {
        let ridges = marker::ridges(image, &runs, &period, pair, &mut buffers.marker, energy.as_mut());
        let mut zone = bytes.take(w, h);
        marker_phase::zone(&ridges, &period, &mut zone);
        let zone_runs = Runs::of(&zone);
        marker_phase::bridge_period(&mut period, &zone_runs, pair.period_px);
        (ridges, zone, zone_runs)
    });
    let (strength, light) = (words.take(w, h), words.take(w, h));
    let mut windows = Windows { strength, light, misfit: planes.take(w, h) };
    if keep.beside {
        windows.light.as_mut_slice().fill(0);
        windows.misfit.as_mut_slice().fill(0.0);
    }
    let mut wrapped = planes.take(w, h);
    clock.time("phase", || {
        let (zone, zone_runs) = (&zone, &zone_runs);
        let input = Input { image, runs: &runs, period: &period, zone, zone_runs, pair, gains };
        simd::dispatch(
            #[inline(always)]
            || input.phases(buffers, &mut windows, &mut wrapped),
        );
    });
    let cores = clock.time("anchors", || marker::detect(&ridges, &period, &wrapped, pair));
    let known = buffers.known;
    Front { runs, period, windows, wrapped, zone, cores, energy, known }
}

/// What the second pass reads.
struct Input<'a> {
    image: Mono8<'a>,
    runs: &'a Runs,
    period: &'a Plane<f32>,
    zone: &'a Plane<u8>,
    zone_runs: &'a Runs,
    pair: &'a Pair,
    gains: &'a Gains,
}

impl Input<'_> {
    /// The second pass: phasors and wrapped phases of all rows.
    #[inline(always)]
    fn phases(&self, buffers: &mut Buffers, windows: &mut Windows, wrapped: &mut Plane<f32>) {
        let (w, h) = (self.image.width(), self.image.height());
        let average = marker_phase::Average::new(self.pair);
        let reach = average.reach();
        for (rings, length) in [(&mut buffers.raw, 2 * reach + 1), (&mut buffers.bridged, BRIDGED)] {
            for ring in rings {
                empty(ring, length, w);
            }
        }
        buffers.units.iter_mut().for_each(|ring| empty(ring, BRIDGED, w));
        buffers.mean.resize(w, 0.0);
        buffers.known = 0;
        const LATER: usize = demodulate::ROWS / 2;
        for next in 0..h + reach + LATER {
            if next < h {
                self.demodulate(next, buffers, windows);
            }
            if let Some(v) = next.checked_sub(reach)
                && v < h
            {
                let misfit = windows.misfit.row_mut(v);
                bridge(v, h, &average, (self.runs, self.zone_runs), buffers, misfit);
                let Buffers { bridged: [c, s], units: [unit_c, unit_s, length], .. } = &mut *buffers;
                let row = v % BRIDGED;
                let (unit_c, unit_s, length) = (&mut unit_c[row], &mut unit_s[row], &mut length[row]);
                clear(unit_c, self.runs, v, BRIDGED);
                clear(unit_s, self.runs, v, BRIDGED);
                clear(length, self.runs, v, BRIDGED);
                for run in self.runs.row(v) {
                    let at = run.columns();
                    let out = [&mut unit_c[at.clone()], &mut unit_s[at.clone()], &mut length[at.clone()]];
                    demodulate::units(&c[row][at.clone()], &s[row][at], out);
                }
            }
            if let Some(v) = next.checked_sub(reach + LATER) {
                self.finish(v, buffers, windows, wrapped.row_mut(v));
            }
        }
    }

    /// Demodulates row `v` and takes off the bias of shading.
    #[inline(always)]
    fn demodulate(&self, v: usize, buffers: &mut Buffers, windows: &mut Windows) {
        let Buffers { raw: [c, s], light, mean, padded_mean, .. } = buffers;
        let (at, length) = (v % c.len(), c.len());
        clear(&mut c[at], self.runs, v, length);
        clear(&mut s[at], self.runs, v, length);
        let (c, s, mean) = (&mut c[at][..], &mut s[at][..], &mut mean[..]);
        let out = PhasorRow { c, s, mean, misfit: windows.misfit.row_mut(v) };
        let (runs, period) = (self.runs.row(v), self.period.row(v));
        demodulate::demodulate_row(self.image.row(v), runs, period, self.gains, self.pair.sign, light, out);
        shading::correct_row((c, s), mean, period, self.zone.row(v), runs, self.pair.sign, padded_mean);
        windows.keep_light(v, runs, mean);
    }

    /// Averages row `v` with those around it, and takes its phases.
    #[inline(always)]
    fn finish(&self, v: usize, buffers: &mut Buffers, windows: &mut Windows, wrapped: &mut [f32]) {
        let Buffers { bridged: [c, s], units: [unit_c, unit_s, length], known, .. } = buffers;
        let Windows { strength, misfit, .. } = windows;
        let rows = |v: usize| {
            let row = v % BRIDGED;
            [&unit_c[row][..], &unit_s[row][..], &length[row][..], misfit.row(v)]
        };
        let own = [&c[v % BRIDGED][..], &s[v % BRIDGED][..]];
        let reach = demodulate::row_reach(v, misfit.height());
        let pairs = [1, 2].map(|k| [rows(v - reach.min(k)), rows(v + reach.min(k))]);
        // Nobody looks at windows outside of the runs, but at phases.
        let strength = strength.row_mut(v);
        fill_beside(self.runs.row(v), wrapped, f32::NAN);
        for run in self.runs.row(v) {
            for first in run.columns().step_by(LANES) {
                let count = LANES.min(run.end() - first);
                let [c, s] =
                    demodulate::average_block(own, rows(v), &pairs[..reach], self.zone.row(v), first);
                let (mut phases, mut lengths) = ([0.0; LANES], [0u16; LANES]);
                for i in 0..LANES {
                    phases[i] = demodulate::phase(c[i], s[i]);
                }
                for i in 0..LANES {
                    lengths[i] = windows::strength_steps(c[i], s[i]);
                }
                sample::store(strength, first, count, &lengths);
                sample::store(wrapped, first, count, &phases);
            }
            let phases = &wrapped[run.columns()];
            *known += phases.iter().map(|x| u32::from(!x.is_nan())).sum::<u32>() as usize;
        }
    }
}

/// Makes a ring of rows of zeros.
fn empty(ring: &mut Vec<Vec<f32>>, length: usize, width: usize) {
    ring.resize(length, Vec::new());
    for row in ring {
        row.clear();
        row.resize(width, 0.0);
    }
}

/// Clears what the row of a ring of so many rows, which is to become row `v`, holds of the one that it was: beside the
/// runs there is nothing.
#[inline(always)]
fn clear(row: &mut [f32], runs: &Runs, v: usize, length: usize) {
    if let Some(before) = v.checked_sub(length) {
        runs.row(before).iter().for_each(|run| row[run.columns()].fill(0.0));
    }
}

/// Row `v` of the phasors with the marker's means in its zone.
#[inline(always)]
fn bridge(
    v: usize,
    height: usize,
    average: &marker_phase::Average,
    (runs, zone): (&Runs, &Runs),
    buffers: &mut Buffers,
    misfit: &mut [f32],
) {
    let Buffers { raw: [raw_c, raw_s], bridged: [c, s], .. } = buffers;
    let (from, to, reach) = (v % raw_c.len(), v % BRIDGED, average.reach());
    for (row, raw) in [(&mut c[to], &raw_c[from]), (&mut s[to], &raw_s[from])] {
        clear(row, runs, v, BRIDGED);
        for run in runs.row(v) {
            row[run.columns()].copy_from_slice(&raw[run.columns()]);
        }
    }
    let whole = v >= reach && v + reach < height;
    let ring = Ring { c: raw_c, s: raw_s };
    for run in zone.row(v) {
        for first in run.columns().step_by(LANES) {
            let count = LANES.min(run.end() - first);
            let mut block = if whole { average.block(&ring, v, first) } else { [[0.0; LANES]; 2] };
            for i in 0..count {
                let known = (raw_c[from][first + i] != 0.0) | (raw_s[from][first + i] != 0.0);
                for lanes in &mut block {
                    lanes[i] = if known { lanes[i] } else { 0.0 };
                }
                // A lobe of other height than its neighbours is no misfit here.
                let at = &mut misfit[first + i];
                *at = if known { 0.0 } else { *at };
            }
            sample::store(&mut c[to], first, count, &block[0]);
            sample::store(&mut s[to], first, count, &block[1]);
        }
    }
}
