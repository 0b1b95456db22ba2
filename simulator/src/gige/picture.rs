// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a camera makes of the light on its sensor before it sends it: crop, binning, mirror, gain, gamma, test pattern.

use super::gvsp::Layout;

/// How the sensor's pixels become the image's. By default they are the image's.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Picture {
    /// The first column and row of the region.
    pub offset: (u32, u32),
    /// So many columns and rows become one.
    pub step: (u32, u32),
    /// Whether they are summed, else averaged; `None`: all but the first are left out.
    pub summed: Option<bool>,
    /// Columns and rows in reverse.
    pub mirror: (bool, bool),
    /// Grey values are multiplied by this.
    pub level: f32,
    /// And raised to this power.
    pub gamma: f32,
    /// The same, looked up in a table that a client has loaded.
    pub lut: bool,
    /// A ramp stands in for the picture.
    pub pattern: bool,
    /// Exposure or gain follow the scene.
    pub automatic: bool,
    /// Every frame has settings of its own.
    pub sequenced: bool,
}

impl Default for Picture {
    fn default() -> Self {
        Self {
            offset: (0, 0),
            step: (1, 1),
            summed: None,
            mirror: (false, false),
            level: 1.0,
            gamma: 1.0,
            lut: false,
            pattern: false,
            automatic: false,
            sequenced: false,
        }
    }
}

impl Picture {
    /// Whether the image is the sensor's top-left pixels as they are.
    pub fn is_plain(&self) -> bool {
        *self == Self::default()
    }

    /// The picture of frame number `number` of an acquisition, exposed `exposure` times as long as its light is meant
    /// for.
    #[must_use]
    pub fn of_frame(self, number: u64, exposure: f64) -> Self {
        let mut level = f64::from(self.level) * exposure;
        if self.automatic {
            // It hunts: never settled, and never right.
            level *= 1.6 + 0.5 * (number as f64 * 0.9).sin();
        }
        if self.sequenced && number % 2 == 1 {
            level *= 0.5;
        }
        Self { level: level as f32, automatic: false, sequenced: false, ..self }
    }

    /// Grey values by grey values of the sensor.
    fn curve(&self) -> [u8; 256] {
        std::array::from_fn(|grey| {
            let light = (grey as f32 / 255.0 * self.level).min(1.0);
            let light = if self.gamma == 1.0 { light } else { light.powf(self.gamma) };
            // What was loaded last: more contrast.
            let light = if self.lut { light * light * (3.0 - 2.0 * light) } else { light };
            (light * 255.0).round() as u8
        })
    }

    /// The image: `layout`'s columns and rows of Mono8.
    pub fn image(&self, pixels: &[u8], (columns, rows): (usize, usize), layout: &Layout) -> Vec<u8> {
        let (width, height) = (layout.width as usize, layout.height as usize);
        let curve = self.curve();
        let mut image = Vec::with_capacity(width * height);
        let (step_x, step_y) = (self.step.0.max(1) as usize, self.step.1.max(1) as usize);
        let taken = if self.summed.is_some() { (step_x, step_y) } else { (1, 1) };
        let divisor = if self.summed == Some(false) { (taken.0 * taken.1) as u32 } else { 1 };
        for row in 0..height {
            for column in 0..width {
                if self.pattern {
                    image.push(((row + column) & 0xff) as u8);
                    continue;
                }
                let across = if self.mirror.0 { width - 1 - column } else { column };
                let down = if self.mirror.1 { height - 1 - row } else { row };
                let x = (across + self.offset.0 as usize) * step_x;
                let y = (down + self.offset.1 as usize) * step_y;
                let mut sum = 0u32;
                for dy in 0..taken.1 {
                    for dx in 0..taken.0 {
                        let at = (y + dy).min(rows.saturating_sub(1)) * columns
                            + (x + dx).min(columns.saturating_sub(1));
                        sum += u32::from(pixels.get(at).copied().unwrap_or(0));
                    }
                }
                image.push(curve[(sum / divisor).min(255) as usize]);
            }
        }
        image
    }
}
