// SPDX-License-Identifier: MIT OR Apache-2.0
//! Predicted standard uncertainty against the actual error, by classes.
//!
//! The error is that along the line of sight, in the plane of which the prediction is made: found less true depth at
//! the point's pixel, along the ray. In each class the ratio is 1.4826 times the median of error over prediction: 1
//! where the prediction is right, larger where it promises too much. Points of wrong fringe order are left out: no
//! standard uncertainty describes them.

use super::light::Light;
use super::truth::{Reference, Truth};
use crate::data::Cloud;
use serde::Serialize;

/// Upper bounds of the classes of modulation, DN, by the photograph and the truth ([`Light`]).
const MODULATION_DN: [f32; 8] = [1.5, 3.0, 4.0, 6.0, 10.0, 20.0, 40.0, f32::INFINITY];

/// Upper bounds of the classes of light (mean over a fringe), DN.
const LIGHT_DN: [f32; 7] = [8.0, 16.0, 32.0, 48.0, 64.0, 96.0, 256.0];

/// Upper bounds of the classes of predicted uncertainty, mm.
const SIGMA_MM: [f32; 8] = [0.03, 0.045, 0.06, 0.09, 0.15, 0.3, 0.6, f32::INFINITY];

/// Errors and predictions of points, which add up over clouds.
#[derive(Debug, Clone, Default)]
pub struct Points {
    points: Vec<Point>,
}

#[derive(Debug, Clone, Copy)]
struct Point {
    /// NaN where it is not known.
    modulation_dn: f32,
    light_dn: f32,
    predicted_mm: f32,
    error_mm: f32,
}

/// The points of one class: what was predicted, and what the error was.
#[derive(Debug, Clone, Serialize)]
pub struct Class {
    /// `modulation DN`, `light DN`, `predicted mm` or `all`.
    pub by: &'static str,
    pub from: f32,
    pub to: f32,
    pub points: usize,
    /// Median of the prediction, mm.
    pub predicted_mm: f32,
    /// 1.4826 times the median of the error's size, mm.
    pub robust_mm: f32,
    /// 1.4826 times the median of the error's size over its prediction.
    pub ratio: f32,
    /// Share of the errors within twice the prediction; 0.954 where they are normally distributed.
    pub within_two: f32,
}

impl Points {
    /// Adds the points of a cloud that carry an uncertainty; with the fringes of its photograph, by their modulation,
    /// too.
    pub fn add(&mut self, cloud: &Cloud, truth: &Truth, reference: Reference<'_>, light: Option<&Light>) {
        for (i, sigma) in cloud.sigma_m.iter().enumerate() {
            let Some(error) = truth.error_along_sight(cloud, i, reference) else { continue };
            let modulation =
                light.zip(truth.place(cloud.pixel[i])).and_then(|(light, place)| light.at(place));
            self.points.push(Point {
                modulation_dn: modulation.map_or(f32::NAN, |(modulation, _)| modulation),
                light_dn: cloud.intensity[i] * 255.0,
                predicted_mm: sigma * 1e3,
                error_mm: (error * 1e3) as f32,
            });
        }
    }

    /// Whether no point with an uncertainty was added.
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// The table: classes of modulation, of light, of prediction, then all.
    pub fn classes(&self) -> Vec<Class> {
        let bounds = |by, bounds: &[f32], of: fn(&Point) -> f32| {
            let lower = std::iter::once(0.0).chain(bounds.iter().copied());
            let classes = lower.zip(bounds.iter().copied());
            classes
                .map(|(from, to)| {
                    let chosen = self.points.iter().filter(|x| (from..to).contains(&of(x)));
                    class(by, from, to, chosen)
                })
                .filter(|class| class.points > 0)
                .collect::<Vec<_>>()
        };
        let mut table = bounds("modulation DN", &MODULATION_DN, |x| x.modulation_dn);
        table.extend(bounds("light DN", &LIGHT_DN, |x| x.light_dn));
        table.extend(bounds("predicted mm", &SIGMA_MM, |x| x.predicted_mm));
        table.push(class("all", 0.0, f32::INFINITY, self.points.iter()));
        table
    }
}

fn class<'a>(by: &'static str, from: f32, to: f32, points: impl Iterator<Item = &'a Point>) -> Class {
    let points: Vec<_> = points.collect();
    let median = |value: fn(&Point) -> f32| {
        let mut values: Vec<f32> = points.iter().map(|x| value(x)).collect();
        values.sort_unstable_by(f32::total_cmp);
        values.get(values.len() / 2).copied().unwrap_or(f32::NAN)
    };
    let within = points.iter().filter(|x| x.error_mm.abs() <= 2.0 * x.predicted_mm).count();
    Class {
        by,
        from,
        to,
        points: points.len(),
        predicted_mm: median(|x| x.predicted_mm),
        robust_mm: 1.4826 * median(|x| x.error_mm.abs()),
        ratio: 1.4826 * median(|x| x.error_mm.abs() / x.predicted_mm),
        within_two: within as f32 / points.len().max(1) as f32,
    }
}
