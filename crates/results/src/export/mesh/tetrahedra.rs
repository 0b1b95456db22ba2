// SPDX-License-Identifier: MIT OR Apache-2.0
//! The surface where numbers on a grid cross a level, by marching tetrahedra: each cube of eight nodes is cut into
//! six tetrahedra that share a diagonal, in the same way everywhere, so that the triangles of neighbours meet and
//! every edge belongs to exactly two of them, as long as the grid's border lies below the level.

use std::collections::HashMap;

/// Numbers on the nodes of a grid, x fastest.
pub(super) struct Field<'a> {
    pub(super) size: [usize; 3],
    pub(super) values: &'a [f32],
}

impl Field<'_> {
    fn node(&self, x: usize, y: usize, z: usize) -> usize {
        (z * self.size[1] + y) * self.size[0] + x
    }
}

/// A point on an edge between two nodes: the node above the level, that below it, and how far from the first, 0 to 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Crossing {
    pub(super) inside: usize,
    pub(super) outside: usize,
    pub(super) fraction: f32,
}

/// Points keep this distance from the ends of their edge: those of different edges never meet, so that no triangle is
/// without area.
const NEAREST: f32 = 0.002;

/// Corners of a cube (bits: x, y, z) of its tetrahedra, each oriented so that its last three turn counter-clockwise
/// seen from outside.
const TETRAHEDRA: [[usize; 4]; 6] =
    [[0, 1, 3, 7], [0, 2, 6, 7], [0, 4, 5, 7], [0, 5, 1, 7], [0, 3, 2, 7], [0, 6, 4, 7]];

/// Even permutations that bring one corner to the front, and a pair.
const FIRST: [[usize; 4]; 4] = [[0, 1, 2, 3], [1, 0, 3, 2], [2, 3, 0, 1], [3, 2, 1, 0]];
const PAIRS: [[usize; 4]; 6] =
    [[0, 1, 2, 3], [2, 3, 0, 1], [0, 2, 3, 1], [1, 3, 2, 0], [0, 3, 1, 2], [1, 2, 0, 3]];

/// The surface between nodes whose number is at least `level` (inside) and the others. Triangles turn counter-clockwise
/// seen from outside.
pub(super) fn surface(field: &Field<'_>, level: f32) -> (Vec<Crossing>, Vec<[u32; 3]>) {
    let mut found =
        Surface { field, level, numbers: HashMap::new(), crossings: Vec::new(), triangles: Vec::new() };
    let [width, height, depth] = field.size;
    for z in 1..depth {
        for y in 1..height {
            for x in 1..width {
                let corners: [usize; 8] = std::array::from_fn(|corner| {
                    field.node(x - 1 + (corner & 1), y - 1 + (corner >> 1 & 1), z - 1 + (corner >> 2))
                });
                let inside = corners.iter().filter(|&&node| found.is_inside(node)).count();
                if inside != 0 && inside != 8 {
                    TETRAHEDRA
                        .iter()
                        .for_each(|tetrahedron| found.cut(tetrahedron.map(|corner| corners[corner])));
                }
            }
        }
    }
    (found.crossings, found.triangles)
}

struct Surface<'a> {
    field: &'a Field<'a>,
    level: f32,
    /// Places of the crossings by their edge.
    numbers: HashMap<(usize, usize), u32>,
    crossings: Vec<Crossing>,
    triangles: Vec<[u32; 3]>,
}

