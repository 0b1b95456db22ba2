//! Which row of a pair stands alone, where the two rows see different surfaces.
//!
//! The outline of a limb runs between the two rows of a pair as often as between two pairs. The mean of the two rows then is the light of no
//! surface, its phase anything between theirs, and one of the two rows would be given a phase that is not its own. What tells is
//! how the two rows differ over most of a period of the fringe, relative to what the fringe itself comes to. Of such a pair one row is
//! taken alone: the bright one where the other is background, else the one that goes on in the row beside the pair.

use super::row_pairs::{Side, Single};
use super::runs::{Run, Runs, runs_of};
use super::simd;
use crate::image::{Mono8, Plane};
use std::ops::Range;

/// Rows differ when the sum of their differences over most of a period is more than `APART[0] / APART[1]` of the sum of the differences
/// between places about half a period apart, in the row where that is larger. Phases that differ by `d` come to `sin(d / 2)`: this is 0.9 rad.
const APART: [u16; 2] = [4, 9];

/// Differences within a row are taken for at least this, DN: what is darker is noise.
const LEAST_CONTRAST_DN: u16 = 6;

/// A row that is so many times darker than the other sees the background.
const DARK: u32 = 2;

/// Pixels that are decided together, at most.
const STRETCH_PX: usize = 16;

/// Pixels to each side that are summed, at most.
const MOST_HALF_PX: usize = 12;

/// Rows that are used again from frame to frame.
#[derive(Debug, Default)]
pub struct Buffers {
    /// Columns of the two rows, where they lie at the border of the frame.
    padded: [Vec<u8>; 2],
    /// What differs between the rows, and within each.
    differences: [Vec<u8>; 3],
    /// Sums of these.
    sums: [Vec<u16>; 3],
    /// Which pixels of a run are of two surfaces.
    apart: Vec<u8>,
    found: Vec<Range<usize>>,
}

/// Finds the pairs of `frame` whose rows see different surfaces, on the runs of the object in `folded`, which has the mean of each pair and is
/// given the light of the row that stands alone. `period_px`: the nominal period of the fringes.
pub fn part(
    frame: Mono8<'_>,
    object: &Runs,
    period_px: f32,
    folded: &mut Plane<u8>,
    buffers: &mut Buffers,
) -> Vec<Single> {
    let reach = Reach::of(period_px);
    let mut singles: Vec<Single> = Vec::new();
    for pair in 0..folded.height() {
        for run in object.row(pair) {
            reach.find(frame, pair, run, buffers);
            for found in &buffers.found {
                let mut first = found.start;
                while first < found.end {
                    let end = found.end.min(first + STRETCH_PX);
                    let side = reach.choose(frame, pair, first..end);
                    let row = &frame.row(side.row(pair))[first..end];
                    folded.row_mut(pair)[first..end].copy_from_slice(row);
                    add(
                        &mut singles,
                        Single { pair: pair as u16, first: first as u16, end: end as u16, side },
                    );
                    first = end;
                }
            }
        }
    }
    singles
}

/// Adds a stretch, or makes the last one longer.
fn add(singles: &mut Vec<Single>, single: Single) {
    match singles.last_mut() {
        Some(last) if (last.pair, last.end, last.side) == (single.pair, single.first, single.side) => {
            last.end = single.end;
        }
        _ => singles.push(single),
    }
}

/// How far stretches of a row are looked at, px.
#[derive(Debug, Clone, Copy)]
struct Reach {
    /// To each side of a pixel: together most of a period.
    half: usize,
    /// To each side for what is half a period apart.
    quarter: usize,
}

impl Reach {
    fn of(period_px: f32) -> Self {
        let half = ((0.4 * period_px).round() as usize).clamp(2, MOST_HALF_PX);
        Self { half, quarter: half.div_ceil(2) }
    }

    /// Pixels that are summed. The largest sum times the larger factor has room in 16 bits.
    fn window(self) -> usize {
        const { assert!((2 * MOST_HALF_PX + 1) * 255 * (APART[1] as usize) < 1 << 16) };
        2 * self.half + 1
    }

    /// Leaves in `buffers.found` the columns of a run in which the pair's rows differ.
    fn find(self, frame: Mono8<'_>, pair: usize, run: &Run, buffers: &mut Buffers) {
        let Buffers { padded: [above, below], differences, sums, apart, found } = buffers;
        found.clear();
        let (n, window, quarter) = (run.columns().len(), self.window(), self.quarter);
        let inner = n + window - 1;
        let columns = run.start() as isize - (self.half + quarter) as isize;
        let (a, b) = (
            columns_of(frame.row(2 * pair), columns, inner + 2 * quarter, above),
            columns_of(frame.row(2 * pair + 1), columns, inner + 2 * quarter, below),
        );
        differences.iter_mut().for_each(|row| row.resize(inner, 0));
        sums.iter_mut().for_each(|row| row.resize(n, 0));
        apart.resize(n, 0);
        let any = simd::dispatch(
            #[inline(always)]
            || {
                let [between, first, second] = differences;
                differ(&a[quarter..], &b[quarter..], between);
                differ(a, &a[2 * quarter..], first);
                differ(b, &b[2 * quarter..], second);
                for (sums, differences) in sums.iter_mut().zip([between, first, second]) {
                    add_up(differences, window, sums);
                }
                let [between, first, second] = sums;
                let (between, first, second) = (&between[..n], &first[..n], &second[..n]);
                let apart = &mut apart[..n];
                let least = LEAST_CONTRAST_DN * window as u16;
                let mut any = 0;
                for i in 0..n {
                    let contrast = first[i].max(second[i]).max(least);
                    apart[i] = u8::from(APART[1] * between[i] > APART[0] * contrast);
                    any |= apart[i];
                }
                any != 0
            },
        );
        if any {
            runs_of(apart, |first, end| found.push(run.start() + first..run.start() + end));
        }
    }

