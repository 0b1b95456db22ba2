// SPDX-License-Identifier: MIT OR Apache-2.0
//! Distances between points (paper, 5.2: 1.5 mm in a directional cloud, 1.0 mm in the merged one).
//!
//! A directional cloud has a point per pixel: its spacing is the mean distance of the points of pixels beside or above
//! one another. Pairs longer than [`STEP`] times the median lie on both sides of a step in depth and do not count.
//!
//! A merged cloud has no such neighbours. Three numbers describe it: the mean distance to the nearest point, that to
//! the four nearest, and the density spacing: the side of the square that each point has to itself, from the number of
//! points within [`DISC_M`] of each. Where cameras overlap the nearest point may be any distance, so that only the
//! last measures how fine a detail the cloud can hold.

use crate::data::Cloud;
use crate::geometry::cells::{Cells, cell_of};
use nalgebra::Point3;
use rayon::iter::{IntoParallelIterator, ParallelIterator};
use serde::Serialize;
use std::collections::HashMap;

/// Pairs longer than this many medians are no neighbours on the surface.
pub const STEP: f64 = 5.0;
/// Neighbours are looked for this far, m; points without four in reach are lone.
pub const REACH_M: f64 = 0.005;
/// Radius of the disc in which points are counted, m: no more than the reach.
pub const DISC_M: f64 = 0.005;

/// Spacing of a directional cloud.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Directional {
    pub points: usize,
    /// Mean distance of pixel neighbours, mm.
    pub spacing_mm: f64,
    /// The same of neighbours along columns of the image (u), mm.
    pub spacing_u_mm: f64,
    /// The same of neighbours along rows of the image (v), mm.
    pub spacing_v_mm: f64,
    /// Area of the cells of the pixel grid that have points at all corners, m².
    pub area_m2: f64,
}

/// Measures a directional cloud; `None` where no two points are neighbours.
pub fn directional(cloud: &Cloud) -> Option<Directional> {
    let places: HashMap<[u16; 2], usize> = cloud.pixel.iter().enumerate().map(|(i, p)| (*p, i)).collect();
    let point = |i: usize| Point3::from(cloud.position_m[i]).cast::<f64>();
    let neighbour = |i: usize, step: [u16; 2]| {
        let [u, v] = cloud.pixel[i];
        places.get(&[u.checked_add(step[0])?, v.checked_add(step[1])?]).map(|&j| point(j))
    };
    let (mut along_u, mut along_v, mut area_m2) = (Vec::new(), Vec::new(), 0.0);
    for i in 0..cloud.len() {
        let (u, v) = (neighbour(i, [1, 0]), neighbour(i, [0, 1]));
        along_u.extend(u.map(|p| (p - point(i)).norm()));
        along_v.extend(v.map(|p| (p - point(i)).norm()));
        if let (Some(u), Some(v), Some(_)) = (u, v, neighbour(i, [1, 1]))
            && (u - point(i)).norm().max((v - point(i)).norm()) < 0.02
        {
            area_m2 += (u - point(i)).cross(&(v - point(i))).norm();
        }
    }
    let mean = |distances: &mut Vec<f64>| {
        let middle = distances.len() / 2;
        if distances.is_empty() {
            return None;
        }
        let median = *distances.select_nth_unstable_by(middle, f64::total_cmp).1;
        let kept = distances.iter().filter(|d| **d <= STEP * median);
        let (sum, n) = kept.fold((0.0, 0.0), |(s, n), d| (s + d, n + 1.0));
        Some((sum, n))
    };
    let ((sum_u, n_u), (sum_v, n_v)) = (mean(&mut along_u)?, mean(&mut along_v)?);
    Some(Directional {
        points: cloud.len(),
        spacing_mm: 1e3 * (sum_u + sum_v) / (n_u + n_v),
        spacing_u_mm: 1e3 * sum_u / n_u,
        spacing_v_mm: 1e3 * sum_v / n_v,
        area_m2,
    })
}

/// Spacing of a merged cloud.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Merged {
    pub points: usize,
    /// Points with fewer than four others in reach; they do not count.
    pub lone: usize,
    /// Mean distance to the nearest point, mm.
    pub nearest_mm: f64,
    /// Mean distance to the four nearest points, mm.
    pub nearest_4_mm: f64,
    /// Side of the square that each point has to itself: root of area by points, mm.
    pub density_mm: f64,
}

