// SPDX-License-Identifier: MIT OR Apache-2.0
//! An implicit field to a closed triangle mesh: marching cubes (Lorensen and Cline 1987) in the blocks that
//! the surface crosses, then every vertex moved onto the exact surface by Newton steps.
//!
//! The case table is derived rather than typed: on each face of a cube the crossed edges are joined so that
//! inside corners stay apart, which depends on that face alone; neighbouring cubes agree, the mesh closes.

use super::implicit::{Field, Group};
use super::mesh::Mesh;
use nalgebra::{Point3, Vector3};
use rayon::prelude::{IndexedParallelIterator, IntoParallelIterator, ParallelIterator};
use std::collections::HashMap;
use std::hash::{BuildHasherDefault, Hasher};
use std::sync::LazyLock;

/// Cells along a block's side, and blocks along a coarse block's side.
const BLOCK: i32 = 8;
const COARSE: i32 = 4;

/// Corner c of a cell sits at (c & 1, c >> 1 & 1, c >> 2). Edge: axis, and the corner where it begins.
const EDGES: [(usize, usize); 12] = [
    (0, 0),
    (0, 2),
    (0, 4),
    (0, 6), //
    (1, 0),
    (1, 1),
    (1, 4),
    (1, 5), //
    (2, 0),
    (2, 1),
    (2, 2),
    (2, 3),
];

/// Corners of each face, counter-clockwise as seen from outside the cell.
const FACES: [[usize; 4]; 6] =
    [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];

/// Triangles (as numbers into `EDGES`) for each of the 256 sets of inside corners.
static CASES: LazyLock<Vec<Vec<[u8; 3]>>> = LazyLock::new(|| (0..256).map(case_triangles).collect());

fn edge_between(a: usize, b: usize) -> usize {
    let (low, axis) = (a.min(b), (a ^ b).trailing_zeros() as usize);
    EDGES.iter().position(|&edge| edge == (axis, low)).expect("two neighbouring corners share an edge")
}

fn case_triangles(case: usize) -> Vec<[u8; 3]> {
    let inside = |corner: usize| case >> corner & 1 == 1;
    let mut next = [usize::MAX; 12];
    for face in FACES {
        for i in 0..4 {
            let (a, b) = (face[i], face[(i + 1) % 4]);
            if inside(a) || !inside(b) {
                continue;
            }
            // Walked into the inside through edge a-b; join it to the edge where this stretch ends.
            let mut j = (i + 1) % 4;
            while inside(face[(j + 1) % 4]) {
                j = (j + 1) % 4;
            }
            next[edge_between(a, b)] = edge_between(face[j], face[(j + 1) % 4]);
        }
    }
    let mut triangles = Vec::new();
    let mut done = [false; 12];
    for start in 0..12 {
        if next[start] == usize::MAX || done[start] {
            continue;
        }
        let mut ring = Vec::new();
        let mut edge = start;
        while !done[edge] {
            done[edge] = true;
            ring.push(edge);
            edge = next[edge];
        }
        triangles.extend(fan(&ring));
    }
    triangles
}

/// A fan over the ring from an apex whose diagonals do not lie in a face of the cell: such a diagonal could be
/// the neighbouring cell's as well, and four triangles would meet there.
fn fan(ring: &[usize]) -> Vec<[u8; 3]> {
    let on_face = |edge: usize, face: &[usize; 4]| {
        let (axis, low) = EDGES[edge];
        face.contains(&low) && face.contains(&(low | 1 << axis))
    };
    let share_a_face = |a: usize, b: usize| FACES.iter().any(|face| on_face(a, face) && on_face(b, face));
    let n = ring.len();
    let diagonals_in_faces =
        |apex: usize| (2..n - 1).filter(|&k| share_a_face(ring[apex], ring[(apex + k) % n])).count();
    let apex = (0..n).min_by_key(|&apex| diagonals_in_faces(apex)).unwrap_or(0);
    let at = |k: usize| ring[(apex + k) % n] as u8;
    (1..n - 1).map(|k| [at(0), at(k), at(k + 1)]).collect()
}

/// Marks a grid edge: cell coordinates of its lower end, and its axis.
type EdgeKey = (i32, i32, i32, u8);

/// Keys are well spread already after one multiplication per part.
#[derive(Default)]
struct KeyHasher(u64);

impl Hasher for KeyHasher {
    fn finish(&self) -> u64 {
        self.0 ^ self.0 >> 29
    }

    fn write(&mut self, bytes: &[u8]) {
        for &byte in bytes {
            self.write_u8(byte);
        }
    }

