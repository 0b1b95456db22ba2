// SPDX-License-Identifier: MIT OR Apache-2.0
//! Triangle meshes: the surface that is ray cast, and therefore the truth.

use std::collections::HashMap;

/// A triangle mesh in world coordinates, metres; vertices of a triangle counter-clockwise from outside.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Mesh {
    /// Positions of the vertices, world, m.
    pub positions: Vec<[f32; 3]>,
    /// Outward unit normals per vertex, for shading.
    pub normals: Vec<[f32; 3]>,
    /// Albedo per vertex relative to the subject's (1: the same).
    pub albedo: Vec<f32>,
    pub triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// The corners of triangle `t`.
    pub fn corners(&self, t: usize) -> [[f32; 3]; 3] {
        self.triangles[t].map(|vertex| self.positions[vertex as usize])
    }

    /// Scales it by a factor, about a point of the floor, m.
    pub fn scale(&mut self, [x, y]: [f64; 2], times: f64) {
        let about = [x as f32, y as f32, 0.0];
        for position in &mut self.positions {
            *position = std::array::from_fn(|i| about[i] + times as f32 * (position[i] - about[i]));
        }
    }

    /// Enclosed volume, m3 (divergence theorem); meaningful for closed meshes only.
    pub fn volume(&self) -> f64 {
        let tetrahedron = |t: usize| {
            let [a, b, c] = self.corners(t).map(|p| nalgebra::Vector3::from(p.map(f64::from)));
            a.dot(&b.cross(&c)) / 6.0
        };
        (0..self.triangles.len()).map(tetrahedron).sum()
    }

    /// Number of directed edges without exactly one opposite: 0 for a closed, consistently turned mesh.
    pub fn open_edges(&self) -> usize {
        let mut balance: HashMap<(u32, u32), [u32; 2]> = HashMap::new();
        for &[a, b, c] in &self.triangles {
            for (from, to) in [(a, b), (b, c), (c, a)] {
                balance.entry((from.min(to), from.max(to))).or_default()[usize::from(from < to)] += 1;
            }
        }
        balance.values().filter(|&&counts| counts != [1, 1]).count()
    }

    /// Lowest and highest coordinates; `None` for an empty mesh.
    pub fn bounds(&self) -> Option<([f32; 3], [f32; 3])> {
        let first = *self.positions.first()?;
        Some(self.positions.iter().fold((first, first), |(low, high), p| {
            (std::array::from_fn(|a| low[a].min(p[a])), std::array::from_fn(|a| high[a].max(p[a])))
        }))
    }

    /// Sets the normals to the area-weighted mean of the triangles around each vertex.
    pub fn compute_normals(&mut self) {
        let mut sums = vec![nalgebra::Vector3::<f32>::zeros(); self.positions.len()];
        for t in 0..self.triangles.len() {
            let [a, b, c] = self.corners(t).map(nalgebra::Vector3::from);
            let normal = (b - a).cross(&(c - a));
            for vertex in self.triangles[t] {
                sums[vertex as usize] += normal;
            }
        }
        let unit = |n: &nalgebra::Vector3<f32>| {
            n.try_normalize(f32::MIN_POSITIVE).unwrap_or_else(nalgebra::Vector3::z).into()
        };
        self.normals = sums.iter().map(unit).collect();
    }
}
