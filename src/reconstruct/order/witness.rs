//! What the other cameras say about a place in space.
//!
//! All cameras photograph the same instant. A surface that one of them claims must look right to each of the others: at
//! the pixel where it would be seen there is the same surface, or something before it. A claimed surface that stands
//! before what another camera sees there, or where that camera looks past the body, is not there. Places are compared by
//! the phase of the other camera's own projector: the phase that it casts on the place against the one that is seen.

use super::cells::{CELL_PX, Cells};
use super::glimpse::{Glimpse, GlimpseLanes};
use super::lookout::{LANES, Spots};
use crate::reconstruct::pair::Pair;
use crate::reconstruct::prefetch;
use crate::reconstruct::roi::Roi;
use crate::reconstruct::round::floor;
use nalgebra::{Point3, Vector3};
use std::f32::consts::TAU;
use std::hint::select_unpredictable;

/// Phases of the same surface differ by less for the cameras of one head, rad: 2 mm. Where an order is right they differ by less than 0.1 rad
/// nearly everywhere, where two surfaces agree by chance, by anything (`docs/design/reconstruction-experiments.md`, "How near cameras
/// must agree").
pub const SAME_RAD: f32 = 0.35;

/// The same for a camera of another head, which is calibrated less closely with this one, and sees most of what both see from the
/// side: 3 mm.
pub const SAME_ELSEWHERE_RAD: f32 = 0.5;

/// Phases of different surfaces differ by more, rad; what lies between says nothing.
pub const OTHER_RAD: f32 = 1.2;

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
    /// How many there are of all views.
    pub all: u32,
}

impl Numbers {
    /// The number that stands for nothing that could be said.
    #[inline(always)]
    pub fn nothing(&self) -> u32 {
        self.all
    }

    /// The number that stands for a look past the object.
    #[inline(always)]
    pub fn past(&self) -> u32 {
        self.all + 1
    }
}

/// What the cameras of a block have at the pixels where they would see a place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SightLanes {
    /// The node of each there, or what stands for none, by [`Numbers`].
    pub node: [u32; LANES],
    /// The node's phase there less the one that is cast on the place, rad; any number where there is no node.
    pub ahead: [f32; LANES],
}

impl SightLanes {
    /// Of a place that was not looked at.
    pub const NONE: Self = Self { node: [u32::MAX; LANES], ahead: [0.0; LANES] };
}

/// Which pixels of their cells the cameras of a block have to be asked for, where they have to be asked closely.
#[derive(Debug, Clone, Copy)]
pub struct Pixels {
    /// What each cell is: [`GlimpseLanes::node`].
    kind: [u32; LANES],
    /// The column that the place is in or behind.
    column: [u32; LANES],
    /// How far behind, columns.
    behind: [f32; LANES],
    /// The column that is nearest; that behind the cell's last is the next cell's.
    nearest: [u32; LANES],
    row: [u32; LANES],
}

impl Pixels {
    /// None yet.
    pub const NONE: Self = Self {
        kind: [0; LANES],
        column: [0; LANES],
        behind: [0.0; LANES],
        nearest: [0; LANES],
        row: [0; LANES],
    };
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

    /// What the cameras of a block have at a place, which each sees in one of `cells`; which pixels these are; a bit for each that has to
    /// be asked [`closely`](Self::see_closely) for them. Nothing here depends on a branch: what the next camera has is as good as chance.
    #[inline(always)]
    pub fn glance(
        cells: &GlimpseLanes<LANES>,
        spots: &Spots,
        numbers: &Numbers,
    ) -> (SightLanes, Pixels, u32) {
        // Values that may be written meanwhile would be loaded where they are chosen, by a branch.
        let (Numbers { first, .. }, Spots { right, down, cast, .. }) = (*numbers, *spots);
        let (nothing, past) = (numbers.nothing(), numbers.past());
        let (mut sights, mut pixels, mut ask) = (SightLanes::NONE, Pixels::NONE, [0u32; LANES]);
        for i in 0..LANES {
            let kind = cells.node(i);
            let ahead = cells.phase(i, right[i], down[i]) - cast[i];
            // Beside the object pixels are asked that have their columns in the middle, too: the last half is the next cell's.
            // Where no such cell is seen they are any numbers.
            let column = floor(right[i]);
            let nearest = floor(right[i] + 0.5) as u32;
            let row = floor(down[i] + 0.5).max(0) as u32;
            let is_near = kind == Glimpse::NEAR;
            let is_past = is_near & !cells.is_near(i, nearest, row) | (kind == Glimpse::FAR);
            // Cells of no node have no phase. What has to be asked is any number.
            let node = if ahead.is_nan() { nothing } else { first[i].wrapping_add(kind) };
            sights.node[i] = if is_past { past } else { node };
            sights.ahead[i] = ahead;
            let is_rim = (Glimpse::RIM..Glimpse::NEAR).contains(&kind);
            ask[i] = u32::from(is_rim | is_near & (nearest >= CELL_PX as u32)) << i;
            pixels.kind[i] = kind;
            pixels.column[i] = column as u32;
            pixels.behind[i] = right[i] - column as f32;
            pixels.nearest[i] = nearest;
            pixels.row[i] = row;
        }
        (sights, pixels, ask.iter().fold(0, |all, bit| all | bit))
    }

    /// Asks for the memory that [`Self::see_closely`] will look at.
    #[inline(always)]
    pub fn expect(&self, pixels: &Pixels, i: usize) {
        if let Some(row) = self.cells.glimpses.rim(pixels.kind[i], pixels.row[i] as usize) {
            prefetch::line(row);
        }
    }

