// SPDX-License-Identifier: MIT OR Apache-2.0
//! The articulated mannequin: about 1.75 m of our own proportions, like a tailor's figure.
//!
//! Flesh is a table of rounded cones on bones. Groups blend inside; between groups there is a crease, so an
//! arm that rests on the chest does not melt into it. A cone that joins two parts belongs to both groups.

use super::implicit::{ConeShape, Field, Group, RoundedCone};
use super::mesh::Mesh;
use super::motion::Motion;
use super::polygonize::polygonize;
use super::skeleton::{self, BONES, Bone};
use super::worn::Worn;
use nalgebra::{Isometry3, Point3};
use rayon::prelude::{
    IndexedParallelIterator, IntoParallelRefIterator, IntoParallelRefMutIterator, ParallelIterator,
};

/// How tall it stands in the rest pose, m.
pub const HEIGHT_M: f64 = 1.75;

const TRUNK: u8 = 1;
const ARM_L: u8 = 2;
const ARM_R: u8 = 4;
const LEG_L: u8 = 8;
const LEG_R: u8 = 16;
const WORN: u8 = 32;
/// Groups by their bit, with the width over which they blend, m.
const GROUPS: [(u8, f64); 6] =
    [(TRUNK, 0.055), (ARM_L, 0.022), (ARM_R, 0.022), (LEG_L, 0.03), (LEG_R, 0.03), (WORN, 0.012)];

/// One piece of flesh in the rest pose: bone, groups, ball centres, radii, flattening along x, y, z.
type Flesh = (Bone, u8, [[f64; 3]; 2], [f64; 2], [f64; 3]);

const ROUND: [f64; 3] = [1.0, 1.0, 1.0];

/// Parts of the body on its midline.
const MIDDLE: [Flesh; 9] = [
    (Bone::Pelvis, TRUNK, [[-0.01, 0.0, 0.91], [-0.012, 0.0, 1.0]], [0.166, 0.152], [0.66, 1.0, 0.7]),
    (Bone::Spine, TRUNK, [[-0.012, 0.0, 1.0], [-0.008, 0.0, 1.12]], [0.148, 0.13], [0.7, 1.0, 0.6]),
    (Bone::Chest, TRUNK, [[-0.008, 0.0, 1.14], [-0.012, 0.0, 1.3]], [0.13, 0.156], [0.68, 1.0, 0.6]),
    (Bone::Chest, TRUNK, [[-0.012, 0.0, 1.3], [-0.025, 0.0, 1.38]], [0.156, 0.13], [0.66, 1.0, 0.5]),
    (Bone::Chest, TRUNK, [[-0.035, 0.0, 1.43], [-0.015, 0.0, 1.5]], [0.062, 0.056], ROUND),
    (Bone::Neck, TRUNK, [[-0.015, 0.0, 1.5], [0.0, 0.0, 1.57]], [0.056, 0.054], ROUND),
    (Bone::Head, TRUNK, [[-0.005, 0.0, 1.65], [0.035, 0.0, 1.575]], [0.097, 0.056], [1.0, 0.8, 1.0]),
    (Bone::Head, TRUNK, [[0.083, 0.0, 1.64], [0.1, 0.0, 1.612]], [0.012, 0.017], [1.0, 0.8, 1.0]),
    (Bone::Spine, TRUNK, [[0.045, 0.0, 1.0], [0.045, 0.0, 1.09]], [0.06, 0.05], ROUND),
];