    fn write_u8(&mut self, value: u8) {
        self.0 = (self.0.rotate_left(21) ^ u64::from(value)).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    }

    fn write_i32(&mut self, value: i32) {
        self.0 = (self.0.rotate_left(21) ^ value as u32 as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    }
}

/// One block's share of the surface.
struct Patch {
    groups: Vec<Group>,
    triangles: Vec<[EdgeKey; 3]>,
}

/// The surface of `groups` as a closed mesh of about `cell_m` resolution. The mesh's normals point outwards;
/// its albedo is 1 everywhere. The same for any number of threads.
pub fn polygonize(field: Field<'_>, groups: &[Group], cell_m: f64) -> Mesh {
    let coarse_side = COARSE * BLOCK;
    let (low, high) = coarse_range(&field, cell_m * f64::from(coarse_side));
    let blocks: Vec<[i32; 3]> = (low[2]..high[2])
        .flat_map(|z| (low[1]..high[1]).flat_map(move |y| (low[0]..high[0]).map(move |x| [x, y, z])))
        .collect();
    let patches: Vec<Vec<Patch>> =
        blocks.into_par_iter().map(|block| coarse_block(&field, groups, cell_m, block)).collect();
    assemble(&field, cell_m, &patches.into_iter().flatten().collect::<Vec<_>>())
}

fn coarse_range(field: &Field<'_>, side_m: f64) -> ([i32; 3], [i32; 3]) {
    let mut range = ([i32::MAX; 3], [i32::MIN; 3]);
    for cone in field.cones {
        let (centre, radius) = cone.bound();
        for axis in 0..3 {
            range.0[axis] = range.0[axis].min(((centre[axis] - radius) / side_m).floor() as i32);
            range.1[axis] = range.1[axis].max(((centre[axis] + radius) / side_m).floor() as i32 + 1);
        }
    }
    range
}

fn coarse_block(field: &Field<'_>, groups: &[Group], cell_m: f64, at: [i32; 3]) -> Vec<Patch> {
    let side = COARSE * BLOCK;
    let Some(groups) = crossing(field, groups, cell_m, at.map(|x| x * side), side) else { return Vec::new() };
    let mut patches = Vec::new();
    for z in 0..COARSE {
        for y in 0..COARSE {
            for x in 0..COARSE {
                let from = [at[0] * COARSE + x, at[1] * COARSE + y, at[2] * COARSE + z].map(|i| i * BLOCK);
                if let Some(groups) = crossing(field, &groups, cell_m, from, BLOCK) {
                    let triangles = block_triangles(field, &groups, cell_m, from);
                    if !triangles.is_empty() {
                        patches.push(Patch { groups, triangles });
                    }
                }
            }
        }
    }
    patches
}

/// The groups that matter in the block of `side` cells from `from`, if the surface may cross it.
fn crossing(
    field: &Field<'_>,
    groups: &[Group],
    cell_m: f64,
    from: [i32; 3],
    side: i32,
) -> Option<Vec<Group>> {
    let centre = Point3::from(from.map(|i| (f64::from(i) + f64::from(side) / 2.0) * cell_m));
    let radius = f64::from(side) / 2.0 * cell_m * 3f64.sqrt();
    let groups = field.cull(groups, &centre, radius);
    (field.value(&groups, &centre).abs() <= radius).then_some(groups)
}

fn block_triangles(field: &Field<'_>, groups: &[Group], cell_m: f64, from: [i32; 3]) -> Vec<[EdgeKey; 3]> {
    const N: usize = BLOCK as usize + 1;
    let mut inside = [false; N * N * N];
    let mut count = 0;
    for (i, corner) in inside.iter_mut().enumerate() {
        let offset = [i % N, i / N % N, i / (N * N)];
        let p: [f64; 3] = std::array::from_fn(|a| (f64::from(from[a]) + offset[a] as f64) * cell_m);
        *corner = field.value(groups, &p.into()) < 0.0;
        count += usize::from(*corner);
    }
    let mut triangles = Vec::new();
    if count == 0 || count == N * N * N {
        return triangles;
    }
    let cells = BLOCK as usize;
    for cell in 0..cells.pow(3) {
        let c = [cell % cells, cell / cells % cells, cell / (cells * cells)];
        let corner =
            |k: usize| inside[(c[0] + (k & 1)) + N * ((c[1] + (k >> 1 & 1)) + N * (c[2] + (k >> 2)))];
        let case = (0..8).fold(0, |case, k| case | usize::from(corner(k)) << k);
        let key = |edge: u8| -> EdgeKey {
            let (axis, low) = EDGES[edge as usize];
            let at = |a: usize| from[a] + c[a] as i32 + (low >> a & 1) as i32;
            (at(0), at(1), at(2), axis as u8)
        };
        triangles.extend(CASES[case].iter().map(|triangle| triangle.map(key)));
    }
    triangles
}

fn assemble(field: &Field<'_>, cell_m: f64, patches: &[Patch]) -> Mesh {
    let count: usize = patches.iter().map(|patch| patch.triangles.len()).sum();
    let mut numbers: HashMap<EdgeKey, u32, BuildHasherDefault<KeyHasher>> =
        HashMap::with_capacity_and_hasher(count / 2 + 16, BuildHasherDefault::default());
    let mut vertices: Vec<(EdgeKey, u32)> = Vec::with_capacity(count / 2 + 16);
    let mut triangles = Vec::with_capacity(count);
    for (p, patch) in patches.iter().enumerate() {
        for triangle in &patch.triangles {
            triangles.push(triangle.map(|key| {
                *numbers.entry(key).or_insert_with(|| {
                    vertices.push((key, p as u32));
                    vertices.len() as u32 - 1
                })
            }));
        }
    }
    let placed: Vec<([f32; 3], [f32; 3])> = vertices
        .into_par_iter()
        .with_min_len(512)
        .map(|(key, patch)| place(field, &patches[patch as usize].groups, cell_m, key))
        .collect();
    let (positions, normals): (Vec<_>, Vec<_>) = placed.into_iter().unzip();
    let albedo = vec![1.0; positions.len()];
    Mesh { positions, normals, albedo, triangles }
}

/// The surface point near a crossed grid edge, and its outward normal.
fn place(field: &Field<'_>, groups: &[Group], cell_m: f64, key: EdgeKey) -> ([f32; 3], [f32; 3]) {
    let start = Point3::from([key.0, key.1, key.2].map(|i| f64::from(i) * cell_m));
    let mut step = Vector3::zeros();
    step[usize::from(key.3)] = cell_m;
    let (a, b) = (field.value(groups, &start), field.value(groups, &(start + step)));
    let share = if a != b { (a / (a - b)).clamp(0.0, 1.0) } else { 0.5 };
    let mut p = start + step * share;
    let mut normal = Vector3::z();
    for round in 0..4 {
        let (value, gradient) = field.value_and_gradient(groups, &p);
        let slope = gradient.norm_squared();
        if !(slope > 1e-12) {
            break;
        }
        normal = gradient / slope.sqrt();
        if round == 3 || value.abs() < 1e-7 {
            break;
        }
        p -= (gradient * (value / slope)).cap_magnitude(cell_m / 2.0);
    }
    (p.coords.map(|x| x as f32).into(), normal.map(|x| x as f32).into())
}

#[cfg(test)]
mod tests {
    use super::{CASES, polygonize};
    use crate::scene::implicit::{ConeShape, Field, Group, RoundedCone};
    use nalgebra::Isometry3;

