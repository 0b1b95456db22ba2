// SPDX-License-Identifier: MIT OR Apache-2.0
//! Normals from the points of neighbouring pixels.
//!
//! A normal is the cross product of two differences of points: along the row and along the column, over three pixels
//! to each side, over one where a neighbour at three is missing or on another surface, to one side where only that
//! has a neighbour.

use super::ray_table::RayTable;

/// Pixels to the neighbours whose points span the tangent plane; nearer ones where these are missing.
const REACH_PX: [usize; 2] = [3, 1];

/// Rows and columns that a normal reaches to each side, px.
pub(crate) const REACH: usize = REACH_PX[0];

/// Neighbours this much further away than the pixel spacing allows are on another surface.
const MAX_STRETCH: f32 = 6.0;

/// Pixels that are worked on at once.
pub(crate) const LANES: usize = 16;

/// One coordinate of some points.
type Lanes = [f32; LANES];

/// The coordinates of the points of a row, in the world, with room to either side; NaN: none.
pub(crate) type Row<'a> = [&'a [f32]; 3];

#[inline(always)]
fn at(row: &Row<'_>, place: usize) -> [Lanes; 3] {
    [lanes(row[0], place), lanes(row[1], place), lanes(row[2], place)]
}

#[inline(always)]
fn lanes(from: &[f32], place: usize) -> Lanes {
    let mut to = [0f32; LANES];
    to.copy_from_slice(&from[place..place + LANES]);
    to
}

/// The unit normals of some points.
pub(crate) struct Oriented {
    pub normal: [Lanes; 3],
    /// 1 where there is a point with a normal that does not face away from the projector.
    pub good: [u8; LANES],
}

