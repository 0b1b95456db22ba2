// SPDX-License-Identifier: MIT OR Apache-2.0
//! Runs of a mask's pixels: stages touch these alone, not the rectangle around them.

use super::bit_rows::{WORD, bits_of};
use super::simd;
use crate::base::image::Plane;
use std::ops::Range;

/// Pixels of one row that lie side by side.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Run {
    start: u32,
    end: u32,
}

impl Run {
    /// The columns `start .. end`.
    pub fn new(start: usize, end: usize) -> Self {
        Self { start: start as u32, end: end as u32 }
    }

    pub fn columns(&self) -> Range<usize> {
        self.start as usize..self.end as usize
    }

    pub fn start(&self) -> usize {
        self.start as usize
    }

    /// The column behind the last one of the run.
    pub fn end(&self) -> usize {
        self.end as usize
    }
}

/// The runs of all rows, from left to right and from top to bottom.
#[derive(Debug, Clone, Default)]
pub struct Runs {
    runs: Vec<Run>,
    /// Where the runs of each row end.
    ends: Vec<usize>,
}

impl Runs {
    /// The runs of a mask of zeros and ones.
    pub fn of(mask: &Plane<u8>) -> Self {
        let mut runs = Self::default();
        simd::dispatch(
            #[inline(always)]
            || {
                for v in 0..mask.height() {
                    runs_of(
                        mask.row(v),
                        #[inline(always)]
                        |first, end| runs.push(Run::new(first, end)),
                    );
                    runs.end_row();
                }
            },
        );
        runs
    }

    /// Writes the mask of zeros and ones that has these runs, of as many rows.
    pub fn paint(&self, mask: &mut Plane<u8>) {
        for v in 0..self.height() {
            let row = mask.row_mut(v);
            let all = 0..row.len();
            fill_around(self.row(v), row, all, 0);
            self.row(v).iter().for_each(|run| row[run.columns()].fill(1));
        }
    }

    /// Forgets all runs and rows.
    pub fn clear(&mut self) {
        self.runs.clear();
        self.ends.clear();
    }

    /// Adds a run to the row that is being built.
    pub fn push(&mut self, run: Run) {
        self.runs.push(run);
    }

    /// Ends the row that is being built.
    pub fn end_row(&mut self) {
        self.ends.push(self.runs.len());
    }

    pub fn height(&self) -> usize {
        self.ends.len()
    }

    /// The places of row `v`'s runs among [`Runs::all`].
    pub fn places(&self, v: usize) -> Range<usize> {
        let start = if v == 0 { 0 } else { self.ends[v - 1] };
        start..self.ends[v]
    }

    /// The runs of row `v`.
    pub fn row(&self, v: usize) -> &[Run] {
        &self.runs[self.places(v)]
    }

    /// All runs, each with its row and its place among [`Runs::all`].
    pub fn each(&self) -> impl Iterator<Item = (usize, usize, Run)> {
        let places = (0..self.height()).flat_map(|v| self.places(v).map(move |place| (v, place)));
        places.map(|(v, place)| (v, place, self.runs[place]))
    }

    pub fn all(&self) -> &[Run] {
        &self.runs
    }

    /// Pixels of all runs together.
    pub fn area(&self) -> usize {
        self.runs.iter().map(|run| run.columns().len()).sum()
    }

    /// From the first to the last pixel of row `v`; empty where it has none.
    pub fn span(&self, v: usize) -> Range<usize> {
        match self.row(v) {
            [] => 0..0,
            [first, .., last] => first.start()..last.end(),
            [only] => only.columns(),
        }
    }

    /// From the first to the last pixel of some rows; empty where they have none.
    #[inline(always)]
    pub fn span_of(&self, rows: Range<usize>) -> Range<usize> {
        rows.map(|v| self.span(v)).fold(0..0, |all, row| joined(&all, &row))
    }
}

/// Fills what lies beside the runs of a row in some columns, and between them.
#[inline(always)]
pub(crate) fn fill_around<T: Copy>(runs: &[Run], row: &mut [T], columns: Range<usize>, value: T) {
    let mut done = runs.first().map_or(columns.start, |first| columns.start.min(first.start()));
    for run in runs {
        row[done..run.start()].fill(value);
        done = run.end();
    }
    row[done..columns.end.max(done)].fill(value);
}

/// Rows of a band; [`Surroundings`] are kept by bands.
const BAND_ROWS: usize = 16;

/// How far beside the runs of a row stages read at most, px. Up and down they read no further than a band.
const BESIDE_PX: usize = 64;

/// The columns beside the runs that stages read of a plane. What lies farther away need not be filled, which saves
/// memory traffic.
#[derive(Debug, Default)]
pub(crate) struct Surroundings {
    /// Columns of the runs of each band; empty where it has none.
    spans: Vec<Range<usize>>,
    width: usize,
}

impl Surroundings {
    /// Finds the surroundings of the runs of rows of `width` pixels: all columns if later stages read whole rows.
    pub fn find(&mut self, runs: &Runs, width: usize, whole: bool) {
        self.width = width;
        self.spans.clear();
        self.spans.extend((0..runs.height()).step_by(BAND_ROWS).map(|top| {
            let rows = top..runs.height().min(top + BAND_ROWS);
            if whole { 0..width } else { runs.span_of(rows) }
        }));
    }

    /// The columns that are looked at in row `v`.
    pub fn columns(&self, v: usize) -> Range<usize> {
        let band = v / BAND_ROWS;
        let bands = self.spans.get(band.saturating_sub(1)..self.spans.len().min(band + 2));
        let span = bands.unwrap_or_default().iter().fold(0..0, |all, band| joined(&all, band));
        if span.is_empty() {
            return span;
        }
        span.start.saturating_sub(BESIDE_PX)..self.width.min(span.end + BESIDE_PX)
    }
}