    /// The same of one camera at outlines and steps, where pixels have to be asked. `cast`: the phase that is cast on the place. What is
    /// there is as good as chance, too: no place may hold up the next while it waits for memory.
    #[inline(always)]
    pub fn see_closely(&self, pixels: &Pixels, i: usize, cast: f32, numbers: &Numbers) -> Option<(u32, f32)> {
        let [column, row] = [pixels.column[i] as usize % CELL_PX, pixels.row[i] as usize];
        let rim = self.cells.glimpses.rim(pixels.kind[i], row)?;
        let (of, here, next) = (rim.of[column], rim.phase[column], rim.phase[column + 1]);
        let (near, named) = (rim.is_near(pixels.nearest[i]), numbers.first[i].wrapping_add(rim.node(of)));
        let is_beside = (of == 0) & !rim.is_object(column);
        // What is rare is asked first: it can be told beforehand.
        if pixels.nearest[i] >= CELL_PX as u32 && is_beside {
            return None;
        }
        let step = next - here;
        // Across a step there is nothing to interpolate; NaN is no step either.
        let step = if step.abs() < TAU / 3.0 { step } else { 0.0 };
        let ahead = here + pixels.behind[i] * step - cast;
        let none = if is_beside & !near { numbers.past() } else { numbers.nothing() };
        Some((select_unpredictable((of == 0) | ahead.is_nan(), none, named), ahead))
    }

    /// What it has at a place in a cell's last column, none of the object's, where the next cell has to be asked whether there is
    /// background.
    pub fn past(&self, cell: u32, pixels: &Pixels, i: usize, numbers: &Numbers) -> u32 {
        let [u, v] = [pixels.nearest[i], pixels.row[i]].map(|x| x as usize);
        let near = self.cells.glimpses.is_near(cell, u, v);
        if near { numbers.nothing() } else { numbers.past() }
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
    use super::{Numbers, SightLanes, Witness};
    use crate::image::Plane;
    use crate::reconstruct::order::cells::{CELL_PX, Cells, Surface};
    use crate::reconstruct::order::glimpse::{GlimpseLanes, PAD_PX, padded};
    use crate::reconstruct::order::lookout::{LANES, Spots};
    use crate::reconstruct::roi::Roi;
    use crate::reconstruct::runs::Runs;
    use std::f32::consts::TAU;

    const PERIOD: f32 = 10.0;

    /// Each camera's nodes by its own numbers.
    const OWN: Numbers = Numbers { first: [0; LANES], all: 1 << 20 };

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
        let surface = Surface { phase: &phase, period: &period, runs: &runs, sign: 1.0, sensor_rows: 1.0 };
        let roi = Roi { u: 0, v: 0, width: w, height: h };
        Witness { head: 0, roi, cells: Cells::new(&surface), towards: 1.0 }
    }

    /// What it has at a place on which a phase of 3 rad is cast.
    fn sight(witness: &Witness, x: f32, y: f32) -> (u32, f32) {
        let [column, row] = [x, y + 0.5].map(|x| (x + PAD_PX as f32) as usize / CELL_PX);
        let mut spots = Spots::NONE;
        spots.cell[5] = (row * padded(witness.roi.width) + column) as u32;
        spots.right[5] = x + PAD_PX as f32 - (column * CELL_PX) as f32;
        spots.down[5] = y + PAD_PX as f32 - (row * CELL_PX) as f32;
        spots.cast[5] = 3.0;
        let mut cells = GlimpseLanes::UNSEEN;
        cells.set(5, witness.cells.glimpses.at(spots.cell[5]));
        let (SightLanes { node, ahead }, pixels, ask) = Witness::glance(&cells, &spots, &OWN);
        if ask >> 5 & 1 == 0 {
            return (node[5], ahead[5]);
        }
        let past = || (witness.past(spots.cell[5], &pixels, 5, &OWN), 0.0);
        witness.see_closely(&pixels, 5, spots.cast[5], &OWN).unwrap_or_else(past)
    }

    #[test]
    fn a_camera_sees_its_surface_and_past_it() {
        let witness = witness();
        // Within cells that are filled, and in those on the outline.
        for (x, y) in [(3.0, 3.0), (20.25, 17.5), (47.5, 12.0), (49.0, 35.4), (48.3, 33.0)] {
            let (node, ahead) = sight(&witness, x, y);
            assert!(node < OWN.nothing(), "({x}, {y})");
            assert!((ahead - (x * TAU / PERIOD - 3.0)).abs() < 1e-3, "({x}, {y}): {ahead}");
        }
        // On the object, but without a phase; beside it; and as far from it as it takes.
        for (x, y) in [(20.0, 38.0), (49.5, 36.0), (50.5, 10.0), (59.4, 30.0), (20.0, 49.4), (-10.4, 3.0)] {
            assert_eq!(sight(&witness, x, y).0, OWN.nothing(), "({x}, {y})");
        }
        for (x, y) in [(59.6, 10.0), (55.0, 45.0), (20.0, 49.6), (-10.6, 3.0), (90.0, 70.0), (3.0, -11.0)] {
            assert_eq!(sight(&witness, x, y).0, OWN.past(), "({x}, {y})");
        }
    }

    #[test]
    fn nothing_is_seen_beyond_the_frame() {
        let witness = witness();
        for place in [0.0, 3e38, -3e38, f32::INFINITY, f32::NAN] {
            let mut spots = Spots::NONE;
            (spots.right[2], spots.down[2], spots.cast[2]) = (place, place, place);
            let mut cells = GlimpseLanes::UNSEEN;
            cells.set(2, witness.cells.glimpses.at(spots.cell[2]));
            let (sights, _, ask) = Witness::glance(&cells, &spots, &OWN);
            assert_eq!((sights.node[2], ask), (OWN.nothing(), 0), "{place}");
        }
    }
}
