//! What the other cameras say about a place in space.
//!
//! All cameras photograph the same instant. A surface that one of them claims must look right to each of the others: at
//! the pixel where it would be seen there is the same surface, or something before it. A claimed surface that stands
//! before what another camera sees there, or where that camera looks past the body, is not there. Places are compared by
//! the phase of the other camera's own projector: the phase that it casts on the place against the one that is seen.

use super::cells::{CELL_PX, Cells};
use super::glimpse::Glimpse;
use super::lookout::{LANES, Spots};
use crate::reconstruct::bits::WORD;
use crate::reconstruct::pair::Pair;
use crate::reconstruct::roi::Roi;
use crate::reconstruct::round::floor;
use nalgebra::{Point3, Vector3};
use std::f32::consts::TAU;

/// Phases of the same surface differ by less, rad.
pub const SAME_RAD: f32 = 0.8;

/// Phases of different surfaces differ by more, rad; what lies between says nothing.
pub const OTHER_RAD: f32 = 1.6;

/// A camera as a witness for the others.
#[derive(Debug)]
pub struct Witness {
    /// Which head it belongs to.
    pub head: usize,
    /// Where its planes lie in the frame.
    pub roi: Roi,
    /// Its nodes, with the phase that it has unwrapped, up to the orders of the pieces.
    pub cells: Cells,
    /// Sign of the projected phase's change with the distance from the camera.
    towards: f32,
}

/// How the nodes of a block's cameras are numbered among those of all views.
#[derive(Debug, Clone, Copy)]
pub struct Numbers {
    /// Where those of each camera begin.
    pub first: [u32; LANES],
    /// How many there are of all views. This number stands for [`Sight::NOTHING`], the next for [`Sight::PAST`].
    pub all: u32,
}

/// What the cameras of a block have at the pixels where they would see a place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SightLanes {
    /// [`Sight::node`], by [`Numbers`].
    pub node: [u32; LANES],
    /// [`Sight::ahead`].
    pub ahead: [f32; LANES],
}

impl SightLanes {
    /// Of a place that was not looked at.
    pub const NONE: Self = Self { node: [u32::MAX; LANES], ahead: [0.0; LANES] };

    /// States what one of the cameras has.
    #[inline(always)]
    pub fn set(&mut self, lane: usize, sight: Sight, numbers: &Numbers) {
        self.ahead[lane] = sight.ahead;
        self.node[lane] = match sight.node {
            Sight::NOTHING => numbers.all,
            Sight::PAST => numbers.all + 1,
            node => numbers.first[lane] + node,
        };
    }
}

/// What a camera has at the pixel where it would see a place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sight {
    /// Its node there, or [`Sight::PAST`], or [`Sight::NOTHING`].
    pub node: u32,
    /// The node's phase there less the one that is cast on the place, rad.
    pub ahead: f32,
}

impl Sight {
    /// `node` where it looks past the object.
    pub const PAST: u32 = u32::MAX;
    /// `node` where there is nothing that could be said.
    pub const NOTHING: u32 = u32::MAX - 1;
    /// Nothing that could be said.
    pub const NONE: Self = Self { node: Self::NOTHING, ahead: 0.0 };

    /// A node, where its phase is known and one is cast.
    #[inline(always)]
    fn of(node: u32, ahead: f32) -> Self {
        Self { node: if ahead.is_nan() { Self::NOTHING } else { node }, ahead }
    }
}

impl Witness {
    /// A witness with the phase that it has unwrapped so far.
    pub fn new(pair: &Pair, head: usize, roi: Roi, cells: Cells) -> Self {
        let middle =
            Point3::from((Vector3::from(pair.volume_min_m) + Vector3::from(pair.volume_max_m)) / 2.0);
        let from = pair.camera.centre();
        let cast = |distance: f64| {
            let at = middle + (middle - from).normalize() * distance;
            pair.projector.project(&at).map_or(0.0, |[column, _]| pair.pattern.phase(column))
        };
        let towards = (cast(0.01) - cast(-0.01)).signum() as f32;
        Self { head, roi, cells, towards }
    }

