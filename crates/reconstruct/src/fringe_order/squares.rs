// SPDX-License-Identifier: MIT OR Apache-2.0
//! The nodes of the graph: squares of whole cells that surely are one surface, and all other patches alone.
//!
//! Most of a body is smooth. Cells that continue each other in all directions have one answer, and are asked for it
//! once.

use super::links::Link;
use super::patches::{ALL, Patches};

/// Cells along the sides of squares, the largest first; what fits into none is a node by itself.
const SIDES: [usize; 2] = [4, 2];

/// The least weight of the links within a square.
const STRONG: f32 = 5.0;

/// A node of the graph.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Square {
    /// The patch that stands for it, its first.
    pub patch: u32,
    /// How many cells lie along its side.
    pub side: u32,
}

/// Which node each patch of a view belongs to.
#[derive(Debug)]
pub struct Squares {
    /// The nodes, in the order of their first patches.
    pub all: Vec<Square>,
    /// The node of each patch.
    pub of: Vec<u32>,
    /// By how much the label of each patch exceeds that of its node.
    pub ahead: Vec<i32>,
}

impl Squares {
    /// Squares where every patch is a node by itself.
    pub fn single(n: usize) -> Self {
        let all = (0..n as u32).map(|patch| Square { patch, side: 1 }).collect();
        Self { all, of: (0..n as u32).collect(), ahead: vec![0; n] }
    }

    /// The squares of a view's patches. `links` have the turns between the patches' labels.
    pub fn of(patches: &Patches, links: &[Link]) -> Self {
        let n = patches.all.len();
        let mut squares = Self { all: Vec::with_capacity(n), of: vec![u32::MAX; n], ahead: vec![0; n] };
        let next = Continuations::of(patches, links);
        let mut members = Vec::with_capacity(SIDES[0] * SIDES[0]);
        for i in 0..n {
            if squares.of[i] != u32::MAX {
                continue;
            }
            let side = SIDES.into_iter().find(|&side| next.square(patches, i, side, &mut members).is_some());
            if side.is_none() {
                members.clear();
                members.push((i as u32, 0));
            }
            let side = side.unwrap_or(1);
            for &(member, ahead) in &members {
                squares.of[member as usize] = squares.all.len() as u32;
                squares.ahead[member as usize] = ahead;
            }
            squares.all.push(Square { patch: i as u32, side: side as u32 });
        }
        squares
    }

    /// The patches of a node that are compared with other cameras, every `step`-th along rows and columns.
    pub fn samples<'a>(
        &self,
        node: usize,
        patches: &'a Patches,
        step: usize,
    ) -> impl ExactSizeIterator<Item = usize> + use<'a> {
        let Square { patch, side } = self.all[node];
        let cell = patches.all[patch as usize].cell as usize;
        let along = (side as usize).div_ceil(step);
        (0..along * along).map(move |k| match k {
            0 => patch as usize,
            _ => patches.grid[cell + step * (k / along * patches.columns + k % along)].first as usize,
        })
    }

    /// The links between nodes: those of the same turns between the same nodes are one, of the sum of their weights.
    pub fn between(&self, links: &[Link]) -> Vec<Link> {
        let outer = links.iter().filter_map(|link| {
            let [a, b] = [link.a, link.b].map(|i| self.of[i as usize]);
            let turns = link.turns + self.ahead[link.a as usize] - self.ahead[link.b as usize];
            match a.cmp(&b) {
                std::cmp::Ordering::Less => Some(Link { a, b, turns, ..*link }),
                std::cmp::Ordering::Equal => None,
                std::cmp::Ordering::Greater => Some(Link { a: b, b: a, turns: -turns, ..*link }),
            }
        });
        let outer: Vec<Link> = outer.collect();
        // By the first node; those of one stay in their order.
        let mut place = vec![0u32; self.all.len() + 1];
        outer.iter().for_each(|link| place[link.a as usize + 1] += 1);
        (0..self.all.len()).for_each(|i| place[i + 1] += place[i]);
        let mut sorted = vec![Link { a: 0, b: 0, turns: 0, weight: 0.0 }; outer.len()];
        for link in outer {
            sorted[place[link.a as usize] as usize] = link;
            place[link.a as usize] += 1;
        }
        let (mut out, mut first): (Vec<Link>, usize) = (Vec::with_capacity(sorted.len()), 0);
        for link in sorted {
            if out.get(first).is_some_and(|known| known.a != link.a) {
                first = out.len();
            }
            match out[first..].iter_mut().find(|known| (known.b, known.turns) == (link.b, link.turns)) {
                Some(known) => known.weight += link.weight,
                None => out.push(link),
            }
        }
        out
    }
}

/// For each patch that fills its cell, the turns to the one on its right and to the one below, where these surely
/// continue it.
struct Continuations(Vec<[Option<i32>; 2]>);

impl Continuations {
    fn of(patches: &Patches, links: &[Link]) -> Self {
        let mut next = vec![[None; 2]; patches.all.len()];
        for link in links.iter().filter(|link| link.weight >= STRONG) {
            let [a, b] = [link.a, link.b].map(|i| &patches.all[i as usize]);
            if a.mask == ALL && b.mask == ALL {
                next[link.a as usize][usize::from(b.cell != a.cell + 1)] = Some(link.turns);
            }
        }
        Self(next)
    }

