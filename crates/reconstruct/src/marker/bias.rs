// SPDX-License-Identifier: MIT OR Apache-2.0
//! The phase under and beside the marker, where the fringe is not a sine.
//!
//! Within one period of the marker its modulation shifts the phase, by up to pi between the dashes of a
//! darkened marker. [`Average`] takes the mean phasor over one period of the modulation along the column, with
//! the fringe's local tilt taken out: that of a zero-mean marker has no bias left. The mean light of a darkened
//! marker is known too, lobe times `1 - depth / 2`, so its bias is a function of the phase alone: [`Bias`]
//! tabulates it from the formula itself and takes it off.

use crate::base::image::Plane;
use crate::geometry::pattern::{Marker, Pattern};
use crate::kernels::pixel_runs::Runs;
use crate::kernels::subpixel::{self, LANES, Lanes};
use crate::phase::demodulate::sums;
use crate::triangulate::camera_projector::CameraProjector;
use std::f32::consts::{PI, TAU};

/// The zone around a ridge in which the marker disturbs the phase, in periods to each side.
const REACH_PERIODS: f32 = 1.0;

/// How far from the zone's ends the periods are taken that bridge it, in nominal fringe periods.
const BESIDE_PERIODS: f32 = 1.5;

/// Below this coherence the mean over the marker's period means nothing.
const MIN_COHERENCE: f32 = 0.5;

/// The pixels whose demodulation window touches the marker, into a plane of the size of `period`: the ridge's, widened
/// along the rows.
pub fn zone(ridges: &Runs, period: &Plane<f32>, zone: &mut Plane<u8>) {
    zone.as_mut_slice().fill(0);
    for v in 0..ridges.height() {
        for run in ridges.row(v) {
            // The reaches of neighbours overlap: together they leave no gap.
            let (mut start, mut end) = (run.start(), run.end());
            for u in run.columns() {
                let reach = (REACH_PERIODS * period.at(u, v)).ceil() as usize;
                start = start.min(u.saturating_sub(reach));
                end = end.max((u + reach + 1).min(period.width()));
            }
            zone.row_mut(v)[start..end].fill(1);
        }
    }
}

/// Crossings cannot be counted where a lobe is missing: in the zone, given by its runs, the period becomes the mean of
/// those beside it.
pub fn bridge_period(period: &mut Plane<f32>, zone: &Runs, nominal_px: f32) {
    let beside = (BESIDE_PERIODS * nominal_px).round() as usize;
    for v in 0..zone.height() {
        for run in zone.row(v) {
            let run = run.columns();
            let row = period.row_mut(v);
            let left = run.start.checked_sub(beside).map_or(0.0, |u| row[u]);
            let right = row.get(run.end - 1 + beside).copied().unwrap_or(0.0);
            let (left, right) = match (left > 0.0, right > 0.0) {
                (true, true) => (left, right),
                (true, false) => (left, left),
                (false, true) => (right, right),
                (false, false) => continue,
            };
            let last = (run.len() - 1).max(1) as f32;
            for (i, p) in row[run].iter_mut().enumerate() {
                *p = left + (right - left) * i as f32 / last;
            }
        }
    }
}

/// Mean phasors over one period of the modulation along the column.
#[derive(Debug)]
pub(crate) struct Average {
    taps: Vec<f32>,
}

/// Rows of C and S in a ring: row `v` is the entry `v % length`.
pub(crate) struct Ring<'a> {
    pub c: &'a [Vec<f32>],
    pub s: &'a [Vec<f32>],
}

impl Ring<'_> {
    #[inline(always)]
    fn load(&self, v: usize, first: usize) -> [Lanes; 2] {
        [subpixel::load(&self.c[v % self.c.len()], first), subpixel::load(&self.s[v % self.s.len()], first)]
    }
}

impl Average {
    pub(crate) fn new(pair: &CameraProjector) -> Self {
        Self { taps: taps(pair.marker_period_px) }
    }

    /// Rows that it needs on each side.
    pub(crate) fn reach(&self) -> usize {
        self.taps.len() / 2
    }