/// The smallest range that holds two, of which either may be empty.
fn joined(a: &Range<usize>, b: &Range<usize>) -> Range<usize> {
    match (a.is_empty(), b.is_empty()) {
        (true, _) => b.clone(),
        (_, true) => a.clone(),
        _ => a.start.min(b.start)..a.end.max(b.end),
    }
}

/// Calls `each` with the first column of every run of ones, and the column after its last.
#[inline(always)]
pub(crate) fn runs_of(row: &[u8], mut each: impl FnMut(usize, usize)) {
    let mut start = None;
    transitions(row, |u| match start.take() {
        None => start = Some(u),
        Some(first) => each(first, u),
    });
    if let Some(first) = start {
        each(first, row.len());
    }
}

/// Calls `at` with each column whose value differs from that before it; before the first is 0.
#[inline(always)]
fn transitions(row: &[u8], mut at: impl FnMut(usize)) {
    let mut inside = 0;
    each_word(
        row,
        #[inline(always)]
        |first, count, bits| {
            let mut changes = bits ^ (bits << 1 | inside);
            // Beyond the row's end nothing changes.
            changes &= u64::MAX >> (WORD - count);
            while changes != 0 {
                at(first + changes.trailing_zeros() as usize);
                changes &= changes - 1;
            }
            inside = bits >> (count - 1) & 1;
        },
    );
}

/// Calls `at` with the place of each byte that is not 0.
#[inline(always)]
pub(crate) fn each_not_0(bytes: &[u8], mut at: impl FnMut(usize)) {
    each_word(
        bytes,
        #[inline(always)]
        |first, _, mut bits| {
            while bits != 0 {
                at(first + bits.trailing_zeros() as usize);
                bits &= bits - 1;
            }
        },
    );
}

/// Calls `each` with the place of the first of up to [`WORD`] bytes, how many they are, and a bit for each that is not
/// 0.
#[inline(always)]
fn each_word(bytes: &[u8], mut each: impl FnMut(usize, usize, u64)) {
    let (words, rest) = bytes.as_chunks::<WORD>();
    for (k, word) in words.iter().enumerate() {
        each(k * WORD, WORD, bits_of(word, u8::MAX));
    }
    if rest.is_empty() {
        return;
    }
    let bits = match bytes.last_chunk() {
        // Of which the first have been looked at.
        Some(word) => bits_of(word, u8::MAX) >> (WORD - rest.len()),
        None => {
            let mut word = [0; WORD];
            word[..rest.len()].copy_from_slice(rest);
            bits_of(&word, u8::MAX)
        }
    };
    each(words.len() * WORD, rest.len(), bits);
}

#[cfg(test)]
mod tests {
    use super::{BAND_ROWS, BESIDE_PX, Run, Runs, Surroundings, each_not_0, fill_around};
    use crate::base::image::Plane;
    use proptest::prelude::{prop_assert, prop_assert_eq, proptest};

    proptest! {
        /// Wherever runs are: all that is as near to them as stages look, and nothing beyond the row.
        #[test]
        fn what_is_near_runs_is_around_them(
            places in proptest::collection::vec((0usize..70, 0usize..300, 1usize..40), 0..4),
            at in (0usize..70, 0usize..300),
        ) {
            let mut mask = Plane::filled(300, 70, 0u8);
            for &(v, u, n) in &places {
                mask.row_mut(v)[u..300.min(u + n)].fill(1);
            }
            let runs = Runs::of(&mask);
            let mut around = Surroundings::default();
            around.find(&runs, 300, false);
            let (v, u) = at;
            let columns = around.columns(v);
            let near = (v.saturating_sub(BAND_ROWS)..70.min(v + BAND_ROWS + 1)).any(|v| {
                let beside = |run: &Run| run.start() <= u + BESIDE_PX && u < run.end() + BESIDE_PX;
                runs.row(v).iter().any(beside)
            });
            prop_assert!(!near || columns.contains(&u), "{columns:?}");
            prop_assert!(columns.end <= 300 && (columns.is_empty() || !runs.all().is_empty()));
            let mut row = vec![7; 300];
            fill_around(runs.row(v), &mut row, columns.clone(), 0);
            for (u, (x, is_run)) in row.iter().zip(mask.row(v)).enumerate() {
                prop_assert_eq!(*x == 0, *is_run == 0 && columns.contains(&u));
            }
            around.find(&runs, 300, true);
            prop_assert_eq!(around.columns(v), 0..300);
        }

        #[test]
        fn bytes_that_are_not_0_are_found(bytes in proptest::collection::vec(0u8..3, 0..200)) {
            let mut found = Vec::new();
            each_not_0(&bytes, |i| found.push(i));
            let plain: Vec<_> = (0..bytes.len()).filter(|&i| bytes[i] != 0).collect();
            prop_assert_eq!(found, plain);
        }

        #[test]
        fn runs_are_those_of_a_plain_search(bits in proptest::collection::vec(0u8..2, 150 * 5), long in 0usize..150) {
            let mut mask = Plane::from_vec(150, 5, bits).expect("750 pixels");
            mask.row_mut(2)[..long].fill(1);
            mask.row_mut(3)[long..].fill(0);
            let found = Runs::of(&mask);
            for v in 0..5 {
                let is_run = |u: usize| (0..150).contains(&u) && mask.at(u, v) != 0;
                let starts = (0..150).filter(|&u| is_run(u) && !is_run(u.wrapping_sub(1)));
                let plain: Vec<_> = starts.map(|u| u..(u..).find(|&u| !is_run(u)).expect("an end")).collect();
                let found: Vec<_> = found.row(v).iter().map(|run| run.columns()).collect();
                prop_assert_eq!(found, plain);
            }
        }
    }
}
