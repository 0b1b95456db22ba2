//! Sums over boxes of pixels, which move down the image row by row.
//!
//! Rows are added in whole blocks, and only where the object's runs lie.

use crate::reconstruct::runs::{Run, Runs};
use std::hint::black_box;
use std::ops::Range;

/// Pixels that are added at once. Rows of sums are added in whole blocks: what lies beside the runs is 0, and no loop has a rest.
const BLOCK: usize = 32;

/// Pixels of the widest vector.
pub(super) const VECTOR: usize = 16;

/// Room before a row, px: no window reaches further.
const PAD: usize = BLOCK;

/// Room before and behind a row, px: boxes take a block more than a row has, and look up to ten pixels further.
const ROOM: usize = PAD + 3 * BLOCK;

/// Rows of packed values: a whole number of units and a count of one in the same word, 0 where there is none. Sums of them
/// are sums of both.
#[derive(Debug, Default)]
pub(super) struct Ring(Vec<Vec<i32>>);

impl Ring {
    /// So many rows of zeros.
    pub(super) fn begin(&mut self, rows: usize, width: usize) {
        self.0.resize_with(rows, Vec::new);
        for row in &mut self.0 {
            row.clear();
            row.resize(width + ROOM, 0);
        }
    }

    /// Row `v` of the image, with room beside it.
    #[inline(always)]
    pub(super) fn row(&self, v: usize) -> &[i32] {
        &self.0[v % self.0.len()]
    }

    /// Row `v`, all zeros.
    #[inline(always)]
    pub(super) fn fresh(&mut self, v: usize, runs: &Runs) -> &mut [i32] {
        let rows = self.0.len();
        let row = &mut self.0[v % rows];
        if let Some(before) = v.checked_sub(rows) {
            for run in runs.row(before) {
                row[padded(run)].fill(0);
            }
        }
        row
    }
}

/// Columns of a run in a row with room beside it.
#[inline(always)]
pub(super) fn padded(run: &Run) -> Range<usize> {
    run.start() + PAD..run.end() + PAD
}

/// The length of a run in whole vectors: what lies behind its end is no step, or is written again by the next run.
#[inline(always)]
pub(super) fn whole_vectors(run: &Run) -> usize {
    run.columns().len().div_ceil(VECTOR) * VECTOR
}

/// The whole blocks of rows with room beside them that have pixels of the runs.
pub(super) fn find_blocks(runs: &Runs, blocks: &mut Runs) {
    blocks.clear();
    for v in 0..runs.height() {
        for run in runs.row(v) {
            let columns = padded(run);
            let (start, end) = (columns.start / BLOCK * BLOCK, columns.end.next_multiple_of(BLOCK));
            blocks.push_joined(Run::new(start, end));
        }
        blocks.end_row();
    }
}

/// Calls `each` with the columns that two rows have between them.
#[inline(always)]
fn each_of_both<'a>(mut a: &'a [Run], mut b: &'a [Run], mut each: impl FnMut(Range<usize>)) {
    // Of what begins first.
    let mut next = || {
        let first = match (a.first(), b.first()) {
            (Some(x), Some(y)) if y.start() < x.start() => &mut b,
            (Some(_), _) => &mut a,
            (None, _) => &mut b,
        };
        first.split_off_first().map(Run::columns)
    };
    let Some(mut open) = next() else { return };
    while let Some(columns) = next() {
        if columns.start <= open.end {
            open.end = open.end.max(columns.end);
        } else {
            each(open);
            open = columns;
        }
    }
    each(open);
}

/// Sums over the rows of a box, kept up to date as it moves down.
#[derive(Debug, Default)]
pub(super) struct Window {
    sums: Vec<i32>,
    /// Half size: columns, rows.
    pub(super) half: (usize, usize),
}

impl Window {
    /// Above the first row of an image.
    pub(super) fn begin(&mut self, width: usize, half: (usize, usize)) {
        self.sums.clear();
        self.sums.resize(width + ROOM, 0);
        self.half = half;
    }

    /// Moves down to where row `last` is the lowest.
    #[inline(always)]
    pub(super) fn advance(&mut self, last: usize, ring: &Ring, blocks: &Runs) {
        let height = blocks.height();
        let entering = Some(last).filter(|v| *v < height);
        let leaving = last.checked_sub(2 * self.half.1 + 1).filter(|v| *v < height);
        let sums = &mut self.sums;
        match (entering, leaving) {
            (Some(last), Some(first)) => {
                let (entering, leaving) = (ring.row(last), ring.row(first));
                each_of_both(
                    blocks.row(last),
                    blocks.row(first),
                    #[inline(always)]
                    |columns| {
                        let leaving = whole_blocks(&leaving[columns.clone()]);
                        let entering = whole_blocks(&entering[columns.clone()]);
                        let sums = sums[columns].as_chunks_mut::<BLOCK>().0;
                        for ((sums, entering), leaving) in sums.iter_mut().zip(entering).zip(leaving) {
                            one_by_one();
                            let mut moved = *sums;
                            for i in 0..BLOCK {
                                moved[i] = moved[i].wrapping_add(entering[i]).wrapping_sub(leaving[i]);
                            }
                            *sums = moved;
                        }
                    },
                );
            }
            (Some(v), None) => move_by(sums, ring.row(v), blocks.row(v), i32::wrapping_add),
            (None, Some(v)) => move_by(sums, ring.row(v), blocks.row(v), i32::wrapping_sub),
            (None, None) => {}
        }
    }

