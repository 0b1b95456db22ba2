// SPDX-License-Identifier: MIT OR Apache-2.0
//! The response of a projector to its panel values, measured on the board in white light and in fringes.
//!
//! Light that is the panel's share to the power g, instead of the share itself, has another mean over a period: blur of
//! projector and lens takes from the harmonics, but nothing from the mean. With fringes `s (1/2 + 1/2 cos)` the mean is
//! `s^g G(g + 1/2) / (sqrt(pi) G(g + 1))` of the white light (G: the gamma function). The slope of the mean over the
//! white level, point by point, gives it without the sensor's offset and the room's light.

use super::board::Board;
use super::estimate::{least_squares, median};
use super::observed::{LightSample, View};
use crate::base::image::Plane;
use crate::data::Response;
use crate::geometry::pattern::{Marker, Pattern};
use nalgebra::{SVector, Vector2};
use std::f64::consts::TAU;

/// Half the window around a point, px.
const REACH: i64 = 8;
/// Systematic standard deviation of an exponent: light of the black panel, and stray light of the room.
const SYSTEMATIC: f64 = 0.015;
/// Fewest points from which a projector's response is taken.
const LEAST_SAMPLES: usize = 50;
/// Periods around the marker that are left out.
const MARKER_PERIODS: f64 = 1.5;

/// Compares both frames half way between neighbouring circles that are seen in both.
pub(super) fn light_samples(
    view: &View,
    white: &Plane<u8>,
    fringes: &Plane<u8>,
    phase: &Plane<f32>,
    confirmed: &[bool],
    board: &Board,
    pattern: &Pattern,
) -> Vec<LightSample> {
    let mut centres: Vec<Option<[f64; 2]>> = vec![None; board.circles().len()];
    for sighting in view.sightings.iter().filter(|s| confirmed.get(s.circle).is_some_and(|is| *is)) {
        centres[sighting.circle] = Some(sighting.spot.ellipse.centre);
    }
    let middle = |row: usize, column: usize| {
        let at = |column: usize, row: usize| centres[board.number(column, row)];
        let corners =
            [at(column, row)?, at(column + 1, row)?, at(column, row + 1)?, at(column + 1, row + 1)?];
        Some([0, 1].map(|axis| corners.iter().map(|c| c[axis]).sum::<f64>() / 4.0))
    };
    let places = (0..board.rows - 1).flat_map(|row| (0..board.columns - 1).map(move |column| (row, column)));
    places.filter_map(|(row, column)| sample(white, fringes, phase, middle(row, column)?, pattern)).collect()
}

fn sample(
    white: &Plane<u8>,
    fringes: &Plane<u8>,
    phase: &Plane<f32>,
    [u, v]: [f64; 2],
    pattern: &Pattern,
) -> Option<LightSample> {
    let (column, row) = (u.round() as i64, v.round() as i64);
    let inside = |at: i64, size: usize| at >= REACH && at + REACH < size as i64;
    if !(inside(column, phase.width()) && inside(row, phase.height())) {
        return None;
    }
    let (mut rows, mut sum, mut lightest) = (Vec::new(), 0.0, 0u8);
    for y in row - REACH..=row + REACH {
        for x in column - REACH..=column + REACH {
            let (x, y) = (x as usize, y as usize);
            let at = f64::from(phase.at(x, y));
            if at.is_nan() || pattern.from_marker(at).abs() < TAU * MARKER_PERIODS {
                return None;
            }
            let wave = |n: f64| [(n * at).cos(), (n * at).sin()];
            let ([c1, s1], [c2, s2], [c3, s3]) = (wave(1.0), wave(2.0), wave(3.0));
            let slopes = [x as f64 - u, y as f64 - v];
            let line = SVector::from([1.0, c1, s1, c2, s2, c3, s3, slopes[0], slopes[1]]);
            rows.push((line, f64::from(fringes.at(x, y))));
            sum += f64::from(white.at(x, y));
            lightest = lightest.max(white.at(x, y)).max(fringes.at(x, y));
        }
    }
    let fit: SVector<f64, 9> = least_squares(rows.iter().copied())?;
    let harmonics = [1, 3, 5].map(|i| fit[i].hypot(fit[i + 1]));
    let sample = LightSample { white: sum / rows.len() as f64, mean: fit[0], harmonics };
    (lightest < 250 && sample.mean > 0.0).then_some(sample)
}

