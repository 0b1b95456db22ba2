//! Fringe orders of all views of one instant, from all evidence.
//!
//! ```text
//! cells     the unwrapped phase in patches of 8 x 8 px, and where they continue each other
//! pieces    patches grown to pieces of surface, joined only along whole borders
//! lookout   where the other cameras would see a place
//! witness   what another camera has at the place where a piece would be
//! settle    marker, neighbours and other cameras weighed: each piece gets an order, or is refused
//! split     pieces that have grown over two surfaces, parted
//! grow      from the pieces' cores to every place, as far as the other cameras confirm it
//! elsewhere where other heads see what is open, or hidden from all of them
//! ```
//!
//! One view cannot tell an arm that lies parallel to the hip at a whole number of fringes from one surface. What it can
//! tell is where that may be: pieces whose common border agrees only in part. These are given their orders by the other
//! cameras, and are refused where they cannot tell.

mod cells;
mod elsewhere;
mod graph;
mod grow;
mod lookout;
mod pieces;
mod settle;
mod sighted;
mod split;
mod volume;
mod witness;
mod words;

use super::pipeline::Prepared;
use super::rays::RayTable;
use super::triangulate::Triangulator;
use crate::image::Plane;
use cells::Cells;
use grow::{Label, NONE};
use lookout::Lookout;
use pieces::Pieces;
use rayon::prelude::*;
use settle::{Refusal, Scene, State};
use std::collections::BTreeMap;
use std::f32::consts::TAU;
use std::time::Instant;
use witness::Witness;

/// One camera's frame and its geometry.
#[derive(Debug)]
pub struct View<'a> {
    /// Its lines of sight.
    pub table: &'a RayTable,
    /// Its geometry.
    pub triangulator: &'a Triangulator,
    /// Which head it belongs to: cameras of equal number see the same projector.
    pub head: usize,
    /// Its frame.
    pub prepared: &'a mut Prepared,
}

/// Pieces of a view's surface with one fringe order each, and how certain these are.
#[derive(Debug, Clone, PartialEq)]
pub struct Regions {
    /// Column and row of the frame at which `id` begins.
    pub origin: (usize, usize),
    /// Region of each pixel, 0 where there is none: its order has come from its neighbours.
    pub id: Plane<u16>,
    /// How far the evidence for each region's order leads that for any other: 1 is the full word of one camera, or 60
    /// pixels of marker. Entry 0 stands for no region.
    pub margin: Vec<f32>,
}

impl Regions {
    /// No regions.
    pub fn none(width: usize, height: usize) -> Self {
        Self { origin: (0, 0), id: Plane::filled(width, height, 0), margin: vec![0.0] }
    }

    /// The margin of the order at a pixel of the frame, such as a cloud's `pixel`; 0 where there is no region.
    pub fn margin_at(&self, [u, v]: [u16; 2]) -> f32 {
        let place = usize::from(u).checked_sub(self.origin.0).zip(usize::from(v).checked_sub(self.origin.1));
        let id = place.filter(|(u, v)| *u < self.id.width() && *v < self.id.height());
        id.and_then(|(u, v)| self.margin.get(usize::from(self.id.at(u, v))).copied()).unwrap_or(0.0)
    }
}

