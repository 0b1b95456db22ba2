// SPDX-License-Identifier: MIT OR Apache-2.0
//! A small move of a device: a turn about its centre, a shift, another focal length.

use crate::geometry::{Device, Pose};
use nalgebra::{Isometry3, UnitQuaternion, Vector3};

/// Numbers of a motion: turn about x, y, z; shift along x, y, z; focal length.
pub(super) const NUMBERS: usize = 7;

/// Standard deviation of each number beforehand, rad, m and a share: what mounts and lenses move by, as a rule. Each moves
/// by some 0.3 mm what a device sees at the body, so that none is preferred.
pub(super) const USUAL: [f64; NUMBERS] = [TURN, TURN, TURN, SHIFT_M, SHIFT_M, SHIFT_M, FOCAL];
const TURN: f64 = 0.01 * std::f64::consts::PI / 180.0;
const SHIFT_M: f64 = 3e-4;
const FOCAL: f64 = 6e-4;

/// How a device stands, counted from its calibration.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Motion {
    /// About its own axes, rad.
    pub turn: Vector3<f64>,
    /// Of its centre, along its own axes, m.
    pub shift_m: Vector3<f64>,
    /// By which share its focal length is longer.
    pub focal: f64,
}

impl Motion {
    /// From its numbers, each in units of [`USUAL`].
    pub fn of(numbers: &[f64]) -> Self {
        let x: [f64; NUMBERS] = std::array::from_fn(|i| numbers[i] * USUAL[i]);
        Self { turn: [x[0], x[1], x[2]].into(), shift_m: [x[3], x[4], x[5]].into(), focal: x[6] }
    }

    /// One unit of one number.
    pub fn unit(number: usize) -> Self {
        Self::of(&std::array::from_fn::<f64, NUMBERS, _>(|i| if i == number { 1.0 } else { 0.0 }))
    }

    /// Its numbers, as [`Motion::of`] takes them.
    pub fn numbers(&self) -> [f64; NUMBERS] {
        let [x, y, z] = [0, 1, 2].map(|i| (self.turn[i], self.shift_m[i]));
        let all = [x.0, y.0, z.0, x.1, y.1, z.1, self.focal];
        std::array::from_fn(|i| all[i] / USUAL[i])
    }

    /// The device after this motion.
    pub fn apply(&self, device: &Device) -> Device {
        let mut moved = device.clone();
        let turn = UnitQuaternion::from_scaled_axis(self.turn);
        let motion = Isometry3::from_parts(self.shift_m.into(), turn);
        moved.world_from_device = Pose::new(device.world_from_device.isometry() * motion);
        moved.lens.fx *= 1.0 + self.focal;
        moved.lens.fy *= 1.0 + self.focal;
        moved
    }
}
