// SPDX-License-Identifier: MIT OR Apache-2.0
//! The circles of the board in a directional cloud: dark, or without points, on its pixel grid.

use super::plane::Placed;
use crate::base::image::Plane;
use crate::data::Cloud;
use crate::estimate::median;
use crate::geometry::best_motion;
use crate::spots::{lightest_of_blocks, regions};
use crate::{Board, Ellipse, Spot, identify};
use nalgebra::{Point3, SMatrix, SVector, Vector3};

/// Pixels darker than this share of the light around are of a circle.
const DARK: f32 = 0.5;
/// Side of the blocks in which the light is looked for, px.
const BLOCK: usize = 32;
/// Pixels that a circle may have.
const AREA: std::ops::RangeInclusive<usize> = 30..=20_000;
/// Pixels this near to a circle along u see it in their fringe window, or nearly: their points are not taken for the
/// surface. One period is 8 to 14 px on a board in the volume.
const CLEAR_U: f64 = 14.0;
/// The same distance along v, px.
const CLEAR_V: f64 = 5.0;
/// Half side of the patch that the surface is fitted in, as a share of the distance of circles.
const PATCH: f64 = 1.0;
/// Fewest points of a patch.
const LEAST_POINTS: usize = 300;

/// Number of terms of a cubic in two variables.
pub(super) const TERMS: usize = 10;

/// A directional cloud by pixel.
#[derive(Debug)]
pub struct Organized<'a> {
    cloud: &'a Cloud,
    /// Column and row of the first place.
    origin: [usize; 2],
    /// Number of the point + 1, 0 where there is none.
    points: Plane<u32>,
}

impl<'a> Organized<'a> {
    /// Sorts a cloud by pixel; `None` where it is empty.
    pub fn new(cloud: &'a Cloud) -> Option<Self> {
        let range = |axis: usize| {
            let values = || cloud.pixel.iter().map(|p| usize::from(p[axis]));
            Some((values().min()?, values().max()?))
        };
        let ((u0, u1), (v0, v1)) = (range(0)?, range(1)?);
        let mut points = Plane::filled(u1 - u0 + 1, v1 - v0 + 1, 0u32);
        for (i, &[u, v]) in cloud.pixel.iter().enumerate() {
            points.set(usize::from(u) - u0, usize::from(v) - v0, i as u32 + 1);
        }
        Some(Self { cloud, origin: [u0, v0], points })
    }

    /// The number of the point of a pixel.
    pub(super) fn at(&self, u: i64, v: i64) -> Option<usize> {
        let u = usize::try_from(u).ok()?.checked_sub(self.origin[0])?;
        let v = usize::try_from(v).ok()?.checked_sub(self.origin[1])?;
        let inside = u < self.points.width() && v < self.points.height();
        inside.then(|| self.points.at(u, v)).and_then(|i| (i as usize).checked_sub(1))
    }

    /// The point with this number, m.
    pub(super) fn position(&self, i: usize) -> Point3<f64> {
        Point3::from(self.cloud.position_m[i]).cast::<f64>()
    }

    /// Its light, 0 to 1.
    pub(super) fn intensity(&self, i: usize) -> f64 {
        f64::from(self.cloud.intensity[i])
    }

    /// Finds and names the board's circles.
    pub fn circles(&self, board: &Board) -> Result<Vec<Ring>, String> {
        let sightings = identify(&self.spots(), board).map_err(|refusal| refusal.message)?;
        let mut rings: Vec<Ring> = sightings
            .into_iter()
            .map(|s| Ring { circle: s.circle, outline: s.spot.ellipse, step_px: 0.0 })
            .collect();
        rings.sort_by_key(|ring| ring.circle);
        let centres: Vec<[f64; 2]> = rings.iter().map(|r| r.outline.centre).collect();
        for ring in &mut rings {
            let [u, v] = ring.outline.centre;
            let others = centres.iter().map(|c| (c[0] - u).hypot(c[1] - v)).filter(|d| *d > 0.0);
            ring.step_px = others.fold(f64::INFINITY, f64::min);
        }
        Ok(rings)
    }

