// SPDX-License-Identifier: MIT OR Apache-2.0
//! Fringe orders of all views of one instant, by minimizing one energy (`docs/design/fringe-order.md`).
//!
//! ```text
//! patches         a view's phases in patches of 8 x 8 px: the nodes of a graph
//! links           where patches touch, and how surely they are one surface: its edges
//! lookup          what a view has in each cell, for the other cameras
//! projection      where the other cameras would see a place
//! squares         the nodes of the graph: smooth patches together, others alone
//! observation     what they see there
//! same_head       the same for the other camera of the head, which is compared first
//! evidence        what that costs each fringe order of a patch
//! far_off         cameras whose head moved so far that hardly any of their orders is certain
//! drift           by how much two cameras differ where both surely see one surface
//! contradictions  places where cameras differ though their devices stand as they stood
//! inference       the orders that cost least together, and by how much they lead
//! one_view        the same for a camera alone
//! witness         which surfaces another head or the marker bears out
//! scene           a view with its patches, as the other cameras see it
//! orders          the fringe orders that come out, and how certain they are
//! unwrapped_frame a frame before and after
//! ```
//!
//! A patch's label is the fringe that it lies on. What the other cameras observe at the place, and the marker, give
//! each label a cost; a patch that does not continue its neighbour costs the weight of their link. A patch is refused
//! if its label leads any other by too little.

mod contradictions;
mod drift;
mod evidence;
mod far_off;
mod inference;
mod links;
mod lookup;
mod observation;
mod one_view;
mod orders;
mod patches;
mod projection;
mod same_head;
mod scene;
mod squares;
pub mod unwrapped_frame;
mod witness;

pub use drift::MostDifference;
use drift::{Agreement, Differences};
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

/// Sweeps of message passing in each pass; the second begins with the messages of the first.
const SWEEPS: usize = 2;

/// Gives every patch of every view its fringe order, or refuses it: [`Pipeline::finish`] adds these to the phases, of
/// which only what is certain is left: orders that lead any other by at least `margin`. All views must show the same
/// instant; cameras that differ by more than `most` contradict the calibration. The result does not depend on the
/// number of threads. Returned is which cameras could be compared with others.
///
/// # Errors
///
/// The cameras contradict each other so much that the calibration cannot be believed: then there are no orders.
///
/// [`Pipeline::finish`]: super::pipeline::Pipeline::finish
pub fn solve(views: &mut [View<'_>], margin: f32, most: MostDifference) -> Result<Vec<bool>, String> {
    let start = Instant::now();
    let all: Vec<Patches> =
        views.iter_mut().map(|view| std::mem::take(&mut view.prepared.orders.patches)).collect();
    let (results, agreement) = {
        let scenes = all.into_par_iter().enumerate();
        let scenes: Vec<Scene<'_>> = scenes.map(|(view, patches)| Scene::new(views, view, patches)).collect();
        let (found, differences) = label_all(&scenes, margin, most);
        let agreement = Agreement::of(&differences, &scenes);
        let results: Vec<Found> =
            scenes.into_iter().zip(found).map(|(scene, x)| (scene.patches, x.0, x.1)).collect();
        (results, agreement)
    };
    let verdict = agreement.verdict(views, most);
    for (view, differs_rad) in views.iter_mut().zip(agreement.differ_rad()) {
        view.prepared.counts.differs_rad = differs_rad;
    }
    let margin = if verdict.is_ok() { margin } else { f32::INFINITY };
    views.par_iter_mut().zip(results).for_each(|(view, found)| keep(view.prepared, found, margin));
    let share = start.elapsed() / views.len().max(1) as u32;
    views.iter_mut().for_each(|view| view.prepared.add_time("order", share));
    verdict.map(|()| agreement.compared().collect())
}

/// The whole turns that make the phases of each patch of a view absolute, and by how much these lead any other.
type Turns = (Vec<i32>, Vec<f32>);

/// The same with the patches.
type Found = (Patches, Vec<i32>, Vec<f32>);

/// The turns of each view, and how far the cameras agree.
fn label_all(scenes: &[Scene<'_>], margin: f32, most: MostDifference) -> (Vec<Turns>, Vec<Vec<Differences>>) {
    let mut fields: Vec<Field<'_>> =
        (0..scenes.len()).into_par_iter().map(|i| Field::new(scenes, i)).collect();
    if let [field] = &mut fields[..] {
        one_view::infer(field);
        let margin = (0..field.base.len()).map(|i| field.margin(i)).collect();
        return (vec![(turns_of(field), margin)], Vec::new());
    }
    let (rests, differences) = infer_together(&mut fields, scenes, margin);
    let of = |(field, rests): (Field<'_>, Vec<(u32, f32)>)| {
        let refused = contradictions::refused(&field.scene.patches, &rests, most.scatter_rad);
        let margin = refused.into_iter().enumerate();
        (turns_of(&field), margin.map(|(i, refused)| if refused { 0.0 } else { field.margin(i) }).collect())
    };
    (fields.into_iter().zip(rests).map(of).collect(), differences)
}

/// The whole turns that make the phases of each patch absolute.
fn turns_of(field: &Field<'_>) -> Vec<i32> {
    (0..field.base.len()).map(|i| field.turns(i)).collect()
}

/// How far single places of each view are off what its cameras differ by: patch, rad.
type Rests = Vec<Vec<(u32, f32)>>;

/// The two passes, and the witnesses. The first pass gives an estimate of what hides what, and of the differences between
/// cameras, which are returned; the second uses both.
fn infer_together(
    fields: &mut [Field<'_>],
    scenes: &[Scene<'_>],
    margin: f32,
) -> (Rests, Vec<Vec<Differences>>) {
    let none = vec![vec![Differences::default(); scenes.len().div_ceil(LANES)]; scenes.len()];
    let mut known = OrderTable { turns: Vec::new(), differences: none };
    let mut rests = Vec::new();
    known.turns = turns_from(fields, f32::INFINITY);
    for first in [true, false] {
        fields.par_iter_mut().for_each(|field| {
            evidence::collect(field, scenes, &known, first);
            field.graph.infer(SWEEPS);
        });
        known.turns = turns_from(fields, if first { CERTAIN } else { margin });
        if first {
            (known.differences, rests) =
                fields.par_iter().map(|field| drift::of(field, scenes, &known)).unzip();
        }
    }
    fields.par_iter_mut().for_each(|field| witness::require(field, scenes, &known, margin));
    (rests, known.differences)
}

/// The turns of the patches of all views whose margin is at least this, and [`BEYOND`] entries.
fn turns_from(fields: &[Field<'_>], least: f32) -> Vec<i32> {
    let turns =
        |field: &Field<'_>, i: usize| if field.margin(i) >= least { field.turns(i) } else { NO_ORDER };
    let all = fields.iter().flat_map(|field| (0..field.base.len()).map(move |i| turns(field, i)));
    all.chain([NO_ORDER; BEYOND]).collect()
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
