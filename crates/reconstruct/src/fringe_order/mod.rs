// SPDX-License-Identifier: MIT OR Apache-2.0
//! Fringe orders of all views of one instant, by minimizing one energy (`docs/design/fringe-order.md`).
//!
//! ```text
//! patches         a view's phases in patches of 8 x 8 px: the nodes of a graph
//! links           where patches touch, and how surely they are one surface: its edges
//! lookup          what a view has in each cell, for the other cameras
//! projection      where the other cameras would see a place
//! observation     what they see there
//! evidence        what that costs each fringe order of a patch
//! drift           by how much two cameras differ where both surely see one surface
//! inference       the orders that cost least together, and by how much they lead
//! one_view        the same for a camera alone
//! unwrapped_frame what goes in, and what comes out
//! ```
//!
//! A patch's label is the fringe that it lies on. What the other cameras observe at the place, and the marker, give
//! each label a cost; a patch that does not continue its neighbour costs the weight of their link. A patch is refused
//! if its label leads any other by too little.

mod drift;
mod evidence;
mod inference;
mod links;
mod lookup;
mod observation;
mod one_view;
mod patches;
mod projection;
pub mod unwrapped_frame;

use super::kernels::pixel_runs::each_not_0;
use super::kernels::region_of_interest::Roi;
use super::kernels::simd;
use super::triangulate::camera_projector::CameraProjector;
use super::triangulate::triangulator::Triangulator;
use crate::base::image::Plane;
pub use drift::MostDifference;
use drift::{Differences, Turned};
use evidence::{BEYOND, NO_ORDER, OrderTable};
use inference::Field;
use nalgebra::{Point3, Vector3};
use patches::{CELL_PX, Patch, Patches, Surface};
use projection::{LANES, Projection};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::f32::consts::TAU;
use std::time::Instant;
use unwrapped_frame::UnwrappedFrame;

/// The default of `--margin`: a patch whose label leads any other by less is refused. Costs have no unit. For twice as
/// much see docs/validation.md, *Other poses and skins*.
pub const MARGIN: f32 = 1.0;

/// From this margin after the first pass on, a patch hides what lies behind it from the other cameras.
const CERTAIN: f32 = 1.0;

/// One camera's frame and its geometry: what [`solve`] takes of each camera.
#[derive(Debug)]
pub struct View<'a> {
    /// The camera's name, for messages to the user.
    pub id: &'a str,
    /// The geometry of the camera and its projector.
    pub triangulator: &'a Triangulator,
    /// Which head it belongs to: cameras of equal number see the same projector.
    pub head: usize,
    /// Its frame, whose orders are found or refused.
    pub prepared: &'a mut UnwrappedFrame,
}

/// How certain the fringe order of each pixel is.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Regions {
    /// Column and row of the image at which the cells begin.
    origin: (usize, usize),
    /// Cells in a row of the region of interest.
    columns: usize,
    /// Patches that have an order: cell, pixels within it, by how much the order leads any other. Cell by cell.
    patches: Vec<(u32, u64, f32)>,
}

impl Regions {
    /// The margin of the order at a pixel of the frame, such as a cloud's `pixel`; 0 where there is none.
    pub fn margin_at(&self, [u, v]: [u16; 2]) -> f32 {
        let place = usize::from(u).checked_sub(self.origin.0).zip(usize::from(v).checked_sub(self.origin.1));
        let Some((u, v)) = place.filter(|(u, _)| u / CELL_PX < self.columns) else { return 0.0 };
        let cell = (v / CELL_PX * self.columns + u / CELL_PX) as u32;
        let bit = 1u64 << (v % CELL_PX * CELL_PX + u % CELL_PX);
        let first = self.patches.partition_point(|patch| patch.0 < cell);
        let mut patches = self.patches[first..].iter().take_while(|patch| patch.0 == cell);
        patches.find(|patch| patch.1 & bit != 0).map_or(0.0, |patch| patch.2)
    }
}

/// A frame's patches and their fringe orders. Patches are cut while their phases are in the cache; their orders are
/// added when the phases are read again.
#[derive(Debug, Default)]
pub struct Orders {
    patches: Patches,
    /// What to add to the phases of each patch, rad; NaN where there is no order, and for all patches before [`solve`].
    shift: Vec<f32>,
}

impl Orders {
    /// Cuts a frame's wrapped phases into patches: they become those unwrapped within each cell.
    pub(super) fn cut(
        phase: &mut Plane<f32>,
        period: &Plane<f32>,
        object: &super::kernels::pixel_runs::Runs,
        pair: &CameraProjector,
    ) -> Self {
        let patches = Patches::cut(&mut Surface { phase, period, object, sign: pair.sign });
        let shift = vec![f32::NAN; patches.all.len()];
        Self { patches, shift }
    }

    /// Adds the orders to the phases.
    pub(super) fn apply(&self, phase: &mut Plane<f32>) {
        simd::dispatch(
            #[inline(always)]
            || self.patches.shift(phase, &self.shift),
        );
    }
}

/// A view as all others see it.
#[derive(Debug)]
struct Scene<'a> {
    /// The number of its camera's head.
    head: usize,
    /// Sign of its projector's phase's change with the distance from it.
    towards: f32,
    /// Where its planes lie in the frame.
    roi: Roi,
    patches: Patches,
    /// Where the other cameras see its places.
    projection: Projection<'a>,
    /// The orders by its marker: patch, whole turns that make its phases absolute, number of marker pixels.
    votes: Vec<(u32, i32, u32)>,
    /// Mean light of its patches, DN.
    light_dn: f32,
}

