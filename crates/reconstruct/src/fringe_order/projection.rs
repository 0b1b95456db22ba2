// SPDX-License-Identifier: MIT OR Apache-2.0
//! Where all other cameras would see a place on a line of sight of one view, and which phase their projectors cast on
//! it: eight cameras at once.
//!
//! A line of sight of the view runs from its centre `c` along `d`, at inverse depth `w` through `c + d / w`. In the
//! axes of another device that is `a + b / w`, where `a` is the same for all lines of the view and `b` is `d` turned.
//! Only the quotient of the coordinates matters, so `w a + b` does as well and there is nothing to divide by `w`. The
//! inverse depth of a fringe order is a polynomial that [`RayTable`] has. Cameras and projectors lie side by side in
//! lanes.

use super::lookup::{BACKGROUND_PX, PAD_PX, padded};
use super::patches::CELL_PX;
use crate::geometry::Device;
use crate::kernels::fast_round::floor;
use crate::kernels::region_of_interest::Roi;
use crate::triangulate::camera_projector::CameraProjector;
use crate::triangulate::ray_table::RayTable;
use nalgebra::{Point3, Vector3};

/// Cameras that are worked on at once, one in each lane of a vector.
pub const LANES: usize = 8;

type Lanes = [f32; LANES];

/// Where each camera of some would see a place.
#[derive(Debug, Clone, Copy)]
pub struct Projected {
    /// Cell of the padded grid; [`NOWHERE`] where the camera does not see it.
    pub cell: [u32; LANES],
    /// Columns from the cell's first.
    pub right: Lanes,
    /// Rows from the cell's first.
    pub down: Lanes,
    /// Phase that the projector of its head casts there, rad; NaN where it casts none.
    pub cast: Lanes,
}

/// The cell of a place that a camera does not see.
pub const NOWHERE: u32 = u32::MAX;

/// How to get from a view to a place in the volume.
#[derive(Debug, Clone, Copy)]
pub struct Ray {
    /// Direction of the line of sight, as [`RayTable`] has it.
    pub direction: [f32; 3],
    /// Inverse of the depth, 1/m.
    pub inverse_depth: f32,
}

impl Projected {
    /// A place that no camera sees.
    pub const NONE: Self =
        Self { cell: [NOWHERE; LANES], right: [0.0; LANES], down: [0.0; LANES], cast: [f32::NAN; LANES] };
}

/// Devices side by side: what [`Device::project`] does, for lines of sight of one view.
#[derive(Debug, Clone, Default)]
struct Devices {
    /// Rows of the rotation from the world.
    turn: [[Lanes; 3]; 3],
    /// The view's centre in the device's axes, m.
    centre: [Lanes; 3],
    focal: [Lanes; 2],
    principal: [Lanes; 2],
    /// `[k1, k2, p1, p2, k3]`.
    distortion: [Lanes; 5],
    /// `[3 k1, 5 k2, 7 k3]`.
    slope: [Lanes; 3],
}

impl Devices {
    fn set(&mut self, lane: usize, device: &Device, view_centre: &Point3<f64>) {
        let turn = device.world_from_device.isometry().rotation.to_rotation_matrix().inverse();
        let centre: Vector3<f64> = turn * (view_centre - device.centre());
        for row in 0..3 {
            for column in 0..3 {
                self.turn[row][column][lane] = turn[(row, column)] as f32;
            }
            self.centre[row][lane] = centre[row] as f32;
        }
        let lens = &device.lens;
        set(&mut self.focal, lane, [lens.fx, lens.fy]);
        set(&mut self.principal, lane, [lens.cx, lens.cy]);
        set(&mut self.distortion, lane, lens.distortion);
        let [k1, k2, _, _, k3] = lens.distortion;
        set(&mut self.slope, lane, [3.0 * k1, 5.0 * k2, 7.0 * k3]);
    }

    /// One coordinate of a place in the axes of a device, times the inverse depth `w`.
    #[inline(always)]
    fn axis(&self, row: usize, i: usize, d: [f32; 3], w: f32) -> f32 {
        let [x, y, z] = &self.turn[row];
        w * self.centre[row][i] + (x[i] * d[0] + y[i] * d[1] + z[i] * d[2])
    }

