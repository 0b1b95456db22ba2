// SPDX-License-Identifier: MIT OR Apache-2.0
//! Ellipses: the conic that fits edge points, and its centre and axes.

use nalgebra::{Matrix2, Matrix3, SymmetricEigen, Vector2, Vector3};

/// An ellipse in the image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ellipse {
    pub centre: [f64; 2],
    /// Half axes, the longer first, px.
    pub axes: [f64; 2],
    /// Direction of the longer axis, radians from +u towards +v.
    pub angle: f64,
}

impl Ellipse {
    /// The point at eccentric anomaly `t`.
    pub fn at(&self, t: f64) -> [f64; 2] {
        let (x, y) = (self.axes[0] * t.cos(), self.axes[1] * t.sin());
        let (sin, cos) = self.angle.sin_cos();
        [self.centre[0] + x * cos - y * sin, self.centre[1] + x * sin + y * cos]
    }

    /// Radius of a circle of the same area, px.
    pub fn radius(&self) -> f64 {
        (self.axes[0] * self.axes[1]).sqrt()
    }

    /// How far a point lies outside (negative: inside), px, to first order.
    pub fn distance(&self, [u, v]: [f64; 2]) -> f64 {
        let (sin, cos) = self.angle.sin_cos();
        let (du, dv) = (u - self.centre[0], v - self.centre[1]);
        let (x, y) = ((du * cos + dv * sin) / self.axes[0], (dv * cos - du * sin) / self.axes[1]);
        let level = (x * x + y * y).sqrt();
        let slope = ((x / self.axes[0]).powi(2) + (y / self.axes[1]).powi(2)).sqrt() / level;
        (level - 1.0) / slope
    }

    /// Centre and axes of the conic `x' Q x = 0`; `None` where it is no real ellipse.
    pub fn from_conic(q: &Matrix3<f64>) -> Option<Self> {
        let a = Matrix2::new(q[(0, 0)], q[(0, 1)], q[(1, 0)], q[(1, 1)]);
        let b = Vector2::new(q[(0, 2)], q[(1, 2)]);
        if !(a.determinant() > 0.0) {
            return None;
        }
        let centre = -(a.try_inverse()? * b);
        let level = q[(2, 2)] + b.dot(&centre);
        let eigen = SymmetricEigen::new(a);
        let axis = |i: usize| (-level / eigen.eigenvalues[i]).sqrt();
        let (long, short) = if axis(0) >= axis(1) { (0, 1) } else { (1, 0) };
        let axes = [axis(long), axis(short)];
        if !(axes[0].is_finite() && axes[1] > 0.0) {
            return None;
        }
        let direction = eigen.eigenvectors.column(long);
        Some(Self { centre: centre.into(), axes, angle: direction[1].atan2(direction[0]) })
    }

    /// The ellipse with the moments of a region's pixels (half axes are twice their standard deviations), and the
    /// number of pixels relative to its area: 1 where they fill it. `None` where the pixels lie on a line.
    pub fn of_region(pixels: impl Iterator<Item = [f64; 2]> + Clone) -> Option<(Self, f64)> {
        let n = pixels.clone().count() as f64;
        let mean = |axis: usize| pixels.clone().map(|p| p[axis]).sum::<f64>() / n;
        let (mu, mv) = (mean(0), mean(1));
        let (mut uu, mut uv, mut vv) = (0.0, 0.0, 0.0);
        for [u, v] in pixels {
            uu += (u - mu) * (u - mu) / n;
            uv += (u - mu) * (v - mv) / n;
            vv += (v - mv) * (v - mv) / n;
        }
        let determinant: f64 = uu * vv - uv * uv;
        let conic = Matrix3::new(vv, -uv, 0.0, -uv, uu, 0.0, 0.0, 0.0, -4.0 * determinant);
        let ellipse = Self { centre: [mu, mv], ..Self::from_conic(&conic)? };
        Some((ellipse, n / (4.0 * std::f64::consts::PI * determinant.max(1e-9).sqrt())))
    }

    /// Direct least-squares fit (Halir and Flusser 1998), the points shifted and scaled first.
    pub fn fit(points: &[[f64; 2]]) -> Option<Self> {
        if points.len() < 6 {
            return None;
        }
        let n = points.len() as f64;
        let mean = |axis: usize| points.iter().map(|p| p[axis]).sum::<f64>() / n;
        let (mu, mv) = (mean(0), mean(1));
        let scale =
            (points.iter().map(|p| (p[0] - mu).powi(2) + (p[1] - mv).powi(2)).sum::<f64>() / n).sqrt();
        let (mut s1, mut s2, mut s3) = (Matrix3::zeros(), Matrix3::zeros(), Matrix3::zeros());
        for point in points {
            let (x, y) = ((point[0] - mu) / scale, (point[1] - mv) / scale);
            let (d1, d2) = (Vector3::new(x * x, x * y, y * y), Vector3::new(x, y, 1.0));
            s1 += d1 * d1.transpose();
            s2 += d1 * d2.transpose();
            s3 += d2 * d2.transpose();
        }
        let t = -(s3.try_inverse()? * s2.transpose());
        let m = s1 + s2 * t;
        // Inverse of the constraint 4ac - b² = 1.
        let reduced = Matrix3::from_rows(&[m.row(2) / 2.0, -m.row(1), m.row(0) / 2.0]);
        let a1 = ellipse_vector(&reduced)?;
        let a2 = t * a1;
        let [a, b, c, d, e, f] = [a1[0], a1[1] / 2.0, a1[2], a2[0] / 2.0, a2[1] / 2.0, a2[2]];
        let q = Matrix3::new(a, b, d, b, c, e, d, e, f);
        let unit = Self::from_conic(&q).or_else(|| Self::from_conic(&-q))?;
        let centre = [unit.centre[0] * scale + mu, unit.centre[1] * scale + mv];
        Some(Self { centre, axes: unit.axes.map(|a| a * scale), angle: unit.angle })
    }
}

