// SPDX-License-Identifier: MIT OR Apache-2.0
//! From a pixel and its absolute phase to a world point.
//!
//! The phase names a column of the projector's panel; the light of that column fills a surface in space
//! (a plane, bent by the projector's distortion). The point is where the pixel's ray meets it. With the ray
//! `z (x, y, 1)` in the camera, `a = R (x, y, 1)` and `X = z a + t` in the projector, a column whose
//! undistorted coordinate is `p = X_0 / X_2` gives `z = (t_0 - p t_2) / (p a_2 - a_0)`. The distortion of the
//! column depends on where along it the point lies, so `p` is iterated to a fixed point; each step gains
//! about two digits.

use super::camera_projector::CameraProjector;
use nalgebra::{Isometry3, Matrix3, Point3, Vector3};

/// Pixels between the nodes of the ray table. Bilinear interpolation is then exact to about 1e-6 of the
/// distance.
const GRID_PX: usize = 8;

/// The fixed point is reached when the column moves by less than this, normalized.
const CONVERGED: f64 = 1e-10;

/// Triangulates the pixels of one camera exactly, one at a time: for calibration and checks. Clouds are made with
/// [`super::ray_table::RayTable`], which is faster and agrees within 0.01 mm.
#[derive(Debug)]
pub struct Triangulator {
    pair: CameraProjector,
    rotation: Matrix3<f64>,
    translation: Vector3<f64>,
    world_from_camera: Isometry3<f64>,
    /// Undistorted (x, y) at the grid's nodes, row-major; NaN where the lens cannot be inverted.
    rays: Vec<[f64; 2]>,
    columns: usize,
}

impl Triangulator {
    /// Tabulates the undistorted rays of the pair's camera.
    pub fn new(pair: CameraProjector) -> Self {
        let world_from_camera = *pair.camera.world_from_device.isometry();
        let projector_from_camera = pair.projector.world_from_device.isometry().inverse() * world_from_camera;
        let columns = pair.camera.width / GRID_PX + 2;
        let rows = pair.camera.height / GRID_PX + 2;
        let lens = pair.camera.lens;
        let node = |i: usize| {
            let (u, v) = ((i % columns * GRID_PX) as f64, (i / columns * GRID_PX) as f64);
            lens.undistort(u, v).unwrap_or([f64::NAN; 2])
        };
        Self {
            rotation: projector_from_camera.rotation.to_rotation_matrix().into_inner(),
            translation: projector_from_camera.translation.vector,
            world_from_camera,
            rays: (0..columns * rows).map(node).collect(),
            columns,
            pair,
        }
    }

    /// The pair it triangulates for.
    pub fn pair(&self) -> &CameraProjector {
        &self.pair
    }

    /// The point that pixel (u, v) sees at absolute phase `phase`: in the camera's and the world's axes, m.
    /// `None` where ray and column do not meet in front of both devices, or the column is not on the panel.
    pub fn point(&self, u: usize, v: usize, phase: f64) -> Option<(Point3<f64>, Point3<f64>)> {
        let column = self.pair.pattern.column(phase);
        if !(-0.5..self.pair.projector.width as f64 - 0.5).contains(&column) {
            return None;
        }
        let ray = self.ray(u, v)?;
        let depth = self.depth(&ray, column)?;
        let camera = Point3::from(ray * depth);
        Some((camera, self.world_from_camera.transform_point(&camera)))
    }

    /// The row of the projector, px, that by the geometry lights what pixel (u, v) sees at absolute phase `phase`; and
    /// the distance of that point before the projector, m.
    pub fn panel_row(&self, u: usize, v: usize, phase: f64) -> Option<(f64, f64)> {
        let (_, world) = self.point(u, v, phase)?;
        let [_, row] = self.pair.projector.project(&world)?;
        Some((row, self.pair.projector.device_point(&world).z))
    }

