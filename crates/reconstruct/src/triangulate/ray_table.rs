// SPDX-License-Identifier: MIT OR Apache-2.0
//! Points of whole rows of pixels without solving for any: what triangulation comes to, tabulated.
//!
//! Along the line of sight of one pixel the inverse of the depth is a smooth function of the panel column, nearly a
//! straight line, bent by the quotient of [`super::triangulator`] and by the projector's lens. At every node of a grid
//! of 8 px it is the polynomial of degree 5 through six exact points inside the working volume: the forward way, from
//! depth to column, needs no iteration. Between nodes its coefficients, and the direction of sight, are interpolated
//! linearly. Against the exact solution the points are off by less than 0.01 mm over the whole volume (test).

use super::camera_projector::CameraProjector;
use crate::kernels::prefetch;
use nalgebra::{Point3, Vector3};
use std::f64::consts::TAU;

/// Pixels between neighbouring nodes, along columns and rows.
pub(crate) const NODE_PX: usize = 8;

/// Pixels that are worked on at once. The compiler turns loops of this length into vectors; loops over the pixels
/// between two nodes it would unroll.
pub(crate) const BLOCK_PX: usize = 32;

/// A number for each pixel of a block.
type Block = [f32; BLOCK_PX];

/// Coefficients of the polynomial: its degree is 5, which is exact to 0.01 mm.
const TERMS: usize = 6;

/// A node: direction of sight in the world (camera z = 1), then the polynomial from its constant term on.
type Node = [f32; 3 + TERMS];

/// Columns of the panel run from -1 to 1; the polynomial is laid through points up to this far out.
const PANEL_MARGIN: f64 = 1.2;

/// Depths that are tried to find the part of a line of sight that the panel can light.
const TRIED_DEPTHS: usize = 17;

/// Lines of sight are tabulated from this depth on, m.
const NEAREST_M: f64 = 0.2;

/// The lines of sight of one camera, with what its projector's columns do on them.
#[derive(Debug)]
pub struct RayTable {
    nodes: Vec<Node>,
    /// First and last fringe that is sought at each node.
    inside: Vec<[f32; 2]>,
    columns: usize,
    /// The camera's centre and its forward axis in the world.
    pub(crate) centre: [f32; 3],
    pub(crate) forward: [f32; 3],
    /// Centre of the projector in the world.
    pub(crate) projector: [f32; 3],
    /// Focal length of the camera, px.
    pub(crate) focal_px: f32,
    /// From fringes to the panel's -1 .. 1.
    per_fringe: f32,
    /// Where surfaces are sought, the lower corner first, m.
    sought: [[f32; 3]; 2],
    /// Where points are made of surfaces.
    volume: [[f32; 3]; 2],
}

/// The lines of sight of a row, block by block of 8 px: the node of its first pixel, and what it changes by from pixel
/// to pixel. There is one node more than there are blocks.
#[derive(Debug, Default)]
pub(crate) struct Line {
    from: Vec<Node>,
    step: Vec<Node>,
}

/// The line of sight of one pixel.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Sightline {
    /// In the world, as long as it takes for a camera z of 1.
    pub direction: [f32; 3],
    /// The inverse depth over the panel's columns, from the constant term on.
    terms: [f32; TERMS],
}

impl RayTable {
    /// Tabulates a pair of camera and projector.
    pub fn new(pair: &CameraProjector) -> Self {
        let camera = pair.camera.world_from_device.isometry();
        let columns = pair.camera.width.div_ceil(NODE_PX) + 1;
        let rows = pair.camera.height.div_ceil(NODE_PX) + 1;
        let sight = Sight::new(pair);
        let node = |i: usize| {
            let (u, v) = ((i % columns * NODE_PX) as f64, (i / columns * NODE_PX) as f64);
            sight.node(u, v).unwrap_or([f32::NAN; 3 + TERMS])
        };
        let half = pair.projector.width as f64 / 2.0;
        let inside = |i: usize| fringes_sought(pair, i % columns * NODE_PX, i / columns * NODE_PX);
        Self {
            nodes: (0..columns * rows).map(node).collect(),
            inside: (0..columns * rows).map(inside).collect(),
            columns,
            centre: pair.camera.centre().cast::<f32>().coords.into(),
            forward: (camera.rotation * Vector3::z()).cast::<f32>().into(),
            projector: pair.projector.centre().cast::<f32>().coords.into(),
            focal_px: pair.camera.lens.fx as f32,
            per_fringe: (pair.pattern.period_px / half) as f32,
            sought: pair.sought_m().map(|corner| corner.map(|x| x as f32)),
            volume: [pair.volume_min_m, pair.volume_max_m].map(|corner| corner.map(|x| x as f32)),
        }
    }

