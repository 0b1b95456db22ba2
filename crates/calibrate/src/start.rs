// SPDX-License-Identifier: MIT OR Apache-2.0
//! Where the board is, roughly: from one view and a lens that is nearly right.

use super::board::Board;
use super::lattice::Sighting;
use crate::geometry::Lens;
use nalgebra::{DMatrix, Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};

/// The board's pose before a camera (`camera_from_board`), by the homography of its plane (Zhang 2000); `None` where
/// the view does not determine it.
pub fn board_pose(board: &Board, sightings: &[Sighting], lens: &Lens) -> Option<Isometry3<f64>> {
    let pairs: Vec<([f64; 2], [f64; 2])> = sightings
        .iter()
        .filter_map(|sighting| {
            let circle = board.circles().get(sighting.circle)?;
            let [u, v] = sighting.spot.ellipse.centre;
            Some(([circle.centre_m[0], circle.centre_m[1]], lens.undistort(u, v)?))
        })
        .collect();
    let homography = homography(&pairs)?;
    let (a, b, t) = (homography.column(0), homography.column(1), homography.column(2));
    // Both columns are unit vectors times the same factor; the board lies in front of the camera.
    let scale = 2.0 / (a.norm() + b.norm()) * t.z.signum();
    let (x, y) = ((a * scale).normalize(), b * scale);
    let y = (y - x * x.dot(&y)).try_normalize(1e-9)?;
    let rotation = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[x, y, x.cross(&y)]));
    let translation: Vector3<f64> = t * scale;
    let pose = Isometry3::from_parts(
        Translation3::from(translation),
        UnitQuaternion::from_rotation_matrix(&rotation),
    );
    pose.translation.vector.iter().all(|x| x.is_finite()).then_some(pose)
}

/// Positions of the board nearer to each other than this, m and rad, are one.
const DISTINCT: (f64, f64) = (0.02, 0.035);

/// Whether two positions of the board are so near that the second adds nothing.
pub(super) fn is_same_position(a: &Isometry3<f64>, b: &Isometry3<f64>) -> bool {
    (a.translation.vector - b.translation.vector).norm() < DISTINCT.0
        && a.rotation.angle_to(&b.rotation) < DISTINCT.1
}

/// The plane-to-plane map with the least algebraic error; both sides are of order 1 already.
fn homography(pairs: &[([f64; 2], [f64; 2])]) -> Option<Matrix3<f64>> {
    if pairs.len() < 4 {
        return None;
    }
    let mut normal = DMatrix::<f64>::zeros(9, 9);
    for &([x, y], [u, v]) in pairs {
        let rows =
            [[x, y, 1.0, 0.0, 0.0, 0.0, -u * x, -u * y, -u], [0.0, 0.0, 0.0, x, y, 1.0, -v * x, -v * y, -v]];
        for row in rows {
            for (i, a) in row.iter().enumerate() {
                for (k, b) in row.iter().enumerate() {
                    normal[(i, k)] += a * b;
                }
            }
        }
    }
    let eigen = normal.symmetric_eigen();
    let least = eigen.eigenvalues.imin();
    let h = eigen.eigenvectors.column(least);
    Some(Matrix3::from_row_slice(h.as_slice()))
}

#[cfg(test)]
mod tests {
    use super::homography;
    use nalgebra::{Matrix3, Vector3};

    #[test]
    fn a_homography_is_found_up_to_scale() {
        let truth = Matrix3::new(0.4, 0.01, 0.1, -0.02, 0.38, -0.05, 0.05, 0.03, 1.0);
        let pairs: Vec<_> = (0..20)
            .map(|i| {
                let (x, y) = (f64::from(i % 5) * 0.2 - 0.4, f64::from(i / 5) * 0.3 - 0.4);
                let p = truth * Vector3::new(x, y, 1.0);
                ([x, y], [p.x / p.z, p.y / p.z])
            })
            .collect();
        let found = homography(&pairs).expect("determined");
        assert!((found / found[(2, 2)] - truth).abs().max() < 1e-9);
    }
}
