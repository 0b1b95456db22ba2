// SPDX-License-Identifier: MIT OR Apache-2.0
//! Plane fits of the board (paper, 5.1, step 1).
//!
//! The plane is the total least-squares one of all points within [`GROSS_M`] of it; the first guess is the plane
//! that most of a few thousand points lie on. Which points count is decided by place alone, never by how well they
//! fit, with one exception that is counted:
//!
//! * The outline is the convex hull of the points near the plane, or the board's own where its pose is known. Points
//!   nearer to it than the margin see the board's edge in their window of one fringe and are left out (`edge`).
//! * Points inside the outline, but further than [`GROSS_M`] from the plane, have a wrong fringe order (one fringe is
//!   some 40 mm of depth): `left_out`. They do not enter the RMS, but they are reported beside it.
//! * Points further than [`DEPTH_M`] from the plane, or beside the outline, are of something else: `elsewhere`.

use super::deviations::{Deviations, Draws};
use nalgebra::{Isometry3, Matrix3, Point3, SymmetricEigen, Vector3};
use serde::Serialize;

/// Deviations beyond this are wrong fringe orders, m.
pub const GROSS_M: f64 = 0.01;
/// Beyond this from the plane is something else, m.
pub const DEPTH_M: f64 = 0.1;
/// Planes tried for the first guess.
const TRIES: usize = 300;
/// Points that a first guess is judged by.
const SAMPLES: usize = 3000;
/// Side of the cells in which points are counted for the outline, m.
const CELL_M: f64 = 0.01;
/// Fewest points of a cell that belongs to the outline: single stray points do not.
const LEAST_IN_CELL: usize = 5;

/// A plane in its normal form, with axes along it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Plane {
    /// A point of it: the mean of those that it was fitted to, m.
    pub centre: Point3<f64>,
    pub normal: Vector3<f64>,
    /// Unit vectors along it, across each other and across the normal.
    pub axes: [Vector3<f64>; 2],
}

impl Plane {
    /// Signed distance of a point, m.
    pub fn distance(&self, point: &Point3<f64>) -> f64 {
        self.normal.dot(&(point - self.centre))
    }

    /// Place of a point along the plane, m.
    pub fn place(&self, point: &Point3<f64>) -> [f64; 2] {
        self.axes.map(|axis| axis.dot(&(point - self.centre)))
    }

    /// The total least-squares plane; `None` for fewer than three points or points on a line.
    pub fn fit<'a>(points: impl Iterator<Item = &'a Point3<f64>> + Clone) -> Option<Self> {
        let (sum, n) = points.clone().fold((Vector3::zeros(), 0.0), |(s, n), p| (s + p.coords, n + 1.0));
        let centre: Point3<f64> = (sum / n).into();
        let mut spread = Matrix3::zeros();
        for point in points {
            let d = point - centre;
            spread += d * d.transpose();
        }
        if !(n >= 3.0) || !spread.iter().all(|x| x.is_finite()) {
            return None;
        }
        let eigen = SymmetricEigen::new(spread);
        let mut order = [0, 1, 2];
        order.sort_by(|a, b| eigen.eigenvalues[*a].total_cmp(&eigen.eigenvalues[*b]));
        let axis = |i: usize| -> Vector3<f64> { eigen.eigenvectors.column(order[i]).into() };
        (eigen.eigenvalues[order[1]] > 1e-12 * n).then(|| Self {
            centre,
            normal: axis(0),
            axes: [axis(2), axis(1)],
        })
    }

    /// The plane that most points lie near, then fitted to all points near it.
    pub fn largest(points: &[Point3<f64>]) -> Option<Self> {
        if points.len() < 3 {
            return None;
        }
        let mut draws = Draws(1);
        let sample: Vec<&Point3<f64>> =
            (0..SAMPLES.min(points.len())).map(|_| &points[draws.below(points.len())]).collect();
        let mut best: Option<(usize, Self)> = None;
        for _ in 0..TRIES {
            let three: [&Point3<f64>; 3] = std::array::from_fn(|_| sample[draws.below(sample.len())]);
            let Some(plane) = Self::fit(three.into_iter()) else { continue };
            let near = sample.iter().filter(|p| plane.distance(p).abs() < GROSS_M / 2.0).count();
            if best.as_ref().is_none_or(|(most, _)| near > *most) {
                best = Some((near, plane));
            }
        }
        let mut plane = best?.1;
        for _ in 0..4 {
            plane = Self::fit(points.iter().filter(|p| plane.distance(p).abs() < GROSS_M))?;
        }
        Some(plane)
    }
}

