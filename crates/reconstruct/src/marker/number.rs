// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which of the pattern's markers a piece is: the working volume distinguishes equal markers.
//!
//! A camera's ray meets the volume between two distances, and there the projector's columns between two values. A
//! marker whose ridge does not lie between them cannot be what the camera sees there. Markers are so far apart
//! (`Pattern::marker_every`) that for most rays one is left; where two are, or none, the piece is no anchor.

use super::pieces::MarkerPieces;
use crate::kernels::region_of_interest::Roi;
use crate::triangulate::camera_projector::CameraProjector;

/// Pixels of a piece that are tried, about.
const SAMPLES: usize = 64;

/// Share of these pixels that must allow one marker.
const LEAST_SHARE: f32 = 0.9;

/// The largest share of these pixels that may allow any other marker.
const MOST_OF_ANOTHER: f32 = 0.1;

/// Gives each piece the number of the marker that it is; 0 where that is not certain. `roi` is where they lie in the
/// frame.
pub fn assign(marker: &mut MarkerPieces, roi: Roi, pair: &CameraProjector) {
    let mut samples = vec![Vec::new(); marker.pieces.len()];
    let mut seen = vec![0u32; marker.pieces.len()];
    for (v, columns, piece) in marker.runs() {
        for u in columns {
            if seen[piece].is_multiple_of(marker.pieces[piece].area.div_ceil(SAMPLES as u32)) {
                samples[piece].push((roi.u + u, roi.v + v));
            }
            seen[piece] += 1;
        }
    }
    for (out, samples) in marker.number.iter_mut().zip(&samples) {
        *out = number(samples, pair);
    }
}

/// The marker that lies in the volume for these pixels, 1 for the first; 0 where there is none or more than one.
fn number(samples: &[(usize, usize)], pair: &CameraProjector) -> u8 {
    let mut allowed = vec![0u32; pair.markers.len()];
    for &(u, v) in samples {
        let Some([low, high]) = pair.columns_sought(u, v) else { continue };
        for (allowed, &marker) in allowed.iter_mut().zip(&pair.markers) {
            let column = f64::from(marker) * pair.pattern.period_px - 0.5;
            *allowed += u32::from(low <= column && column <= high);
        }
    }
    let share = |count: u32| count as f32 / samples.len().max(1) as f32;
    let Some((best, &count)) = allowed.iter().enumerate().max_by_key(|(_, count)| **count) else { return 0 };
    let mut others = allowed.iter().enumerate().filter(|(place, _)| *place != best);
    let certain = share(count) >= LEAST_SHARE && others.all(|(_, &count)| share(count) <= MOST_OF_ANOTHER);
    // A panel has a few thousand columns at most, and markers are at least two fringes of four columns apart; a rig
    // with more than 255 of them gets no anchors beyond.
    if certain { u8::try_from(best + 1).unwrap_or(0) } else { 0 }
}
