// SPDX-License-Identifier: MIT OR Apache-2.0
//! From absolute phase to the cloud: what is known of a frame in whole steps, then points and normals.
//!
//! Rows of points go through a ring of seven, as many as a normal needs, which stays in the cache. The steps come
//! first so that a cloud made of a stored phase map has the same bytes.

use super::normals::{LANES, Oriented, REACH, Row, orient};
use super::ray_table::{BLOCK_PX, Line, NODE_PX, RayTable};
use crate::base::image::Plane;
use crate::data::{Cloud, PhaseMap, Run, STEPS_PER_FRINGE, STEPS_PER_LEVEL, decode_sigma};
use crate::kernels::fast_round::whole;
use crate::kernels::pixel_runs::{self, Runs};
use crate::kernels::region_of_interest::Roi;
use crate::kernels::{prefetch, simd};
use std::f32::consts::TAU;
use std::hint::black_box;
use std::ops::Range;

/// Rows in the ring: a normal reaches three up and three down.
const RING: usize = 2 * REACH + 1;

/// Room to either side of a row of points, for the reach of normals and for what a block has beyond its end.
const PAD: usize = BLOCK_PX;

/// Fringes beyond this are no phase.
const MAX_STEPS: f32 = 4e6;

/// What is known of a frame on the region of interest.
#[derive(Debug, Clone, Copy)]
pub(crate) struct KnownPixels<'a> {
    /// Absolute phase, rad; NaN where it is unknown.
    pub absolute: &'a Plane<f32>,
    /// It is known within these only.
    pub runs: &'a Runs,
    /// Light over one fringe, in the whole steps of a [`PhaseMap`].
    pub light: &'a Plane<u16>,
    /// Where the planes lie in the frame.
    pub roi: Roi,
}

impl KnownPixels<'_> {
    /// Appends the runs of the known pixels of a row of the planes. `room` is for a row of bytes.
    #[inline(always)]
    fn add_runs(&self, v: usize, room: &mut [u8], to: &mut Vec<Run>) {
        for run in self.runs.row(v) {
            let phase = &self.absolute.row(v)[run.columns()];
            let known = &mut room[..phase.len()];
            for (known, phase) in known.iter_mut().zip(phase) {
                *known = u8::from(!phase.is_nan());
            }
            pixel_runs::runs_of(known, |start, end| {
                let (first, length) = (self.roi.u + run.start() + start, end - start);
                to.push(Run { row: (self.roi.v + v) as u16, first: first as u16, length: length as u16 });
            });
        }
    }

    /// What a plane of the region of interest has of a run.
    #[inline(always)]
    fn part<'p, T: Copy>(&self, plane: &'p Plane<T>, run: &Run) -> &'p [T] {
        let Roi { u, v, .. } = self.roi;
        &plane.row(usize::from(run.row) - v)[usize::from(run.first) - u..run.end() - u]
    }
}

/// Collects the known pixels of a frame in whole steps. `sigma_code` holds the standard uncertainty of each phase as a
/// byte, where uncertainties are wanted; `frame` is columns and rows.
pub(crate) fn phase_map(
    known: &KnownPixels<'_>,
    sigma_code: Option<&Plane<u8>>,
    frame: [u16; 2],
) -> PhaseMap {
    let mut map = PhaseMap { frame, ..PhaseMap::default() };
    let mut room = vec![0u8; known.roi.width];
    simd::dispatch(
        #[inline(always)]
        || {
            for v in 0..known.roi.height {
                known.add_runs(v, &mut room, &mut map.runs);
            }
            let pixels = map.runs.iter().map(|run| usize::from(run.length)).sum();
            (map.phase, map.light) = (vec![0; pixels], vec![0; pixels]);
            map.sigma_code.reserve_exact(if sigma_code.is_some() { pixels } else { 0 });
            let mut first = 0;
            for run in &map.runs {
                let own = first..first + usize::from(run.length);
                first = own.end;
                for (to, &phase) in map.phase[own.clone()].iter_mut().zip(known.part(known.absolute, run)) {
                    *to = steps(phase);
                }
                map.light[own].copy_from_slice(known.part(known.light, run));
                if let Some(sigma_code) = sigma_code {
                    map.sigma_code.extend_from_slice(known.part(sigma_code, run));
                }
            }
        },
    );
    map
}

