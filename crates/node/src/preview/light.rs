// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a frame's light is like: the figures by which an operator sets exposure, and sees that pattern and focus are
//! there.

use super::exposure::{Exposure, Peaks, WINDOW, quantile};
use crate::acquire::preview::Sample;
use crate::telemetry::Grade;
use crate::telemetry::thresholds::{LIT, MODULATION, SATURATED};
use serde::{Deserialize, Serialize};

/// The light of one frame, in figures.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Light {
    /// Share of the lit pixels that are saturated (255), 0 to 1.
    pub saturated: f64,
    /// Share of the frame that is lit, 0 to 1.
    pub lit: f64,
    /// Median fringe amplitude of what is lit, grey values: half of the range over 24 columns.
    pub modulation_dn: f64,
    /// The same as a share of the mean there (Michelson's contrast), 0 to 1.
    pub contrast: f64,
    /// How fine the detail is: root mean square of the second difference along the row, as a share of the modulation.
    /// It has no unit and no right value: turn the lens until it is highest.
    pub focus: f64,
    /// The grey value that one lit pixel in a hundred exceeds.
    pub bright_dn: f64,
    /// What exposure would be right; none without fringes.
    #[serde(default)]
    pub exposure: Option<Exposure>,
}

/// What the light's figures mean.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct LightGrades {
    /// Of [`Light::saturated`]: a saturated fringe has no phase.
    pub saturated: Grade,
    /// Of [`Light::modulation_dn`]: the phase's noise goes with its inverse.
    pub modulation: Grade,
    /// Of [`Light::lit`]: is there anybody, and light?
    pub lit: Grade,
}

impl Light {
    /// Judged by the thresholds that `status` and reports show as well.
    pub fn grades(&self) -> LightGrades {
        LightGrades {
            saturated: SATURATED.grade(100.0 * self.saturated),
            modulation: MODULATION.grade(self.modulation_dn),
            lit: LIT.grade(100.0 * self.lit),
        }
    }
}

/// What the light of a window of [`WINDOW`] columns is good for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WindowLight {
    /// Nothing is lit, or nobody is there.
    Dark,
    /// Its fringes are strong enough.
    Good,
    /// It is lit, and its fringes are too weak.
    Weak,
    /// A pixel is saturated: the fringe has no peak.
    Saturated,
}

/// The light of every window of a sample, row by row, each row from its first column on.
pub fn windows(sample: &Sample) -> impl Iterator<Item = impl Iterator<Item = WindowLight>> {
    sample.pixels.chunks_exact(sample.width.max(1)).map(|row| {
        row.chunks_exact(WINDOW).map(|window| {
            let (low, high) = window.iter().fold((255u8, 0u8), |(low, high), &x| (low.min(x), high.max(x)));
            let amplitude_dn = f64::from(high - low) / 2.0;
            match (high, MODULATION.grade(amplitude_dn)) {
                (0..=LIT_DN, _) => WindowLight::Dark,
                (255, _) => WindowLight::Saturated,
                (_, Grade::Bad) => WindowLight::Weak,
                _ => WindowLight::Good,
            }
        })
    })
}

/// Grey value that the brightest pixel of a lit window exceeds.
const LIT_DN: u8 = 24;

