// SPDX-License-Identifier: MIT OR Apache-2.0
//! What exposure would be right: one number, in EV, from how bright the fringes of the body are.
//!
//! The noise of a phase is that of the light over the fringes' amplitude. With the exposure it falls like the inverse
//! where the sensor's own noise prevails, like the root of that where the photons' does: more light is always better,
//! until a fringe's peak is cut at 255, where it has no phase. So the right exposure puts the brightest fringes just
//! below that. Pixels belong to the body where the fringes' amplitude is large enough relative to the largest, at any
//! exposure.

use serde::{Deserialize, Serialize};
use std::f64::consts::{PI, SQRT_2};
use std::fmt;

/// Columns over which a fringe shows its whole range: the longest period of the rig is 24 px (docs of optics).
pub const WINDOW: usize = 24;
/// Where the brightest fringes should peak, DN: 10 % below the limit, as much as a body gains that comes nearer by 5 %.
const PEAK_DN: f64 = 230.0;
/// Share of the body's fringes that may peak above that: glints.
const BRIGHTER: f64 = 0.02;
/// Share of the windows with the largest ranges that is left out as stray.
const STRAY: f64 = 0.005;
/// Least range of a window that shows the body, as a share of the largest.
const OF_LARGEST: f64 = 0.125;
/// Ranges below this are noise, DN.
const LEAST_RANGE_DN: u8 = 6;
/// Share of all pixels that are darker than the level that counts as no light.
const DARK: f64 = 0.01;
/// Highest peak that is counted, DN; higher ones are guesses, and count as this.
const MOST_DN: usize = 1023;

/// How bright the fringes of the body were in some frames of a camera.
#[derive(Debug, Clone)]
pub struct Peaks {
    /// Windows by the light on their ridges, as it would be without a limit, DN.
    peaks: Vec<u64>,
    /// Pixels of all windows by grey value.
    pixels: [u64; 256],
    /// Pixels of the body, and how many of them are saturated.
    body: u64,
    saturated: u64,
}

/// The exposure that would be right.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Exposure {
    /// By how much to change it: 1 is twice the light, -1 half of it.
    pub ev: f64,
    /// Share of the body's pixels that are saturated, 0 to 1.
    pub saturated: f64,
}

impl Default for Peaks {
    fn default() -> Self {
        Self { peaks: vec![0; MOST_DN + 1], pixels: [0; 256], body: 0, saturated: 0 }
    }
}

impl Peaks {
    /// Adds rows of a frame, `width` pixels each.
    pub fn add(&mut self, width: usize, pixels: &[u8]) {
        let windows = || pixels.chunks_exact(width.max(1)).flat_map(|row| row.chunks_exact(WINDOW));
        let range = |window: &[u8]| {
            let (low, high) = window.iter().fold((255u8, 0u8), |(low, high), &x| (low.min(x), high.max(x)));
            (low, high - low.min(high))
        };
        let mut ranges = [0u64; 256];
        windows().for_each(|window| ranges[usize::from(range(window).1)] += 1);
        let Some(largest) = quantile(&ranges, 1.0 - STRAY) else { return };
        let least = (OF_LARGEST * largest).max(f64::from(LEAST_RANGE_DN));
        for window in windows() {
            window.iter().for_each(|&x| self.pixels[usize::from(x)] += 1);
            let (low, range) = range(window);
            let cut = window.iter().filter(|x| **x == 255).count();
            // What is cut all over has no range any more.
            if f64::from(range) < least && cut < WINDOW {
                continue;
            }
            self.body += WINDOW as u64;
            self.saturated += cut as u64;
            let peak = if cut == 0 { uncut_peak(window) } else { cut_peak(low, cut) };
            self.peaks[(peak.round() as usize).min(MOST_DN)] += 1;
        }
    }

    /// The exposure that would be right; `None` where no fringes were seen.
    pub fn exposure(&self) -> Option<Exposure> {
        let peak = quantile(&self.peaks, 1.0 - BRIGHTER)?;
        let dark = quantile(&self.pixels, DARK)?;
        let ev = ((PEAK_DN - dark).max(1.0) / (peak - dark).max(1.0)).log2();
        Some(Exposure { ev, saturated: self.saturated as f64 / self.body.max(1) as f64 })
    }
}

