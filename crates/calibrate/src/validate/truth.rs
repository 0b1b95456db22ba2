// SPDX-License-Identifier: MIT OR Apache-2.0
//! Clouds against rendered ground truth: depth, phase and light of every pixel of a camera.
//!
//! A truth file is an `npz` with `crop` = [v0, v1, u0, u1] of the full `shape` = [rows, columns], and for the
//! crop `depth` (camera z, m; NaN: nothing there), `lit` (in the projector's view, not shadowed, facing it).
//!
//! The distance of a point is the Euclidean one to the true surface around its pixel, triangulated from the
//! depth map. Its fringe order is wrong when the phase at which the projector sees the point differs by more
//! than pi from that of the true surface at its pixel. A point whose pixel sees no surface counts as wrong too
//! (`off_surface`). Its normal is compared with that of the true points [`NORMAL_PX`] around its pixel, as far as these
//! lie on one surface.

use super::light::{Classes, Light, LightScore};
use crate::base::image::Plane;
use crate::data::Cloud;
use crate::formats::npz::NpzReader;
use crate::geometry::Device;
use crate::geometry::pattern::Pattern;
use nalgebra::{Point3, Vector3};
use serde::Serialize;
use std::f64::consts::PI;
use std::path::Path;

/// Neighbouring pixels are on one surface when their points are nearer than this many pixel spacings.
const MAX_STRETCH: f64 = 12.0;

/// Up to this distance, m, the cells that touch the pixel are enough to find the nearest surface.
const NEAR_M: f64 = 0.001;

/// Distance of the true points that make the normal, px: as far as clouds take for theirs.
const NORMAL_PX: usize = 3;

/// Cells searched on each side where the nearest surface is further away.
const WIDE_PX: usize = 4;

/// The truth of one camera at one instant.
#[derive(Debug)]
pub struct Truth {
    /// First column and row of the crop in the frame, px.
    pub(super) origin: [usize; 2],
    /// True points of the crop in camera axes, m; NaN where there is nothing.
    pub(super) points: Plane<[f64; 3]>,
    /// Whether the projector lights the pixels of the crop: not 0.
    pub(super) lit: Plane<u8>,
    focal_px: f64,
}

impl Truth {
    /// Reads a truth file for a camera. Each of its rows is `bin_rows` rows of the file, of which the middle one
    /// counts.
    pub fn load(path: &Path, camera: &Device, bin_rows: usize) -> Result<Self, String> {
        let fail = |e: &dyn std::fmt::Display| format!("{}: {e}", path.display());
        let mut archive = NpzReader::open(path).map_err(|e| fail(&e))?;
        let (_, crop): (_, Vec<i64>) = archive.array("crop").map_err(|e| fail(&e))?;
        let (_, depth): (_, Vec<f32>) = archive.array("depth").map_err(|e| fail(&e))?;
        let (_, lit): (_, Vec<bool>) = archive.array("lit").map_err(|e| fail(&e))?;
        let crop: Option<Vec<usize>> = crop.iter().map(|&x| usize::try_from(x).ok()).collect();
        let &[v0, v1, u0, u1] = crop
            .as_deref()
            .unwrap_or_default()
            .as_array()
            .ok_or_else(|| fail(&"crop is not [v0, v1, u0, u1]"))?;
        if v0 >= v1 || u0 >= u1 || v1 >= (camera.height + 1) * bin_rows || u1 > camera.width {
            return Err(fail(&format!("crop [{v0}, {v1}, {u0}, {u1}] does not fit the camera's sensor")));
        }
        let (width, height) = (u1 - u0, v1 - v0);
        let lit = Plane::from_vec(width, height, lit.into_iter().map(u8::from).collect());
        let depth = Plane::from_vec(width, height, depth);
        let (Some(lit), Some(depth)) = (lit, depth) else {
            return Err(fail(&format!("expected depth and lit of {width} x {height} pixels")));
        };
        // Rows that the file has the middle of.
        let (first, middle) = ((v0 + bin_rows - 1 - bin_rows / 2) / bin_rows, bin_rows / 2);
        let rows = (first..camera.height).take_while(|row| row * bin_rows + middle < v1);
        let rows: Vec<usize> = rows.map(|row| row * bin_rows + middle - v0).collect();
        let mut points = Plane::filled(width, rows.len(), [f64::NAN; 3]);
        let mut is_lit = Plane::filled(width, rows.len(), 0);
        for (v, &from) in rows.iter().enumerate() {
            is_lit.row_mut(v).copy_from_slice(lit.row(from));
            let row = ((v0 + from) as f64 - (bin_rows - 1) as f64 / 2.0) / bin_rows as f64;
            for u in 0..width {
                let z = f64::from(depth.at(u, from));
                if z.is_nan() {
                    continue;
                }
                if let Some([x, y]) = camera.lens.undistort((u0 + u) as f64, row) {
                    points.set(u, v, [x * z, y * z, z]);
                }
            }
        }
        Ok(Self { origin: [u0, first], points, lit: is_lit, focal_px: camera.lens.fx })
    }

