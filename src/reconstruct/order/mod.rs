//! Fringe orders of all views of one instant, from all evidence.
//!
//! ```text
//! cells     the unwrapped phase in patches of 8 x 8 px
//! borders   where they touch, and whether they continue each other
//! steps     what a row of them has in common: most are filled by one smooth surface
//! glimpse   the patches as other cameras look at them
//! pieces    patches grown to pieces of surface, joined only along whole borders
//! lookout   where the other cameras would see a place
//! looks     what all of them have there, for several places at once
//! jury      what they say of a place, eight cameras at once
//! witness   what another camera has at the place where a piece would be
//! settle    marker, neighbours and other cameras weighed: each piece gets an order, or is refused
//! split     pieces that have grown over two surfaces, parted
//! around    what is said around each place
//! grow      from the pieces' cores to every place, as far as the other cameras confirm it
//! elsewhere where other heads see what is open, or hidden from all of them
//! finish    what too little vouches for refused, holes closed
//! mutual    stretches that are open at last in both cameras of a head, at the same place
//! confirmed those that the other cameras see at one order alone
//! enclosed  and those that known surfaces enclose
//! stretch   nodes that continue one another, and the orders that are tried for them
//! ```
//!
//! One view cannot tell an arm that lies parallel to the hip at a whole number of fringes from one surface. What it can
//! tell is where that may be: pieces whose common border agrees only in part. These are given their orders by the other
//! cameras, and are refused where they cannot tell.

mod around;
mod borders;
mod cells;
mod confirmed;
mod elsewhere;
mod enclosed;
mod finish;
mod glimpse;
mod graph;
mod grow;
mod jury;
mod lookout;
mod looks;
mod mutual;
mod pieces;
mod settle;
mod split;
mod steps;
mod stretch;
mod volume;
mod witness;
mod words;

use super::pair::Pair;
use super::pipeline::Prepared;
use super::runs::each_not_0;
use super::simd;
use super::triangulate::Triangulator;
use crate::image::Plane;
use cells::{CELL_PX, Cells, Surface};
use graph::Graph;
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
    /// Its geometry.
    pub triangulator: &'a Triangulator,
    /// Which head it belongs to: cameras of equal number see the same projector.
    pub head: usize,
    /// Its frame.
    pub prepared: &'a mut Prepared,
}

/// Pieces of a view's surface with one fringe order each, and how certain these are.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Regions {
    /// Column and row of the image at which the cells begin.
    origin: (usize, usize),
    /// Cells in a row.
    columns: usize,
    /// Rows of the frame in a row of the cells' pixels.
    sensor_rows: usize,
    /// Patches of the surface: cell, pixels within it, region. Cell by cell.
    patches: Vec<(u32, u64, u32)>,
    /// How far the evidence for each region's order leads that for any other: 1 is the full word of one camera, or 60
    /// pixels of marker.
    margin: Vec<f32>,
}

impl Regions {
    /// The margin of the order at a pixel of the frame, such as a cloud's `pixel`; 0 where there is no region: its order has
    /// come from its neighbours.
    pub fn margin_at(&self, [u, v]: [u16; 2]) -> f32 {
        let v = usize::from(v) / self.sensor_rows.max(1);
        let place = usize::from(u).checked_sub(self.origin.0).zip(v.checked_sub(self.origin.1));
        let Some((u, v)) = place.filter(|(u, _)| u / CELL_PX < self.columns) else { return 0.0 };
        let cell = (v / CELL_PX * self.columns + u / CELL_PX) as u32;
        let bit = 1u64 << (v % CELL_PX * CELL_PX + u % CELL_PX);
        let first = self.patches.partition_point(|patch| patch.0 < cell);
        let mut patches = self.patches[first..].iter().take_while(|patch| patch.0 == cell);
        let region = patches.find(|patch| patch.1 & bit != 0);
        region.and_then(|patch| self.margin.get(patch.2 as usize).copied()).unwrap_or(0.0)
    }
}

/// What a frame's patches come to. They are cut while their phases are in the cache, and their orders are written when these are read
/// again.
#[derive(Debug, Default)]
pub enum Orders {
    /// Nobody has asked for any.
    #[default]
    Unasked,
    /// Patches without orders.
    Open(Cells),
    /// What to add to the phases of each patch, rad; NaN where there is no order.
    Known(Cells, Vec<f32>),
}

impl Orders {
    /// Adds them to the phases.
    pub(super) fn apply(&self, phase: &mut Plane<f32>) {
        if let Self::Known(cells, shift) = self {
            simd::dispatch(
                #[inline(always)]
                || cells.shift(phase, shift),
            );
        }
    }
}

/// Cuts a frame that other cameras will be asked for into patches.
pub fn cut(prepared: &mut Prepared, pair: &Pair) {
    let start = Instant::now();
    prepared.orders = Orders::Open(cells(prepared, pair));
    prepared.add_time("order", start.elapsed());
}

fn cells(prepared: &Prepared, pair: &Pair) -> Cells {
    Cells::new(&Surface {
        phase: &prepared.absolute,
        period: prepared.period(),
        runs: &prepared.lit,
        sign: pair.sign,
        sensor_rows: pair.sensor_rows as f32,
    })
}

