// SPDX-License-Identifier: MIT OR Apache-2.0
//! What stands in the light: solids and meshes, and the questions that a ray asks of them.

mod bvh;
pub mod implicit;
pub mod mannequin;
pub mod mesh;
pub mod mesh_file;
pub mod motion;
pub mod paint;
pub mod polygonize;
pub mod skeleton;
pub mod solids;
pub mod subject;
pub mod torso;
pub mod worn;

pub use bvh::{Bvh, FastRay, TriangleHit};
pub use mesh::Mesh;
pub use solids::{Cylinder, Hit, Rectangle, Sight, Sphere};

use nalgebra::{Point3, Vector3};

/// A mesh with its hierarchy.
#[derive(Debug, Clone)]
pub struct MeshSolid {
    pub mesh: Mesh,
    bvh: Bvh,
}

impl MeshSolid {
    /// Builds the bounding-volume hierarchy of a mesh.
    pub fn new(mesh: Mesh) -> Self {
        let bvh = Bvh::build(&mesh);
        Self { mesh, bvh }
    }

    fn intersect(&self, sight: &Sight, from: f64, to: f64) -> Option<Hit> {
        let hit = self.bvh.nearest(&fast(sight), from as f32, to as f32)?;
        let vertices = self.mesh.triangles[hit.triangle as usize];
        let [a, b, c] = vertices.map(|v| Vector3::from(self.mesh.positions[v as usize].map(f64::from)));
        let flat = (b - a).cross(&(c - a));
        // Single precision found the triangle; its plane gives the distance in double precision.
        let exact = flat.dot(&(a - sight.origin.coords)) / flat.dot(&sight.direction);
        let near = f64::from(hit.distance);
        let distance = if (exact - near).abs() < 1e-4 { exact } else { near };
        let [u, v] = hit.weights.map(f64::from);
        let mix = |[x, y, z]: [f64; 3]| x * (1.0 - u - v) + y * u + z * v;
        let normals = vertices.map(|v| Vector3::from(self.mesh.normals[v as usize].map(f64::from)));
        let mixed = normals[0] * (1.0 - u - v) + normals[1] * u + normals[2] * v;
        let normal = mixed.try_normalize(1e-9).unwrap_or_else(|| flat.normalize());
        let albedo = mix(vertices.map(|v| f64::from(self.mesh.albedo[v as usize])));
        Some(Hit { distance, normal, albedo })
    }

    fn blocks(&self, sight: &Sight, from: f64, to: f64) -> bool {
        self.bvh.any(&fast(sight), from as f32, to as f32)
    }
}

fn fast(sight: &Sight) -> FastRay {
    FastRay::new(sight.origin.coords.map(|x| x as f32).into(), sight.direction.map(|x| x as f32).into())
}

/// One thing in the scene.
#[derive(Debug, Clone)]
pub enum Solid {
    Mesh(MeshSolid),
    Sphere(Sphere),
    Cylinder(Cylinder),
    /// A plate or the calibration board.
    Rectangle(Rectangle),
}

impl Solid {
    fn intersect(&self, sight: &Sight, from: f64, to: f64) -> Option<Hit> {
        match self {
            Self::Mesh(mesh) => mesh.intersect(sight, from, to),
            Self::Sphere(sphere) => sphere.intersect(sight, from, to),
            Self::Cylinder(cylinder) => cylinder.intersect(sight, from, to),
            Self::Rectangle(rectangle) => rectangle.intersect(sight, from, to),
        }
    }

    fn blocks(&self, sight: &Sight, from: f64, to: f64) -> bool {
        match self {
            Self::Mesh(mesh) => mesh.blocks(sight, from, to),
            solid => solid.intersect(sight, from, to).is_some(),
        }
    }

