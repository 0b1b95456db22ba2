//! Rows in pairs: a photograph of half as many rows, and back from what is known of these to all rows.
//!
//! Phases are means of five rows, so that each says little that those beside it do not. [`Method::Paired`] takes the mean of
//! each two rows first, or one of them alone where the two see different surfaces (`single_rows`), works on a photograph of half
//! the height with the camera that would have taken it ([`Pair::of_row_pairs`]), and ends with all rows again. Stages that take [`Pair::sensor_rows`] mean rows of the sensor by their
//! constants; for all others a pair is a row.
//!
//! [`Method::Paired`]: super::pipeline::Method::Paired
//! [`Pair::of_row_pairs`]: super::pair::Pair::of_row_pairs
//! [`Pair::sensor_rows`]: super::pair::Pair::sensor_rows

use super::cloud::KnownPixels;
use super::mask::SATURATED;
use super::simd;
use crate::export::{PhaseMap, Run, STEPS_PER_FRINGE};
use crate::image::{Mono8, Plane};
use std::ops::Range;

/// Pairs whose phases differ by more than this are of two surfaces, steps of phase (1.6 rad).
const STEP: i32 = (STEPS_PER_FRINGE / 4.0) as i32;

/// What is not known. Far enough from every phase.
const UNKNOWN: i32 = i32::MIN / 4;

/// The mean of each two rows into one plane of half the height, the larger of their pixels into another; the last of an odd number of rows is
/// left out. Halves are rounded up and down by turns, and a pair of which one is over-exposed is.
pub fn fold(image: Mono8<'_>, folded: &mut Plane<u8>, largest: &mut Plane<u8>) {
    simd::dispatch(
        #[inline(always)]
        || {
            for k in 0..folded.height() {
                let n = image.width();
                let (a, b) = (&image.row(2 * k)[..n], &image.row(2 * k + 1)[..n]);
                let half = k as u16 % 2;
                let (out, largest) = (&mut folded.row_mut(k)[..n], &mut largest.row_mut(k)[..n]);
                for u in 0..n {
                    let most = a[u].max(b[u]);
                    let mean = ((u16::from(a[u]) + u16::from(b[u]) + half) / 2) as u8;
                    out[u] = if most >= SATURATED { most } else { mean };
                    largest[u] = most;
                }
            }
        },
    );
}

/// A stretch of a pair of which one row is taken alone.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Single {
    /// Row of the folded frame.
    pub pair: u16,
    /// First column in the frame.
    pub first: u16,
    /// The column after the last.
    pub end: u16,
    /// Which of its rows.
    pub side: Side,
}

/// A row of a pair.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Side {
    /// Row `2 k`.
    Upper,
    /// Row `2 k + 1`.
    Lower,
}

impl Side {
    /// The row of the frame that it is of a pair.
    pub fn row(self, pair: usize) -> usize {
        match self {
            Self::Upper => 2 * pair,
            Self::Lower => 2 * pair + 1,
        }
    }
}

/// All rows of what is known of pairs, for a frame of so many columns and rows. The middle of a row lies a quarter of the way from the
/// middle of its pair to that of the next one, and so does its phase, where both are of one surface; its light is its pair's. Of `singles`,
/// from top to bottom and from left to right, the row that stands alone has the phase of the pair, and the other one is half way to the
/// pair on its side where that is of the same surface, or nothing. How certain phases are nobody knows of pairs.
pub fn unfold(known: &KnownPixels<'_>, frame: [u16; 2], singles: &[Single]) -> PhaseMap {
    let mut out = PhaseMap { frame, ..PhaseMap::default() };
    let pairs = known.roi.v..known.roi.v + known.roi.height;
    let pixels = 2 * known.runs.area();
    out.phase.reserve_exact(pixels);
    out.light.reserve_exact(pixels);
    let mut rows = Rows::new(usize::from(frame[0]));
    let mut singles = &singles[singles.partition_point(|single| usize::from(single.pair) < pairs.start)..];
    simd::dispatch(
        #[inline(always)]
        || {
            rows.look_ahead(known, pairs.start);
            for k in pairs {
                rows.advance(known, k);
                let here = singles.iter().take_while(|single| usize::from(single.pair) <= k).count();
                let (of_pair, rest) = singles.split_at(here);
                for side in [Side::Upper, Side::Lower] {
                    rows.write(known, k, side, of_pair, &mut out);
                }
                singles = rest;
            }
        },
    );
    out
}

