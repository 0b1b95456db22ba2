// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the mannequin does: postures over time.

use super::skeleton::{Bone, Posture};
use nalgebra::Vector3;
use std::f64::consts::TAU;

/// A movement that the mannequin repeats.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Motion {
    /// Stands with slightly spread arms, breathing.
    Stand,
    /// Raises both arms, half to the side and half to the front, and lowers them.
    ArmRaise,
    /// Walks without leaving its place.
    WalkInPlace,
    /// Turns the upper body to the left and to the right.
    Twist,
    /// Forearms across the trunk, rocking a little.
    ArmsCrossed,
    /// Hands on the hips, elbows out, turning the trunk a little.
    HandsOnHips,
    /// Bends forwards from the hips, arms hanging, and straightens up again.
    Bend,
    /// Squats until the thighs are level, arms to the front, and rises again.
    Squat,
    /// Both hands a little before the face, elbows in front of the chest.
    HandsAtFace,
}

impl Motion {
    /// All motions by their names in scenarios.
    pub const NAMES: [(&'static str, Self); 9] = [
        ("stand", Self::Stand),
        ("arm_raise", Self::ArmRaise),
        ("walk_in_place", Self::WalkInPlace),
        ("twist", Self::Twist),
        ("arms_crossed", Self::ArmsCrossed),
        ("hands_on_hips", Self::HandsOnHips),
        ("bend", Self::Bend),
        ("squat", Self::Squat),
        ("hands_at_face", Self::HandsAtFace),
    ];

    /// The posture at `cycles` repetitions (0: the beginning, 1: the same again).
    pub fn posture(self, cycles: f64) -> Posture {
        let swing = (TAU * cycles).sin();
        let rise = 0.5 - 0.5 * (TAU * cycles).cos();
        let mut posture = Posture::default();
        match self {
            Self::Stand => {
                spread_arms(&mut posture, 22.0 + 0.5 * swing);
                bend_elbows(&mut posture, 12.0);
                forward(&mut posture, Bone::Chest, 0.4 * swing);
            }
            Self::ArmRaise => {
                // Somewhat to the front, where the arms stay within the volume.
                posture.turn(Bone::UpperArmL, Vector3::z(), -f64::to_radians(38.0));
                posture.turn(Bone::UpperArmR, Vector3::z(), f64::to_radians(38.0));
                spread_arms(&mut posture, 25.0 + 75.0 * rise);
                bend_elbows(&mut posture, 20.0 + 10.0 * rise);
                forward(&mut posture, Bone::Head, -5.0 * rise);
            }
            Self::WalkInPlace => walk(&mut posture, cycles),
            Self::Twist => {
                spread_arms(&mut posture, 35.0);
                bend_elbows(&mut posture, 40.0);
                for (bone, degrees) in [(Bone::Spine, 14.0), (Bone::Chest, 16.0), (Bone::Head, -10.0)] {
                    posture.turn(bone, Vector3::z(), (degrees * swing).to_radians());
                }
            }
            Self::ArmsCrossed => cross_arms(&mut posture, swing),
            Self::HandsOnHips => rest_hands(&mut posture, swing),
            Self::Bend => bend(&mut posture, rise),
            Self::Squat => squat(&mut posture, rise),
            Self::HandsAtFace => lift_hands(&mut posture, swing),
        }
        posture
    }
}

/// Turns a bone forwards (a hanging limb swings to +x) by degrees.
fn forward(posture: &mut Posture, bone: Bone, degrees: f64) {
    posture.turn(bone, -Vector3::y(), degrees.to_radians());
}

fn spread_arms(posture: &mut Posture, degrees: f64) {
    posture.turn(Bone::UpperArmL, Vector3::x(), degrees.to_radians());
    posture.turn(Bone::UpperArmR, Vector3::x(), -degrees.to_radians());
}

fn bend_elbows(posture: &mut Posture, degrees: f64) {
    forward(posture, Bone::ForearmL, degrees);
    forward(posture, Bone::ForearmR, degrees);
}

fn walk(posture: &mut Posture, cycles: f64) {
    spread_arms(posture, 18.0);
    let sides = [
        (0.0, Bone::ThighL, Bone::ShankL, Bone::FootL, Bone::UpperArmR, Bone::ForearmR),
        (0.5, Bone::ThighR, Bone::ShankR, Bone::FootR, Bone::UpperArmL, Bone::ForearmL),
    ];
    for (offset, thigh, shank, foot, arm, forearm) in sides {
        let lift = (TAU * (cycles + offset)).sin().max(0.0).powi(2);
        forward(posture, thigh, 50.0 * lift);
        forward(posture, shank, -80.0 * lift);
        forward(posture, foot, 10.0 * lift);
        forward(posture, arm, 25.0 * lift - 8.0);
        forward(posture, forearm, 20.0 + 25.0 * lift);
    }
    posture.turn(Bone::Chest, Vector3::z(), (4.0 * (TAU * cycles).sin()).to_radians());
}

fn cross_arms(posture: &mut Posture, swing: f64) {
    // The left forearm lies a little higher and further out, so that the two touch but do not merge.
    let arms = [
        (1.0, Bone::UpperArmL, Bone::ForearmL, 40.0, 84.0 + 2.0 * swing, 62.0),
        (-1.0, Bone::UpperArmR, Bone::ForearmR, 26.0, 80.0 - 2.0 * swing, 66.0),
    ];
    for (side, arm, forearm, lift, bend, inward) in arms {
        posture.turn(arm, Vector3::x(), side * 16f64.to_radians());
        forward(posture, arm, lift);
        // Seen from above the forearm turns inwards about the upper arm.
        posture.turn(forearm, Vector3::z(), -side * f64::to_radians(inward));
        forward(posture, forearm, bend);
    }
    forward(posture, Bone::Head, 4.0 + 2.0 * swing);
}

fn rest_hands(posture: &mut Posture, swing: f64) {
    // Elbows out by 42 degrees and forearms at a right angle put the wrists beside the waist.
    let sides = [
        (1.0, Bone::UpperArmL, Bone::ForearmL, Bone::HandL),
        (-1.0, Bone::UpperArmR, Bone::ForearmR, Bone::HandR),
    ];
    for (side, arm, forearm, hand) in sides {
        posture.turn(arm, Vector3::x(), side * (42.0 + 2.0 * swing).to_radians());
        posture.turn(forearm, Vector3::x(), -side * (88.0 + 2.0 * swing).to_radians());
        forward(posture, forearm, 6.0);
        // Fingers down along the hip.
        posture.turn(hand, Vector3::x(), side * 38f64.to_radians());
    }
    for (bone, degrees) in [(Bone::Spine, 5.0), (Bone::Chest, 6.0), (Bone::Head, -8.0)] {
        posture.turn(bone, Vector3::z(), (degrees * swing).to_radians());
    }
}

fn bend(posture: &mut Posture, rise: f64) {
    let total = 55.0 * rise;
    // What the pelvis leans forwards, the thighs turn back: the legs stay upright.
    forward(posture, Bone::Pelvis, -0.45 * total);
    forward(posture, Bone::ThighL, 0.45 * total);
    forward(posture, Bone::ThighR, 0.45 * total);
    forward(posture, Bone::Spine, -0.3 * total);
    forward(posture, Bone::Chest, -0.25 * total);
    forward(posture, Bone::Head, -0.1 * total);
    spread_arms(posture, 14.0);
    // The arms go on hanging, a little to the front.
    forward(posture, Bone::UpperArmL, 1.1 * total);
    forward(posture, Bone::UpperArmR, 1.1 * total);
    bend_elbows(posture, 12.0);
}

fn squat(posture: &mut Posture, rise: f64) {
    // The trunk leans to the front, the knees lie before the feet, and the feet stay level.
    let (lean, hips, knees) = (25.0 * rise, 120.0 * rise, 115.0 * rise);
    forward(posture, Bone::Pelvis, -lean);
    for (side, thigh, shank, foot) in
        [(1.0, Bone::ThighL, Bone::ShankL, Bone::FootL), (-1.0, Bone::ThighR, Bone::ShankR, Bone::FootR)]
    {
        posture.turn(thigh, Vector3::z(), side * (12.0 * rise).to_radians());
        forward(posture, thigh, hips);
        forward(posture, shank, -knees);
        forward(posture, foot, lean - hips + knees);
    }
    forward(posture, Bone::Spine, -8.0 * rise);
    forward(posture, Bone::Head, 14.0 * rise);
    spread_arms(posture, 12.0);
    forward(posture, Bone::UpperArmL, 15.0 + 65.0 * rise);
    forward(posture, Bone::UpperArmR, 15.0 + 65.0 * rise);
    bend_elbows(posture, 15.0 + 15.0 * rise);
}

fn lift_hands(posture: &mut Posture, swing: f64) {
    for (side, arm, forearm) in
        [(1.0, Bone::UpperArmL, Bone::ForearmL), (-1.0, Bone::UpperArmR, Bone::ForearmR)]
    {
        posture.turn(arm, Vector3::z(), -side * 25f64.to_radians());
        forward(posture, arm, 62.0 + 2.0 * swing);
        forward(posture, forearm, 124.0 + 3.0 * swing);
    }
    forward(posture, Bone::Head, -3.0);
}
