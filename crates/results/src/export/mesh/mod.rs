// SPDX-License-Identifier: MIT OR Apache-2.0
//! Clouds to triangle meshes: on the pixel grid of each camera, where holes stay holes, and closed.

mod grid;
mod poisson;
mod tetrahedra;

pub use grid::{GridLimits, on_grid};
pub use poisson::watertight;

use crate::data::Cloud;

/// Which kind of mesh is made of clouds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum MeshKind {
    /// Triangles between neighbouring pixels of each camera.
    Grid(GridLimits),
    /// One closed surface of the merged cloud.
    Watertight {
        /// Side of the cells that the surface is found on, metres.
        cell_m: f64,
    },
}

impl std::fmt::Display for MeshKind {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Grid(limits) => write!(f, "grid, stretch {}", limits.stretch),
            Self::Watertight { cell_m } => write!(f, "watertight, cells of {:.3} mm", 1e3 * cell_m),
        }
    }
}

/// Triangles between the points of a cloud.
#[derive(Debug, Clone, Default)]
pub struct Mesh {
    pub vertices: Cloud,
    /// Places in the corners, counter-clockwise as seen from outside.
    pub triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// Appends the mesh of camera number `camera`.
    pub fn append(&mut self, other: &Self, camera: u8) {
        // More points than 32 bits count do not fit into memory.
        let first = self.vertices.len() as u32;
        self.vertices.merge(&other.vertices, camera);
        self.triangles.extend(other.triangles.iter().map(|corners| corners.map(|corner| first + corner)));
    }
}

#[cfg(test)]
impl Mesh {
    /// Enclosed volume of a closed mesh, cubic metres (negative if it is inside out).
    pub fn volume_m3(&self) -> f64 {
        let six = self.triangles.iter().map(|&corners| {
            let [a, b, c] = corners.map(|i| self.vertices.position_m[i as usize].map(f64::from));
            a[0] * (b[1] * c[2] - b[2] * c[1])
                + a[1] * (b[2] * c[0] - b[0] * c[2])
                + a[2] * (b[0] * c[1] - b[1] * c[0])
        });
        six.sum::<f64>() / 6.0
    }

    /// Number of edges that do not belong to exactly two triangles, once in each direction: zero in a watertight mesh.
    pub fn open_edges(&self) -> usize {
        let mut directed: Vec<(u32, u32)> =
            self.triangles.iter().flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)]).collect();
        directed.sort_unstable();
        let twice = directed.windows(2).filter(|pair| pair[0] == pair[1]).count();
        let open = directed.iter().filter(|(a, b)| directed.binary_search(&(*b, *a)).is_err()).count();
        twice + open
    }
}
