// SPDX-License-Identifier: MIT OR Apache-2.0
//! Girths of a merged cloud at a height (paper, 5.2): the length of the closed contour, and of its convex hull (what a
//! tape measures).
//!
//! Points within [`BAND_M`] of the height are moved to it along the surface that their normals describe. They fall
//! apart into loops (trunk, arms, legs) where nothing is between them for one to two [`LINK_M`]. Each loop is described
//! by its radius around a middle as a closed cubic spline of the angle, fitted to all points at once by least squares
//! with outliers weighted down (Tukey), together with what the radius still changes with height inside the band (slope
//! and curvature, smooth around the loop). The length is that of the spline.
//!
//! A contour drawn from noisy point to noisy point is too long, whatever the noise: the spline is not, because each of
//! its knots averages dozens of points. A weak penalty on its bends closes the gaps that no camera sees. A loop that a
//! ray from its middle meets more than once (a deep fold) cannot be described so: such rays are counted
//! (`folded_share`), and the hull alone should be trusted when they are many.

use super::plane::convex_hull;
use crate::estimate::median;
use nalgebra::{DMatrix, DVector};
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};
use std::f64::consts::TAU;

/// Half thickness of the slice, m.
pub const BAND_M: f64 = 0.004;
/// Points in neighbouring cells of this side are of one loop, m: gaps of twice as much always part.
pub const LINK_M: f64 = 0.01;
/// Largest |z| of a normal that counts: a flatter surface does not determine the contour.
const FLATTEST: f32 = 0.85;
/// Fewest points of a loop.
const LEAST_POINTS: usize = 150;
/// Distance of the spline's knots along the loop, m.
const KNOT_M: f64 = 0.008;
/// Knots of slope and curvature within the band.
const COARSE_KNOTS: usize = 16;
/// The penalty on second differences of the spline's coefficients, as a share of a knot's mean weight.
const STIFFNESS: f64 = 0.005;
/// Points beyond this many robust standard deviations do not count (Tukey's biweight).
const TUKEY: f64 = 5.0;
/// Places of the spline that lengths are summed over.
const DRAWN: usize = 4096;
/// Rays on which two layers further apart than this are seen are folded, m.
const FOLD_M: f64 = 0.01;

/// A point of the surface: where it is, and its unit normal.
#[derive(Debug, Clone, Copy)]
pub struct SurfacePoint {
    pub position_m: [f32; 3],
    pub normal: [f32; 3],
}

/// One closed loop of a slice.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Loop {
    /// Length of the contour, mm.
    pub contour_mm: f64,
    /// Length of its convex hull, mm.
    pub hull_mm: f64,
    /// Its middle (x, y), m.
    pub middle_m: [f64; 2],
    /// Points of the slice in this loop.
    pub points: usize,
    /// Points that do not count because they lie off the contour.
    pub left_out: usize,
    /// RMS distance of the others from it, mm.
    pub rms_mm: f64,
    /// Longest part of the contour without points, mm.
    pub gap_mm: f64,
    /// Share of the rays from the middle that meet the surface more than once.
    pub folded_share: f64,
    /// The contour, (x, y), m.
    #[serde(skip)]
    pub outline_m: Vec<[f64; 2]>,
}

/// A point in the slice: place, and height above the slice's, m.
#[derive(Debug, Clone, Copy)]
struct Flat {
    place: [f64; 2],
    rise: f64,
}

/// The loops at a height, the longest first.
pub fn loops(points: impl Iterator<Item = SurfacePoint>, height_m: f64) -> Vec<Loop> {
    let flat: Vec<Flat> = points.filter_map(|p| flatten(&p, height_m)).collect();
    let mut loops: Vec<Loop> =
        components(&flat).into_iter().filter(|c| c.len() >= LEAST_POINTS).filter_map(|c| trace(&c)).collect();
    loops.sort_by(|a, b| b.hull_mm.total_cmp(&a.hull_mm));
    loops
}

/// Moves a point of the band to the slice, upwards or downwards along the surface.
fn flatten(point: &SurfacePoint, height_m: f64) -> Option<Flat> {
    let [x, y, z] = point.position_m.map(f64::from);
    let rise = z - height_m;
    let [nx, ny, nz] = point.normal;
    if !(rise.abs() <= BAND_M && nz.abs() < FLATTEST) {
        return None;
    }
    // Along the steepest way on the surface: across the normal, in the plane of the normal and the vertical.
    let (nx, ny, nz) = (f64::from(nx), f64::from(ny), f64::from(nz));
    let factor = rise * nz / (nx * nx + ny * ny);
    Some(Flat { place: [x + factor * nx, y + factor * ny], rise })
}