    /// Counts no pixel as lit that shows a place outside of a volume (world, m): there are no points, by intention.
    #[must_use]
    pub fn within(mut self, [min, max]: [[f64; 3]; 2], camera: &Device) -> Self {
        let world = camera.world_from_device.isometry();
        for (lit, place) in self.lit.as_mut_slice().iter_mut().zip(self.points.as_slice()) {
            let place = world.transform_point(&Point3::from(*place));
            let inside = (0..3).all(|axis| (min[axis]..=max[axis]).contains(&place[axis]));
            *lit *= u8::from(inside);
        }
        self
    }

    /// Place of a frame pixel in the crop.
    pub(super) fn place(&self, [u, v]: [u16; 2]) -> Option<(usize, usize)> {
        let u = usize::from(u).checked_sub(self.origin[0])?;
        let v = usize::from(v).checked_sub(self.origin[1])?;
        (u < self.points.width() && v < self.points.height()).then_some((u, v))
    }

    /// Compares point `i` of a cloud of this camera with the truth.
    fn judge(&self, cloud: &Cloud, i: usize, reference: Reference<'_>) -> Verdict {
        let place = self.place(cloud.pixel[i]);
        let surface = place.map(|(u, v)| Point3::from(self.points.at(u, v)));
        let (Some(place), Some(surface)) = (place, surface.filter(|p| !p.x.is_nan())) else {
            return Verdict::OffSurface;
        };
        let phase =
            |world: &Point3<f64>| reference.projector.project(world).map(|[u, _]| reference.pattern.phase(u));
        let world = Point3::from(cloud.position_m[i]).cast::<f64>();
        let expected = reference.camera.world_from_device.isometry().transform_point(&surface);
        let right = match (phase(&world), phase(&expected)) {
            (Some(found), Some(expected)) => (found - expected).abs() <= PI,
            _ => false,
        };
        let point = reference.camera.device_point(&world);
        Verdict::On {
            right,
            lit: self.lit.at(place.0, place.1) != 0,
            distance_m: self.distance(&point.coords, place),
        }
    }

    /// How far point `i` of a cloud of this camera lies behind the true surface, along its pixel's line of sight, m.
    /// `None` where there is no surface or the fringe order is wrong.
    pub fn error_along_sight(&self, cloud: &Cloud, i: usize, reference: Reference<'_>) -> Option<f64> {
        let Verdict::On { right: true, .. } = self.judge(cloud, i, reference) else { return None };
        let (u, v) = self.place(cloud.pixel[i])?;
        let surface = Vector3::from(self.points.at(u, v));
        let point = reference.camera.device_point(&Point3::from(cloud.position_m[i]).cast::<f64>());
        Some((point.z - surface.z) * surface.norm() / surface.z)
    }

    /// Angle between the normal of point `i` of a cloud of this camera and the true one at its pixel, rad. `None` where
    /// there is no smooth surface around.
    fn tilt(&self, cloud: &Cloud, i: usize, reference: Reference<'_>) -> Option<f32> {
        let truth = self.normal(self.place(cloud.pixel[i])?)?;
        let world = Vector3::from(cloud.normal[i]).cast::<f64>();
        let own = reference.camera.world_from_device.isometry().inverse_transform_vector(&world);
        Some(own.angle(&truth) as f32)
    }

    /// The true normal around a pixel of the crop, towards the camera, in its axes.
    fn normal(&self, (u, v): (usize, usize)) -> Option<Vector3<f64>> {
        let (left, above) = (u.checked_sub(NORMAL_PX)?, v.checked_sub(NORMAL_PX)?);
        let (right, below) = (u + NORMAL_PX, v + NORMAL_PX);
        if right >= self.points.width() || below >= self.points.height() {
            return None;
        }
        let at = |u: usize, v: usize| Vector3::from(self.points.at(u, v));
        let own = at(u, v);
        let limit = MAX_STRETCH * NORMAL_PX as f64 * own.z / self.focal_px;
        let around = [at(left, v), at(right, v), at(u, above), at(u, below)];
        // A missing point is NaN, which is not below the limit.
        let smooth = around.iter().all(|x| (x - own).norm() < limit);
        let normal = (around[1] - around[0]).cross(&(around[3] - around[2])).try_normalize(0.0)?;
        smooth.then(|| if normal.dot(&own) > 0.0 { -normal } else { normal })
    }

