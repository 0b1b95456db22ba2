//! Rows in pairs: a photograph of half as many rows, and back from what is known of these to all rows.
//!
//! Phases are means of five rows, so that each says little that those beside it do not. [`Method::Paired`] takes the mean of
//! each two rows first, works on a photograph of half the height with the camera that would have taken it
//! ([`Pair::of_row_pairs`]), and ends with all rows again. Stages that take [`Pair::sensor_rows`] mean rows of the sensor by their
//! constants; for all others a pair is a row.
//!
//! [`Method::Paired`]: super::pipeline::Method::Paired
//! [`Pair::of_row_pairs`]: super::pair::Pair::of_row_pairs
//! [`Pair::sensor_rows`]: super::pair::Pair::sensor_rows

use super::mask::SATURATED;
use super::simd;
use crate::export::{PhaseMap, Run, STEPS_PER_FRINGE};
use crate::image::{Mono8, Plane};

/// Pairs whose phases differ by more than this are of two surfaces, steps of phase (1.6 rad).
const STEP: i32 = (STEPS_PER_FRINGE / 4.0) as i32;

/// What is not known. Far enough from every phase.
const UNKNOWN: i32 = i32::MIN / 4;

/// The mean of each two rows into a plane of half the height; the last of an odd number of rows is left out. Halves are rounded up and down by
/// turns, and a pair of which one is over-exposed is.
pub fn fold(image: Mono8<'_>, folded: &mut Plane<u8>) {
    simd::dispatch(
        #[inline(always)]
        || {
            for k in 0..folded.height() {
                let n = image.width();
                let (a, b) = (&image.row(2 * k)[..n], &image.row(2 * k + 1)[..n]);
                let (out, half) = (&mut folded.row_mut(k)[..n], k as u16 % 2);
                for u in 0..n {
                    let most = a[u].max(b[u]);
                    let mean = ((u16::from(a[u]) + u16::from(b[u]) + half) / 2) as u8;
                    out[u] = if most >= SATURATED { most } else { mean };
                }
            }
        },
    );
}

/// All rows of what is known of pairs, for a frame of `height` rows. The middle of a row lies a quarter of the way from the middle of its
/// pair to that of the next one, and so does its phase, where both are of one surface; its light is its pair's. How certain phases are
/// nobody knows of pairs.
pub fn unfold(map: &PhaseMap, height: u16) -> PhaseMap {
    let mut out = PhaseMap { frame: [map.frame[0], height], ..PhaseMap::default() };
    let pixels = 2 * map.phase.len();
    out.runs.reserve_exact(2 * map.runs.len());
    out.phase.reserve_exact(pixels);
    out.light.reserve_exact(pixels);
    let mut rows = Rows::of(map);
    simd::dispatch(
        #[inline(always)]
        || {
            for k in 0..map.frame[1] {
                rows.advance(map, k);
                for below in [false, true] {
                    rows.write(map, k, below, &mut out);
                }
            }
        },
    );
    out
}

/// The pairs of a phase map from top to bottom.
struct Rows {
    /// Runs of the pair and of that below it, as places in the map, and their first pixels.
    own: Stretch,
    below: Stretch,
    /// Phases of the pairs above, here and below, for all columns; [`UNKNOWN`] where they are.
    phases: [Vec<i32>; 3],
}

/// Runs of one row.
#[derive(Debug, Clone, Copy, Default)]
struct Stretch {
    run: usize,
    end: usize,
    pixel: usize,
}

impl Rows {
    /// Above the first.
    fn of(map: &PhaseMap) -> Self {
        let row = || vec![UNKNOWN; usize::from(map.frame[0])];
        let mut rows =
            Self { own: Stretch::default(), below: Stretch::default(), phases: [row(), row(), row()] };
        rows.look_ahead(map, 0);
        rows
    }

    /// Goes to pair `k`.
    #[inline(always)]
    fn advance(&mut self, map: &PhaseMap, k: u16) {
        self.phases.rotate_left(1);
        self.own = self.below;
        self.look_ahead(map, k + 1);
    }