    /// Sums over the boxes around the pixels of a row, but for the last addition.
    #[inline(always)]
    pub(super) fn boxes<'a>(&'a self, blocks: &[Run], taps: &'a mut Taps) -> Boxes<'a> {
        let (half, Taps { three, nine }) = (self.half.0, taps);
        if half > 1 {
            for blocks in blocks {
                let (start, end) = (blocks.start(), blocks.end());
                let from = &self.sums[start - half..];
                add([from, &from[1..], &from[2..]], &mut three[start..end + BLOCK]);
                if half > 4 {
                    let three = &three[start..];
                    add([three, &three[3..], &three[6..]], &mut nine[start..end + BLOCK]);
                }
            }
        }
        let sums = self.sums.as_slice();
        match half {
            1 => Boxes([&sums[PAD - 1..], &sums[PAD..], &sums[PAD + 1..]]),
            2 => Boxes([&three[PAD..], &sums[PAD + 1..], &sums[PAD + 2..]]),
            4 => Boxes([&three[PAD..], &three[PAD + 3..], &three[PAD + 6..]]),
            5 => Boxes([&nine[PAD..], &sums[PAD + 4..], &sums[PAD + 5..]]),
            _ => Boxes([&nine[PAD..], &nine[PAD + 10..], &sums[PAD..]]),
        }
    }
}

/// Sums over the boxes around the pixels of a row, by column: each is that of three values. Whoever needs it adds them, which saves a
/// way through memory.
#[derive(Debug, Clone, Copy)]
pub(super) struct Boxes<'a>([&'a [i32]; 3]);

impl<'a> Boxes<'a> {
    /// The three values of some pixels from one on.
    #[inline(always)]
    pub(super) fn of(&self, column: usize, n: usize) -> [&'a [i32]; 3] {
        // Of neighbours in memory the compiler would load one, and make the others of it.
        let [a, b, c] = self.0;
        [&black_box(a)[column..][..n], &black_box(b)[column..][..n], &black_box(c)[column..][..n]]
    }
}

/// Moves sums by a row, of which these blocks have values.
#[inline(always)]
fn move_by(sums: &mut [i32], row: &[i32], blocks: &[Run], by: impl Fn(i32, i32) -> i32) {
    for blocks in blocks {
        for (sum, x) in sums[blocks.columns()].iter_mut().zip(&row[blocks.columns()]) {
            *sum = by(*sum, *x);
        }
    }
}

/// The sum of three values, any where these are: beside the runs.
#[inline(always)]
pub(super) fn sum(a: i32, b: i32, c: i32) -> i32 {
    a.wrapping_add(b).wrapping_add(c)
}

/// Sums of three values each.
#[inline(always)]
fn add(parts: [&[i32]; 3], out: &mut [i32]) {
    let [a, b, c] = Boxes(parts).of(0, out.len());
    let parts = whole_blocks(a).iter().zip(whole_blocks(b)).zip(whole_blocks(c));
    for (out, ((a, b), c)) in out.as_chunks_mut::<BLOCK>().0.iter_mut().zip(parts) {
        one_by_one();
        let mut sums = [0; BLOCK];
        for i in 0..BLOCK {
            sums[i] = sum(a[i], b[i], c[i]);
        }
        *out = sums;
    }
}

/// Keeps the compiler from taking the same lane of many blocks at once, which it does where vectors can scatter, and loses by.
#[inline(always)]
fn one_by_one() {
    black_box(());
}

/// The blocks of a slice that has no rest.
#[inline(always)]
fn whole_blocks(values: &[i32]) -> &[[i32; BLOCK]] {
    values.as_chunks().0
}

/// Rows to add up boxes in: sums of three and nine columns.
#[derive(Debug, Default)]
pub(super) struct Taps {
    three: Vec<i32>,
    nine: Vec<i32>,
}

impl Taps {
    /// For rows of so many columns.
    pub(super) fn begin(&mut self, width: usize) {
        for row in [&mut self.three, &mut self.nine] {
            row.resize(width + ROOM, 0);
        }
    }
}