    /// The line of sight of pixel (u, v) of the frame.
    pub(crate) fn sightline(&self, u: usize, v: usize) -> Sightline {
        let at = v / NODE_PX * self.columns + u / NODE_PX;
        let (s, t) = ((u % NODE_PX) as f32 / NODE_PX as f32, (v % NODE_PX) as f32 / NODE_PX as f32);
        let nodes = [at, at + 1, at + self.columns, at + self.columns + 1];
        let [a, b, c, d] = nodes.map(|at| self.nodes.get(at).unwrap_or(&[f32::NAN; 3 + TERMS]));
        let mut mixed = [0f32; 3 + TERMS];
        for (k, mixed) in mixed.iter_mut().enumerate() {
            let (above, below) = (a[k] + s * (b[k] - a[k]), c[k] + s * (d[k] - c[k]));
            *mixed = above + t * (below - above);
        }
        let [x, y, z, terms @ ..] = mixed;
        Sightline { direction: [x, y, z], terms }
    }

    /// The first and the last absolute phase, in fringes, at which the line of sight of pixel (u, v) is where surfaces
    /// are sought, to half a fringe; the first is above the last where it misses that.
    pub(crate) fn fringes_sought(&self, u: usize, v: usize) -> [f32; 2] {
        let (column, row) = ((u + NODE_PX / 2) / NODE_PX, (v + NODE_PX / 2) / NODE_PX);
        self.inside.get(row * self.columns + column).copied().unwrap_or(NOWHERE)
    }

    /// Inverse of the depth at which a line of sight has the absolute phases `first`, `first + 1`, ..., in fringes; no
    /// number where nothing is sought.
    #[inline(always)]
    pub(crate) fn inverse_depths<const N: usize>(&self, line: &Sightline, first: f32) -> [f32; N] {
        let mut inverse = [0f32; N];
        for (i, inverse) in inverse.iter_mut().enumerate() {
            let s = (first + i as f32) * self.per_fringe - 1.0;
            let mut w = line.terms[TERMS - 1];
            for terms in line.terms[..TERMS - 1].iter().rev() {
                w = w * s + terms;
            }
            let depth = 1.0 / w;
            let mut inside = (s.abs() < 1.0) & (w > 0.0);
            for (axis, direction) in line.direction.iter().enumerate() {
                let x = self.centre[axis] + depth * direction;
                inside &= (self.sought[0][axis] <= x) & (x <= self.sought[1][axis]);
            }
            *inverse = if inside { w } else { f32::NAN };
        }
        inverse
    }

    /// The lines of sight of row `v` for blocks `first .. first + blocks` of 8 px.
    #[inline(always)]
    pub(crate) fn line(&self, v: usize, first: usize, blocks: usize, line: &mut Line) {
        let above = v / NODE_PX * self.columns + first;
        let t = (v % NODE_PX) as f32 / NODE_PX as f32;
        let (a, b) = (&self.nodes[above..=above + blocks], &self.nodes[above + self.columns..]);
        // Every eighth row needs a new row of nodes: each of the rows before prefetches a part of it.
        let next = &self.nodes[self.nodes.len().min(above + 2 * self.columns)..];
        let part = blocks.div_ceil(NODE_PX);
        for node in next.iter().take(blocks + 1).skip(v % NODE_PX * part).take(part + 1) {
            prefetch::line(node);
        }
        line.from.resize(a.len(), [0.0; 3 + TERMS]);
        line.step.resize(blocks, [0.0; 3 + TERMS]);
        let from = line.from.as_flattened_mut();
        for ((to, a), b) in from.iter_mut().zip(a.as_flattened()).zip(b.as_flattened()) {
            *to = a + t * (b - a);
        }
        let ends = from.iter().zip(&from[3 + TERMS..]);
        for (step, (here, next)) in line.step.as_flattened_mut().iter_mut().zip(ends) {
            *step = (next - here) / NODE_PX as f32;
        }
    }