/// The eigenvector of a real 3 x 3 matrix that is an ellipse (4ac - b² > 0).
fn ellipse_vector(matrix: &Matrix3<f64>) -> Option<Vector3<f64>> {
    let eigenvalues = matrix.complex_eigenvalues();
    let mut candidates =
        eigenvalues.iter().filter(|e| e.im.abs() < 1e-9 * (1.0 + e.re.abs())).filter_map(|e| {
            let shifted = matrix - Matrix3::identity() * e.re;
            // The null space: the cross product of two rows that are furthest from parallel.
            let row = |i: usize| Vector3::new(shifted[(i, 0)], shifted[(i, 1)], shifted[(i, 2)]);
            let crosses = [row(0).cross(&row(1)), row(1).cross(&row(2)), row(2).cross(&row(0))];
            let best = crosses.into_iter().max_by(|a, b| a.norm_squared().total_cmp(&b.norm_squared()))?;
            best.try_normalize(1e-300)
        });
    candidates.find(|v| 4.0 * v[0] * v[2] - v[1] * v[1] > 0.0)
}

/// The image of a circle on a board: `columns` are the board's x axis, y axis and the circle's centre in
/// device coordinates (m); the conic is in normalized coordinates (X/Z, Y/Z).
///
/// A circle of radius r is the dual conic diag(r², r², -1) in its plane; seen through `columns` it stays one.
pub fn image_of_circle(columns: &Matrix3<f64>, radius_m: f64) -> Option<Ellipse> {
    let circle = Matrix3::from_diagonal(&Vector3::new(radius_m * radius_m, radius_m * radius_m, -1.0));
    let dual = columns * circle * columns.transpose();
    Ellipse::from_conic(&dual.try_inverse()?).or_else(|| Ellipse::from_conic(&-dual.try_inverse()?))
}

#[cfg(test)]
mod tests {
    use super::{Ellipse, image_of_circle};
    use nalgebra::{Matrix3, Rotation3, Vector3};
    use proptest::prelude::{ProptestConfig, prop_assert, prop_assume, proptest};

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(200))]
        #[test]
        fn points_of_an_ellipse_give_it_back(
            u in 0.0..1900.0f64, v in 0.0..1200.0f64, long in 5.0..60.0f64, ratio in 0.3..0.99f64, angle in -1.5..1.5f64,
        ) {
            let truth = Ellipse { centre: [u, v], axes: [long, long * ratio], angle };
            let points: Vec<[f64; 2]> = (0..24).map(|i| truth.at(f64::from(i) * 0.26)).collect();
            let found = Ellipse::fit(&points).expect("an ellipse");
            prop_assert!((found.centre[0] - u).abs() < 1e-6 && (found.centre[1] - v).abs() < 1e-6, "{found:?}");
            prop_assert!((found.axes[0] - long).abs() < 1e-6 && (found.axes[1] - long * ratio).abs() < 1e-6);
            prop_assert!(points.iter().all(|p| found.distance(*p).abs() < 1e-6));
        }

        #[test]
        fn the_image_of_a_circle_passes_through_the_images_of_its_points(
            yaw in -0.9..0.9f64, pitch in -0.9..0.9f64, x in -0.5..0.5f64, y in -0.5..0.5f64, z in 1.0..3.0f64,
        ) {
            let rotation = Rotation3::from_euler_angles(pitch, yaw, 0.2);
            let columns = Matrix3::from_columns(&[rotation * Vector3::x(), rotation * Vector3::y(), Vector3::new(x, y, z)]);
            // Seen from its own plane a circle is a line.
            let away = (rotation * Vector3::z()).dot(&Vector3::new(x, y, z));
            prop_assume!(away.abs() > 0.1);
            let ellipse = image_of_circle(&columns, 0.02).expect("an ellipse");
            for i in 0..12 {
                let (sin, cos) = (f64::from(i) * 0.5).sin_cos();
                let p = columns * Vector3::new(0.02 * cos, 0.02 * sin, 1.0);
                prop_assert!(ellipse.distance([p.x / p.z, p.y / p.z]).abs() < 1e-9);
            }
        }
    }
}
