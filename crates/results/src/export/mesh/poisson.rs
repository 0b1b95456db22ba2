// SPDX-License-Identifier: MIT OR Apache-2.0
//! A closed surface through the points of a merged cloud: screened Poisson reconstruction (Kazhdan, Bolitho and Hoppe,
//! SGP 2006; Kazhdan and Hoppe, ACM TOG 32(3), 2013), on a regular grid instead of an octree.
//!
//! Sought is the function f that is 1 inside of the body and 0 outside, smoothed: its gradient is that of the points'
//! normals, and at the points it is one half. That is the minimum of `|grad f + n dS|^2 + a (f - 1/2)^2 dS`, so that
//! `-lap f + a dS f = div(n dS) + a/2 dS`, here with f = 0 on the border of a box around the cloud, solved by
//! multigrid. The surface is where f has its mean over the points. It closes holes: where no camera has seen the body,
//! the surface is interpolated, and its intensity is 0.
//!
//! The points are first thinned out to one a cell. A plane of area A crosses `A / h^2 (|nx| + |ny| + |nz|)` cells of
//! side h, which gives each of them its share of the surface.

use super::Mesh;
use super::tetrahedra::{Crossing, Field, surface};
use crate::data::Cloud;
use crate::geometry::cells::{Cells, cell_of};
use rayon::prelude::*;
use std::collections::HashMap;

/// Weight of the points' places beside their normals: a in cells.
const SCREENING: f32 = 4.0;

/// Cells between the cloud and the border of the box, at least.
const MARGIN: usize = 12;

/// The most cells of a box: 0.8 GB while it is solved.
const MAX_CELLS: usize = 48 << 20;

/// Boxes are coarsened down to this many cells in their shortest direction.
const COARSEST: usize = 4;

/// The number of V-cycles that solve the equations.
const CYCLES: usize = 12;
/// Steps of Jacobi before and after the correction by each coarser grid.
const SMOOTHINGS: usize = 3;

/// Weight of a step of the smoothing, which is Jacobi's.
const DAMPING: f32 = 6.0 / 7.0;

/// Parts with fewer triangles than this share of the largest one's are left out: closed bubbles around stray points.
const LEAST_PART: f64 = 0.02;

/// The mean of the points in one cell.
#[derive(Debug, Clone, Copy)]
struct Sample {
    /// In cells, from the corner of the box.
    place: [f32; 3],
    normal: [f32; 3],
    intensity: f32,
    /// Area, in squared sides of a cell.
    area: f32,
}

/// The closed surface through a cloud with normals. An error states what is wrong with the cloud or the cells.
pub fn watertight(cloud: &Cloud, cell_m: f64) -> Result<Mesh, String> {
    let cell = cell_m as f32;
    if !(cell > 0.0) || cloud.normal.len() != cloud.len() {
        return Err(format!("cells of {cell_m} m, {} points, {} normals", cloud.len(), cloud.normal.len()));
    }
    let (grid, samples) = thin_out(cloud, cell)?;
    let mut levels = vec![Level::new(grid.size)];
    levels[0].splat(&samples);
    while let Some(coarser) = levels.last().and_then(Level::coarser) {
        levels.push(coarser);
    }
    (0..CYCLES).for_each(|_| cycle(&mut levels));
    let level = &levels[0];
    let (sum, area) = samples.iter().fold((0.0, 0.0), |(sum, area), sample| {
        let value: f32 = corners(level.size, sample.place).map(|(node, part)| part * level.f[node]).sum();
        (sum + f64::from(value * sample.area), area + f64::from(sample.area))
    });
    let field = Field { size: level.size, values: &level.f };
    let (crossings, triangles) = surface(&field, (sum / area) as f32);
    let (crossings, triangles) = large_parts(&crossings, &triangles);
    if triangles.is_empty() {
        return Err("its points enclose nothing".to_owned());
    }
    Ok(Mesh { vertices: vertices(&grid, level, &samples, &crossings), triangles })
}

/// The box around the cloud, and the size of its cells.
struct Grid {
    origin: [f32; 3],
    cell: f32,
    size: [usize; 3],
}

