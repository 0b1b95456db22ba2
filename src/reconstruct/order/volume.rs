//! Which fringe orders the working volume allows.

use crate::reconstruct::pair::Pair;
use std::ops::RangeInclusive;

/// Fringe orders that put any of some pixels, with their phases in their piece, into the volume. `None` where all rays miss it.
pub fn orders_of(
    pair: &Pair,
    places: impl Iterator<Item = (usize, usize, f32)>,
) -> Option<RangeInclusive<i32>> {
    let each = places.filter_map(|(u, v, phase)| orders_inside(pair, u, v, phase));
    each.reduce(|a, b| *a.start().min(b.start())..=*a.end().max(b.end()))
}

/// Fringe orders that put a pixel with this phase in its piece into the volume, and one more at either end. `None` where
/// its ray misses the volume.
fn orders_inside(pair: &Pair, u: usize, v: usize, relative: f32) -> Option<RangeInclusive<i32>> {
    let (ray, [near, far]) = pair.distances_in_volume(u, v)?;
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