/// The points of each group of connected cells.
fn components(points: &[Flat]) -> Vec<Vec<Flat>> {
    let cell = |p: &Flat| p.place.map(|x| (x / LINK_M).floor() as i64);
    let mut cells: BTreeMap<[i64; 2], Vec<Flat>> = BTreeMap::new();
    points.iter().for_each(|p| cells.entry(cell(p)).or_default().push(*p));
    let mut unseen: BTreeSet<[i64; 2]> = cells.keys().copied().collect();
    let mut found = Vec::new();
    while let Some(start) = unseen.pop_first() {
        let (mut stack, mut members) = (vec![start], Vec::new());
        while let Some([x, y]) = stack.pop() {
            members.extend(cells.remove(&[x, y]).unwrap_or_default());
            for next in (0..9).map(|i| [x + i % 3 - 1, y + i / 3 - 1]) {
                if unseen.remove(&next) {
                    stack.push(next);
                }
            }
        }
        found.push(members);
    }
    found
}

/// A point around the middle of its loop.
struct Polar {
    /// Share of a turn, 0 to 1.
    turn: f64,
    radius: f64,
    rise: f64,
}

fn trace(points: &[Flat]) -> Option<Loop> {
    let hull = convex_hull(points.iter().map(|p| p.place).collect());
    let middle = middle(&hull)?;
    let polar: Vec<Polar> = points
        .iter()
        .map(|p| {
            let (x, y) = (p.place[0] - middle[0], p.place[1] - middle[1]);
            Polar { turn: y.atan2(x).rem_euclid(TAU) / TAU, radius: x.hypot(y), rise: p.rise }
        })
        .collect();
    let knots = ((length(&hull) / KNOT_M) as usize).clamp(16, 160);
    let fit = fit(&polar, knots)?;
    let outline: Vec<[f64; 2]> = (0..DRAWN)
        .map(|i| {
            let turn = i as f64 / DRAWN as f64;
            let radius = fit.radius(turn);
            let (sin, cos) = (TAU * turn).sin_cos();
            [middle[0] + radius * cos, middle[1] + radius * sin]
        })
        .collect();
    Some(Loop {
        contour_mm: 1e3 * length(&outline),
        hull_mm: 1e3 * length(&convex_hull(outline.clone())),
        middle_m: middle,
        points: points.len(),
        left_out: fit.left_out,
        rms_mm: 1e3 * fit.rms,
        gap_mm: 1e3 * longest_gap(&polar, &fit),
        folded_share: folded_share(&polar, &fit),
        outline_m: outline,
    })
}

/// Centre of area of a polygon; `None` where it has none.
fn middle(polygon: &[[f64; 2]]) -> Option<[f64; 2]> {
    let (mut area, mut x, mut y) = (0.0, 0.0, 0.0);
    let origin = *polygon.first()?;
    for (a, b) in polygon.iter().zip(polygon.iter().cycle().skip(1)) {
        let (a, b) = ([a[0] - origin[0], a[1] - origin[1]], [b[0] - origin[0], b[1] - origin[1]]);
        let cross = a[0] * b[1] - a[1] * b[0];
        area += cross;
        x += cross * (a[0] + b[0]) / 3.0;
        y += cross * (a[1] + b[1]) / 3.0;
    }
    (area > 1e-6).then(|| [origin[0] + x / area, origin[1] + y / area])
}

fn length(polygon: &[[f64; 2]]) -> f64 {
    let next = polygon.iter().cycle().skip(1);
    polygon.iter().zip(next).map(|(a, b)| (b[0] - a[0]).hypot(b[1] - a[1])).sum()
}

/// A closed spline of the turn, and how well it fits.
struct Fit {
    coefficients: DVector<f64>,
    knots: usize,
    rms: f64,
    left_out: usize,
}

impl Fit {
    fn radius(&self, turn: f64) -> f64 {
        basis(turn, self.knots).into_iter().map(|(i, b)| b * self.coefficients[i]).sum()
    }
}