    /// The points of the pixels of some blocks of [`BLOCK_PX`]. `fringes`: absolute phase of each pixel in fringes,
    /// NaN where it is not known and beyond the lines of sight of `line`. All coordinates are written, NaN where there
    /// is no point; and metres along the line of sight per rad of phase, unless that is empty.
    #[inline(always)]
    pub(crate) fn points(
        &self,
        line: &Line,
        fringes: &[f32],
        [x, y, z]: [&mut [f32]; 3],
        metres_per_rad: &mut [f32],
    ) {
        let blocks = fringes.as_chunks().0;
        let (x, y, z) = (x.as_chunks_mut().0, y.as_chunks_mut().0, z.as_chunks_mut().0);
        let mut sight = [[0f32; BLOCK_PX]; 3 + TERMS];
        for (block, (((fringes, x), y), z)) in blocks.iter().zip(x).zip(y).zip(z).enumerate() {
            let fringes: &Block = fringes;
            let (x, y, z): (&mut Block, &mut Block, &mut Block) = (x, y, z);
            let mut known = 0u32;
            for fringe in fringes {
                known |= u32::from(!fringe.is_nan());
            }
            if known == 0 {
                (*x, *y, *z) = ([f32::NAN; BLOCK_PX], [f32::NAN; BLOCK_PX], [f32::NAN; BLOCK_PX]);
                continue;
            }
            line.spread(block, &mut sight);
            let [direction_x, direction_y, direction_z, terms @ ..] = &sight;
            let (mut s, mut w, mut depth) = ([0f32; BLOCK_PX], [0f32; BLOCK_PX], [0f32; BLOCK_PX]);
            for i in 0..BLOCK_PX {
                s[i] = fringes[i] * self.per_fringe - 1.0;
                w[i] = terms[TERMS - 1][i];
                for k in (0..TERMS - 1).rev() {
                    w[i] = w[i] * s[i] + terms[k][i];
                }
                depth[i] = 1.0 / w[i];
            }
            let ([x0, y0, z0], [low, high]) = (self.centre, &self.volume);
            for i in 0..BLOCK_PX {
                let px = x0 + depth[i] * direction_x[i];
                let py = y0 + depth[i] * direction_y[i];
                let pz = z0 + depth[i] * direction_z[i];
                let inside = (s[i].abs() < 1.0)
                    & (w[i] > 0.0)
                    & (px >= low[0])
                    & (px <= high[0])
                    & (py >= low[1])
                    & (py <= high[1])
                    & (pz >= low[2])
                    & (pz <= high[2]);
                x[i] = if inside { px } else { f32::NAN };
                y[i] = if inside { py } else { f32::NAN };
                z[i] = if inside { pz } else { f32::NAN };
            }
            if let Some(out) = metres_per_rad.get_mut(block * BLOCK_PX..(block + 1) * BLOCK_PX) {
                scale(&sight, (&s, &depth, self.per_fringe / TAU as f32), out);
            }
        }
    }
}

/// The pixels between two nodes.
const PLACES: [f32; NODE_PX] = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0];

impl Line {
    /// The numbers of the lines of sight of a block's pixels; what lies beyond the last node stays as it is.
    #[inline(always)]
    fn spread(&self, block: usize, sight: &mut [Block; 3 + TERMS]) {
        for node in 0..BLOCK_PX / NODE_PX {
            let place = block * (BLOCK_PX / NODE_PX) + node;
            let (Some(from), Some(step)) = (self.from.get(place), self.step.get(place)) else { break };
            for k in 0..3 + TERMS {
                let to = &mut sight[k].as_chunks_mut::<NODE_PX>().0[node];
                for i in 0..NODE_PX {
                    to[i] = from[k] + PLACES[i] * step[k];
                }
            }
        }
    }
}