/// The box, and the mean of the points in each of its cells.
fn thin_out(cloud: &Cloud, cell: f32) -> Result<(Grid, Vec<Sample>), String> {
    let good = |i: &usize| {
        cloud.position_m[*i].iter().chain(&cloud.normal[*i]).all(|x| x.is_finite() && x.abs() < 1e6)
    };
    let used: Vec<usize> = (0..cloud.len()).filter(good).collect();
    let mut low = [f32::INFINITY; 3];
    let mut high = [f32::NEG_INFINITY; 3];
    for &i in &used {
        for axis in 0..3 {
            low[axis] = low[axis].min(cloud.position_m[i][axis]);
            high[axis] = high[axis].max(cloud.position_m[i][axis]);
        }
    }
    if used.is_empty() {
        return Err("there are no points".to_owned());
    }
    let mut size = [0; 3];
    for axis in 0..3 {
        let across = ((high[axis] - low[axis]) / cell).ceil().min(MAX_CELLS as f32);
        let cells = across as usize + 1 + 2 * MARGIN;
        size[axis] = cells.next_multiple_of(16);
    }
    let cells = size.iter().try_fold(1usize, |all, side| all.checked_mul(*side)).unwrap_or(usize::MAX);
    if cells > MAX_CELLS {
        return Err(format!("{size:?} cells are more than {MAX_CELLS}: give larger ones"));
    }
    let origin = std::array::from_fn(|axis| (low[axis] + high[axis]) / 2.0 - size[axis] as f32 / 2.0 * cell);
    let grid = Grid { origin, cell, size };
    let mut sums: HashMap<usize, ([f64; 7], u32)> = HashMap::new();
    for &i in &used {
        let place: [f32; 3] = std::array::from_fn(|axis| (cloud.position_m[i][axis] - origin[axis]) / cell);
        let [x, y, z] = place.map(|x| x as usize);
        let (sum, count) = sums.entry((z * size[1] + y) * size[0] + x).or_default();
        let numbers = place.iter().chain(&cloud.normal[i]).chain([&cloud.intensity[i]]);
        sum.iter_mut().zip(numbers).for_each(|(sum, x)| *sum += f64::from(*x));
        *count += 1;
    }
    let mut cells: Vec<(usize, Sample)> = sums
        .into_iter()
        .filter_map(|(cell, (sum, count))| {
            let mean = sum.map(|x| (x / f64::from(count)) as f32);
            let length = mean[3].hypot(mean[4]).hypot(mean[5]);
            // Normals of both sides of a thin part cancel each other.
            let normal = [mean[3] / length, mean[4] / length, mean[5] / length];
            let area = 1.0 / normal.iter().map(|x| x.abs()).sum::<f32>();
            let sample = Sample { place: [mean[0], mean[1], mean[2]], normal, intensity: mean[6], area };
            (length > 0.3).then_some((cell, sample))
        })
        .collect();
    // The order of a hash map differs from run to run, and sums of floats depend on it.
    cells.sort_unstable_by_key(|(cell, _)| *cell);
    Ok((grid, cells.into_iter().map(|(_, sample)| sample).collect()))
}

/// The eight nodes around a place, and their parts of it.
fn corners(size: [usize; 3], place: [f32; 3]) -> impl Iterator<Item = (usize, f32)> {
    let base = place.map(|x| x as usize);
    (0..8).map(move |corner| {
        let mut part = 1.0;
        let mut node = [0; 3];
        for axis in 0..3 {
            let upper = corner >> axis & 1;
            let fraction = place[axis] - base[axis] as f32;
            part *= if upper == 1 { fraction } else { 1.0 - fraction };
            node[axis] = base[axis] + upper;
        }
        ((node[2] * size[1] + node[1]) * size[0] + node[0], part)
    })
}

/// The equations on one grid, in its own cells: `sum over the six neighbours (f - f') + d f = b`.
struct Level {
    size: [usize; 3],
    f: Vec<f32>,
    b: Vec<f32>,
    d: Vec<f32>,
    spare: Vec<f32>,
}

impl Level {
    fn new(size: [usize; 3]) -> Self {
        let zeros = || vec![0.0; size.iter().product()];
        Self { size, f: zeros(), b: zeros(), d: zeros(), spare: zeros() }
    }

    fn splat(&mut self, samples: &[Sample]) {
        let steps = [1, self.size[0], self.size[0] * self.size[1]];
        for sample in samples {
            for (node, part) in corners(self.size, sample.place) {
                let weight = part * sample.area;
                self.d[node] += SCREENING * weight;
                self.b[node] += SCREENING * weight / 2.0;
                for (step, n) in steps.into_iter().zip(sample.normal) {
                    // Divergence by central differences: what is put into a node its neighbours see.
                    self.b[node - step] += weight * n / 2.0;
                    self.b[node + step] -= weight * n / 2.0;
                }
            }
        }
    }