impl Surface<'_> {
    fn is_inside(&self, node: usize) -> bool {
        self.field.values[node] >= self.level
    }

    fn cut(&mut self, nodes: [usize; 4]) {
        let inside = nodes.map(|node| self.is_inside(node));
        match inside.iter().filter(|inside| **inside).count() {
            1 => {
                let place = inside.iter().position(|inside| *inside).unwrap_or(0);
                let [a, b, c, d] = FIRST[place].map(|corner| nodes[corner]);
                let triangle = [self.crossing(a, b), self.crossing(a, c), self.crossing(a, d)];
                self.triangles.push(triangle);
            }
            3 => {
                let place = inside.iter().position(|inside| !*inside).unwrap_or(0);
                let [a, b, c, d] = FIRST[place].map(|corner| nodes[corner]);
                let triangle = [self.crossing(b, a), self.crossing(d, a), self.crossing(c, a)];
                self.triangles.push(triangle);
            }
            2 => {
                let pair = PAIRS.iter().find(|pair| inside[pair[0]] && inside[pair[1]]);
                let [a, b, c, d] = pair.unwrap_or(&PAIRS[0]).map(|corner| nodes[corner]);
                let ac = self.crossing(a, c);
                let ad = self.crossing(a, d);
                let bd = self.crossing(b, d);
                let bc = self.crossing(b, c);
                self.triangles.extend([[ac, ad, bd], [ac, bd, bc]]);
            }
            _ => {}
        }
    }

    /// The number of the point between an inside and an outside node.
    fn crossing(&mut self, inside: usize, outside: usize) -> u32 {
        let (values, level) = (self.field.values, self.level);
        let crossings = &mut self.crossings;
        *self.numbers.entry((inside, outside)).or_insert_with(|| {
            let (high, low) = (values[inside], values[outside]);
            let fraction = ((high - level) / (high - low)).clamp(NEAREST, 1.0 - NEAREST);
            crossings.push(Crossing { inside, outside, fraction });
            // The grid has fewer edges at the level than 32 bits count: memory for its nodes ends first.
            (crossings.len() - 1) as u32
        })
    }
}

#[cfg(test)]
mod tests {
    use super::{Field, surface};
    use crate::data::Cloud;
    use crate::export::mesh::Mesh;
    use proptest::prelude::{prop_assert, prop_assert_eq, proptest};

    fn mesh(size: [usize; 3], values: &[f32], level: f32) -> Mesh {
        let (crossings, triangles) = surface(&Field { size, values }, level);
        let place = |node: usize| [node % size[0], node / size[0] % size[1], node / size[0] / size[1]];
        let point = |crossing: &super::Crossing| {
            let (a, b) = (place(crossing.inside), place(crossing.outside));
            std::array::from_fn(|k| a[k] as f32 + crossing.fraction * (b[k] as f32 - a[k] as f32))
        };
        let position_m = crossings.iter().map(point).collect();
        Mesh { vertices: Cloud { position_m, ..Cloud::default() }, triangles }
    }

    #[test]
    fn a_ball_has_its_volume_and_no_open_edge() {
        let size = [24, 25, 26];
        let values: Vec<f32> = (0..size[0] * size[1] * size[2])
            .map(|i| {
                let (x, y, z) = (i % 24, i / 24 % 25, i / 600);
                9.0 - (x as f32 - 11.3).hypot(y as f32 - 12.1).hypot(z as f32 - 12.7)
            })
            .collect();
        let ball = mesh(size, &values, 0.0);
        let volume = 4.0 / 3.0 * std::f64::consts::PI * 729.0;
        assert!((ball.volume_m3() / volume - 1.0).abs() < 0.01, "{}", ball.volume_m3());
        assert_eq!(ball.open_edges(), 0);
    }

    proptest! {
        /// Whatever the numbers, the surface is closed and encloses something.
        #[test]
        fn any_field_with_a_low_border_gives_a_closed_surface(seed: u64) {
            let size = [7usize, 6, 8];
            let mut state = seed | 1;
            let values: Vec<f32> = (0..size[0] * size[1] * size[2]).map(|i| {
                let (x, y, z) = (i % 7, i / 7 % 6, i / 42);
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                let border = x == 0 || y == 0 || z == 0 || x == 6 || y == 5 || z == 7;
                // Steps of a quarter, so that nodes lie on the level itself.
                if border { -1.0 } else { ((state >> 61) as f32 - 3.0) / 4.0 }
            }).collect();
            let mesh = mesh(size, &values, 0.0);
            prop_assert_eq!(mesh.open_edges(), 0);
            prop_assert!(mesh.triangles.is_empty() || mesh.volume_m3() > -1e-9);
        }
    }
}
