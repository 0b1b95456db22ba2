//! What all cameras have at places of one view: eight places with eight cameras at once.
//!
//! What a camera has there lies anywhere in memory. So the cells of all are asked before anything is decided by one of them, and
//! then the pixels of those that need it: while the processor waits for one it fetches the others.

use super::lookout::{LANES, Ray, Spots};
use super::settle::Scene;
use super::witness::Sight;
use crate::reconstruct::rays::Sightline;
use std::ops::RangeInclusive;

/// Places that are worked on at once.
pub const PLACES: usize = 8;

/// A place on a line of sight, at a phase in fringes; absolute at order 0.
pub type Place<'a> = (&'a Sightline, f32);

/// What the cameras have at some places, one place after the other.
#[derive(Debug, Default)]
pub struct Looks {
    cameras: usize,
    sights: Vec<Sight>,
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

    /// What each camera has at a place; `None` outside the volume. Of the view itself nothing.
    pub fn at(&self, place: usize) -> Option<&[Sight]> {
        let all = self.sights.get(place * self.cameras..(place + 1) * self.cameras);
        all.filter(|_| self.inside[place])
    }

    /// Looks at places of a view, at each of some orders, and appends what there is: order by order.
    pub fn add(
        &mut self,
        scenes: &[Scene<'_>],
        view: usize,
        places: &[Place<'_>],
        orders: RangeInclusive<i32>,
    ) {
        self.cameras = scenes.len();
        let lookout = &scenes[view].lookout;
        let first = self.sights.len();
        let count = orders.clone().count() * places.len();
        self.sights.resize(first + count * scenes.len(), Sight::NONE);
        let mut places = orders
            .flat_map(|order| places.iter().map(move |&(line, fringes)| (line, fringes + order as f32)));
        let mut spots = [Spots::NONE; PLACES];
        for sights in self.sights[first..].chunks_mut(PLACES * scenes.len()) {
            let mut rays = [Ray::NONE; PLACES];
            let rays = &mut rays[..sights.len() / scenes.len()];
            for (ray, place) in rays.iter_mut().zip(&mut places) {
                *ray = lookout.ray(place);
            }
            self.inside.extend(rays.iter().map(|ray| ray.is_inside()));
            for (block, scenes_of) in scenes.chunks(LANES).enumerate() {
                lookout.spots(block, rays, &mut spots);
                let sights = &mut sights[block * LANES..];
                // A bit for each camera of each place.
                let mut vague = 0u64;
                for (k, spots) in spots.iter().enumerate().take(rays.len()) {
                    for (i, scene) in scenes_of.iter().enumerate() {
                        let (sight, ask) = scene.witness.glance(spots, i);
                        sights[k * scenes.len() + i] = sight;
                        vague |= u64::from(ask) << (k * LANES + i);
                    }
                }
                while vague != 0 {
                    let at = vague.trailing_zeros() as usize;
                    let (k, i) = (at / LANES, at % LANES);
                    sights[k * scenes.len() + i] = scenes_of[i].witness.see_closely(&spots[k], i);
                    vague &= vague - 1;
                }
            }
        }
    }
}
