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

/// Places in the cells of some cameras.
#[derive(Debug, Clone, Copy)]
pub struct InCells {
    /// Cell of the padded grid; [`NOWHERE`] where the camera does not see it.
    pub cell: [u32; LANES],
    /// Columns from the cell's first.
    pub right: Lanes,
    /// Rows from the cell's first.
    pub down: Lanes,
}

/// Where each camera of some would see a place.
#[derive(Debug, Clone, Copy)]
pub struct Projected {
    /// The place in the camera's cells.
    pub at: InCells,
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

impl InCells {
    const NONE: Self = Self { cell: [NOWHERE; LANES], right: [0.0; LANES], down: [0.0; LANES] };
}

impl Projected {
    /// A place that no camera sees.
    pub const NONE: Self = Self { at: InCells::NONE, cast: [f32::NAN; LANES] };
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

    /// A direction in the axes of each device.
    #[inline(always)]
    fn turned(&self, d: [f32; 3]) -> [Lanes; 3] {
        let mut out = [[0.0; LANES]; 3];
        for (out, [x, y, z]) in out.iter_mut().zip(&self.turn) {
            for i in 0..LANES {
                out[i] = x[i] * d[0] + y[i] * d[1] + z[i] * d[2];
            }
        }
        out
    }

    /// Column and row of the places at inverse depths `w` of the line of sight along a direction that is [turned
    /// ](Self::turned); no number behind the device, where its lens folds over, and in lanes without a device.
    #[inline(always)]
    fn project(&self, turned: &[Lanes; 3], w: &Lanes) -> [Lanes; 2] {
        let mut out = [[0.0; LANES]; 2];
        for i in 0..LANES {
            // Times the inverse depth: only quotients matter.
            let [x, y, depth] = [0, 1, 2].map(
                #[inline(always)]
                |axis: usize| w[i] * self.centre[axis][i] + turned[axis][i],
            );
            let inverse = 1.0 / depth;
            let (x, y) = (x * inverse, y * inverse);
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
    /// Another camera of the same head, the same in all lanes: for as many places at once.
    mate: Option<(usize, Block)>,
}

impl<'a> Projection<'a> {
    /// From camera `view` of some, given with their regions of interest and their heads. `table` has its lines of sight.
    pub fn new<'b>(
        table: &'a RayTable,
        view: usize,
        cameras: impl ExactSizeIterator<Item = (&'b CameraProjector, Roi, usize)> + Clone,
    ) -> Self {
        let own = cameras.clone().nth(view);
        let centre = own.map_or_else(Point3::origin, |(pair, ..)| pair.camera.centre());
        let mut blocks = vec![Block::default(); cameras.len().div_ceil(LANES)];
        let mut mate = None;
        for (i, (pair, roi, head)) in cameras.enumerate().filter(|x| x.0 != view) {
            blocks[i / LANES].set(i % LANES, (pair, roi), &centre);
            if mate.is_none() && own.is_some_and(|own| own.2 == head) {
                let mut block = Block::default();
                (0..LANES).for_each(|lane| block.set(lane, (pair, roi), &centre));
                mate = Some((i, block));
            }
        }
        Self { table, blocks, mate }
    }

    /// The number of another camera of the same head, if there is one.
    pub fn mate(&self) -> Option<usize> {
        self.mate.as_ref().map(|mate| mate.0)
    }

    /// Where the [mate](Self::mate) sees the places at these inverse depths, 1/m, of the line of sight along a
    /// direction.
    #[inline(always)]
    pub fn at_mate(&self, direction: [f32; 3], inverse_depths: &Lanes) -> InCells {
        let mut at = InCells::NONE;
        if let Some((_, block)) = &self.mate {
            block.find(&block.cameras.turned(direction), inverse_depths, &mut at);
        }
        at
    }

    /// Where each camera of a block of eight sees places.
    #[inline(always)]
    pub fn spots(&self, block: usize, places: &[Ray], out: &mut [Projected]) {
        let block = &self.blocks[block];
        let Some(first) = places.first() else { return };
        let turned = |d: [f32; 3]| [block.cameras.turned(d), block.projectors.turned(d)];
        // Most places lie on one line of sight.
        let (mut direction, mut devices) = (first.direction, turned(first.direction));
        for (out, place) in out.iter_mut().zip(places) {
            if place.direction != direction {
                direction = place.direction;
                devices = turned(direction);
            }
            let w = [place.inverse_depth; LANES];
            block.find(&devices[0], &w, &mut out.at);
            let [column, _] = block.projectors.project(&devices[1], &w);
            for ((cast, column), per_column) in out.cast.iter_mut().zip(column).zip(block.per_column) {
                *cast = (column + 0.5) * per_column;
            }
        }
    }
}

impl Block {
    fn set(&mut self, lane: usize, (pair, roi): (&CameraProjector, Roi), view_centre: &Point3<f64>) {
        self.cameras.set(lane, &pair.camera, view_centre);
        self.projectors.set(lane, &pair.projector, view_centre);
        self.per_column[lane] = (std::f64::consts::TAU / pair.pattern.period_px) as f32;
        let size = [pair.camera.width, pair.camera.height];
        let cells = [roi.width, roi.height].map(padded);
        for (axis, origin) in [roi.u, roi.v].into_iter().enumerate() {
            self.origin[axis][lane] = origin as f32;
            self.end[axis][lane] = size[axis] as f32 - BACKGROUND_PX;
            self.last[axis][lane] = (cells[axis] * CELL_PX - 1) as f32;
        }
        self.stride[lane] = cells[0] as u32;
    }

    /// The places of a line of sight, at an inverse depth for each camera, in the cameras' cells.
    #[inline(always)]
    fn find(&self, turned: &[Lanes; 3], w: &Lanes, out: &mut InCells) {
        const PAD: f32 = PAD_PX as f32;
        let [u, v] = self.cameras.project(turned, w);
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
        let projection = Projection::new(&table, view, pairs.iter().map(|pair| (pair, roi, 0)));
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
                    assert_ne!(spots.at.cell[i], NOWHERE);
                    let first_px = |cell: usize| (cell * CELL_PX) as f64 - PAD_PX as f64;
                    let (column, row) =
                        (spots.at.cell[i] as usize % stride, spots.at.cell[i] as usize / stride);
                    let x = first_px(column) + f64::from(spots.at.right[i]);
                    let y = first_px(row) + f64::from(spots.at.down[i]);
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
