// SPDX-License-Identifier: MIT OR Apache-2.0
//! Cameras whose phases are off by about a radian or more: their head, or they, moved far.
//!
//! Other heads then bear out hardly any of their fringe orders, and what is not certain is not compared
//! ([`super::drift`]); the other camera of the head moved with them, and agrees. But whatever their orders are: where
//! certain places of other heads are seen, most phases that belong to the same surface are off by the same. Others are
//! off by chance, all amounts equally often.

use super::drift::POOL_PLACES;
use super::evidence::wrapped;
use std::f32::consts::{PI, TAU};

/// Bins that a turn is cut into.
const BINS: usize = 24;

/// Bins that one surface's differences lie in: a twelfth of a turn. It is more than what cameras may differ by.
const WIDTH: usize = 2;

/// By how many standard deviations more looks are off by one amount than by nothing, where a camera is far off.
const SURE: f32 = 5.0;

/// How often a camera's phase differs by which amount from what is expected at certain places of other heads' views.
#[derive(Debug, Clone, Copy, Default)]
pub struct Amounts([u32; BINS]);

impl Amounts {
    /// Counts a phase less the expected one, rad.
    pub fn count(&mut self, ahead: f32) {
        let turns = ahead / TAU + 0.5;
        self.0[((turns - turns.floor()) * BINS as f32) as usize % BINS] += 1;
    }

    /// Adds those of another view.
    pub fn add(&mut self, other: &Self) {
        self.0.iter_mut().zip(other.0).for_each(|(sum, x)| *sum += x);
    }

    /// By how much the camera is off, rad, where that is far.
    pub fn far_off_rad(&self) -> Option<f32> {
        let window = |first: usize| (first..first + WIDTH).map(|i| self.0[i % BINS]).sum::<u32>();
        let agree = window(BINS / 2 - 1);
        let (differ, first) = (0..BINS).map(|first| (window(first), first)).max()?;
        let sure = differ as f32 - agree as f32 > SURE * ((differ + agree) as f32).sqrt();
        let middle = (first as f32 + WIDTH as f32 / 2.0) / BINS as f32 * TAU - PI;
        (self.0.iter().sum::<u32>() as f32 >= POOL_PLACES && sure).then(|| wrapped(middle).abs())
    }
}

#[cfg(test)]
mod tests {
    use super::{Amounts, wrapped};

    /// Looks at chance, and at one surface that is off by `by` rad.
    fn amounts(chance: u32, surface: u32, by: f32) -> Amounts {
        let mut out = Amounts::default();
        (0..chance).for_each(|i| out.count((i * 37 % 1009) as f32));
        (0..surface).for_each(|i| out.count(by + ((i * 29 % 101) as f32 / 101.0 - 0.5) * 0.3));
        out
    }

    #[test]
    fn a_camera_is_far_off_where_most_looks_at_one_surface_are_off_by_the_same() {
        for by in [1.0, 2.0, 3.1, -1.5, 4.0, 5.3, 7.5] {
            let found = amounts(900, 300, by).far_off_rad().expect("far off");
            assert!((found - wrapped(by).abs()).abs() < 0.3, "{by}: {found}");
        }
    }

    #[test]
    fn a_camera_that_agrees_or_sees_by_chance_or_hardly_looks_is_not() {
        for (chance, surface, by) in
            [(900, 300, 0.0), (900, 300, 0.1), (900, 0, 0.0), (0, 110, 2.0), (3000, 60, 2.0)]
        {
            assert_eq!(amounts(chance, surface, by).far_off_rad(), None, "{chance} {surface} {by}");
        }
    }
}
