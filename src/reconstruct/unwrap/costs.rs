//! Costs of the steps between neighbours: how far each is from what the carrier and the surface around predict.
//!
//! Rows go down the image through rings that stay in the cache, and only the runs of the object are touched. All sums are
//! of whole numbers, so that what is added to a window and taken off again cancels exactly.

use super::boxes::{Ring, Taps, VECTOR, Window, find_blocks, padded, sum, whole_vectors};
use crate::image::Plane;
use crate::reconstruct::bits::WORD;
use crate::reconstruct::round::{nearest, whole};
use crate::reconstruct::runs::{Run, Runs};
use std::f32::consts::TAU;

/// Units of a rad in sums and costs.
pub(super) const UNITS: f32 = 1024.0;

/// Half sizes (columns and rows of the sensor) of the box in which the local mean step is taken.
const MEAN_STEP: (usize, usize) = (5, 3);

/// Half sizes (columns and rows of the sensor) of the boxes in which residuals are averaged: along the boundary that steps to
/// the right and steps down cross.
const ALONG: [(usize, usize); 2] = [(1, 3), (4, 1)];

/// Half sizes (columns and rows of the sensor) of the box that says whether phases agree over a longer stretch.
const STRETCH: (usize, usize) = (9, 10);

/// A window that crosses a depth step does not hold a sine: what the misfit of the fringe model has above this
/// is added to the cost, 1 rad per unit. On smooth skin the misfit stays below it.
const GOOD_MISFIT: f32 = 0.2;

/// Bits of a packed sum that count its values: boxes have fewer than 512 pixels.
const COUNT_BITS: u32 = 9;

/// Half sizes (columns, rows of the image) of the boxes above.
#[derive(Debug, Clone, Copy, Default)]
struct Boxes {
    mean_step: (usize, usize),
    along: [(usize, usize); 2],
    stretch: (usize, usize),
}

impl Boxes {
    /// Where a pixel of the image stands for so many columns, and is the mean of so many rows, of the sensor.
    fn of(sensor_columns: usize, sensor_rows: usize) -> Self {
        let of = |(columns, rows): (usize, usize)| {
            ((columns / sensor_columns).max(1), (rows / sensor_rows).max(1))
        };
        Self { mean_step: of(MEAN_STEP), along: ALONG.map(of), stretch: of(STRETCH) }
    }

    /// Rows that costs lag behind the steps.
    fn lag(&self) -> usize {
        self.mean_step.1 + self.stretch.1
    }
}

/// A step that is no edge.
pub(super) const NONE: u16 = u16::MAX;

/// What a doubtful step has more in its code than the units of its cost, so that what is certain is below a bound. The units of
/// as many steps as a segment has come to less.
const DOUBTFUL: u16 = 1 << 15;

/// Units in a sum of codes.
#[inline(always)]
pub(super) const fn units(sum: u32) -> u32 {
    sum % DOUBTFUL as u32
}

/// Doubtful steps in a sum of codes.
#[inline(always)]
pub(super) const fn doubtful(sum: u32) -> u32 {
    sum / DOUBTFUL as u32
}

/// Bounds on residuals, units.
#[derive(Debug, Clone, Copy)]
pub(super) struct Bounds {
    pub largest: f32,
    pub doubtful: f32,
    pub doubtful_stretch: f32,
}

/// What costs follow from.
#[derive(Debug, Clone, Copy)]
pub(super) struct Input<'a> {
    pub wrapped: &'a Plane<f32>,
    pub period: &'a Plane<f32>,
    pub misfit: &'a Plane<f32>,
    /// All known phases lie in these.
    pub runs: &'a Runs,
    /// That of the phase along the columns.
    pub sign: f32,
    /// Columns of the sensor that a column stands for, and rows that a row is the mean of.
    pub sensor_columns: usize,
    pub sensor_rows: usize,
}

/// What is known of the steps to one side.
#[derive(Debug, Default)]
struct Side {
    steps: Ring,
    residuals: Ring,
    mean: Window,
    along: Window,
    stretch: Window,
    /// Costs of one run, units.
    costs: Vec<f32>,
    /// Costs of one row.
    codes: Vec<u16>,
}

