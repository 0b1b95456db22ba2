// SPDX-License-Identifier: MIT OR Apache-2.0
//! Analytic solids: sphere, upright cylinder, rectangle and the calibration board. Exact tests for everything.

use super::mesh::Mesh;
use fourdbody::config::Board;
use nalgebra::{Isometry3, Point3, Vector3};
use std::f64::consts::TAU;

/// A line of sight: unit direction, distances in metres.
#[derive(Debug, Clone, Copy)]
pub struct Sight {
    /// Where it starts, world, m.
    pub origin: Point3<f64>,
    pub direction: Vector3<f64>,
}

impl Sight {
    /// The point at `distance` m.
    pub fn at(&self, distance: f64) -> Point3<f64> {
        self.origin + self.direction * distance
    }
}

/// Where a line of sight meets a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hit {
    /// Distance along the line of sight, m.
    pub distance: f64,
    /// Unit normal for shading, outward.
    pub normal: Vector3<f64>,
    /// Albedo relative to the subject's.
    pub albedo: f64,
}

/// A ball at rest in the volume.
#[derive(Debug, Clone, Copy)]
pub struct Sphere {
    /// Its centre in the world's frame, m.
    pub centre: Point3<f64>,
    /// In metres, as all lengths of scenes.
    pub radius: f64,
}

impl Sphere {
    /// First point beyond `from`, seen from outside.
    pub fn intersect(&self, sight: &Sight, from: f64, to: f64) -> Option<Hit> {
        let offset = sight.origin - self.centre;
        let half = offset.dot(&sight.direction);
        // From the point nearest to the centre, which loses less to rounding than |offset|^2 - r^2.
        let nearest = offset - sight.direction * half;
        let under = self.radius * self.radius - nearest.norm_squared();
        let distance = -half - under.max(0.0).sqrt();
        (under >= 0.0 && distance > from && distance < to).then(|| {
            let normal = (sight.at(distance) - self.centre) / self.radius;
            Hit { distance, normal, albedo: 1.0 }
        })
    }
}

/// An upright cylinder with flat ends.
#[derive(Debug, Clone, Copy)]
pub struct Cylinder {
    /// Centre of the lower end, world, m.
    pub foot: Point3<f64>,
    /// In metres, as all lengths of scenes.
    pub radius: f64,
    /// In metres, as all lengths of scenes.
    pub height: f64,
}

impl Cylinder {
    /// First point beyond `from`, seen from outside.
    pub fn intersect(&self, sight: &Sight, from: f64, to: f64) -> Option<Hit> {
        let (o, d) = (sight.origin - self.foot, sight.direction);
        let a = d.x * d.x + d.y * d.y;
        let half = o.x * d.x + o.y * d.y;
        let under = half * half - a * (o.x * o.x + o.y * o.y - self.radius * self.radius);
        let side = (-half - under.max(0.0).sqrt()) / a;
        let z = o.z + side * d.z;
        let range = from..to;
        if under >= 0.0 && (0.0..=self.height).contains(&z) && range.contains(&side) && side > from {
            let at = o + d * side;
            let normal = Vector3::new(at.x, at.y, 0.0) / self.radius;
            return Some(Hit { distance: side, normal, albedo: 1.0 });
        }
        let (end, normal) = if d.z < 0.0 { (self.height, Vector3::z()) } else { (0.0, -Vector3::z()) };
        let distance = (end - o.z) / d.z;
        let at = o + d * distance;
        let on_end = at.x * at.x + at.y * at.y <= self.radius * self.radius;
        (on_end && distance > from && distance < to).then_some(Hit { distance, normal, albedo: 1.0 })
    }
}

/// A flat rectangle, seen from both sides; with circles it is the calibration board. Its plane is z = 0 of its
/// own frame, its face looks along +z.
#[derive(Debug, Clone)]
pub struct Rectangle {
    /// Takes board coordinates to the world.
    pub world_from_board: Isometry3<f64>,
    /// Half of its size along its x and y, m.
    pub half_m: [f64; 2],
    /// Albedo of the other side, relative to that of the face.
    pub back: f64,
    /// Black circles, with the albedo of black relative to white.
    pub circles: Option<(Board, f64)>,
}

