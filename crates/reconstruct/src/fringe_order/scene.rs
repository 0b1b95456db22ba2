// SPDX-License-Identifier: MIT OR Apache-2.0
//! A view as all others see it: its patches, and where the others see its places.

use super::patches::{Patch, Patches};
use super::projection::Projection;
use super::unwrapped_frame::{UnwrappedFrame, View};
use crate::kernels::pixel_runs::each_not_0;
use crate::kernels::region_of_interest::Roi;
use crate::triangulate::camera_projector::CameraProjector;
use nalgebra::{Point3, Vector3};
use std::collections::BTreeMap;
use std::f32::consts::TAU;

/// A view as all others see it.
#[derive(Debug)]
pub struct Scene<'a> {
    /// The number of its camera's head.
    pub head: usize,
    /// Sign of its projector's phase's change with the distance from it.
    pub towards: f32,
    /// Where its planes lie in the frame.
    pub roi: Roi,
    pub patches: Patches,
    /// Where the other cameras see its places.
    pub projection: Projection<'a>,
    /// The orders by its marker: patch, whole turns that make its phases absolute, number of marker pixels. A camera
    /// alone whose volume is shallow has such votes for all patches.
    pub votes: Vec<(u32, i32, u32)>,
    /// Mean light of its patches, DN.
    pub light_dn: f32,
    /// Whether each patch has half the light that the light itself falls on in the mean: differences of darker ones tell of
    /// noise, and of a floor, rather than of devices.
    pub is_bright: Vec<bool>,
}

impl<'a> Scene<'a> {
    /// View `number` of all, with its patches.
    pub fn new(views: &'a [View<'_>], number: usize, patches: Patches) -> Self {
        let view = &views[number];
        let prepared = &*view.prepared;
        let pair = view.triangulator.pair();
        let lights: Vec<f32> =
            patches.all.iter().map(|patch| prepared.light_dn(patch.pixel as usize)).collect();
        let mut votes = votes(&patches, prepared, pair);
        if views.len() == 1 && pair.is_shallow {
            votes.extend(votes_of_the_volume(&patches, prepared.roi, pair));
        }
        let (light, squares) = lights.iter().fold((0.0, 0.0), |sum, x| (sum.0 + x, sum.1 + x * x));
        Self {
            head: view.head,
            towards: towards(pair),
            roi: prepared.roi,
            projection: Projection::new(
                &prepared.table,
                number,
                views.iter().map(|x| (x.triangulator.pair(), x.prepared.roi, x.head)),
            ),
            votes,
            light_dn: light / patches.all.len().max(1) as f32,
            is_bright: lights.iter().map(|x| x * light >= 0.5 * squares).collect(),
            patches,
        }
    }

    /// The pixel of the frame that stands for a patch.
    pub fn pixel(&self, patch: &Patch) -> (usize, usize) {
        pixel_of(patch, self.roi)
    }
}

fn pixel_of(patch: &Patch, roi: Roi) -> (usize, usize) {
    let pixel = patch.pixel as usize;
    (roi.u + pixel % roi.width, roi.v + pixel / roi.width)
}

/// Sign of the projected phase's change with the distance from the camera.
fn towards(pair: &CameraProjector) -> f32 {
    let middle = Point3::from((Vector3::from(pair.volume_min_m) + Vector3::from(pair.volume_max_m)) / 2.0);
    let from = pair.camera.centre();
    let cast = |distance: f64| {
        let at = middle + (middle - from).normalize() * distance;
        pair.projector.project(&at).map_or(0.0, |[column, _]| pair.pattern.phase(column))
    };
    (cast(0.01) - cast(-0.01)).signum() as f32
}

/// The orders that marker pixels give their patches: patch, order, pixels.
fn votes(patches: &Patches, prepared: &UnwrappedFrame, pair: &CameraProjector) -> Vec<(u32, i32, u32)> {
    let mut votes: BTreeMap<(u32, i32), u32> = BTreeMap::new();
    for v in 0..prepared.marker.height() {
        for run in prepared.runs().row(v) {
            let (marker, phase) =
                (&prepared.marker.row(v)[run.columns()], &prepared.absolute.row(v)[run.columns()]);
            each_not_0(marker, |i| {
                let Some(patch) = patches.lookup.node(run.start() + i, v) else { return };
                // On the marker's core the wrapped phase is small: the nearest whole turn is the patch's own.
                let order = pair.markers[usize::from(marker[i] - 1)] as i32 - (phase[i] / TAU).round() as i32;
                *votes.entry((patch, order)).or_default() += 1;
            });
        }
    }
    votes.into_iter().map(|((patch, order), n)| (patch, order, n)).collect()
}

/// The orders by a shallow volume: as sure as those of many marker pixels.
fn votes_of_the_volume(
    patches: &Patches,
    roi: Roi,
    pair: &CameraProjector,
) -> impl Iterator<Item = (u32, i32, u32)> {
    const PIXELS: u32 = 10;
    patches.all.iter().zip(0..).filter_map(move |(patch, number)| {
        let (u, v) = pixel_of(patch, roi);
        let [least, largest] = pair.fringes_within(u, v)?;
        let middle = (least + largest) / 2.0;
        Some((number, (middle - f64::from(patch.phase / TAU)).round() as i32, PIXELS))
    })
}