impl Side {
    fn begin(&mut self, width: usize, boxes: &Boxes, along: (usize, usize)) {
        // One more than a window has: the row that leaves it.
        self.steps.begin(2 * boxes.mean_step.1 + 2, width);
        self.residuals.begin(2 * boxes.stretch.1 + 2, width);
        self.mean.begin(width, boxes.mean_step);
        self.along.begin(width, along);
        self.stretch.begin(width, boxes.stretch);
        self.costs.resize(width + VECTOR, 0.0);
        self.codes.resize((width + VECTOR).next_multiple_of(WORD), NONE);
    }

    /// How far the steps of row `v` are from the mean around them.
    #[inline(always)]
    fn residuals(&mut self, v: usize, runs: &Runs, blocks: &Runs, taps: &mut Taps) {
        let row = self.residuals.fresh(v, runs);
        let means = self.mean.boxes(blocks.row(v), taps);
        for run in runs.row(v) {
            let (start, n) = (padded(run).start, whole_vectors(run));
            let (steps, [a, b, c]) = (&self.steps.row(v)[start..][..n], means.of(run.start(), n));
            let out = &mut row[start..][..n];
            for i in 0..n {
                let residual = apart((steps[i] >> COUNT_BITS) as f32 - mean(sum(a[i], b[i], c[i])));
                out[i] = if steps[i] == 0 { 0 } else { counted(residual) };
            }
        }
    }

    /// Costs of the steps of row `v`, whose misfit adds `excess`.
    #[inline(always)]
    fn costs(
        &mut self,
        v: usize,
        excess: &[f32],
        bounds: &Bounds,
        [runs, blocks]: [&Runs; 2],
        taps: &mut [Taps; 2],
    ) {
        let [taps, more] = taps;
        let along = self.along.boxes(blocks.row(v), taps);
        let stretch = self.stretch.boxes(blocks.row(v), more);
        for run in runs.row(v) {
            let (column, start, n) = (run.start(), padded(run).start, whole_vectors(run));
            let own = &self.residuals.row(v)[start..][..n];
            let [a, b, c] = along.of(column, n);
            let excess = &excess[column..][..n];
            let (costs, out) = (&mut self.costs[..n], &mut self.codes[column..][..n]);
            for i in 0..n {
                let (residual, around) = ((own[i] >> COUNT_BITS) as f32, mean(sum(a[i], b[i], c[i])));
                let worse = if residual < around { around } else { residual };
                costs[i] = worse + excess[i];
            }
            // By themselves: else the compiler makes branches of these choices where vectors have no masks.
            let [a, b, c] = stretch.of(column, n);
            for i in 0..n {
                let (cost, around) = (costs[i], sum(a[i], b[i], c[i]));
                let doubtful = (cost > bounds.doubtful) | mean_exceeds(around, bounds.doubtful_stretch);
                // What is large is no edge; NaN is none, either, whatever its units come to.
                let edge = (own[i] != 0) & (cost <= bounds.largest);
                let code = whole(cost) as u16 | if doubtful { DOUBTFUL } else { 0 };
                out[i] = if edge { code } else { NONE };
            }
        }
    }
}

/// Rings and sums that are used again from frame to frame.
#[derive(Debug, Default)]
pub(super) struct Buffers {
    right: Side,
    down: Side,
    taps: [Taps; 2],
    blocks: Runs,
    excess: Vec<f32>,
    turns: Vec<i16>,
}

/// Codes of a row's steps to the right and down, by column: the units of their costs, [`DOUBTFUL`], [`NONE`]. They end with a whole
/// word; what lies beside the runs is any.
pub(super) struct Row<'a> {
    pub right: &'a [u16],
    pub down: &'a [u16],
}

