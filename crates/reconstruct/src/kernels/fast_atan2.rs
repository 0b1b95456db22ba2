// SPDX-License-Identifier: MIT OR Apache-2.0
//! The angle of a phasor, for many pixels at once: no table, no branch, the same bytes at every width of vectors.

use super::fast_round::nearest;
use std::f32::consts::{FRAC_1_PI, FRAC_PI_2, PI};

/// `atan(t) = t + t^3 (A_0 + A_1 t^2 + ..)` on 0..1, least in the largest error (5e-8 rad).
const A: [f32; 7] =
    [-0.333_316_6, 0.199_627_04, -0.139_765_81, 0.097_942_32, -0.057_773_56, 0.023_040_12, -0.004_355_4];

/// `atan2(s, c)` in (-pi, pi], to 5e-7 rad; finite, not NaN, where both are 0.
#[inline(always)]
pub(crate) fn atan2(s: f32, c: f32) -> f32 {
    let (x, y) = (c.abs(), s.abs());
    let (less, more) = (if x < y { x } else { y }, if x < y { y } else { x });
    let t = less / if more > 0.0 { more } else { 1.0 };
    let q = t * t;
    let mut sum = A[6];
    for k in (0..6).rev() {
        sum = sum * q + A[k];
    }
    let octant = t + t * q * sum;
    let quadrant = if y > x { FRAC_PI_2 - octant } else { octant };
    let half = if c < 0.0 { PI - quadrant } else { quadrant };
    if s < 0.0 { -half } else { half }
}

/// `cos 2 x` to 1e-3.
#[inline(always)]
pub(crate) fn cos_of_double(x: f32) -> f32 {
    let turns = x * FRAC_1_PI;
    let t = turns - nearest(turns);
    // The sine of pi t by its series, t within +-1/2, and cos 2 pi t = 1 - 2 sin^2 pi t.
    let q = t * t;
    let sin = t * (PI - q * (5.167_713 - q * (2.550_164 - q * 0.599_264_5)));
    1.0 - 2.0 * sin * sin
}

#[cfg(test)]
mod tests {
    use super::{atan2, cos_of_double};
    use proptest::prelude::{ProptestConfig, prop_assert, proptest};
    use std::f32::consts::PI;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(20_000))]
        #[test]
        fn angles_are_those_of_f64(angle in -0.999_999f32..0.999_999, size in -3f32..4.0) {
            let size = 10f32.powf(size);
            let (s, c) = (size * (PI * angle).sin(), size * (PI * angle).cos());
            let error = f64::from(atan2(s, c)) - f64::from(s).atan2(f64::from(c));
            prop_assert!(error.abs() < 5e-7, "{error}");
        }
    }

    #[test]
    fn cosines_are_good_enough() {
        for i in -3000..3000 {
            let x = i as f32 * 0.37;
            assert!((cos_of_double(x) - (2.0 * x).cos()).abs() < 1e-3, "{x}");
        }
        assert!(cos_of_double(f32::NAN).is_nan());
    }

    #[test]
    fn the_axes_are_exact_enough() {
        use std::f32::consts::FRAC_PI_2;
        let found = [(0.0, 1.0), (1.0, 0.0), (0.0, -1.0), (-1.0, 0.0), (0.0, 0.0), (-0.0, -2.0)];
        let found = found.map(|(s, c)| atan2(s, c));
        assert_eq!(found, [0.0, FRAC_PI_2, PI, -FRAC_PI_2, 0.0, PI]);
    }
}
