// SPDX-License-Identifier: MIT OR Apache-2.0
//! Marker map Mm and the shift from Um to Fm (paper, Equation 5, Figure 9).

use super::mask::largest_segment;
use super::planes::one_if;
use crate::base::image::{Mono8, Plane};
use rustfft::FftPlanner;
use rustfft::num_complex::Complex;
use std::f32::consts::{FRAC_PI_2, PI, TAU};

/// The marker's band: periods from its own over this to its own times this.
const BAND: f32 = 1.35;

/// Share of the projected modulation from which a pixel counts as marker: a lens blurs it.
const THRESHOLD: f32 = 0.35;

/// What Mm is cut from, and Mm: the largest segment of what exceeds the threshold, 1 there and 0 elsewhere.
///
/// `period_px` is the period of the marker's modulation along the fringe, which is a column of the image, and
/// `contrast` its projected amplitude relative to the light.
pub fn find(
    image: Mono8<'_>,
    object: &Plane<f32>,
    period_px: f32,
    contrast: f32,
) -> (Plane<f32>, Plane<f32>) {
    let energy = band_energy(image, object, period_px);
    let marker = largest_segment(&energy.map(|energy| one_if(energy > THRESHOLD * contrast)));
    (energy, marker)
}

/// Amplitude of each column's light in the marker's band, relative to the mean light of its object pixels; 0 beside
/// the object. Of the Fourier transform the band's positive frequencies alone are transformed back, so that the
/// magnitude is the amplitude.
fn band_energy(image: Mono8<'_>, object: &Plane<f32>, period_px: f32) -> Plane<f32> {
    let rows = image.height();
    let mut planner = FftPlanner::<f32>::new();
    let (forward, inverse) = (planner.plan_fft_forward(rows), planner.plan_fft_inverse(rows));
    let frequency = rows as f32 / period_px;
    let band = frequency / BAND..=frequency * BAND;
    let mut energy = Plane::filled(image.width(), rows, 0.0);
    for u in 0..image.width() {
        let light = |v: usize| object.at(u, v) * f32::from(image.row(v)[u]);
        let mut column: Vec<Complex<f32>> = (0..rows).map(|v| light(v).into()).collect();
        let pixels: f32 = (0..rows).map(|v| object.at(u, v)).sum();
        let mean = (0..rows).map(light).sum::<f32>() / pixels.max(1.0);
        forward.process(&mut column);
        for (k, x) in column.iter_mut().enumerate() {
            *x *= one_if(2 * k < rows && band.contains(&(k as f32)));
        }
        inverse.process(&mut column);
        for (v, x) in column.iter().enumerate() {
            energy.set(u, v, object.at(u, v) * 2.0 * x.norm_sqr().sqrt() / (rows as f32 * mean.max(1.0)));
        }
    }
    energy
}

/// Equation 5: the shift, rad, from Um to Fm, with the median of Um under the marker; `None` without a marker.
///
/// Only the fringe's bright half counts, |Wm| < pi / 2: with the pixels between two fringes the median can sit on
/// their border.
pub fn shift(
    unwrapped: &Plane<f32>,
    wrapped: &Plane<f32>,
    marker: &Plane<f32>,
    marker_index: u32,
) -> Option<f32> {
    let core = |i: &usize| marker.as_slice()[*i] > 0.0 && wrapped.as_slice()[*i].abs() < FRAC_PI_2;
    let phases = (0..marker.as_slice().len()).filter(core).map(|i| unwrapped.as_slice()[i]);
    let mut phases: Vec<f32> = phases.filter(|phase| !phase.is_nan()).collect();
    phases.sort_unstable_by(f32::total_cmp);
    let median = *phases.get(phases.len() / 2)?;
    Some(TAU * (marker_index as f32 - ((median + PI) / TAU).floor()))
}

#[cfg(test)]
mod tests {
    use super::{find, shift};
    use crate::base::image::{Mono8, Plane};
    use proptest::prelude::{ProptestConfig, prop_assert, prop_assert_eq, proptest};
    use std::f32::consts::{FRAC_PI_2, PI, TAU};

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(16))]
        #[test]
        fn the_marker_is_found_where_it_is_planted(fringe in 3usize..12, period in 6.0f32..14.0) {
            let columns = 10 * fringe - 5..10 * fringe + 5;
            let image = Plane::from_fn(150, 120, |u, v| {
                let dashes = 1.0 - 0.3 * (1.0 + (TAU * v as f32 / period).cos());
                let light = 100.0 + 80.0 * (TAU * u as f32 / 10.0).cos();
                (light * if columns.contains(&u) { dashes } else { 1.0 }) as u8
            });
            let object = Plane::from_fn(150, 120, |_, v| if (10..110).contains(&v) { 1.0 } else { 0.0 });
            let (_, marker) = find(Mono8::from(&image), &object, period, 0.43);
            for v in 20..100 {
                for u in 0..150 {
                    prop_assert_eq!(marker.at(u, v) > 0.0, columns.contains(&u), "{} {}", u, v);
                }
            }
        }

        #[test]
        fn equation_5_puts_the_marker_where_it_belongs(order in -40i32..40, core in -FRAC_PI_2..FRAC_PI_2) {
            let [wrapped, unwrapped] = [core, TAU * order as f32 + core].map(|phase| Plane::filled(3, 3, phase));
            let shift = shift(&unwrapped, &wrapped, &Plane::filled(3, 3, 1.0), 80).expect("a marker");
            let absolute = unwrapped.at(1, 1) + shift;
            prop_assert!((absolute - TAU * 80.0).abs() < PI, "{absolute}");
        }
    }

    #[test]
    fn without_a_marker_there_is_no_shift() {
        let phase = Plane::filled(3, 3, 0.1);
        assert_eq!(shift(&phase, &phase, &Plane::filled(3, 3, 0.0), 80), None);
    }
}