    /// Column and row of the place at inverse depth `w` of the line of sight along `d`; no number behind the device,
    /// where its lens folds over, and in lanes without a device.
    #[inline(always)]
    fn project(&self, d: [f32; 3], w: f32) -> [Lanes; 2] {
        let mut out = [[0.0; LANES]; 2];
        for i in 0..LANES {
            let depth = self.axis(2, i, d, w);
            let inverse = 1.0 / depth;
            let (x, y) = (self.axis(0, i, d, w) * inverse, self.axis(1, i, d, w) * inverse);
            let [k1, k2, p1, p2, k3] = &self.distortion;
            let r2 = x * x + y * y;
            let radial = 1.0 + r2 * (k1[i] + r2 * (k2[i] + r2 * k3[i]));
            let slope = 1.0 + r2 * (self.slope[0][i] + r2 * (self.slope[1][i] + r2 * self.slope[2][i]));
            let xy = 2.0 * x * y;
            let u = x * radial + p1[i] * xy + p2[i] * (r2 + 2.0 * x * x);
            let v = y * radial + p1[i] * (r2 + 2.0 * y * y) + p2[i] * xy;
            let seen = (depth > 0.0) & (slope > 0.0);
            let column = self.focal[0][i] * u + self.principal[0][i];
            out[0][i] = if seen { column } else { f32::NAN };
            out[1][i] = self.focal[1][i] * v + self.principal[1][i];
        }
        out
    }
}

fn set<const N: usize>(lanes: &mut [Lanes; N], lane: usize, values: [f64; N]) {
    for (lanes, value) in lanes.iter_mut().zip(values) {
        lanes[lane] = value as f32;
    }
}

/// Some cameras with their projectors.
#[derive(Debug, Clone, Default)]
struct Block {
    cameras: Devices,
    projectors: Devices,
    /// From panel columns to phase, rad.
    per_column: Lanes,
    /// First column and row of the region of interest.
    origin: [Lanes; 2],
    /// What is nearer to the frame's border is not seen: end of what is.
    end: [Lanes; 2],
    /// Last column and row of the padded grid of cells, px from its begin.
    last: [Lanes; 2],
    /// Cells in a row of the padded grid.
    stride: [u32; LANES],
}

/// All other cameras as seen from one view.
#[derive(Debug, Clone)]
pub struct Projection<'a> {
    /// The view's lines of sight.
    pub table: &'a RayTable,
    blocks: Vec<Block>,
}

impl<'a> Projection<'a> {
    /// From camera `view` of some, given with their regions of interest. `table` has its lines of sight.
    pub fn new<'b>(
        table: &'a RayTable,
        view: usize,
        cameras: impl ExactSizeIterator<Item = (&'b CameraProjector, Roi)> + Clone,
    ) -> Self {
        let centre = cameras.clone().nth(view).map_or_else(Point3::origin, |(pair, _)| pair.camera.centre());
        let mut blocks = vec![Block::default(); cameras.len().div_ceil(LANES)];
        for (i, (pair, roi)) in cameras.enumerate().filter(|x| x.0 != view) {
            let (block, lane) = (&mut blocks[i / LANES], i % LANES);
            block.cameras.set(lane, &pair.camera, &centre);
            block.projectors.set(lane, &pair.projector, &centre);
            block.per_column[lane] = (std::f64::consts::TAU / pair.pattern.period_px) as f32;
            let size = [pair.camera.width, pair.camera.height];
            let cells = [roi.width, roi.height].map(padded);
            for (axis, origin) in [roi.u, roi.v].into_iter().enumerate() {
                block.origin[axis][lane] = origin as f32;
                block.end[axis][lane] = size[axis] as f32 - BACKGROUND_PX;
                block.last[axis][lane] = (cells[axis] * CELL_PX - 1) as f32;
            }
            block.stride[lane] = cells[0] as u32;
        }
        Self { table, blocks }
    }

    /// Where each camera of a block of eight sees places.
    #[inline(always)]
    pub fn spots(&self, block: usize, places: &[Ray], out: &mut [Projected]) {
        let block = &self.blocks[block];
        for (out, place) in out.iter_mut().zip(places) {
            block.spots(place, out);
        }
    }
}