    /// The next coarser grid, with the means of four times d.
    fn coarser(&self) -> Option<Self> {
        let halves = self.size.iter().all(|side| side % 2 == 0 && side / 2 >= COARSEST);
        let mut coarser = Self::new(halves.then(|| self.size.map(|side| side / 2))?);
        restrict(&self.d, self.size, &mut coarser.d);
        Some(coarser)
    }

    fn slab(&self) -> usize {
        self.size[0] * self.size[1]
    }

    /// Takes this many steps of damped Jacobi, each over all nodes.
    fn smooth(&mut self, steps: usize) {
        for _ in 0..steps {
            let (size, slab) = (self.size, self.slab());
            let (f, b, d) = (&self.f, &self.b, &self.d);
            self.spare.par_chunks_mut(slab).enumerate().for_each(|(z, out)| {
                for_each_row(size, z, |y, row| {
                    let out = &mut out[y * size[0]..][..size[0]];
                    neighbours(f, size, row, y, z, |x, i, sum| {
                        out[x] = f[i] + DAMPING * ((b[i] + sum) / (6.0 + d[i]) - f[i]);
                    });
                });
            });
            std::mem::swap(&mut self.f, &mut self.spare);
        }
    }

    /// What is left of the equations, into `spare`.
    fn residual(&mut self) {
        let (size, slab) = (self.size, self.slab());
        let (f, b, d) = (&self.f, &self.b, &self.d);
        self.spare.par_chunks_mut(slab).enumerate().for_each(|(z, out)| {
            for_each_row(size, z, |y, row| {
                let out = &mut out[y * size[0]..][..size[0]];
                neighbours(f, size, row, y, z, |x, i, sum| out[x] = b[i] + sum - (6.0 + d[i]) * f[i]);
            });
        });
    }
}

/// Calls `work` with each row of a slab and the place of its first node.
fn for_each_row(size: [usize; 3], z: usize, mut work: impl FnMut(usize, usize)) {
    (0..size[1]).for_each(|y| work(y, (z * size[1] + y) * size[0]));
}

/// Calls `work` with each node of a row and the sum of its neighbours, which are zero outside.
#[inline(always)]
fn neighbours(
    f: &[f32],
    size: [usize; 3],
    row: usize,
    y: usize,
    z: usize,
    mut work: impl FnMut(usize, usize, f32),
) {
    let [width, height, depth] = size;
    let (line, slab) = (width, width * height);
    let part = |here: bool, first: usize| if here { &f[first..first + width] } else { &[][..] };
    let around = [
        part(y > 0, row.wrapping_sub(line)),
        part(y + 1 < height, row + line),
        part(z > 0, row.wrapping_sub(slab)),
        part(z + 1 < depth, row + slab),
    ];
    let here = &f[row..row + width];
    for x in 0..width {
        let mut sum = 0.0;
        for line in around {
            sum += line.get(x).copied().unwrap_or(0.0);
        }
        if x > 0 {
            sum += here[x - 1];
        }
        if x + 1 < width {
            sum += here[x + 1];
        }
        work(x, row + x, sum);
    }
}

/// Sums of eight cells over two: four times their mean, since the squared side of a cell grows fourfold.
fn restrict(fine: &[f32], size: [usize; 3], coarse: &mut [f32]) {
    let [width, height] = [size[0] / 2, size[1] / 2];
    coarse.par_chunks_mut(width * height).enumerate().for_each(|(z, out)| {
        for (i, out) in out.iter_mut().enumerate() {
            let (x, y) = (2 * (i % width), 2 * (i / width));
            let mut sum = 0.0;
            for corner in 0..8 {
                let (dx, dy, dz) = (corner & 1, corner >> 1 & 1, corner >> 2);
                sum += fine[((2 * z + dz) * size[1] + y + dy) * size[0] + x + dx];
            }
            *out = sum / 2.0;
        }
    });
}

