//! Where all other cameras would see a place of one view, and what their projectors cast on it: eight cameras at once.
//!
//! A line of sight of the view runs from its centre `c` along `d`, at inverse depth `w` through `c + d / w`. In the axes of
//! another device that is `a + b / w`, where `a` is the same for all lines of the view and `b` is `d` turned. Only the
//! quotient of the coordinates matters, so `w a + b` does as well and there is nothing to divide by `w`. The inverse
//! depth of a fringe order is a polynomial that [`RayTable`] has. Cameras and projectors lie side by side in lanes.

use super::cells::{CELL_PX, PAD_CELLS, padded};
use crate::geometry::Device;
use crate::reconstruct::pair::Pair;
use crate::reconstruct::rays::{RayTable, Sightline};
use crate::reconstruct::roi::Roi;
use crate::reconstruct::simd;
use nalgebra::{Point3, Vector3};

/// Cameras that are worked on at once.
pub const LANES: usize = 8;

type Lanes = [f32; LANES];

/// Background must be as wide around a place, px: outlines are not sharp.
pub const BACKGROUND_PX: f32 = 10.0;

/// Where each camera of some would see a place.
#[derive(Debug, Clone, Copy)]
pub struct Spots {
    /// Column in the region of interest.
    pub x: Lanes,
    /// Row in the region of interest.
    pub y: Lanes,
    /// Cell of the padded grid; [`NOWHERE`] where the camera does not see it.
    pub cell: [u32; LANES],
    /// Columns from the cell's first.
    pub right: Lanes,
    /// Rows from the cell's first.
    pub down: Lanes,
    /// Phase that the projector of its head casts there, rad; NaN where it casts none.
    pub cast: Lanes,
}

/// No cell.
pub const NOWHERE: u32 = u32::MAX;

/// Devices side by side: what [`Device::project`] does, for lines of sight of one view.
#[derive(Debug, Clone)]
struct Devices {
    /// Rows of the rotation from the world.
    turn: [[Lanes; 3]; 3],
    /// The view's centre in the device's axes, m.
    centre: [Lanes; 3],
    focal: [Lanes; 2],
    principal: [Lanes; 2],
    /// `[k1, k2, p1, p2, k3]`.
    distortion: [Lanes; 5],
}

impl Devices {
    fn new() -> Self {
        Self {
            turn: [[[0.0; LANES]; 3]; 3],
            centre: [[0.0; LANES]; 3],
            focal: [[0.0; LANES]; 2],
            principal: [[0.0; LANES]; 2],
            distortion: [[0.0; LANES]; 5],
        }
    }

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
        self.focal = set(self.focal, lane, [lens.fx, lens.fy]);
        self.principal = set(self.principal, lane, [lens.cx, lens.cy]);
        self.distortion = set(self.distortion, lane, lens.distortion);
    }

    /// Column and row of the place at inverse depth `w` of the line of sight along `d`; no number behind the device, where
    /// its lens folds over, and in lanes without a device.
    #[inline(always)]
    fn project(&self, d: [f32; 3], w: f32) -> [Lanes; 2] {
        let mut out = [[0.0; LANES]; 2];
        for i in 0..LANES {
            let axis = |row: usize| {
                let [x, y, z] = [self.turn[row][0][i], self.turn[row][1][i], self.turn[row][2][i]];
                w * self.centre[row][i] + (x * d[0] + y * d[1] + z * d[2])
            };
            let depth = axis(2);
            let inverse = 1.0 / depth;
            let (x, y) = (axis(0) * inverse, axis(1) * inverse);
            let k = |n: usize| self.distortion[n][i];
            let r2 = x * x + y * y;
            let radial = 1.0 + r2 * (k(0) + r2 * (k(1) + r2 * k(4)));
            let slope = 1.0 + r2 * (3.0 * k(0) + r2 * (5.0 * k(1) + r2 * (7.0 * k(4))));
            let xy = 2.0 * x * y;
            let u = x * radial + k(2) * xy + k(3) * (r2 + 2.0 * x * x);
            let v = y * radial + k(2) * (r2 + 2.0 * y * y) + k(3) * xy;
            let seen = (depth > 0.0) & (slope > 0.0);
            let column = self.focal[0][i] * u + self.principal[0][i];
            out[0][i] = if seen { column } else { f32::NAN };
            out[1][i] = self.focal[1][i] * v + self.principal[1][i];
        }
        out
    }
}