/// Measures a merged cloud; `None` where all points are lone.
pub fn merged(cloud: &Cloud) -> Option<Merged> {
    let points = cloud.position_m.iter().filter(|p| p.iter().all(|x| x.is_finite()));
    let points = points.map(|p| Point3::from(*p).cast::<f64>());
    let cells = Cells::new(points.map(|point| (cell_of(point.into(), REACH_M), point)));
    // Floating sums depend on their order: cells are summed one by one.
    let each: Vec<_> = cells.each().collect();
    let sums = each.into_par_iter().map(|(cell, members)| {
        let (around, mut sums) = (cells.around(cell).copied().collect::<Vec<_>>(), Sums::default());
        members.for_each(|point| sums.add(point, &around, REACH_M));
        sums
    });
    let sums: Vec<Sums> = sums.collect();
    let all = sums.into_iter().fold(Sums::default(), Sums::join);
    let n = all.count as f64;
    (all.count > 0).then(|| Merged {
        points: cloud.len(),
        lone: cloud.len() - all.count,
        nearest_mm: 1e3 * all.nearest / n,
        nearest_4_mm: 1e3 * all.four / n,
        density_mm: 1e3 * (all.area / n).sqrt(),
    })
}

/// Sums over points that have neighbours.
#[derive(Debug, Default, Clone, Copy)]
struct Sums {
    count: usize,
    nearest: f64,
    four: f64,
    area: f64,
}

impl Sums {
    fn add(&mut self, point: &Point3<f64>, around: &[Point3<f64>], reach_m: f64) {
        // Squared distances of the five nearest: the first is the point itself.
        let (mut nearest, mut within) = ([f64::INFINITY; 5], 0usize);
        for other in around {
            let d = (other - point).norm_squared();
            within += usize::from(d < DISC_M * DISC_M);
            if d < nearest[4] {
                let place = nearest.iter().position(|x| d < *x).unwrap_or(4);
                nearest[place..].rotate_right(1);
                nearest[place] = d;
            }
        }
        if !(nearest[4] <= reach_m * reach_m) {
            return;
        }
        self.count += 1;
        self.nearest += nearest[1].sqrt();
        self.four += nearest[1..].iter().map(|d| d.sqrt()).sum::<f64>() / 4.0;
        self.area += std::f64::consts::PI * DISC_M * DISC_M / within as f64;
    }

    fn join(self, other: Self) -> Self {
        Self {
            count: self.count + other.count,
            nearest: self.nearest + other.nearest,
            four: self.four + other.four,
            area: self.area + other.area,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{directional, merged};
    use crate::data::Cloud;

    /// A tilted plane with a point every `step` m along both image axes.
    fn plane(side: u16, step: f32) -> Cloud {
        let mut cloud = Cloud::default();
        for v in 0..side {
            for u in 0..side {
                let (x, y) = (f32::from(u) * step, f32::from(v) * step);
                cloud.position_m.push([0.6 * x, y, 0.8 * x]);
                cloud.normal.push([-0.8, 0.0, 0.6]);
                cloud.intensity.push(0.5);
                cloud.pixel.push([u, v]);
            }
        }
        cloud
    }

    #[test]
    fn a_lattice_has_its_own_spacing() {
        let cloud = plane(150, 0.001);
        let found = directional(&cloud).expect("neighbours");
        assert!(
            (found.spacing_mm - 1.0).abs() < 1e-3 && (found.area_m2 - 0.149 * 0.149).abs() < 1e-5,
            "{found:?}"
        );
        let found = merged(&cloud).expect("neighbours");
        assert_eq!((found.points, found.lone), (22_500, 0));
        assert!((found.nearest_mm - 1.0).abs() < 1e-3, "{found:?}");
        // Corners and edges have a diagonal neighbour among their four.
        assert!((found.nearest_4_mm - 1.0).abs() < 0.01, "{found:?}");
        // At the rim the disc is half empty: a part 2 * 5 mm of 149 counts up to double.
        assert!((found.density_mm - 1.0).abs() < 0.05, "{found:?}");
    }

    #[test]
    fn a_step_in_depth_is_no_spacing_and_lone_points_do_not_count() {
        let mut cloud = plane(100, 0.001);
        for (position, pixel) in cloud.position_m.iter_mut().zip(&cloud.pixel) {
            position[1] += if pixel[1] >= 50 { 0.3 } else { 0.0 };
        }
        let found = directional(&cloud).expect("neighbours");
        assert!((found.spacing_mm - 1.0).abs() < 1e-3, "{found:?}");
        cloud.position_m[0] = [3.0, 3.0, 3.0];
        assert_eq!(merged(&cloud).map(|m| m.lone), Some(1));
        assert_eq!(directional(&Cloud::default()), None);
        assert_eq!(merged(&Cloud::default()), None);
    }

    #[test]
    fn two_clouds_halve_the_area_of_a_point() {
        let mut cloud = plane(150, 0.001);
        let mut other = plane(150, 0.001);
        other.position_m.iter_mut().for_each(|p| *p = [p[0] + 0.0003, p[1] + 0.0005, p[2] + 0.0004]);
        cloud.position_m.append(&mut other.position_m);
        let found = merged(&cloud).expect("neighbours");
        assert!((found.density_mm - 0.5f64.sqrt()).abs() < 0.04, "{found:?}");
        assert!(found.nearest_mm < 0.72, "{found:?}");
    }
}