/// Adds the coarser grid's function, interpolated between the middles of its cells.
fn add_interpolated(fine: &mut Level, coarse: &Level) {
    let (size, half) = (fine.size, coarse.size);
    let slab = fine.slab();
    let f = &coarse.f;
    // The coarse cell around a fine one, and the next one on its side; none beyond the border.
    let near = |i: usize, end: usize| {
        let other = if i.is_multiple_of(2) { (i / 2).checked_sub(1) } else { Some(i / 2 + 1) };
        [(Some(i / 2), 0.75f32), (other.filter(|other| *other < end), 0.25)]
    };
    fine.f.par_chunks_mut(slab).enumerate().for_each(|(z, out)| {
        for y in 0..size[1] {
            for x in 0..size[0] {
                let mut sum = 0.0;
                for (cz, wz) in near(z, half[2]) {
                    for (cy, wy) in near(y, half[1]) {
                        for (cx, wx) in near(x, half[0]) {
                            if let (Some(cx), Some(cy), Some(cz)) = (cx, cy, cz) {
                                sum += wx * wy * wz * f[(cz * half[1] + cy) * half[0] + cx];
                            }
                        }
                    }
                }
                out[y * size[0] + x] += sum;
            }
        }
    });
}

/// One V-cycle of multigrid over these levels, the finest first.
fn cycle(levels: &mut [Level]) {
    let [fine, rest @ ..] = levels else { return };
    let Some(coarse) = rest.first_mut() else {
        fine.smooth(60);
        return;
    };
    fine.smooth(SMOOTHINGS);
    fine.residual();
    restrict(&fine.spare, fine.size, &mut coarse.b);
    coarse.f.fill(0.0);
    cycle(rest);
    if let Some(coarse) = rest.first() {
        add_interpolated(fine, coarse);
    }
    fine.smooth(SMOOTHINGS);
}

/// The surface without its small parts.
fn large_parts(crossings: &[Crossing], triangles: &[[u32; 3]]) -> (Vec<Crossing>, Vec<[u32; 3]>) {
    let mut parent: Vec<u32> = (0..).take(crossings.len()).collect();
    fn root(parent: &mut [u32], mut i: u32) -> u32 {
        while parent[i as usize] != i {
            parent[i as usize] = parent[parent[i as usize] as usize];
            i = parent[i as usize];
        }
        i
    }
    for &[a, b, c] in triangles {
        for other in [b, c] {
            let (a, b) = (root(&mut parent, a), root(&mut parent, other));
            parent[a.max(b) as usize] = a.min(b);
        }
    }
    let mut counts: HashMap<u32, usize> = HashMap::new();
    triangles.iter().for_each(|triangle| *counts.entry(root(&mut parent, triangle[0])).or_default() += 1);
    let least = LEAST_PART * counts.values().copied().max().unwrap_or(0) as f64;
    let mut places = vec![None; crossings.len()];
    let mut kept = Vec::new();
    for (i, crossing) in (0..).zip(crossings) {
        if counts.get(&root(&mut parent, i)).is_some_and(|count| *count as f64 >= least) {
            places[i as usize] = Some(kept.len() as u32);
            kept.push(*crossing);
        }
    }
    let place = |corners: &[u32; 3]| {
        let [a, b, c] = corners.map(|corner| places[corner as usize]);
        Some([a?, b?, c?])
    };
    (kept, triangles.iter().filter_map(place).collect())
}

/// The corners in the world, with the function's gradient as normal and the intensity of the nearest sample.
fn vertices(grid: &Grid, level: &Level, samples: &[Sample], crossings: &[Crossing]) -> Cloud {
    let size = grid.size;
    let steps = [1, size[0], size[0] * size[1]];
    let place = |node: usize| [node % size[0], node / size[0] % size[1], node / size[0] / size[1]];
    let cells = Cells::new(samples.iter().map(|sample| (cell_of(sample.place.map(f64::from), 1.0), sample)));
    let mut cloud = Cloud::default();
    for crossing in crossings {
        let (a, b, t) = (place(crossing.inside), place(crossing.outside), crossing.fraction);
        let at: [f32; 3] = std::array::from_fn(|k| a[k] as f32 + t * (b[k] as f32 - a[k] as f32));
        let slope = |node: usize, step: usize| {
            let f = |i: Option<usize>| i.and_then(|i| level.f.get(i)).copied().unwrap_or(0.0);
            f(node.checked_sub(step)) - f(node.checked_add(step))
        };
        let normal =
            steps.map(|step| (1.0 - t) * slope(crossing.inside, step) + t * slope(crossing.outside, step));
        let length = normal[0].hypot(normal[1]).hypot(normal[2]).max(f32::MIN_POSITIVE);
        cloud.position_m.push(std::array::from_fn(|k| grid.origin[k] + at[k] * grid.cell));
        cloud.normal.push(normal.map(|x| x / length));
        cloud.intensity.push(nearest(&cells, at).map_or(0.0, |sample| sample.intensity));
    }
    cloud
}