/// A phase, rad, in whole steps.
#[inline(always)]
fn steps(phase: f32) -> i32 {
    whole((phase * (STEPS_PER_FRINGE / TAU)).clamp(-MAX_STEPS, MAX_STEPS))
}

/// A row of points in the ring.
#[derive(Default)]
struct RingRow {
    /// x, y and z of each point, world, m; NaN: none.
    points: [Vec<f32>; 3],
    /// Metres along the line of sight per rad of phase.
    metres_per_rad: Vec<f32>,
    /// What is written of it: all else is NaN.
    written: Range<usize>,
}

impl RingRow {
    fn new(width: usize) -> Self {
        let none = || vec![f32::NAN; width];
        Self { points: [none(), none(), none()], metres_per_rad: none(), written: 0..0 }
    }

    /// Prepares the row for new points in the columns `written`: older points outside of these become NaN.
    #[inline(always)]
    fn begin(&mut self, written: Range<usize>) {
        let Range { start, end } = self.written;
        let (before, behind) = (written.start.clamp(start, end), written.end.clamp(start, end));
        for plane in &mut self.points {
            plane[start..before].fill(f32::NAN);
            plane[behind..end].fill(f32::NAN);
        }
        self.written = written;
    }
}

/// The cloud of a frame, in the world. Pixels whose point lies outside the volume, has no normal or faces away from
/// the projector that is supposed to light it, give none. The map must be of the table's camera.
pub fn make(table: &RayTable, map: &PhaseMap) -> Cloud {
    simd::dispatch(
        #[inline(always)]
        || make_rows::<false>(table, map).0,
    )
}

/// How many points [`make`] makes of the map.
pub fn count(table: &RayTable, map: &PhaseMap) -> usize {
    simd::dispatch(
        #[inline(always)]
        || make_rows::<true>(table, map).1,
    )
}

/// The cloud, or (`COUNT`) the number of its points alone.
#[inline(always)]
fn make_rows<const COUNT: bool>(table: &RayTable, map: &PhaseMap) -> (Cloud, usize) {
    let (mut cloud, mut good) = (Cloud::default(), 0);
    let (Some(first), Some(last)) = (map.runs.first(), map.runs.last()) else { return (cloud, good) };
    if !COUNT {
        reserve(&mut cloud, map.phase.len(), !map.sigma_code.is_empty());
    }
    let left = map.runs.iter().map(|run| usize::from(run.first)).min().unwrap_or(0) / NODE_PX;
    let right = map.runs.iter().map(Run::end).max().unwrap_or(0).div_ceil(NODE_PX);
    let width = (right - left) * NODE_PX + 2 * PAD;
    let frame = Frame { table, map, left };
    let (mut line, mut fringes) = (Line::default(), vec![f32::NAN; width]);
    let mut ring: [RingRow; RING] = std::array::from_fn(|_| RingRow::new(width));
    let mut normals = RunNormals::new(width);
    // The runs and pixels whose points are made next, and those whose normals are.
    let (mut run_in, mut pixel_in, mut run_out, mut pixel_out) = (0, 0, 0, 0);
    for v in usize::from(first.row)..=usize::from(last.row) + REACH {
        let row = &mut ring[v % RING];
        let runs = runs_of_row(map, &mut run_in, v);
        if runs.is_empty() {
            row.begin(0..0);
        } else {
            pixel_in += frame.points(v, runs, &map.phase[pixel_in..], &mut fringes, &mut line, row);
        }
        let Some(v) = v.checked_sub(REACH) else { continue };
        let runs = runs_of_row(map, &mut run_out, v);
        if !runs.is_empty() {
            // Row v - 3 is where v + 4 will be.
            let row = |dv: usize| &ring[(v + RING + dv - REACH) % RING];
            let rows = [row(0), row(2), row(3), row(4), row(6)];
            pixel_out += frame.emit::<COUNT>(rows, runs, pixel_out, &mut normals, &mut cloud);
            if COUNT {
                good += std::mem::take(&mut normals.counted);
            }
        }
    }
    (cloud, good)
}