    /// What the cameras of a block have at a place, which each sees in one of `cells`; a bit for each that has to be asked
    /// [`closely`](Self::see_closely). Nothing here depends on a branch: what the next camera has is as good as chance.
    #[inline(always)]
    pub fn glance(cells: &[Glimpse; LANES], spots: &Spots, numbers: &Numbers) -> (SightLanes, u8) {
        let (mut node, mut ahead, mut ask) = ([0; LANES], [0.0; LANES], [0u32; LANES]);
        let cells = Glimpse::lanes(cells);
        for i in 0..LANES {
            let kind = cells.node[i];
            let seen = cells.phase[i] + (spots.right[i] * cells.right[i] + spots.down[i] * cells.down[i]);
            ahead[i] = seen - spots.cast[i];
            // Beside the object pixels are asked that have their columns in the middle, too: the last half is the next cell's.
            // Where no such cell is seen they are any numbers.
            let u = floor(spots.right[i] + 0.5) as u32;
            let v = floor(spots.down[i] + 0.5).max(0) as u32;
            let is_near = kind == Glimpse::NEAR;
            let pixel = v.wrapping_mul(CELL_PX as u32) | u;
            let past = is_near & (cells.near[i] >> (pixel % WORD as u32) & 1 == 0);
            let past = past | (kind == Glimpse::FAR);
            let unknown = is_near | ahead[i].is_nan() & (kind < Glimpse::RIM);
            let named = if unknown { numbers.all } else { numbers.first[i].wrapping_add(kind) };
            node[i] = if past { numbers.all + 1 } else { named };
            let is_rim = (Glimpse::RIM..Glimpse::NEAR).contains(&kind);
            ask[i] = u32::from(is_rim | is_near & (u >= CELL_PX as u32)) << i;
        }
        (SightLanes { node, ahead }, ask.iter().fold(0, |all, bit| all | bit) as u8)
    }

    /// The same at outlines and steps, where pixels have to be asked.
    pub fn see_closely(&self, spots: &Spots, i: usize) -> Sight {
        let glimpses = &self.cells.glimpses;
        let Some(rim) = glimpses.rim(glimpses.at(spots.cell[i])) else { return self.past(spots, i) };
        let right = spots.right[i];
        let whole = floor(right);
        let [u, v] = [whole, floor(spots.down[i] + 0.5)].map(|x| x.clamp(0, CELL_PX as i32 - 1) as usize);
        let pixel = v * CELL_PX + u;
        match rim.node(pixel) {
            None if rim.object >> pixel & 1 == 0 => self.past(spots, i),
            None => Sight::NONE,
            Some(node) => {
                let (here, next) = (rim.phase[v][u], rim.phase[v][u + 1]);
                let step = next - here;
                // Across a step there is nothing to interpolate; NaN is no step either.
                let step = if step.abs() < TAU / 3.0 { step } else { 0.0 };
                Sight::of(node, here + (right - whole as f32) * step - spots.cast[i])
            }
        }
    }

    /// Whether there is background around a place that is none of the object's.
    fn past(&self, spots: &Spots, i: usize) -> Sight {
        let [u, v] = [spots.right[i], spots.down[i]].map(|x| floor(x + 0.5).max(0) as usize);
        let near = self.cells.glimpses.is_near(spots.cell[i], u, v);
        Sight { node: if near { Sight::NOTHING } else { Sight::PAST }, ahead: 0.0 }
    }

    /// Whether a node whose phases are absolute after `turns` lies behind where `others` would put it.
    pub fn is_behind(&self, turns: i32, others: i32) -> bool {
        if self.towards > 0.0 { turns > others } else { turns < others }
    }

