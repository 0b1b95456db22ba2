// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the mannequin wears or holds: thin things before a body, and cloth that stands off it.

use super::implicit::ConeShape;
use super::skeleton::Bone;
use serde::Serialize;
use std::f64::consts::TAU;

/// One thing beside the body.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Worn {
    Nothing,
    /// A rod as thick as a broomstick, upright before the chest: what is behind it is seen to both of its sides.
    Rod,
    /// A skirt with pleats, from the waist to the knees.
    Skirt,
}

/// Pleats of the skirt. At the hem their middles are 63 mm apart, and each is 76 mm thick: they overlap.
const PLEATS: usize = 28;

impl Worn {
    /// The garments, with their names in scenario files.
    pub const NAMES: [(&'static str, Worn); 3] =
        [("nothing", Worn::Nothing), ("rod", Worn::Rod), ("skirt", Worn::Skirt)];

    /// Whether the subject wears nothing at all.
    pub fn is_nothing(&self) -> bool {
        *self == Worn::Nothing
    }

    /// Its parts in the rest pose, with the bone that carries each.
    pub fn parts(self) -> Vec<(Bone, ConeShape)> {
        let round = [1.0; 3];
        match self {
            Worn::Nothing => Vec::new(),
            Worn::Rod => {
                let ends = [[0.36, 0.06, 0.45], [0.34, 0.04, 1.7]];
                vec![(Bone::Pelvis, ConeShape { ends, radii: [0.014; 2], flatten: round })]
            }
            Worn::Skirt => {
                let pleat = |i: usize| {
                    let (sine, cosine) = (TAU * i as f64 / PLEATS as f64).sin_cos();
                    // Flatter than wide, as the waist is.
                    let around = |radius: f64, z: f64| [0.8 * radius * cosine - 0.01, radius * sine, z];
                    let ends = [around(0.14, 1.02), around(0.28, 0.52)];
                    (Bone::Pelvis, ConeShape { ends, radii: [0.02, 0.038], flatten: round })
                };
                (0..PLEATS).map(pleat).collect()
            }
        }
    }
}
