// SPDX-License-Identifier: MIT OR Apache-2.0
//! One camera with the projector of its head: what the phase pipeline must know of the geometry.

use crate::data::{CalibratedCamera, CalibratedHead, Calibration, PanelRows};
use crate::geometry::pattern::{Marker, Pattern};
use crate::geometry::{Device, Fringes, Ray};
use nalgebra::{Point3, Vector3};
use std::f64::consts::TAU;

/// A camera and its projector, with the figures that the stages derive from them. [`CameraProjector::new`] makes it
/// from a calibration; it is not changed afterwards.
#[derive(Debug, Clone)]
pub struct CameraProjector {
    /// The camera, with lens and pose in the world.
    pub camera: Device,
    /// The projector of its head, as an inverse camera.
    pub projector: Device,
    /// The pattern that the projector shows.
    pub pattern: Pattern,
    /// How the calibrated rows of the projector become rows of its panel, where that was calibrated. Fringes alone
    /// determine its columns only.
    pub rows: Option<PanelRows>,
    /// Indices of the markers on the panel, rising.
    pub markers: Vec<u32>,
    /// +1 where the absolute phase grows with the image column, -1 where it falls.
    pub sign: f32,
    /// Fringe period in the image of a plane that faces the camera in the middle of the volume, px.
    pub period_px: f32,
    /// Period of the marker's modulation along the image column at the same place, px.
    pub marker_period_px: f32,
    /// Amplitude of the marker's modulation relative to the light around it, before any blur.
    pub marker_contrast: f32,
    /// Lower corner of the volume that points may lie in, world, m.
    pub volume_min_m: [f64; 3],
    /// Upper corner of that volume, world, m.
    pub volume_max_m: [f64; 3],
    /// Whether there is no marker, and the volume is so shallow that it alone tells fringes apart.
    pub is_shallow: bool,
}

/// Lines of sight are cut off nearer to the camera than this, m. [`super::ray_table`] tabulates from 0.2 m on.
const NEAREST_M: f64 = 0.05;

/// Surfaces are sought this far outside of the volume, m. No points are made of them there: but a floor on the border
/// that could not be where it is would be taken for something within.
const VOLUME_MARGIN_M: f64 = 0.10;

/// The most fringes that a volume is deep which tells fringes apart by itself. What lies in front of it or behind it by
/// less than the rest of a fringe falls out, and is not taken for something within.
const SHALLOW: f64 = 0.8;
/// Pixels between the rays whose depth is measured for that.
const SHALLOW_STEP_PX: usize = 32;

impl CameraProjector {
    /// Derives the pair's figures; an error when the pattern is not visible, or runs along the image columns.
    pub fn new(
        head: &CalibratedHead,
        camera: &CalibratedCamera,
        calibration: &Calibration,
    ) -> Result<Self, String> {
        let (min, max) = (calibration.volume_min_m, calibration.volume_max_m);
        let middle = Point3::from((Vector3::from(min) + Vector3::from(max)) / 2.0);
        let pattern = calibration.pattern.clone();
        let fringes = Fringes::seen_by(&camera.device, &head.projector, &pattern, &middle)
            .map_err(|unusable| format!("camera {}: {unusable}", camera.id))?;
        let marker_contrast = match pattern.marker {
            // Nothing is as strong as what is not there.
            _ if !pattern.has_marker() => f64::INFINITY,
            // Mean 1 - depth / 2, amplitude depth / 2.
            Marker::Darkened { depth } => depth / 2.0 / (1.0 - depth / 2.0),
            Marker::ZeroMean { amplitude } => amplitude,
        };
        let mut pair = Self {
            camera: camera.device.clone(),
            projector: head.projector.clone(),
            rows: head.rows,
            sign: fringes.sign as f32,
            period_px: fringes.period_px as f32,
            marker_period_px: fringes.marker_period_px as f32,
            marker_contrast: marker_contrast as f32,
            markers: pattern.markers(head.projector.width),
            pattern,
            volume_min_m: min,
            volume_max_m: max,
            is_shallow: false,
        };
        pair.is_shallow = !pair.pattern.has_marker() && pair.tells_fringes_apart();
        Ok(pair)
    }

    /// Lower and upper corner of where surfaces are sought, world, m: the volume, and a hand's breadth around it.
    pub fn sought_m(&self) -> [[f64; 3]; 2] {
        [self.volume_min_m.map(|x| x - VOLUME_MARGIN_M), self.volume_max_m.map(|x| x + VOLUME_MARGIN_M)]
    }

    /// The ray of pixel (u, v), and the distances, m, between which surfaces are [sought](Self::sought_m); `None` where
    /// it misses that.
    pub fn distances_sought(&self, u: usize, v: usize) -> Option<(Ray, [f64; 2])> {
        self.distances(u, v, self.sought_m())
    }

    /// The ray of pixel (u, v), and the distances, m, between which it lies in a box.
    fn distances(&self, u: usize, v: usize, [min, max]: [[f64; 3]; 2]) -> Option<(Ray, [f64; 2])> {
        let ray = self.camera.ray(u as f64, v as f64)?;
        let (from, to) = (ray.at(0.0), ray.at(1.0));
        let (mut near, mut far) = (NEAREST_M, f64::INFINITY);
        for i in 0..3 {
            let ends = [min[i], max[i]].map(|x| (x - from[i]) / (to[i] - from[i]));
            (near, far) = (near.max(ends[0].min(ends[1])), far.min(ends[0].max(ends[1])));
        }
        (near <= far).then_some((ray, [near, far]))
    }

    /// Least and largest projector column that the ray of pixel (u, v) meets where surfaces are [sought](Self::sought_m),
    /// px; `None` where it misses that or the projector does not see what it meets.
    pub fn columns_sought(&self, u: usize, v: usize) -> Option<[f64; 2]> {
        let (ray, distances) = self.distances_sought(u, v)?;
        let [near, far] = distances.map(|x| self.projector.project(&ray.at(x)).map(|[column, _]| column));
        let (near, far) = (near?, far?);
        Some([near.min(far), near.max(far)])
    }

    /// Least and largest absolute phase, in fringes, on the part of the ray of pixel (u, v) that lies in the volume; `None`
    /// as for [`Self::columns_sought`].
    pub fn fringes_within(&self, u: usize, v: usize) -> Option<[f64; 2]> {
        let (ray, distances) = self.distances(u, v, [self.volume_min_m, self.volume_max_m])?;
        let [near, far] = distances.map(|x| self.projector.project(&ray.at(x)).map(|[column, _]| column));
        let [near, far] = [near?, far?].map(|column| self.pattern.phase(column) / TAU);
        Some([near.min(far), near.max(far)])
    }

    /// Whether the volume is less than [`SHALLOW`] deep, as every pixel sees it.
    fn tells_fringes_apart(&self) -> bool {
        let nodes = |side: usize| (0..side).step_by(SHALLOW_STEP_PX);
        let rays = nodes(self.camera.width).flat_map(|u| nodes(self.camera.height).map(move |v| (u, v)));
        let mut depths =
            rays.filter_map(|(u, v)| self.fringes_within(u, v)).map(|[least, most]| most - least).peekable();
        depths.peek().is_some() && depths.all(|depth| depth < SHALLOW)
    }

    /// Whether a world point lies in the volume.
    pub fn in_volume(&self, point: &Point3<f64>) -> bool {
        (0..3).all(|i| (self.volume_min_m[i]..=self.volume_max_m[i]).contains(&point[i]))
    }
}
