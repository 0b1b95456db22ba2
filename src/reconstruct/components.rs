//! Connected components of a mask.

use super::period::runs;
use crate::image::Plane;
use std::ops::Range;

/// Components of a mask: `label` holds 0 outside and 1.. inside, `area` the pixels of each label (entry 0
/// unused).
#[derive(Debug)]
pub struct Components {
    /// Label of each pixel.
    pub label: Plane<u32>,
    /// Pixels of each label.
    pub area: Vec<u32>,
}

/// A run of one row's non-zero pixels.
struct Run {
    columns: Range<usize>,
    label: u32,
}

/// Labels the 8-connected components of the non-zero pixels, in the order of their first pixel. Runs are joined, not
/// pixels: a row of a mask has few.
pub fn label(mask: &Plane<u8>) -> Components {
    let (width, height) = (mask.width(), mask.height());
    let mut parent: Vec<u32> = Vec::new();
    let mut all: Vec<Vec<Run>> = Vec::with_capacity(height);
    for v in 0..height {
        let above = all.last().map_or(&[][..], Vec::as_slice);
        let (mut row, mut first) = (Vec::new(), 0);
        for columns in runs(mask.row(v)) {
            // A run above touches this one where their columns overlap or are next to each other.
            while above.get(first).is_some_and(|other| other.columns.end < columns.start) {
                first += 1;
            }
            let mut own = None;
            for other in above[first..].iter().take_while(|other| other.columns.start <= columns.end) {
                own = Some(own.map_or(other.label, |own| join(&mut parent, own, other.label)));
            }
            let label = own.unwrap_or_else(|| {
                parent.push(parent.len() as u32);
                parent.len() as u32 - 1
            });
            row.push(Run { columns, label });
        }
        all.push(row);
    }
    let mut label = Plane::filled(width, height, 0u32);
    let (mut number, mut area) = (vec![0u32; parent.len()], vec![0u32]);
    for (v, row) in all.iter().enumerate() {
        for run in row {
            let root = find(&mut parent, run.label) as usize;
            if number[root] == 0 {
                number[root] = area.len() as u32;
                area.push(0);
            }
            area[number[root] as usize] += run.columns.len() as u32;
            label.row_mut(v)[run.columns.clone()].fill(number[root]);
        }
    }
    Components { label, area }
}

fn find(parent: &mut [u32], mut x: u32) -> u32 {
    while parent[x as usize] != x {
        parent[x as usize] = parent[parent[x as usize] as usize];
        x = parent[x as usize];
    }
    x
}

/// Joins two labels; the smaller root stays.
fn join(parent: &mut [u32], a: u32, b: u32) -> u32 {
    let (a, b) = (find(parent, a), find(parent, b));
    let (low, high) = (a.min(b), a.max(b));
    parent[high as usize] = low;
    low
}

#[cfg(test)]
mod tests {
    use super::label;
    use crate::image::Plane;
    use proptest::prelude::{prop_assert, prop_assert_eq, proptest};

    proptest! {
        /// Pixels that touch have one label, all others of it are reached over pixels that touch, and numbers rise.
        #[test]
        fn labels_are_those_of_a_flood(bits in proptest::collection::vec(0u8..2, 12 * 9)) {
            let mask = Plane::from_vec(12, 9, bits).expect("108 pixels");
            let found = label(&mask);
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
            prop_assert_eq!(&found.label, &flooded);
            prop_assert!(found.area == areas);
        }
    }

    #[test]
    fn a_ring_is_one_component_and_its_hole_is_not_labelled() {
        let text = ["..##..#", ".#..#.#", ".#..#..", "..##..#"];
        let data = text.iter().flat_map(|row| row.bytes().map(|b| u8::from(b == b'#'))).collect();
        let found = label(&Plane::from_vec(7, 4, data).expect("28 pixels"));
        assert_eq!(found.area, [0, 8, 2, 1]);
        assert_eq!(found.label.at(2, 1), 0);
    }
}