    /// The ellipses of connected dark or missing places that do not reach the rim.
    fn spots(&self) -> Vec<Spot> {
        let (w, h) = (self.points.width(), self.points.height());
        let light = |u: usize, v: usize| match self.points.at(u, v) {
            0 => 0.0,
            i => self.cloud.intensity[i as usize - 1],
        };
        let white = lightest_of_blocks(w, h, BLOCK, light);
        let dark = Plane::from_fn(w, h, |u, v| light(u, v) <= DARK * white.at(u / BLOCK, v / BLOCK));
        let place = |p: &usize| [(p % w + self.origin[0]) as f64, (p / w + self.origin[1]) as f64];
        let spot = |region: &Vec<usize>| {
            let (ellipse, filled) = Ellipse::of_region(region.iter().map(place))?;
            let spot = Spot { ellipse, rms_px: 0.0, contrast: 0.0, blur_px: 0.0, outside: 0.0 };
            (0.8..1.2).contains(&filled).then_some(spot)
        };
        regions(dark, &[[1, 0], [-1, 0], [0, 1], [0, -1]], AREA).iter().filter_map(spot).collect()
    }

    /// The surface around a circle, from points that see no circle in their window.
    pub(super) fn surface(&self, ring: &Ring, all: &[Ring]) -> Option<Surface> {
        let [cu, cv] = ring.outline.centre;
        let reach = (PATCH * ring.step_px).clamp(30.0, 150.0);
        let near: Vec<&Ellipse> = all
            .iter()
            .map(|other| &other.outline)
            .filter(|o| (o.centre[0] - cu).abs().max((o.centre[1] - cv).abs()) < reach + 60.0)
            .collect();
        let is_clear = |u: f64, v: f64| {
            near.iter().all(|o| {
                // A box around the ellipse is enough.
                let (sin, cos) = o.angle.sin_cos();
                let half = |x: f64, y: f64| (o.axes[0] * x).hypot(o.axes[1] * y);
                let (wide, high) = (half(cos, sin) + CLEAR_U, half(sin, cos) + CLEAR_V);
                ((u - o.centre[0]) / wide).powi(2) + ((v - o.centre[1]) / high).powi(2) > 1.0
            })
        };
        let mut samples = Vec::new();
        let span = |c: f64| (c - reach).round() as i64..=(c + reach).round() as i64;
        for v in span(cv) {
            for u in span(cu) {
                if let Some(i) = self.at(u, v).filter(|_| is_clear(u as f64, v as f64)) {
                    samples.push((terms((u as f64 - cu) / reach, (v as f64 - cv) / reach), self.position(i)));
                }
            }
        }
        let coefficients = fit(&samples)?;
        Some(Surface { centre: [cu, cv], reach, coefficients })
    }
}

/// A circle of the board as a directional cloud shows it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ring {
    /// Its number in the list [`Board::circles`].
    pub circle: usize,
    /// The ellipse of its dark or empty pixels: to a few tenths of a pixel.
    pub outline: Ellipse,
    /// Distance to the next circle, px.
    pub step_px: f64,
}

/// Constant, linear, quadratic and cubic terms.
pub(super) fn terms(x: f64, y: f64) -> SVector<f64, TERMS> {
    SVector::from([1.0, x, y, x * x, x * y, y * y, x * x * x, x * x * y, x * y * y, y * y * y])
}

type Coefficients = SMatrix<f64, TERMS, 3>;

/// Least squares of world points over pixels, points beyond three robust deviations left out.
fn fit(samples: &[(SVector<f64, TERMS>, Point3<f64>)]) -> Option<Coefficients> {
    let mut gate = f64::INFINITY;
    let mut found = Coefficients::zeros();
    for _ in 0..3 {
        let away = |(t, p): &(SVector<f64, TERMS>, Point3<f64>)| (found.transpose() * t - p.coords).norm();
        let (mut normal, mut right, mut n) =
            (SMatrix::<f64, TERMS, TERMS>::zeros(), Coefficients::zeros(), 0);
        for sample in samples.iter().filter(|s| gate.is_infinite() || away(s) <= gate) {
            normal += sample.0 * sample.0.transpose();
            right += sample.0 * sample.1.coords.transpose();
            n += 1;
        }
        if n < LEAST_POINTS {
            return None;
        }
        found = normal.cholesky()?.solve(&right);
        let sizes = samples.iter().map(|(t, p)| (found.transpose() * t - p.coords).norm());
        gate = 3.0 * 1.4826 * median(sizes);
    }
    Some(found)
}

/// The surface around a circle: a cubic of the pixel in each world coordinate.
#[derive(Debug, Clone)]
pub(super) struct Surface {
    centre: [f64; 2],
    reach: f64,
    coefficients: Coefficients,
}

impl Surface {
    /// The point that a pixel sees, m.
    pub(super) fn at(&self, [u, v]: [f64; 2]) -> Point3<f64> {
        let t = terms((u - self.centre[0]) / self.reach, (v - self.centre[1]) / self.reach);
        (self.coefficients.transpose() * t).into()
    }

