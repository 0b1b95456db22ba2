//! What all cameras have at places of one view: eight places with eight cameras at once.
//!
//! What a camera has there lies anywhere in memory. So the cells of all are asked before anything is decided by one of them, and
//! then the pixels of those that need it: while the processor waits for one it fetches the others.

use super::glimpse::{Glimpse, GlimpseLanes};
use super::lookout::{LANES, Lookout, Ray, Spots};
use super::settle::{Scene, all_nodes};
use super::witness::{Numbers, Pixels, SightLanes, Witness};
use crate::reconstruct::rays::{Sightline, Sightlines};
use crate::reconstruct::simd;
use std::collections::BTreeMap;
use std::ops::RangeInclusive;

/// Places that are worked on at once.
pub const PLACES: usize = 8;

/// A place on a line of sight, at a phase in fringes; absolute at order 0.
pub type Place<'a> = (&'a Sightline, f32);

/// What the cameras have at places of pieces, by view, piece and order.
pub type PieceLooks = BTreeMap<(usize, usize, i32), Looks>;

/// What the cameras have at some places, one place after the other.
#[derive(Debug, Default)]
pub struct Looks {
    /// Blocks of cameras.
    blocks: usize,
    sights: Vec<SightLanes>,
    /// Whether each place lies in the volume.
    inside: Vec<bool>,
}

impl Looks {
    /// Forgets all.
    pub fn clear(&mut self) {
        self.sights.clear();
        self.inside.clear();
    }

    /// Places that were looked at.
    pub fn len(&self) -> usize {
        self.inside.len()
    }

    /// What the cameras have at a place, block by block; `None` outside the volume. Of the view itself nothing.
    #[inline(always)]
    pub fn at(&self, place: usize) -> Option<&[SightLanes]> {
        if self.inside[place] {
            self.sights.get(place * self.blocks..(place + 1) * self.blocks)
        } else {
            None
        }
    }

    /// Looks at places of a view, at each of some orders, and appends what there is: order by order.
    pub fn add(
        &mut self,
        scenes: &[Scene<'_>],
        view: usize,
        places: &[Place<'_>],
        orders: RangeInclusive<i32>,
    ) {
        self.blocks = scenes.len().div_ceil(LANES);
        let lookout = &scenes[view].lookout;
        let (before, count) = (self.inside.len(), orders.clone().count() * places.len());
        self.inside.resize(before + count, false);
        self.sights.resize((before + count) * self.blocks, SightLanes::NONE);
        let mut batch = Batch::new(scenes);
        let mut lines = Sightlines::NONE;
        for (first, chunk) in places.chunks(PLACES).enumerate().map(|(i, chunk)| (i * PLACES, chunk)) {
            let mut phases = [f32::NAN; PLACES];
            for (i, &(line, fringes)) in chunk.iter().enumerate() {
                lines.set(i, line);
                phases[i] = fringes;
            }
            for (turn, order) in orders.clone().enumerate() {
                let inverse_depths = simd::dispatch(
                    #[inline(always)]
                    || {
                        let mut fringes = phases;
                        for fringes in &mut fringes {
                            *fringes += order as f32;
                        }
                        lookout.inverse_depths(&lines, &fringes)
                    },
                );
                let at = before + turn * places.len() + first;
                for ((i, &(line, _)), inverse_depth) in chunk.iter().enumerate().zip(inverse_depths) {
                    // What lies outside of the volume is not looked at.
                    if inverse_depth.is_nan() {
                        continue;
                    }
                    self.inside[at + i] = true;
                    batch.rays[batch.len] = Ray { direction: line.direction, inverse_depth };
                    batch.at[batch.len] = (at + i) * self.blocks;
                    batch.len += 1;
                    if batch.len == PLACES {
                        batch.look(scenes, lookout, &mut self.sights);
                    }
                }
            }
        }
        if batch.len > 0 {
            batch.look(scenes, lookout, &mut self.sights);
        }
    }
}

/// Places that are worked on at once, and where what there is belongs.
struct Batch {
    rays: [Ray; PLACES],
    at: [usize; PLACES],
    len: usize,
    /// Nodes of all views.
    nodes: u32,
    /// Where a block's cameras see each place, what these have there, and which pixels have to be asked: room for one block.
    spots: [Spots; PLACES],
    cells: [GlimpseLanes<LANES>; PLACES],
    pixels: [Pixels; PLACES],
}

impl Batch {
    fn new(scenes: &[Scene<'_>]) -> Self {
        Self {
            rays: [Ray { direction: [0.0; 3], inverse_depth: 0.0 }; PLACES],
            at: [0; PLACES],
            len: 0,
            nodes: all_nodes(scenes),
            spots: [Spots::NONE; PLACES],
            cells: [GlimpseLanes::UNSEEN; PLACES],
            pixels: [Pixels::NONE; PLACES],
        }
    }

    /// Looks at the places, and forgets them.
    #[inline(never)]
    fn look(&mut self, scenes: &[Scene<'_>], lookout: &Lookout<'_>, sights: &mut [SightLanes]) {
        let Self { rays, at, len, nodes, spots, cells, pixels } = self;
        let (rays, at) = (&rays[..*len], &at[..*len]);
        let mut next = 0;
        for (block, scenes) in scenes.chunks(LANES).enumerate() {
            let mut numbers = Numbers { first: [0; LANES], all: *nodes };
            let mut grids: [&[Glimpse]; LANES] = [&[]; LANES];
            for ((first, grid), scene) in numbers.first.iter_mut().zip(&mut grids).zip(scenes) {
                *first = next;
                next += scene.graph.len() as u32;
                *grid = scene.witness.cells.glimpses.cells();
            }
            // A bit for each camera of each place.
            let mut vague = 0u64;
            simd::dispatch(
                #[inline(always)]
                || {
                    lookout.spots(block, rays, spots);
                    for (cells, spots) in cells.iter_mut().zip(&*spots).take(rays.len()) {
                        for (i, (grid, &cell)) in grids.iter().zip(&spots.cell).enumerate() {
                            cells.set(i, grid.get(cell as usize).unwrap_or(&Glimpse::UNSEEN));
                        }
                    }
                    let places = at.iter().zip(&*cells).zip(&*spots).zip(&mut *pixels).enumerate();
                    for (k, (((at, cells), spots), pixels)) in places {
                        let (seen, asked, ask) = Witness::glance(cells, spots, &numbers);
                        (sights[at + block], *pixels) = (seen, asked);
                        vague |= u64::from(ask) << (k * LANES);
                    }
                },
            );
            let mut soon = vague;
            while soon != 0 {
                let bit = soon.trailing_zeros() as usize;
                let (k, i) = (bit / LANES, bit % LANES);
                scenes[i].witness.expect(&pixels[k], i);
                soon &= soon - 1;
            }
            while vague != 0 {
                let bit = vague.trailing_zeros() as usize;
                let (k, i) = (bit / LANES, bit % LANES);
                let (witness, pixels, spots) = (&scenes[i].witness, &pixels[k], &spots[k]);
                let past = || (witness.past(spots.cell[i], pixels, i, &numbers), 0.0);
                let seen = witness.see_closely(pixels, i, spots.cast[i], &numbers).unwrap_or_else(past);
                let sight = &mut sights[at[k] + block];
                (sight.node[i], sight.ahead[i]) = seen;
                vague &= vague - 1;
            }
        }
        self.len = 0;
    }
}