    /// Where a cloud of this camera is right, wrong or missing: columns, rows and RGB of the crop. Blue: lit,
    /// but no point; grey: right, the darker the further from the surface (black at 1 mm); red: wrong order;
    /// magenta: no surface there.
    pub fn picture(&self, cloud: &Cloud, reference: Reference<'_>) -> (usize, usize, Vec<u8>) {
        let (width, height) = (self.lit.width(), self.lit.height());
        let mut rgb: Vec<u8> = self
            .lit
            .as_slice()
            .iter()
            .flat_map(|&lit| if lit != 0 { [0, 0, 255] } else { [0, 0, 48] })
            .collect();
        for i in 0..cloud.len() {
            let Some((u, v)) = self.place(cloud.pixel[i]) else { continue };
            let colour = match self.judge(cloud, i, reference) {
                Verdict::OffSurface => [255, 0, 255],
                Verdict::On { right: false, .. } => [255, 0, 0],
                Verdict::On { distance_m, .. } => [(255.0 * (1.0 - distance_m / 1e-3)).max(0.0) as u8; 3],
            };
            let at = 3 * (v * width + u);
            rgb[at..at + 3].copy_from_slice(&colour);
        }
        (width, height, rgb)
    }

    /// Distance from a point in camera axes to the surface around a pixel, m; infinite where there is none.
    fn distance(&self, point: &Vector3<f64>, place: (usize, usize)) -> f64 {
        let near = self.distance_within(point, place, 1);
        if near <= NEAR_M { near } else { near.min(self.distance_within(point, place, WIDE_PX)) }
    }

    fn distance_within(&self, point: &Vector3<f64>, (u, v): (usize, usize), reach: usize) -> f64 {
        let mut best = f64::INFINITY;
        let columns = u.saturating_sub(reach)..(u + reach).min(self.points.width() - 1);
        for y in v.saturating_sub(reach)..(v + reach).min(self.points.height() - 1) {
            for x in columns.clone() {
                let corner = |dx: usize, dy: usize| Vector3::from(self.points.at(x + dx, y + dy));
                let [a, b, c, d] = [corner(0, 0), corner(1, 0), corner(0, 1), corner(1, 1)];
                for triangle in [[a, b, c], [d, c, b]] {
                    if self.is_surface(&triangle) {
                        best = best.min((closest(point, &triangle) - point).norm());
                    }
                }
            }
        }
        best
    }

    fn is_surface(&self, [a, b, c]: &[Vector3<f64>; 3]) -> bool {
        let limit = MAX_STRETCH * a.z / self.focal_px;
        (b - a).norm() < limit && (c - a).norm() < limit && (c - b).norm() < limit
    }
}

/// One point against the truth.
enum Verdict {
    /// There is no surface at its pixel.
    OffSurface,
    /// There is a surface at its pixel.
    On {
        /// Whether the fringe order is right.
        right: bool,
        /// Whether the projector lights the pixel.
        lit: bool,
        /// Distance to the surface, m; infinite where it is too broken to be triangulated.
        distance_m: f64,
    },
}

/// The point of a triangle that is nearest to `p` (Ericson, Real-Time Collision Detection, 5.1.5: by the
/// Voronoi region that `p` lies in).
pub(super) fn closest(p: &Vector3<f64>, [a, b, c]: &[Vector3<f64>; 3]) -> Vector3<f64> {
    let (ab, ac) = (b - a, c - a);
    let (d1, d2) = (ab.dot(&(p - a)), ac.dot(&(p - a)));
    if d1 <= 0.0 && d2 <= 0.0 {
        return *a;
    }
    let (d3, d4) = (ab.dot(&(p - b)), ac.dot(&(p - b)));
    if d3 >= 0.0 && d4 <= d3 {
        return *b;
    }
    let (d5, d6) = (ab.dot(&(p - c)), ac.dot(&(p - c)));
    if d6 >= 0.0 && d5 <= d6 {
        return *c;
    }
    let vc = d1 * d4 - d3 * d2;
    if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 {
        return a + ab * (d1 / (d1 - d3));
    }
    let vb = d5 * d2 - d1 * d6;
    if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 {
        return a + ac * (d2 / (d2 - d6));
    }
    let va = d3 * d6 - d5 * d4;
    if va <= 0.0 && d4 - d3 >= 0.0 && d5 - d6 >= 0.0 {
        return b + (c - b) * ((d4 - d3) / ((d4 - d3) + (d5 - d6)));
    }
    a + (ab * vb + ac * vc) / (va + vb + vc)
}