/// What is known of the pairs above, here and below.
struct Rows {
    rows: [Row; 3],
    /// A row of bytes to find runs in.
    room: Vec<u8>,
}

/// What is known of a pair.
struct Row {
    runs: Vec<Run>,
    /// Phases of all columns; [`UNKNOWN`] where they are.
    phases: Vec<i32>,
}

impl Rows {
    /// Nothing is known yet, of so many columns.
    fn new(columns: usize) -> Self {
        let row = |()| Row { runs: Vec::new(), phases: vec![UNKNOWN; columns] };
        Self { rows: [(); 3].map(row), room: vec![0; columns] }
    }

    /// Goes to pair `k`.
    #[inline(always)]
    fn advance(&mut self, known: &KnownPixels<'_>, k: usize) {
        self.rows.rotate_left(1);
        self.look_ahead(known, k + 1);
    }

    /// Takes pair `k` as that below.
    #[inline(always)]
    fn look_ahead(&mut self, known: &KnownPixels<'_>, k: usize) {
        let Row { runs, phases } = &mut self.rows[2];
        for run in runs.drain(..) {
            phases[usize::from(run.first)..run.end()].fill(UNKNOWN);
        }
        if k < known.roi.v + known.roi.height {
            known.add_runs(k, &mut self.room, runs);
        }
        for run in &*runs {
            known.write_phases(run, &mut phases[usize::from(run.first)..run.end()]);
        }
    }

    /// Writes one row of pair `k`, of which `singles` stand alone.
    #[inline(always)]
    fn write(
        &self,
        known: &KnownPixels<'_>,
        k: usize,
        side: Side,
        mut singles: &[Single],
        out: &mut PhaseMap,
    ) {
        let [above, Row { runs, phases: own }, under] = &self.rows;
        let row = side.row(k) as u16;
        let beside = if side == Side::Upper { &above.phases } else { &under.phases };
        for run in runs {
            let (first, end) = (usize::from(run.first), run.end());
            let light = known.light(run);
            let mut columns = first;
            while columns < end {
                // What ends before is of no use for what follows, either.
                while let Some((_, rest)) = singles.split_first().filter(|x| usize::from(x.0.end) <= columns)
                {
                    singles = rest;
                }
                let (start, stop, single) = singles
                    .first()
                    .map_or((end, end, None), |x| (usize::from(x.first), usize::from(x.end), Some(x.side)));
                let (to, single) =
                    if start > columns { (start.min(end), None) } else { (stop.min(end), single) };
                let part = columns..to;
                let [own, beside] = [own, beside].map(|row| &row[part.clone()]);
                let light = &light[columns - first..to - first];
                columns = to;
                match single {
                    None => {
                        begin(&mut out.runs, row, &part);
                        out.phase.extend(own.iter().zip(beside).map(
                            #[inline(always)]
                            |(&own, &beside)| towards(own, beside),
                        ));
                        out.light.extend_from_slice(light);
                    }
                    Some(single) if single == side => {
                        begin(&mut out.runs, row, &part);
                        out.phase.extend_from_slice(own);
                        out.light.extend_from_slice(light);
                    }
                    Some(_) => {
                        for (i, u) in part.enumerate() {
                            if (-STEP..=STEP).contains(&(beside[i] - own[i])) {
                                begin(&mut out.runs, row, &(u..u + 1));
                                out.phase.push(own[i] + ((beside[i] - own[i]) >> 1));
                                out.light.push(light[i]);
                            }
                        }
                    }
                }
            }
        }
    }
}