impl Rectangle {
    /// The calibration board of the rig, at this pose.
    pub fn board(board: &Board, black: f64, back: f64, world_from_board: Isometry3<f64>) -> Self {
        let half_m = [board.width_m / 2.0, board.height_m / 2.0];
        Self { world_from_board, half_m, back, circles: Some((board.clone(), black)) }
    }

    /// The nearest point on the line of sight between `from` and `to`, m.
    pub fn intersect(&self, sight: &Sight, from: f64, to: f64) -> Option<Hit> {
        let o = self.world_from_board.inverse_transform_point(&sight.origin);
        let d = self.world_from_board.inverse_transform_vector(&sight.direction);
        let distance = -o.z / d.z;
        let at = o + d * distance;
        let inside = at.x.abs() <= self.half_m[0] && at.y.abs() <= self.half_m[1];
        (inside && distance > from && distance < to).then(|| {
            let face = if d.z < 0.0 { Vector3::z() } else { -Vector3::z() };
            let albedo = if d.z < 0.0 { self.albedo(at.x, at.y) } else { self.back };
            Hit { distance, normal: self.world_from_board * face, albedo }
        })
    }

    /// Balls that together hold it: world centre and radius, m.
    pub fn balls(&self) -> Vec<(Point3<f64>, f64)> {
        const SIDE_M: f64 = 0.06;
        let counts = self.half_m.map(|half| (2.0 * half / SIDE_M).ceil().max(1.0) as usize);
        let steps = [0, 1].map(|axis| 2.0 * self.half_m[axis] / counts[axis] as f64);
        let radius = 0.5 * steps[0].hypot(steps[1]);
        let place = |axis: usize, i: usize| (i as f64 + 0.5) * steps[axis] - self.half_m[axis];
        let at = |i: usize, k: usize| self.world_from_board * Point3::new(place(0, i), place(1, k), 0.0);
        (0..counts[0])
            .flat_map(|i| (0..counts[1]).map(move |k| (i, k)))
            .map(|(i, k)| (at(i, k), radius))
            .collect()
    }

    /// Relative albedo of the face at board coordinates, m.
    fn albedo(&self, x: f64, y: f64) -> f64 {
        let Some((board, black)) = &self.circles else { return 1.0 };
        let nearest = |value: f64, count: usize| {
            let middle = (count as f64 - 1.0) / 2.0;
            let index = (value / board.pitch_m + middle).round().clamp(0.0, count as f64 - 1.0);
            (index as usize, (index - middle) * board.pitch_m)
        };
        let (column, cx) = nearest(x, board.columns);
        let (row, cy) = nearest(y, board.rows);
        let large = board.large.contains(&[column, row]);
        let radius = if large { board.large_radius_m } else { board.radius_m };
        if (x - cx).hypot(y - cy) <= radius { *black } else { 1.0 }
    }

    /// The surface as a mesh of two triangles.
    pub fn mesh(&self) -> Mesh {
        let [x, y] = self.half_m;
        let corners = [[-x, -y], [x, -y], [x, y], [-x, y]];
        let world = |[x, y]: [f64; 2]| self.world_from_board * Point3::new(x, y, 0.0);
        mesh_of(corners.map(|c| world(c).coords), vec![[0, 1, 2], [0, 2, 3]])
    }
}

impl Sphere {
    /// Within 2 micrometres of the ball for radii up to 0.3 m.
    pub fn mesh(&self) -> Mesh {
        let rings = 400;
        let point = |ring: usize, step: usize| {
            let (polar, azimuth) =
                (TAU / 2.0 * ring as f64 / rings as f64, TAU * step as f64 / (2 * rings) as f64);
            let (sin, cos) = polar.sin_cos();
            self.centre.coords + self.radius * Vector3::new(sin * azimuth.cos(), sin * azimuth.sin(), -cos)
        };
        grid_mesh(rings, 2 * rings, point)
    }
}

impl Cylinder {
    /// Within 2 micrometres of the cylinder for radii up to 0.3 m.
    pub fn mesh(&self) -> Mesh {
        let steps = 900;
        let point = |ring: usize, step: usize| {
            let azimuth = TAU * step as f64 / steps as f64;
            let (radius, z) = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)][ring];
            let radius = radius * self.radius;
            self.foot.coords + Vector3::new(radius * azimuth.cos(), radius * azimuth.sin(), z * self.height)
        };
        grid_mesh(3, steps, point)
    }
}

