// SPDX-License-Identifier: MIT OR Apache-2.0
//! Things sorted into cubic cells by their place: all that is within a cell's side of a place lies in the 27 cells
//! around.

/// Cells per axis on either side of the origin: 21 bits of a key each.
const MOST: i64 = 1 << 20;

/// Things of any kind by the cubic cell that they lie in. Whoever makes it chooses the side of a cell; it is not
/// changed afterwards.
#[derive(Debug)]
pub struct Cells<T> {
    /// The key of a cell and a thing in it, sorted by key.
    entries: Vec<(u64, T)>,
}

impl<T> Cells<T> {
    /// Sorts things into their cells. Those a million cells and more from the origin are left out.
    pub fn new(things: impl Iterator<Item = ([i64; 3], T)>) -> Self {
        let near = things.filter(|(cell, _)| is_near(cell));
        let mut entries: Vec<(u64, T)> = near.map(|(cell, thing)| (key(cell), thing)).collect();
        entries.sort_unstable_by_key(|entry| entry.0);
        Self { entries }
    }

    /// All cells that hold something, with what they hold.
    pub fn each(&self) -> impl Iterator<Item = ([i64; 3], impl Iterator<Item = &T>)> {
        let cells = self.entries.chunk_by(|a, b| a.0 == b.0);
        cells.map(|cell| (unkey(cell[0].0), cell.iter().map(|entry| &entry.1)))
    }

    /// What the 27 cells around (and with) one hold.
    pub fn around(&self, cell: [i64; 3]) -> impl Iterator<Item = &T> {
        let [x, y, z] = cell;
        let rows = (-1..=1).flat_map(|dz| (-1..=1).map(move |dy| (dy, dz)));
        let rows = rows.filter(move |_| is_near(&cell));
        rows.flat_map(move |(dy, dz)| {
            // Cells along x follow one another.
            let (low, high) = (key([x - 1, y + dy, z + dz]), key([x + 1, y + dy, z + dz]));
            let from = self.entries.partition_point(|entry| entry.0 < low);
            self.entries[from..].iter().take_while(move |entry| entry.0 <= high).map(|entry| &entry.1)
        })
    }
}

/// The cell of this side that a place lies in, both in the same unit. What is no number lies in the cell at the
/// origin, what is infinite beyond all that [`Cells`] holds.
pub fn cell_of(place: [f64; 3], side: f64) -> [i64; 3] {
    place.map(|x| (x / side).floor() as i64)
}

/// Whether a cell and those around it have keys.
fn is_near(cell: &[i64; 3]) -> bool {
    cell.iter().all(|x| (2 - MOST..MOST - 1).contains(x))
}

fn key([x, y, z]: [i64; 3]) -> u64 {
    let part = |i: i64| (i + MOST) as u64;
    part(z) << 42 | part(y) << 21 | part(x)
}

fn unkey(key: u64) -> [i64; 3] {
    [0, 21, 42].map(|shift| ((key >> shift) & ((1 << 21) - 1)) as i64 - MOST)
}

#[cfg(test)]
mod tests {
    use super::{Cells, cell_of, key, unkey};
    use proptest::prelude::{ProptestConfig, prop_assert, prop_assert_eq, proptest};

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]
        #[test]
        fn no_near_place_is_missed(
            places in proptest::collection::vec(proptest::array::uniform3(-1.0f64..1.0), 1..60),
        ) {
            let cells = Cells::new(places.iter().map(|&place| (cell_of(place, 0.3), place)));
            let apart = |a: &[f64; 3], b: &[f64; 3]| (0..3).map(|i| (a[i] - b[i]).powi(2)).sum::<f64>();
            let mut seen = 0;
            for (cell, members) in cells.each() {
                for member in members {
                    seen += 1;
                    let near = places.iter().filter(|place| apart(place, member) < 0.09).count();
                    let around = cells.around(cell).filter(|place| apart(place, member) < 0.09).count();
                    prop_assert_eq!(near, around);
                }
            }
            prop_assert!(seen == places.len());
        }
    }

    #[test]
    fn keys_are_places() {
        assert_eq!(unkey(key([-5, 7, -1_000_000])), [-5, 7, -1_000_000]);
        let far = [[1e300, 0.0, 0.0], [0.0, f64::NEG_INFINITY, 0.0]].map(|place| (cell_of(place, 0.01), ()));
        let cells = Cells::new(far.into_iter());
        assert_eq!((cells.each().count(), cells.around([i64::MAX; 3]).count()), (0, 0));
    }
}
