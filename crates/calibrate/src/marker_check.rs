// SPDX-License-Identifier: MIT OR Apache-2.0
//! Checks that the marker is where the phase has it. On a board, circles that lie along a fringe can pass for dashes;
//! then the whole phase is some fringes off. Between the circles nothing but the marker changes along its fringe.

use super::estimate::least_squares;
use super::observed::View;
use crate::base::image::Plane;
use crate::reconstruct::triangulate::camera_projector::CameraProjector;
use nalgebra::Vector3;
use std::f64::consts::TAU;

/// Length of the pieces of a ridge that are judged, in periods of the marker.
const PIECE: f64 = 1.5;
/// Periods tried, relative to the one expected.
const PERIODS: [f64; 5] = [0.8, 0.9, 1.0, 1.12, 1.25];
/// Share of the modulation projected that must be seen: blur takes the rest.
const LEAST_CONTRAST: f64 = 0.3;
/// Share of the pieces that must show the modulation.
const LEAST_SHARE: f64 = 0.5;
/// Fewest pieces by which a marker is judged.
const LEAST_PIECES: usize = 3;
/// Distance from a circle below which a ridge is not judged, px.
const MARGIN_PX: f64 = 2.5;

/// Whether the fringes that the phase takes for markers are modulated along themselves.
pub(super) fn marker_is_there(
    view: &View,
    image: &Plane<u8>,
    phase: &Plane<f32>,
    pair: &CameraProjector,
) -> bool {
    let period = f64::from(pair.marker_period_px);
    let rows = (PIECE * period).ceil().max(6.0) as usize;
    let threshold = LEAST_CONTRAST * f64::from(pair.marker_contrast);
    let (mut all, mut modulated) = (0, 0);
    for ridge in ridges(view, phase, pair) {
        let mut v = 0;
        while v + rows <= ridge.len() {
            match levels(image, &ridge, v, rows) {
                Ok(levels) => {
                    all += 1;
                    modulated += usize::from(contrast(&levels, period) > threshold);
                    v += rows;
                }
                Err(hole) => v = hole + 1,
            }
        }
    }
    all >= LEAST_PIECES && modulated as f64 >= LEAST_SHARE * all as f64
}

/// By marker, the column of its ridge in each row; `None` where it is not seen, or beside a circle.
pub(super) fn ridges(view: &View, phase: &Plane<f32>, pair: &CameraProjector) -> Vec<Vec<Option<usize>>> {
    let ridge = |marker: u32| {
        let target = (TAU * f64::from(marker)) as f32;
        let column = |v| crossing(phase.row(v), target).filter(|u| is_free(view, *u, v));
        (0..phase.height()).map(column).collect()
    };
    pair.pattern.markers(pair.projector.width).into_iter().map(ridge).collect()
}

/// The column at which a row's phase passes a value.
fn crossing(row: &[f32], target: f32) -> Option<usize> {
    let passes =
        |pair: &[f32]| (pair[0] - target) * (pair[1] - target) <= 0.0 && (pair[0] - pair[1]).abs() < 2.0;
    row.windows(2).position(passes)
}

fn is_free(view: &View, u: usize, v: usize) -> bool {
    view.sightings.iter().all(|sighting| {
        let ellipse = &sighting.spot.ellipse;
        let (du, dv) = (u as f64 - ellipse.centre[0], v as f64 - ellipse.centre[1]);
        let far = ellipse.axes[0] + MARGIN_PX;
        du * du + dv * dv > far * far || ellipse.distance([u as f64, v as f64]) > MARGIN_PX
    })
}

/// Light along the ridge from row `v` on; the error is the last row without a ridge.
fn levels(image: &Plane<u8>, ridge: &[Option<usize>], v: usize, rows: usize) -> Result<Vec<f64>, usize> {
    let hole = (v..v + rows).rev().find(|row| {
        let u = ridge[*row];
        u.is_none_or(|u| u == 0 || u + 1 >= image.width())
    });
    if let Some(hole) = hole {
        return Err(hole);
    }
    let level = |row: usize| {
        let u = ridge[row].unwrap_or(1);
        image.row(row)[u - 1..=u + 1].iter().map(|x| f64::from(*x)).sum::<f64>() / 3.0
    };
    Ok((v..v + rows).map(level).collect())
}

/// Amplitude at about this period, relative to the mean.
fn contrast(levels: &[f64], period: f64) -> f64 {
    let of = |period: f64| {
        let rows = levels.iter().enumerate().map(|(i, level)| {
            let (sin, cos) = (TAU * i as f64 / period).sin_cos();
            (Vector3::new(1.0, cos, sin), *level)
        });
        least_squares(rows).map_or(0.0, |fit| fit[1].hypot(fit[2]) / fit[0].max(1.0))
    };
    PERIODS.iter().map(|factor| of(factor * period)).fold(0.0, f64::max)
}
