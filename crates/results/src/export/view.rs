// SPDX-License-Identifier: MIT OR Apache-2.0
//! A picture of a cloud: every point a splat with a depth buffer, lit by its normal.
//!
//! The view is orthographic from a given azimuth around the vertical axis: the cloud fills the height.

use crate::data::Cloud;

/// A picture of 8-bit RGB pixels, row by row.
#[derive(Debug)]
pub struct Picture {
    pub width: usize,
    pub height: usize,
    /// `3 * width * height` bytes.
    pub rgb: Vec<u8>,
}

/// How a cloud is drawn.
#[derive(Debug, Clone, Copy)]
pub struct Style {
    /// Width of the picture of one side, px.
    pub width: usize,
    /// Height of the picture, px.
    pub height: usize,
    /// Colour by camera instead of grey.
    pub by_camera: bool,
}

const BACKGROUND: [u8; 3] = [24, 26, 30];

/// Colours of cameras 0 to 7; more cameras repeat them.
const COLOURS: [[f32; 3]; 8] = [
    [0.90, 0.35, 0.30],
    [0.95, 0.60, 0.25],
    [0.85, 0.80, 0.30],
    [0.45, 0.75, 0.35],
    [0.30, 0.75, 0.70],
    [0.35, 0.55, 0.90],
    [0.60, 0.45, 0.85],
    [0.85, 0.45, 0.70],
];

/// What the picture shows: the middle of the cloud and its half height, world, m.
#[derive(Debug, Clone, Copy)]
struct Frame {
    middle: [f32; 3],
    half_height: f32,
}

impl Frame {
    /// Around the points between the 0.1 and 99.9 percentiles of each axis, so that a stray point does not
    /// shrink the body.
    fn around(cloud: &Cloud) -> Option<Self> {
        let range = |axis: usize| {
            let mut values: Vec<f32> =
                cloud.position_m.iter().map(|p| p[axis]).filter(|x| x.is_finite()).collect();
            values.sort_unstable_by(f32::total_cmp);
            let last = values.len().checked_sub(1)?;
            Some((values[last / 1000], values[last - last / 1000]))
        };
        let (x, y, z) = (range(0)?, range(1)?, range(2)?);
        let middle = [(x.0 + x.1) / 2.0, (y.0 + y.1) / 2.0, (z.0 + z.1) / 2.0];
        let wide = (x.1 - x.0).hypot(y.1 - y.0) * 0.5;
        Some(Self { middle, half_height: ((z.1 - z.0) / 2.0).max(wide * 0.8).max(0.01) * 1.06 })
    }
}

/// Draws `sides` views side by side, evenly around the cloud, the first from `azimuth_deg` (0: from +x, 90: from +y).
pub fn draw_sides(cloud: &Cloud, azimuth_deg: f64, sides: usize, style: Style) -> Picture {
    let (width, height) = (style.width * sides, style.height);
    let mut picture = Picture { width, height, rgb: BACKGROUND.repeat(width * height) };
    if let Some(frame) = Frame::around(cloud) {
        for side in 0..sides {
            let azimuth = azimuth_deg + 360.0 * side as f64 / sides as f64;
            draw_side(&mut picture, cloud, frame, azimuth, style, side * style.width);
        }
    }
    picture
}

fn draw_side(
    picture: &mut Picture,
    cloud: &Cloud,
    frame: Frame,
    azimuth_deg: f64,
    style: Style,
    left: usize,
) {
    let (sin, cos) = (azimuth_deg.to_radians() as f32).sin_cos();
    let scale = style.height as f32 / (2.0 * frame.half_height);
    // A splat covers about 2 mm, the spacing of the points.
    let reach = ((0.002 * scale / 2.0).ceil() as i64).max(1);
    let mut nearest = vec![f32::NEG_INFINITY; style.width * style.height];
    for (i, (p, n)) in cloud.position_m.iter().zip(&cloud.normal).enumerate() {
        let (x, y, z) = (p[0] - frame.middle[0], p[1] - frame.middle[1], p[2] - frame.middle[2]);
        let (right, towards) = (-x * sin + y * cos, x * cos + y * sin);
        let facing = n[0] * cos + n[1] * sin;
        let column = style.width as f32 / 2.0 + right * scale;
        let row = style.height as f32 / 2.0 - z * scale;
        if facing <= 0.0 || !column.is_finite() || !row.is_finite() {
            continue;
        }
        let shade = (0.25 + 0.6 * facing + 0.15 * n[2]).clamp(0.0, 1.0);
        let base = match cloud.camera.get(i) {
            Some(&camera) if style.by_camera => COLOURS[usize::from(camera) % COLOURS.len()],
            _ => [0.92, 0.90, 0.87],
        };
        for v in row as i64 - reach..row as i64 + reach {
            for u in column as i64 - reach..column as i64 + reach {
                if u < 0 || v < 0 || u >= style.width as i64 || v >= style.height as i64 {
                    continue;
                }
                let (u, v) = (u as usize, v as usize);
                let depth = &mut nearest[v * style.width + u];
                if towards > *depth {
                    *depth = towards;
                    let at = 3 * (v * picture.width + left + u);
                    for (out, base) in picture.rgb[at..at + 3].iter_mut().zip(base) {
                        *out = (255.0 * base * shade) as u8;
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{Style, draw_sides};
    use crate::data::Cloud;

    fn sphere() -> Cloud {
        let mut cloud = Cloud::default();
        for i in 0..20_000u16 {
            let z = 1.0 - 2.0 * (f32::from(i) + 0.5) / 20_000.0;
            let angle = f32::from(i) * 2.399_963;
            let r = (1.0 - z * z).sqrt();
            let n = [r * angle.cos(), r * angle.sin(), z];
            cloud.position_m.push(n.map(|x| 0.5 * x));
            cloud.normal.push(n);
            cloud.intensity.push(0.5);
            cloud.pixel.push([0, 0]);
        }
        cloud
    }

    #[test]
    fn a_sphere_is_a_disc_from_every_side() {
        let style = Style { width: 100, height: 100, by_camera: false };
        let lit = |picture: &super::Picture| {
            picture.rgb.chunks(3).filter(|x| x[0] != super::BACKGROUND[0]).count() as f64
        };
        let one = lit(&draw_sides(&sphere(), 37.0, 1, style));
        // The frame holds the cloud's diagonal.
        let radius = 50.0 * 0.5 / (0.5 * 2f64.sqrt() * 0.8 * 1.06);
        assert!((one / (std::f64::consts::PI * radius * radius) - 1.0).abs() < 0.1, "{one}");
        let four = draw_sides(&sphere(), 0.0, 4, style);
        assert_eq!((four.width, four.rgb.len()), (400, 120_000));
        assert!((lit(&four) / (4.0 * one) - 1.0).abs() < 0.05);
    }

    #[test]
    fn an_empty_cloud_or_nan_is_a_blank_picture() {
        let style = Style { width: 10, height: 10, by_camera: true };
        let mut cloud = Cloud::default();
        assert_eq!(draw_sides(&cloud, 0.0, 1, style).rgb.len(), 300);
        cloud.position_m.push([f32::NAN; 3]);
        cloud.normal.push([f32::NAN; 3]);
        assert_eq!(draw_sides(&cloud, 0.0, 1, style).rgb, super::BACKGROUND.repeat(100));
    }
}
