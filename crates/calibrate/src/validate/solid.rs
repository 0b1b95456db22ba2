// SPDX-License-Identifier: MIT OR Apache-2.0
//! Clouds against a solid of known shape: a sphere, or a triangle mesh.
//!
//! Distances are signed, positive outside. Points further than [`GROSS_M`] from the surface have a wrong fringe order
//! or are of something else: they are counted, and do not enter the other figures.

use super::deviations::Deviations;
use super::plane::GROSS_M;
use crate::base::regular;
use crate::geometry::cells::{Cells, cell_of};
use nalgebra::{Matrix4, Point3, Vector3, Vector4};
use serde::Serialize;
use std::path::Path;

/// Distances to a known solid.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SolidScore {
    /// Deviations of the points within [`GROSS_M`].
    #[serde(flatten)]
    pub deviations: Deviations,
    /// Points that lie further away than that.
    pub gross: usize,
    pub gross_share: f64,
    /// The sphere that fits best, where the solid is one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fitted: Option<FittedSphere>,
}

/// The sphere that fits the points best (least squares of the distances), against the known one.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct FittedSphere {
    pub radius_mm: f64,
    /// Its radius minus the known one, mm.
    pub radius_error_mm: f64,
    /// Its centre minus the known one, mm.
    pub centre_error_mm: [f64; 3],
    /// RMS distance of the points from it, mm.
    pub rms_mm: f64,
}

/// A known sphere, in the world frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sphere {
    pub centre: Point3<f64>,
    pub radius_m: f64,
}

impl Sphere {
    /// Signed distance of a point, m.
    pub fn distance(&self, point: &Point3<f64>) -> f64 {
        (point - self.centre).norm() - self.radius_m
    }

    /// The least-squares sphere of the points near this one, by Gauss and Newton from this one; `None` where the
    /// points do not determine it.
    pub fn fit(&self, points: &[Point3<f64>]) -> Option<Self> {
        let near: Vec<&Point3<f64>> = points.iter().filter(|p| self.distance(p).abs() <= GROSS_M).collect();
        let mut sphere = *self;
        for _ in 0..20 {
            let (mut normal, mut right) = (Matrix4::zeros(), Vector4::zeros());
            for point in &near {
                let d = *point - sphere.centre;
                let n = d / d.norm();
                let row = Vector4::new(-n.x, -n.y, -n.z, -1.0);
                normal += row * row.transpose();
                right -= row * sphere.distance(point);
            }
            let step = normal.cholesky()?.solve(&right);
            sphere.centre += step.xyz();
            sphere.radius_m += step.w;
            if step.norm() < 1e-10 {
                return Some(sphere);
            }
        }
        None
    }
}

/// Scores points against a sphere.
pub fn score_sphere(points: &[Point3<f64>], sphere: &Sphere) -> SolidScore {
    let mut score = score(points, |p| sphere.distance(p));
    score.fitted = sphere.fit(points).map(|fitted| {
        let near = points.iter().filter(|p| sphere.distance(p).abs() <= GROSS_M);
        let rest: Vec<f64> = near.map(|p| fitted.distance(p)).collect();
        FittedSphere {
            radius_mm: 1e3 * fitted.radius_m,
            radius_error_mm: 1e3 * (fitted.radius_m - sphere.radius_m),
            centre_error_mm: ((fitted.centre - sphere.centre) * 1e3).into(),
            rms_mm: Deviations::of(&rest).rms_mm,
        }
    });
    score
}

/// Scores points against a mesh.
pub fn score_mesh(points: &[Point3<f64>], mesh: &Mesh) -> SolidScore {
    score(points, |p| mesh.distance(p).unwrap_or(f64::INFINITY))
}

fn score(points: &[Point3<f64>], distance: impl Fn(&Point3<f64>) -> f64) -> SolidScore {
    let near: Vec<f64> = points.iter().map(distance).filter(|d| d.abs() <= GROSS_M).collect();
    let gross = points.len() - near.len();
    SolidScore {
        deviations: Deviations::of(&near),
        gross,
        gross_share: gross as f64 / points.len().max(1) as f64,
        fitted: None,
    }
}

