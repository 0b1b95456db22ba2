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
//! scene           a view with its patches, as the other cameras see it
//! orders          the fringe orders that come out, and how certain they are
//! unwrapped_frame a frame before and after
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
mod orders;
mod patches;
mod projection;
mod scene;
pub mod unwrapped_frame;

pub use drift::MostDifference;
use drift::{Differences, Turned};
use evidence::{BEYOND, NO_ORDER, OrderTable};
use inference::Field;
pub(crate) use orders::Orders;
pub use orders::Regions;
use patches::Patches;
use projection::LANES;
use rayon::prelude::*;
use scene::Scene;
use std::f32::consts::TAU;
use std::time::Instant;
use unwrapped_frame::UnwrappedFrame;
pub use unwrapped_frame::View;

/// The default of `--margin`: a patch whose label leads any other by less is refused. Costs have no unit. For twice as
/// much see docs/validation.md, *Other poses and skins*.
pub const MARGIN: f32 = 1.0;

/// From this margin after the first pass on, a patch hides what lies behind it from the other cameras.
const CERTAIN: f32 = 1.0;

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
        let scenes: Vec<Scene<'_>> = scenes.map(|(view, patches)| Scene::new(views, view, patches)).collect();
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