/// Flesh of the left side; the right side mirrors it.
const SIDE: [Flesh; 24] = [
    // Trunk: shoulder line, shoulder blade, breast, flank of the hip, buttock.
    (Bone::Chest, TRUNK, [[-0.03, 0.035, 1.455], [-0.018, 0.15, 1.415]], [0.045, 0.05], ROUND),
    (Bone::Chest, TRUNK, [[-0.065, 0.075, 1.35], [-0.055, 0.07, 1.25]], [0.055, 0.045], ROUND),
    (Bone::Chest, TRUNK, [[0.048, 0.078, 1.3], [0.035, 0.11, 1.35]], [0.058, 0.045], ROUND),
    (Bone::Pelvis, TRUNK, [[0.0, 0.11, 0.9], [0.0, 0.1, 0.97]], [0.066, 0.05], ROUND),
    (Bone::Pelvis, TRUNK, [[-0.058, 0.072, 0.9], [-0.05, 0.08, 0.86]], [0.076, 0.07], ROUND),
    // Arm.
    (Bone::UpperArmL, TRUNK | ARM_L, [[-0.015, 0.178, 1.4], [-0.016, 0.184, 1.33]], [0.06, 0.053], ROUND),
    (Bone::UpperArmL, TRUNK | ARM_L, [[-0.016, 0.184, 1.34], [-0.02, 0.195, 1.115]], [0.052, 0.041], ROUND),
    (Bone::UpperArmL, ARM_L, [[0.002, 0.188, 1.28], [0.0, 0.19, 1.2]], [0.036, 0.034], ROUND),
    (Bone::ForearmL, ARM_L, [[-0.02, 0.195, 1.115], [-0.012, 0.199, 1.04]], [0.041, 0.043], ROUND),
    (Bone::ForearmL, ARM_L, [[-0.012, 0.199, 1.04], [-0.005, 0.2, 0.87]], [0.043, 0.027], ROUND),
    // Hand: palm, two pairs of fingers, thumb.
    (Bone::HandL, ARM_L, [[-0.005, 0.2, 0.865], [0.0, 0.2, 0.79]], [0.03, 0.041], [1.0, 0.5, 1.0]),
    (Bone::HandL, ARM_L, [[0.017, 0.2, 0.775], [0.018, 0.197, 0.7]], [0.018, 0.014], [1.0, 0.62, 1.0]),
    (Bone::HandL, ARM_L, [[-0.02, 0.2, 0.775], [-0.022, 0.197, 0.712]], [0.018, 0.014], [1.0, 0.62, 1.0]),
    (Bone::HandL, ARM_L, [[0.025, 0.196, 0.835], [0.055, 0.188, 0.775]], [0.016, 0.011], ROUND),
    // Leg.
    (Bone::ThighL, TRUNK | LEG_L, [[0.0, 0.095, 0.88], [0.004, 0.095, 0.68]], [0.086, 0.073], ROUND),
    (Bone::ThighL, TRUNK | LEG_L, [[0.004, 0.095, 0.68], [0.005, 0.095, 0.49]], [0.073, 0.054], ROUND),
    (Bone::ThighL, LEG_L, [[0.03, 0.1, 0.72], [0.024, 0.097, 0.56]], [0.055, 0.042], ROUND),
    (Bone::ShankL, LEG_L, [[0.005, 0.095, 0.49], [-0.005, 0.098, 0.38]], [0.053, 0.052], ROUND),
    (Bone::ShankL, LEG_L, [[-0.025, 0.098, 0.4], [-0.024, 0.099, 0.3]], [0.046, 0.042], ROUND),
    (Bone::ShankL, LEG_L, [[-0.005, 0.098, 0.38], [-0.02, 0.1, 0.1]], [0.051, 0.034], ROUND),
    // Foot: heel to ball, ball to toes, instep.
    (Bone::FootL, LEG_L, [[-0.05, 0.1, 0.037], [0.11, 0.106, 0.032]], [0.037, 0.04], [1.0, 1.0, 0.8]),
    (Bone::FootL, LEG_L, [[0.11, 0.108, 0.03], [0.165, 0.104, 0.02]], [0.04, 0.026], [1.0, 1.0, 0.72]),
    (Bone::FootL, LEG_L, [[-0.02, 0.1, 0.085], [0.07, 0.102, 0.045]], [0.036, 0.03], ROUND),
    (Bone::Chest, TRUNK, [[-0.02, 0.105, 1.34], [-0.02, 0.09, 1.22]], [0.07, 0.05], ROUND),
];

/// The mannequin in one posture: an exact surface that can be evaluated anywhere.
pub struct Mannequin {
    cones: Vec<RoundedCone>,
    /// Bone and rest shape of every cone.
    rest: Vec<(Bone, ConeShape)>,
    world_from_rest: [Isometry3<f64>; BONES],
    groups: Vec<Group>,
}

impl Mannequin {
    /// At `cycles` repetitions of `motion`, its lowest point on the floor at `position_m`, facing
    /// `heading_rad` from world +x towards +y.
    pub fn new(motion: Motion, cycles: f64, position_m: [f64; 2], heading_rad: f64) -> Self {
        Self::with(Worn::Nothing, motion, cycles, position_m, heading_rad)
    }

    /// The same with something beside the body.
    pub fn with(worn: Worn, motion: Motion, cycles: f64, position_m: [f64; 2], heading_rad: f64) -> Self {
        let mut flesh = all_flesh();
        flesh.extend(worn.parts().into_iter().map(|(bone, shape)| (bone, WORN, shape)));
        let groups = group_lists(&flesh);
        let posed = motion.posture(cycles).body_from_rest();
        let lowest = flesh.iter().map(|(bone, _, shape)| lowest_point(shape, &posed[*bone as usize]).z);
        let lift = -lowest.fold(f64::INFINITY, f64::min);
        // Blended flesh bulges below the balls that it is made of.
        let standing = Self::on_bones(&flesh, &groups, skeleton::place(&posed, lift, 0.0, [0.0; 2]));
        let lift = lift - standing.lowest();
        Self::on_bones(&flesh, &groups, skeleton::place(&posed, lift, heading_rad, position_m))
    }