/// Cells of a mesh that triangles are sorted into, m: at least the reach of a query.
const CELL_M: f64 = 0.012;
/// Most cells that one triangle may lie in.
const MOST_CELLS: f64 = 1e6;

/// A triangle mesh with its triangles by place.
#[derive(Debug)]
pub struct Mesh {
    triangles: Vec<[Vector3<f64>; 3]>,
    cells: Cells<u32>,
}

impl Mesh {
    /// Reads a Wavefront OBJ file: `v` and `f` lines; metres, world axes, faces counterclockwise from outside.
    pub fn load(path: &Path) -> Result<Self, String> {
        let text = regular::read_text(path, regular::STATEMENT_BYTES)
            .map_err(|e| format!("{}: {e}", path.display()))?;
        Self::parse(&text).map_err(|reason| {
            format!(
                "{}: {reason}; expected a Wavefront OBJ mesh (v and f lines, metres, world axes)",
                path.display()
            )
        })
    }

    /// Reads the text of an OBJ file.
    pub fn parse(text: &str) -> Result<Self, String> {
        let (mut vertices, mut triangles) = (Vec::new(), Vec::new());
        for (number, line) in text.lines().enumerate() {
            let wrong = || format!("line {}: {line:?} cannot be read", number + 1);
            let mut words = line.split_whitespace();
            match words.next() {
                Some("v") => {
                    let numbers: Vec<f64> = words.take(3).map_while(|w| w.parse().ok()).collect();
                    let &[x, y, z] = numbers.as_slice() else { return Err(wrong()) };
                    vertices.push(Vector3::new(x, y, z));
                }
                Some("f") => {
                    let corner = |word: &str| {
                        let index: i64 = word.split('/').next()?.parse().ok()?;
                        let place = if index < 0 { vertices.len() as i64 + index } else { index - 1 };
                        vertices.get(usize::try_from(place).ok()?).copied()
                    };
                    let corners: Option<Vec<Vector3<f64>>> = words.map(corner).collect();
                    let corners = corners.filter(|c| c.len() >= 3).ok_or_else(wrong)?;
                    triangles.extend(corners.windows(2).skip(1).map(|pair| [corners[0], pair[0], pair[1]]));
                }
                _ => {}
            }
        }
        Self::new(triangles)
    }

    /// A mesh of these triangles, or why they are none.
    pub fn new(triangles: Vec<[Vector3<f64>; 3]>) -> Result<Self, String> {
        let mut places = Vec::new();
        for (number, triangle) in triangles.iter().enumerate() {
            let low = triangle.iter().fold(triangle[0], |a, b| a.inf(b)).map(|x| (x / CELL_M).floor());
            let high = triangle.iter().fold(triangle[0], |a, b| a.sup(b)).map(|x| (x / CELL_M).floor());
            let count: f64 = (high - low).iter().map(|d| d + 1.0).product();
            if !(count <= MOST_CELLS) {
                return Err(format!("a face spans {count} cells of {CELL_M} m: are the lengths metres?"));
            }
            for z in low.z as i64..=high.z as i64 {
                for y in low.y as i64..=high.y as i64 {
                    places.extend((low.x as i64..=high.x as i64).map(|x| ([x, y, z], number as u32)));
                }
            }
        }
        if triangles.is_empty() {
            Err("there are no faces".to_owned())
        } else {
            Ok(Self { triangles, cells: Cells::new(places.into_iter()) })
        }
    }

    /// Signed distance to the nearest face, m; `None` where none is in reach (at least [`GROSS_M`]).
    ///
    /// Where several faces share the nearest edge or corner, the one that the point lies most in front of or behind
    /// decides the side.
    pub fn distance(&self, point: &Point3<f64>) -> Option<f64> {
        let (mut best, mut side) = (f64::INFINITY, 0.0f64);
        for &number in self.cells.around(cell_of((*point).into(), CELL_M)) {
            let triangle = &self.triangles[number as usize];
            let away = point.coords - super::truth::closest(&point.coords, triangle);
            let distance = away.norm();
            if distance > best + 1e-12 {
                continue;
            }
            let [a, b, c] = triangle;
            let height = away.dot(&(b - a).cross(&(c - a)).try_normalize(0.0).unwrap_or_default());
            if distance < best - 1e-12 || height.abs() > side.abs() {
                side = height;
            }
            best = best.min(distance);
        }
        best.is_finite().then(|| best.copysign(side))
    }
}

