// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the stages after the wrapped phase need of its windows. Amplitude and light are kept in 16 bits each: eight
//! frames of a trigger are in memory at once.

use crate::base::image::Plane;
use crate::data::STEPS_PER_LEVEL;
use crate::kernels::fast_round::whole;

/// Steps in which a phasor's length is kept, per DN.
pub const STEPS_PER_DN: f32 = 64.0;

/// Up to this misfit (relative to B) a window shows one surface of one colour: phases are 0.02 mm off (median, board).
pub(crate) const GOOD_MISFIT: f32 = 0.05;

/// From this misfit on (relative to B) a phase is doubtful: its window may cross an edge of colour or a step. Phases
/// of a misfit from 0.08 to 0.12 are 0.35 mm off (median, board; `docs/design/experiments.md`).
pub(crate) const DOUBTFUL_MISFIT: f32 = 0.08;

/// Fainter amplitudes B are taken for this one where noise is divided by them, DN.
pub(crate) const LEAST_AMPLITUDE_DN: f32 = 0.5;

/// The windows of a frame, by their middle pixel.
#[derive(Debug)]
pub struct Windows {
    /// Length of the phasor, 6 B, DN times [`STEPS_PER_DN`]; 0 where it is unknown.
    pub strength: Plane<u16>,
    /// Light over the window's one period: the mean, DN times [`STEPS_PER_LEVEL`].
    pub light: Plane<u16>,
    /// What the samples have beside offset, slope and fringe: RMS relative to B.
    pub misfit: Plane<f32>,
}

/// The length of a phasor in whole steps.
#[inline(always)]
pub(crate) fn strength_steps(c: f32, s: f32) -> u16 {
    let steps = (c * c + s * s).sqrt() * STEPS_PER_DN;
    whole(if steps < 65535.0 { steps } else { 65535.0 }) as u16
}

/// The amplitude B, DN, of a phasor whose length is given in steps.
#[inline(always)]
pub(crate) fn amplitude(strength: u16) -> f32 {
    f32::from(strength) * (1.0 / (6.0 * STEPS_PER_DN))
}

/// A mean light, DN, in whole steps.
#[inline(always)]
pub(crate) fn light_steps(mean: f32) -> u16 {
    whole((mean * STEPS_PER_LEVEL).clamp(0.0, 255.0 * STEPS_PER_LEVEL)) as u16
}

/// The light, DN, that is given in steps.
#[inline(always)]
pub(crate) fn light(steps: u16) -> f32 {
    f32::from(steps) * (1.0 / STEPS_PER_LEVEL)
}

#[cfg(test)]
mod tests {
    use super::{amplitude, light_steps, strength_steps};

    #[test]
    fn steps_are_the_nearest() {
        assert_eq!([0.0, 0.12, 0.13, 100.0, 300.0].map(light_steps), [0, 0, 1, 400, 1020]);
        assert_eq!(strength_steps(3.0, -4.0), 320);
        assert_eq!(strength_steps(0.0, 2000.0), 65535);
        assert!((amplitude(strength_steps(60.0, 80.0)) - 100.0 / 6.0).abs() < 1e-5);
    }
}
