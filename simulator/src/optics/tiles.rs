// SPDX-License-Identifier: MIT OR Apache-2.0
//! Where in an image a scene can be at all: most rays need not be cast.

use crate::scene::Scene;
use fourdbody::geometry::Device;
use nalgebra::Point3;

/// Pixels along a tile's side.
const SIDE: usize = 16;

/// An image cut into tiles, each of which may or may not hold a part of the scene.
pub struct Tiles {
    columns: usize,
    occupied: Vec<bool>,
}

/// Number of tiles along and down an image.
fn counts(device: &Device) -> (usize, usize) {
    (device.width.div_ceil(SIDE), device.height.div_ceil(SIDE))
}

/// The tile of a place in or near the image, by the number that [`Tiles::holds_tile`] takes.
pub fn tile_number(device: &Device, [u, v]: [f64; 2]) -> u32 {
    let (columns, rows) = counts(device);
    let index = |x: f64, count: usize| ((x / SIDE as f64).max(0.0) as usize).min(count - 1);
    (index(v + 0.5, rows) * columns + index(u + 0.5, columns)) as u32
}

impl Tiles {
    /// Marks the tiles of a device's image that the scene may touch, also half a pixel beyond each pixel.
    pub fn new(scene: &Scene, device: &Device) -> Self {
        let (columns, rows) = counts(device);
        let Some(balls) = scene.balls() else {
            return Self { columns, occupied: vec![true; columns * rows] };
        };
        let mut tiles = Self { columns, occupied: vec![false; columns * rows] };
        let slack = 1.0 + distortion_slack(device);
        let focal = device.lens.fx.max(device.lens.fy);
        for (centre, radius) in balls {
            let z = device.device_point(&centre).z;
            if z < -radius {
                continue;
            }
            let Some(pixel) = (z > 2.0 * radius).then(|| device.project(&centre)).flatten() else {
                // Around the device itself, or outside what its lens model covers.
                tiles.occupied.fill(true);
                return tiles;
            };
            // Off the axis a ball looks longer, by at most the square of 1 / cos.
            let oblique = oblique(device, &centre);
            tiles.mark(device, pixel, focal * radius / (z - radius) * oblique * slack + 2.0);
        }
        tiles
    }

    fn mark(&mut self, device: &Device, [u, v]: [f64; 2], reach: f64) {
        let outside = |x: f64, size: usize| x + reach < -1.0 || x - reach > size as f64;
        if outside(u, device.width) || outside(v, device.height) {
            return;
        }
        let first = tile_number(device, [u - reach, v - reach]) as usize;
        let last = tile_number(device, [u + reach, v + reach]) as usize;
        for row in first / self.columns..=last / self.columns {
            let line = row * self.columns;
            self.occupied[line + first % self.columns..=line + last % self.columns].fill(true);
        }
    }

    /// Whether the tile of pixel (u, v) may hold a part of the scene.
    #[inline]
    pub fn holds(&self, u: usize, v: usize) -> bool {
        self.occupied[v / SIDE * self.columns + u / SIDE]
    }

    /// Whether a tile may hold a part of the scene.
    #[inline]
    pub fn holds_tile(&self, number: u32) -> bool {
        self.occupied[number as usize]
    }
}

fn oblique(device: &Device, point: &Point3<f64>) -> f64 {
    let p = device.device_point(point);
    1.0 + (p.x * p.x + p.y * p.y) / (p.z * p.z)
}

/// By how much distortion can stretch the image anywhere in it, as a share (sampled along the diagonal).
fn distortion_slack(device: &Device) -> f64 {
    let lens = &device.lens;
    let edge = (device.width as f64).hypot(device.height as f64) / lens.fx.min(lens.fy);
    let [k1, k2, p1, p2, k3] = lens.distortion;
    let stretch = (0..=20).map(|i| {
        let r2 = (edge * f64::from(i) / 20.0).powi(2);
        (3.0 * k1 * r2).abs().max((r2 * (3.0 * k1 + r2 * (5.0 * k2 + r2 * 7.0 * k3))).abs())
    });
    stretch.fold(0.1, f64::max) + 6.0 * (p1.abs() + p2.abs()) * edge
}

#[cfg(test)]
mod tests {
    use super::{Tiles, tile_number};
    use crate::scene::{MeshSolid, Scene, Sight, Solid, Sphere};
    use fourdbody::geometry::{Device, Lens, look_at};
    use nalgebra::Point3;

    #[test]
    fn every_ray_that_hits_passes_a_marked_tile_and_few_tiles_are_marked() {
        let lens =
            Lens { fx: 512.0, fy: 512.0, cx: 240.0, cy: 150.0, distortion: [-0.095, 0.075, 2e-4, 1e-4, 0.0] };
        let world_from_device = look_at([2.4, 0.0, 1.85], [0.0, 0.0, 1.0], 90.0).expect("a valid pose");
        let device = Device { width: 480, height: 300, lens, world_from_device };
        let ball = Sphere { centre: Point3::new(0.1, 0.3, 1.5), radius: 0.15 };
        let scene = Scene::of(Solid::Mesh(MeshSolid::new(ball.mesh())));
        let tiles = Tiles::new(&scene, &device);
        for v in 0..device.height {
            for u in 0..device.width {
                let ray = device.ray(u as f64, v as f64).expect("in the image");
                let sight = Sight { origin: ray.origin, direction: ray.direction.into_inner() };
                let hit = scene.intersect(&sight).is_some();
                assert!(!hit || tiles.holds(u, v), "({u}, {v})");
                assert_eq!(tiles.holds(u, v), tiles.holds_tile(tile_number(&device, [u as f64, v as f64])));
            }
        }
        let marked = tiles.occupied.iter().filter(|&&occupied| occupied).count();
        assert!(marked * 4 < tiles.occupied.len(), "{marked} of {}", tiles.occupied.len());
    }
}