/// The nearest sample in the cells around a place.
fn nearest<'a>(cells: &Cells<&'a Sample>, at: [f32; 3]) -> Option<&'a Sample> {
    let squared = |sample: &Sample| (0..3).map(|k| (sample.place[k] - at[k]).powi(2)).sum::<f32>();
    let around = cells.around(cell_of(at.map(f64::from), 1.0));
    around.copied().min_by(|a, b| squared(a).total_cmp(&squared(b)))
}

#[cfg(test)]
mod tests {
    use super::watertight;
    use crate::data::Cloud;

    const RADIUS: f32 = 0.15;

    /// Points on a ball, without those that `hole` names.
    fn ball(points: u32, noise: f32, hole: impl Fn([f32; 3]) -> bool) -> Cloud {
        let mut cloud = Cloud::default();
        let mut state = 7u64;
        for i in 0..points {
            let z = 1.0 - 2.0 * (i as f32 + 0.5) / points as f32;
            let angle = (f64::from(i) * 2.399_963_229_728_653) as f32;
            let r = (1.0 - z * z).sqrt();
            let n = [r * angle.cos(), r * angle.sin(), z];
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            let off = noise * ((state >> 40) as f32 / (1u64 << 24) as f32 - 0.5);
            if !hole(n) {
                let (r, centre) = (RADIUS + off, [0.4, -0.1, 1.0]);
                cloud.position_m.push(std::array::from_fn(|k| centre[k] + r * n[k]));
                cloud.normal.push(n);
                cloud.intensity.push(0.5);
            }
        }
        cloud
    }

    fn volume_error(cloud: &Cloud, cell_m: f64) -> f64 {
        let mesh = watertight(cloud, cell_m).expect("a surface");
        assert_eq!(mesh.open_edges(), 0, "not watertight");
        let truth = 4.0 / 3.0 * std::f64::consts::PI * f64::from(RADIUS).powi(3);
        let error = mesh.volume_m3() / truth - 1.0;
        let off: Vec<f32> = mesh
            .vertices
            .position_m
            .iter()
            .map(|p| ((p[0] - 0.4).hypot(p[1] + 0.1).hypot(p[2] - 1.0) - RADIUS).abs())
            .collect();
        let outward = mesh
            .vertices
            .position_m
            .iter()
            .zip(&mesh.vertices.normal)
            .filter(|(p, n)| (p[0] - 0.4) * n[0] + (p[1] + 0.1) * n[1] + (p[2] - 1.0) * n[2] > 0.0)
            .count();
        println!(
            "cells {cell_m}: volume off by {:.3} %, worst corner {:.2} mm, {} triangles",
            100.0 * error,
            1e3 * off.iter().copied().fold(0.0, f32::max),
            mesh.triangles.len()
        );
        assert_eq!(outward, mesh.vertices.len(), "normals point outwards");
        error
    }

    #[test]
    fn a_ball_has_its_volume_even_with_noise_and_holes() {
        assert!(volume_error(&ball(100_000, 0.0, |_| false), 0.006).abs() < 0.005);
        assert!(volume_error(&ball(100_000, 0.0005, |_| false), 0.006).abs() < 0.005);
        // A cap of 30 degrees that no camera saw.
        assert!(volume_error(&ball(100_000, 0.0005, |n| n[2] > 0.87), 0.006).abs() < 0.03);
        // Half of it seen four times as densely.
        assert!(
            volume_error(&ball(100_000, 0.0, |n| n[0] > 0.0 && (n[1] * 1e4) as i32 % 4 != 0), 0.006).abs()
                < 0.005
        );
    }

    #[test]
    fn the_same_cloud_gives_the_same_mesh_and_nothing_gives_none() {
        let cloud = ball(20_000, 0.0005, |_| false);
        let once = || watertight(&cloud, 0.01).expect("a surface");
        assert_eq!((once().vertices, once().triangles), (once().vertices, once().triangles));
        assert!(watertight(&Cloud::default(), 0.01).is_err());
        assert!(watertight(&cloud, 0.0).is_err());
        for too_small in [1e-5, 1e-30] {
            assert!(watertight(&cloud, too_small).is_err(), "too many cells");
        }
    }
}