    /// The row of a pair that is taken alone in these columns.
    fn choose(self, frame: Mono8<'_>, pair: usize, columns: Range<usize>) -> Side {
        let wide = columns.start.saturating_sub(self.half)..(columns.end + self.half).min(frame.width());
        let (upper, lower) = (2 * pair, 2 * pair + 1);
        let light = |v: usize| frame.row(v)[wide.clone()].iter().map(|&x| u32::from(x)).sum::<u32>();
        let (a, b) = (light(upper), light(lower));
        if a > DARK * b || b > DARK * a {
            return if a > b { Side::Upper } else { Side::Lower };
        }
        let Some(above) = upper.checked_sub(1) else { return Side::Lower };
        if lower + 1 >= frame.height() {
            return Side::Upper;
        }
        // How either row goes on beside the pair, relative to its fringe.
        let [up, down] = [(above, upper), (lower, lower + 1)].map(|(v, w)| {
            let contrast = self.contrast(frame.row(v), &wide).max(self.contrast(frame.row(w), &wide));
            let least = u32::from(LEAST_CONTRAST_DN) * wide.len() as u32;
            let apart = distance(&frame.row(v)[wide.clone()], &frame.row(w)[wide.clone()]);
            (u64::from(apart), u64::from(contrast.max(least)))
        });
        if up.0 * down.1 <= down.0 * up.1 { Side::Upper } else { Side::Lower }
    }

    /// How places half a period apart differ in these columns of a row.
    fn contrast(self, row: &[u8], columns: &Range<usize>) -> u32 {
        let first = columns.start.saturating_sub(self.quarter);
        let end = (columns.end + self.quarter).min(row.len());
        let n = (end - first).saturating_sub(2 * self.quarter);
        distance(&row[first..][..n], &row[end - n..end])
    }
}

/// So many columns of a row from `first` on; beyond its ends they are 0.
fn columns_of<'a>(row: &'a [u8], first: isize, count: usize, padded: &'a mut Vec<u8>) -> &'a [u8] {
    if let Some(columns) = usize::try_from(first).ok().and_then(|first| row.get(first..first + count)) {
        return columns;
    }
    padded.clear();
    padded.extend(
        (first..first + count as isize)
            .map(|u| usize::try_from(u).ok().and_then(|u| row.get(u)).copied().unwrap_or(0)),
    );
    padded
}

/// The sum of all differences.
fn distance(a: &[u8], b: &[u8]) -> u32 {
    a.iter().zip(b).map(|(a, b)| u32::from(a.abs_diff(*b))).sum()
}

/// What differs, pixel by pixel.
#[inline(always)]
fn differ(a: &[u8], b: &[u8], out: &mut [u8]) {
    let n = out.len();
    let (a, b) = (&a[..n], &b[..n]);
    for i in 0..n {
        out[i] = a[i].abs_diff(b[i]);
    }
}