    /// The undistorted ray (x, y, 1) of a pixel.
    fn ray(&self, u: usize, v: usize) -> Option<Vector3<f64>> {
        let first = v / GRID_PX * self.columns + u / GRID_PX;
        let (fu, fv) = ((u % GRID_PX) as f64 / GRID_PX as f64, (v % GRID_PX) as f64 / GRID_PX as f64);
        let (a, b) = (self.rays.get(first)?, self.rays.get(first + 1)?);
        let (c, d) = (self.rays.get(first + self.columns)?, self.rays.get(first + self.columns + 1)?);
        let mix =
            |i: usize| (1.0 - fv) * ((1.0 - fu) * a[i] + fu * b[i]) + fv * ((1.0 - fu) * c[i] + fu * d[i]);
        let (x, y) = (mix(0), mix(1));
        (x.is_finite() && y.is_finite()).then(|| Vector3::new(x, y, 1.0))
    }

    /// Camera z at which the ray meets the panel column.
    fn depth(&self, ray: &Vector3<f64>, column: f64) -> Option<f64> {
        let lens = &self.pair.projector.lens;
        let (a, t) = (self.rotation * ray, &self.translation);
        let target = (column - lens.cx) / lens.fx;
        let mut p = target;
        for _ in 0..20 {
            let depth = (t.x - p * t.z) / (p * a.z - a.x);
            let (y, z) = (depth * a.y + t.y, depth * a.z + t.z);
            let [u, _] = lens.distort(p, y / z)?;
            let error = (u - column) / lens.fx;
            p -= error;
            if error.abs() < CONVERGED {
                let depth = (t.x - p * t.z) / (p * a.z - a.x);
                return (depth > 0.0 && depth * a.z + t.z > 0.0).then_some(depth);
            }
        }
        None
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::Triangulator;
    use crate::config::Rig;
    use crate::data::Calibration;
    use crate::triangulate::camera_projector::CameraProjector;
    use proptest::prelude::{ProptestConfig, prop_assert, prop_assume, proptest};
    use std::path::Path;

    /// The first pair of the shipped rig, with strong lenses.
    pub(crate) fn strong_lenses() -> CameraProjector {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/rig.toml");
        let mut calibration = Calibration::nominal(&Rig::load(&path).expect("the shipped rig"));
        let head = &mut calibration.heads[0];
        head.projector.lens.distortion = [-0.12, 0.08, 4e-4, -3e-4, 0.01];
        head.cameras[0].device.lens.distortion = [-0.11, 0.09, -3e-4, 2e-4, -0.01];
        let head = &calibration.heads[0];
        CameraProjector::new(head, &head.cameras[0], &calibration).expect("a usable pair")
    }

    fn triangulator() -> Triangulator {
        Triangulator::new(strong_lenses())
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(100))]
        #[test]
        fn a_point_comes_back_within_a_hundredth_of_a_millimetre(
            u in 0usize..1920, v in 0usize..1200, distance in 1.6f64..3.4,
        ) {
            let triangulator = triangulator();
            let pair = triangulator.pair();
            let ray = pair.camera.ray(u as f64, v as f64).expect("inside the image");
            let point = ray.at(distance);
            let panel = pair.projector.project(&point);
            prop_assume!(panel.is_some_and(|panel| pair.projector.contains(panel)));
            let phase = pair.pattern.phase(panel.map_or(0.0, |panel| panel[0]));
            let (camera, world) = triangulator.point(u, v, phase).expect("on the panel");
            prop_assert!((world - point).norm() < 1e-5, "{} m", (world - point).norm());
            prop_assert!((camera - pair.camera.device_point(&world)).norm() < 1e-9);
        }
    }

    #[test]
    fn columns_beside_the_panel_are_refused() {
        let triangulator = triangulator();
        assert!(triangulator.point(960, 600, -10.0).is_none());
        assert!(triangulator.point(960, 600, 1e4).is_none());
        assert!(triangulator.point(960, 600, f64::NAN).is_none());
    }
}