    /// The square that begins with patch `first`, if it surely is one surface all around. `members` become its patches,
    /// row by row, with their labels less the first one's.
    fn square(
        &self,
        patches: &Patches,
        first: usize,
        side: usize,
        members: &mut Vec<(u32, i32)>,
    ) -> Option<()> {
        let cell = patches.all[first].cell as usize;
        let (column, row) = (cell % patches.columns, cell / patches.columns);
        let rows = patches.grid.len() / patches.columns;
        if column % side != 0 || row % side != 0 || column + side > patches.columns || row + side > rows {
            return None;
        }
        members.clear();
        members.push((first as u32, 0));
        for k in 1..side * side {
            let (x, y) = (k % side, k / side);
            let label = |by: usize, axis: usize| {
                let (from, label): (u32, i32) = members[k - by];
                self.0[from as usize][axis].map(|turns| label + turns)
            };
            let left = if x > 0 { Some(label(1, 0)?) } else { None };
            let above = if y > 0 { Some(label(side, 1)?) } else { None };
            if left.zip(above).is_some_and(|(left, above)| left != above) {
                return None;
            }
            members.push((patches.grid[cell + y * patches.columns + x].first, left.or(above)?));
        }
        Some(())
    }
}

#[cfg(test)]
mod tests {
    use super::{Square, Squares};
    use crate::base::image::Plane;
    use crate::fringe_order::patches::{Patches, Surface};
    use crate::kernels::pixel_runs::Runs;
    use std::f32::consts::TAU;

    const PERIOD: f32 = 10.0;

    /// 64 x 64 px of a plane whose right half is `step` rad ahead.
    fn patches(step: f32) -> Patches {
        let (w, h) = (64, 64);
        let mut phase = Plane::filled(w, h, 0f32);
        for v in 0..h {
            for (u, phase) in phase.row_mut(v).iter_mut().enumerate() {
                let at = u as f32 * TAU / PERIOD + if u < 32 { 0.0 } else { step };
                *phase = at - TAU * (at / TAU).round();
            }
        }
        let (runs, period) = (Runs::of(&Plane::filled(w, h, 1)), Plane::filled(w, h, PERIOD));
        Patches::cut(&mut Surface { phase: &mut phase, period: &period, object: &runs, sign: 1.0 })
    }

    #[test]
    fn a_smooth_surface_is_four_squares_whose_labels_continue_each_other() {
        let patches = patches(0.0);
        let squares = Squares::of(&patches, &patches.links);
        assert_eq!(squares.all.len(), 4, "{:?}", squares.all);
        assert!(squares.all.iter().all(|square| square.side == 4));
        let of: Vec<u32> = squares.all.iter().map(|square| patches.all[square.patch as usize].cell).collect();
        assert_eq!(of, [0, 4, 32, 36], "the first cell stands for a square");
        let samples: Vec<u32> = squares.samples(3, &patches, 2).map(|i| patches.all[i].cell).collect();
        assert_eq!(samples, [36, 38, 52, 54]);
        let links = squares.between(&patches.links);
        let ends: Vec<(u32, u32)> = links.iter().map(|link| (link.a, link.b)).collect();
        assert_eq!(ends, [(0, 1), (0, 2), (1, 3), (2, 3)]);
        let inner =
            patches.links.iter().filter(|link| link.weight > 5.0).map(|link| link.weight).fold(0.0, f32::max);
        assert!(links.iter().all(|link| link.weight > 2.0 * inner), "four links are one: {links:?}");
        // Phases with the turns of their nodes are one plane.
        for (i, patch) in patches.all.iter().enumerate() {
            let node = squares.of[i] as usize;
            let square = squares.all[node];
            let (own, its) = (patch, &patches.all[square.patch as usize]);
            let off = own.phase + TAU * squares.ahead[i] as f32 - its.phase;
            let columns = (own.pixel % 64) as f32 - (its.pixel % 64) as f32;
            assert!((off - columns * TAU / PERIOD).abs() < 0.01, "patch {i}: {off}");
        }
    }

    #[test]
    fn a_step_parts_squares() {
        let patches = patches(1.5);
        let squares = Squares::of(&patches, &patches.links);
        assert_eq!(
            squares.all.iter().filter(|square| square.side == 4).count(),
            4,
            "the step is between squares"
        );
        let shifted = {
            let mut patches = patches;
            patches.links.iter_mut().filter(|link| link.a == 0).for_each(|link| link.weight = 1.0);
            patches
        };
        let squares = Squares::of(&shifted, &shifted.links);
        let of_side = |side: u32| squares.all.iter().filter(|square| square.side == side).count();
        assert_eq!([of_side(4), of_side(2), of_side(1)], [3, 3, 4], "{:?}", squares.all);
        assert_eq!(Squares::single(2).all, [0, 1].map(|patch| Square { patch, side: 1 }));
    }
}
