// SPDX-License-Identifier: MIT OR Apache-2.0
//! Projectors: how much light leaves a panel position.

use crate::scenario::{Light, Optics};
use fourdbody::base::image::Plane;
use fourdbody::config::Channel;
use fourdbody::geometry::Device;
use fourdbody::geometry::pattern::Pattern;
use nalgebra::Point3;

/// Fractions of a pixel that the blur is tabulated for: half a step is 2e-4 px, or 2e-4 rad at period 8.
const FRACTIONS: usize = 2048;

/// A panel's image as light, seen through the panel's pixels and the projector's blur.
pub struct PanelLight {
    /// Light of each panel pixel, 0 to 1, with a dark margin on all sides.
    light: Plane<f32>,
    width: usize,
    height: usize,
    margin: usize,
    /// Blurs that it is seen through, rising by [`BLUR_STEP_PX`]. One, where the blur is the same everywhere.
    blurs: Vec<Blur>,
}

/// What lies between is mixed from the two blurs around it, px.
const BLUR_STEP_PX: f64 = 0.25;

/// No fringe of 8 px outlives more, px.
const MOST_BLUR_PX: f64 = 4.0;

/// A Gaussian blur of the panel, as a table.
struct Blur {
    px: f64,
    reach: usize,
    /// For each fraction, the weights of the pixels from `-reach` to `reach`.
    weights: Vec<f32>,
}

impl Blur {
    fn new(px: f64) -> Self {
        let reach = (0.5 + 4.0 * px).ceil() as usize;
        Self { px, reach, weights: weights(px, reach) }
    }
}

impl PanelLight {
    /// An 8-bit panel image through `black + (1 - black) (value / 255)^gamma`, a pixel's square and Gaussians from
    /// `least_px` to `most_px`.
    pub fn new(panel: &Plane<u8>, gamma: f64, black: f64, [least_px, most_px]: [f64; 2]) -> Self {
        let steps = ((most_px.min(MOST_BLUR_PX) - least_px) / BLUR_STEP_PX).ceil().max(0.0) as usize;
        let blurs: Vec<Blur> = (0..=steps).map(|k| Blur::new(least_px + k as f64 * BLUR_STEP_PX)).collect();
        let margin = blurs.last().map_or(0, |blur| blur.reach);
        let (width, height) = (panel.width(), panel.height());
        let mut light = Plane::filled(width + 2 * margin, height + 2 * margin, 0f32);
        let table: Vec<f32> = (0..256)
            .map(|value| (black + (1.0 - black) * (f64::from(value) / 255.0).powf(gamma)) as f32)
            .collect();
        for v in 0..height {
            let row = &mut light.row_mut(v + margin)[margin..margin + width];
            row.iter_mut().zip(panel.row(v)).for_each(|(light, &value)| *light = table[usize::from(value)]);
        }
        Self { light, width, height, margin, blurs }
    }

    /// What the rig's pattern, white or black looks like on this projector.
    pub fn of(light: Light, pattern: &Pattern, optics: &Optics, width: usize, height: usize) -> Self {
        let panel = match light {
            Light::Fringes => pattern.panel(width, height),
            Light::White => Plane::filled(width, height, 255),
            Light::Dark => Plane::filled(width, height, 0),
        };
        let gamma = optics.projector_gamma.unwrap_or(pattern.gamma);
        Self::new(&panel, gamma, optics.black_level, optics.projector_blurs_px())
    }

    /// Light at panel position (u, v), where it is blurred by `blur_px`: 0 outside the panel and its blur.
    #[inline]
    pub fn blurred_at(&self, u: f64, v: f64, blur_px: f64) -> f32 {
        let [first, .., _] = &self.blurs[..] else { return self.at(u, v, &self.blurs[0]) };
        let step = ((blur_px - first.px) / BLUR_STEP_PX).clamp(0.0, (self.blurs.len() - 1) as f64);
        let k = (step as usize).min(self.blurs.len() - 2);
        let far = (step - k as f64) as f32;
        (1.0 - far) * self.at(u, v, &self.blurs[k]) + far * self.at(u, v, &self.blurs[k + 1])
    }

    #[inline]
    fn at(&self, u: f64, v: f64, blur: &Blur) -> f32 {
        // Beyond the last pixel whose blur can reach inside, and for NaN.
        let margin = blur.reach as f64 - 0.5;
        let inside = u > -margin && v > -margin;
        if !(inside && u < self.width as f64 - 1.0 + margin && v < self.height as f64 - 1.0 + margin) {
            return 0.0;
        }
        let taps = 2 * blur.reach + 1;
        let split = |x: f64| {
            let nearest = (x + 0.5).floor();
            let fraction = ((x + 0.5 - nearest) * FRACTIONS as f64) as usize;
            let first = nearest as isize + (self.margin - blur.reach) as isize;
            (first, &blur.weights[fraction.min(FRACTIONS - 1) * taps..][..taps])
        };
        let (column, along_u) = split(u);
        let (row, along_v) = split(v);
        // The dark margin holds what lies beyond the panel; taps further out are cut.
        let first_column = column.max(0) as usize;
        let skip_u = first_column.wrapping_sub(column as usize).min(taps);
        let mut sum = 0.0;
        for (j, weight) in along_v.iter().enumerate() {
            let y = row + j as isize;
            if y < 0 || y as usize >= self.light.height() {
                continue;
            }
            let line = self.light.row(y as usize).get(first_column..).unwrap_or(&[]);
            let part: f32 = line.iter().zip(&along_u[skip_u..]).map(|(light, weight)| light * weight).sum();
            sum += weight * part;
        }
        sum
    }
}

