//! Stages of the front end by themselves, on whole frames: what tests ask of each. What is run goes row by row
//! ([`super::front`], [`super::windows::demodulate`]).

use super::demodulate::{Gains, PhasorRow, average_block, demodulate_row, phase, row_reach, units};
use super::runs::{Run, Runs};
use super::sample::{self, LANES};
use super::shading;
use super::windows::Windows;
use crate::image::{Mono8, Plane};

/// The phasor of each pixel: `c + i s = 6 B exp(i W)`; both zero where it is unknown.
#[derive(Debug)]
pub struct Phasors {
    /// Real part.
    pub c: Plane<f32>,
    /// Imaginary part.
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
    let mut light = Vec::new();
    for v in 0..image.height() {
        let row = PhasorRow {
            c: out.c.row_mut(v),
            s: out.s.row_mut(v),
            mean: out.mean.row_mut(v),
            misfit: out.misfit.row_mut(v),
        };
        demodulate_row(image.row(v), runs.row(v), period.row(v), gains, sign, &mut light, row);
    }
    out
}

/// The mean of up to five rows, see [`average_block`].
pub fn average_rows(phasors: &mut Phasors, skip: &Plane<u8>) {
    let (w, h) = (phasors.c.width(), phasors.c.height());
    let (c, s) = (phasors.c.clone(), phasors.s.clone());
    let [mut unit_c, mut unit_s, mut lengths] = [(); 3].map(|()| Plane::filled(w, h, 0f32));
    let out = [&mut unit_c, &mut unit_s, &mut lengths].map(Plane::as_mut_slice);
    units(c.as_slice(), s.as_slice(), out);
    for v in 0..h {
        let row = |v: usize| [unit_c.row(v), unit_s.row(v), lengths.row(v), phasors.misfit.row(v)];
        let reach = row_reach(v, h);
        let pairs = [1, 2].map(|k| [row(v - reach.min(k)), row(v + reach.min(k))]);
        let (out_c, out_s) = (phasors.c.row_mut(v), phasors.s.row_mut(v));
        for first in (0..w).step_by(LANES) {
            let end = w.min(first + LANES);
            let [c, s] = average_block([c.row(v), s.row(v)], row(v), &pairs[..reach], skip.row(v), first);
            sample::store(out_c, first, end - first, &c);
            sample::store(out_s, first, end - first, &s);
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
    let all = [Run::new(0, period.width())];
    let mut light = Vec::new();
    for v in 0..period.height() {
        let phasor = (phasors.c.row_mut(v), phasors.s.row_mut(v));
        shading::correct_row(phasor, phasors.mean.row(v), period.row(v), skip.row(v), &all, sign, &mut light);
    }
}

/// What is left of the windows of phasors, of the pixels of `runs`.
pub fn windows(phasors: Phasors, runs: &Runs) -> Windows {
    let Phasors { c, s, mean, misfit } = phasors;
    let (width, height) = (misfit.width(), misfit.height());
    let [strength, light] = [(); 2].map(|()| Plane::filled(width, height, 0u16));
    let mut windows = Windows { strength, light, misfit };
    for v in 0..height {
        windows.keep_row(v, runs.row(v), [c.row(v), s.row(v), mean.row(v)]);
    }
    windows
}
