//! Which fringe orders the working volume allows.

use crate::reconstruct::pair::Pair;
use std::ops::RangeInclusive;

/// No surface is nearer to a camera, m.
const NEAREST_M: f64 = 0.05;

/// Fringe orders that put a pixel with this phase in its piece into the volume, and one more at either end. `None` where
/// its ray misses the volume.
pub fn orders_inside(pair: &Pair, u: usize, v: usize, relative: f32) -> Option<RangeInclusive<i32>> {
    let ray = pair.camera.ray(u as f64, v as f64)?;
    let (from, to) = (ray.at(0.0), ray.at(1.0));
    let (mut near, mut far) = (NEAREST_M, f64::INFINITY);
    for i in 0..3 {
        let ends = [pair.volume_min_m[i], pair.volume_max_m[i]].map(|x| (x - from[i]) / (to[i] - from[i]));
        (near, far) = (near.max(ends[0].min(ends[1])), far.min(ends[0].max(ends[1])));
    }
    if near > far {
        return None;
    }
    let fringes = (pair.projector.width as f64 / pair.pattern.period_px) as i32;
    let order = |distance: f64| {
        let column = pair.projector.project(&ray.at(distance)).map(|[column, _]| column);
        let phase = column.map(|column| pair.pattern.phase(column) - f64::from(relative));
        phase.map(|phase| (phase / std::f64::consts::TAU).floor() as i32)
    };
    // Behind the projector or beyond its lens there is no column: then no order is left out.
    let (a, b) = order(near).zip(order(far)).unwrap_or((-fringes, 2 * fringes));
    Some((a.min(b) - 1).max(-fringes)..=(a.max(b) + 2).min(2 * fringes))
}
