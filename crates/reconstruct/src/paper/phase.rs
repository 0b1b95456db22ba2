// SPDX-License-Identifier: MIT OR Apache-2.0
//! Wrapped phase Wm (paper, Figure 7d): the seven-point spatial-carrier phase shifting of Larkin.

use crate::base::image::{Mono8, Plane};
use crate::phase::demodulate::{self, Gains, of_samples};

/// Wm, rad, NaN where it is unknown; and the mean light over one fringe, DN, 0 there.
///
/// The seven samples lie a sixth of the local period apart, between pixels by linear interpolation. They cover one
/// period, all of which has to be object. `sign` is that of the phase along the columns: the formula alone yields one
/// that grows. The formula is that of the default method ([`crate::phase::demodulate`]).
pub fn demodulate(
    image: Mono8<'_>,
    object: &Plane<f32>,
    period: &Plane<f32>,
    sign: f32,
) -> (Plane<f32>, Plane<f32>) {
    let gains = Gains::new();
    let (mut wrapped, mut light) = (object.map(|_| f32::NAN), object.map(|_| 0.0));
    for v in 0..image.height() {
        let (row, object) = (image.row(v), object.row(v));
        for u in 0..image.width() {
            let period = period.at(u, v);
            let first = u as f32 - period / 2.0;
            let last = (u as f32 + period / 2.0).ceil() as usize;
            let inside = first >= 0.0 && last < row.len();
            if period == 0.0 || !inside || object[first as usize..=last].contains(&0.0) {
                continue;
            }
            let samples = std::array::from_fn(|k| {
                let at = first + k as f32 * period / 6.0;
                let (left, right) = (at as usize, (at as usize + 1).min(last));
                f32::from(row[left]) * (1.0 - at.fract()) + f32::from(row[right]) * at.fract()
            });
            let (s, c, mean, _) = of_samples(&samples, gains.of(period));
            light.set(u, v, mean);
            wrapped.set(u, v, demodulate::phase(c, sign * s));
        }
    }
    (wrapped, light)
}

#[cfg(test)]
mod tests {
    use super::demodulate;
    use crate::base::image::{Mono8, Plane};
    use proptest::prelude::{ProptestConfig, prop_assert, proptest};
    use std::f32::consts::TAU;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn a_planted_phase_is_found_where_its_period_is_object(period in 6.0f32..20.0, gap in 30usize..70, up: bool) {
            let sign = if up { 1.0 } else { -1.0 };
            let truth = |u: usize| sign * (TAU * u as f32 / period + 0.4);
            let image = Plane::from_fn(100, 1, |u, _| (120.0 + 100.0 * truth(u).cos()).round() as u8);
            let object = Plane::from_fn(100, 1, |u, _| if u == gap { 0.0 } else { 1.0 });
            let (wrapped, light) = demodulate(Mono8::from(&image), &object, &Plane::filled(100, 1, period), sign);
            let half = period / 2.0;
            for u in 0..100 {
                let beside = (u as f32 - gap as f32).abs();
                let known = u as f32 >= half && 99.0 - u as f32 >= half && beside >= half + 1.0;
                prop_assert!(known || beside > half || wrapped.at(u, 0).is_nan(), "{u}");
                if known {
                    let error = (wrapped.at(u, 0) - truth(u)) / TAU;
                    prop_assert!((error - error.round()).abs() * TAU < 0.03, "{error} at {u}");
                    prop_assert!((light.at(u, 0) - 120.0).abs() < 6.0, "{}", light.at(u, 0));
                }
            }
        }
    }
}