fn reserve(cloud: &mut Cloud, points: usize, sigma: bool) {
    cloud.position_m.reserve_exact(points);
    cloud.normal.reserve_exact(points);
    cloud.intensity.reserve_exact(points);
    cloud.pixel.reserve_exact(points);
    cloud.sigma_m.reserve_exact(if sigma { points } else { 0 });
}

/// The runs of row `v`, from `next` on, which moves behind them.
#[inline(always)]
fn runs_of_row<'a>(map: &'a PhaseMap, next: &mut usize, v: usize) -> &'a [Run] {
    let from = *next;
    while map.runs.get(*next).is_some_and(|run| usize::from(run.row) == v) {
        *next += 1;
    }
    &map.runs[from..*next]
}

/// The frame whose points are made.
#[derive(Clone, Copy)]
struct Frame<'a> {
    table: &'a RayTable,
    map: &'a PhaseMap,
    /// The table's column at which rows of points begin.
    left: usize,
}

impl Frame<'_> {
    /// The points of a row. `phase` begins with its pixels; returns how many these are.
    #[inline(always)]
    fn points(
        &self,
        v: usize,
        runs: &[Run],
        phase: &[i32],
        fringes: &mut [f32],
        line: &mut Line,
        ring: &mut RingRow,
    ) -> usize {
        let Self { table, left, .. } = *self;
        let place = |u: usize| u - left * NODE_PX + PAD;
        let mut pixel = 0;
        for run in runs {
            let to = &mut fringes[place(usize::from(run.first))..place(run.end())];
            for (to, &steps) in to.iter_mut().zip(&phase[pixel..]) {
                *to = steps as f32 * (1.0 / STEPS_PER_FRINGE);
            }
            pixel += usize::from(run.length);
        }
        let start = runs.first().map_or(0, |run| usize::from(run.first) / NODE_PX);
        let end = runs.last().map_or(0, |run| run.end().div_ceil(NODE_PX));
        table.line(v, start, end - start, line);
        // Whole blocks: there is room behind the last one.
        let first = place(start * NODE_PX);
        let written = first..first + ((end - start) * NODE_PX).next_multiple_of(BLOCK_PX);
        ring.begin(written.clone());
        let scale = if self.map.sigma_code.is_empty() { 0..0 } else { written.clone() };
        let [x, y, z] = &mut ring.points;
        let points = [&mut x[written.clone()], &mut y[written.clone()], &mut z[written.clone()]];
        table.points(line, &fringes[written.clone()], points, &mut ring.metres_per_rad[scale]);
        fringes[written].fill(f32::NAN);
        pixel
    }

    /// Appends the points of a row, or counts them; its pixels begin with `pixel`. Returns how many pixels these are.
    #[inline(always)]
    fn emit<const COUNT: bool>(
        &self,
        rows: [&RingRow; 5],
        runs: &[Run],
        pixel: usize,
        own: &mut RunNormals,
        cloud: &mut Cloud,
    ) -> usize {
        let Self { table, map, left } = *self;
        // Of one length, so that one check of a place serves for all rows.
        let width = rows[2].points[0].len();
        let mut points: [Row<'_>; 5] = [[&[]; 3]; 5];
        for (points, row) in points.iter_mut().zip(rows) {
            for (to, axis) in points.iter_mut().zip(&row.points) {
                *to = &axis[..width];
            }
        }
        let mut done = 0;
        for run in runs {
            let count = usize::from(run.length);
            let place = usize::from(run.first) - left * NODE_PX + PAD;
            own.orient(
                &points,
                place,
                count,
                table,
                #[inline(always)]
                |offset| {
                    if !COUNT {
                        expect(cloud, offset);
                    }
                },
            );
            if COUNT {
                let mut sum = 0;
                for &good in &own.good[..count] {
                    sum += u32::from(good);
                }
                own.counted += sum as usize;
                done += count;
                continue;
            }
            let positions = points[2].map(|axis| &axis[place..place + count]);
            let [x, y, z] = &own.normals;
            let normals = [&x[..count], &y[..count], &z[..count]];
            let light = &map.light[pixel + done..][..count];
            pixel_runs::runs_of(
                &own.good[..count],
                #[inline(always)]
                |start, end| {
                    append(&mut cloud.position_m, positions.map(|axis| &axis[start..end]));
                    append(&mut cloud.normal, normals.map(|axis| &axis[start..end]));
                    cloud.intensity.extend(light[start..end].iter().map(|&light| intensity(light)));
                    let first = run.first + start as u16;
                    cloud.pixel.extend((first..first + (end - start) as u16).map(|column| [column, run.row]));
                    if let Some(codes) = map.sigma_code.get(pixel + done + start..pixel + done + end) {
                        let codes = codes.iter().zip(&rows[2].metres_per_rad[place + start..]);
                        cloud.sigma_m.extend(codes.map(|(&code, scale)| decode_sigma(code) * scale));
                    }
                },
            );
            done += count;
        }
        done
    }
}