/// What scoring needs to know of a camera.
#[derive(Debug, Clone, Copy)]
pub struct Reference<'a> {
    pub camera: &'a Device,
    pub projector: &'a Device,
    pub pattern: &'a Pattern,
}

/// Counts and distances, which add up over clouds.
#[derive(Debug, Clone, Default)]
pub struct Tally {
    points: usize,
    wrong_order: usize,
    off_surface: usize,
    lit: usize,
    lit_right: usize,
    /// Distances of the points that have a surface, m, with whether their order is right.
    distances: Vec<(f32, bool)>,
    /// Angles between the normals of points of right order and the true ones, rad.
    tilts: Vec<f32>,
    /// Counts by modulation, where photographs are given.
    classes: Classes,
}

impl Tally {
    /// Adds the points of `cloud` for which `select` holds (by index), all of one camera, and that camera's lit pixels;
    /// with the fringes of its photograph, by their modulation, too.
    pub fn add(
        &mut self,
        cloud: &Cloud,
        select: impl Fn(usize) -> bool,
        truth: &Truth,
        reference: Reference<'_>,
        light: Option<&Light>,
    ) {
        if let Some(light) = light {
            self.classes.add_pixels(light);
        }
        self.lit += truth.lit.as_slice().iter().filter(|&&x| x != 0).count();
        for i in (0..cloud.len()).filter(|&i| select(i)) {
            self.points += 1;
            match truth.judge(cloud, i, reference) {
                Verdict::OffSurface => self.off_surface += 1,
                Verdict::On { right, lit, distance_m } => {
                    let place = truth.place(cloud.pixel[i]);
                    if let Some(pixel) = light.zip(place).and_then(|(light, place)| light.at(place)) {
                        self.classes.add_point(pixel, right);
                    }
                    self.wrong_order += usize::from(!right);
                    self.lit_right += usize::from(right && lit);
                    self.tilts.extend(right.then(|| truth.tilt(cloud, i, reference)).flatten());
                    if distance_m.is_finite() {
                        self.distances.push((distance_m as f32, right));
                    }
                }
            }
        }
    }

    /// Adds the tally of another cloud.
    pub fn join(&mut self, other: &Tally) {
        self.points += other.points;
        self.wrong_order += other.wrong_order;
        self.off_surface += other.off_surface;
        self.lit += other.lit;
        self.lit_right += other.lit_right;
        self.distances.extend_from_slice(&other.distances);
        self.tilts.extend_from_slice(&other.tilts);
        self.classes.join(&other.classes);
    }

    /// The figures of everything that was added.
    pub fn score(&self) -> Score {
        let share = |part: usize, whole: usize| part as f64 / whole.max(1) as f64;
        let mut all: Vec<f32> = self.distances.iter().map(|&(d, _)| d).collect();
        all.sort_unstable_by(f32::total_cmp);
        let right: Vec<f32> = self.distances.iter().filter(|x| x.1).map(|x| x.0).collect();
        let mut tilts = self.tilts.clone();
        tilts.sort_unstable_by(f32::total_cmp);
        let of = |sorted: &[f32], q: f64| {
            let i = (q * sorted.len().saturating_sub(1) as f64).round() as usize;
            sorted.get(i).map_or(f64::NAN, |&x| f64::from(x))
        };
        let quantile = |q: f64| 1e3 * of(&all, q);
        let rms = |values: &[f32]| {
            let sum: f64 = values.iter().map(|&d| f64::from(d) * f64::from(d)).sum();
            1e3 * (sum / values.len() as f64).sqrt()
        };
        Score {
            points: self.points,
            rms_mm: rms(&all),
            rms_right_order_mm: rms(&right),
            mean_right_order_mm: 1e3 * right.iter().map(|&d| f64::from(d)).sum::<f64>() / right.len() as f64,
            p95_mm: quantile(0.95),
            robust_mm: 1.4826 * quantile(0.5),
            wrong_order_share: share(self.wrong_order + self.off_surface, self.points),
            off_surface_share: share(self.off_surface, self.points),
            completeness_of_lit: share(self.lit_right, self.lit),
            lit_px: self.lit,
            normal_median_deg: of(&tilts, 0.5).to_degrees(),
            normal_p95_deg: of(&tilts, 0.95).to_degrees(),
            by_modulation: self.classes.score(self.lit),
        }
    }
}