/// Measures a sample of a frame.
pub fn measure(sample: &Sample) -> Light {
    let mut counts = [0u64; 256];
    // Amplitudes in half grey values, contrasts in two-hundredths.
    let (mut amplitudes, mut contrasts) = ([0u64; 256], [0u64; 201]);
    let (mut windows, mut bend, mut bends) = (0u64, 0u64, 0u64);
    for row in sample.pixels.chunks_exact(sample.width.max(1)) {
        for window in row.chunks_exact(WINDOW) {
            windows += 1;
            let (low, high) = window.iter().fold((255u8, 0u8), |(low, high), &x| (low.min(x), high.max(x)));
            if high <= LIT_DN {
                continue;
            }
            window.iter().for_each(|&x| counts[usize::from(x)] += 1);
            amplitudes[usize::from(high - low)] += 1;
            let (range, sum) = (u32::from(high - low), u32::from(high) + u32::from(low));
            contrasts[(200 * range / sum) as usize] += 1;
            for three in window.windows(3) {
                let second = i64::from(three[0]) - 2 * i64::from(three[1]) + i64::from(three[2]);
                bend += (second * second) as u64;
                bends += 1;
            }
        }
    }
    let mut peaks = Peaks::default();
    peaks.add(sample.width, &sample.pixels);
    let lit: u64 = amplitudes.iter().sum();
    let pixels: u64 = counts.iter().sum();
    let modulation_dn = quantile(&amplitudes, 0.5).unwrap_or(0.0) / 2.0;
    let share = |part: u64, whole: u64| if whole == 0 { 0.0 } else { part as f64 / whole as f64 };
    Light {
        saturated: share(counts[255], pixels),
        lit: share(lit, windows),
        modulation_dn,
        contrast: quantile(&contrasts, 0.5).unwrap_or(0.0) / 200.0,
        focus: if modulation_dn > 0.0 { share(bend, bends).sqrt() / modulation_dn } else { 0.0 },
        bright_dn: quantile(&counts, 0.99).unwrap_or(0.0),
        exposure: peaks.exposure(),
    }
}

#[cfg(test)]
mod tests {
    use super::measure;
    use crate::acquire::preview::Sample;
    use crate::telemetry::Grade;
    use std::f64::consts::TAU;

    /// Rows of fringes of this amplitude about a mean, lit over half of the width.
    fn fringes(mean: f64, amplitude: f64, period: f64) -> Sample {
        let (width, rows) = (480, 20);
        let pixel = |i: usize| {
            let u = i % width;
            let lit = mean + amplitude * (TAU * u as f64 / period).cos();
            if u < width / 2 { lit.round().clamp(0.0, 255.0) as u8 } else { 3 }
        };
        Sample { width, pixels: (0..width * rows).map(pixel).collect(), ..Sample::default() }
    }

    #[test]
    fn amplitude_and_contrast_are_those_of_the_fringes() {
        for period in [8.0, 11.3, 20.0] {
            let light = measure(&fringes(100.0, 60.0, period));
            assert!((light.modulation_dn - 60.0).abs() < 3.0, "{period}: {light:?}");
            assert!((light.contrast - 0.6).abs() < 0.03, "{period}: {light:?}");
            assert!((light.lit - 0.5).abs() < 1e-9 && light.saturated == 0.0);
        }
    }

    #[test]
    fn saturation_is_a_share_of_what_is_lit() {
        // A sine of 200 about 200 is cut at 255 where it is above 55: 41 % of the period.
        let light = measure(&fringes(200.0, 200.0, 12.0));
        assert!((light.saturated - 0.41).abs() < 0.06, "{light:?}");
        assert_eq!(light.bright_dn, 255.0);
        assert_eq!(light.grades().saturated, Grade::Bad);
    }

    #[test]
    fn every_window_says_what_its_light_is_good_for() {
        let of = |mean, amplitude| {
            let sample = fringes(mean, amplitude, 12.0);
            super::windows(&sample).next().expect("a row").collect::<Vec<_>>()
        };
        use super::WindowLight::{Dark, Good, Saturated, Weak};
        for (mean, amplitude, light) in [(100.0, 60.0, Good), (100.0, 8.0, Weak), (220.0, 60.0, Saturated)] {
            let row = of(mean, amplitude);
            assert_eq!((row[0], row[9], row[10], row[19]), (light, light, Dark, Dark), "{row:?}");
        }
    }

    #[test]
    fn finer_detail_is_better_focus_and_darkness_is_nothing() {
        assert!(measure(&fringes(100.0, 60.0, 8.0)).focus > 2.0 * measure(&fringes(100.0, 60.0, 16.0)).focus);
        assert_eq!(measure(&fringes(100.0, 60.0, 8.0)).grades().modulation, Grade::Good);
        let dark = measure(&fringes(3.0, 1.0, 12.0));
        assert_eq!((dark.lit, dark.modulation_dn, dark.focus), (0.0, 0.0, 0.0));
        assert_eq!((dark.grades().lit, dark.grades().modulation), (Grade::Bad, Grade::Bad));
        let nothing = measure(&Sample::default());
        assert_eq!((nothing.lit, nothing.saturated), (0.0, 0.0));
    }
}