/// Of a sine, whose deviation is its amplitude over root 2: noise makes less of that than of the brightest pixel.
fn uncut_peak(window: &[u8]) -> f64 {
    let n = window.len() as f64;
    let (sum, squares) = window.iter().fold((0.0, 0.0), |(sum, squares), &x| {
        let x = f64::from(x);
        (sum + x, squares + x * x)
    });
    let mean = sum / n;
    mean + SQRT_2 * (squares / n - mean * mean).max(0.0).sqrt()
}

/// Of a sine that is cut over a share f of its period, at 255 = low + a (1 + cos(pi f)), a its amplitude.
fn cut_peak(low: u8, cut: usize) -> f64 {
    let low = f64::from(low);
    let above = 1.0 + (PI * cut as f64 / WINDOW as f64).cos();
    low + 2.0 * (255.0 - low) / above.max(0.25)
}

/// The value below or at which this share of the counted lie; `None` without any.
pub(super) fn quantile(counts: &[u64], share: f64) -> Option<f64> {
    let wanted = (counts.iter().sum::<u64>() as f64 * share).ceil() as u64;
    let mut below = 0;
    let found = counts.iter().position(|count| {
        below += count;
        *count > 0 && below >= wanted
    });
    found.map(|value| value as f64)
}

impl fmt::Display for Exposure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // No sign before a zero.
        let ev = (10.0 * self.ev).round() / 10.0 + 0.0;
        write!(f, "{ev:+.1} EV")?;
        if self.saturated >= 0.005 {
            write!(f, ": {:.0} % of the body is saturated", 100.0 * self.saturated)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::{Exposure, Peaks};
    use std::f64::consts::TAU;

    /// A body in the middle third whose light falls off to its sides, times `factor`, over a sensor's offset.
    fn frame(factor: f64, offset: f64) -> (usize, Vec<u8>) {
        let width = 1920;
        let pixel = |i: usize| {
            let u = (i % width) as f64;
            let across = (u - 960.0) / 320.0;
            let body = if across.abs() < 1.0 { 90.0 * (1.0 - across * across).sqrt() } else { 0.0 };
            let noise = [0.4, -0.6, 0.1, -0.2, 0.7, -0.4][i % 6];
            (factor * body * (1.0 + 0.9 * (TAU * u / 11.7).cos()) + offset + noise).round().clamp(0.0, 255.0)
                as u8
        };
        (width, (0..width * 40).map(pixel).collect())
    }

    fn advised(factor: f64, offset: f64) -> Exposure {
        let (width, pixels) = frame(factor, offset);
        let mut peaks = Peaks::default();
        peaks.add(width, &pixels);
        peaks.exposure().expect("there is a body")
    }

    #[test]
    fn whatever_the_light_the_advice_leads_to_the_same_exposure() {
        for offset in [0.0, 6.0] {
            let right = advised(1.0, offset);
            assert!(
                (right.ev - (229.0f64 / 171.0).log2()).abs() < 0.1 && right.saturated == 0.0,
                "{right:?}"
            );
            for factor in [0.08, 0.2, 0.5, 1.3] {
                let found = advised(factor, offset);
                assert!(
                    (found.ev + factor.log2() - right.ev).abs() < 0.2,
                    "x {factor}: {found:?}, {right:?}"
                );
            }
            for factor in [1.8, 2.2, 3.0] {
                let found = advised(factor, offset);
                assert!(
                    (found.ev + factor.log2() - right.ev).abs() < 0.3,
                    "x {factor}: {found:?}, {right:?}"
                );
                assert!(found.saturated > 0.01, "x {factor}: {found:?}");
            }
        }
    }

    #[test]
    fn nobody_is_no_advice() {
        let mut peaks = Peaks::default();
        assert_eq!(peaks.exposure(), None);
        let noise: Vec<u8> = (0..1920 * 40).map(|i| 3 + (i * 7 % 5) as u8).collect();
        peaks.add(1920, &noise);
        peaks.add(0, &[]);
        assert_eq!(peaks.exposure(), None);
    }

    #[test]
    fn advice_is_one_number_and_says_what_is_lost() {
        let said = |ev, saturated| Exposure { ev, saturated }.to_string();
        assert_eq!(said(0.68, 0.001), "+0.7 EV");
        assert_eq!(said(-1.22, 0.141), "-1.2 EV: 14 % of the body is saturated");
        assert_eq!(said(-0.02, 0.0), "+0.0 EV");
    }
}