/// Rings of points closed around, from the lowest ring up; triangles that have no area are left out.
pub(super) fn grid_mesh(rings: usize, steps: usize, point: impl Fn(usize, usize) -> Vector3<f64>) -> Mesh {
    let points = (0..=rings).flat_map(|ring| (0..steps).map(move |step| (ring, step)));
    let number = |ring: usize, step: usize| (ring * steps + step % steps) as u32;
    let mut triangles = Vec::with_capacity(2 * rings * steps);
    for ring in 0..rings {
        for step in 0..steps {
            let [a, b, c, d] = [(0, 0), (0, 1), (1, 1), (1, 0)].map(|(r, s)| number(ring + r, step + s));
            if ring > 0 {
                triangles.push([a, b, c]);
            }
            if ring + 1 < rings {
                triangles.push([a, c, d]);
            }
        }
    }
    mesh_of(points.map(|(ring, step)| point(ring, step)), triangles)
}

fn mesh_of(points: impl IntoIterator<Item = Vector3<f64>>, triangles: Vec<[u32; 3]>) -> Mesh {
    let positions: Vec<[f32; 3]> = points.into_iter().map(|p| p.map(|x| x as f32).into()).collect();
    let albedo = vec![1.0; positions.len()];
    let mut mesh = Mesh { positions, albedo, triangles, normals: Vec::new() };
    mesh.compute_normals();
    mesh
}

#[cfg(test)]
mod tests {
    use super::{Cylinder, Rectangle, Sight, Sphere};
    use nalgebra::{Isometry3, Point3, Vector3};

    fn sight(origin: [f64; 3], target: [f64; 3]) -> Sight {
        let (origin, target) = (Point3::from(origin), Point3::from(target));
        Sight { origin, direction: (target - origin).normalize() }
    }

    #[test]
    fn solids_are_met_where_they_are() {
        let ball = Sphere { centre: Point3::new(0.0, 0.0, 1.0), radius: 0.15 };
        let hit = ball.intersect(&sight([2.0, 0.0, 1.0], [0.0, 0.0, 1.0]), 0.0, 9.0).expect("the ball");
        assert!((hit.distance - 1.85).abs() < 1e-12 && (hit.normal - Vector3::x()).norm() < 1e-12);
        assert!(ball.intersect(&sight([2.0, 0.0, 1.2], [0.0, 0.0, 1.2]), 0.0, 9.0).is_none());
        let tube = Cylinder { foot: Point3::origin(), radius: 0.2, height: 1.0 };
        let hit = tube.intersect(&sight([2.0, 0.0, 0.5], [0.0, 0.0, 0.5]), 0.0, 9.0).expect("the side");
        assert!((hit.distance - 1.8).abs() < 1e-12);
        let hit = tube.intersect(&sight([0.1, 0.0, 3.0], [0.1, 0.0, 0.0]), 0.0, 9.0).expect("the top");
        assert!((hit.distance - 2.0).abs() < 1e-12 && (hit.normal - Vector3::z()).norm() < 1e-12);
        let plate = Rectangle {
            world_from_board: Isometry3::identity(),
            half_m: [0.5, 0.5],
            back: 0.05,
            circles: None,
        };
        assert!(plate.intersect(&sight([0.4, 0.4, 1.0], [0.4, 0.4, 0.0]), 0.0, 9.0).is_some());
        assert!(plate.intersect(&sight([0.6, 0.4, 1.0], [0.6, 0.4, 0.0]), 0.0, 9.0).is_none());
        for corner in [[-0.5, -0.5], [0.5, -0.5], [0.013, 0.5], [0.27, -0.33]] {
            let point = Point3::new(corner[0], corner[1], 0.0);
            let held = plate.balls().iter().any(|(centre, radius)| (point - centre).norm() <= radius + 1e-12);
            assert!(held, "{corner:?}");
        }
    }

    #[test]
    fn their_meshes_turn_outwards() {
        let ball = Sphere { centre: Point3::new(0.0, 0.0, 1.0), radius: 0.15 };
        let exact = std::f64::consts::TAU * 2.0 / 3.0 * 0.15f64.powi(3);
        assert!((ball.mesh().volume() / exact - 1.0).abs() < 1e-3);
        let tube = Cylinder { foot: Point3::origin(), radius: 0.2, height: 1.0 };
        assert!((tube.mesh().volume() / (std::f64::consts::PI * 0.04) - 1.0).abs() < 1e-3);
    }
}
