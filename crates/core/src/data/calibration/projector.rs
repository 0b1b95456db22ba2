// SPDX-License-Identifier: MIT OR Apache-2.0
//! What is known of a projector beside its geometry: which rows of the panel are its rows, and its response to light.

use serde::{Deserialize, Serialize};

/// From the rows of a projector's geometry to those of its panel.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PanelRows {
    /// What is subtracted from the geometry's row: an offset, px; a share of the row; and px m, over the distance.
    pub excess: [f64; 3],
    /// RMS of the remaining differences on the board, px.
    pub rms_px: f64,
}

impl PanelRows {
    /// Of a projector whose geometry is exact in its rows, too.
    pub fn exact() -> Self {
        Self { excess: [0.0; 3], rms_px: 0.0 }
    }

    /// Whether all of its values are finite numbers.
    pub fn is_finite(&self) -> bool {
        self.excess.iter().all(|x| x.is_finite()) && self.rms_px.is_finite()
    }

    /// The panel's row, px, for the geometry's row, px, at a distance before the projector, m.
    pub fn of(&self, row_px: f64, distance_m: f64) -> f64 {
        let [a, b, c] = self.excess;
        row_px - (a + b * row_px + c / distance_m)
    }
}

/// How a projector turns panel values into light.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Response {
    /// Exponent from panel value to light.
    pub gamma: f64,
    /// Standard deviation of that exponent.
    pub sigma: f64,
    /// Amplitude of the second harmonic of what the cameras see, relative to the first.
    pub second_harmonic: f64,
    /// Amplitude of the third harmonic, relative to the first.
    pub third_harmonic: f64,
}
