// SPDX-License-Identifier: MIT OR Apache-2.0
//! A tailor's dummy: a body without limbs whose girths are known, because each of its horizontal sections is a curve
//! with a formula.
//!
//! A section in polar coordinates about the body's axis (0: forwards, a quarter turn: left) is a superellipse with a
//! furrow along the spine,
//!
//! ```text
//! r(t) = (|cos t / a|^n + |sin t / b|^n)^(-1/n) (1 - g exp(-(s / w)^2 / 2)),   s: angle from straight back
//! ```
//!
//! with half depth a, half width b, exponent n and furrow g given at some heights, and a quintic step in between: at the
//! given heights nothing changes with height, so that a girth there does not depend on a millimetre up or down.

use super::mesh::Mesh;
use super::solids::grid_mesh;
use nalgebra::Vector3;
use std::f64::consts::{PI, TAU};

/// A horizontal section at one height.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Section {
    /// Its name, when its girth is measured.
    pub name: Option<String>,
    pub height_m: f64,
    /// a: half of its size forwards, m.
    pub half_depth_m: f64,
    /// b: half of its size sidewards, m.
    pub half_width_m: f64,
    /// n: 2 is an ellipse, more is squarer.
    pub exponent: f64,
    /// g: depth of the furrow at the back, as a share of the radius there.
    pub furrow: f64,
}

/// Half width of the furrow: w of the formula, rad.
const FURROW_RAD: f64 = 0.3;
/// Height of the rounded ends, m.
const CAP_M: f64 = 0.06;
/// Steps around, rings per metre of height, and rings of a rounded end: facets within 3 micrometres of the surface.
const STEPS: usize = 720;
const RINGS_PER_M: f64 = 400.0;
const CAP_RINGS: usize = 40;
/// Corners of the polygon that stands for a section when its girth is computed.
const CORNERS: usize = 40_000;

/// Length of a section's outline, and of the tape around it.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Girth {
    pub name: String,
    pub height_m: f64,
    pub girth_mm: f64,
    /// Of its convex hull, mm: what a tape measures.
    pub hull_mm: f64,
}

/// A torso whose girths are known exactly.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Torso {
    /// From the lowest up, at least two, heights strictly growing.
    pub sections: Vec<Section>,
    /// Where its axis stands, m.
    pub position_m: [f64; 2],
    /// Which way it faces, from world +x towards +y.
    pub heading_deg: f64,
}

impl Torso {
    /// The section at a height within the body, by interpolation.
    pub fn section(&self, height_m: f64) -> Section {
        let above = self.sections.iter().position(|s| s.height_m >= height_m);
        let above = above.unwrap_or(self.sections.len() - 1).max(1);
        let (a, b) = (&self.sections[above - 1], &self.sections[above]);
        let t = ((height_m - a.height_m) / (b.height_m - a.height_m)).clamp(0.0, 1.0);
        let step = t * t * t * (t * (6.0 * t - 15.0) + 10.0);
        let mix = |a: f64, b: f64| a + (b - a) * step;
        Section {
            name: None,
            height_m,
            half_depth_m: mix(a.half_depth_m, b.half_depth_m),
            half_width_m: mix(a.half_width_m, b.half_width_m),
            exponent: mix(a.exponent, b.exponent),
            furrow: mix(a.furrow, b.furrow),
        }
    }

    /// The girths of the named sections.
    pub fn girths(&self) -> Vec<Girth> {
        let girth = |section: &Section| {
            let points: Vec<[f64; 2]> =
                (0..CORNERS).map(|i| section.point(i as f64 * TAU / CORNERS as f64)).collect();
            Some(Girth {
                name: section.name.clone()?,
                height_m: section.height_m,
                girth_mm: 1e3 * perimeter(&points),
                hull_mm: 1e3 * perimeter(&convex_hull(points)),
            })
        };
        self.sections.iter().filter_map(girth).collect()
    }

    /// The surface of the torso as triangles.
    pub fn mesh(&self) -> Mesh {
        let (low, high) = (self.sections[0].height_m, self.sections[self.sections.len() - 1].height_m);
        let rings = ((high - low) * RINGS_PER_M).ceil() as usize;
        let (sin, cos) = self.heading_deg.to_radians().sin_cos();
        // Per ring: the height of the section that is shown, by how much it is smaller, and where it lies.
        let place = |ring: usize| {
            let body = (ring as f64 - CAP_RINGS as f64).clamp(0.0, rings as f64);
            let height = low + (high - low) * body / rings as f64;
            let beyond = (ring as f64 - CAP_RINGS as f64 - body) / CAP_RINGS as f64 * TAU / 4.0;
            (height, beyond.cos().max(0.0), height + CAP_M * beyond.sin())
        };
        let sections: Vec<(Section, f64, f64)> = (0..=rings + 2 * CAP_RINGS)
            .map(|ring| {
                let (height, scale, z) = place(ring);
                (self.section(height), scale, z)
            })
            .collect();
        grid_mesh(rings + 2 * CAP_RINGS, STEPS, |ring, step| {
            let (section, scale, z) = &sections[ring];
            let [x, y] = section.point(step as f64 * TAU / STEPS as f64).map(|c| c * scale);
            let [px, py] = self.position_m;
            Vector3::new(px + cos * x - sin * y, py + sin * x + cos * y, *z)
        })
    }
}

