// SPDX-License-Identifier: MIT OR Apache-2.0
//! Lens models, rigid transforms and the triangulating devices.
//!
//! A camera and a projector are the same kind of [`Device`]: a [`Lens`] at a pose `world_from_device`.
//! Device axes: x along image columns (u), y along rows (v), z forward. Lengths are metres.

/// Things sorted into cubic cells by their place.
pub mod cells;
mod fringes;
mod lens;
mod motion;
/// The projected pattern: sine fringes and the marker.
pub mod pattern;
mod pose;

pub use fringes::Fringes;
pub use lens::Lens;
pub use motion::best_motion;
pub use pose::{Pose, look_at};

use nalgebra::{Point3, Unit, Vector3};
use serde::{Deserialize, Serialize};

/// A pinhole device with distortion, somewhere in the world: a camera, or a projector run backwards.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Device {
    /// Columns of the sensor or panel.
    pub width: usize,
    /// Rows of the sensor or panel.
    pub height: usize,
    pub lens: Lens,
    /// Takes device coordinates to world coordinates.
    pub world_from_device: Pose,
}

/// The half line of world points that one pixel sees.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ray {
    /// The projection centre, world, metres.
    pub origin: Point3<f64>,
    /// Unit direction away from the device.
    pub direction: Unit<Vector3<f64>>,
}

impl Ray {
    /// The point `distance_m` along the ray.
    pub fn at(&self, distance_m: f64) -> Point3<f64> {
        self.origin + self.direction.into_inner() * distance_m
    }
}

impl Device {
    /// The projection centre in the world, metres.
    pub fn centre(&self) -> Point3<f64> {
        self.world_from_device.isometry().translation.vector.into()
    }

    /// World point in device coordinates, metres.
    pub fn device_point(&self, world: &Point3<f64>) -> Point3<f64> {
        self.world_from_device.isometry().inverse_transform_point(world)
    }

    /// Pixel (u, v) of a world point, which may lie outside the image; `None` behind the device or where the
    /// distortion model folds over.
    pub fn project(&self, world: &Point3<f64>) -> Option<[f64; 2]> {
        let p = self.device_point(world);
        (p.z > 0.0).then(|| self.lens.distort(p.x / p.z, p.y / p.z)).flatten()
    }

    /// Whether pixel (u, v) lies on the sensor or panel.
    pub fn contains(&self, [u, v]: [f64; 2]) -> bool {
        (-0.5..self.width as f64 - 0.5).contains(&u) && (-0.5..self.height as f64 - 0.5).contains(&v)
    }

    /// The ray of pixel (u, v); `None` where the distortion cannot be inverted.
    pub fn ray(&self, u: f64, v: f64) -> Option<Ray> {
        let [x, y] = self.lens.undistort(u, v)?;
        let world = self.world_from_device.isometry();
        let direction = Unit::new_normalize(world.rotation * Vector3::new(x, y, 1.0));
        Some(Ray { origin: self.centre(), direction })
    }
}

#[cfg(test)]
mod tests {
    use super::Device;
    use super::lens::Lens;
    use super::pose::look_at;
    use nalgebra::Point3;
    use proptest::prelude::{ProptestConfig, prop_assert, proptest};

    fn camera() -> Device {
        Device {
            width: 1920,
            height: 1200,
            lens: Lens {
                fx: 2048.0,
                fy: 2047.0,
                cx: 961.0,
                cy: 602.0,
                distortion: [-0.095, 0.075, 2e-4, -1e-4, 0.0],
            },
            world_from_device: look_at([2.4, 0.0, 1.85], [0.0, 0.0, 1.0], 90.0).expect("a valid pose"),
        }
    }

    #[test]
    fn portrait_camera_sees_up_at_small_u() {
        let camera = camera();
        let high = camera.project(&Point3::new(0.0, 0.0, 1.5)).expect("in front");
        let low = camera.project(&Point3::new(0.0, 0.0, 0.5)).expect("in front");
        assert!(high[0] < low[0], "u must grow downwards: {high:?} {low:?}");
        // Looking along -x the viewer's right is +y; rolled by 90 degrees rows grow to the left.
        let right = camera.project(&Point3::new(0.0, 0.3, 1.0)).expect("in front");
        assert!(right[1] < 602.0, "{right:?}");
    }

    #[test]
    fn points_behind_are_refused() {
        assert_eq!(camera().project(&Point3::new(5.0, 0.0, 2.0)), None);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(200))]
        #[test]
        fn projecting_a_point_of_a_ray_gives_the_pixel_back(
            u in 0.0..1919.0f64, v in 0.0..1199.0f64, distance in 0.5..4.0f64,
        ) {
            let camera = camera();
            let ray = camera.ray(u, v).expect("inside the image");
            let [pu, pv] = camera.project(&ray.at(distance)).expect("in front");
            prop_assert!((pu - u).abs() < 1e-6 && (pv - v).abs() < 1e-6, "{pu} {pv}");
        }
    }
}
