// SPDX-License-Identifier: MIT OR Apache-2.0
//! The mannequin's bones: where the joints are in the rest pose, and how they are turned.
//!
//! Body axes: x forward, y to the body's left, z up; feet on z = 0. At rest it stands upright, arms hanging.

use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};

/// A rigid part of the body. Left and right are the body's own.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs, reason = "the names of body parts")]
pub enum Bone {
    Pelvis,
    Spine,
    Chest,
    Neck,
    Head,
    UpperArmL,
    ForearmL,
    HandL,
    UpperArmR,
    ForearmR,
    HandR,
    ThighL,
    ShankL,
    FootL,
    ThighR,
    ShankR,
    FootR,
}

/// Number of bones of the mannequin's skeleton.
pub const BONES: usize = 17;

/// Parent and rest position of the joint that a bone turns about, in the order of [`Bone`]; parents first.
const JOINTS: [(Option<Bone>, [f64; 3]); BONES] = [
    (None, [0.0, 0.0, 0.94]),
    (Some(Bone::Pelvis), [-0.015, 0.0, 1.04]),
    (Some(Bone::Spine), [-0.015, 0.0, 1.18]),
    (Some(Bone::Chest), [-0.02, 0.0, 1.46]),
    (Some(Bone::Neck), [0.0, 0.0, 1.55]),
    (Some(Bone::Chest), [-0.015, 0.175, 1.405]),
    (Some(Bone::UpperArmL), [-0.02, 0.195, 1.115]),
    (Some(Bone::ForearmL), [-0.005, 0.2, 0.865]),
    (Some(Bone::Chest), [-0.015, -0.175, 1.405]),
    (Some(Bone::UpperArmR), [-0.02, -0.195, 1.115]),
    (Some(Bone::ForearmR), [-0.005, -0.2, 0.865]),
    (Some(Bone::Pelvis), [0.0, 0.09, 0.9]),
    (Some(Bone::ThighL), [0.005, 0.095, 0.49]),
    (Some(Bone::ShankL), [-0.02, 0.1, 0.085]),
    (Some(Bone::Pelvis), [0.0, -0.09, 0.9]),
    (Some(Bone::ThighR), [0.005, -0.095, 0.49]),
    (Some(Bone::ShankR), [-0.02, -0.1, 0.085]),
];

/// How every joint is turned, relative to its parent.
#[derive(Debug, Clone)]
pub struct Posture {
    turns: [UnitQuaternion<f64>; BONES],
}

impl Default for Posture {
    fn default() -> Self {
        Self { turns: [UnitQuaternion::identity(); BONES] }
    }
}

impl Posture {
    /// Turns a bone further, about an axis of its own rest frame.
    pub fn turn(&mut self, bone: Bone, axis: Vector3<f64>, angle_rad: f64) {
        let turn = UnitQuaternion::from_scaled_axis(axis * angle_rad);
        self.turns[bone as usize] *= turn;
    }

    /// Body-from-rest transforms of all bones, pelvis in place.
    pub fn body_from_rest(&self) -> [Isometry3<f64>; BONES] {
        let mut poses = [Isometry3::identity(); BONES];
        for (bone, (parent, joint)) in JOINTS.iter().enumerate() {
            let joint = Point3::from(*joint);
            let turn = Isometry3::rotation_wrt_point(self.turns[bone], joint);
            poses[bone] = parent.map_or(turn, |parent| poses[parent as usize] * turn);
        }
        poses
    }
}

/// World-from-rest transforms: the body's own, lifted by `lift_m`, turned by `heading_rad` about the vertical
/// and placed at `position_m` on the floor.
pub fn place(
    body_from_rest: &[Isometry3<f64>; BONES],
    lift_m: f64,
    heading_rad: f64,
    position_m: [f64; 2],
) -> [Isometry3<f64>; BONES] {
    let [x, y] = position_m;
    let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), heading_rad);
    let world_from_body = Isometry3::from_parts(Translation3::new(x, y, lift_m), turn);
    body_from_rest.map(|pose| world_from_body * pose)
}

#[cfg(test)]
mod tests {
    use super::{Bone, Posture};
    use nalgebra::{Point3, Vector3};

    #[test]
    fn a_raised_arm_takes_its_hand_along() {
        let mut posture = Posture::default();
        posture.turn(Bone::UpperArmL, Vector3::x(), std::f64::consts::FRAC_PI_2);
        let hand = posture.body_from_rest()[Bone::HandL as usize] * Point3::new(-0.015, 0.175, 0.905);
        assert!((hand - Point3::new(-0.015, 0.675, 1.405)).norm() < 1e-12, "{hand}");
    }
}
