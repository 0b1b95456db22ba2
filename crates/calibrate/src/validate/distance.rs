// SPDX-License-Identifier: MIT OR Apache-2.0
//! Distances between the outermost circles on both diagonals of the board (paper, 5.1, step 2).
//!
//! As the paper has it, the distance of two circles is the mean of that between the points on their outer edges and
//! that between the points on their inner edges, on the line through their middles. Edges are found in the image grid
//! of the cloud; their points lie on the surface that the cloud's points around the circle make (points whose fringe
//! window a circle reaches are not taken for it).
//!
//! The outermost circle at a corner of the board is the nearest one to that corner that all cameras of the head see
//! whole; it is named by column and row. The distance of the two is compared with the board file's.

use super::edge::{self, Edge};
use super::ring::{Organized, Ring};
use crate::Board;
use crate::base::image::Mono8;
use serde::Serialize;
use std::collections::BTreeMap;

pub use super::edge::Light;

/// Circles tried at each corner.
const TRIED: usize = 8;

/// What one camera has of the board.
#[derive(Debug, Clone, Copy)]
pub struct Sight<'a> {
    pub cloud: &'a Organized<'a>,
    /// What lights it, where the calibration is known.
    pub light: Option<Light<'a>>,
    /// The photograph of the cloud, where it is at hand.
    pub photograph: Option<Mono8<'a>>,
}

/// The circles at both ends of the two diagonals.
#[derive(Debug, Clone, Serialize)]
pub struct Diagonals {
    /// Column and row of the circles at both ends of each diagonal.
    pub ends: [[[usize; 2]; 2]; 2],
    /// Mean of outer and inner distance of each diagonal, mean of the cameras, mm.
    pub diagonal_mm: [f64; 2],
    /// The same distances in the board file, mm.
    pub board_mm: [f64; 2],
    /// Measured distance minus the board file's, mm.
    pub error_mm: [f64; 2],
    /// The errors of each camera alone, mm.
    pub error_of_camera_mm: Vec<[f64; 2]>,
    /// Where each camera has the middles of the ends, world, m: by camera, diagonal and end.
    pub ends_m: Vec<[[[f64; 3]; 2]; 2]>,
    /// Outer distance minus inner distance minus twice the board's diameters, mean of the cameras, mm: it
    /// measures the error of the edges.
    pub edges_mm: [f64; 2],
    /// Root mean square of what the edges' models leave, as a share of the light.
    pub edge_rms: f64,
}

