// SPDX-License-Identifier: MIT OR Apache-2.0
//! What is painted on the subject: stripes of a shirt, dark lines over a whole body, hairs and moles. Default: nothing.
//!
//! A pattern lies in the world and not on the body: within an exposure a body moves by less than a line is wide.

use crate::random::{hash, share};
use fourdbody::config::Section;
use nalgebra::{Point3, Vector3};
use serde::Serialize;

/// A pattern, as factors of the subject's albedo.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Paint {
    /// The subject's own albedo alone.
    Nothing,
    /// Level stripes, as wide as the gaps between them.
    Stripes {
        /// From a stripe to the next, m.
        period_m: f64,
        /// Albedo of a stripe, relative.
        dark: f64,
        /// Between which heights they are, m.
        from_to_m: [f64; 2],
    },
    /// Lines and blots without a direction, about 4 mm wide.
    Lines {
        /// Their albedo as a share of the surface's.
        dark: f64,
        seed: u64,
    },
    /// Skin and cloth seen closely: hairs of a millimetre's width, moles, a weave of 3 mm.
    Skin { seed: u64 },
}

/// The paint's name in a scenario.
#[derive(Clone, Copy)]
enum Kind {
    Stripes,
    Lines,
    Skin,
}

impl Paint {
    /// Reads the scenario's table `[paint]`.
    pub fn read(section: Section<'_>, seed: u64) -> Self {
        let kinds = [("stripes", Kind::Stripes), ("lines", Kind::Lines), ("skin", Kind::Skin)];
        let dark = |default| section.number_or("dark", 0.0..=1.0, default);
        let paint = match section.choice("kind", &kinds) {
            Kind::Stripes => Self::Stripes {
                period_m: section.number_or("period_mm", 1.0..=1000.0, 30.0) / 1000.0,
                dark: dark(0.3),
                from_to_m: section.vector_or("from_to_m", [0.85, 1.5]),
            },
            Kind::Lines => Self::Lines { dark: dark(0.15), seed },
            Kind::Skin => Self::Skin { seed },
        };
        section.finish();
        paint
    }

    /// Albedo relative to the subject's own at a point of its surface.
    pub fn factor(&self, point: &Point3<f64>) -> f64 {
        match *self {
            Self::Nothing => 1.0,
            Self::Stripes { period_m, dark, from_to_m: [from, to] } => {
                let on = (from..to).contains(&point.z) && (point.z / period_m).rem_euclid(1.0) < 0.5;
                if on { dark } else { 1.0 }
            }
            Self::Lines { dark, seed } => {
                let field = noise(seed, point.coords / 0.07) + 0.3 * noise(seed ^ 1, point.coords / 0.025);
                if (field - 0.65).abs() < 0.03 { dark } else { 1.0 }
            }
            Self::Skin { seed } => {
                let at = point.coords;
                let hair = noise(seed, at.component_div(&Vector3::new(0.002, 0.002, 0.012)));
                let mole = noise(seed ^ 1, at / 0.006) + noise(seed ^ 2, at / 0.05);
                let weave = 0.06 * (noise(seed ^ 3, at / 0.0015) - 0.5);
                let dark = if mole > 1.62 {
                    0.5
                } else if hair > 0.85 {
                    0.75
                } else {
                    1.0
                };
                dark * (1.0 + weave)
            }
        }
    }
}

/// Smooth noise from 0 to 1 whose grid has a side of 1.
fn noise(seed: u64, at: Vector3<f64>) -> f64 {
    let corner = at.map(f64::floor);
    let inside = (at - corner).map(|x| x * x * (3.0 - 2.0 * x));
    let mut sum = 0.0;
    for k in 0..8u32 {
        let side = [k & 1, k >> 1 & 1, k >> 2];
        let mut weight = 1.0;
        let mut words = [0u64; 3];
        for axis in 0..3 {
            let far = f64::from(side[axis]);
            weight *= if side[axis] == 1 { inside[axis] } else { 1.0 - inside[axis] };
            words[axis] = (corner[axis] + far) as i64 as u64;
        }
        sum += weight * share(hash(seed, &words));
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::{Paint, noise};
    use crate::random::Stream;
    use nalgebra::{Point3, Vector3};

    #[test]
    fn each_paint_darkens_its_share_of_a_surface() {
        let mut random = Stream::new(5, "paint");
        let points: Vec<Point3<f64>> = (0..40_000)
            .map(|_| Point3::new(random.uniform(), random.uniform(), 0.9 + 0.5 * random.uniform()))
            .collect();
        let dark = |paint: Paint| {
            points.iter().filter(|point| paint.factor(point) < 0.9).count() as f64 / points.len() as f64
        };
        assert_eq!(dark(Paint::Nothing), 0.0);
        let stripes = Paint::Stripes { period_m: 0.013, dark: 0.3, from_to_m: [0.85, 1.5] };
        assert!((dark(stripes) - 0.5).abs() < 0.01, "{}", dark(stripes));
        assert_eq!(stripes.factor(&Point3::new(0.0, 0.0, 0.2)), 1.0, "below the shirt");
        let lines = dark(Paint::Lines { dark: 0.15, seed: 3 });
        assert!((0.05..0.25).contains(&lines), "{lines}");
        let skin = dark(Paint::Skin { seed: 3 });
        assert!((0.01..0.15).contains(&skin), "{skin}");
    }

    #[test]
    fn noise_is_smooth_across_its_grid() {
        for k in 0..1000 {
            let at = Vector3::new(0.013, 0.007, 0.011) * f64::from(k) - Vector3::new(3.0, 2.0, 5.0);
            let step = noise(9, at + Vector3::new(1e-4, 1e-4, 1e-4)) - noise(9, at);
            assert!(step.abs() < 1e-3, "{at}: {step}");
        }
    }
}