/// A phase a quarter of the way to that beside it where this is of the same surface.
#[inline(always)]
fn towards(own: i32, beside: i32) -> i32 {
    let step = beside - own;
    let quarter = (step + 2) >> 2;
    own + if (-STEP..=STEP).contains(&step) { quarter } else { 0 }
}

/// Begins a run, or makes the last one longer.
#[inline(always)]
fn begin(runs: &mut Vec<Run>, row: u16, columns: &Range<usize>) {
    match runs.last_mut() {
        Some(last) if last.row == row && last.end() == columns.start => last.length += columns.len() as u16,
        _ => runs.push(Run { row, first: columns.start as u16, length: columns.len() as u16 }),
    }
}

#[cfg(test)]
mod tests {
    use super::{STEP, Side, Single, fold, unfold};
    use crate::export::{PhaseMap, Run, STEPS_PER_FRINGE};
    use crate::image::{Mono8, Plane};
    use crate::reconstruct::cloud::KnownPixels;
    use crate::reconstruct::roi::Roi;
    use crate::reconstruct::runs::Runs;
    use proptest::prelude::{Just, any, prop_assert, prop_assert_eq, prop_oneof, proptest};
    use std::f32::consts::TAU;

    /// A phase map of these rows of columns that are known.
    fn map(rows: &[Vec<Option<i32>>]) -> PhaseMap {
        let mut map = PhaseMap { frame: [rows[0].len() as u16, rows.len() as u16], ..PhaseMap::default() };
        for (v, row) in rows.iter().enumerate() {
            for (u, phase) in row.iter().enumerate() {
                let Some(phase) = phase else { continue };
                match map.runs.last_mut().filter(|run| usize::from(run.row) == v && run.end() == u) {
                    Some(run) => run.length += 1,
                    None => map.runs.push(Run { row: v as u16, first: u as u16, length: 1 }),
                }
                map.phase.push(*phase);
                map.light.push((v * 100 + u) as u16);
            }
        }
        map
    }

    /// What [`unfold`] makes of these rows, all of which are object, from column `u` and pair `v` on. The frame has a row more than its
    /// pairs, and what stands alone above them is none of theirs.
    fn unfolded(rows: &[Vec<Option<i32>>], singles: &[Single], [u, v]: [u16; 2]) -> PhaseMap {
        let (w, h) = (rows[0].len(), rows.len());
        let rad = |x: &Option<i32>| x.map_or(f32::NAN, |x| x as f32 * (TAU / STEPS_PER_FRINGE));
        let absolute = Plane::from_vec(w, h, rows.iter().flatten().map(rad).collect()).expect("rows");
        let light = (0..w * h).map(|i| (i / w * 100 + i % w) as u16).collect();
        let light = Plane::from_vec(w, h, light).expect("rows");
        let runs = Runs::of(&Plane::filled(w, h, 1));
        let roi = Roi { u: u.into(), v: v.into(), width: w, height: h };
        let known = KnownPixels { absolute: &absolute, runs: &runs, light: &light, roi };
        let frame = [u + w as u16, 2 * (v + h as u16) + 1];
        let above = (0..v).map(|pair| Single { pair, first: 0, end: frame[0], side: Side::Lower });
        let own =
            singles.iter().map(|x| Single { pair: x.pair + v, first: x.first + u, end: x.end + u, ..*x });
        unfold(&known, frame, &above.chain(own).collect::<Vec<_>>())
    }

    /// Stretches of the pairs' pixels that stand alone, by what is said of each.
    fn singles(said: &[Vec<Option<bool>>]) -> Vec<Single> {
        let mut singles: Vec<Single> = Vec::new();
        for (pair, said) in said.iter().enumerate() {
            for (u, lower) in said.iter().enumerate() {
                let Some(lower) = lower else { continue };
                let (pair, u) = (pair as u16, u as u16);
                let side = if *lower { Side::Lower } else { Side::Upper };
                match singles.last_mut().filter(|x| (x.pair, x.end, x.side) == (pair, u, side)) {
                    Some(last) => last.end += 1,
                    None => singles.push(Single { pair, first: u, end: u + 1, side }),
                }
            }
        }
        singles
    }

