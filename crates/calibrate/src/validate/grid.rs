// SPDX-License-Identifier: MIT OR Apache-2.0
//! Points sorted into cubic cells, so that all within a cell's side of a point are in 27 of them.

use nalgebra::Point3;

/// Cells per axis: 21 bits of a key each.
const MOST: f64 = (1 << 20) as f64;

/// Points sorted by the cubic cell that they lie in.
#[derive(Debug)]
pub struct Grid {
    side_m: f64,
    /// Key of the cell and the point, sorted by cell.
    entries: Vec<(u64, Point3<f64>)>,
    /// Where each cell begins in `entries`, and the end.
    starts: Vec<usize>,
}

impl Grid {
    /// Sorts points into cells of this side; those that are not finite or further than a million cells from the
    /// origin are left out.
    pub fn new(points: impl Iterator<Item = Point3<f64>>, side_m: f64) -> Self {
        let place = |p: &Point3<f64>| p.coords.map(|x| (x / side_m).floor());
        let mut entries: Vec<(u64, Point3<f64>)> = points
            .filter(|p| place(p).iter().all(|x| x.abs() < MOST - 1.0))
            .map(|p| (key(place(&p).map(|x| x as i64).into()), p))
            .collect();
        entries.sort_unstable_by_key(|entry| entry.0);
        let mut starts: Vec<usize> =
            (0..entries.len()).filter(|&i| i == 0 || entries[i].0 != entries[i - 1].0).collect();
        starts.push(entries.len());
        Self { side_m, entries, starts }
    }

    /// Number of cells that are not empty.
    pub fn cells(&self) -> usize {
        self.starts.len() - 1
    }

    /// The points of one cell.
    pub fn members(&self, cell: usize) -> impl Iterator<Item = &Point3<f64>> {
        self.entries[self.starts[cell]..self.starts[cell + 1]].iter().map(|entry| &entry.1)
    }

    /// Collects the points of the 27 cells around (and with) one.
    pub fn around(&self, cell: usize, out: &mut Vec<Point3<f64>>) {
        out.clear();
        let [x, y, z] = unkey(self.entries[self.starts[cell]].0);
        for dz in -1..=1 {
            for dy in -1..=1 {
                // Cells along x follow one another.
                let (low, high) = (key([x - 1, y + dy, z + dz]), key([x + 1, y + dy, z + dz]));
                let from = self.entries.partition_point(|entry| entry.0 < low);
                let run = self.entries[from..].iter().take_while(|entry| entry.0 <= high);
                out.extend(run.map(|entry| entry.1));
            }
        }
    }

    /// Side of a cell, m: what [`Self::around`] is sure to reach.
    pub fn side_m(&self) -> f64 {
        self.side_m
    }
}

fn key([x, y, z]: [i64; 3]) -> u64 {
    let part = |i: i64| (i + (1 << 20)) as u64;
    part(z) << 42 | part(y) << 21 | part(x)
}

fn unkey(key: u64) -> [i64; 3] {
    let part = |shift: u32| ((key >> shift) & ((1 << 21) - 1)) as i64 - (1 << 20);
    [part(0), part(21), part(42)]
}

#[cfg(test)]
mod tests {
    use super::{Grid, key, unkey};
    use nalgebra::Point3;
    use proptest::prelude::{ProptestConfig, prop_assert, prop_assert_eq, proptest};

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]
        #[test]
        fn no_near_point_is_missed(coordinates in proptest::collection::vec(proptest::array::uniform3(-1.0f64..1.0), 1..60)) {
            let points: Vec<Point3<f64>> = coordinates.into_iter().map(Point3::from).collect();
            let grid = Grid::new(points.iter().copied(), 0.3);
            let (mut seen, mut around) = (0, Vec::new());
            for cell in 0..grid.cells() {
                grid.around(cell, &mut around);
                for member in grid.members(cell) {
                    seen += 1;
                    let near = |list: &[Point3<f64>]| list.iter().filter(|p| (*p - member).norm() < 0.3).count();
                    prop_assert_eq!(near(&points), near(&around));
                }
            }
            prop_assert!(seen == points.len());
        }
    }

    #[test]
    fn keys_are_places() {
        assert_eq!(unkey(key([-5, 7, -1_000_000])), [-5, 7, -1_000_000]);
        let odd = [Point3::new(f64::NAN, 0.0, 0.0), Point3::new(1e300, 0.0, 0.0)];
        assert_eq!(Grid::new(odd.into_iter(), 0.01).cells(), 0);
    }
}