/// The figures of one cloud or of several together.
#[derive(Debug, Clone, Serialize)]
pub struct Score {
    pub points: usize,
    /// RMS distance to the true surface of all points that have one, wrong fringe orders included, mm.
    pub rms_mm: f64,
    /// The same of the points of right fringe order.
    pub rms_right_order_mm: f64,
    /// Mean distance of the points of right fringe order, mm.
    pub mean_right_order_mm: f64,
    /// 95th percentile of the distance of all points that have a surface, mm.
    pub p95_mm: f64,
    /// 1.4826 times the median distance, mm.
    pub robust_mm: f64,
    /// Share of points of wrong fringe order, or where there is no surface.
    pub wrong_order_share: f64,
    /// Share of points where there is no surface.
    pub off_surface_share: f64,
    /// Share of the lit pixels that have a point of right order.
    pub completeness_of_lit: f64,
    pub lit_px: usize,
    /// Median angle between the normals of points of right order and the true ones, degrees.
    pub normal_median_deg: f64,
    /// 95th percentile of that, degrees.
    pub normal_p95_deg: f64,
    /// Completeness and wrong points by modulation; empty without photographs.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub by_modulation: Vec<LightScore>,
}

#[cfg(test)]
mod tests {
    use super::{NORMAL_PX, Truth, closest};
    use crate::base::image::Plane;
    use crate::geometry::{Device, Lens, Pose};
    use nalgebra::{Isometry3, Vector3};
    use proptest::prelude::{ProptestConfig, prop_assert, proptest};

    #[test]
    fn the_true_normal_is_that_of_the_surface_and_none_at_its_edge() {
        // A plane seen from the origin by a camera of 1000 px focal length; from column 15 on another one, half a metre
        // behind.
        let (side, focal_px) = (30, 1000.0);
        let normal = Vector3::new(0.3, -0.2, -0.9).normalize();
        let mut points = Plane::filled(side, side, [f64::NAN; 3]);
        for v in 0..side {
            for u in 0..side {
                let ray = Vector3::new(u as f64 / focal_px, v as f64 / focal_px, 1.0);
                let behind = if u < 15 { 0.0 } else { 0.5 };
                points.set(u, v, (ray * ((2.0 + behind) * normal.z / normal.dot(&ray))).into());
            }
        }
        let truth = Truth { origin: [0, 0], points, lit: Plane::filled(side, side, 1), focal_px };
        for place in [(3, 3), (8, 20), (11, 26), (18, 10)] {
            let found = truth.normal(place).expect("a smooth surface");
            assert!(found.angle(&normal) < 1e-6, "{place:?}: {found:?}");
        }
        for place in [(NORMAL_PX - 1, 10), (10, side - NORMAL_PX), (14, 10), (15, 10), (17, 10)] {
            assert_eq!(truth.normal(place), None, "{place:?}");
        }
    }

    #[test]
    fn what_lies_outside_of_the_volume_counts_as_not_lit() {
        let pose = Isometry3::translation(0.0, 0.0, -2.0);
        let lens = Lens { fx: 100.0, fy: 100.0, cx: 1.0, cy: 0.0, distortion: [0.0; 5] };
        let camera = Device { width: 3, height: 1, lens, world_from_device: Pose::new(pose) };
        let places = vec![[0.2, 0.0, 2.0], [0.2, 0.0, 3.5], [f64::NAN; 3]];
        let points = Plane::from_vec(3, 1, places).expect("three");
        let truth = Truth { origin: [0, 0], points, lit: Plane::filled(3, 1, 1), focal_px: 100.0 };
        let lit = truth.within([[-1.0; 3], [1.0; 3]], &camera).lit;
        assert_eq!(lit.as_slice(), [1, 0, 0]);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn no_point_of_the_triangle_is_nearer(coordinates in proptest::array::uniform12(-1.0f64..1.0)) {
            let vertex = |i: usize| Vector3::new(coordinates[i], coordinates[i + 1], coordinates[i + 2]);
            let (p, triangle) = (vertex(0), [vertex(3), vertex(6), vertex(9)]);
            let found = (closest(&p, &triangle) - p).norm();
            let mut sampled = f64::INFINITY;
            for i in 0..=60 {
                for j in 0..=60 - i {
                    let (s, t) = (f64::from(i) / 60.0, f64::from(j) / 60.0);
                    let q = triangle[0] * (1.0 - s - t) + triangle[1] * s + triangle[2] * t;
                    sampled = sampled.min((q - p).norm());
                }
            }
            prop_assert!(found <= sampled + 1e-12 && found > sampled - 0.05, "{found} {sampled}");
        }
    }
}
