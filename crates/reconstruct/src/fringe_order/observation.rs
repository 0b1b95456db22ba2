// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the other cameras see at places of a view, and how its phase differs from the one expected: eight places with
//! eight cameras at once.
//!
//! All cameras photograph the same instant. A surface that one of them claims must look right to each of the others:
//! at the pixel where it would be seen there is the same surface, or something before it. Places are compared by the
//! phase of the other camera's own projector: the phase that it casts on the place against the one that is seen.
//!
//! What a camera has there lies anywhere in memory. So the cells of all cameras are loaded before anything is decided
//! by one of them, and then the pixels of those that need it: while the processor waits for one it fetches the others.

use super::lookup::{CellContent, CellLanes, CellLookup};
use super::patches::CELL_PX;
use super::projection::{InCells, LANES, Projected, Ray};
use super::scene::Scene;
use crate::kernels::fast_round::floor;
use crate::kernels::{prefetch, simd};
use std::f32::consts::TAU;
use std::hint::select_unpredictable;

/// Places of one view that are worked on at once.
pub const PLACES: usize = 8;

/// How the nodes of a block's cameras are numbered among those of all views.
#[derive(Debug, Clone, Copy)]
pub struct Numbers {
    /// Where those of each camera begin.
    pub first: [u32; LANES],
    /// How many there are of all views.
    pub all: u32,
}

impl Numbers {
    /// The number that stands for no observation.
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
pub struct Observed {
    /// The node of each there, or what stands for none, by [`Numbers`].
    pub node: [u32; LANES],
    /// The node's phase there less the one that is cast on the place, rad; any number where there is no node.
    pub ahead: [f32; LANES],
}

impl Observed {
    /// The observation before a place is looked at.
    pub const NONE: Self = Self { node: [u32::MAX; LANES], ahead: [0.0; LANES] };
}

/// The pixels of their cells that the cameras of a block would see a place at, for [`see_closely`].
#[derive(Debug, Clone, Copy, Default)]
pub struct Pixels {
    /// What each cell is: [`CellLanes::node`].
    kind: [u32; LANES],
    /// The column that the place is in or behind.
    column: [u32; LANES],
    /// How far behind that column, in columns.
    behind: [f32; LANES],
    /// The column that is nearest; that behind the cell's last is the next cell's.
    nearest: [u32; LANES],
    row: [u32; LANES],
}

/// Some views, how their patches are numbered, and their cells.
type Block<'a> = (&'a [Scene<'a>], Numbers, [&'a [CellContent]; LANES]);

/// Looks at places of one view after the other.
#[derive(Debug)]
pub struct Observations<'a> {
    scenes: &'a [Scene<'a>],
    /// The views by blocks, and how their nodes are numbered.
    blocks: Vec<Block<'a>>,
    spots: [Projected; PLACES],
    cells: [CellLanes<LANES>; PLACES],
    pixels: [Pixels; PLACES],
}

impl<'a> Observations<'a> {
    /// At what these views have.
    pub fn new(scenes: &'a [Scene<'a>]) -> Self {
        let all = scenes.iter().map(|scene| scene.patches.all.len() as u32).sum();
        let mut next = 0;
        let blocks = scenes.chunks(LANES).map(|scenes| {
            let mut numbers = Numbers { first: [0; LANES], all };
            let mut grids: [&[CellContent]; LANES] = [&[]; LANES];
            for ((first, grid), scene) in numbers.first.iter_mut().zip(&mut grids).zip(scenes) {
                *first = next;
                next += scene.patches.all.len() as u32;
                *grid = scene.patches.lookup.cells();
            }
            (scenes, numbers, grids)
        });
        Self {
            scenes,
            blocks: blocks.collect(),
            spots: [Projected::NONE; PLACES],
            cells: [CellLanes::UNSEEN; PLACES],
            pixels: [Pixels::default(); PLACES],
        }
    }

    /// What the cameras of a block have at up to [`PLACES`] places of a view. Returns the number that stands for
    /// [nothing](Numbers::nothing).
    #[inline(never)]
    pub fn at(&mut self, view: usize, block: usize, rays: &[Ray], sights: &mut [Observed; PLACES]) -> u32 {
        let Self { scenes, blocks, spots, cells, pixels } = self;
        let projection = &scenes[view].projection;
        let (scenes, numbers, grids) = &blocks[block];
        // A bit for each camera of each place.
        let mut vague = 0u64;
        simd::dispatch(
            #[inline(always)]
            || {
                projection.spots(block, rays, spots);
                for (cells, spots) in cells.iter_mut().zip(&*spots).take(rays.len()) {
                    for (i, (grid, &cell)) in grids.iter().zip(&spots.at.cell).enumerate() {
                        cells.set(i, grid.get(cell as usize).unwrap_or(&CellContent::UNSEEN));
                    }
                }
                let places = cells.iter().zip(&*spots).zip(&mut *pixels).zip(&mut *sights).enumerate();
                for (k, (((cells, spots), pixels), sight)) in places.take(rays.len()) {
                    let unclear;
                    (*sight, *pixels, unclear) = glance(cells, spots, numbers);
                    vague |= u64::from(unclear) << (k * LANES);
                }
            },
        );
        let mut soon = vague;
        while soon != 0 {
            let bit = soon.trailing_zeros() as usize;
            let (k, i) = (bit / LANES, bit % LANES);
            expect(&scenes[i].patches.lookup, &pixels[k], i);
            soon &= soon - 1;
        }
        while vague != 0 {
            let bit = vague.trailing_zeros() as usize;
            let (k, i) = (bit / LANES, bit % LANES);
            let (lookup, pixels, spots) = (&scenes[i].patches.lookup, &pixels[k], &spots[k]);
            let beyond = || (past(lookup, spots.at.cell[i], pixels, i, numbers), 0.0);
            let seen = see_closely(lookup, pixels, i, spots.cast[i], numbers).unwrap_or_else(beyond);
            (sights[k].node[i], sights[k].ahead[i]) = seen;
            vague &= vague - 1;
        }
        numbers.nothing()
    }
}

