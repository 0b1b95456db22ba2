//! Fringe orders from the head's other camera.
//!
//! Both cameras of a head see the same fringes of the same projector. A tree that no marker anchors in one
//! camera, a fore-arm before the chest, often shows surface whose absolute phase the other camera knows. For
//! every order that puts the tree into the volume, some of its points are projected into the other camera
//! and their phase is held against the one known there. One order must agree clearly better than any other;
//! else the tree stays unresolved. Only *absolute* phases count as evidence: modulo 2 pi the fringes of two
//! cameras above and below the projector agree for wrong orders, too.

use super::pair::Pair;
use super::pipeline::Prepared;
use super::triangulate::Triangulator;
use nalgebra::Point3;
use std::collections::{BTreeMap, BTreeSet};
use std::f32::consts::TAU;
use std::ops::RangeInclusive;

/// Points of a tree that are tried.
const SAMPLES: usize = 400;

/// So many of them say whether an order is worth the rest.
const FIRST_SAMPLES: usize = 16;

/// No surface is nearer to a camera, m.
const NEAREST_M: f64 = 0.05;

/// The smallest tree that is tried, px.
const MIN_TREE_PX: usize = 150;

/// Phases agree when they differ by less than this, rad.
const AGREE_RAD: f32 = 0.5;

/// Share of the samples that must agree for the best order.
const MIN_AGREE_SHARE: f32 = 0.2;

/// Share of the samples seen by the other camera that must agree for the best order.
const MIN_AGREE_OF_SEEN: f32 = 0.7;

/// Side of the tiles in which evidence is gathered, px.
const TILE_PX: usize = 16;

/// One of so many pixels is tried there.
const TILE_SAMPLING: usize = 8;

/// Votes for less those against from which a tile supports its neighbours.
const MIN_TILE_VOTES: i32 = 10;

/// The best order must gather this many times the agreement of the second best.
const MARGIN: f32 = 2.5;

/// Resolves trees of `own` by the absolute phase of `other`, a camera of the same head. Returns the number of
/// pixels that gained an absolute phase.
pub fn resolve(own: &mut Prepared, triangulator: &Triangulator, other: &Prepared, partner: &Pair) -> usize {
    let mut clock = std::mem::take(&mut own.clock);
    let gained = clock.time("partner", || resolve_trees(own, triangulator, other, partner));
    own.clock = clock;
    gained
}

fn resolve_trees(own: &mut Prepared, triangulator: &Triangulator, other: &Prepared, partner: &Pair) -> usize {
    let mut trees: BTreeMap<u32, Vec<u32>> = BTreeMap::new();
    for (pixel, &tree) in own.open.tree.as_slice().iter().enumerate() {
        if tree != 0 {
            trees.entry(tree).or_default().push(pixel as u32);
        }
    }
    let mut gained = 0;
    for pixels in trees.values().filter(|pixels| pixels.len() >= MIN_TREE_PX) {
        let Some(order) = vote(own, pixels, triangulator, other, partner) else { continue };
        let supported = supported_tiles(own, pixels, order, triangulator, other, partner);
        for &pixel in pixels {
            if !supported.contains(&own.tile(pixel)) {
                continue;
            }
            let phase = own.open.relative.as_slice()[pixel as usize] + TAU * order as f32;
            own.absolute.as_mut_slice()[pixel as usize] = phase;
            own.open.tree.as_mut_slice()[pixel as usize] = 0;
            gained += 1;
        }
    }
    gained
}

/// The order that the other camera confirms for a tree.
fn vote(
    own: &Prepared,
    pixels: &[u32],
    triangulator: &Triangulator,
    other: &Prepared,
    partner: &Pair,
) -> Option<i32> {
    let step = pixels.len().div_ceil(SAMPLES);
    let samples: Vec<u32> = pixels.iter().copied().step_by(step).collect();
    let pair = triangulator.pair();
    let inside = samples.iter().take(FIRST_SAMPLES).filter_map(|&pixel| {
        let (u, v) = (own.roi.u + pixel as usize % own.roi.width, own.roi.v + pixel as usize / own.roi.width);
        orders_inside(pair, u, v, own.open.relative.as_slice()[pixel as usize])
    });
    let orders = inside.reduce(|a, b| *a.start().min(b.start())..=*a.end().max(b.end()))?;
    let mut scores: Vec<(f32, f32, i32)> = Vec::new();
    for order in orders {
        let (mut seen, mut agree, mut inside) = (0u32, 0u32, 0u32);
        for (i, &pixel) in samples.iter().enumerate() {
            // Orders that put the first samples outside the volume are not worth the rest.
            if i == FIRST_SAMPLES && inside == 0 {
                break;
            }
            let phase = own.open.relative.as_slice()[pixel as usize] + TAU * order as f32;
            let (u, v) = (pixel as usize % own.roi.width, pixel as usize / own.roi.width);
            let point = triangulator.point(own.roi.u + u, own.roi.v + v, f64::from(phase));
            let Some((_, world)) = point.filter(|(_, world)| pair.in_volume(world)) else {
                continue;
            };
            inside += 1;
            if let Some(known) = phase_at(other, partner, &world) {
                seen += 1;
                agree += u32::from((known - phase).abs() < AGREE_RAD);
            }
        }
        scores.push((agree as f32, seen as f32, order));
    }
    scores.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.2.cmp(&b.2)));
    let (&(agree, seen, order), second) = (scores.first()?, scores.get(1).map_or(0.0, |s| s.0));
    let enough = agree >= MIN_AGREE_SHARE * samples.len() as f32 && agree >= MIN_AGREE_OF_SEEN * seen;
    (enough && agree >= MARGIN * second).then_some(order)
}