/// Metres along the line of sight per rad, for a block: the slope of its polynomials at `s`.
#[inline(always)]
fn scale(c: &[Block; 3 + TERMS], (s, depth, per_rad): (&Block, &Block, f32), metres_per_rad: &mut [f32]) {
    for (i, out) in metres_per_rad.iter_mut().enumerate() {
        let slope = (((5.0 * c[8][i] * s[i] + 4.0 * c[7][i]) * s[i] + 3.0 * c[6][i]) * s[i] + 2.0 * c[5][i])
            * s[i]
            + c[4][i];
        let length = (c[0][i] * c[0][i] + c[1][i] * c[1][i] + c[2][i] * c[2][i]).sqrt();
        *out = (slope * per_rad).abs() * depth[i] * depth[i] * length;
    }
}

/// The fringes of a line of sight that misses the volume: the first is above the last.
const NOWHERE: [f32; 2] = [1.0, 0.0];

/// The fringes between which the line of sight of a pixel is where surfaces are sought, and half a fringe more at either
/// end.
fn fringes_sought(pair: &CameraProjector, u: usize, v: usize) -> [f32; 2] {
    let Some((ray, ends)) = pair.distances_sought(u, v) else { return NOWHERE };
    let all = (pair.projector.width as f64 / pair.pattern.period_px) as f32;
    let [near, far] = ends.map(|distance| {
        let column = pair.projector.project(&ray.at(distance)).map(|[column, _]| column);
        column.map(|column| (pair.pattern.phase(column) / TAU) as f32)
    });
    // Behind the projector or beyond its lens there is no column: then no fringe is left out.
    let (near, far) = near.zip(far).unwrap_or((0.0, all));
    [(near.min(far) - 0.5).max(0.0), (near.max(far) + 0.5).min(all)]
}

/// The geometry of a pair while it is tabulated.
struct Sight<'a> {
    pair: &'a CameraProjector,
    /// Inverse depths between which surfaces are sought.
    inverse: [f64; 2],
}

impl<'a> Sight<'a> {
    fn new(pair: &'a CameraProjector) -> Self {
        let [min, max] = pair.sought_m();
        let mut depths = [f64::INFINITY, 0f64];
        for corner in 0..8 {
            let side = |i: usize| if corner >> i & 1 == 0 { min[i] } else { max[i] };
            let point = Point3::new(side(0), side(1), side(2));
            let depth = pair.camera.device_point(&point).z;
            depths = [depths[0].min(depth), depths[1].max(depth)];
        }
        let [near, far] = depths.map(|depth| depth.max(NEAREST_M));
        Self { pair, inverse: [1.0 / far, 1.0 / near] }
    }

    /// The node of pixel (u, v); `None` where its line of sight does not exist or the panel cannot light it.
    fn node(&self, u: f64, v: f64) -> Option<Node> {
        let [x, y] = self.pair.camera.lens.undistort(u, v)?;
        let camera = self.pair.camera.world_from_device.isometry();
        let direction = camera.rotation * Vector3::new(x, y, 1.0);
        let centre = self.pair.camera.centre();
        let column = |inverse: f64| {
            let [u, _] = self.pair.projector.project(&(centre + direction / inverse))?;
            let column = (u + 0.5) / (self.pair.projector.width as f64 / 2.0) - 1.0;
            (column.abs() <= PANEL_MARGIN).then_some(column)
        };
        let [far, near] = self.inverse;
        let tried = |i: usize| far + (near - far) * i as f64 / (TRIED_DEPTHS - 1) as f64;
        let lit = |i: &usize| column(tried(*i)).is_some();
        let first = (0..TRIED_DEPTHS).find(lit)?;
        // A line of sight crosses the panel in one direction: what lies between two depths that it lights is lit.
        let farthest = Some(TRIED_DEPTHS - 1).filter(lit);
        let last = farthest.or_else(|| (first..TRIED_DEPTHS).take_while(lit).last())?;
        let (low, high) = (tried(first), tried(last));
        let mut at = [[0.0; 2]; TERMS];
        for (j, at) in at.iter_mut().enumerate() {
            // Chebyshev's points.
            let place = 0.5 - 0.5 * (TAU / 4.0 * (2 * j + 1) as f64 / TERMS as f64).cos();
            let inverse = low + (high - low) * place;
            *at = [column(inverse)?, inverse];
        }
        let polynomial = through(&at).filter(|terms| terms.iter().all(|x| x.is_finite()))?;
        let mut node = [0f32; 3 + TERMS];
        node[..3].copy_from_slice(direction.cast::<f32>().as_slice());
        for (to, from) in node[3..].iter_mut().zip(polynomial) {
            *to = from as f32;
        }
        Some(node)
    }
}