/// The four cubic B-splines of a closed spline that are not zero at a turn.
fn basis(turn: f64, knots: usize) -> [(usize, f64); 4] {
    let x = turn * knots as f64;
    let (cell, t) = (x.floor(), x - x.floor());
    let (u, cell) = (1.0 - t, cell as usize);
    let values = [
        u * u * u / 6.0,
        (3.0 * t * t * t - 6.0 * t * t + 4.0) / 6.0,
        (3.0 * u * u * u - 6.0 * u * u + 4.0) / 6.0,
        t * t * t / 6.0,
    ];
    std::array::from_fn(|i| ((cell + i) % knots, values[i]))
}

/// Rounds in which the weights settle.
const ROUNDS: usize = 8;

/// Fits radius, slope and curvature.
fn fit(points: &[Polar], knots: usize) -> Option<Fit> {
    let size = knots + 2 * COARSE_KNOTS;
    // Slope and curvature in units of the band, so that all columns are of one size.
    let row = |p: &Polar| {
        let rise = p.rise / BAND_M;
        let coarse = basis(p.turn, COARSE_KNOTS);
        let mut row = [(0usize, 0.0f64); 12];
        row[..4].copy_from_slice(&basis(p.turn, knots));
        for (i, (place, value)) in coarse.into_iter().enumerate() {
            row[4 + i] = (knots + place, value * rise);
            row[8 + i] = (knots + COARSE_KNOTS + place, value * rise * rise);
        }
        row
    };
    let rows: Vec<[(usize, f64); 12]> = points.iter().map(row).collect();
    let (mut weights, mut rests) = (vec![1.0; points.len()], Vec::new());
    let mut solution = DVector::zeros(size);
    for round in 0..ROUNDS {
        let (mut normal, mut right) = (DMatrix::zeros(size, size), DVector::zeros(size));
        for ((row, point), &weight) in rows.iter().zip(points).zip(&weights).filter(|(_, w)| **w > 0.0) {
            for &(i, a) in row {
                right[i] += weight * a * point.radius;
                for &(j, b) in row {
                    normal[(i, j)] += weight * a * b;
                }
            }
        }
        let mean = weights.iter().sum::<f64>() / knots as f64;
        penalize(&mut normal, 0, knots, STIFFNESS * mean);
        // Slope and curvature within the band change slowly around the loop, and are 0 where no point shows them.
        for start in [knots, knots + COARSE_KNOTS] {
            penalize(&mut normal, start, COARSE_KNOTS, mean);
            (start..start + COARSE_KNOTS).for_each(|i| normal[(i, i)] += 1e-3 * mean);
        }
        solution = normal.cholesky()?.solve(&right);
        let rest = |row: &[(usize, f64); 12], p: &Polar| {
            row.iter().map(|&(i, a)| a * solution[i]).sum::<f64>() - p.radius
        };
        rests = rows.iter().zip(points).map(|(row, p)| rest(row, p)).collect::<Vec<f64>>();
        let scale = 1.4826 * median(rests.iter().map(|r| r.abs())) + 1e-7;
        // The first rounds pull the spline off far outliers with a wider gate.
        let gate = TUKEY * scale * if round < 2 { 2.0 } else { 1.0 };
        let weight = |r: &f64| (1.0 - (r / gate).powi(2)).max(0.0).powi(2);
        weights = rests.iter().map(weight).collect();
    }
    let kept = rests.iter().zip(&weights).filter(|(_, w)| **w > 0.0);
    let (sum, n) = kept.fold((0.0, 0.0), |(s, n), (r, _)| (s + r * r, n + 1.0));
    let left_out = weights.iter().filter(|w| **w == 0.0).count();
    Some(Fit { coefficients: solution, knots, rms: (sum / n).sqrt(), left_out })
}

/// Adds `weight` times the squares of the second differences around a closed run of unknowns.
fn penalize(normal: &mut DMatrix<f64>, start: usize, count: usize, weight: f64) {
    for i in 0..count {
        let term = [(i, 1.0), ((i + 1) % count, -2.0), ((i + 2) % count, 1.0)];
        for (a, x) in term {
            for (b, y) in term {
                normal[(start + a, start + b)] += weight * x * y;
            }
        }
    }
}

/// Longest stretch of the contour between turns of points, m.
fn longest_gap(points: &[Polar], fit: &Fit) -> f64 {
    let mut turns: Vec<f64> = points.iter().map(|p| p.turn).collect();
    turns.sort_unstable_by(f64::total_cmp);
    let place = |turn: f64| {
        let (sin, cos) = (TAU * turn).sin_cos();
        let radius = fit.radius(turn.rem_euclid(1.0));
        [radius * cos, radius * sin]
    };
    let next = turns.iter().skip(1).copied().chain(turns.first().map(|t| t + 1.0));
    let gap = |(from, to): (&f64, f64)| {
        let (a, b) = (place(*from), place(to));
        (b[0] - a[0]).hypot(b[1] - a[1])
    };
    turns.iter().zip(next).map(gap).fold(0.0, f64::max)
}