/// Where the board is: takes board coordinates to the world, and its outer size, m.
#[derive(Debug, Clone, Copy)]
pub struct Placed {
    pub world_from_board: Isometry3<f64>,
    /// Outer size along x and y, m.
    pub size_m: [f64; 2],
}

/// How flat the board came out.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Flatness {
    /// Deviations of the points that count.
    #[serde(flatten)]
    pub deviations: Deviations,
    /// Points of the board of a wrong fringe order.
    pub left_out: usize,
    /// Points too near to the board's edge to count.
    pub edge: usize,
    /// RMS with those near the edge, mm.
    pub rms_with_edge_mm: f64,
    /// Points that are not of the board.
    pub elsewhere: usize,
    /// Share of all points on the board that count.
    pub used_share: f64,
    /// Area of the outline, m².
    pub area_m2: f64,
}

/// Fits the plane of the board. Without its pose the largest plane is the board, and the outline of its points the
/// board's. `None` where there is no plane.
pub fn flatness(points: &[Point3<f64>], board: Option<&Placed>, margin_m: f64) -> Option<Flatness> {
    let mut plane = match board {
        None => Plane::largest(points)?,
        Some(placed) => {
            let pose = placed.world_from_board;
            let axis = |v: Vector3<f64>| pose.transform_vector(&v);
            let axes = [axis(Vector3::x()), axis(Vector3::y())];
            Plane { centre: pose.translation.vector.into(), normal: axis(Vector3::z()), axes }
        }
    };
    let outline = match board {
        None => outline(points, &plane),
        Some(placed) => {
            let [x, y] = placed.size_m.map(|s| s / 2.0);
            vec![[-x, -y], [x, -y], [x, y], [-x, y]]
        }
    };
    let frame = plane;
    // Where each point lies is settled before the plane is fitted to those that count.
    let (mut counting, mut edge, mut elsewhere) = (Vec::new(), Vec::new(), 0);
    for point in points {
        let inside = inside_by(&outline, frame.place(point));
        if !(inside >= 0.0) || !(frame.distance(point).abs() <= DEPTH_M) {
            elsewhere += 1;
        } else if inside < margin_m {
            edge.push(*point);
        } else {
            counting.push(*point);
        }
    }
    for _ in 0..4 {
        plane = Plane::fit(counting.iter().filter(|p| plane.distance(p).abs() <= GROSS_M))?;
    }
    let near = |points: &[Point3<f64>]| -> Vec<f64> {
        points.iter().map(|p| plane.distance(p)).filter(|d| d.abs() <= GROSS_M).collect()
    };
    let deviations = near(&counting);
    let left_out = counting.len() - deviations.len();
    let at_edge = near(&edge);
    let with_edge: Vec<f64> = deviations.iter().chain(&at_edge).copied().collect();
    Some(Flatness {
        left_out,
        edge: edge.len(),
        rms_with_edge_mm: Deviations::of(&with_edge).rms_mm,
        elsewhere,
        used_share: deviations.len() as f64 / (counting.len() + edge.len()).max(1) as f64,
        area_m2: area(&outline),
        deviations: Deviations::of(&deviations),
    })
}

/// The convex hull of the well-filled cells of the plane, counterclockwise.
fn outline(points: &[Point3<f64>], plane: &Plane) -> Vec<[f64; 2]> {
    let mut cells = std::collections::BTreeMap::<[i64; 2], Vec<[f64; 2]>>::new();
    for point in points.iter().filter(|p| plane.distance(p).abs() < GROSS_M) {
        let place = plane.place(point);
        cells.entry(place.map(|x| (x / CELL_M).floor() as i64)).or_default().push(place);
    }
    convex_hull(cells.into_values().filter(|cell| cell.len() >= LEAST_IN_CELL).flatten().collect())
}

/// Convex hull, counterclockwise (Andrew's monotone chain).
pub(super) fn convex_hull(mut points: Vec<[f64; 2]>) -> Vec<[f64; 2]> {
    points.sort_unstable_by(|a, b| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])));
    points.dedup();
    let mut hull: Vec<[f64; 2]> = Vec::new();
    let mut chain = |points: &mut dyn Iterator<Item = &[f64; 2]>| {
        let start = hull.len();
        for p in points {
            while let &[.., a, b] = &hull[start..]
                && turn(a, b, *p) <= 0.0
            {
                hull.pop();
            }
            hull.push(*p);
        }
        hull.pop();
    };
    chain(&mut points.iter());
    chain(&mut points.iter().rev());
    hull
}

