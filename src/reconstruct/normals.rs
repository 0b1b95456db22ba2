//! Normals from the points of neighbouring pixels.

use crate::image::Plane;

/// Pixels to the neighbours whose points span the tangent plane; nearer ones where these are missing.
const REACH_PX: [usize; 2] = [3, 1];

/// Neighbours this much further away than the pixel spacing allows are on another surface.
const MAX_STRETCH: f32 = 6.0;

/// The unit normal of pixel (u, v), towards the camera at the origin, from points in camera axes (NaN: none).
/// `None` where the neighbours do not span a plane.
pub fn normal(points: &Plane<[f32; 3]>, u: usize, v: usize, focal_px: f32) -> Option<[f32; 3]> {
    let centre = points.at(u, v);
    let spacing = centre[2] / focal_px;
    let across = tangent(points, centre, spacing, |k| {
        (u.checked_sub(k).map(|x| (x, v)), (u + k < points.width()).then_some((u + k, v)))
    })?;
    let along = tangent(points, centre, spacing, |k| {
        (v.checked_sub(k).map(|y| (u, y)), (v + k < points.height()).then_some((u, v + k)))
    })?;
    let n = [
        across[1] * along[2] - across[2] * along[1],
        across[2] * along[0] - across[0] * along[2],
        across[0] * along[1] - across[1] * along[0],
    ];
    let length = dot(n, n).sqrt();
    // Towards the camera: against the direction of view.
    let facing = if dot(n, centre) > 0.0 { -1.0 } else { 1.0 };
    (length > 0.0).then(|| n.map(|x| facing * x / length))
}

type Place = Option<(usize, usize)>;

/// Difference of the points before and after, of one of them to the centre where the other is missing.
fn tangent(
    points: &Plane<[f32; 3]>,
    centre: [f32; 3],
    spacing: f32,
    places: impl Fn(usize) -> (Place, Place),
) -> Option<[f32; 3]> {
    REACH_PX.iter().find_map(|&k| {
        let limit = MAX_STRETCH * spacing * k as f32;
        let near = |place: Place| {
            let point = place.map(|(u, v)| points.at(u, v))?;
            let d = sub(point, centre);
            (dot(d, d) <= limit * limit).then_some(point)
        };
        let (before, after) = places(k);
        match (near(before), near(after)) {
            (Some(a), Some(b)) => Some(sub(b, a)),
            (Some(a), None) => Some(sub(centre, a)),
            (None, Some(b)) => Some(sub(b, centre)),
            (None, None) => None,
        }
    })
}

fn sub(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

/// Scalar product.
pub(super) fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[cfg(test)]
mod tests {
    use super::normal;
    use crate::image::Plane;

    /// A plane x + z = 3 before the camera, and a hole.
    #[test]
    fn a_tilted_plane_has_its_normal_up_to_its_edges() {
        let mut points = Plane::filled(20, 20, [f32::NAN; 3]);
        for v in 0..20 {
            for u in 0..20 {
                let x = (u as f32 - 10.0) * 0.001;
                points.set(u, v, [x, (v as f32 - 10.0) * 0.001, 3.0 - x]);
            }
        }
        points.set(10, 10, [f32::NAN; 3]);
        for (u, v) in [(0, 0), (19, 19), (9, 10), (13, 10), (5, 5)] {
            let n = normal(&points, u, v, 2000.0).expect("a plane");
            let expected = -std::f32::consts::FRAC_1_SQRT_2;
            assert!((n[0] - expected).abs() < 1e-3 && (n[2] - expected).abs() < 1e-3, "{n:?}");
        }
    }
}