    /// How that point moves with u and with v, m/px.
    pub(super) fn slopes(&self, [u, v]: [f64; 2]) -> [Vector3<f64>; 2] {
        let half = |a: Point3<f64>, b: Point3<f64>| (a - b) / 2.0;
        [
            half(self.at([u + 1.0, v]), self.at([u - 1.0, v])),
            half(self.at([u, v + 1.0]), self.at([u, v - 1.0])),
        ]
    }
}

/// The board's pose from the middles of its circles in the clouds of one head: good to some tenths of a millimetre.
pub fn place(clouds: &[Organized<'_>], board: &Board) -> Result<Placed, String> {
    let mut pairs: Vec<(Point3<f64>, Point3<f64>)> = Vec::new();
    let mut reason = "there are no clouds".to_owned();
    for cloud in clouds {
        match cloud.circles(board) {
            Err(why) => reason = why,
            Ok(rings) => pairs.extend(rings.iter().filter_map(|ring| {
                let surface = cloud.surface(ring, &rings)?;
                let circle = board.circles().get(ring.circle)?;
                Some((Point3::from(circle.centre_m), surface.at(ring.outline.centre)))
            })),
        }
    }
    let pose = best_motion(&pairs).ok_or_else(|| format!("the board is not recognized: {reason}"))?;
    Ok(Placed { world_from_board: pose, size_m: board.size_m })
}

#[cfg(test)]
mod tests {
    use super::{Organized, place};
    use crate::Board;
    use crate::data::Cloud;
    use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};
    use std::path::Path;

    /// Distance of the camera from the board's middle, m, and its focal length, px.
    const AWAY_M: f64 = 2.2;
    const FOCAL_PX: f64 = 1000.0;

    /// The board turned about its long axis before a camera. Around four circles of one column, on which the marker
    /// lies, points are missing.
    fn cloud(board: &Board, world_from_board: &Isometry3<f64>, grown: f64) -> Cloud {
        let normal = world_from_board * Vector3::z();
        let mut cloud = Cloud::default();
        for (u, v) in (0..1200u16).flat_map(|u| (0..900u16).map(move |v| (u, v))) {
            let (x, y) = ((f64::from(u) - 600.0) / FOCAL_PX, (f64::from(v) - 450.0) / FOCAL_PX);
            let z = AWAY_M * normal.z / (normal.z - normal.x * y - normal.y * x);
            let point = Point3::new(z * y, z * x, AWAY_M - z);
            let at = world_from_board.inverse() * point;
            if at.x.abs() > 0.75 || at.y.abs() > 1.0 {
                continue;
            }
            let number = |x: f64, count: usize| {
                (x / 0.1 + (count as f64 - 1.0) / 2.0).round().clamp(0.0, count as f64 - 1.0) as usize
            };
            let (column, row) = (number(at.x, board.columns), number(at.y, board.rows));
            let circle = board.circle(column, row).expect("on the board");
            let from = (at.x - circle.centre_m[0]).hypot(at.y - circle.centre_m[1]);
            let missing = column == 8 && (2..6).contains(&row) && from < grown * circle.radius_m;
            if from < circle.radius_m || missing {
                continue;
            }
            cloud.position_m.push(point.coords.map(|x| x as f32).into());
            cloud.normal.push([0.0, 0.0, 1.0]);
            cloud.intensity.push(0.5);
            cloud.pixel.push([u, v]);
        }
        cloud
    }

    /// What points are missing beside circles that the marker crosses makes these seem large: four, and five are.
    #[test]
    fn the_board_is_recognized_where_some_circles_seem_large() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/board.toml");
        let board = Board::load(&path).expect("a good board");
        for (degrees, grown) in [(0.0f64, 1.0), (45.0, 1.0), (-45.0, 1.0), (45.0, 1.35), (-45.0, 1.35)] {
            let turn = UnitQuaternion::from_scaled_axis(Vector3::y() * degrees.to_radians());
            let pose = Isometry3::from_parts(Vector3::zeros().into(), turn);
            let cloud = cloud(&board, &pose, grown);
            let organized = Organized::new(&cloud).expect("points");
            let placed =
                place(&[organized], &board).unwrap_or_else(|e| panic!("{degrees} degrees, {grown}: {e}"));
            let off = board.corners().map(|c| (placed.world_from_board * c - pose * c).norm());
            assert!(off.iter().all(|off| *off < 1e-3), "{degrees} degrees, {grown}: {off:?} m");
        }
    }
}