impl Scene<'_> {
    /// The pixel of the frame that stands for a patch.
    fn pixel(&self, patch: &Patch) -> (usize, usize) {
        let pixel = patch.pixel as usize;
        (self.roi.u + pixel % self.roi.width, self.roi.v + pixel / self.roi.width)
    }
}

/// Gives every patch of every view its fringe order, or refuses it: [`Pipeline::finish`] adds these to the phases, of
/// which only what is certain is left: orders that lead any other by at least `margin`. All views must show the same
/// instant; cameras that differ by more than `most` contradict the calibration. The result does not depend on the
/// number of threads.
///
/// # Errors
///
/// The cameras contradict each other so much that the calibration cannot be believed: then there are no orders.
///
/// [`Pipeline::finish`]: super::pipeline::Pipeline::finish
pub fn solve(views: &mut [View<'_>], margin: f32, most: MostDifference) -> Result<(), String> {
    let start = Instant::now();
    let all: Vec<Patches> =
        views.iter_mut().map(|view| std::mem::take(&mut view.prepared.orders.patches)).collect();
    let (results, verdict) = {
        let scenes = all.into_par_iter().enumerate();
        let scenes: Vec<Scene<'_>> = scenes.map(|(view, patches)| scene(views, view, patches)).collect();
        let (found, turned) = label_all(&scenes, most);
        let verdict = turned.map_or(Ok(()), |turned| Err(turned.message(views, most)));
        let results: Vec<Found> =
            scenes.into_iter().zip(found).map(|(scene, x)| (scene.patches, x.0, x.1)).collect();
        (results, verdict)
    };
    let margin = if verdict.is_ok() { margin } else { f32::INFINITY };
    views.par_iter_mut().zip(results).for_each(|(view, found)| keep(view.prepared, found, margin));
    let share = start.elapsed() / views.len().max(1) as u32;
    views.iter_mut().for_each(|view| view.prepared.add_time("order", share));
    verdict
}

/// The whole turns that make the phases of each patch of a view absolute, and by how much these lead any other.
type Turns = (Vec<i32>, Vec<f32>);

/// The same with the patches.
type Found = (Patches, Vec<i32>, Vec<f32>);

/// The turns of each view, and the camera that differs most, if the cameras contradict each other.
fn label_all(scenes: &[Scene<'_>], most: MostDifference) -> (Vec<Turns>, Option<Turned>) {
    let mut fields: Vec<Field<'_>> =
        (0..scenes.len()).into_par_iter().map(|i| Field::new(scenes, i)).collect();
    let mut turned = None;
    if let [field] = &mut fields[..] {
        one_view::infer(field);
    } else {
        turned = infer_together(&mut fields, scenes, most);
    }
    let of = |field: Field<'_>| {
        ((0..field.graph.label.len()).map(|i| field.turns(i)).collect(), field.graph.margin)
    };
    (fields.into_iter().map(of).collect(), turned)
}

/// The two passes. The first gives an estimate of what hides what, and of the differences between cameras; the second
/// uses both.
fn infer_together(fields: &mut [Field<'_>], scenes: &[Scene<'_>], most: MostDifference) -> Option<Turned> {
    let patches: usize = scenes.iter().map(|scene| scene.patches.all.len()).sum();
    let none = vec![vec![Differences::default(); scenes.len().div_ceil(LANES)]; scenes.len()];
    let mut known = OrderTable { turns: vec![NO_ORDER; patches + BEYOND], differences: none };
    for first in [true, false] {
        fields.par_iter_mut().for_each(|field| {
            evidence::collect(field, scenes, &known, first);
            field.graph.infer();
        });
        if first {
            let turns = |field: &Field<'_>, i: usize| {
                if field.graph.margin[i] >= CERTAIN { field.turns(i) } else { NO_ORDER }
            };
            let all =
                fields.iter().flat_map(|field| (0..field.graph.label.len()).map(move |i| turns(field, i)));
            known.turns = all.chain([NO_ORDER; BEYOND]).collect();
            known.differences = fields.par_iter().map(|field| drift::of(field, scenes, &known)).collect();
        }
    }
    Turned::most(&known.differences, most)
}

fn scene<'a>(views: &'a [View<'_>], number: usize, patches: Patches) -> Scene<'a> {
    let view = &views[number];
    let prepared = &*view.prepared;
    let pair = view.triangulator.pair();
    let light: f32 = patches.all.iter().map(|patch| prepared.light_dn(patch.pixel as usize)).sum();
    Scene {
        head: view.head,
        towards: towards(pair),
        roi: prepared.roi,
        projection: Projection::new(
            &prepared.table,
            number,
            views.iter().map(|x| (x.triangulator.pair(), x.prepared.roi)),
        ),
        votes: votes(&patches, prepared, pair),
        light_dn: light / patches.all.len().max(1) as f32,
        patches,
    }
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

/// Keeps the orders of a view's patches.
fn keep(prepared: &mut UnwrappedFrame, (patches, turns, margin): Found, least: f32) {
    let mut regions =
        Regions { origin: (prepared.roi.u, prepared.roi.v), columns: patches.columns, patches: Vec::new() };
    let (mut shift, mut known) = (vec![f32::NAN; turns.len()], 0);
    for (i, patch) in patches.all.iter().enumerate().filter(|x| margin[x.0] >= least) {
        shift[i] = TAU * turns[i] as f32;
        known += patch.size as usize;
        regions.patches.push((patch.cell, patch.mask, margin[i]));
    }
    prepared.counts.refused = prepared.counts.phase.saturating_sub(known);
    prepared.regions = regions;
    prepared.orders = Orders { patches, shift };
}