/// The response of a projector, from what all cameras of its head saw; `None` with too few points.
pub(super) fn response<'a>(
    samples: impl Iterator<Item = &'a LightSample>,
    pattern: &Pattern,
) -> Option<Response> {
    let samples: Vec<&LightSample> = samples.collect();
    if samples.len() < LEAST_SAMPLES {
        return None;
    }
    let line = |s: &&LightSample| (Vector2::new(1.0, s.white), s.mean);
    let mut kept = samples.clone();
    let mut fit = least_squares(kept.iter().map(line))?;
    for _ in 0..3 {
        let off = |s: &&LightSample| s.mean - fit[0] - fit[1] * s.white;
        let gate = 4.0 * 1.4826 * median(samples.iter().map(|s| off(s).abs())).max(0.05);
        kept = samples.iter().copied().filter(|s| off(s).abs() <= gate).collect();
        fit = least_squares(kept.iter().map(line))?;
    }
    let n = kept.len() as f64;
    let mean = kept.iter().map(|s| s.white).sum::<f64>() / n;
    let spread: f64 = kept.iter().map(|s| (s.white - mean).powi(2)).sum();
    let squares: f64 = kept.iter().map(|s| (s.mean - fit[0] - fit[1] * s.white).powi(2)).sum();
    let slope_sigma = (squares / (n - 2.0) / spread).sqrt();
    let exponent = exponent_of(fit[1], pattern)?;
    let slope = |e: f64| mean_share(e, pattern);
    let per_exponent = (slope(exponent + 1e-3) - slope(exponent - 1e-3)) / 2e-3;
    let share = |i: usize| median(kept.iter().map(|s| s.harmonics[i] / s.harmonics[0].max(1e-9)));
    Some(Response {
        gamma: exponent * pattern.gamma,
        sigma: (slope_sigma / per_exponent).hypot(SYSTEMATIC) * pattern.gamma,
        second_harmonic: share(1),
        third_harmonic: share(2),
    })
}

/// Mean light of the fringes as a share of white, when the shares that the pattern means are raised to `exponent`.
fn mean_share(exponent: f64, pattern: &Pattern) -> f64 {
    const STEPS: usize = 512;
    let room = match pattern.marker {
        Marker::ZeroMean { amplitude } => 1.0 / (1.0 + amplitude),
        Marker::Darkened { .. } => 1.0,
    };
    let light = |i: usize| {
        let wave = 0.5 + 0.5 * (TAU * (i as f64 + 0.5) / STEPS as f64).cos();
        (room * (pattern.low + (pattern.high - pattern.low) * wave)).powf(exponent)
    };
    (0..STEPS).map(light).sum::<f64>() / STEPS as f64
}

/// The exponent that gives this mean; it falls with the exponent.
fn exponent_of(share: f64, pattern: &Pattern) -> Option<f64> {
    let (mut low, mut high) = (0.1, 10.0);
    if !(share < mean_share(low, pattern) && share > mean_share(high, pattern)) {
        return None;
    }
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        if mean_share(middle, pattern) > share { low = middle } else { high = middle }
    }
    Some(0.5 * (low + high))
}

#[cfg(test)]
mod tests {
    use super::{LightSample, mean_share, response};
    use crate::geometry::pattern::{Marker, Pattern};

    #[test]
    fn the_exponent_comes_back_in_spite_of_offset_and_room_light() {
        let pattern = Pattern {
            period_px: 8.0,
            marker_index: 80,
            marker_every: 0,
            marker: Marker::ZeroMean { amplitude: 0.3 },
            marker_period_px: 8.0,
            low: 0.0,
            high: 1.0,
            gamma: 2.0,
        };
        for gamma in [1.6, 2.0, 2.2] {
            let share = mean_share(gamma / 2.0, &pattern);
            let samples: Vec<LightSample> = (0..100)
                .map(|i| {
                    let light = 60.0 + f64::from(i);
                    LightSample { white: light + 3.0, mean: share * light + 3.0, harmonics: [50.0, 2.0, 0.5] }
                })
                .collect();
            let found = response(samples.iter(), &pattern).expect("enough points");
            assert!((found.gamma - gamma).abs() < 1e-6, "{found:?}");
            assert!((found.second_harmonic - 0.04).abs() < 1e-9);
        }
    }
}
