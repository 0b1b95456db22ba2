// SPDX-License-Identifier: MIT OR Apache-2.0
//! Where patches touch, by how many whole turns their phases differ, and how surely they are one surface.
//!
//! Two whole cells are planes: how these meet at their border separates one surface from two that touch by chance.
//! Other patches are compared pixel by pixel.

use super::lookup::Plane;
use super::patches::{ALL, CELL_PX, FIRST_COLUMN, FIRST_ROW, Patches, Spot, Surface};
use std::f32::consts::TAU;

/// Weight in the energy of the logarithm of the likelihood that two planes are one surface.
const PLANES: f32 = 1.5;

/// Scale of the step between two planes of one surface, rad.
const STEP_RAD: f32 = 0.02;

/// Scales of the bend from one plane to the next, rad: along the rows and across them, each of one surface and of two.
const BENDS_RAD: [[f32; 2]; 2] = [[0.1, 0.8], [0.2, 0.6]];

/// Weight in the energy of the mean logarithm of the likelihood of a border's pixel pairs.
const PAIR: f32 = 0.6;

/// Scale of the step between two pixels of one surface beyond what their patches' own slopes predict, rad.
const PAIR_RAD: f32 = 0.05;

/// The last column of a cell's bits.
const LAST_COLUMN: u64 = FIRST_COLUMN << (CELL_PX - 1);

/// Two patches that are one surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Link {
    /// The number of one patch.
    pub a: u32,
    /// The number of the other patch, which is larger.
    pub b: u32,
    /// Whole turns to add to the phases of `b` so that they continue those of `a`.
    pub turns: i32,
    /// What it costs that they are not one surface.
    pub weight: f32,
}

/// Two patches, turns, the pixel pairs that are nearest to these, and the logarithm of how much likelier they are one
/// surface than two.
pub(super) type Pairs = (u32, u32, i32, u32, f32);

impl Patches {
    /// The links between the patches of one cell, and to those of the cells to the right and below. `found` is room to
    /// count in.
    #[inline(always)]
    pub(super) fn link_cell(
        &mut self,
        surface: &Surface<'_>,
        column: usize,
        row: usize,
        found: &mut Vec<Pairs>,
    ) {
        let place = row * self.columns + column;
        let spot = self.grid[place];
        if spot.count == 0 {
            return;
        }
        let beside = if column + 1 < self.columns { self.grid[place + 1] } else { Spot::default() };
        let below = self.grid.get(place + self.columns).copied().unwrap_or_default();
        let is_whole = |spot: &Spot| spot.count == 1 && self.all[spot.first as usize].mask == ALL;
        let whole = is_whole(&spot);
        let touch = [beside, below].map(|other| other.count > 0 && !(whole && is_whole(&other)));
        for (across, other) in [beside, below].into_iter().enumerate() {
            if other.count > 0 && !touch[across] {
                let planes =
                    [self.lookup.plane(column, row), self.lookup.plane(column + 1 - across, row + across)];
                let (turns, weight) = meeting(planes, across);
                if weight > 0.0 {
                    self.links.push(Link { a: spot.first, b: other.first, turns, weight });
                }
            }
        }
        if spot.count > 1 || touch[0] || touch[1] {
            self.link_pixels(surface, (column, row), [beside, below], touch, found);
        }
    }

    /// The same where a cell has several patches, or patches with holes.
    #[inline(never)]
    fn link_pixels(
        &mut self,
        surface: &Surface<'_>,
        (column, row): (usize, usize),
        [beside, below]: [Spot; 2],
        touch: [bool; 2],
        found: &mut Vec<Pairs>,
    ) {
        let patches = |spot: Spot| spot.first..spot.first + spot.count;
        found.clear();
        let own = self.grid[row * self.columns + column];
        for a in patches(own) {
            let mask = self.all[a as usize].mask;
            let at = (column * CELL_PX, row * CELL_PX);
            let mut touches = |b, right, down| {
                for (down, pixels) in [(false, right), (true, down)] {
                    self.pairs(surface, at, (a, b), down, pixels, found);
                }
            };
            for b in patches(own).filter(|b| *b != a) {
                let other = self.all[b as usize].mask;
                touches(b, mask & other >> 1 & !LAST_COLUMN, mask & other >> CELL_PX);
            }
            for b in patches(beside).filter(|_| touch[0]) {
                let other = self.all[b as usize].mask & FIRST_COLUMN;
                touches(b, mask & other << (CELL_PX - 1), 0);
            }
            for b in patches(below).filter(|_| touch[1]) {
                let other = self.all[b as usize].mask & FIRST_ROW;
                touches(b, 0, mask & other << (CELL_PX * (CELL_PX - 1)));
            }
        }
        found.sort_unstable_by_key(|x| (x.0, x.1, x.2));
        let apart = likelier(std::f32::consts::PI, PAIR_RAD).ln();
        for pair in found.chunk_by(|x, y| (x.0, x.1) == (y.0, y.1)) {
            let all: u32 = pair.iter().map(|x| x.3).sum();
            let of = |x: &Pairs| PAIR * (x.4 + apart * (all - x.3) as f32) / all as f32;
            let best = pair.iter().max_by(|x, y| of(x).total_cmp(&of(y)));
            if let Some(best) = best.filter(|x| of(x) > 0.0) {
                self.links.push(Link { a: best.0, b: best.1, turns: best.2, weight: of(best) });
            }
        }
    }

