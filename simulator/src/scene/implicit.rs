// SPDX-License-Identifier: MIT OR Apache-2.0
//! Implicit flesh: rounded cones, possibly flattened, blended smoothly within groups.
//!
//! Every field value is at most the true distance to the surface (its gradient is never longer than 1), which
//! is what culling and the search for the surface rely on. Negative inside. Lengths are metres.

use nalgebra::{Matrix3, Point3, Rotation3, Vector3};

/// Two balls of different radius and the cone that touches both, flattened along the world axes of its rest
/// pose and carried by a rigid bone.
#[derive(Debug, Clone)]
pub struct RoundedCone {
    /// World to the cone's own frame: axis along z, first ball at the origin, flattening undone.
    linear: Matrix3<f64>,
    offset: Vector3<f64>,
    length: f64,
    radius: [f64; 2],
    /// Sine and cosine of the cone's half angle.
    slope: [f64; 2],
    /// Smallest flattening factor: undoing the flattening stretches distances by at most its inverse.
    scale: f64,
    /// A ball around everything, world.
    bound: (Point3<f64>, f64),
}

/// What a cone is made of, in its rest pose.
#[derive(Debug, Clone, Copy)]
pub struct ConeShape {
    /// The centres of the two balls, m.
    pub ends: [[f64; 3]; 2],
    /// Ball radii before flattening, m.
    pub radii: [f64; 2],
    /// Factors (0 to 1] by which the shape is flattened about the first centre along x, y, z.
    pub flatten: [f64; 3],
}

impl RoundedCone {
    /// The shape, moved by `world_from_rest`.
    pub fn new(shape: &ConeShape, world_from_rest: &nalgebra::Isometry3<f64>) -> Self {
        let undo = Matrix3::from_diagonal(&Vector3::from(shape.flatten.map(|s| 1.0 / s)));
        let first = Vector3::from(shape.ends[0]);
        let axis = undo * (Vector3::from(shape.ends[1]) - first);
        let length = axis.norm();
        let align = Rotation3::rotation_between(&axis, &Vector3::z()).unwrap_or_else(|| {
            // Zero length, or the axis points straight down.
            Rotation3::from_axis_angle(
                &Vector3::x_axis(),
                if length > 0.0 { std::f64::consts::PI } else { 0.0 },
            )
        });
        let back = world_from_rest.inverse();
        let linear = align.matrix() * undo * back.rotation.to_rotation_matrix().matrix();
        let offset = align.matrix() * undo * (back.translation.vector - first);
        // When one ball holds the other, the cone is that ball.
        let sine =
            if length > 1e-9 { ((shape.radii[0] - shape.radii[1]) / length).clamp(-1.0, 1.0) } else { 0.0 };
        let scale = shape.flatten.into_iter().fold(1.0, f64::min);
        let centres = shape.ends.map(|end| world_from_rest * Point3::from(end));
        let middle = nalgebra::center(&centres[0], &centres[1]);
        let reach = (centres[1] - centres[0]).norm() / 2.0 + shape.radii[0].max(shape.radii[1]);
        Self {
            linear,
            offset,
            length,
            radius: shape.radii,
            slope: [sine, (1.0 - sine * sine).sqrt()],
            scale,
            bound: (middle, reach),
        }
    }

    /// Centre and radius of a ball around it.
    pub fn bound(&self) -> (Point3<f64>, f64) {
        self.bound
    }

    /// At most the distance from `p`, negative inside.
    #[inline]
    pub fn distance(&self, p: &Point3<f64>) -> f64 {
        let q = self.linear * p.coords + self.offset;
        let side = (q.x * q.x + q.y * q.y).sqrt();
        let [sine, cosine] = self.slope;
        let along = q.z * cosine - side * sine;
        let distance = if along <= 0.0 {
            (side * side + q.z * q.z).sqrt() - self.radius[0]
        } else if along >= cosine * self.length {
            let beyond = q.z - self.length;
            (side * side + beyond * beyond).sqrt() - self.radius[1]
        } else {
            side * cosine + q.z * sine - self.radius[0]
        };
        distance * self.scale
    }

    /// The distance and its gradient.
    pub fn distance_and_gradient(&self, p: &Point3<f64>) -> (f64, Vector3<f64>) {
        let q = self.linear * p.coords + self.offset;
        let side = (q.x * q.x + q.y * q.y).sqrt();
        let [sine, cosine] = self.slope;
        let along = q.z * cosine - side * sine;
        let ball = |from: Vector3<f64>, radius: f64| {
            let length = from.norm();
            (length - radius, if length > 0.0 { from / length } else { Vector3::z() })
        };
        let (distance, gradient) = if along <= 0.0 {
            ball(q, self.radius[0])
        } else if along >= cosine * self.length {
            ball(q - Vector3::new(0.0, 0.0, self.length), self.radius[1])
        } else {
            let outward =
                if side > 0.0 { Vector3::new(q.x / side, q.y / side, 0.0) } else { Vector3::zeros() };
            (side * cosine + q.z * sine - self.radius[0], outward * cosine + Vector3::new(0.0, 0.0, sine))
        };
        (distance * self.scale, self.linear.tr_mul(&gradient) * self.scale)
    }
}

/// Cones that blend with each other over `blend_m`.
#[derive(Debug, Clone)]
pub struct Group {
    /// Two cones whose distances differ by less than this melt together.
    pub blend_m: f64,
    /// Numbers of its cones; a cone may belong to several groups.
    pub cones: Vec<u32>,
}

/// A union of groups; between groups there is a crease, as where a forearm rests on a chest.
#[derive(Debug, Clone, Copy)]
pub struct Field<'a> {
    pub cones: &'a [RoundedCone],
}