    proptest! {
        /// Pixels are far apart, as random ones are, or near.
        #[test]
        fn every_pair_becomes_what_is_known_of_two_rows(
            rows in proptest::collection::vec(proptest::collection::vec(any::<Option<i16>>(), 7), 1..6),
            said in proptest::collection::vec(proptest::collection::vec(any::<Option<bool>>(), 7), 5),
            none_alone in any::<bool>(),
            divisor in prop_oneof![Just(1), Just(30)],
            (u, v) in (0u16..4, 0u16..4),
        ) {
            let near = |x: Option<i16>| x.map(|x| i32::from(x) / divisor);
            let rows: Vec<Vec<Option<i32>>> =
                rows.into_iter().map(|row| row.into_iter().map(near).collect()).collect();
            let said = if none_alone { vec![vec![None; 7]; 5] } else { said };
            let found = unfolded(&rows, &singles(&said[..rows.len()]), [u, v]);
            let mut expected = vec![vec![None; 7]; 2 * rows.len()];
            for (row, out) in expected.iter_mut().enumerate() {
                let beside = if row % 2 == 0 { (row / 2).checked_sub(1) } else { Some(row / 2 + 1) };
                for (column, out) in out.iter_mut().enumerate() {
                    let beside = beside.and_then(|k| rows.get(k)).and_then(|row| row[column]);
                    let Some(own) = rows[row / 2][column] else { continue };
                    let step = beside.map(|x| x - own).filter(|step| step.abs() <= STEP);
                    *out = match said[row / 2][column] {
                        None => Some(own + step.map_or(0, |step| (step + 2).div_euclid(4))),
                        Some(lower) if lower == (row % 2 == 1) => Some(own),
                        Some(_) => step.map(|step| own + step.div_euclid(2)),
                    };
                }
            }
            let mut expected = map(&expected);
            for run in &mut expected.runs {
                (run.row, run.first) = (run.row + 2 * v, run.first + u);
            }
            prop_assert_eq!(&found.runs, &expected.runs);
            prop_assert_eq!(&found.phase, &expected.phase);
            prop_assert_eq!(found.frame, [u + 7, 2 * (v + rows.len() as u16) + 1]);
            prop_assert_eq!(found.light.len(), expected.light.len());
            prop_assert!(found.light.iter().zip(&expected.light).all(|(x, y)| x % 100 == y % 100 && x / 100 == y / 200));
        }
    }

    #[test]
    fn a_plane_stays_one() {
        // Four steps of phase a row: eight a pair.
        let rows: Vec<Vec<Option<i32>>> =
            (0..5).map(|k| (0..9).map(|u| Some(8 * k + 100 * u)).collect()).collect();
        let found = unfolded(&rows, &[], [0, 0]);
        let row = |v: usize| &found.phase[9 * v..9 * (v + 1)];
        for v in 1..8 {
            assert!(row(v).iter().zip(row(v + 1)).all(|(x, y)| y - x == 4), "{v}");
        }
    }

    #[test]
    fn light_is_the_mean_of_two_rows_and_what_is_over_exposed_stays_so() {
        let image = Plane::from_vec(3, 5, vec![10, 20, 251, 13, 30, 40, 1, 2, 3, 2, 2, 255, 9, 9, 9]);
        let (mut folded, mut largest) = (Plane::filled(3, 2, 0), Plane::filled(3, 2, 0));
        fold(Mono8::from(&image.expect("15 pixels")), &mut folded, &mut largest);
        assert_eq!(folded.as_slice(), [11, 25, 251, 2, 2, 255]);
        assert_eq!(largest.as_slice(), [13, 30, 251, 2, 2, 255]);
    }
}
