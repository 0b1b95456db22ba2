//! What all cameras have at places of one view: eight places with eight cameras at once.
//!
//! What a camera has there lies anywhere in memory. So the cells of all are asked before anything is decided by one of them, and
//! then the pixels of those that need it: while the processor waits for one it fetches the others.

use super::glimpse::Glimpse;
use super::lookout::{LANES, Lookout, Ray, Spots};
use super::settle::{Scene, all_nodes};
use super::witness::{Numbers, SightLanes, Witness};
use crate::reconstruct::rays::Sightline;
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
        let mut at = self.sights.len();
        let count = orders.clone().count() * places.len();
        self.sights.resize(at + count * self.blocks, SightLanes::NONE);
        self.inside.reserve(count);
        // What lies outside of the volume is not looked at.
        let mut batch =
            Batch { rays: [Ray::NONE; PLACES], at: [0; PLACES], len: 0, nodes: all_nodes(scenes) };
        for order in orders {
            for &(line, fringes) in places {
                let ray = lookout.ray((line, fringes + order as f32));
                self.inside.push(ray.is_inside());
                if ray.is_inside() {
                    (batch.rays[batch.len], batch.at[batch.len]) = (ray, at);
                    batch.len += 1;
                    if batch.len == PLACES {
                        batch.look(scenes, lookout, &mut self.sights);
                    }
                }
                at += self.blocks;
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
}

impl Batch {
    /// Looks at the places, and forgets them.
    #[inline]
    fn look(&mut self, scenes: &[Scene<'_>], lookout: &Lookout<'_>, sights: &mut [SightLanes]) {
        let (rays, at) = (&self.rays[..self.len], &self.at[..self.len]);
        let mut spots = [Spots::NONE; PLACES];
        let mut next = 0;
        for (block, scenes) in scenes.chunks(LANES).enumerate() {
            let mut numbers = Numbers { first: [0; LANES], all: self.nodes };
            for (first, scene) in numbers.first.iter_mut().zip(scenes) {
                *first = next;
                next += scene.graph.len() as u32;
            }
            // A bit for each camera of each place.
            let mut vague = 0u64;
            simd::dispatch(
                #[inline(always)]
                || {
                    lookout.spots(block, rays, &mut spots);
                    let mut cells = [[Glimpse::UNSEEN; LANES]; PLACES];
                    for (i, scene) in scenes.iter().enumerate() {
                        let glimpses = &scene.witness.cells.glimpses;
                        for (cells, spots) in cells.iter_mut().zip(&spots).take(rays.len()) {
                            cells[i] = *glimpses.at(spots.cell[i]);
                        }
                    }
                    for (k, &at) in at.iter().enumerate() {
                        let (seen, ask) = Witness::glance(&cells[k], &spots[k], &numbers);
                        sights[at + block] = seen;
                        vague |= u64::from(ask) << (k * LANES);
                    }
                },
            );
            while vague != 0 {
                let bit = vague.trailing_zeros() as usize;
                let (k, i) = (bit / LANES, bit % LANES);
                let sight = scenes[i].witness.see_closely(&spots[k], i);
                sights[at[k] + block].set(i, sight, &numbers);
                vague &= vague - 1;
            }
        }
        self.len = 0;
    }
}