impl Section {
    /// The outline at angle `t` from straight ahead towards the left: forwards, left; m.
    fn point(&self, t: f64) -> [f64; 2] {
        let (sin, cos) = t.sin_cos();
        let n = self.exponent;
        let round = ((cos / self.half_depth_m).abs().powf(n) + (sin / self.half_width_m).abs().powf(n))
            .powf(-1.0 / n);
        let from_back = (t.rem_euclid(TAU) - PI) / FURROW_RAD;
        let radius = round * (1.0 - self.furrow * (-0.5 * from_back * from_back).exp());
        [radius * cos, radius * sin]
    }
}

fn perimeter(points: &[[f64; 2]]) -> f64 {
    let next = points.iter().cycle().skip(1);
    points.iter().zip(next).map(|(a, b)| (a[0] - b[0]).hypot(a[1] - b[1])).sum()
}

/// The convex hull, counter-clockwise (Andrew 1979).
fn convex_hull(mut points: Vec<[f64; 2]>) -> Vec<[f64; 2]> {
    points.sort_by(|a, b| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])));
    let turns_right = |a: [f64; 2], b: [f64; 2], c: [f64; 2]| {
        (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]) <= 0.0
    };
    let chain = |points: &mut dyn Iterator<Item = [f64; 2]>| {
        let mut chain: Vec<[f64; 2]> = Vec::new();
        for point in points {
            while let [.., a, b] = chain[..]
                && turns_right(a, b, point)
            {
                chain.pop();
            }
            chain.push(point);
        }
        chain.pop();
        chain
    };
    let mut hull = chain(&mut points.iter().copied());
    hull.extend(chain(&mut points.iter().rev().copied()));
    hull
}

#[cfg(test)]
mod tests {
    use super::{Section, Torso};
    use std::f64::consts::PI;

    fn section(name: &str, height_m: f64, a: f64, b: f64, furrow: f64) -> Section {
        Section {
            name: Some(name.to_owned()),
            height_m,
            half_depth_m: a,
            half_width_m: b,
            exponent: 2.0,
            furrow,
        }
    }

    fn torso() -> Torso {
        let sections = vec![section("hip", 0.9, 0.12, 0.18, 0.0), section("chest", 1.3, 0.15, 0.15, 0.2)];
        Torso { sections, position_m: [0.1, -0.2], heading_deg: 40.0 }
    }

    #[test]
    fn girths_are_those_of_the_formula() {
        let girths = torso().girths();
        // Ramanujan's second approximation, exact to 1e-7 for this flattening.
        let (a, b) = (0.12f64, 0.18f64);
        let h = ((a - b) / (a + b)).powi(2);
        let ellipse = PI * (a + b) * (1.0 + 3.0 * h / (10.0 + (4.0 - 3.0 * h).sqrt()));
        assert!((girths[0].girth_mm - 1e3 * ellipse).abs() < 1e-3, "{} {ellipse}", girths[0].girth_mm);
        assert!((girths[0].girth_mm - girths[0].hull_mm).abs() < 1e-6);
        assert!(girths[1].girth_mm > girths[1].hull_mm + 0.5, "{:?}", girths[1]);
        assert!(girths[1].hull_mm < 2e3 * PI * 0.15);
    }

    #[test]
    fn the_mesh_has_the_girths() {
        let (torso, mesh) = (torso(), torso().mesh());
        assert!((0.025..0.035).contains(&mesh.volume()), "{}", mesh.volume());
        for girth in torso.girths() {
            // The rings at the given heights, which the mesh has exactly.
            let ring: Vec<[f64; 2]> = mesh
                .positions
                .iter()
                .filter(|p| (f64::from(p[2]) - girth.height_m).abs() < 1e-6)
                .map(|p| [f64::from(p[0]), f64::from(p[1])])
                .collect();
            assert!(ring.len() >= 720, "{}", ring.len());
            let of_mesh = 1e3 * super::perimeter(&ring[..720]);
            assert!((of_mesh - girth.girth_mm).abs() < 0.02, "{of_mesh} {girth:?}");
        }
    }

    #[test]
    fn nothing_changes_at_the_given_heights() {
        let torso = torso();
        let (at, above) = (torso.section(0.9), torso.section(0.905));
        assert!((at.half_depth_m - above.half_depth_m).abs() < 1e-6);
    }
}