/// Share of 360 rays on which more than a tenth of the points lie off the contour.
fn folded_share(points: &[Polar], fit: &Fit) -> f64 {
    let mut rays = [(0usize, 0usize); 360];
    for point in points {
        let ray = &mut rays[((point.turn * 360.0) as usize).min(359)];
        ray.0 += 1;
        ray.1 += usize::from((point.radius - fit.radius(point.turn)).abs() > FOLD_M);
    }
    rays.iter().filter(|(all, off)| off * 10 > *all).count() as f64 / 360.0
}

/// Names for the loops of one slice, in their order: the trunk keeps the name; others, and all where none is much
/// longer than the rest (legs), get the direction in which they lie, `NAME:+y`.
pub fn names(name: &str, loops: &[Loop]) -> Vec<String> {
    let main = match loops {
        [] | [_] => true,
        [first, second, ..] => first.hull_mm > 1.3 * second.hull_mm,
    };
    let n = loops.len().max(1) as f64;
    let mean = |axis: usize| loops.iter().map(|l| l.middle_m[axis]).sum::<f64>() / n;
    let centre = if main { loops.first().map_or([0.0; 2], |l| l.middle_m) } else { [mean(0), mean(1)] };
    let mut names: Vec<String> = Vec::new();
    for (i, one) in loops.iter().enumerate() {
        if main && i == 0 {
            names.push(name.to_owned());
            continue;
        }
        let (x, y) = (one.middle_m[0] - centre[0], one.middle_m[1] - centre[1]);
        let (axis, along) = if x.abs() > y.abs() { ('x', x) } else { ('y', y) };
        let base = format!("{name}:{}{axis}", if along < 0.0 { '-' } else { '+' });
        let count = names.iter().filter(|n| **n == base || n.starts_with(&format!("{base}."))).count();
        names.push(if count == 0 { base } else { format!("{base}.{}", count + 1) });
    }
    names
}

#[cfg(test)]
mod tests {
    use super::{Loop, SurfacePoint, loops, names};
    use crate::validate::deviations::Draws;
    use std::f64::consts::TAU;

    /// Points of an elliptic cone of half axes a and b at height 1, with noise along the normal and a slope.
    fn tube(a: f64, b: f64, centre: [f64; 2], slope: f64, noise_m: f64, seed: u64) -> Vec<SurfacePoint> {
        let mut draws = Draws(seed);
        let count = (TAU * (a + b) / 2.0 * 0.02 / (0.9e-3f64).powi(2)) as usize;
        (0..count)
            .map(|_| {
                let (t, z) = (TAU * draws.share(), 0.02 * (draws.share() - 0.5));
                // The profile bends: half axes grow by slope * z + z² / 0.2.
                let (grow, steep) = (slope * z + z * z / 0.2, slope + z / 0.1);
                let (sin, cos) = t.sin_cos();
                let n = [cos / (a + grow), sin / (b + grow)];
                let size = n[0].hypot(n[1]);
                let n = [n[0] / size, n[1] / size];
                let nz = -steep * (n[0] * cos + n[1] * sin);
                let full = (1.0 + nz * nz).sqrt();
                let normal = [n[0] / full, n[1] / full, nz / full];
                let error = noise_m * draws.normal();
                let place = [centre[0] + (a + grow) * cos, centre[1] + (b + grow) * sin, 1.0 + z];
                SurfacePoint {
                    position_m: std::array::from_fn(|i| (place[i] + error * normal[i]) as f32),
                    normal: normal.map(|x| x as f32),
                }
            })
            .collect()
    }

    /// Girth of an ellipse, m, by many chords.
    fn ellipse(a: f64, b: f64) -> f64 {
        let place = |i: usize| {
            let t = TAU * i as f64 / 100_000.0;
            [a * t.cos(), b * t.sin()]
        };
        (0..100_000).map(|i| (place(i + 1)[0] - place(i)[0]).hypot(place(i + 1)[1] - place(i)[1])).sum()
    }

    /// Half axes whose ellipse is 900 mm round.
    const WAIST: [f64; 2] = [0.170, 0.113_7];

