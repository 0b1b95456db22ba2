// SPDX-License-Identifier: MIT OR Apache-2.0
//! Triangles between neighbouring pixels of one camera.
//!
//! The paper calls this the natural next form of an organized cloud. Four neighbouring pixels give two triangles,
//! split along the shorter diagonal; three give one. A triangle is left out where it does not lie on the surface:
//! where an edge is much longer than the spacing of the cloud (a step in depth, or a surface seen at so grazing an
//! angle that its points are far apart), or where it faces another way than the normals of its corners (a step that
//! is no longer than that). Holes stay holes.

use super::Mesh;
use crate::data::Cloud;

/// What a triangle may look like.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GridLimits {
    /// The longest edge, in median spacings of the cloud. A surface turned by an angle a from the line of sight has
    /// points 1 / cos a as far apart: 4 leaves out what is turned by more than about 75 degrees.
    pub stretch: f32,
    /// The least cosine of the angle between a triangle's normal and that of each of its corners.
    pub cosine: f32,
}

impl Default for GridLimits {
    fn default() -> Self {
        Self { stretch: 4.0, cosine: 0.4 }
    }
}

const NONE: u32 = u32::MAX;

/// The mesh of a directional cloud. Points that no triangle uses are left out.
pub fn on_grid(cloud: &Cloud, limits: GridLimits) -> Mesh {
    let Some(grid) = Grid::new(cloud) else { return Mesh::default() };
    let Some(spacing) = grid.spacing(cloud) else { return Mesh::default() };
    let longest = limits.stretch * spacing;
    let mut triangles = Vec::with_capacity(2 * cloud.len());
    for row in 1..grid.height {
        for column in 1..grid.width {
            let corners = [
                grid.at(column - 1, row - 1),
                grid.at(column, row - 1),
                grid.at(column, row),
                grid.at(column - 1, row),
            ];
            for triangle in split(cloud, corners) {
                triangles.extend(accepted(cloud, triangle, longest, limits.cosine));
            }
        }
    }
    without_strays(cloud, triangles)
}

/// Which point each pixel has.
struct Grid {
    first: [u16; 2],
    width: usize,
    height: usize,
    points: Vec<u32>,
}

impl Grid {
    fn new(cloud: &Cloud) -> Option<Self> {
        if cloud.pixel.len() != cloud.len() || cloud.len() >= NONE as usize {
            return None;
        }
        let columns = || cloud.pixel.iter().map(|pixel| pixel[0]);
        let rows = || cloud.pixel.iter().map(|pixel| pixel[1]);
        let first = [columns().min()?, rows().min()?];
        let width = usize::from(columns().max()? - first[0]) + 1;
        let height = usize::from(rows().max()? - first[1]) + 1;
        let mut grid = Self { first, width, height, points: vec![NONE; width * height] };
        for (i, pixel) in cloud.pixel.iter().enumerate() {
            let (u, v) = (usize::from(pixel[0] - grid.first[0]), usize::from(pixel[1] - grid.first[1]));
            grid.points[v * width + u] = i as u32;
        }
        Some(grid)
    }

    fn at(&self, column: usize, row: usize) -> u32 {
        self.points[row * self.width + column]
    }

    /// Median distance of points of neighbouring pixels in a row and in a column.
    fn spacing(&self, cloud: &Cloud) -> Option<f32> {
        let mut lengths = Vec::with_capacity(2 * cloud.len());
        for row in 0..self.height {
            for column in 0..self.width {
                let here = self.at(column, row);
                let right = if column + 1 < self.width { self.at(column + 1, row) } else { NONE };
                let below = if row + 1 < self.height { self.at(column, row + 1) } else { NONE };
                for there in [right, below] {
                    if here != NONE && there != NONE {
                        lengths.push(length(difference(cloud, there, here)));
                    }
                }
            }
        }
        let middle = lengths.len() / 2;
        (!lengths.is_empty()).then(|| *lengths.select_nth_unstable_by(middle, f32::total_cmp).1)
    }
}

/// The one or two triangles of four pixels in a circle.
fn split(cloud: &Cloud, corners: [u32; 4]) -> impl Iterator<Item = [u32; 3]> {
    let [a, b, c, d] = corners;
    let there = corners.iter().filter(|corner| **corner != NONE).count();
    let (one, two) = match there {
        4 => {
            let (ac, bd) = (length(difference(cloud, c, a)), length(difference(cloud, d, b)));
            if ac <= bd { (Some([a, b, c]), Some([a, c, d])) } else { (Some([a, b, d]), Some([b, c, d])) }
        }
        3 => {
            let mut three = corners.into_iter().filter(|corner| *corner != NONE);
            let triangle = [three.next(), three.next(), three.next()].map(|corner| corner.unwrap_or(a));
            (Some(triangle), None)
        }
        _ => (None, None),
    };
    one.into_iter().chain(two)
}