/// Takes the costs of all rows, from top to bottom, and hands them to `each`. `turns` receives how many whole turns make
/// each pixel's phase continue those before it in its run.
#[inline(always)]
pub(super) fn run(
    input: &Input<'_>,
    bounds: &Bounds,
    buffers: &mut Buffers,
    turns: &mut Plane<i16>,
    mut each: impl FnMut(usize, Row<'_>, &Plane<i16>),
) {
    let (w, h) = (input.wrapped.width(), input.wrapped.height());
    let Buffers { right, down, taps, blocks, excess, turns: row_turns } = buffers;
    let boxes = Boxes::of(input.sensor_columns, input.sensor_rows);
    let lag = boxes.lag();
    right.begin(w, &boxes, boxes.along[0]);
    down.begin(w, &boxes, boxes.along[1]);
    taps.iter_mut().for_each(|taps| taps.begin(w));
    find_blocks(input.runs, blocks);
    excess.resize(w + VECTOR, 0.0);
    row_turns.resize(w, 0);
    for next in 0..h + lag {
        if next < h {
            steps_right(input, next, right.steps.fresh(next, input.runs), row_turns);
            add_up(input.runs.row(next), row_turns, turns.row_mut(next));
            steps_down(input, next, down.steps.fresh(next, input.runs));
        }
        if let Some(v) = next.checked_sub(lag) {
            find_excess(input.misfit.row(v), input.runs.row(v), excess);
        }
        for side in [&mut *right, &mut *down] {
            side.mean.advance(next, &side.steps, blocks);
            if let Some(v) = next.checked_sub(boxes.mean_step.1)
                && v < h
            {
                side.residuals(v, input.runs, blocks, &mut taps[0]);
            }
            // Windows begin above the first row: what lies before it is nothing.
            let Some(v) = next.checked_sub(boxes.mean_step.1) else { continue };
            side.stretch.advance(v, &side.residuals, blocks);
            if let Some(last) = (v + side.along.half.1).checked_sub(boxes.stretch.1) {
                side.along.advance(last, &side.residuals, blocks);
            }
            if let Some(v) = next.checked_sub(lag) {
                side.costs(v, excess, bounds, [input.runs, blocks], taps);
            }
        }
        if let Some(v) = next.checked_sub(lag) {
            each(v, Row { right: &right.codes, down: &down.codes }, turns);
        }
    }
}

/// Steps to the right of row `v` less the carrier's, and the whole turns that they lack.
#[inline(always)]
fn steps_right(input: &Input<'_>, v: usize, out: &mut [i32], turns: &mut [i16]) {
    let (row, period) = (input.wrapped.row(v), input.period.row(v));
    let carrier = 2.0 * input.sensor_columns as f32 * input.sign * TAU;
    for run in input.runs.row(v) {
        // The last pixel has no step.
        let n = run.columns().len() - 1;
        let (start, end) = (run.start(), run.end());
        let (a, b) = (&row[start..end - 1][..n], &row[start + 1..end][..n]);
        let (p, q) = (&period[start..end - 1][..n], &period[start + 1..end][..n]);
        let (out, turns) = (&mut out[padded(run)][..n], &mut turns[start..end - 1][..n]);
        for i in 0..n {
            let x = b[i] - a[i] - carrier / (p[i] + q[i]);
            let rounded = turns_in(x);
            let value = packed(x - rounded * TAU);
            out[i] = value;
            turns[i] = if value == 0 { 0 } else { -whole(rounded) as i16 };
        }
    }
}

/// Steps down from row `v`.
#[inline(always)]
fn steps_down(input: &Input<'_>, v: usize, out: &mut [i32]) {
    if v + 1 >= input.wrapped.height() {
        return;
    }
    let (row, next) = (input.wrapped.row(v), input.wrapped.row(v + 1));
    for run in input.runs.row(v) {
        let n = run.columns().len();
        let (a, b) = (&row[run.columns()][..n], &next[run.columns()][..n]);
        let out = &mut out[padded(run)][..n];
        for i in 0..n {
            let x = b[i] - a[i];
            out[i] = packed(x - turns_in(x) * TAU);
        }
    }
}

/// What the misfit of a row's pixels adds to costs.
#[inline(always)]
fn find_excess(misfit: &[f32], runs: &[Run], out: &mut [f32]) {
    for run in runs {
        for (out, misfit) in out[run.columns()].iter_mut().zip(&misfit[run.columns()]) {
            let excess = misfit - GOOD_MISFIT;
            *out = UNITS * if excess > 0.0 { excess } else { 0.0 };
        }
    }
}

/// Whole turns in a phase, as a whole number; any where it is NaN.
#[inline(always)]
pub(super) fn turns_in(phase: f32) -> f32 {
    nearest(phase * (1.0 / TAU))
}

/// Sums of the turns before each pixel of its run.
#[inline(always)]
fn add_up(runs: &[Run], steps: &[i16], out: &mut [i16]) {
    for run in runs {
        let mut sum = 0i16;
        for (out, step) in out[run.columns()].iter_mut().zip(&steps[run.columns()]) {
            *out = sum;
            sum = sum.wrapping_add(*step);
        }
    }
}

/// A step, rad, in a word; 0 for NaN.
#[inline(always)]
fn packed(x: f32) -> i32 {
    let value = counted(x * UNITS);
    if x.is_nan() { 0 } else { value }
}

/// Units, rounded, and a count of one. (A sum: one with the constant that rounding takes off.)
#[inline(always)]
fn counted(units: f32) -> i32 {
    (whole(units) << COUNT_BITS).wrapping_add(1)
}

/// The mean of a packed sum; NaN where there is nothing in it.
#[inline(always)]
fn mean(sum: i32) -> f32 {
    let count = sum & ((1 << COUNT_BITS) - 1);
    (sum >> COUNT_BITS) as f32 / count as f32
}

/// Whether [`mean`] is above a bound, without dividing.
#[inline(always)]
fn mean_exceeds(sum: i32, bound: f32) -> bool {
    let count = sum & ((1 << COUNT_BITS) - 1);
    (sum >> COUNT_BITS) as f32 > bound * count as f32
}

/// How far a difference of two steps is from no turn or a whole one, in units.
#[inline(always)]
fn apart(difference: f32) -> f32 {
    const TURN: f32 = TAU * UNITS;
    let (below, above) = (difference.abs(), TURN - difference.abs());
    if below < above { below } else { above }
}

#[cfg(test)]
mod tests {
    use super::{Bounds, Boxes, Buffers, GOOD_MISFIT, Input, NONE, UNITS, doubtful, run, units};
    use crate::image::Plane;
    use crate::reconstruct::runs::Runs;
    use crate::reconstruct::unwrap::blocks::COLUMNS;
    use proptest::prelude::{ProptestConfig, any, prop_assert, proptest};
    use std::f64::consts::TAU;

    const W: usize = 70;
    const H: usize = 40;
    const PERIOD: f32 = 11.0;

    /// Mean of the known values in a box; `None` where there is none.
    fn mean(values: &Plane<f64>, (u, v): (usize, usize), half: (usize, usize)) -> f64 {
        let rows = v.saturating_sub(half.1)..(v + half.1 + 1).min(H);
        let columns = u.saturating_sub(half.0)..(u + half.0 + 1).min(W);
        let all = rows.flat_map(|v| values.row(v)[columns.clone()].to_vec());
        let known: Vec<f64> = all.filter(|x| !x.is_nan()).collect();
        known.iter().sum::<f64>() / known.len().max(1) as f64
    }

    fn wrap(x: f64) -> f64 {
        x - TAU * (x / TAU).round()
    }

    /// Steps less the carrier's, to the right or down.
    fn steps(wrapped: &Plane<f32>, down: bool, sensor_columns: usize) -> Plane<f64> {
        let mut out = Plane::filled(W, H, f64::NAN);
        for v in 0..H - usize::from(down) {
            for u in 0..W - usize::from(!down) {
                let next = if down { wrapped.at(u, v + 1) } else { wrapped.at(u + 1, v) };
                let carrier = if down { 0.0 } else { sensor_columns as f64 * TAU / f64::from(PERIOD) };
                out.set(u, v, wrap(f64::from(next) - f64::from(wrapped.at(u, v)) - carrier));
            }
        }
        out
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(12))]
        #[test]
        fn costs_are_those_of_the_definition(
            noise in proptest::collection::vec(-1.0f32..1.0, W * H),
            rough in 0.0f32..0.3,
            sensor_rows in 1usize..=2,
            in_blocks in any::<bool>(),
            holes in proptest::collection::vec((any::<proptest::sample::Index>(), 0usize..30), 0..12),
        ) {
            let sensor_columns = if in_blocks { COLUMNS } else { 1 };
            let step = sensor_columns as f32 * std::f32::consts::TAU / PERIOD;
            let phase = |i: usize| (i % W) as f32 * step + 0.1 * (i / W) as f32;
            let value = |i: usize| phase(i) + rough * noise[i];
            let mut wrapped = Plane::from_vec(W, H, (0..W * H).map(|i| wrap(f64::from(value(i))) as f32).collect())
                .expect("its size");
            for (at, length) in holes {
                let at = at.index(W * H - 30);
                wrapped.as_mut_slice()[at..at + length].fill(f32::NAN);
            }
            let misfit = Plane::from_vec(W, H, noise.iter().map(|x| 0.3 * x.abs()).collect()).expect("its size");
            let known = wrapped.as_slice().iter().map(|x| u8::from(!x.is_nan())).collect();
            let runs = Runs::of(&Plane::from_vec(W, H, known).expect("its size"));
            let period = Plane::filled(W, H, PERIOD);
            let input =
                Input { wrapped: &wrapped, period: &period, misfit: &misfit, runs: &runs, sign: 1.0, sensor_columns, sensor_rows };
            let Boxes { mean_step, along, stretch } = Boxes::of(sensor_columns, sensor_rows);
            let bounds = Bounds { largest: 1.5 * UNITS, doubtful: 0.04 * UNITS, doubtful_stretch: 0.04 * UNITS };
            let mut turns = Plane::filled(W, H, 0);
            let mut found = [Plane::filled(W, H, NONE), Plane::filled(W, H, NONE)];
            run(&input, &bounds, &mut Buffers::default(), &mut turns, |v, costs, _| {
                found[0].row_mut(v).copy_from_slice(&costs.right[..W]);
                found[1].row_mut(v).copy_from_slice(&costs.down[..W]);
            });
            for (found, down) in found.iter().zip([false, true]) {
                let steps = steps(&wrapped, down, sensor_columns);
                let mut own = Plane::filled(W, H, f64::NAN);
                for (v, u) in (0..H).flat_map(|v| (0..W).map(move |u| (v, u))) {
                    own.set(u, v, wrap(steps.at(u, v) - mean(&steps, (u, v), mean_step)).abs());
                }
                for (v, u) in (0..H).flat_map(|v| (0..W).map(move |u| (v, u))) {
                    if wrapped.at(u, v).is_nan() {
                        continue;
                    }
                    let code = found.at(u, v);
                    if own.at(u, v).is_nan() {
                        prop_assert!(code == NONE, "({u}, {v}): {code}");
                        continue;
                    }
                    let along = mean(&own, (u, v), along[usize::from(down)]);
                    let excess = f64::from((misfit.at(u, v) - GOOD_MISFIT).max(0.0));
                    let cost = 1024.0 * (own.at(u, v).max(along) + excess);
                    // Values, their means and the means of their residuals are rounded to whole units.
                    let (found, doubtful) = (units(code.into()), doubtful(code.into()) != 0);
                    prop_assert!((f64::from(found) - cost).abs() < 3.0, "({u}, {v}): {found} {cost}");
                    let stretch = 1024.0 * mean(&own, (u, v), stretch);
                    let most = cost.max(stretch);
                    if (most - 40.96).abs() > 3.0 {
                        prop_assert!(doubtful == (most > 40.96), "({u}, {v}): {cost} {stretch}");
                    }
                }
            }
        }
    }
}