    fn on_bones(
        flesh: &[(Bone, u8, ConeShape)],
        groups: &[Group],
        world_from_rest: [Isometry3<f64>; BONES],
    ) -> Self {
        let cone = |(bone, _, shape): &(Bone, u8, ConeShape)| {
            RoundedCone::new(shape, &world_from_rest[*bone as usize])
        };
        Self {
            cones: flesh.iter().map(cone).collect(),
            rest: flesh.iter().map(|(bone, _, shape)| (*bone, *shape)).collect(),
            world_from_rest,
            groups: groups.to_vec(),
        }
    }

    /// Height of the lowest skin, m, for a body within a few centimetres of the floor: from below, along
    /// verticals through the lowest points of the cones near the floor.
    fn lowest(&self) -> f64 {
        const START: f64 = -0.04;
        let feet =
            self.rest.iter().map(|(bone, shape)| lowest_point(shape, &self.world_from_rest[*bone as usize]));
        let heights = feet.filter(|foot| foot.z < 0.03).map(|foot| {
            let mut z = START;
            for _ in 0..200 {
                let gap = self.field(&Point3::new(foot.x, foot.y, z));
                if gap < 1e-7 {
                    break;
                }
                z += gap;
            }
            z
        });
        heights.fold(f64::INFINITY, f64::min)
    }

    /// The implicit field at a world point, m: negative inside, at most the distance to the skin. Cross
    /// sections (girths) are its zero lines in a plane.
    pub fn field(&self, p: &Point3<f64>) -> f64 {
        Field { cones: &self.cones }.value(&self.groups, p)
    }

    /// The skin as a mesh of about `cell_m` resolution, textured by `texture_share`.
    pub fn mesh(&self, cell_m: f64, texture_share: f64) -> Mesh {
        let mut mesh = polygonize(Field { cones: &self.cones }, &self.groups, cell_m);
        if texture_share > 0.0 {
            let positions = &mesh.positions;
            mesh.albedo.par_iter_mut().zip(positions.par_iter()).with_min_len(512).for_each(|(albedo, p)| {
                let p = Point3::from(p.map(f64::from));
                *albedo = (1.0 + texture_share * self.texture(&p)) as f32;
            });
        }
        mesh
    }

    /// A slowly varying number, about -1 to 1, that is painted on the skin and moves with it.
    fn texture(&self, p: &Point3<f64>) -> f64 {
        // Each bone sees the point in its own rest pose; near joints the bones' views are mixed.
        let mut distances = [f64::INFINITY; BONES];
        for (cone, (bone, _)) in self.cones.iter().zip(&self.rest) {
            let (centre, reach) = cone.bound();
            let best = &mut distances[*bone as usize];
            if (p - centre).norm() - reach < best.min(0.03) {
                *best = best.min(cone.distance(p));
            }
        }
        let (mut sum, mut weights) = (0.0, 1e-12);
        for (bone, &distance) in distances.iter().enumerate() {
            let weight = (1.0 - distance / 0.03).clamp(0.0, 2.0).powi(2);
            if weight > 0.0 {
                let rest = self.world_from_rest[bone].inverse_transform_point(p);
                sum += weight * waves(&rest);
                weights += weight;
            }
        }
        sum / weights
    }
}

fn waves(p: &Point3<f64>) -> f64 {
    let wave = |x: f64, y: f64, z: f64, phase: f64| (x * p.x + y * p.y + z * p.z + phase).sin();
    0.4 * wave(23.0, 11.0, 17.0, 0.3)
        + 0.35 * wave(-13.0, 29.0, 7.0, 1.9)
        + 0.25 * wave(5.0, -17.0, 37.0, 4.1)
}

fn all_flesh() -> Vec<(Bone, u8, ConeShape)> {
    let shape = |ends, radii, flatten| ConeShape { ends, radii, flatten };
    let middle =
        MIDDLE.iter().map(|&(bone, groups, ends, radii, flat)| (bone, groups, shape(ends, radii, flat)));
    let left = SIDE.iter().map(|&(bone, groups, ends, radii, flat)| (bone, groups, shape(ends, radii, flat)));
    let right = SIDE.iter().map(|&(bone, groups, ends, radii, flat)| {
        let ends = ends.map(|[x, y, z]| [x, -y, z]);
        (right_bone(bone), right_groups(groups), shape(ends, radii, flat))
    });
    middle.chain(left).chain(right).collect()
}

fn right_bone(bone: Bone) -> Bone {
    match bone {
        Bone::UpperArmL => Bone::UpperArmR,
        Bone::ForearmL => Bone::ForearmR,
        Bone::HandL => Bone::HandR,
        Bone::ThighL => Bone::ThighR,
        Bone::ShankL => Bone::ShankR,
        Bone::FootL => Bone::FootR,
        middle => middle,
    }
}