    /// The surface of the solid as triangles.
    pub fn mesh(&self) -> Mesh {
        match self {
            Self::Mesh(mesh) => mesh.mesh.clone(),
            Self::Sphere(sphere) => sphere.mesh(),
            Self::Cylinder(cylinder) => cylinder.mesh(),
            Self::Rectangle(rectangle) => rectangle.mesh(),
        }
    }
}

/// Everything but the room, at one moment.
#[derive(Debug, Clone, Default)]
pub struct Scene {
    pub solids: Vec<Solid>,
}

impl Scene {
    /// Balls (world centre, radius, m) that together hold everything; `None` where a solid has no such list.
    pub fn balls(&self) -> Option<Vec<(Point3<f64>, f64)>> {
        let mut balls = Vec::new();
        for solid in &self.solids {
            match solid {
                Solid::Mesh(mesh) => {
                    let around = |(centre, radius): ([f32; 3], f32)| {
                        (Point3::from(centre.map(f64::from)), f64::from(radius))
                    };
                    balls.extend(mesh.bvh.balls().map(around));
                }
                Solid::Rectangle(rectangle) => balls.extend(rectangle.balls()),
                Solid::Sphere(sphere) => balls.push((sphere.centre, sphere.radius)),
                Solid::Cylinder(_) => return None,
            }
        }
        Some(balls)
    }
}

/// Shadow rays begin this far from the surface, m: beyond rounding and the flatness of triangles.
const LIFT_M: f64 = 2e-4;

impl Scene {
    /// A scene of one solid.
    pub fn of(solid: Solid) -> Self {
        Self { solids: vec![solid] }
    }

    /// The nearest surface along the line of sight.
    pub fn intersect(&self, sight: &Sight) -> Option<Hit> {
        self.solids.iter().fold(None, |best: Option<Hit>, solid| {
            let limit = best.map_or(f64::from(f32::MAX), |hit| hit.distance);
            solid.intersect(sight, 0.0, limit).or(best)
        })
    }

    /// Whether something stands between the light at `source` and a surface point with this outward normal.
    pub fn shadowed(&self, point: &Point3<f64>, normal: &Vector3<f64>, source: &Point3<f64>) -> bool {
        let start = point + normal * LIFT_M;
        let way = source - start;
        let distance = way.norm();
        let sight = Sight { origin: start, direction: way / distance };
        self.solids.iter().any(|solid| solid.blocks(&sight, 0.0, distance))
    }
}

#[cfg(test)]
mod tests {
    use super::{Hit, MeshSolid, Scene, Sight, Solid, Sphere};
    use crate::random::Stream;
    use nalgebra::Point3;

    #[test]
    fn a_ball_of_triangles_is_nearly_the_ball() {
        let ball = Sphere { centre: Point3::new(0.1, 0.0, 1.0), radius: 0.15 };
        let exact = Scene::of(Solid::Sphere(ball));
        let mesh = Scene::of(Solid::Mesh(MeshSolid::new(ball.mesh())));
        let mut random = Stream::new(1, "rays");
        for _ in 0..2000 {
            let target =
                Point3::new(0.1, 0.14 * (random.uniform() - 0.5), 1.0 + 0.14 * (random.uniform() - 0.5));
            let origin = Point3::new(2.0, random.uniform(), random.uniform());
            let sight = Sight { origin, direction: (target - origin).normalize() };
            let (a, b): (Hit, Hit) =
                (exact.intersect(&sight).expect("ball"), mesh.intersect(&sight).expect("mesh"));
            assert!((a.distance - b.distance).abs() < 5e-6, "{} {}", a.distance, b.distance);
            assert!((a.normal - b.normal).norm() < 1e-2);
            let source = Point3::new(2.4, 0.0, 1.0);
            let (p, q) = (sight.at(a.distance), sight.at(b.distance));
            let grazing = (source - p).normalize().dot(&a.normal).abs() < 0.05;
            assert!(
                grazing || exact.shadowed(&p, &a.normal, &source) == mesh.shadowed(&q, &b.normal, &source)
            );
        }
    }
}
