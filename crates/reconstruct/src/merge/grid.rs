// SPDX-License-Identifier: MIT OR Apache-2.0
//! The cells around points at grazing incidence: a grid of bits, so that only what lies near such a point is sorted.

/// Cells of the grid at most: 8 MiB of bits. Where points lie further apart, cells grow; what is decided stays the
/// same.
const MOST_CELLS: f64 = (1 << 26) as f64;

/// Cubic cells over the points at grazing incidence and all that is within reach of them, and which of the cells are
/// within that reach.
pub(crate) struct Cells {
    /// The corner of the grid, world, m.
    origin: [f64; 3],
    per_m: f64,
    size: [usize; 3],
    reach_m: f64,
    /// A bit for each cell: whether it is marked, within reach of such a point.
    marked: Vec<u64>,
    /// For each word of these, the marked cells before it.
    before: Vec<u32>,
    /// How many cells are marked.
    pub(crate) count: usize,
}

impl Cells {
    /// Lays cells around points, and marks those within reach; `None` where there are none.
    pub(crate) fn around(points: impl Iterator<Item = [f64; 3]> + Clone, reach_m: f64) -> Option<Self> {
        // A little more, so that rounding excludes no point: the distance itself decides.
        let reach_m = reach_m * 1.001;
        let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        for point in points.clone() {
            for axis in 0..3 {
                low[axis] = low[axis].min(point[axis] - reach_m);
                high[axis] = high[axis].max(point[axis] + reach_m);
            }
        }
        if low[0] > high[0] {
            return None;
        }
        // Twice the reach: a point and all that is within its reach lie in two or three cells of each axis.
        let mut side_m = 2.0 * reach_m;
        let across = |side_m: f64| [0, 1, 2].map(|axis| ((high[axis] - low[axis]) / side_m).floor() + 1.0);
        while across(side_m).iter().product::<f64>() > MOST_CELLS {
            side_m *= 2.0;
        }
        let size = across(side_m).map(|x| x as usize);
        let mut marked = vec![0u64; size.iter().product::<usize>().div_ceil(64)];
        let (origin, per_m) = (low, 1.0 / side_m);
        let mut cells =
            Self { origin, per_m, size, reach_m, marked: Vec::new(), before: Vec::new(), count: 0 };
        for point in points {
            cells.any_within_reach(point, |cell| {
                marked[cell / 64] |= 1 << (cell % 64);
                false
            });
        }
        for word in &marked {
            cells.before.push(cells.count as u32);
            cells.count += word.count_ones() as usize;
        }
        Some(Self { marked, ..cells })
    }

    /// The cell of a place along an axis, held to the grid. It never falls as the place rises.
    fn along(&self, axis: usize, x: f64) -> usize {
        // Conversions of floats saturate: what lies before the grid comes to 0.
        (((x - self.origin[axis]) * self.per_m) as usize).min(self.size[axis] - 1)
    }

    /// The cell that a place lies in.
    pub(crate) fn of(&self, place: [f32; 3]) -> usize {
        let [x, y, z] = [0, 1, 2].map(|axis| self.along(axis, f64::from(place[axis])));
        (z * self.size[1] + y) * self.size[0] + x
    }

    /// Whether `visit` is true for any of the cells within reach of a point. The first such cell ends the search.
    pub(crate) fn any_within_reach(&self, point: [f64; 3], mut visit: impl FnMut(usize) -> bool) -> bool {
        let range = |axis: usize| {
            self.along(axis, point[axis] - self.reach_m)..=self.along(axis, point[axis] + self.reach_m)
        };
        let (columns, rows, layers) = (range(0), range(1), range(2));
        for z in layers {
            for y in rows.clone() {
                let first = (z * self.size[1] + y) * self.size[0];
                for x in columns.clone() {
                    if visit(first + x) {
                        return true;
                    }
                }
            }
        }
        false
    }

    /// The number of a cell among the marked ones, if it is one.
    pub(crate) fn number(&self, cell: usize) -> Option<usize> {
        let (word, bit) = (self.marked[cell / 64], cell % 64);
        let below = (word & ((1 << bit) - 1)).count_ones() as usize;
        (word >> bit & 1 == 1).then(|| self.before[cell / 64] as usize + below)
    }
}