    /// C and S of a block around row `v`, whose window must lie in the frame; both 0 where that mean is not to be
    /// had.
    #[inline(always)]
    pub(crate) fn block(&self, ring: &Ring<'_>, v: usize, first: usize) -> [Lanes; 2] {
        let half = self.reach();
        let tilt = tilt(ring, v, half, first);
        // The rotation that takes the tilt out of the first row; each further row turns it back by one tilt.
        let (mut turn_c, mut turn_s): (Lanes, Lanes) = ([1.0; LANES], [0.0; LANES]);
        for _ in 0..half {
            for i in 0..LANES {
                (turn_c[i], turn_s[i]) = (
                    turn_c[i] * tilt[0][i] - turn_s[i] * tilt[1][i],
                    turn_c[i] * tilt[1][i] + turn_s[i] * tilt[0][i],
                );
            }
        }
        let [mut re, mut im, mut length] = [[0f32; LANES]; 3];
        let mut least: Lanes = [f32::INFINITY; LANES];
        for (k, &tap) in self.taps.iter().enumerate() {
            let [c, s] = ring.load(v + k - half, first);
            for i in 0..LANES {
                let power = c[i] * c[i] + s[i] * s[i];
                least[i] = if power < least[i] { power } else { least[i] };
                re[i] += tap * (c[i] * turn_c[i] - s[i] * turn_s[i]);
                im[i] += tap * (c[i] * turn_s[i] + s[i] * turn_c[i]);
                length[i] += tap * power.sqrt();
                (turn_c[i], turn_s[i]) = (
                    turn_c[i] * tilt[0][i] + turn_s[i] * tilt[1][i],
                    turn_s[i] * tilt[0][i] - turn_c[i] * tilt[1][i],
                );
            }
        }
        for i in 0..LANES {
            let mean = (re[i] * re[i] + im[i] * im[i]).sqrt();
            let coherent = (least[i] > 0.0) & (mean > MIN_COHERENCE * length[i]);
            re[i] = if coherent { re[i] } else { 0.0 };
            im[i] = if coherent { im[i] } else { 0.0 };
        }
        [re, im]
    }
}

/// Weights of a mean over exactly `period` rows; the outermost taps count in part.
fn taps(period: f32) -> Vec<f32> {
    let half = ((period - 1.0) / 2.0).ceil().max(0.0) as usize;
    let end = (period - (2 * half) as f32 + 1.0) / 2.0;
    (0..=2 * half).map(|k| if k == 0 || k == 2 * half { end / period } else { 1.0 / period }).collect()
}

/// Mean phase step from one row to the next around a block, as cosine and sine.
#[inline(always)]
fn tilt(ring: &Ring<'_>, v: usize, half: usize, first: usize) -> [Lanes; 2] {
    let [mut re, mut im] = [[0f32; LANES]; 2];
    let mut above = ring.load(v - half, first);
    for row in v - half + 1..=v + half {
        let below = ring.load(row, first);
        for i in 0..LANES {
            re[i] += above[0][i] * below[0][i] + above[1][i] * below[1][i];
            im[i] += above[0][i] * below[1][i] - above[1][i] * below[0][i];
        }
        above = below;
    }
    for i in 0..LANES {
        let size = (re[i] * re[i] + im[i] * im[i]).sqrt();
        let known = size > 0.0;
        re[i] = if known { re[i] / size } else { 1.0 };
        im[i] = if known { im[i] / size } else { 0.0 };
    }
    [re, im]
}

/// The bias of the seven-point formula around a darkened marker, by the biased phase relative to the marker.
#[derive(Debug)]
pub struct Bias {
    pattern: Pattern,
    /// Bias at `-REACH .. REACH` of the biased phase relative to the marker; empty where there is none.
    table: Vec<f32>,
}

impl Bias {
    /// How far from the marker the table goes, rad of phase: the formula's window is one fringe wide.
    const REACH: f32 = 1.5 * TAU;

    /// Steps of the table: 1/512 of a fringe each.
    const STEPS: usize = 1536;

    /// The table for a pattern.
    pub fn new(pattern: &Pattern) -> Self {
        let Marker::Darkened { depth } = pattern.marker else {
            return Self { pattern: pattern.clone(), table: Vec::new() };
        };
        let lobe = 1.0 - depth as f32 / 2.0;
        let (low, high) = (pattern.low as f32, pattern.high as f32);
        let light = |x: f32| {
            let fringe = low + (high - low) * (0.5 + 0.5 * x.cos());
            if x.abs() <= PI { fringe * lobe } else { fringe }
        };
        let biased = |x: f32| {
            let (s, c) = sums(&std::array::from_fn(|k| light(x + (k as f32 - 3.0) * TAU / 6.0)));
            let wrapped = s.atan2(c);
            wrapped + TAU * ((x - wrapped) / TAU).round()
        };
        // Sample the biased phase finely and invert it: for each entry the first true phase that reaches it.
        let step = 2.0 * Self::REACH / Self::STEPS as f32;
        let mut table = Vec::with_capacity(Self::STEPS + 1);
        let (fine, mut x) = (step / 8.0, -Self::REACH);
        let mut at = biased(x);
        for i in 0..=Self::STEPS {
            let target = i as f32 * step - Self::REACH;
            while at < target && x < Self::REACH {
                x += fine;
                at = biased(x);
            }
            table.push(at - x);
        }
        Self { pattern: pattern.clone(), table }
    }

