// SPDX-License-Identifier: MIT OR Apache-2.0
//! Pinhole projection with Brown-Conrady distortion (Brown 1971), in OpenCV's parameter order.

use serde::{Deserialize, Serialize};

/// Focal lengths and principal point in pixels, distortion `[k1, k2, p1, p2, k3]` without unit.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Lens {
    /// Focal length along u, px.
    pub fx: f64,
    /// Focal length along v, px.
    pub fy: f64,
    /// Column of the principal point, px.
    pub cx: f64,
    /// Row of the principal point, px.
    pub cy: f64,
    /// `[k1, k2, p1, p2, k3]`.
    pub distortion: [f64; 5],
}

impl Lens {
    /// Normalized coordinates (x = X/Z, y = Y/Z) to pixel (u, v); `None` where the radial polynomial has
    /// turned over and the model means nothing.
    pub fn distort(&self, x: f64, y: f64) -> Option<[f64; 2]> {
        let [k1, k2, _, _, k3] = self.distortion;
        let r2 = x * x + y * y;
        let slope = 1.0 + r2 * (3.0 * k1 + r2 * (5.0 * k2 + r2 * 7.0 * k3));
        if !(slope > 0.0) {
            return None;
        }
        let [xd, yd] = self.distorted(x, y);
        Some([self.fx * xd + self.cx, self.fy * yd + self.cy])
    }

    /// Pixel (u, v) to normalized coordinates (x, y); `None` where Newton's iteration does not converge.
    pub fn undistort(&self, u: f64, v: f64) -> Option<[f64; 2]> {
        let (tx, ty) = ((u - self.cx) / self.fx, (v - self.cy) / self.fy);
        let (mut x, mut y) = (tx, ty);
        for _ in 0..20 {
            let [xd, yd] = self.distorted(x, y);
            let (ex, ey) = (xd - tx, yd - ty);
            if ex.abs().max(ey.abs()) < 1e-13 {
                return Some([x, y]);
            }
            let [[a, b], [c, d]] = self.jacobian(x, y);
            let determinant = a * d - b * c;
            if !(determinant > 1e-6) {
                return None;
            }
            x -= (d * ex - b * ey) / determinant;
            y -= (a * ey - c * ex) / determinant;
        }
        let [xd, yd] = self.distorted(x, y);
        ((xd - tx).abs().max((yd - ty).abs()) < 1e-10).then_some([x, y])
    }

    /// Distorted normalized coordinates, whatever the model means there.
    pub fn distorted(&self, x: f64, y: f64) -> [f64; 2] {
        let [k1, k2, p1, p2, k3] = self.distortion;
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ]
    }

    /// The derivatives of [`Self::distorted`] by x and y, a row for each of its coordinates.
    pub fn jacobian(&self, x: f64, y: f64) -> [[f64; 2]; 2] {
        let [k1, k2, p1, p2, k3] = self.distortion;
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        let radial_slope = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3);
        let cross = 2.0 * x * y * radial_slope + 2.0 * p1 * x + 2.0 * p2 * y;
        [
            [radial + 2.0 * x * x * radial_slope + 2.0 * p1 * y + 6.0 * p2 * x, cross],
            [cross, radial + 2.0 * y * y * radial_slope + 6.0 * p1 * y + 2.0 * p2 * x],
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::Lens;

    #[test]
    fn without_distortion_it_is_the_pinhole() {
        let lens = Lens { fx: 1000.0, fy: 900.0, cx: 10.0, cy: 20.0, distortion: [0.0; 5] };
        assert_eq!(lens.distort(0.1, -0.2), Some([110.0, -160.0]));
    }

    #[test]
    fn folded_distortion_is_refused() {
        let lens = Lens { fx: 1000.0, fy: 1000.0, cx: 0.0, cy: 0.0, distortion: [-0.5, 0.0, 0.0, 0.0, 0.0] };
        assert_eq!(lens.distort(1.0, 1.0), None);
        let finite = [f64::NAN, f64::INFINITY];
        assert!(finite.iter().all(|&bad| lens.undistort(bad, 0.0).is_none()));
    }
}
