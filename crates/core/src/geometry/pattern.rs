// SPDX-License-Identifier: MIT OR Apache-2.0
//! The projected pattern: sine fringes along u and one distinguished fringe, the marker (paper, Figure 4b).
//!
//! Absolute phase is `2 pi (u + 1/2) / period_px` on the panel, so bright ridge k lies at `u + 1/2 = k *
//! period_px`, and fringe k spans the phases `[2 pi k - pi, 2 pi k + pi)`. The marker is fringe
//! `marker_index`; its bright lobe is modulated along itself (along v). There may be more of them, `marker_every`
//! fringes apart: so far that within the working volume no ray of a camera can meet two.

use crate::base::image::Plane;
use serde::{Deserialize, Serialize};
use std::f64::consts::{PI, TAU};

/// The projected pattern, with all that reconstruction needs of it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Pattern {
    /// Fringe period on the panel, px.
    pub period_px: f64,
    /// Number of the marker fringe: its ridge lies at `u + 1/2 = marker_index * period_px`.
    pub marker_index: u32,
    /// Fringes from one marker to the next, to both sides of `marker_index`; 0: that is the only one.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub marker_every: u32,
    /// How the marker is modulated along itself.
    pub marker: Marker,
    /// Period of that modulation along v, px.
    pub marker_period_px: f64,
    /// Light between the fringes, as a share of full light.
    pub low: f64,
    /// Light on the ridges, as a share of full light.
    pub high: f64,
    /// Exponent by which the projector turns panel values into light (1: linear).
    pub gamma: f64,
}

fn is_zero(number: &u32) -> bool {
    *number == 0
}

/// How the marker's lobe is modulated.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Marker {
    /// Lobe times `1 - depth (1/2 - 1/2 cos)`: easily seen, but biases the phase under it.
    Darkened {
        /// Share of the lobe's light that the dark parts lack, 0 to 1.
        depth: f64,
    },
    /// Lobe times `1 + amplitude cos`, mean 1: does not bias the phase averaged over one marker period.
    ZeroMean {
        /// 0 to 1; the whole pattern is scaled by `1 / (1 + amplitude)` to make room.
        amplitude: f64,
    },
}

impl Pattern {
    /// Absolute phase of panel column `u`, rad.
    pub fn phase(&self, u: f64) -> f64 {
        TAU * (u + 0.5) / self.period_px
    }

    /// Panel column of an absolute phase, px.
    pub fn column(&self, phase: f64) -> f64 {
        phase * self.period_px / TAU - 0.5
    }

    /// Whether a fringe is distinguished: a marker without strength is none.
    pub fn has_marker(&self) -> bool {
        match self.marker {
            Marker::Darkened { depth: strength } | Marker::ZeroMean { amplitude: strength } => strength > 0.0,
        }
    }

    /// The markers whose ridges lie on a panel of `width` columns, by rising index.
    pub fn markers(&self, width: usize) -> Vec<u32> {
        if !self.has_marker() {
            return Vec::new();
        }
        let on_panel = |index: &u32| f64::from(*index) * self.period_px <= width as f64;
        match self.marker_every {
            0 => vec![self.marker_index],
            every => (self.marker_index % every..).step_by(every as usize).take_while(on_panel).collect(),
        }
    }

    /// How far an absolute phase lies from the ridge of the nearest marker, rad.
    pub fn from_marker(&self, phase: f64) -> f64 {
        let from = phase - TAU * f64::from(self.marker_index);
        match self.marker_every {
            0 => from,
            every => {
                let period = TAU * f64::from(every);
                from - period * (from / period).round()
            }
        }
    }

    /// Light at panel position (u, v), 0 to 1, before gamma.
    pub fn light(&self, u: f64, v: f64) -> f64 {
        let phase = self.phase(u);
        let fringe = self.low + (self.high - self.low) * (0.5 + 0.5 * phase.cos());
        let in_marker = self.from_marker(phase).abs() <= PI;
        let along = (TAU * v / self.marker_period_px).cos();
        match self.marker {
            Marker::Darkened { depth } if in_marker => fringe * (1.0 - depth * (0.5 - 0.5 * along)),
            Marker::Darkened { .. } => fringe,
            Marker::ZeroMean { amplitude } if in_marker => {
                fringe * (1.0 + amplitude * along) / (1.0 + amplitude)
            }
            Marker::ZeroMean { amplitude } => fringe / (1.0 + amplitude),
        }
    }

    /// The 8-bit panel image: light through the inverse of the projector's gamma.
    pub fn panel(&self, width: usize, height: usize) -> Plane<u8> {
        let mut panel = Plane::filled(width, height, 0u8);
        for v in 0..height {
            for (u, pixel) in panel.row_mut(v).iter_mut().enumerate() {
                let value = self.light(u as f64, v as f64).clamp(0.0, 1.0).powf(1.0 / self.gamma);
                *pixel = (255.0 * value).round() as u8;
            }
        }
        panel
    }
}

#[cfg(test)]
mod tests {
    use super::{Marker, Pattern};

    fn pattern(marker: Marker) -> Pattern {
        Pattern {
            period_px: 8.0,
            marker_index: 80,
            marker_every: 0,
            marker,
            marker_period_px: 8.0,
            low: 0.0,
            high: 1.0,
            gamma: 1.0,
        }
    }

    #[test]
    fn ridges_lie_at_multiples_of_the_period() {
        let pattern = pattern(Marker::Darkened { depth: 0.8 });
        for k in [1.0, 79.0, 81.0, 159.0] {
            assert!((pattern.light(8.0 * k - 0.5, 0.0) - 1.0).abs() < 1e-12);
            assert!(pattern.light(8.0 * k + 3.5, 0.0) < 1e-12);
        }
        assert!((pattern.column(pattern.phase(123.25)) - 123.25).abs() < 1e-12);
    }

    #[test]
    fn only_the_marker_fringe_changes_along_itself() {
        for marker in [Marker::Darkened { depth: 0.8 }, Marker::ZeroMean { amplitude: 0.3 }] {
            let pattern = pattern(marker);
            for k in 1..160 {
                let u = 8.0 * f64::from(k) - 0.5;
                let changes = (pattern.light(u, 0.0) - pattern.light(u, 4.0)).abs() > 0.1;
                assert_eq!(changes, k == 80, "fringe {k}");
            }
        }
    }

    #[test]
    fn several_markers_cover_the_panel() {
        let several = Pattern { marker_every: 41, ..pattern(Marker::ZeroMean { amplitude: 0.3 }) };
        assert_eq!(several.markers(1280), [39, 80, 121]);
        assert_eq!(pattern(several.marker).markers(1280), [80]);
        for k in 1..160 {
            let u = 8.0 * f64::from(k) - 0.5;
            let changes = (several.light(u, 0.0) - several.light(u, 4.0)).abs() > 0.1;
            assert_eq!(changes, [39, 80, 121].contains(&k), "fringe {k}");
            let from = several.from_marker(several.phase(u)) / std::f64::consts::TAU;
            let nearest =
                [39, 80, 121, 162, -2].map(|marker| k - marker).into_iter().min_by_key(|d: &i32| d.abs());
            assert!((from - f64::from(nearest.expect("five"))).abs() < 1e-9, "fringe {k}: {from}");
        }
    }

    #[test]
    fn zero_mean_marker_keeps_the_mean_light() {
        let pattern = pattern(Marker::ZeroMean { amplitude: 0.3 });
        let mean = |u: f64| (0..8).map(|v| pattern.light(u, f64::from(v))).sum::<f64>() / 8.0;
        assert!((mean(639.5) - mean(631.5)).abs() < 1e-12);
    }
}
