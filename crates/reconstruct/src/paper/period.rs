// SPDX-License-Identifier: MIT OR Apache-2.0
//! Fringe period Pm, amplitude Am and period stability Sm (paper, Figure 7a to c).

use super::planes::{box_sum, one_if};
use crate::base::image::{Mono8, Plane};
use crate::phase::period::{HYSTERESIS, PERIOD_RANGE_PX, SMOOTH_COLUMNS, SMOOTH_ROWS, WINDOW_PERIODS};
use std::ops::Range;

/// Pm, px, and Am, DN; both 0 where they are unknown.
///
/// The neighbourhood of a pixel is a window along the row, across the fringes, of 2.6 nominal periods: the least that
/// holds two whole ones. Pm is the mean over a small box, because two crossings alone are noisy.
pub fn measure(image: Mono8<'_>, object: &Plane<f32>, nominal_px: f32) -> (Plane<f32>, Plane<f32>) {
    let length = 2 * (WINDOW_PERIODS * nominal_px).round() as usize + 1;
    let mut counted = Plane::filled(image.width(), image.height(), 0.0);
    let mut amplitude = counted.clone();
    for v in 0..image.height() {
        for u in (0..image.width()).filter(|&u| object.at(u, v) > 0.0) {
            let light = &image.row(v)[window(object.row(v), u, length)];
            let mut sorted = light.to_vec();
            sorted.sort_unstable();
            let (low, high) = (sorted[0], sorted[sorted.len() - 1]);
            let range = f32::from(high - low);
            amplitude.set(u, v, range);
            counted.set(u, v, count(light, f32::from(sorted[(sorted.len() - 1) / 2]), HYSTERESIS * range));
        }
    }
    let sum = box_sum(&counted, SMOOTH_COLUMNS, SMOOTH_ROWS);
    let known = box_sum(&counted.map(|p| one_if(p > 0.0)), SMOOTH_COLUMNS, SMOOTH_ROWS);
    let mean = |u, v| object.at(u, v) * sum.at(u, v) / known.at(u, v).max(1.0);
    (Plane::from_fn(image.width(), image.height(), mean), amplitude)
}

/// The columns of the object around `u`, as many as `length` if that is possible without a gap. Where the object ends
/// the window is shifted, not cut.
fn window(object: &[f32], u: usize, length: usize) -> Range<usize> {
    let (mut start, mut end) = (u, u + 1);
    while end - start < length {
        let left = start > 0 && object[start - 1] > 0.0;
        let right = end < object.len() && object[end] > 0.0;
        let left_is_nearer = u - start < end - u;
        match (left, right) {
            (true, false) => start -= 1,
            (true, true) if left_is_nearer => start -= 1,
            (_, true) => end += 1,
            (false, false) => break,
        }
    }
    start..end
}

/// The mean distance of crossings of the threshold that have the same direction, which is every second one; 0 where
/// there are too few, or it is no period. A crossing counts once the light has left the threshold by `margin` on the
/// other side: noise crosses it as well.
fn count(light: &[u8], threshold: f32, margin: f32) -> f32 {
    let mut crossings = Vec::new();
    // Where the light crossed last, and on which side of the threshold it was last for certain: 0 at first.
    let (mut crossed, mut side, mut before) = (0.0, 0.0, 0.0);
    for (i, &value) in light.iter().enumerate() {
        let value = f32::from(value) - threshold;
        if i > 0 && (value > 0.0) != (before > 0.0) {
            crossed = i as f32 - value / (value - before);
        }
        if value.abs() > margin && value.signum() != side {
            if side != 0.0 {
                crossings.push(crossed);
            }
            side = value.signum();
        }
        before = value;
    }
    let distances = crossings.windows(3).map(|three| three[2] - three[0]);
    let mean = distances.sum::<f32>() / crossings.len().saturating_sub(2).max(1) as f32;
    if PERIOD_RANGE_PX.contains(&mean) { mean } else { 0.0 }
}

/// Sm: the variance of Pm along the row over one nominal period to each side, as `1 / (1 + variance / px^2)`, so that
/// it is large where periods are stable; 0 where Pm is unknown.
pub fn stability(period: &Plane<f32>, nominal_px: f32) -> Plane<f32> {
    let sum = |values: &Plane<f32>| box_sum(values, nominal_px.round() as usize, 0);
    let known = sum(&period.map(|p| one_if(p > 0.0)));
    let (sums, squares) = (sum(period), sum(&period.map(|p| p * p)));
    Plane::from_fn(period.width(), period.height(), |u, v| {
        let count = known.at(u, v).max(1.0);
        let mean = sums.at(u, v) / count;
        let variance = (squares.at(u, v) / count - mean * mean).max(0.0);
        one_if(period.at(u, v) > 0.0) / (1.0 + variance)
    })
}

#[cfg(test)]
mod tests {
    use super::{measure, stability};
    use crate::base::image::{Mono8, Plane};
    use proptest::prelude::{ProptestConfig, prop_assert, proptest};

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn the_period_of_a_noisy_sine_is_found(
            period in 6.0f32..18.0, phase in -3.0f32..3.0, amplitude in 15.0f32..100.0,
        ) {
            let image = Plane::from_fn(200, 3, |u, v| {
                let noise = ((u * 7919 + v * 104_729) % 13) as f32 / 6.5 - 1.0;
                let wave = (std::f32::consts::TAU * u as f32 / period + phase).cos();
                (110.0 + amplitude * wave + noise) as u8
            });
            // The object has a gap, which no window may cross.
            let object = Plane::from_fn(200, 3, |u, _| if u == 100 { 0.0 } else { 1.0 });
            let (found, range) = measure(Mono8::from(&image), &object, 11.0);
            for u in (20..180).filter(|&u| u != 100) {
                let (p, range) = (found.at(u, 1), range.at(u, 1));
                prop_assert!((p / period - 1.0).abs() < 0.05, "{p} at {u}, true {period}");
                prop_assert!((range / (2.0 * amplitude) - 1.0).abs() < 0.25, "{range}");
            }
            prop_assert!(found.at(100, 1) == 0.0 && range.at(100, 1) == 0.0);
            prop_assert!(stability(&found, 11.0).at(60, 1) > 0.9);
        }
    }

    #[test]
    fn a_change_of_period_is_not_stable() {
        let period = Plane::from_fn(200, 1, |u, _| if u < 100 { 8.0 } else { 14.0 });
        let found = stability(&period, 11.0);
        assert!(found.at(40, 0) > 0.99 && found.at(160, 0) > 0.99 && found.at(100, 0) < 0.2);
        assert_eq!(stability(&Plane::filled(9, 1, 0.0), 11.0).at(4, 0), 0.0);
    }
}