    /// Takes the bias off absolute phases.
    pub fn correct(&self, absolute: &mut Plane<f32>) {
        if self.table.is_empty() {
            return;
        }
        let scale = Self::STEPS as f32 / (2.0 * Self::REACH);
        for phase in absolute.as_mut_slice() {
            let place = (self.pattern.from_marker(f64::from(*phase)) as f32 + Self::REACH) * scale;
            if place >= 0.0 && place < Self::STEPS as f32 {
                let i = place as usize;
                let f = place - i as f32;
                *phase -= (1.0 - f) * self.table[i] + f * self.table[i + 1];
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{Bias, Ring, taps};
    use crate::base::image::Plane;
    use crate::geometry::pattern::{Marker, Pattern};
    use crate::kernels::subpixel::LANES;
    use crate::phase::demodulate::sums;
    use proptest::prelude::{ProptestConfig, prop_assert, proptest};
    use std::f32::consts::TAU;

    #[test]
    fn the_bias_of_a_darkened_marker_is_taken_off() {
        let pattern = Pattern {
            period_px: 8.0,
            marker_index: 80,
            marker_every: 0,
            marker: Marker::Darkened { depth: 0.8 },
            marker_period_px: 8.0,
            low: 0.0,
            high: 1.0,
            gamma: 1.0,
        };
        // Light averaged along the marker, from the pattern itself.
        let light = |phase: f64| {
            let u = pattern.column(phase);
            (0..32).map(|v| pattern.light(u, f64::from(v) / 4.0)).sum::<f64>() as f32 / 32.0
        };
        let (mut before, mut after) = (0f32, 0f32);
        for i in -240..240 {
            let truth = 80.0 * f64::from(TAU) + f64::from(i) * 0.03 + 0.01;
            let samples = std::array::from_fn(|k| light(truth + (k as f64 - 3.0) * f64::from(TAU) / 6.0));
            let (s, c) = sums(&samples);
            let wrapped = s.atan2(c);
            let truth = truth as f32;
            let mut plane = Plane::filled(1, 1, wrapped + TAU * ((truth - wrapped) / TAU).round());
            before = before.max((plane.at(0, 0) - truth).abs());
            Bias::new(&pattern).correct(&mut plane);
            after = after.max((plane.at(0, 0) - truth).abs());
        }
        assert!(before > 0.15 && after < 0.01, "{before} {after}");
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        /// A phasor whose phase rises steadily along the column keeps its phase, whatever the modulation of zero mean.
        #[test]
        fn the_mean_over_the_modulation_has_the_tilt_taken_out(
            phase in -3.0f32..3.0,
            tilt in -0.15f32..0.15,
            depth in 0.0f32..0.3,
            gap in 0usize..64,
        ) {
            let period = 11.0;
            let average = super::Average { taps: taps(period) };
            let rows = average.taps.len();
            let (mut c, mut s) = (vec![vec![0f32; LANES]; rows], vec![vec![0f32; LANES]; rows]);
            let middle = average.reach();
            for v in 0..rows {
                for u in 0..LANES {
                    let x = v as f32 - middle as f32;
                    let size = 300.0 * (1.0 + depth * (TAU * x / period + u as f32).cos());
                    let at = phase + 0.05 * u as f32 + tilt * x;
                    (c[v][u], s[v][u]) = (size * at.cos(), size * at.sin());
                }
            }
            if gap < LANES {
                (c[1][gap], s[1][gap]) = (0.0, 0.0);
            }
            let [re, im] = average.block(&Ring { c: &c, s: &s }, middle, 0);
            for u in 0..LANES {
                if u == gap {
                    prop_assert!(re[u] == 0.0 && im[u] == 0.0);
                    continue;
                }
                let error = im[u].atan2(re[u]) - (phase + 0.05 * u as f32);
                let size = re[u].hypot(im[u]);
                prop_assert!(error.sin().abs() < 0.002 && error.cos() > 0.0, "{error}");
                prop_assert!((size / 300.0 - 1.0).abs() < 0.01, "{size}");
            }
        }
    }

    #[test]
    fn taps_are_a_mean_over_the_period() {
        for period in [7.0, 8.4, 11.0, 11.9, 12.3] {
            let taps = taps(period);
            assert!(
                (taps.iter().sum::<f32>() - 1.0).abs() < 1e-5 && taps.iter().all(|&x| x > 0.0),
                "{taps:?}"
            );
            let response: f32 = taps
                .iter()
                .enumerate()
                .map(|(k, tap)| tap * (TAU * (k as f32 - (taps.len() / 2) as f32) / period).cos())
                .sum();
            assert!(response.abs() < 0.02, "{period}: {response}");
        }
    }
}