/// The sums of `window` values from each on, for as many as there is room for.
#[inline(always)]
fn add_up(values: &[u8], window: usize, sums: &mut [u16]) {
    let n = sums.len();
    let from = |first: usize| &values[first..][..n];
    sums.fill(0);
    // Four at a time, so that the sums are seldom read and written; whole rows, because sums of a block would be taken apart.
    let whole = window / 4 * 4;
    for first in (0..whole).step_by(4) {
        let (a, b, c, d) = (from(first), from(first + 1), from(first + 2), from(first + 3));
        for i in 0..n {
            let [a, b, c, d] = [u16::from(a[i]), u16::from(b[i]), u16::from(c[i]), u16::from(d[i])];
            sums[i] += (a + b) + (c + d);
        }
    }
    for first in whole..window {
        let values = from(first);
        for i in 0..n {
            sums[i] += u16::from(values[i]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{Buffers, add_up, part};
    use crate::image::{Mono8, Plane};
    use crate::reconstruct::row_pairs::{Side, Single, fold};
    use crate::reconstruct::runs::Runs;
    use proptest::prelude::{any, prop_assert, prop_assert_eq, proptest};
    use std::f32::consts::TAU;

    const PERIOD_PX: f32 = 12.0;
    const WIDTH: usize = 100;
    const HEIGHT: usize = 10;

    /// Fringes whose phase and strength in each row are `of(row)`: rad and DN.
    fn photograph(of: impl Fn(usize) -> (f32, f32)) -> Plane<u8> {
        let light = |v: usize, u: usize| {
            let (phase, strength) = of(v);
            (2.0 + strength * (1.0 + 0.8 * (TAU * u as f32 / PERIOD_PX + phase).cos())) as u8
        };
        let pixels = (0..HEIGHT).flat_map(|v| (0..WIDTH).map(move |u| (v, u))).map(|(v, u)| light(v, u));
        Plane::from_vec(WIDTH, HEIGHT, pixels.collect()).expect("so many pixels")
    }

    /// What stands alone in a photograph of which all is object, and what is left of the pairs.
    fn parted(photograph: &Plane<u8>) -> (Vec<Single>, Plane<u8>) {
        let mut folded = Plane::filled(photograph.width(), photograph.height() / 2, 0);
        fold(Mono8::from(photograph), &mut folded, &mut Plane::filled(photograph.width(), HEIGHT, 0));
        let object = Runs::of(&Plane::filled(folded.width(), folded.height(), 1));
        let singles = part(Mono8::from(photograph), &object, PERIOD_PX, &mut folded, &mut Buffers::default());
        (singles, folded)
    }

    /// The one stretch that stands alone, of nearly all columns, and has the light of its row.
    fn one(photograph: &Plane<u8>) -> (u16, Side) {
        let (singles, folded) = parted(photograph);
        let [Single { pair, first, end, side }] = singles[..] else { panic!("{singles:?}") };
        assert!(first < 6 && usize::from(end) > WIDTH - 6, "{first} to {end}");
        let row = photograph.row(side.row(usize::from(pair)));
        let columns = usize::from(first)..usize::from(end);
        assert_eq!(folded.row(usize::from(pair))[columns.clone()], row[columns]);
        (pair, side)
    }

    #[test]
    fn a_row_beside_the_background_stands_alone() {
        assert_eq!(one(&photograph(|v| (0.2 * v as f32, if v < 5 { 40.0 } else { 0.0 }))), (2, Side::Upper));
        assert_eq!(one(&photograph(|v| (0.2 * v as f32, if v < 5 { 0.0 } else { 40.0 }))), (2, Side::Lower));
    }

    /// Row 4 is the last of a surface, row 5 the first of another: the upper one that bends less, or the lower one.
    #[test]
    fn of_two_surfaces_the_row_that_goes_on_stands_alone() {
        let two = |bends: [f32; 2]| {
            photograph(
                |v| if v < 5 { (bends[0] * v as f32, 40.0) } else { (2.5 + bends[1] * v as f32, 40.0) },
            )
        };
        assert_eq!(one(&two([0.1, 0.4])), (2, Side::Upper));
        assert_eq!(one(&two([0.4, 0.1])), (2, Side::Lower));
    }

    #[test]
    fn a_surface_that_falls_away_is_one() {
        for phase in [0.0, 0.3, -0.6] {
            let (singles, _) = parted(&photograph(|v| (phase * v as f32, 40.0)));
            assert_eq!(singles, []);
        }
    }

    proptest! {
        #[test]
        fn sums_are_those_of_a_loop(
            values in proptest::collection::vec(any::<u8>(), 25..120),
            window in 1usize..26,
        ) {
            let mut sums = vec![7; values.len() + 1 - window];
            add_up(&values, window, &mut sums);
            for (sum, values) in sums.into_iter().zip(values.windows(window)) {
                prop_assert_eq!(sum, values.iter().map(|&x| u16::from(x)).sum::<u16>());
            }
        }

        /// Whatever is photographed: stretches lie in the object's runs, in order and apart, and what is not in one is the mean.
        #[test]
        fn stretches_are_of_the_object_and_in_order(
            pixels in proptest::collection::vec(any::<u8>(), 7 * 40),
            object in proptest::collection::vec(proptest::bool::weighted(0.9), 3 * 40),
            period in 4f32..40.0,
        ) {
            let photograph = Plane::from_vec(40, 7, pixels).expect("so many pixels");
            let object: Vec<u8> = object.into_iter().map(u8::from).collect();
            let object = Plane::from_vec(40, 3, object).expect("so many pixels");
            let mut means = Plane::filled(40, 3, 0);
            fold(Mono8::from(&photograph), &mut means, &mut Plane::filled(40, 3, 0));
            let mut folded = means.clone();
            let runs = Runs::of(&object);
            let singles = part(Mono8::from(&photograph), &runs, period, &mut folded, &mut Buffers::default());
            let mut expected = means;
            for single in &singles {
                let (pair, columns) = (usize::from(single.pair), usize::from(single.first)..usize::from(single.end));
                prop_assert!(!columns.is_empty() && object.row(pair)[columns.clone()].iter().all(|&x| x == 1));
                let row = photograph.row(single.side.row(pair));
                expected.row_mut(pair)[columns.clone()].copy_from_slice(&row[columns]);
            }
            prop_assert_eq!(folded.as_slice(), expected.as_slice());
            let in_order = |x: &[Single]| (x[0].pair, x[0].end) <= (x[1].pair, x[1].first) || x[0].pair < x[1].pair;
            prop_assert!(singles.windows(2).all(in_order), "{:?}", singles);
        }
    }
}