/// Measures both diagonals with all cameras of a head. The error names what is not seen.
pub fn diagonals(sights: &[Sight<'_>], board: &Board) -> Result<Diagonals, String> {
    let mut rings: Vec<Vec<Ring>> = Vec::new();
    for sight in sights {
        rings.push(sight.cloud.circles(board)?);
    }
    let (right, top) = (board.columns - 1, board.rows - 1);
    let corners = [[0, 0], [right, top], [right, 0], [0, top]];
    let mut found: Vec<(usize, Vec<Edge>)> = Vec::new();
    for corner in corners {
        found.push(outermost(sights, &rings, board, corner).ok_or_else(|| {
            format!("no circle near column {}, row {} is seen whole by every camera", corner[0], corner[1])
        })?);
    }
    let name = |circle: usize| [circle % board.columns, circle / board.columns];
    let (mut errors, mut edges) = (vec![[0.0; 2]; sights.len()], [0.0; 2]);
    let (mut diagonal_mm, mut board_mm) = ([0.0; 2], [0.0; 2]);
    let mut ends = [[[0; 2]; 2]; 2];
    let mut ends_m = vec![[[[0.0; 3]; 2]; 2]; sights.len()];
    for diagonal in 0..2 {
        let [(a, of_a), (b, of_b)] = [&found[2 * diagonal], &found[2 * diagonal + 1]];
        ends[diagonal] = [name(*a), name(*b)];
        let [from, to] = [a, b].map(|&i| board.circles()[i]);
        let apart = |i: usize| to.centre_m[i] - from.centre_m[i];
        board_mm[diagonal] = 1e3 * (apart(0).powi(2) + apart(1).powi(2) + apart(2).powi(2)).sqrt();
        let n = sights.len() as f64;
        for (((one, other), errors), ends_m) in of_a.iter().zip(of_b).zip(&mut errors).zip(&mut ends_m) {
            ends_m[diagonal] = [one.centre().into(), other.centre().into()];
            let length = |sign: f64| {
                1e3 * (one.towards(&other.centre(), sign) - other.towards(&one.centre(), sign)).norm()
            };
            let (inner, outer) = (length(1.0), length(-1.0));
            errors[diagonal] = (inner + outer) / 2.0 - board_mm[diagonal];
            diagonal_mm[diagonal] += (inner + outer) / 2.0 / n;
            edges[diagonal] += (outer - inner - 2e3 * (from.radius_m + to.radius_m)) / n;
        }
    }
    let rms: Vec<f64> = found.iter().flat_map(|(_, edges)| edges.iter().map(|e| e.rms)).collect();
    Ok(Diagonals {
        ends,
        diagonal_mm,
        board_mm,
        error_mm: [0, 1].map(|i| diagonal_mm[i] - board_mm[i]),
        error_of_camera_mm: errors,
        ends_m,
        edges_mm: edges,
        edge_rms: (rms.iter().map(|r| r * r).sum::<f64>() / rms.len() as f64).sqrt(),
    })
}

/// The circle nearest to a corner whose edge every camera sees.
fn outermost(
    sights: &[Sight<'_>],
    rings: &[Vec<Ring>],
    board: &Board,
    corner: [usize; 2],
) -> Option<(usize, Vec<Edge>)> {
    let mut seen: BTreeMap<usize, usize> = BTreeMap::new();
    rings.iter().flatten().for_each(|ring| *seen.entry(ring.circle).or_default() += 1);
    let mut candidates: Vec<usize> =
        seen.into_iter().filter(|(_, n)| *n == sights.len()).map(|(circle, _)| circle).collect();
    let steps = |circle: &usize| {
        let (column, row) = (circle % board.columns, circle / board.columns);
        column.abs_diff(corner[0]).pow(2) + row.abs_diff(corner[1]).pow(2)
    };
    candidates.sort_by_key(steps);
    candidates.truncate(TRIED);
    candidates.into_iter().find_map(|circle| {
        let radius = board.circles().get(circle)?.radius_m;
        let edges: Option<Vec<Edge>> = sights
            .iter()
            .zip(rings)
            .map(|(sight, rings)| {
                let ring = rings.iter().find(|ring| ring.circle == circle)?;
                edge::find(sight.cloud, ring, rings, radius, sight.light, sight.photograph)
            })
            .collect();
        Some((circle, edges?))
    })
}

#[cfg(test)]
mod tests {
    use super::{Sight, diagonals};
    use crate::Board;
    use crate::base::image::{Mono8, Plane};
    use crate::data::Cloud;
    use crate::geometry::pattern::{Marker, Pattern};
    use crate::geometry::{Device, Lens, look_at};
    use crate::validate::deviations::Draws;
    use crate::validate::distance::Light;
    use crate::validate::ring::{Organized, place};
    use nalgebra::{Isometry3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};
    use std::path::Path;

    fn device(width: usize, height: usize, focal: f64, position_m: [f64; 3]) -> Device {
        let (cx, cy) = (width as f64 / 2.0 - 0.5, height as f64 / 2.0 - 0.5);
        Device {
            width,
            height,
            lens: Lens { fx: focal, fy: focal, cx, cy, distortion: [0.0; 5] },
            world_from_device: look_at(position_m, [0.0, 0.0, 1.0], 90.0).expect("a pose"),
        }
    }

    /// A head of half the resolution, the board across it and a little turned.
    struct Scene {
        camera: Device,
        projector: Device,
        pattern: Pattern,
        board: Board,
        world_from_board: Isometry3<f64>,
    }

    impl Scene {
        fn new() -> Self {
            let axes = [Vector3::y(), Vector3::z(), Vector3::x()];
            let facing = UnitQuaternion::from_rotation_matrix(&Rotation3::from_basis_unchecked(&axes));
            let turned = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), 0.35) * facing;
            Self {
                camera: device(960, 600, 1024.0, [2.4, 0.0, 1.85]),
                projector: device(1280, 800, 1400.0, [2.4, 0.0, 1.05]),
                pattern: Pattern {
                    period_px: 16.0,
                    marker_index: 40,
                    marker_every: 0,
                    marker: Marker::Darkened { depth: 0.2 },
                    marker_period_px: 16.0,
                    low: 0.0,
                    high: 1.0,
                    gamma: 1.0,
                },
                board: Board::load(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/board.toml"))
                    .expect("the shipped board"),
                world_from_board: Isometry3::from_parts(Translation3::new(0.02, 0.01, 1.0), turned),
            }
        }

        /// The board's point that a pixel sees, board axes.
        fn hit(&self, u: f64, v: f64) -> Option<Point3<f64>> {
            let ray = self.camera.ray(u, v)?;
            let origin = self.world_from_board.inverse_transform_point(&ray.origin);
            let way = self.world_from_board.inverse_transform_vector(&ray.direction);
            let hit = origin - way * (origin.z / way.z);
            (hit.x.abs() < 0.75 && hit.y.abs() < 1.0).then_some(hit)
        }

        /// Share of a pixel that is white, by 4 x 4 samples, and light there.
        fn pixel(&self, u: usize, v: usize) -> Option<(f64, f64)> {
            let hit = self.hit(u as f64, v as f64)?;
            let near = |x: f64, y: f64| {
                let (column, row) = ((x / 0.1 + 6.5).round(), (y / 0.1 + 9.0).round());
                let circle = self.board.circle(column.max(0.0) as usize, row.max(0.0) as usize);
                circle.is_some_and(|c| (x - c.centre_m[0]).hypot(y - c.centre_m[1]) < c.radius_m)
            };
            let black = (0..16)
                .filter_map(|i| {
                    let (du, dv) = (f64::from(i % 4) * 0.25 - 0.375, f64::from(i / 4) * 0.25 - 0.375);
                    self.hit(u as f64 + du, v as f64 + dv)
                })
                .filter(|p| near(p.x, p.y))
                .count();
            let [pu, pv] = self.projector.project(&(self.world_from_board * hit))?;
            Some((1.0 - black as f64 / 16.0, self.pattern.light(pu, pv)))
        }

        /// The photograph, and the cloud as the pipeline makes it: means over one period, no points in circles, depth
        /// wrong by `noise_m` and, near circles, by half a millimetre more.
        fn shoot(&self, noise_m: f64) -> (Plane<u8>, Cloud) {
            let (w, h) = (self.camera.width, self.camera.height);
            let mut draws = Draws(5);
            let mut pixels = Plane::filled(w, h, None);
            let mut sharp = Plane::filled(w, h, 0.0);
            for v in 0..h {
                for u in 0..w {
                    pixels.set(u, v, self.pixel(u, v));
                    let level = |(white, light): (f64, f64)| 200.0 * (0.05 + 0.95 * white) * light;
                    sharp.set(u, v, pixels.at(u, v).map_or(0.0, level));
                }
            }
            // A lens that blurs by 0.6 px.
            let mut image = Plane::filled(w, h, 0u8);
            for v in 3..h - 3 {
                for u in 3..w - 3 {
                    let (mut sum, mut total) = (0.0, 0.0);
                    for (x, y) in (0..49).map(|i| (i % 7, i / 7)) {
                        let away = (x as f64 - 3.0).powi(2) + (y as f64 - 3.0).powi(2);
                        let weight = (-away / (2.0 * 0.36)).exp();
                        sum += weight * sharp.at(u + x - 3, v + y - 3);
                        total += weight;
                    }
                    image.set(u, v, (sum / total + 0.5 + draws.normal()).clamp(0.0, 255.0) as u8);
                }
            }
            let mut cloud = Cloud::default();
            for v in 0..h {
                for u in 12..w - 12 {
                    let Some(hit) = self.hit(u as f64, v as f64) else { continue };
                    let world = self.world_from_board * hit;
                    let column = |du: f64| {
                        Some(
                            self.projector
                                .project(&(self.world_from_board * self.hit(u as f64 + du, v as f64)?))?[0],
                        )
                    };
                    let (Some(left), Some(right)) = (column(-1.0), column(1.0)) else { continue };
                    let period = 2.0 * self.pattern.period_px / (right - left).abs();
                    let white = |i: usize| pixels.at(i, v).map_or(0.0, |p| p.0);
                    let half = (period / 2.0) as usize;
                    let share = (u - half..=u + half).map(white).sum::<f64>() / (2 * half + 1) as f64;
                    if white(u) < 1.0 || share < 0.75 {
                        continue;
                    }
                    let sample = |k: usize| {
                        let x = u as f64 + (k as f64 - 3.0) * period / 6.0;
                        let (i, t) = (x as usize, x.fract());
                        f64::from(image.at(i, v)) * (1.0 - t) + f64::from(image.at(i + 1, v)) * t
                    };
                    let weights = [5.0, 5.0, 7.0, 8.0, 7.0, 5.0, 5.0];
                    let mean = (0..7).map(|k| weights[k] / 42.0 * sample(k)).sum::<f64>();
                    let ray = self.camera.ray(u as f64, v as f64).expect("a ray");
                    let error = noise_m * draws.normal() + if share < 1.0 { 5e-4 } else { 0.0 };
                    let point = world + ray.direction.into_inner() * error;
                    cloud.position_m.push(point.coords.cast::<f32>().into());
                    cloud.normal.push([1.0, 0.0, 0.0]);
                    cloud.intensity.push((mean / 255.0) as f32);
                    cloud.pixel.push([u as u16, v as u16]);
                }
            }
            (image, cloud)
        }
    }

    #[test]
    fn diagonals_are_those_of_the_board() {
        let scene = Scene::new();
        let (image, mut cloud) = scene.shoot(1e-4);
        let light = Some(Light { projector: &scene.projector, pattern: &scene.pattern });
        // A pixel is 2.5 mm here: about an eighth of one from the photograph, a quarter from means over a window.
        for (photograph, most_mm) in [(Some(Mono8::from(&image)), 0.3), (None, 0.6)] {
            let grid = Organized::new(&cloud).expect("points");
            let sight = Sight { cloud: &grid, light, photograph };
            let found = diagonals(&[sight], &scene.board).expect("both diagonals");
            for (ends, corners) in found.ends.iter().zip([[[0, 0], [13, 18]], [[13, 0], [0, 18]]]) {
                let steps = |i: usize, k: usize| ends[i][k].abs_diff(corners[i][k]);
                assert!((0..4).all(|i| steps(i / 2, i % 2) <= 1), "{found:?}");
            }
            assert!(found.error_mm.iter().all(|e| e.abs() < most_mm), "{} {found:?}", photograph.is_some());
            assert!(photograph.is_none() || found.edges_mm.iter().all(|e| e.abs() < 0.5), "{found:?}");
        }
        // Where the board is, from the same circles.
        let grid = Organized::new(&cloud).expect("points");
        let placed = place(&[grid], &scene.board).expect("the board");
        let corner = Point3::new(0.75, 1.0, 0.0);
        let away = placed.world_from_board * corner - scene.world_from_board * corner;
        assert!(away.norm() < 1e-3, "{away}");
        // A cloud that is too large by 0.02 % is found out.
        for p in &mut cloud.position_m {
            *p = [2.4 + (p[0] - 2.4) * 1.0002, p[1] * 1.0002, 1.85 + (p[2] - 1.85) * 1.0002];
        }
        let grid = Organized::new(&cloud).expect("points");
        let sight = Sight { cloud: &grid, light, photograph: Some(Mono8::from(&image)) };
        let found = diagonals(&[sight], &scene.board).expect("both diagonals");
        assert!(found.error_mm.iter().all(|e| (e - 0.44).abs() < 0.3), "{found:?}");
        // Another board is refused.
        let mut other = scene.board.clone();
        other.name = "other".to_owned();
        assert!(diagonals(&[sight], &mirrored(&other)).is_err());
    }

    /// The board file with rows and columns of the larger circles exchanged.
    fn mirrored(board: &Board) -> Board {
        let text =
            std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/board.toml"))
                .expect("the shipped board");
        let text = text
            .replace("[10, 4]]", "[3, 4]]")
            .replace("[[4, 13], [4, 16], [5, 13], [7, 13]", "[[9, 13], [9, 16], [8, 13], [6, 13]");
        let dir = tempfile::tempdir().expect("a temporary directory");
        let path = dir.path().join("board.toml");
        std::fs::write(&path, text).expect("writable");
        let other = Board::load(&path).expect("a board");
        assert_ne!(other.circles(), board.circles());
        other
    }
}