    #[test]
    fn every_case_joins_each_crossed_edge_once() {
        for (case, triangles) in CASES.iter().enumerate() {
            let crossed = super::EDGES
                .iter()
                .filter(|(axis, low)| case >> low & 1 != case >> (low | 1 << axis) & 1)
                .count();
            let mut used: Vec<u8> = triangles.iter().flatten().copied().collect();
            used.sort_unstable();
            used.dedup();
            assert_eq!(used.len(), crossed, "case {case}");
        }
    }

    #[test]
    fn a_ball_has_its_volume_and_closes() {
        let shape = ConeShape { ends: [[0.1, 0.2, 0.3]; 2], radii: [0.15; 2], flatten: [1.0; 3] };
        let cones = [RoundedCone::new(&shape, &Isometry3::identity())];
        let mesh = polygonize(Field { cones: &cones }, &[Group { blend_m: 0.01, cones: vec![0] }], 0.006);
        let exact = 4.0 / 3.0 * std::f64::consts::PI * 0.15f64.powi(3);
        let volume = mesh.volume();
        assert!((volume / exact - 1.0).abs() < 1e-3, "{volume} expected {exact}");
        assert_eq!(mesh.open_edges(), 0);
        let radius =
            |p: &[f32; 3]| ((p[0] - 0.1).powi(2) + (p[1] - 0.2).powi(2) + (p[2] - 0.3).powi(2)).sqrt() - 0.15;
        assert!(mesh.positions.iter().all(|p| radius(p).abs() < 1e-6));
    }
}