impl Block {
    #[inline(always)]
    fn spots(&self, place: &Ray, out: &mut Projected) {
        const PAD: f32 = PAD_PX as f32;
        let [u, v] = self.cameras.project(place.direction, place.inverse_depth);
        let [column, _] = self.projectors.project(place.direction, place.inverse_depth);
        for i in 0..LANES {
            let (x, y) = (u[i] - self.origin[0][i], v[i] - self.origin[1][i]);
            // A pixel has its row in the middle; columns are interpolated from one to the next.
            let across = (x + PAD).max(0.0).min(self.last[0][i]);
            let along = (y + (PAD + 0.5)).max(0.0).min(self.last[1][i]);
            let [column, row] = [floor(across / CELL_PX as f32), floor(along / CELL_PX as f32)];
            let seen = (u[i] >= BACKGROUND_PX)
                & (u[i] < self.end[0][i])
                & (v[i] >= BACKGROUND_PX)
                & (v[i] < self.end[1][i]);
            out.cell[i] = if seen { row as u32 * self.stride[i] + column as u32 } else { NOWHERE };
            out.right[i] = x + PAD - (column * CELL_PX as i32) as f32;
            out.down[i] = y + PAD - (row * CELL_PX as i32) as f32;
        }
        for ((cast, column), per_column) in out.cast.iter_mut().zip(column).zip(self.per_column) {
            *cast = (column + 0.5) * per_column;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{LANES, NOWHERE, Projected, Projection, Ray};
    use crate::config::Rig;
    use crate::data::Calibration;
    use crate::fringe_order::lookup::{BACKGROUND_PX, PAD_CELLS, PAD_PX, padded};
    use crate::fringe_order::patches::CELL_PX;
    use crate::kernels::region_of_interest::Roi;
    use crate::triangulate::camera_projector::CameraProjector;
    use crate::triangulate::ray_table::RayTable;
    use crate::triangulate::triangulator::Triangulator;
    use std::f64::consts::TAU;
    use std::path::Path;

    /// The shipped rig with strong lenses.
    fn pairs() -> Vec<CameraProjector> {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/rig.toml");
        let mut calibration = Calibration::nominal(&Rig::load(&path).expect("the shipped rig"));
        for head in &mut calibration.heads {
            head.projector.lens.distortion = [-0.12, 0.08, 4e-4, -3e-4, 0.01];
            for camera in &mut head.cameras {
                camera.device.lens.distortion = [-0.11, 0.09, -3e-4, 2e-4, -0.01];
            }
        }
        let pairs =
            calibration.cameras().map(|(head, camera)| CameraProjector::new(head, camera, &calibration));
        pairs.collect::<Result<_, _>>().expect("usable pairs")
    }

    #[test]
    fn all_cameras_see_places_where_they_project_them() {
        let pairs = pairs();
        let roi = Roi { u: 300, v: 200, width: 1100, height: 700 };
        let (view, table) = (1, RayTable::new(&pairs[1]));
        let triangulator = Triangulator::new(pairs[view].clone());
        let projection = Projection::new(&table, view, pairs.iter().map(|pair| (pair, roi)));
        let stride = padded(roi.width);
        let (mut seen, mut looks) = (0, 0);
        for (i, fringe) in (0..2000u32).map(|i| (i, f64::from(i) * 0.618 % 128.0)) {
            let (u, v) = (i * 37 % 1900, i * 53 % 1190);
            let Some((_, world)) = triangulator.point(u as usize, v as usize, fringe * TAU) else { continue };
            let line = table.sightline(u as usize, v as usize);
            let [inverse_depth] = projection.table.inverse_depths(&line, fringe as f32);
            if inverse_depth.is_nan() {
                continue;
            }
            let ray = Ray { direction: line.direction, inverse_depth };
            looks += 1;
            for first in (0..pairs.len()).step_by(LANES) {
                let mut spots = [Projected::NONE; 1];
                projection.spots(first / LANES, &[ray], &mut spots);
                let [spots] = spots;
                for (pair, i) in pairs[first..].iter().zip(0..LANES).filter(|x| first + x.1 != view) {
                    let Some(place) = pair.camera.project(&world) else { continue };
                    let margin = f64::from(BACKGROUND_PX) + 0.1;
                    let near = |x: f64, size: usize| x > margin && x < size as f64 - margin;
                    if !near(place[0], pair.camera.width) || !near(place[1], pair.camera.height) {
                        continue;
                    }
                    assert_ne!(spots.cell[i], NOWHERE);
                    let first_px = |cell: usize| (cell * CELL_PX) as f64 - PAD_PX as f64;
                    let (column, row) = (spots.cell[i] as usize % stride, spots.cell[i] as usize / stride);
                    let x = first_px(column) + f64::from(spots.right[i]);
                    let y = first_px(row) + f64::from(spots.down[i]);
                    let off = (x + 300.0 - place[0]).hypot(y + 200.0 - place[1]);
                    assert!(off < 0.05, "{off} px");
                    if let Some([column, _]) = pair.projector.project(&world) {
                        let off = (f64::from(spots.cast[i]) - pair.pattern.phase(column)).abs();
                        assert!(off < 0.02, "{off} rad");
                    }
                    if (0.0..1100.0).contains(&x) && (0.0..699.0).contains(&y) {
                        let cell = |x: f64| x as usize / CELL_PX + PAD_CELLS;
                        assert_eq!((column, row), (cell(x), cell(y + 0.5)), "({x}, {y})");
                        seen += 1;
                    }
                }
            }
        }
        assert!(looks > 200 && seen > 500, "{looks} places, {seen} seen");
    }
}