#[cfg(test)]
mod tests {
    use super::{Mesh, Sphere, score_mesh, score_sphere};
    use crate::validate::deviations::Draws;
    use nalgebra::{Point3, Vector3};

    /// Half a sphere with noise of 0.2 mm, moved and swollen.
    fn half(centre: Point3<f64>, radius: f64, noise: f64) -> Vec<Point3<f64>> {
        let mut draws = Draws(3);
        (0..20_000)
            .map(|_| {
                let direction =
                    Vector3::new(draws.normal(), draws.normal(), draws.normal().abs()).normalize();
                centre + direction * (radius + noise * draws.normal())
            })
            .collect()
    }

    #[test]
    fn a_sphere_is_fitted_where_only_half_is_seen() {
        let known = Sphere { centre: Point3::new(0.0, 0.0, 1.0), radius_m: 0.15 };
        let mut points = half(Point3::new(0.0003, 0.0, 1.0), 0.1504, 2e-4);
        points.extend((0..100).map(|_| Point3::new(0.0, 0.0, 1.2)));
        let score = score_sphere(&points, &known);
        let fitted = score.fitted.expect("a sphere");
        assert!((fitted.radius_error_mm - 0.4).abs() < 0.02, "{fitted:?}");
        assert!(
            (fitted.centre_error_mm[0] - 0.3).abs() < 0.02 && fitted.centre_error_mm[2].abs() < 0.03,
            "{fitted:?}"
        );
        assert!((fitted.rms_mm - 0.2).abs() < 0.01, "{fitted:?}");
        assert_eq!(score.gross, 100);
        assert!((score.deviations.mean_mm - 0.4).abs() < 0.02, "{score:?}");
    }

    const CUBE: &str = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nv 1 0 1\nv 1 1 1\nv 0 1 1\n\
        f 4 3 2 1\nf 5 6 7 8\nf 1 2 6 5\nf 2/1/1 3 7 6\nf 3 4 8 7\nf 4 1 5 -4\n";

    #[test]
    fn a_cube_has_an_inside_and_an_outside() {
        let scaled: String = CUBE
            .lines()
            .map(|line| match line.strip_prefix("v ") {
                Some(rest) => format!("v {}\n", rest.replace('1', "0.1")),
                None => format!("{line}\n"),
            })
            .collect();
        let cube = Mesh::parse(&scaled).expect("a mesh");
        for (point, expected) in [
            ([0.05, 0.05, 0.103], 0.003),
            ([0.05, 0.05, 0.096], -0.004),
            ([0.103, 0.104, 0.05], 0.005),
            ([0.103, 0.104, 0.112], 0.013),
            ([0.002, 0.001, 0.05], -0.001),
        ] {
            let found = cube.distance(&Point3::from(point)).expect("in reach");
            assert!((found - expected).abs() < 1e-12, "{point:?}: {found}");
        }
        assert_eq!(cube.distance(&Point3::new(0.05, 0.05, 0.05)), None);
        let score = score_mesh(&[Point3::new(0.05, 0.05, 0.103), Point3::new(0.05, 0.05, 0.05)], &cube);
        assert_eq!((score.gross, score.deviations.points), (1, 1));
    }

    #[test]
    fn what_is_no_mesh_is_refused() {
        assert!(Mesh::parse("hello").is_err());
        assert!(Mesh::parse("v 0 0\n").is_err());
        assert!(Mesh::parse("v 0 0 0\nf 1 2 3\n").is_err());
        assert!(
            Mesh::parse("v 0 0 0\nv 1000 0 0\nv 0 1000 1000\nf 1 2 3\n")
                .expect_err("too large")
                .contains("metres")
        );
    }
}