/// The normals of a run's points, good or not: points are appended by stretches of good ones.
struct RunNormals {
    normals: [Vec<f32>; 3],
    good: Vec<u8>,
    /// Points that were counted and not appended.
    counted: usize,
}

impl RunNormals {
    fn new(width: usize) -> Self {
        let zeros = || vec![0.0; width];
        Self { normals: [zeros(), zeros(), zeros()], good: vec![0; width], counted: 0 }
    }

    /// Computes the normals of `count` points from `place` on. `rows` are those around them that [`orient`] needs.
    /// `block` is called with the number of the first of each [`LANES`] points.
    #[inline(always)]
    fn orient(
        &mut self,
        rows: &[Row<'_>; 5],
        place: usize,
        count: usize,
        table: &RayTable,
        mut block: impl FnMut(usize),
    ) {
        for offset in (0..count).step_by(LANES) {
            block(offset);
            let oriented = orient::<false>(rows, place + offset, table);
            self.put(&oriented, offset);
            let known = BELOW[LANES.min(count - offset)];
            if (u128::from_le_bytes(oriented.good) ^ ALL) & known != 0 {
                // Computed anew, so that the first pass need not keep values for this rare case.
                self.put(&orient::<true>(rows, black_box(place + offset), table), offset);
            }
        }
    }

    #[inline(always)]
    fn put(&mut self, oriented: &Oriented, offset: usize) {
        for (to, normal) in self.normals.iter_mut().zip(&oriented.normal) {
            to[offset..offset + LANES].copy_from_slice(normal);
        }
        self.good[offset..offset + LANES].copy_from_slice(&oriented.good);
    }
}

/// Prefetches the memory of [`LANES`] points that are appended soon, `offset` places behind the end: a cloud is larger
/// than the cache, and writing it would take longer than computing it.
#[inline(always)]
fn expect(cloud: &mut Cloud, offset: usize) {
    ask_for(&mut cloud.position_m, offset);
    ask_for(&mut cloud.normal, offset);
    ask_for(&mut cloud.intensity, offset);
    ask_for(&mut cloud.pixel, offset);
}

/// The same for one of the lists of a cloud.
#[inline(always)]
fn ask_for<T>(list: &mut Vec<T>, offset: usize) {
    let room = list.spare_capacity_mut();
    for i in (0..LANES).step_by(prefetch::LINE / size_of::<T>()) {
        prefetch::value(room, offset + i);
    }
}

/// Appends points whose coordinates lie apart.
#[inline(always)]
fn append(to: &mut Vec<[f32; 3]>, [x, y, z]: [&[f32]; 3]) {
    to.extend(x.iter().zip(y).zip(z).map(|((&x, &y), &z)| [x, y, z]));
}

/// The bytes of a block whose points are all good.
const ALL: u128 = u128::MAX / 255;

/// For each number of points, all bits of as many bytes.
const BELOW: [u128; LANES + 1] = {
    let mut below = [0; LANES + 1];
    let mut count = 1;
    while count <= LANES {
        below[count] = u128::MAX >> (8 * (LANES - count));
        count += 1;
    }
    below
};

#[inline(always)]
fn intensity(light: u16) -> f32 {
    f32::from(light) * (1.0 / (255.0 * STEPS_PER_LEVEL))
}