/// What the cameras of a block have at a place, which each sees in one of `cells`; which pixels these are; and a bit
/// for each camera whose cell does not suffice, so that [`see_closely`] decides. Nothing here depends on a branch: no
/// branch could be predicted.
#[inline(always)]
fn glance(cells: &CellLanes<LANES>, spots: &Projected, numbers: &Numbers) -> (Observed, Pixels, u32) {
    // Values that may be written meanwhile would be loaded where they are chosen, by a branch.
    let (Numbers { first, .. }, Projected { at: InCells { right, down, .. }, cast }) = (*numbers, *spots);
    let (nothing, past) = (numbers.nothing(), numbers.past());
    let (mut sights, mut pixels, mut unclear) = (Observed::NONE, Pixels::default(), [0u32; LANES]);
    for i in 0..LANES {
        let kind = cells.node(i);
        let ahead = cells.phase(i, right[i], down[i]) - cast[i];
        // Beside the object the nearest pixel decides, along columns too: the last half column is the next cell's.
        // Where no such cell is seen they are any numbers.
        let column = floor(right[i]);
        let nearest = floor(right[i] + 0.5) as u32;
        let row = floor(down[i] + 0.5).max(0) as u32;
        let is_near = kind == CellContent::NEAR;
        let is_past = is_near & !cells.is_near(i, nearest, row) | (kind == CellContent::FAR);
        // Cells of no node have no phase. Where the cell does not suffice, this is any number.
        let node = if ahead.is_nan() { nothing } else { first[i].wrapping_add(kind) };
        sights.node[i] = if is_past { past } else { node };
        sights.ahead[i] = ahead;
        let is_rim = (CellContent::RIM..CellContent::NEAR).contains(&kind);
        unclear[i] = u32::from(is_rim | is_near & (nearest >= CELL_PX as u32)) << i;
        pixels.kind[i] = kind;
        pixels.column[i] = column as u32;
        pixels.behind[i] = right[i] - column as f32;
        pixels.nearest[i] = nearest;
        pixels.row[i] = row;
    }
    (sights, pixels, unclear.iter().fold(0, |all, bit| all | bit))
}

/// Prefetches the memory that [`see_closely`] will read.
#[inline(always)]
fn expect(lookup: &CellLookup, pixels: &Pixels, i: usize) {
    if let Some(row) = lookup.rim(pixels.kind[i], pixels.row[i] as usize) {
        prefetch::line(row);
    }
}