/// The triangle, turned so that it faces as its corners do, if it lies on the surface.
fn accepted(cloud: &Cloud, [a, b, c]: [u32; 3], longest: f32, cosine: f32) -> Option<[u32; 3]> {
    let (ab, ac, bc) = (difference(cloud, b, a), difference(cloud, c, a), difference(cloud, c, b));
    if [ab, ac, bc].into_iter().any(|edge| !(length(edge) <= longest)) {
        return None;
    }
    let normal =
        [ab[1] * ac[2] - ab[2] * ac[1], ab[2] * ac[0] - ab[0] * ac[2], ab[0] * ac[1] - ab[1] * ac[0]];
    let facing =
        |corner: u32, side: f32| side * dot(normal, cloud.normal[corner as usize]) >= cosine * length(normal);
    // A triangle without area faces nowhere.
    let flat = !(length(normal) > 0.0);
    let all = |side: f32| !flat && [a, b, c].into_iter().all(|corner| facing(corner, side));
    if all(1.0) {
        Some([a, b, c])
    } else if all(-1.0) {
        Some([a, c, b])
    } else {
        None
    }
}

fn without_strays(cloud: &Cloud, mut triangles: Vec<[u32; 3]>) -> Mesh {
    let mut places = vec![NONE; cloud.len()];
    triangles.iter().flatten().for_each(|&corner| places[corner as usize] = 0);
    let used: Vec<usize> = (0..cloud.len()).filter(|&i| places[i] != NONE).collect();
    used.iter().zip(0..).for_each(|(&i, place)| places[i] = place);
    triangles.iter_mut().flatten().for_each(|corner| *corner = places[*corner as usize]);
    Mesh { vertices: cloud.pick(&used), triangles }
}

fn difference(cloud: &Cloud, to: u32, from: u32) -> [f32; 3] {
    let (to, from) = (cloud.position_m[to as usize], cloud.position_m[from as usize]);
    [to[0] - from[0], to[1] - from[1], to[2] - from[2]]
}

fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn length(a: [f32; 3]) -> f32 {
    dot(a, a).sqrt()
}

#[cfg(test)]
mod tests {
    use super::{GridLimits, on_grid};
    use crate::data::Cloud;

    /// A ball of 0.15 m before a wall 0.4 m behind its centre, as a camera far above sees them: a point a millimetre.
    fn ball_before_wall() -> Cloud {
        let mut cloud = Cloud::default();
        for v in 0..400u16 {
            for u in 0..400u16 {
                let (x, y) = ((f32::from(u) - 199.5) * 1e-3, (f32::from(v) - 199.5) * 1e-3);
                let under = 0.15f32.powi(2) - x * x - y * y;
                let on_ball = under > 0.0;
                let z = if on_ball { under.sqrt() } else { -0.4 };
                // A hole in the ball's top.
                if x.hypot(y) < 0.02 {
                    continue;
                }
                cloud.position_m.push([x, y, z]);
                cloud.normal.push(if on_ball { [x / 0.15, y / 0.15, z / 0.15] } else { [0.0, 0.0, 1.0] });
                cloud.intensity.push(0.5);
                cloud.pixel.push([u + 7, v + 9]);
            }
        }
        cloud
    }

    #[test]
    fn no_triangle_spans_a_step_or_a_hole_and_all_face_outwards() {
        let cloud = ball_before_wall();
        let mesh = on_grid(&cloud, GridLimits::default());
        let (mut ball, mut wall) = (0.0, 0.0);
        for corners in &mesh.triangles {
            let [a, b, c] = corners.map(|i| mesh.vertices.position_m[i as usize].map(f64::from));
            let side = |p: [f64; 3]| p[2] > -0.2;
            assert!(side(a) == side(b) && side(b) == side(c), "{a:?} {b:?} {c:?}");
            let cross = |i: usize, j: usize| (b[i] - a[i]) * (c[j] - a[j]) - (b[j] - a[j]) * (c[i] - a[i]);
            let normal = [cross(1, 2), cross(2, 0), cross(0, 1)];
            assert!(normal[2] > 0.0, "it faces away from the camera");
            let centre = (a[0] + b[0] + c[0]).hypot(a[1] + b[1] + c[1]) / 3.0;
            assert!(centre > 0.0195, "a triangle in the hole");
            let area = (normal[0].powi(2) + normal[1].powi(2) + normal[2].powi(2)).sqrt() / 2.0;
            *(if side(a) { &mut ball } else { &mut wall }) += area;
        }
        // The zone of the ball from the hole to where it is turned by 75 degrees, and at least to 70.
        let zone = |degrees: f64| {
            let (top, bottom) = (1.0 - (0.02f64 / 0.15).powi(2), degrees.to_radians().cos());
            2.0 * std::f64::consts::PI * 0.15 * 0.15 * (top.sqrt() - bottom)
        };
        assert!(ball > zone(70.0) && ball < zone(80.0), "{ball} {} {}", zone(70.0), zone(80.0));
        let around = 0.399 * 0.399 - std::f64::consts::PI * 0.15 * 0.15;
        assert!((wall / around - 1.0).abs() < 0.02, "{wall} {around}");
        assert!(mesh.vertices.len() < cloud.len(), "points of no triangle are left out");
        assert!(mesh.vertices.pixel.len() == mesh.vertices.len());
    }

    #[test]
    fn points_without_pixels_or_without_number_give_no_triangle() {
        let mut cloud = ball_before_wall();
        cloud.position_m.iter_mut().for_each(|point| point[2] = f32::NAN);
        assert!(on_grid(&cloud, GridLimits::default()).triangles.is_empty());
        cloud.pixel.clear();
        assert!(on_grid(&cloud, GridLimits::default()).triangles.is_empty());
        assert!(on_grid(&Cloud::default(), GridLimits::default()).triangles.is_empty());
    }
}