fn right_groups(groups: u8) -> u8 {
    let arm = if groups & ARM_L != 0 { ARM_R } else { 0 };
    let leg = if groups & LEG_L != 0 { LEG_R } else { 0 };
    groups & TRUNK | arm | leg
}

fn group_lists(flesh: &[(Bone, u8, ConeShape)]) -> Vec<Group> {
    let members = |bit: u8| {
        let of_group = flesh.iter().enumerate().filter(move |(_, (_, groups, _))| groups & bit != 0);
        of_group.map(|(number, _)| number as u32).collect()
    };
    let groups = GROUPS.iter().map(|&(bit, blend)| Group { blend_m: blend, cones: members(bit) });
    groups.filter(|group: &Group| !group.cones.is_empty()).collect()
}

/// Lowest point of a flattened cone: that of its two flattened balls (the cone is their convex hull).
fn lowest_point(shape: &ConeShape, pose: &Isometry3<f64>) -> Point3<f64> {
    let flatten = nalgebra::Vector3::from(shape.flatten);
    let down = -(pose.rotation.inverse() * nalgebra::Vector3::z());
    let scaled = down.component_mul(&flatten);
    // The point of the ellipsoid furthest along `down`.
    let reach = scaled.component_mul(&flatten) / scaled.norm();
    let point = |end: usize| pose * (Point3::from(shape.ends[end]) + reach * shape.radii[end]);
    let (a, b) = (point(0), point(1));
    if a.z < b.z { a } else { b }
}

#[cfg(test)]
mod tests {
    use super::Mannequin;
    use crate::scene::motion::Motion;
    use crate::scene::worn::Worn;

    #[test]
    fn it_is_a_closed_body_of_human_size_in_every_motion() {
        for (name, motion) in Motion::NAMES {
            for cycles in [0.0, 0.3, 0.75] {
                let mesh = Mannequin::new(motion, cycles, [0.0, 0.0], 0.0).mesh(0.012, 0.03);
                let (low, high) = mesh.bounds().expect("a body");
                assert_eq!(mesh.open_edges(), 0, "{name} at {cycles}");
                assert!(low[2].abs() < 0.001, "{name} at {cycles}: lowest point {}", low[2]);
                // Whoever bends is smaller.
                let smallest = match motion {
                    Motion::Squat => 1.0,
                    Motion::Bend => 1.3,
                    _ => 1.68,
                };
                assert!((smallest..1.80).contains(&high[2]), "{name} at {cycles}: height {}", high[2]);
                let litres = 1000.0 * mesh.volume();
                assert!((50.0..90.0).contains(&litres), "{name} at {cycles}: {litres} l");
                assert!(low[0] > -0.75 && low[1] > -0.95 && high[0] < 0.75 && high[1] < 0.95, "{name}");
            }
        }
    }

    #[test]
    fn what_it_wears_is_closed_too_and_stands_off_the_body() {
        let bare = Mannequin::new(Motion::ArmsCrossed, 0.4, [0.0; 2], 0.0).mesh(0.008, 0.0);
        for worn in [Worn::Rod, Worn::Skirt] {
            let mesh = Mannequin::with(worn, Motion::ArmsCrossed, 0.4, [0.0; 2], 0.0).mesh(0.008, 0.0);
            assert_eq!(mesh.open_edges(), 0, "{worn:?}");
            let litres = 1000.0 * (mesh.volume() - bare.volume());
            assert!(
                if worn == Worn::Rod { (0.5..1.2).contains(&litres) } else { litres > 5.0 },
                "{worn:?}: {litres} l"
            );
        }
    }

    #[test]
    fn vertices_lie_on_the_exact_surface() {
        let body = Mannequin::new(Motion::ArmRaise, 0.4, [0.1, -0.05], 0.3);
        let mesh = body.mesh(0.012, 0.0);
        let off = |p: &[f32; 3]| body.field(&nalgebra::Point3::from(p.map(f64::from))).abs();
        let wrong = mesh.positions.iter().filter(|p| off(p) > 1e-5).count();
        // Creases between groups have no single nearest point.
        assert!(wrong * 500 < mesh.positions.len(), "{wrong} of {}", mesh.positions.len());
    }

    #[test]
    fn neighbouring_instants_move_little() {
        let at = |cycles| Mannequin::new(Motion::ArmRaise, cycles, [0.0; 2], 0.0);
        let (now, next) = (at(0.25), at(0.25 + 1.0 / 240.0));
        let mesh = now.mesh(0.02, 0.0);
        let moved =
            mesh.positions.iter().map(|p| next.field(&nalgebra::Point3::from(p.map(f64::from))).abs());
        let most = moved.fold(0.0, f64::max);
        assert!((0.001..0.02).contains(&most), "{most} m between two instants at 120 Hz");
    }
}