    /// Takes pair `k` as that below.
    #[inline(always)]
    fn look_ahead(&mut self, map: &PhaseMap, k: u16) {
        let of = |from: usize| map.runs[from..].iter().take_while(|run| run.row == k);
        let before = self.own;
        let lengths = map.runs[before.run..before.end].iter().map(|run| usize::from(run.length));
        let (run, pixel) = (before.end, before.pixel + lengths.sum::<usize>());
        self.below = Stretch { run, end: run + of(run).count(), pixel };
        let row = &mut self.phases[2];
        row.fill(UNKNOWN);
        let mut at = pixel;
        for run in of(run) {
            let phases = &map.phase[at..at + usize::from(run.length)];
            row[usize::from(run.first)..run.end()].copy_from_slice(phases);
            at += phases.len();
        }
    }

    /// Writes the upper or the lower row of pair `k`.
    #[inline(always)]
    fn write(&self, map: &PhaseMap, k: u16, below: bool, out: &mut PhaseMap) {
        let [above, own, under] = &self.phases;
        let beside = if below { under } else { above };
        let mut at = self.own.pixel;
        for run in &map.runs[self.own.run..self.own.end] {
            let (columns, pixels) = (usize::from(run.first)..run.end(), at..at + usize::from(run.length));
            out.runs.push(Run { row: 2 * k + u16::from(below), ..*run });
            let (n, first) = (columns.len(), out.phase.len());
            out.phase.resize(first + n, 0);
            let to = &mut out.phase[first..][..n];
            let (own, beside) = (&own[columns.clone()][..n], &beside[columns][..n]);
            for i in 0..n {
                let step = beside[i] - own[i];
                let quarter = (step + 2) >> 2;
                to[i] = own[i] + if (-STEP..=STEP).contains(&step) { quarter } else { 0 };
            }
            out.light.extend_from_slice(&map.light[pixels.clone()]);
            at = pixels.end;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{STEP, fold, unfold};
    use crate::export::{PhaseMap, Run};
    use crate::image::{Mono8, Plane};
    use proptest::prelude::{any, prop_assert, prop_assert_eq, proptest};

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

    proptest! {
        #[test]
        fn every_pair_becomes_two_rows(
            rows in proptest::collection::vec(proptest::collection::vec(any::<Option<i16>>(), 7), 1..6),
        ) {
            let rows: Vec<Vec<Option<i32>>> =
                rows.into_iter().map(|row| row.into_iter().map(|x| x.map(i32::from)).collect()).collect();
            let height = 2 * rows.len() + 1;
            let found = unfold(&map(&rows), height as u16);
            let mut expected = vec![vec![None; 7]; height - 1];
            for (v, out) in expected.iter_mut().enumerate() {
                let beside = if v % 2 == 0 { (v / 2).checked_sub(1) } else { Some(v / 2 + 1) };
                for (u, out) in out.iter_mut().enumerate() {
                    let beside = beside.and_then(|k| rows.get(k)).and_then(|row| row[u]);
                    *out = rows[v / 2][u].map(|own| {
                        let step = beside.map_or(0, |x| x - own);
                        own + if step.abs() <= STEP { (step + 2).div_euclid(4) } else { 0 }
                    });
                }
            }
            let expected = map(&expected);
            prop_assert_eq!(&found.runs, &expected.runs);
            prop_assert_eq!(&found.phase, &expected.phase);
            prop_assert_eq!(found.frame, [7, height as u16]);
            prop_assert!(found.light.iter().zip(&expected.light).all(|(x, y)| x % 100 == y % 100 && x / 100 == y / 200));
        }
    }

    #[test]
    fn a_plane_stays_one() {
        // Four steps of phase a row: eight a pair.
        let rows: Vec<Vec<Option<i32>>> =
            (0..5).map(|k| (0..9).map(|u| Some(8 * k + 100 * u)).collect()).collect();
        let found = unfold(&map(&rows), 10);
        let row = |v: usize| &found.phase[9 * v..9 * (v + 1)];
        for v in 1..8 {
            assert!(row(v).iter().zip(row(v + 1)).all(|(x, y)| y - x == 4), "{v}");
        }
    }

    #[test]
    fn light_is_the_mean_of_two_rows_and_what_is_over_exposed_stays_so() {
        let image = Plane::from_vec(3, 5, vec![10, 20, 251, 13, 30, 40, 1, 2, 3, 2, 2, 255, 9, 9, 9]);
        let mut folded = Plane::filled(3, 2, 0);
        fold(Mono8::from(&image.expect("15 pixels")), &mut folded);
        assert_eq!(folded.as_slice(), [11, 25, 251, 2, 2, 255]);
    }
}