/// Twice the area of a triangle, positive counterclockwise.
fn turn(a: [f64; 2], b: [f64; 2], c: [f64; 2]) -> f64 {
    (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
}

/// How far a place lies inside a convex outline, m; negative outside.
fn inside_by(outline: &[[f64; 2]], place: [f64; 2]) -> f64 {
    let sides = (0..outline.len()).map(|i| (outline[i], outline[(i + 1) % outline.len()]));
    sides.map(|(a, b)| turn(a, b, place) / (b[0] - a[0]).hypot(b[1] - a[1])).fold(f64::INFINITY, f64::min)
}

fn area(outline: &[[f64; 2]]) -> f64 {
    let next = outline.iter().cycle().skip(1);
    outline.iter().zip(next).map(|(a, b)| turn([0.0; 2], *a, *b)).sum::<f64>() / 2.0
}

#[cfg(test)]
mod tests {
    use super::{Placed, convex_hull, flatness};
    use crate::validate::deviations::Draws;
    use nalgebra::{Isometry3, Point3, Vector3};

    /// A tilted board of 0.5 x 0.4 m with noise of 0.1 mm, seen every 2 mm.
    fn board(noise_m: f64) -> (Isometry3<f64>, Vec<Point3<f64>>) {
        let pose = Isometry3::new(Vector3::new(0.1, -0.2, 1.0), Vector3::new(0.4, 0.7, -0.2));
        let mut draws = Draws(7);
        let points = (0..251 * 201).map(|i| {
            let (x, y) = (f64::from(i % 251) * 0.002 - 0.25, f64::from(i / 251) * 0.002 - 0.2);
            pose * Point3::new(x, y, noise_m * draws.normal())
        });
        (pose, points.collect())
    }

    #[test]
    fn the_rms_is_the_noise_and_gross_points_are_counted() {
        let (pose, mut points) = board(1e-4);
        for i in 0..500 {
            points[i * 97 + 30] += pose.transform_vector(&Vector3::new(0.0, 0.0, 0.04));
        }
        // A wall behind.
        points.extend(
            (0..4000).map(|i| pose * Point3::new(f64::from(i % 60) * 0.01, f64::from(i / 60) * 0.01, -0.5)),
        );
        let placed = Placed { world_from_board: pose, size_m: [0.5, 0.4] };
        for board in [None, Some(&placed)] {
            let found = flatness(&points, board, 0.01).expect("a plane");
            assert!((found.deviations.rms_mm - 0.1).abs() < 0.002, "{found:?}");
            assert!((430..=500).contains(&found.left_out), "{found:?}");
            assert!((found.area_m2 - 0.2).abs() < 0.002, "{found:?}");
            assert!((found.elsewhere as i64 - 4000).abs() < 500, "{found:?}");
            // A margin of 10 mm all around.
            let margin = 1.0 - 0.48 * 0.38 / 0.2;
            assert!((found.edge as f64 / 50451.0 - margin).abs() < 0.01, "{found:?}");
        }
    }

    #[test]
    fn a_bent_board_is_not_flat() {
        let (pose, mut points) = board(0.0);
        for point in &mut points {
            let x = (pose.inverse() * *point).x;
            *point += pose.transform_vector(&Vector3::new(0.0, 0.0, 0.001 * (x / 0.24).powi(2)));
        }
        // Of t², t even in -1..1, the mean 1/3 removed: sqrt(4 / 45).
        let found = flatness(&points, None, 0.01).expect("a plane");
        assert!((found.deviations.rms_mm - (4.0f64 / 45.0).sqrt()).abs() < 0.005, "{found:?}");
        assert_eq!(found.left_out, 0);
    }

    #[test]
    fn points_of_a_line_have_no_plane() {
        let line: Vec<_> = (0..100).map(|i| Point3::new(f64::from(i), 0.0, 0.0)).collect();
        assert_eq!(flatness(&line, None, 0.01), None);
        assert_eq!(flatness(&[], None, 0.01), None);
    }

    #[test]
    fn the_hull_leaves_out_what_is_inside() {
        let hull = convex_hull(vec![[0.0, 0.0], [1.0, 0.0], [0.5, 0.0], [0.4, 0.5], [1.0, 1.0], [0.0, 1.0]]);
        assert_eq!(hull, [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]);
    }
}