/// The normals of the points at `place ..` of the middle row, towards the camera. `rows` are those at -3, -1, 0,
/// 1 and 3. A point without a normal, or that faces away from the projector that is supposed to light it, is no good.
/// Without `NEAR` only neighbours at three pixels count: few blocks need nearer ones.
#[inline(always)]
pub(crate) fn orient<const NEAR: bool>(rows: &[Row<'_>; 5], place: usize, table: &RayTable) -> Oriented {
    let [above, just_above, own, just_below, below] = rows;
    let centre = at(own, place);
    let limit = limits(&centre, table);
    let [far, near] = REACH_PX;
    let (mut across, has) = differences(&centre, &limit, far, &[at(own, place - far), at(own, place + far)]);
    if NEAR {
        let beside = [at(own, place - near), at(own, place + near)];
        complete(&mut across, &has, &differences(&centre, &limit, near, &beside).0);
    }
    let (mut along, has) = differences(&centre, &limit, far, &[at(above, place), at(below, place)]);
    if NEAR {
        let beside = [at(just_above, place), at(just_below, place)];
        complete(&mut along, &has, &differences(&centre, &limit, near, &beside).0);
    }
    let mut out = Oriented { normal: [[0.0; LANES]; 3], good: [0; LANES] };
    for i in 0..LANES {
        let (a, b) = (pick(&across, i), pick(&along, i));
        let n = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
        let length = dot(n, n).sqrt();
        // Towards the camera: against the direction of view.
        let facing = if dot(n, from(table.centre, &centre, i)) > 0.0 { -1.0 } else { 1.0 };
        let scale = facing / length;
        let n = [n[0] * scale, n[1] * scale, n[2] * scale];
        // False where a tangent is missing: then the length is 0 or NaN.
        out.good[i] = u8::from((length > 0.0) & (dot(n, from(table.projector, &centre, i)) < 0.0));
        out.normal[0][i] = n[0];
        out.normal[1][i] = n[1];
        out.normal[2][i] = n[2];
    }
    out
}

/// Squares of the largest distances to a neighbouring pixel's point on the same surface.
#[inline(always)]
fn limits(points: &[Lanes; 3], table: &RayTable) -> Lanes {
    // Coordinate by coordinate: of a loop over points the compiler would make vectors of three coordinates.
    let mut depth = [0f32; LANES];
    for (axis, points) in points.iter().enumerate() {
        let (centre, forward) = (table.centre[axis], table.forward[axis]);
        for i in 0..LANES {
            depth[i] += (points[i] - centre) * forward;
        }
    }
    let mut limit = [0f32; LANES];
    for i in 0..LANES {
        let spacing = MAX_STRETCH * depth[i] / table.focal_px;
        limit[i] = spacing * spacing;
    }
    limit
}

/// Differences of the points before and after, of one of them to the centre where the other is missing, 0 where both
/// are; and where there is one (all bits). `limit`: the square of the largest distance for a reach of 1.
#[inline(always)]
fn differences(
    centre: &[Lanes; 3],
    limit: &Lanes,
    reach: usize,
    [before, after]: &[[Lanes; 3]; 2],
) -> ([Lanes; 3], [u32; LANES]) {
    let (mut out, mut has) = ([[0f32; LANES]; 3], [0u32; LANES]);
    let squared = (reach * reach) as f32;
    for i in 0..LANES {
        let c = pick(centre, i);
        let (a, b) = (pick(before, i), pick(after, i));
        let (da, db) = (sub(a, c), sub(b, c));
        // False for NaN.
        let has_a = dot(da, da) <= limit[i] * squared;
        let has_b = dot(db, db) <= limit[i] * squared;
        for axis in 0..3 {
            let end = if has_b { b[axis] } else { c[axis] };
            let start = if has_a { a[axis] } else { c[axis] };
            out[axis][i] = end - start;
        }
        has[i] = if has_a | has_b { u32::MAX } else { 0 };
    }
    (out, has)
}

/// Takes nearer differences where there are none.
#[inline(always)]
fn complete(out: &mut [Lanes; 3], has: &[u32; LANES], nearer: &[Lanes; 3]) {
    for (out, nearer) in out.iter_mut().zip(nearer) {
        for i in 0..LANES {
            out[i] = if has[i] != 0 { out[i] } else { nearer[i] };
        }
    }
}

/// From `origin` to point `i`.
#[inline(always)]
fn from(origin: [f32; 3], points: &[Lanes; 3], i: usize) -> [f32; 3] {
    sub(pick(points, i), origin)
}

#[inline(always)]
fn pick(points: &[Lanes; 3], i: usize) -> [f32; 3] {
    [points[0][i], points[1][i], points[2][i]]
}

#[inline(always)]
fn sub(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

#[inline(always)]
fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[cfg(test)]
mod tests {
    use super::{LANES, orient};
    use crate::triangulate::ray_table::RayTable;
    use crate::triangulate::triangulator::tests::strong_lenses;
    use nalgebra::{Point3, Vector3};

    /// A tilted plane before the camera, with a hole.
    #[test]
    fn a_tilted_plane_has_its_normal_up_to_its_edges() {
        let pair = strong_lenses();
        let table = RayTable::new(&pair);
        let camera = pair.camera.world_from_device.isometry();
        let world = |x: f64, y: f64| camera.transform_point(&Point3::new(x, y, 3.0 - x));
        let rows: Vec<[Vec<f32>; 3]> = (0..20)
            .map(|v| {
                let mut row = [Vec::new(), Vec::new(), Vec::new()];
                for u in -3..3 + 2 * LANES as i32 {
                    let point = world(f64::from(u - 10) * 1e-3, f64::from(v - 10) * 1e-3).cast::<f32>();
                    let hole = (u, v) == (10, 10) || !(0..20).contains(&u);
                    row[0].push(if hole { f32::NAN } else { point.x });
                    row[1].push(if hole { f32::NAN } else { point.y });
                    row[2].push(if hole { f32::NAN } else { point.z });
                }
                row
            })
            .collect();
        let width = 6 + 2 * LANES;
        let none = || vec![f32::NAN; width];
        let empty = [none(), none(), none()];
        let expected = (camera.rotation * Vector3::new(-1.0, 0.0, -1.0).normalize()).cast::<f32>();
        for (u, v) in [(0, 0), (19, 19), (9, 10), (13, 10), (5, 5)] {
            let row = |dv: i32| usize::try_from(v + dv).ok().and_then(|v| rows.get(v)).unwrap_or(&empty);
            let place = 3 + u / LANES * LANES;
            let near = [row(-3), row(-1), row(0), row(1), row(3)]
                .map(|row| row.each_ref().map(|axis| &axis[..width]));
            let found = orient::<true>(&near, place, &table);
            let i = u % LANES;
            let n = Vector3::from(found.normal.map(|axis| axis[i]));
            assert!((n - expected).norm() < 2e-3, "({u}, {v}): {n:?}, not {expected:?}");
            assert_eq!(found.good[i], 1, "({u}, {v})");
        }
        let alone =
            [&empty, &empty, &rows[5], &empty, &empty].map(|row| row.each_ref().map(|axis| &axis[..width]));
        let found = orient::<true>(&alone, 3, &table);
        assert_eq!(found.good, [0; LANES]);
    }
}