impl Field<'_> {
    /// The groups' field at `p`: infinite when there are none.
    pub fn value(&self, groups: &[Group], p: &Point3<f64>) -> f64 {
        let group_value = |group: &Group| {
            let distances = group.cones.iter().map(|&cone| self.cones[cone as usize].distance(p));
            distances.fold(f64::INFINITY, |a, b| blended(a, b, group.blend_m).0)
        };
        groups.iter().map(group_value).fold(f64::INFINITY, f64::min)
    }

    /// Value and gradient at `p`; a zero gradient when there is nothing.
    pub fn value_and_gradient(&self, groups: &[Group], p: &Point3<f64>) -> (f64, Vector3<f64>) {
        let mut best = (f64::INFINITY, Vector3::zeros());
        for group in groups {
            let mut sum = (f64::INFINITY, Vector3::zeros());
            for &cone in &group.cones {
                let (distance, gradient) = self.cones[cone as usize].distance_and_gradient(p);
                let (value, share) = blended(sum.0, distance, group.blend_m);
                sum = (value, sum.1 * (1.0 - share) + gradient * share);
            }
            if sum.0 < best.0 {
                best = sum;
            }
        }
        best
    }

    /// The groups without the cones that cannot matter where the field is below `radius` inside the ball
    /// around `centre`. What remains gives bit-identical values there, because a cone that is more than the
    /// blend away from a sum leaves the sum exactly as it is.
    pub fn cull(&self, groups: &[Group], centre: &Point3<f64>, radius: f64) -> Vec<Group> {
        let kept = groups.iter().map(|group| {
            let reach = 2.0 * radius + 2.0 * group.blend_m;
            let near = |&&cone: &&u32| self.cones[cone as usize].distance(centre) <= reach;
            Group { blend_m: group.blend_m, cones: group.cones.iter().filter(near).copied().collect() }
        });
        kept.filter(|group| !group.cones.is_empty()).collect()
    }
}

/// Cubic smooth minimum with compact support: exactly the smaller one where they differ by `blend` or more.
/// Also the share of `b` in the gradient.
#[inline]
fn blended(a: f64, b: f64, blend: f64) -> (f64, f64) {
    let h = 1.0 - (a - b).abs() / blend;
    if !(h > 0.0) {
        return if b < a { (b, 1.0) } else { (a, 0.0) };
    }
    let lower = a.min(b) - h * h * h * blend / 6.0;
    let minor = 0.5 * h * h;
    (lower, if b < a { 1.0 - minor } else { minor })
}

#[cfg(test)]
mod tests {
    use super::{ConeShape, Field, Group, RoundedCone};
    use nalgebra::{Isometry3, Point3, Vector3};
    use proptest::prelude::{ProptestConfig, prop_assert, proptest};

    fn cones() -> Vec<RoundedCone> {
        let shapes = [
            ConeShape { ends: [[0.0; 3], [0.0, 0.0, 0.3]], radii: [0.1, 0.05], flatten: [0.7, 1.0, 1.0] },
            ConeShape { ends: [[0.0, 0.1, 0.2], [0.0, 0.3, 0.2]], radii: [0.04, 0.06], flatten: [1.0; 3] },
            ConeShape { ends: [[0.1, 0.0, 0.0]; 2], radii: [0.05; 2], flatten: [1.0; 3] },
        ];
        let pose = Isometry3::new(Vector3::new(0.1, -0.2, 0.3), Vector3::new(0.4, 0.5, -0.6));
        shapes.iter().map(|shape| RoundedCone::new(shape, &pose)).collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(300))]
        #[test]
        fn the_field_never_overstates_distances_and_its_gradient_is_its_slope(
            p in [-0.5..0.8f64, -0.6..0.6f64, -0.3..1.0f64], step in [-1.0..1.0f64, -1.0..1.0f64, -1.0..1.0f64],
        ) {
            let cones = cones();
            let field = Field { cones: &cones };
            let groups = [Group { blend_m: 0.05, cones: vec![0, 1] }, Group { blend_m: 0.02, cones: vec![1, 2] }];
            let p = Point3::from(p);
            let step = Vector3::from(step);
            let (value, gradient) = field.value_and_gradient(&groups, &p);
            prop_assert!((field.value(&groups, &p) - value).abs() < 1e-15);
            prop_assert!(gradient.norm() < 1.0 + 1e-9);
            let moved = field.value(&groups, &(p + step));
            prop_assert!((moved - value).abs() <= step.norm() + 1e-12);
            let small = 1e-6 * step;
            let change = field.value(&groups, &(p + small)) - field.value(&groups, &(p - small));
            // At a crease between groups the slope is not defined.
            let crease = (field.value(&groups[..1], &p) - field.value(&groups[1..], &p)).abs() < 1e-5;
            prop_assert!(crease || (change / 2.0 - gradient.dot(&small)).abs() < 1e-9);
        }

        #[test]
        fn culling_changes_nothing_near_the_surface(
            centre in [-0.3..0.6f64, -0.4..0.4f64, 0.0..0.8f64], offset in [-1.0..1.0f64, -1.0..1.0f64, -1.0..1.0f64],
        ) {
            let cones = cones();
            let field = Field { cones: &cones };
            let groups = [Group { blend_m: 0.05, cones: vec![0, 1, 2] }, Group { blend_m: 0.02, cones: vec![1, 2] }];
            let (centre, radius) = (Point3::from(centre), 0.05);
            let p = centre + Vector3::from(offset).cap_magnitude(1.0) * radius;
            let whole = field.value(&groups, &p);
            let culled = field.value(&field.cull(&groups, &centre, radius), &p);
            prop_assert!(whole == culled || (whole > radius && culled > radius), "{whole} {culled}");
        }
    }
}