/// Fringe orders that put a pixel with this phase in its tree into the volume, and one more at either end. `None` where
/// its ray misses the volume.
fn orders_inside(pair: &Pair, u: usize, v: usize, relative: f32) -> Option<RangeInclusive<i32>> {
    let ray = pair.camera.ray(u as f64, v as f64)?;
    let (from, to) = (ray.at(0.0), ray.at(1.0));
    let (mut near, mut far) = (NEAREST_M, f64::INFINITY);
    for i in 0..3 {
        let ends = [pair.volume_min_m[i], pair.volume_max_m[i]].map(|x| (x - from[i]) / (to[i] - from[i]));
        (near, far) = (near.max(ends[0].min(ends[1])), far.min(ends[0].max(ends[1])));
    }
    if near > far {
        return None;
    }
    let fringes = (pair.projector.width as f64 / pair.pattern.period_px) as i32;
    let order = |distance: f64| {
        let column = pair.projector.project(&ray.at(distance)).map(|[column, _]| column);
        let phase = column.map(|column| pair.pattern.phase(column) - f64::from(relative));
        phase.map(|phase| (phase / f64::from(TAU)).floor() as i32)
    };
    // Behind the projector or beyond its lens there is no column: then no order is left out.
    let (a, b) = order(near).zip(order(far)).unwrap_or((-fringes, 2 * fringes));
    Some((a.min(b) - 1).max(-fringes)..=(a.max(b) + 2).min(2 * fringes))
}

impl Prepared {
    /// Place of a pixel in the grid of tiles.
    fn tile(&self, pixel: u32) -> (usize, usize) {
        (pixel as usize % self.roi.width / TILE_PX, pixel as usize / self.roi.width / TILE_PX)
    }
}

/// The tiles of a tree whose order the other camera confirms there, and their neighbours. A tree may have
/// grown over two surfaces: an order holds only near the evidence for it.
fn supported_tiles(
    own: &Prepared,
    pixels: &[u32],
    order: i32,
    triangulator: &Triangulator,
    other: &Prepared,
    partner: &Pair,
) -> BTreeSet<(usize, usize)> {
    let mut balance: BTreeMap<(usize, usize), i32> = BTreeMap::new();
    for &pixel in pixels.iter().step_by(TILE_SAMPLING) {
        let phase = own.open.relative.as_slice()[pixel as usize] + TAU * order as f32;
        let (u, v) = (pixel as usize % own.roi.width, pixel as usize / own.roi.width);
        let Some((_, world)) = triangulator.point(own.roi.u + u, own.roi.v + v, f64::from(phase)) else {
            continue;
        };
        if let Some(known) = phase_at(other, partner, &world) {
            let agrees = (known - phase).abs() < AGREE_RAD;
            *balance.entry(own.tile(pixel)).or_default() += if agrees { 1 } else { -1 };
        }
    }
    let contested = |tile: &(usize, usize)| balance.get(tile).is_some_and(|&votes| votes <= 0);
    let mut supported = BTreeSet::new();
    for &(x, y) in balance.iter().filter(|(_, votes)| **votes >= MIN_TILE_VOTES).map(|(tile, _)| tile) {
        for near in
            (x.saturating_sub(1)..=x + 1).flat_map(|x| (y.saturating_sub(1)..=y + 1).map(move |y| (x, y)))
        {
            if !contested(&near) {
                supported.insert(near);
            }
        }
    }
    supported
}

/// The absolute phase that a camera knows where it would see a world point, interpolated along the row.
fn phase_at(camera: &Prepared, pair: &Pair, world: &Point3<f64>) -> Option<f32> {
    let [u, v] = pair.camera.project(world)?;
    let (u, v) = (u - camera.roi.u as f64, v.round() - camera.roi.v as f64);
    if u < 0.0 || v < 0.0 || u >= (camera.roi.width - 1) as f64 || v >= camera.roi.height as f64 {
        return None;
    }
    let row = camera.absolute.row(v as usize);
    let (a, b) = (*row.get(u as usize)?, *row.get(u as usize + 1)?);
    let phase = a + (u - u.floor()) as f32 * (b - a);
    // Across a depth step there is nothing to interpolate. NaN is refused here, too.
    ((b - a).abs() < TAU / 3.0).then_some(phase)
}