fn set<const N: usize>(mut lanes: [Lanes; N], lane: usize, values: [f64; N]) -> [Lanes; N] {
    for (lanes, value) in lanes.iter_mut().zip(values) {
        lanes[lane] = value as f32;
    }
    lanes
}

/// Some cameras with their projectors.
#[derive(Debug, Clone)]
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

impl Block {
    fn new() -> Self {
        let none = [0.0; LANES];
        Self {
            cameras: Devices::new(),
            projectors: Devices::new(),
            per_column: none,
            origin: [none; 2],
            end: [none; 2],
            last: [none; 2],
            stride: [0; LANES],
        }
    }
}

/// All other cameras as seen from one view.
#[derive(Debug, Clone)]
pub struct Lookout<'a> {
    table: &'a RayTable,
    blocks: Vec<Block>,
}

impl<'a> Lookout<'a> {
    /// From camera `view` of some, given with their regions of interest. `table` has its lines of sight.
    pub fn new<'b>(
        table: &'a RayTable,
        view: usize,
        cameras: impl ExactSizeIterator<Item = (&'b Pair, Roi)> + Clone,
    ) -> Self {
        let centre = cameras.clone().nth(view).map_or_else(Point3::origin, |(pair, _)| pair.camera.centre());
        let mut blocks = vec![Block::new(); cameras.len().div_ceil(LANES)];
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

    /// The line of sight of pixel (u, v).
    pub fn sightline(&self, u: usize, v: usize) -> Sightline {
        self.table.sightline(u, v)
    }

    /// Where each camera sees the place on a line of sight at an absolute phase, in fringes: `each` gets the first camera's
    /// number with eight of them. False, and nothing, where the place is outside of the volume.
    #[inline]
    pub fn look(&self, line: &Sightline, fringes: f32, mut each: impl FnMut(usize, &Spots)) -> bool {
        let Some(w) = self.table.inverse_depth(line, fringes) else { return false };
        for (i, block) in self.blocks.iter().enumerate() {
            let spots = simd::dispatch(
                #[inline(always)]
                || block.spots(line.direction, w),
            );
            each(i * LANES, &spots);
        }
        true
    }
}

impl Block {
    #[inline(always)]
    fn spots(&self, direction: [f32; 3], w: f32) -> Spots {
        const PAD: f32 = (PAD_CELLS * CELL_PX) as f32;
        let [u, v] = self.cameras.project(direction, w);
        let [column, _] = self.projectors.project(direction, w);
        let none = [0.0; LANES];
        let mut out = Spots { x: none, y: none, cell: [0; LANES], right: none, down: none, cast: none };
        for i in 0..LANES {
            let (x, y) = (u[i] - self.origin[0][i], v[i] - self.origin[1][i]);
            // A pixel has its row in the middle; columns are interpolated from one to the next.
            let across = (x + PAD).max(0.0).min(self.last[0][i]);
            let along = (y + (PAD + 0.5)).max(0.0).min(self.last[1][i]);
            let (column, row) = (across as u32 / CELL_PX as u32, along as u32 / CELL_PX as u32);
            let seen = (u[i] >= BACKGROUND_PX)
                & (u[i] < self.end[0][i])
                & (v[i] >= BACKGROUND_PX)
                & (v[i] < self.end[1][i]);
            out.cell[i] = if seen { row * self.stride[i] + column } else { NOWHERE };
            out.right[i] = x + PAD - (column * CELL_PX as u32) as f32;
            out.down[i] = y + PAD - (row * CELL_PX as u32) as f32;
            (out.x[i], out.y[i]) = (x, y);
        }
        for i in 0..LANES {
            out.cast[i] = (column[i] + 0.5) * self.per_column[i];
        }
        out
    }
}
