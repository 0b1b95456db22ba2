// SPDX-License-Identifier: MIT OR Apache-2.0
//! Connected components of a mask's runs.

use super::pixel_runs::Runs;

/// A component: runs of neighbouring rows that touch, also at corners.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Piece {
    /// Pixels of all its runs.
    pub area: u32,
    /// First row that it is in.
    pub first: u32,
    /// Last row that it is in.
    pub last: u32,
}

impl Piece {
    pub fn rows(&self) -> f32 {
        (self.last - self.first + 1) as f32
    }
}

/// The 8-connected components of runs: the component of each run, and the components in the order of their first
/// pixel. Runs are joined, not pixels: a row of a mask has few.
pub fn connect(runs: &Runs) -> (Vec<u32>, Vec<Piece>) {
    let mut parent: Vec<u32> = Vec::with_capacity(runs.all().len());
    let mut above = 0..0;
    for v in 0..runs.height() {
        let places = runs.places(v);
        let mut first = above.start;
        for place in places.clone() {
            let own = runs.all()[place];
            parent.push(place as u32);
            // A run above touches this one where their columns overlap or are next to each other.
            while first < above.end && runs.all()[first].end() < own.start() {
                first += 1;
            }
            let touching = runs.all()[first..above.end].iter().take_while(|run| run.start() <= own.end());
            for other in first..first + touching.count() {
                join(&mut parent, other as u32, place as u32);
            }
        }
        above = places;
    }
    // The smallest run is a component's root: its number is known before that of its others.
    let (mut piece, mut pieces) = (vec![0u32; parent.len()], Vec::<Piece>::new());
    for (v, place, run) in runs.each() {
        let root = find(&mut parent, place as u32) as usize;
        if root == place {
            piece[place] = pieces.len() as u32;
            pieces.push(Piece { area: 0, first: v as u32, last: v as u32 });
        }
        piece[place] = piece[root];
        let piece = &mut pieces[piece[root] as usize];
        piece.area += run.columns().len() as u32;
        piece.last = v as u32;
    }
    (piece, pieces)
}

/// The runs of the components that are chosen, by the component of each run and the components, in the order of `runs`.
pub fn select(runs: &Runs, choose: impl FnOnce(&[u32], &[Piece]) -> Vec<bool>, out: &mut Runs) {
    let (piece, pieces) = connect(runs);
    let chosen = choose(&piece, &pieces);
    out.clear();
    for v in 0..runs.height() {
        for place in runs.places(v).filter(|&place| chosen[piece[place] as usize]) {
            out.push(runs.all()[place]);
        }
        out.end_row();
    }
}

fn find(parent: &mut [u32], mut x: u32) -> u32 {
    while parent[x as usize] != x {
        parent[x as usize] = parent[parent[x as usize] as usize];
        x = parent[x as usize];
    }
    x
}

/// Joins two labels; the smaller root stays.
fn join(parent: &mut [u32], a: u32, b: u32) {
    let (a, b) = (find(parent, a), find(parent, b));
    parent[a.max(b) as usize] = a.min(b);
}

#[cfg(test)]
mod tests {
    use super::{Runs, connect};
    use crate::base::image::Plane;
    use proptest::prelude::{prop_assert, prop_assert_eq, proptest};

    /// The number of each pixel's component from 1, 0 beside the mask, and the area of each.
    fn label(mask: &Plane<u8>) -> (Plane<u32>, Vec<u32>) {
        let runs = Runs::of(mask);
        let (piece, pieces) = connect(&runs);
        let mut label = Plane::filled(mask.width(), mask.height(), 0u32);
        for (v, place, run) in runs.each() {
            label.row_mut(v)[run.columns()].fill(piece[place] + 1);
        }
        (label, [0].into_iter().chain(pieces.iter().map(|piece| piece.area)).collect())
    }

    proptest! {
        /// Pixels that touch have one label, all others of it are reached over pixels that touch, and numbers rise.
        #[test]
        fn labels_are_those_of_a_flood(bits in proptest::collection::vec(0u8..2, 12 * 9)) {
            let mask = Plane::from_vec(12, 9, bits).expect("108 pixels");
            let (found, area) = label(&mask);
            let mut flooded = Plane::filled(12, 9, 0u32);
            let mut areas = vec![0u32];
            for start in 0..12 * 9 {
                if mask.as_slice()[start] == 0 || flooded.as_slice()[start] != 0 {
                    continue;
                }
                let (mut open, number) = (vec![start], areas.len() as u32);
                areas.push(0);
                flooded.as_mut_slice()[start] = number;
                while let Some(at) = open.pop() {
                    areas[number as usize] += 1;
                    let (u, v) = (at % 12, at / 12);
                    for y in v.saturating_sub(1)..(v + 2).min(9) {
                        for x in u.saturating_sub(1)..(u + 2).min(12) {
                            if mask.at(x, y) != 0 && flooded.at(x, y) == 0 {
                                flooded.set(x, y, number);
                                open.push(y * 12 + x);
                            }
                        }
                    }
                }
            }
            prop_assert_eq!(&found, &flooded);
            prop_assert!(area == areas);
        }
    }

    #[test]
    fn a_ring_is_one_component_and_its_hole_is_not_labelled() {
        let text = ["..##..#", ".#..#.#", ".#..#..", "..##..#"];
        let data = text.iter().flat_map(|row| row.bytes().map(|b| u8::from(b == b'#'))).collect();
        let (found, area) = label(&Plane::from_vec(7, 4, data).expect("28 pixels"));
        assert_eq!(area, [0, 8, 2, 1]);
        assert_eq!(found.at(2, 1), 0);
    }
}