/// The same for one camera at outlines and steps, by the pixels themselves. `cast`: the phase that is cast on the
/// place. There is no branch that depends on the pixel: no place may hold up the next while it waits for memory.
#[inline(always)]
fn see_closely(
    lookup: &CellLookup,
    pixels: &Pixels,
    i: usize,
    cast: f32,
    numbers: &Numbers,
) -> Option<(u32, f32)> {
    let [column, row] = [pixels.column[i] as usize % CELL_PX, pixels.row[i] as usize];
    let rim = lookup.rim(pixels.kind[i], row)?;
    let (of, here, next) = (rim.of[column], rim.phase[column], rim.phase[column + 1]);
    let (near, named) = (rim.is_near(pixels.nearest[i]), numbers.first[i].wrapping_add(rim.node(of)));
    let is_beside = (of == 0) & !rim.is_object(column);
    // This is rare, so that the branch is predicted well.
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

/// What a camera has at a place in a cell's last column that is not the object's: the next cell decides whether there
/// is background.
fn past(lookup: &CellLookup, cell: u32, pixels: &Pixels, i: usize, numbers: &Numbers) -> u32 {
    let [u, v] = [pixels.nearest[i], pixels.row[i]].map(|x| x as usize);
    let near = lookup.is_near(cell, u, v);
    if near { numbers.nothing() } else { numbers.past() }
}

#[cfg(test)]
mod tests {
    use super::{Numbers, Observed, glance, past, see_closely};
    use crate::base::image::Plane;
    use crate::fringe_order::lookup::{CellLanes, PAD_PX, padded};
    use crate::fringe_order::patches::{CELL_PX, Patches, Surface};
    use crate::fringe_order::projection::{LANES, Projected};
    use crate::kernels::pixel_runs::Runs;
    use std::f32::consts::TAU;

    const PERIOD: f32 = 10.0;

    /// Each camera's nodes by its own numbers.
    const OWN: Numbers = Numbers { first: [0; LANES], all: 1 << 20 };

    /// A camera that sees a plane of 50 x 40 px, all but the last four rows of it with a phase, in a region of 100 x
    /// 80.
    fn view() -> Patches {
        let (w, h) = (100, 80);
        let (mut phase, mut object) = (Plane::filled(w, h, f32::NAN), Plane::filled(w, h, 0));
        for v in 0..40 {
            object.row_mut(v)[..50].fill(1);
            for (u, phase) in phase.row_mut(v)[..50].iter_mut().enumerate().filter(|_| v < 36) {
                *phase = u as f32 * TAU / PERIOD;
            }
        }
        let (runs, period) = (Runs::of(&object), Plane::filled(w, h, PERIOD));
        Patches::cut(&mut Surface { phase: &mut phase, period: &period, object: &runs, sign: 1.0 })
    }

    /// What it has at a place on which a phase of 3 rad is cast.
    fn sight(view: &Patches, x: f32, y: f32) -> (u32, f32) {
        let [column, row] = [x, y + 0.5].map(|x| (x + PAD_PX as f32) as usize / CELL_PX);
        let mut spots = Projected::NONE;
        spots.at.cell[5] = (row * padded(view.width) + column) as u32;
        spots.at.right[5] = x + PAD_PX as f32 - (column * CELL_PX) as f32;
        spots.at.down[5] = y + PAD_PX as f32 - (row * CELL_PX) as f32;
        spots.cast[5] = 3.0;
        let mut cells = CellLanes::UNSEEN;
        cells.set(5, view.lookup.at(spots.at.cell[5]));
        let (Observed { node, ahead }, pixels, unclear) = glance(&cells, &spots, &OWN);
        if unclear >> 5 & 1 == 0 {
            return (node[5], ahead[5]);
        }
        let past = || (past(&view.lookup, spots.at.cell[5], &pixels, 5, &OWN), 0.0);
        see_closely(&view.lookup, &pixels, 5, spots.cast[5], &OWN).unwrap_or_else(past)
    }

    #[test]
    fn a_camera_sees_its_surface_and_past_it() {
        let view = view();
        // Within cells that are filled, and in those on the outline.
        for (x, y) in [(3.0, 3.0), (20.25, 17.5), (47.5, 12.0), (49.0, 35.4), (48.3, 33.0)] {
            let (node, ahead) = sight(&view, x, y);
            assert!(node < OWN.nothing(), "({x}, {y})");
            // Phases are unwrapped within their cell.
            let turns = (ahead - (x * TAU / PERIOD - 3.0)) / TAU;
            assert!((turns - turns.round()).abs() < 1e-3, "({x}, {y}): {ahead}");
        }
        // On the object, but without a phase; beside it; and as far from it as it takes.
        for (x, y) in [(20.0, 38.0), (49.5, 36.0), (50.5, 10.0), (59.4, 30.0), (20.0, 49.4), (-10.4, 3.0)] {
            assert_eq!(sight(&view, x, y).0, OWN.nothing(), "({x}, {y})");
        }
        for (x, y) in [(59.6, 10.0), (55.0, 45.0), (20.0, 49.6), (-10.6, 3.0), (90.0, 70.0), (3.0, -11.0)] {
            assert_eq!(sight(&view, x, y).0, OWN.past(), "({x}, {y})");
        }
    }

    #[test]
    fn nothing_is_seen_beyond_the_frame() {
        let view = view();
        for place in [0.0, 3e38, -3e38, f32::INFINITY, f32::NAN] {
            let mut spots = Projected::NONE;
            (spots.at.right[2], spots.at.down[2], spots.cast[2]) = (place, place, place);
            let mut cells = CellLanes::UNSEEN;
            cells.set(2, view.lookup.at(spots.at.cell[2]));
            let (sights, _, unclear) = glance(&cells, &spots, &OWN);
            assert_eq!((sights.node[2], unclear), (OWN.nothing(), 0), "{place}");
        }
    }
}