    #[test]
    fn noise_does_not_lengthen_a_girth() {
        let known = 1e3 * ellipse(WAIST[0], WAIST[1]);
        assert!((known - 900.0).abs() < 1.0, "{known}");
        let mut errors = Vec::new();
        for seed in 0..6 {
            let found = loops(tube(WAIST[0], WAIST[1], [0.02, -0.03], 0.3, 2e-4, seed).into_iter(), 1.0);
            assert_eq!(found.len(), 1);
            errors.push(found[0].contour_mm - known);
            assert!((found[0].hull_mm - known).abs() < 0.1, "{} {known}", found[0].hull_mm);
            assert!((found[0].rms_mm - 0.2).abs() < 0.02, "{}", found[0].rms_mm);
        }
        let mean = errors.iter().sum::<f64>() / errors.len() as f64;
        assert!(mean.abs() < 0.05, "{errors:?}");
        assert!(errors.iter().all(|e| e.abs() < 0.1), "{errors:?}");
    }

    #[test]
    fn outliers_and_a_gap_do_little() {
        let known = 1e3 * ellipse(WAIST[0], WAIST[1]);
        let mut points = tube(WAIST[0], WAIST[1], [0.0, 0.0], 0.0, 1e-4, 9);
        points.retain(|p| !(p.position_m[0] > 0.16 && p.position_m[1].abs() < 0.02));
        for point in points.iter_mut().step_by(40) {
            point.position_m[0] *= 1.03;
        }
        let found = loops(points.into_iter(), 1.0);
        assert!((found[0].contour_mm - known).abs() < 1.0, "{:?} {known}", found[0].contour_mm);
        assert!((found[0].gap_mm - 40.0).abs() < 5.0, "{}", found[0].gap_mm);
        assert!(found[0].left_out > 50, "{}", found[0].left_out);
    }

    #[test]
    fn a_hollow_is_in_the_contour_but_not_in_the_hull() {
        let mut points = tube(0.15, 0.15, [0.0, 0.0], 0.0, 1e-4, 4);
        for p in &mut points {
            let angle = f64::from(p.position_m[1]).atan2(f64::from(p.position_m[0]));
            let dent = 1.0 - 0.1 * (-(angle / 0.25).powi(2)).exp();
            (p.position_m[0], p.position_m[1]) =
                (p.position_m[0] * dent as f32, p.position_m[1] * dent as f32);
        }
        let found = loops(points.into_iter(), 1.0);
        let radius = |t: f64| 0.15 * (1.0 - 0.1 * (-(t / 0.25f64).powi(2)).exp());
        let place = |i: i32| {
            let t = f64::from(i) * TAU / 20_000.0;
            [radius(t) * t.cos(), radius(t) * t.sin()]
        };
        let known: f64 = (-10_000..10_000)
            .map(|i| (place(i + 1)[0] - place(i)[0]).hypot(place(i + 1)[1] - place(i)[1]))
            .sum();
        assert!((found[0].contour_mm - 1e3 * known).abs() < 0.15, "{} {known}", found[0].contour_mm);
        // The hull bridges the hollow: 0.805 mm less, by many chords.
        assert!((found[0].contour_mm - found[0].hull_mm - 0.805).abs() < 0.15, "{}", found[0].hull_mm);
    }

    #[test]
    fn legs_are_two_loops_and_arms_lie_beside_the_trunk() {
        let mut points = tube(0.08, 0.08, [0.0, 0.12], 0.0, 1e-4, 1);
        points.extend(tube(0.082, 0.08, [0.0, -0.12], 0.0, 1e-4, 2));
        let legs = loops(points.iter().copied(), 1.0);
        assert_eq!(names("thigh", &legs), ["thigh:-y", "thigh:+y"]);
        let round = |l: &Loop| (l.contour_mm - 1e3 * TAU * 0.08).abs();
        assert!(round(&legs[1]) < 0.1, "{}", legs[1].contour_mm);
        let mut points = tube(WAIST[0], WAIST[1], [0.0, 0.0], 0.0, 1e-4, 3);
        points.extend(tube(0.04, 0.04, [0.26, 0.0], 0.0, 1e-4, 4));
        points.extend(tube(0.04, 0.04, [0.39, 0.0], 0.0, 1e-4, 5));
        let body = loops(points.into_iter(), 1.0);
        let mut found = names("waist", &body);
        found.sort();
        assert_eq!(found, ["waist", "waist:+x", "waist:+x.2"]);
        assert!(loops(std::iter::empty(), 1.0).is_empty());
    }
}