    /// 1 where what is farther away has a greater phase of its projector, -1 where it has a smaller one.
    pub fn sign(&self) -> f32 {
        if self.towards > 0.0 { 1.0 } else { -1.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::{Numbers, Sight, SightLanes, Witness};
    use crate::image::Plane;
    use crate::reconstruct::order::cells::{CELL_PX, Cells, Surface};
    use crate::reconstruct::order::glimpse::{Glimpse, PAD_PX, padded};
    use crate::reconstruct::order::lookout::{LANES, Spots};
    use crate::reconstruct::roi::Roi;
    use crate::reconstruct::runs::Runs;
    use std::f32::consts::TAU;

    const PERIOD: f32 = 10.0;

    /// Each camera's nodes by its own numbers.
    const OWN: Numbers = Numbers { first: [0; LANES], all: Sight::NOTHING };

    /// A camera that sees a plane of 50 x 40 px, all but the last four rows of it with a phase, in a region of 100 x 80.
    fn witness() -> Witness {
        let (w, h) = (100, 80);
        let (mut phase, mut object) = (Plane::filled(w, h, f32::NAN), Plane::filled(w, h, 0));
        for v in 0..40 {
            object.row_mut(v)[..50].fill(1);
            for (u, phase) in phase.row_mut(v)[..50].iter_mut().enumerate().filter(|_| v < 36) {
                *phase = u as f32 * TAU / PERIOD;
            }
        }
        let (runs, period) = (Runs::of(&object), Plane::filled(w, h, PERIOD));
        let surface = Surface { phase: &phase, period: &period, runs: &runs, sign: 1.0 };
        let roi = Roi { u: 0, v: 0, width: w, height: h };
        Witness { head: 0, roi, cells: Cells::new(&surface), towards: 1.0 }
    }

    /// What it has at a place on which a phase of 3 rad is cast.
    fn sight(witness: &Witness, x: f32, y: f32) -> Sight {
        let [column, row] = [x, y + 0.5].map(|x| (x + PAD_PX as f32) as usize / CELL_PX);
        let mut spots = Spots::NONE;
        spots.cell[5] = (row * padded(witness.roi.width) + column) as u32;
        spots.right[5] = x + PAD_PX as f32 - (column * CELL_PX) as f32;
        spots.down[5] = y + PAD_PX as f32 - (row * CELL_PX) as f32;
        spots.cast[5] = 3.0;
        let mut cells = [Glimpse::UNSEEN; LANES];
        cells[5] = *witness.cells.glimpses.at(spots.cell[5]);
        let (SightLanes { node, ahead }, ask) = Witness::glance(&cells, &spots, &OWN);
        let seen = Sight { node: node[5], ahead: ahead[5] };
        if ask >> 5 & 1 != 0 { witness.see_closely(&spots, 5) } else { seen }
    }

    #[test]
    fn a_camera_sees_its_surface_and_past_it() {
        let witness = witness();
        // Within cells that are filled, and in those on the outline.
        for (x, y) in [(3.0, 3.0), (20.25, 17.5), (47.5, 12.0), (49.0, 35.4), (48.3, 33.0)] {
            let sight = sight(&witness, x, y);
            assert!(sight.node < Sight::NOTHING, "({x}, {y})");
            assert!((sight.ahead - (x * TAU / PERIOD - 3.0)).abs() < 1e-3, "({x}, {y}): {sight:?}");
        }
        // On the object, but without a phase; beside it; and as far from it as it takes.
        for (x, y) in [(20.0, 38.0), (49.5, 36.0), (50.5, 10.0), (59.4, 30.0), (20.0, 49.4), (-10.4, 3.0)] {
            assert_eq!(sight(&witness, x, y).node, Sight::NOTHING, "({x}, {y})");
        }
        for (x, y) in [(59.6, 10.0), (55.0, 45.0), (20.0, 49.6), (-10.6, 3.0), (90.0, 70.0), (3.0, -11.0)] {
            assert_eq!(sight(&witness, x, y).node, Sight::PAST, "({x}, {y})");
        }
    }

    #[test]
    fn nothing_is_seen_beyond_the_frame() {
        let witness = witness();
        for place in [0.0, 3e38, -3e38, f32::INFINITY, f32::NAN] {
            let mut spots = Spots::NONE;
            (spots.right[2], spots.down[2], spots.cast[2]) = (place, place, place);
            let (sights, ask) = Witness::glance(&[Glimpse::UNSEEN; LANES], &spots, &OWN);
            assert!(witness.cells.glimpses.at(spots.cell[2]).phase.is_nan(), "a cell that is not seen");
            assert_eq!((sights.node[2], ask), (Sight::NOTHING, 0), "{place}");
        }
    }
}