/// Shares of the neighbouring pixels at each fraction: Gaussian integrated over the pixel (Simpson's rule).
fn weights(blur_px: f64, reach: usize) -> Vec<f32> {
    let taps = 2 * reach + 1;
    let mut weights = Vec::with_capacity(FRACTIONS * taps);
    for fraction in 0..FRACTIONS {
        let offset = (fraction as f64 + 0.5) / FRACTIONS as f64 - 0.5;
        let share = |tap: usize| pixel_share(offset - (tap as f64 - reach as f64), blur_px);
        let raw: Vec<f64> = (0..taps).map(share).collect();
        let sum: f64 = raw.iter().sum();
        weights.extend(raw.iter().map(|w| (w / sum) as f32));
    }
    weights
}

/// Light from a pixel's unit square at `distance` px from its centre under a Gaussian blur.
fn pixel_share(distance: f64, blur_px: f64) -> f64 {
    if blur_px < 1e-6 {
        return if distance.abs() <= 0.5 { 1.0 } else { 0.0 };
    }
    const STEPS: usize = 64;
    let gauss = |x: f64| (-0.5 * (x / blur_px).powi(2)).exp();
    (0..=STEPS)
        .map(|i| {
            let weight = if i == 0 || i == STEPS { 1.0 } else { 2.0 + 2.0 * (i % 2) as f64 };
            weight * gauss(distance - 0.5 + i as f64 / STEPS as f64)
        })
        .sum()
}

/// A projector in its place.
pub struct Lamp {
    pub device: Device,
    pub channel: Channel,
    /// Its projection centre, world, m.
    pub centre: Point3<f64>,
}

impl Lamp {
    /// A projector with this geometry and colour.
    pub fn new(device: Device, channel: Channel) -> Self {
        let centre = device.centre();
        Self { device, channel, centre }
    }
}

#[cfg(test)]
mod tests {
    use super::PanelLight;
    use fourdbody::base::image::Plane;

    fn at(light: &PanelLight, u: f64, v: f64) -> f32 {
        light.blurred_at(u, v, 0.0)
    }

    #[test]
    fn a_flat_panel_is_flat_and_ends_at_its_border() {
        let light = PanelLight::new(&Plane::filled(40, 30, 255), 1.0, 0.004, [0.55; 2]);
        for u in [6.0, 6.25, 20.1, 33.9] {
            assert!((at(&light, u, 15.3) - 1.0).abs() < 1e-6);
        }
        assert!((at(&light, -0.5, 15.0) - 0.5).abs() < 1e-3, "{}", at(&light, -0.5, 15.0));
        assert!((at(&light, 39.5, 15.0) - 0.5).abs() < 1e-3, "{}", at(&light, 39.5, 15.0));
        assert!((at(&light, 20.0, 29.5) - 0.5).abs() < 1e-3);
        for outside in [(-9.0, 15.0), (60.0, 15.0), (20.0, -9.0), (20.0, 45.0), (f64::NAN, 0.0)] {
            assert_eq!(at(&light, outside.0, outside.1), 0.0);
        }
        for edge in 0..500 {
            let u = -5.0 + 0.1 * f64::from(edge);
            assert!((0.0..=1.000_01).contains(&at(&light, u, u)), "{u}");
        }
    }

    #[test]
    fn blur_lowers_contrast_as_its_transfer_function_says() {
        let mut panel = Plane::filled(64, 16, 0u8);
        for v in 0..16 {
            for u in 0..64 {
                let phase = std::f64::consts::TAU * (u as f64 + 0.5) / 8.0;
                panel.set(u, v, (127.5 + 127.0 * phase.cos()).round() as u8);
            }
        }
        let light = PanelLight::new(&panel, 1.0, 0.0, [0.55; 2]);
        let (bright, dark) = (f64::from(at(&light, 31.5, 8.0)), f64::from(at(&light, 27.5, 8.0)));
        let frequency = 1.0 / 8.0;
        let gauss = (-2.0 * (std::f64::consts::PI * frequency * 0.55f64).powi(2)).exp();
        let pixel = (std::f64::consts::PI * frequency).sin() / (std::f64::consts::PI * frequency);
        assert!(((bright - dark) - gauss * pixel * 254.0 / 255.0).abs() < 0.003, "{}", bright - dark);
    }

    #[test]
    fn blur_is_mixed_between_its_steps_and_leaves_the_mean() {
        let mut panel = Plane::filled(64, 16, 0u8);
        (0..16)
            .flat_map(|v| (0..64).map(move |u| (u, v)))
            .for_each(|(u, v)| panel.set(u, v, if u % 8 < 4 { 255 } else { 0 }));
        let light = PanelLight::new(&panel, 1.0, 0.0, [0.5, 3.0]);
        let mut last = f32::INFINITY;
        for blur_px in [0.5, 0.6, 0.9, 1.4, 2.2, 3.0] {
            let row: Vec<f32> =
                (0..80).map(|i| light.blurred_at(28.0 + 0.1 * f64::from(i), 8.0, blur_px)).collect();
            let (least, most) = row.iter().fold((1f32, 0f32), |(a, b), &x| (a.min(x), b.max(x)));
            let mean = row.iter().sum::<f32>() / 80.0;
            assert!((mean - 0.5).abs() < 0.01, "{blur_px}: {mean}");
            assert!(most - least < last, "{blur_px}");
            last = most - least;
        }
        assert!(last < 0.1, "{last}");
    }
}