/// Gives every piece of every view its fringe order, or refuses it: [`Pipeline::finish`] adds these to the phases, of which only what is
/// certain is left. All views must show the same instant. The result does not depend on threads. One view alone has no witnesses: what its
/// own marker says stands, without regions.
///
/// [`Pipeline::finish`]: super::pipeline::Pipeline::finish
pub fn settle(views: &mut [View<'_>]) {
    if views.len() < 2 {
        return;
    }
    let start = Instant::now();
    let all_cells: Vec<Cells> = views.par_iter_mut().map(take_cells).collect();
    let results: Vec<Outcome> = {
        let scenes = all_cells.into_par_iter().enumerate();
        let mut scenes: Vec<Scene<'_>> = scenes.map(|(view, cells)| scene(views, view, cells)).collect();
        settle::settle(&mut scenes);
        let labels = grow::labels(&scenes);
        scenes.into_par_iter().zip(labels).map(|(scene, labels)| outcome(scene, &labels)).collect()
    };
    views.par_iter_mut().zip(results).for_each(|(view, result)| apply(view.prepared, result));
    let share = start.elapsed() / views.len().max(1) as u32;
    views.iter_mut().for_each(|view| view.prepared.add_time("order", share));
}

struct Outcome {
    cells: Cells,
    /// What to add to the phases of each node, rad; NaN where there is no order.
    shift: Vec<f32>,
    regions: Regions,
    contradicted: usize,
}

/// A view's patches, which may have been cut before.
fn take_cells(view: &mut View<'_>) -> Cells {
    match std::mem::take(&mut view.prepared.orders) {
        Orders::Open(cells) | Orders::Known(cells, _) => cells,
        Orders::Unasked => cells(view.prepared, view.triangulator.pair()),
    }
}

/// A view's pieces, all open.
fn scene<'a>(views: &'a [View<'_>], number: usize, cells: Cells) -> Scene<'a> {
    let view = &views[number];
    let prepared = &*view.prepared;
    let pair = view.triangulator.pair();
    let votes = votes(&cells, prepared, pair);
    let graph = Graph::new(&cells, pair.sensor_rows);
    let clearance = pieces::CORE_CLEARANCE / pair.sensor_rows as u8;
    let pieces = Pieces::new(&cells, &graph, &votes, settle::MIN_VOTES, clearance);
    let px = pieces.px(&cells, pair.sensor_rows);
    let open = State { order: Err(Refusal::NoEvidence), margin: 0.0 };
    let states = vec![open; pieces.nodes.len()];
    let settled = vec![NONE; cells.nodes.len()];
    let roi = prepared.roi;
    let line = |pixel: usize| prepared.table.sightline(roi.u + pixel % roi.width, roi.v + pixel / roi.width);
    let lines = cells.nodes.iter().map(|node| line(node.pixel as usize)).collect();
    let witness = Witness::new(pair, view.head, roi, cells);
    let lookout =
        Lookout::new(&prepared.table, number, views.iter().map(|x| (x.triangulator.pair(), x.prepared.roi)));
    let nodes = &witness.cells.nodes;
    let light: f32 = nodes.iter().map(|node| prepared.light_dn(node.pixel as usize)).sum();
    Scene {
        triangulator: view.triangulator,
        lookout,
        graph,
        lines,
        pieces,
        states,
        px,
        settled,
        lone: views.iter().filter(|x| x.head == view.head).count() == 1,
        light_dn: light / nodes.len().max(1) as f32,
        witness,
    }
}

/// The orders that marker pixels give their nodes: node, order, pixels of the sensor.
fn votes(cells: &Cells, prepared: &Prepared, pair: &Pair) -> Vec<(u32, i32, u32)> {
    let mut votes: BTreeMap<(u32, i32), u32> = BTreeMap::new();
    for v in 0..prepared.marker.height() {
        for run in prepared.runs().row(v) {
            let (marker, phase) =
                (&prepared.marker.row(v)[run.columns()], &prepared.absolute.row(v)[run.columns()]);
            each_not_0(marker, |i| {
                let Some(node) = cells.glimpses.node(run.start() + i, v) else { return };
                // On the marker's core the wrapped phase is small: the nearest whole turn is the node's own.
                let order = pair.markers[usize::from(marker[i] - 1)] as i32 - (phase[i] / TAU).round() as i32;
                *votes.entry((node, order)).or_default() += pair.sensor_rows as u32;
            });
        }
    }
    votes.into_iter().map(|((node, order), n)| (node, order, n)).collect()
}

fn outcome(scene: Scene<'_>, labels: &[Label]) -> Outcome {
    let cells = &scene.witness.cells;
    let mut regions = Regions {
        origin: (scene.witness.roi.u, scene.witness.roi.v),
        columns: cells.columns,
        sensor_rows: scene.triangulator.pair().sensor_rows,
        patches: Vec::with_capacity(labels.len()),
        margin: scene.states.iter().map(|x| x.margin).collect(),
    };
    let mut contradicted = 0;
    let mut shift = vec![f32::NAN; labels.len()];
    for (i, ((node, label), shift)) in cells.nodes.iter().zip(labels).zip(&mut shift).enumerate() {
        if label.turns == NONE {
            contradicted += if label.contradicted { node.size as usize } else { 0 };
        } else {
            *shift = TAU * label.turns as f32;
            // What has grown from elsewhere has not the margin of its piece.
            if scene.turns_of(i as u32) == Some(label.turns) {
                regions.patches.push((node.cell, node.mask, scene.pieces.of[i]));
            }
        }
    }
    Outcome { cells: scene.witness.cells, shift, regions, contradicted }
}

/// Keeps the orders of a view's nodes.
fn apply(prepared: &mut Prepared, outcome: Outcome) {
    let Outcome { cells, shift, regions, contradicted } = outcome;
    prepared.open.clear();
    let sizes = cells.nodes.iter().zip(&shift).filter(|(_, shift)| !shift.is_nan());
    let known: usize = sizes.map(|(node, _)| node.size as usize).sum();
    let counts = &mut prepared.counts;
    counts.refused = counts.phase.saturating_sub(known);
    counts.contradicted = contradicted;
    prepared.regions = regions;
    prepared.orders = Orders::Known(cells, shift);
}
