// SPDX-License-Identifier: MIT OR Apache-2.0
//! Stages of the front end by themselves, on whole frames, for unit tests. The pipeline runs them row by row
//! ([`crate::wrapped_phase`]).

use super::demodulate::{Gains, average_block, demodulate_row, phase, row_reach, units};
use super::shading;
use super::window_quality::{Windows, light_steps, strength_steps};
use crate::base::image::{Mono8, Plane};
use crate::kernels::pixel_runs::{Run, Runs};
use crate::kernels::subpixel::{self, LANES, Light};

/// The phasor of each pixel: `c + i s = 6 B exp(i W)`; both zero where it is unknown.
#[derive(Debug)]
pub struct Phasors {
    pub c: Plane<f32>,
    pub s: Plane<f32>,
    /// Light over the window's one period: the mean, DN.
    pub mean: Plane<f32>,
    /// What the samples have beside offset, slope and fringe: RMS relative to B.
    pub misfit: Plane<f32>,
}

/// Demodulates every mask pixel whose window of one period lies within its run of the mask of zeros and ones. `sign`
/// is that of the phase along the columns: the formula alone always yields a phase that grows with the column.
pub fn demodulate(
    image: Mono8<'_>,
    mask: &Plane<u8>,
    period: &Plane<f32>,
    gains: &Gains,
    sign: f32,
) -> Phasors {
    let runs = Runs::of(mask);
    let blank = || Plane::filled(image.width(), image.height(), 0f32);
    let mut out = Phasors { c: blank(), s: blank(), mean: blank(), misfit: blank() };
    let mut light = Light::default();
    for v in 0..image.height() {
        let (own, period) = (runs.row(v), period.row(v));
        demodulate_row(image.row(v), own, period, gains, sign, &mut light, |at, block| {
            let planes = [&mut out.c, &mut out.s, &mut out.mean, &mut out.misfit];
            for (plane, lanes) in planes.into_iter().zip(block) {
                subpixel::store(plane.row_mut(v), at.start, at.len(), lanes);
            }
        });
    }
    out
}

/// The mean of up to five rows, see [`average_block`].
pub fn average_rows(phasors: &mut Phasors, skip: &Plane<u8>) {
    let (w, h) = (phasors.c.width(), phasors.c.height());
    let (c, s) = (phasors.c.clone(), phasors.s.clone());
    for v in 0..h {
        let reach = row_reach(v, h);
        for first in (0..w).step_by(LANES) {
            let block = |plane: &Plane<f32>, v: usize| subpixel::load(plane.row(v), first);
            let row = |v: usize| {
                let [unit_c, unit_s, length] = units(&block(&c, v), &block(&s, v));
                [unit_c, unit_s, length, block(&phasors.misfit, v)]
            };
            let pairs =
                [1, 2].map(|k| if k <= reach { [row(v - k), row(v + k)] } else { [[[0.0; LANES]; 4]; 2] });
            let pairs = pairs.each_ref().map(|pair| pair.each_ref().map(|row| row.each_ref()));
            let [_, _, length, misfit] = row(v);
            let own = [&block(&c, v), &block(&s, v), &length, &misfit];
            let [c, s] = average_block(own, &pairs, &subpixel::load(skip.row(v), first));
            let count = LANES.min(w - first);
            subpixel::store(phasors.c.row_mut(v), first, count, &c);
            subpixel::store(phasors.s.row_mut(v), first, count, &s);
        }
    }
}

/// Wm: the phase of each phasor in (-pi, pi]; NaN where it is unknown.
pub fn wrapped(phasors: &Phasors) -> Plane<f32> {
    let mut out = Plane::filled(phasors.c.width(), phasors.c.height(), f32::NAN);
    let phasors = phasors.c.as_slice().iter().zip(phasors.s.as_slice());
    for (out, (&c, &s)) in out.as_mut_slice().iter_mut().zip(phasors) {
        *out = phase(c, s);
    }
    out
}

/// Takes the first-order bias off all phasors but those with a non-zero `skip`, whose light is not used either:
/// there the marker changes it. `sign` is that of the phase along the columns.
pub fn correct_shading(phasors: &mut Phasors, period: &Plane<f32>, skip: &Plane<u8>, sign: f32) {
    let (width, all) = (period.width(), [Run::new(0, period.width())]);
    let mut light = Vec::new();
    for v in 0..period.height() {
        shading::clear_light(&mut light, width, 0..width);
        for first in (0..width).step_by(LANES) {
            shading::keep_light(&mut light, first, &subpixel::load(phasors.mean.row(v), first));
        }
        (0..width).filter(|&u| skip.at(u, v) != 0).for_each(|u| shading::skip_light(&mut light, u..u + 1));
        let with_room = |plane: &Plane<f32>| [plane.row(v), &[0.0; LANES]].concat();
        let own = [&with_room(&phasors.c)[..], &with_room(&phasors.s)[..]];
        let out = [phasors.c.row_mut(v), phasors.s.row_mut(v)];
        shading::correct_row(own, &light, period.row(v), &all, sign, out);
    }
}

/// What is left of the windows of phasors, of the pixels of `runs`.
pub fn windows(phasors: Phasors, runs: &Runs) -> Windows {
    let Phasors { c, s, mean, misfit } = phasors;
    let [strength, light] = [(); 2].map(|()| misfit.map(|_| 0));
    let mut windows = Windows { strength, light, misfit };
    for v in 0..c.height() {
        for u in runs.row(v).iter().flat_map(Run::columns) {
            windows.strength.set(u, v, strength_steps(c.at(u, v), s.at(u, v)));
            windows.light.set(u, v, light_steps(mean.at(u, v)));
        }
    }
    windows
}