/// The polynomial through points (x, y), from its constant term on: divided differences after Newton, multiplied out.
fn through(points: &[[f64; 2]; TERMS]) -> Option<[f64; TERMS]> {
    let mut difference = points.map(|[_, y]| y);
    for order in 1..TERMS {
        for i in (order..TERMS).rev() {
            let span = points[i][0] - points[i - order][0];
            if span == 0.0 {
                return None;
            }
            difference[i] = (difference[i] - difference[i - 1]) / span;
        }
    }
    let mut terms = [0.0; TERMS];
    for i in (0..TERMS).rev() {
        for k in (0..TERMS).rev() {
            let below = if k > 0 { terms[k - 1] } else { 0.0 };
            terms[k] = below - points[i][0] * terms[k];
        }
        terms[0] += difference[i];
    }
    Some(terms)
}

#[cfg(test)]
mod tests {
    use super::{BLOCK_PX, Line, NODE_PX, RayTable};
    use crate::triangulate::triangulator::Triangulator;
    use crate::triangulate::triangulator::tests::strong_lenses;

    #[test]
    fn rows_agree_with_the_exact_solution_over_the_whole_volume() {
        let pair = strong_lenses();
        let (triangulator, table) = (Triangulator::new(pair.clone()), RayTable::new(&pair));
        let blocks = pair.camera.width / NODE_PX;
        let width = blocks * NODE_PX;
        let room = width.next_multiple_of(BLOCK_PX);
        let (mut line, mut worst, mut known, mut scales) = (Line::default(), 0f64, 0usize, 0f64);
        for v in (3..pair.camera.height).step_by(37) {
            table.line(v, 0, blocks, &mut line);
            for k in 0..60 {
                // Panel columns from edge to edge, shifted from pixel to pixel.
                let fringe = |u: usize, more: f32| {
                    let share = ((k as f32 + u as f32 * 0.618).fract() + k as f32) / 60.0;
                    share * (pair.projector.width as f64 / pair.pattern.period_px) as f32 + more
                };
                let points = |more: f32| {
                    let mut fringes: Vec<f32> = (0..width).map(|u| fringe(u, more)).collect();
                    fringes.resize(room, f32::NAN);
                    let mut found = [(); 4].map(|()| vec![0f32; room]);
                    let [x, y, z, scale] = &mut found;
                    table.points(&line, &fringes, [x, y, z], scale);
                    found
                };
                let ([x, y, z, scale], next) = (points(0.0), points(0.01));
                for u in (k % 7..width).step_by(7) {
                    let phase = f64::from(fringe(u, 0.0)) * std::f64::consts::TAU;
                    let exact = triangulator.point(u, v, phase).map(|(_, world)| world);
                    let Some(exact) = exact.filter(|world| pair.in_volume(world)) else { continue };
                    let found = nalgebra::Point3::new(x[u], y[u], z[u]).cast::<f64>();
                    // Rounding decides on points that lie on the volume's faces.
                    if found.x.is_nan() {
                        let outer = exact - (nalgebra::Point3::new(0.0, 0.0, 1.0) - exact) * 1e-4;
                        assert!(!pair.in_volume(&outer) || phase < 0.1, "{u} {v}: {exact} is missing");
                        continue;
                    }
                    worst = worst.max((found - exact).norm());
                    let moved = (next[0][u] - x[u]).hypot(next[1][u] - y[u]).hypot(next[2][u] - z[u]);
                    if !moved.is_nan() {
                        let ratio = moved / (0.01 * std::f32::consts::TAU * scale[u]);
                        scales = scales.max(f64::from(ratio - 1.0).abs());
                    }
                    known += 1;
                }
            }
        }
        println!("{known} points, worst {:.5} mm, scale off by {scales}", worst * 1e3);
        assert!(known > 50_000 && worst < 1e-5, "{known} points, worst {worst} m");
        assert!(scales < 0.03, "{scales}");
    }
}
