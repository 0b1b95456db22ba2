// SPDX-License-Identifier: MIT OR Apache-2.0
//! From light on the sensor to pixel values: blur, sensitivity, noise, saturation, 8 bits.

use super::sensor::Sensor;
use crate::random::{NormalTable, hash, mix, text_number};
use crate::scenario::Optics;
use fourdbody::base::image::Plane;
use rayon::prelude::{IndexedParallelIterator, ParallelIterator, ParallelSlice, ParallelSliceMut};

/// What an exposure's noise depends on.
#[derive(Debug, Clone, Copy)]
pub struct Exposure {
    pub seed: u64,
    pub instant: u64,
}

/// Blurs an image by a Gaussian of `sigma` px; beyond the border the border goes on.
pub fn blur(image: &mut Plane<f32>, scratch: &mut Plane<f32>, sigma: f64) {
    let reach = (3.0 * sigma).ceil() as usize;
    if reach == 0 {
        return;
    }
    let (width, height) = (image.width(), image.height());
    let raw: Vec<f64> = (0..=reach).map(|k| (-0.5 * (k as f64 / sigma).powi(2)).exp()).collect();
    let sum = 2.0 * raw.iter().sum::<f64>() - raw[0];
    let kernel: Vec<f32> = raw.iter().map(|w| (w / sum) as f32).collect();
    scratch.as_mut_slice().par_chunks_mut(width).zip(image.as_slice().par_chunks(width)).for_each(
        |(out, row)| {
            let mut padded = Vec::with_capacity(width + 2 * reach);
            padded.extend(std::iter::repeat_n(row[0], reach));
            padded.extend_from_slice(row);
            padded.extend(std::iter::repeat_n(row[width - 1], reach));
            let middle = &padded[reach..reach + width];
            out.iter_mut().zip(middle).for_each(|(o, m)| *o = kernel[0] * m);
            for (k, weight) in kernel.iter().enumerate().skip(1) {
                let (left, right) = (&padded[reach - k..][..width], &padded[reach + k..][..width]);
                out.iter_mut().zip(left.iter().zip(right)).for_each(|(o, (l, r))| *o += weight * (l + r));
            }
        },
    );
    let source: &Plane<f32> = scratch;
    image.as_mut_slice().par_chunks_mut(width).enumerate().for_each(|(v, out)| {
        out.iter_mut().zip(source.row(v)).for_each(|(o, m)| *o = kernel[0] * m);
        for (k, weight) in kernel.iter().enumerate().skip(1) {
            let above = source.row(v.saturating_sub(k));
            let below = source.row((v + k).min(height - 1));
            out.iter_mut().zip(above.iter().zip(below)).for_each(|(o, (a, b))| *o += weight * (a + b));
        }
    });
}

/// Blurs each pixel by what its distance from the lens gives: a mix of the two nearest of a row of blurred images.
pub fn blur_by_depth(image: &mut Plane<f32>, distances: impl Iterator<Item = f32>, optics: &Optics) {
    const STEP_PX: f64 = 0.5;
    const STEPS: usize = 8;
    let mut scratch = image.clone();
    let blurred = |k: usize, scratch: &mut Plane<f32>| {
        let mut copy = image.clone();
        blur(&mut copy, scratch, optics.camera_blur_px + k as f64 * STEP_PX);
        copy
    };
    let images: Vec<Plane<f32>> = (0..=STEPS).map(|k| blurred(k, &mut scratch)).collect();
    for (i, distance) in distances.enumerate() {
        let more = optics.camera_defocus * (f64::from(distance).min(10.0) - optics.camera_focus_m).abs();
        let sigma = optics.camera_blur_px.hypot(more);
        let step = ((sigma - optics.camera_blur_px) / STEP_PX).clamp(0.0, STEPS as f64);
        let k = (step as usize).min(STEPS - 1);
        let far = (step - k as f64) as f32;
        let [near, next] = [k, k + 1].map(|k| images[k].as_slice()[i]);
        image.as_mut_slice()[i] = (1.0 - far) * near + far * next;
    }
}

/// Pixel values of light in DN: sensitivity, offset, shot and read noise, rounding, saturation.
///
/// One normal variable of variance `signal / electrons_per_dn + read_noise^2` stands for both noises.
pub fn expose(
    light: &Plane<f32>,
    sensor: &Sensor,
    optics: &Optics,
    exposure: Exposure,
    normal: &NormalTable,
    pixels: &mut [u8],
) {
    let width = light.width();
    let words = [text_number("noise"), text_number(sensor.id.as_str()), exposure.instant];
    let key = hash(exposure.seed, &words);
    let shot = (1.0 / optics.electrons_per_dn) as f32;
    let read = (optics.read_noise_dn * optics.read_noise_dn) as f32;
    let offset = optics.offset_dn as f32;
    pixels
        .par_chunks_mut(width)
        .zip(light.as_slice().par_chunks(width).zip(sensor.sensitivity.par_chunks(width)))
        .enumerate()
        .for_each(|(v, (out, (row, sensitivity)))| {
            let first = (v * width) as u64;
            for (u, pixel) in out.iter_mut().enumerate() {
                let signal = row[u] * sensitivity[u];
                let sigma = (signal * shot + read).sqrt();
                let noise = normal.pick(mix(key ^ (first + u as u64)));
                // `as` saturates: 255 is full well, nothing is darker than 0.
                *pixel = (signal + offset + sigma * noise + 0.5) as u8;
            }
        });
}

#[cfg(test)]
mod tests {
    use super::blur;
    use fourdbody::base::image::Plane;

    #[test]
    fn blur_keeps_the_sum_and_has_its_width() {
        let mut image = Plane::filled(41, 31, 0f32);
        image.set(20, 15, 1.0);
        let mut scratch = image.clone();
        blur(&mut image, &mut scratch, 0.6);
        let at = |u: usize, v: usize| f64::from(image.at(u, v));
        let (mut sum, mut spread) = (0.0, 0.0);
        for v in 0..31 {
            for u in 0..41 {
                sum += at(u, v);
                spread += at(u, v) * (u as f64 - 20.0).powi(2);
            }
        }
        assert!((sum - 1.0).abs() < 1e-5, "{sum}");
        assert!((spread - 0.36).abs() < 0.03, "{spread}");
        assert!((at(19, 15) - at(20, 16)).abs() < 1e-7);
    }
}