/// Gives every piece of every view its fringe order, or refuses it: afterwards `absolute` holds only what is certain.
/// All views must show the same instant. The result does not depend on threads. One view alone has no witnesses: what its
/// own marker says stands, without regions.
pub fn settle(views: &mut [View<'_>]) {
    if views.len() < 2 {
        return;
    }
    let start = Instant::now();
    let results: Vec<Outcome> = {
        let mut scenes: Vec<Scene<'_>> =
            (0..views.len()).into_par_iter().map(|view| scene(views, view)).collect();
        settle::settle(&mut scenes);
        let labels = grow::labels(&scenes);
        scenes.into_iter().zip(labels).map(|(scene, labels)| outcome(scene, &labels)).collect()
    };
    for (view, result) in views.iter_mut().zip(results) {
        let counts = &mut view.prepared.counts;
        let before = &view.prepared.absolute;
        let (mut refused, mut gained) = (0, 0);
        for (was, is) in before.as_slice().iter().zip(result.absolute.as_slice()) {
            gained += usize::from(was.is_nan() && !is.is_nan());
            refused += usize::from(is.is_nan());
        }
        counts.refused = counts.phase.saturating_sub(result.absolute.as_slice().len() - refused);
        counts.contradicted = result.contradicted;
        counts.by_partner = gained;
        view.prepared.absolute = result.absolute;
        view.prepared.regions = result.regions;
    }
    let share = start.elapsed() / views.len().max(1) as u32;
    views.iter_mut().for_each(|view| view.prepared.add_time("order", share));
}

struct Outcome {
    absolute: Plane<f32>,
    regions: Regions,
    contradicted: usize,
}

/// A view's pieces, all open.
fn scene<'a>(views: &'a [View<'_>], number: usize) -> Scene<'a> {
    let view = &views[number];
    let prepared = &*view.prepared;
    let pair = view.triangulator.pair();
    let mut phase = prepared.absolute.clone();
    let open = &prepared.open;
    for ((phase, relative), tree) in
        phase.as_mut_slice().iter_mut().zip(open.relative.as_slice()).zip(open.tree.as_slice())
    {
        if *tree != 0 {
            *phase = *relative;
        }
    }
    let cells = Cells::new(&phase, prepared.period(), pair.sign);
    let votes = votes(&cells, &phase, &prepared.marker, &pair.markers);
    let pieces = Pieces::new(&cells, &votes, settle::MIN_VOTES);
    let px =
        pieces.nodes.iter().map(|nodes| nodes.iter().map(|&x| cells.nodes[x as usize].size).sum()).collect();
    let open = State { order: Err(Refusal::NoEvidence), margin: 0.0 };
    let states = vec![open; pieces.nodes.len()];
    let witness = Witness::new(pair, view.head, prepared.roi, phase, &prepared.object, cells);
    let lookout = Lookout::new(view.table, number, views.iter().map(|x| x.triangulator.pair()));
    Scene { triangulator: view.triangulator, lookout, witness, pieces, states, px }
}

/// The orders that marker pixels give their nodes: node, order, pixels.
fn votes(cells: &Cells, phase: &Plane<f32>, marker: &Plane<u8>, markers: &[u32]) -> Vec<(u32, i32, u32)> {
    let mut votes: BTreeMap<(u32, i32), u32> = BTreeMap::new();
    let pixels = marker.as_slice().iter().zip(phase.as_slice()).zip(cells.node.as_slice());
    for ((marker, phase), node) in pixels.filter(|((marker, _), node)| **marker != 0 && **node != 0) {
        // On the marker's core the wrapped phase is small: the nearest whole turn is the node's own.
        let order = markers[usize::from(marker - 1)] as i32 - (phase / TAU).round() as i32;
        *votes.entry((node - 1, order)).or_default() += 1;
    }
    votes.into_iter().map(|((node, order), n)| (node, order, n)).collect()
}

fn outcome(scene: Scene<'_>, labels: &[Label]) -> Outcome {
    let mut absolute = scene.witness.phase.clone();
    let mut regions = Regions::none(absolute.width(), absolute.height());
    regions.origin = (scene.witness.roi.u, scene.witness.roi.v);
    regions.margin.extend(scene.states.iter().map(|x| x.margin));
    let mut contradicted = 0;
    for ((phase, &node), id) in absolute
        .as_mut_slice()
        .iter_mut()
        .zip(scene.witness.cells.node.as_slice())
        .zip(regions.id.as_mut_slice())
        .filter(|((_, x), _)| **x != 0)
    {
        let piece = scene.pieces.of[node as usize - 1] as usize;
        let label = labels[node as usize - 1];
        if label.turns == NONE {
            *phase = f32::NAN;
            contradicted += usize::from(label.contradicted);
        } else {
            *phase += TAU * label.turns as f32;
            // What has grown from elsewhere has not the margin of its piece.
            if scene.turns_of(node - 1) == Some(label.turns) {
                *id = u16::try_from(piece + 1).unwrap_or(u16::MAX);
            }
        }
    }
    Outcome { absolute, regions, contradicted }
}
