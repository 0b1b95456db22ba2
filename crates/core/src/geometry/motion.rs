// SPDX-License-Identifier: MIT OR Apache-2.0
//! The rigid motion between two sets of points.

use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};

/// The rigid motion that takes the first point of each pair to the second with the least sum of squares (Kabsch 1976;
/// no scale). `None` for fewer than three pairs, and where a coordinate is not finite. Points on one line leave the
/// turn about it open: any of them is returned then.
pub fn best_motion(pairs: &[(Point3<f64>, Point3<f64>)]) -> Option<Isometry3<f64>> {
    let finite = pairs.iter().all(|(a, b)| a.iter().chain(b.iter()).all(|x| x.is_finite()));
    if pairs.len() < 3 || !finite {
        return None;
    }
    let n = pairs.len() as f64;
    let from = pairs.iter().map(|(p, _)| p.coords).sum::<Vector3<f64>>() / n;
    let to = pairs.iter().map(|(_, q)| q.coords).sum::<Vector3<f64>>() / n;
    let spread: Matrix3<f64> =
        pairs.iter().map(|(p, q)| (q.coords - to) * (p.coords - from).transpose()).sum();
    // Singular values come in descending order: a mirror image is undone along the least one.
    let svd = spread.svd(true, true);
    let (u, v_t) = (svd.u?, svd.v_t?);
    let sign = Vector3::new(1.0, 1.0, (u * v_t).determinant().signum());
    let rotation = Rotation3::from_matrix_unchecked(u * Matrix3::from_diagonal(&sign) * v_t);
    let shift = Translation3::from(to - rotation * from);
    Some(Isometry3::from_parts(shift, UnitQuaternion::from_rotation_matrix(&rotation)))
}

#[cfg(test)]
mod tests {
    use super::best_motion;
    use nalgebra::{Isometry3, Point3, Vector3};
    use proptest::prelude::{ProptestConfig, prop_assert, proptest};

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(100))]
        #[test]
        fn a_motion_is_found_again(
            turn in proptest::array::uniform3(-2.0..2.0f64), shift in proptest::array::uniform3(-3.0..3.0f64),
            points in proptest::collection::vec(proptest::array::uniform3(-1.0..1.0f64), 4..20), flat: bool,
        ) {
            let motion = Isometry3::new(Vector3::from(shift), Vector3::from(turn));
            let points = points.iter().map(|&[x, y, z]| Point3::new(x, y, if flat { 0.0 } else { z }));
            let pairs: Vec<_> = points.map(|p| (p, motion * p)).collect();
            let found = best_motion(&pairs).expect("enough points");
            prop_assert!(pairs.iter().all(|(p, q)| (found * p - q).norm() < 1e-6), "{found} {motion}");
        }
    }

    #[test]
    fn too_little_is_no_motion() {
        let p = Point3::new(1.0, 2.0, 3.0);
        assert_eq!(best_motion(&[(p, p), (p, p)]), None);
        assert_eq!(best_motion(&[(p, p), (p, p), (p, Point3::new(f64::NAN, 0.0, 0.0))]), None);
    }
}