    /// Adds the likelihoods of the pixel pairs of two patches. `pixels` are those of the first, in the cell that
    /// begins at `at`, which have one of the second to their right or below them.
    #[inline(always)]
    fn pairs(
        &self,
        surface: &Surface<'_>,
        at: (usize, usize),
        (a, b): (u32, u32),
        down: bool,
        mut pixels: u64,
        found: &mut Vec<Pairs>,
    ) {
        if pixels == 0 {
            return;
        }
        let steps = [a, b].map(|i| self.all[i as usize].steps[usize::from(down)]);
        let mean = (steps[0] + steps[1]) / 2.0;
        let (first, second) = (a.min(b), a.max(b));
        while pixels != 0 {
            let pixel = pixels.trailing_zeros() as usize;
            pixels &= pixels - 1;
            let (u, v) = (at.0 + pixel % CELL_PX, at.1 + pixel / CELL_PX);
            let (x, y) = if down { (u, v + 1) } else { (u + 1, v) };
            let expected = if down { mean } else { surface.carrier(u, v) + mean };
            let rest = surface.phase.at(x, y) - surface.phase.at(u, v) - expected;
            let turns = -(rest / TAU).round();
            let likelier = likelier(rest + turns * TAU, PAIR_RAD).ln();
            let turns = if a < b { turns as i32 } else { -turns as i32 };
            match found.iter_mut().find(|x| (x.0, x.1, x.2) == (first, second, turns)) {
                Some(x) => (x.3, x.4) = (x.3 + 1, x.4 + likelier),
                None => found.push((first, second, turns, 1, likelier)),
            }
        }
    }
}

impl Surface<'_> {
    /// The step that the period predicts between a pixel and the next in its row, rad.
    #[inline(always)]
    fn carrier(&self, u: usize, v: usize) -> f32 {
        self.sign * 2.0 * TAU / (self.period.at(u, v) + self.period.at(u + 1, v))
    }
}

/// How the planes of a cell and of that beside it, or below it if `across` is 1, meet: turns, and the logarithm of how
/// much likelier they are one surface than two.
#[inline(always)]
fn meeting([a, b]: [Plane; 2], across: usize) -> (i32, f32) {
    // Half way between the last pixel of one cell and the first of the other, in the middle of the border.
    const MIDDLE: f32 = (CELL_PX - 1) as f32 / 2.0;
    /// From a cell's first pixel to the border behind its last one, px.
    const EDGE: f32 = CELL_PX as f32 - 0.5;
    let at = |plane: &Plane, border: f32| {
        let other = plane.steps[1 - across];
        plane.phase + border * plane.steps[across] + MIDDLE * other
    };
    let step = at(&b, EDGE - CELL_PX as f32) - at(&a, EDGE);
    let turns = -(step / TAU).round();
    let step = step + turns * TAU;
    let bend = |i: usize| CELL_PX as f32 * (b.steps[i] - a.steps[i]);
    let ratio =
        |x: f32, [same, other]: [f32; 2]| same * (other * other + x * x) / (other * (same * same + x * x));
    let likelier = likelier(step, STEP_RAD) * ratio(bend(0), BENDS_RAD[0]) * ratio(bend(1), BENDS_RAD[1]);
    (turns as i32, PLANES * likelier.ln())
}

/// How much likelier a step is on one surface than between two: a Cauchy distribution of that scale against a uniform
/// one.
#[inline(always)]
fn likelier(step: f32, scale: f32) -> f32 {
    2.0 * scale / (scale * scale + step * step)
}
