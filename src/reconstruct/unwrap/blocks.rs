//! Rows in blocks of a few pixels: where rows are taken in pairs, the forest is made of these, for phases are means over windows as wide
//! as a fringe, and those beside each other say nearly the same.
//!
//! A block has the phase that the first of its pixels that has one gives the first of its pixels. Its other pixels lead that by the
//! carrier's steps, less whole turns. (The blocks of `boxes` are another thing: what vectors work on at once.)

use super::costs::turns_in;
use super::{Input, Write};
use crate::image::Plane;
use crate::reconstruct::prefetch;
use crate::reconstruct::round::whole;
use crate::reconstruct::runs::{Run, Runs, fill_beside};
use crate::reconstruct::simd;
use std::f32::consts::TAU;
use std::ops::Range;

/// Pixels of a block.
pub(super) const COLUMNS: usize = 4;

/// A pixel further from where the carrier leads from its block may belong to the next one, rad.
const DOUBTFUL_RAD: f32 = 0.15;

/// By pixel of a block: twice the whole turns that it has more than its block, and 1 more where it may not belong to it.
type Leads = [i8; COLUMNS];

/// A frame of blocks.
#[derive(Debug, Default)]
pub(super) struct Blocks {
    pub wrapped: Plane<f32>,
    pub period: Plane<f32>,
    pub misfit: Plane<f32>,
    pub runs: Runs,
    /// [`Leads`] by pixel.
    leads: Plane<i8>,
}

impl Blocks {
    /// Takes the blocks of a frame whose phase has this sign along its rows.
    pub fn take(&mut self, phase: &Plane<f32>, input: &Input<'_>, sign: f32) {
        self.begin(phase, input.runs);
        simd::dispatch(
            #[inline(always)]
            || {
                for v in 0..phase.height() {
                    self.take_row(phase, input, sign, v);
                }
            },
        );
    }

    /// Finds the runs of a frame's blocks.
    fn begin(&mut self, phase: &Plane<f32>, runs: &Runs) {
        let (w, h) = (phase.width().div_ceil(COLUMNS), phase.height());
        for plane in [&mut self.wrapped, &mut self.period, &mut self.misfit] {
            plane.reshape(w, h, f32::NAN);
        }
        self.leads.reshape(w * COLUMNS, h, 0);
        self.runs.clear();
        for v in 0..h {
            for run in runs.row(v) {
                // Two may share a block.
                self.runs.push_joined(Run::new(run.start() / COLUMNS, run.end().div_ceil(COLUMNS)));
            }
            self.runs.end_row();
        }
    }

    #[inline(always)]
    fn take_row(&mut self, phase: &Plane<f32>, input: &Input<'_>, sign: f32, v: usize) {
        let from = [phase, input.period, input.misfit];
        from.into_iter().for_each(|plane| prefetch::row(plane, input.runs, v + prefetch::AHEAD));
        let from = from.map(|plane| plane.row(v).as_chunks::<COLUMNS>());
        let rest = from.map(|(_, rest)| {
            let mut block = [f32::NAN; COLUMNS];
            block[..rest.len()].copy_from_slice(rest);
            block
        });
        let from = from.map(|(blocks, _)| blocks);
        let Self { wrapped, period, misfit, runs, leads } = self;
        let mut to = [wrapped.row_mut(v), period.row_mut(v), misfit.row_mut(v)];
        let leads = leads.row_mut(v).as_chunks_mut().0;
        fill_beside(runs.row(v), to[0], f32::NAN);
        for run in runs.row(v) {
            // The last block of a frame may have fewer pixels.
            let (start, whole) = (run.start(), run.end().min(from[0].len()));
            let n = whole - start;
            let [phase, period, misfit] = from.map(|row| &row[start..whole][..n]);
            let [a, b, c] = to.each_mut().map(|row| &mut row[start..whole][..n]);
            let leads_here: &mut [Leads] = &mut leads[start..whole][..n];
            for i in 0..n {
                ([a[i], b[i], c[i]], leads_here[i]) = block([&phase[i], &period[i], &misfit[i]], sign);
            }
            if whole < run.end() {
                let (values, of_pixels) = block(rest.each_ref(), sign);
                to.iter_mut().zip(values).for_each(|(row, value)| row[whole] = value);
                leads[whole] = of_pixels;
            }
        }
    }

    /// Whole turns that a pixel has more than its block.
    #[inline(always)]
    pub fn lead(&self, u: usize, v: usize) -> i32 {
        i32::from(self.leads.at(u, v) >> 1)
    }

    /// A row of blocks, each with so many turns.
    #[inline(always)]
    pub fn row<'a>(&'a self, v: usize, turns: &'a [i16], sign: f32) -> Row<'a> {
        Row {
            wrapped: self.wrapped.row(v),
            period: self.period.row(v),
            leads: self.leads.row(v),
            turns,
            sign,
        }
    }
}

/// Phase, period and misfit of a block, of those of its pixels, and the pixels' leads.
#[inline(always)]
fn block([phase, period, misfit]: [&[f32; COLUMNS]; 3], sign: f32) -> ([f32; 3], Leads) {
    let last = COLUMNS - 1;
    let (mut first, mut at, mut p, mut m) = (phase[last], last as f32, period[last], misfit[last]);
    for j in (0..last).rev() {
        let known = !phase[j].is_nan();
        first = if known { phase[j] } else { first };
        at = if known { j as f32 } else { at };
        p = if known { period[j] } else { p };
        m = if known { misfit[j] } else { m };
    }
    let step = sign * TAU / p;
    let own = first - at * step;
    let mut leads = [0; COLUMNS];
    for j in 0..COLUMNS {
        let beyond = phase[j] - own - j as f32 * step;
        let turns = turns_in(beyond);
        let doubtful = (beyond - TAU * turns).abs() > DOUBTFUL_RAD;
        // Of a pixel without a phase it is any.
        leads[j] = whole(turns).wrapping_mul(-2).wrapping_add(i32::from(doubtful)) as i8;
    }
    ([own, p, m], leads)
}

/// A row of blocks.
#[derive(Debug, Clone, Copy)]
pub(super) struct Row<'a> {
    wrapped: &'a [f32],
    period: &'a [f32],
    leads: &'a [i8],
    turns: &'a [i16],
    sign: f32,
}

impl Write for Row<'_> {
    const COLUMNS: usize = COLUMNS;

    #[inline(always)]
    fn add(&self, phase: &mut [f32], blocks: Range<usize>, base: i32) {
        let Range { start, end } = blocks;
        let (blocks, rest) = phase.as_chunks_mut::<COLUMNS>();
        let whole = end.min(blocks.len());
        let n = whole - start;
        let blocks = &mut blocks[start..whole][..n];
        let leads = self.leads.as_chunks::<COLUMNS>().0;
        let own = &leads[start..whole][..n];
        let turns = &self.turns[start..whole][..n];
        for i in 0..n {
            let of_block = base + i32::from(turns[i]);
            for j in 0..COLUMNS {
                blocks[i][j] += TAU * (of_block + i32::from(own[i][j] >> 1)) as f32;
            }
        }
        if whole < end {
            let of_block = base + i32::from(self.turns[whole]);
            for (phase, lead) in rest.iter_mut().zip(leads[whole]) {
                *phase += TAU * (of_block + i32::from(lead >> 1)) as f32;
            }
        }
    }

    #[inline(always)]
    fn part(&self, phase: &mut [f32], block: usize, bases: [i32; 2]) -> usize {
        // Few may.
        if self.leads[COLUMNS * block - 1] & 1 == 0 { 0 } else { self.part_doubtful(phase, block, bases) }
    }
}

impl Row<'_> {
    #[inline(never)]
    fn part_doubtful(&self, phase: &mut [f32], block: usize, bases: [i32; 2]) -> usize {
        let [own, next] = [block - 1, block];
        let absolute = |block: usize, base: i32| {
            self.wrapped[block] + TAU * (base + i32::from(self.turns[block])) as f32
        };
        let (before, behind) = (absolute(own, bases[0]), absolute(next, bases[1]));
        let step = |block: usize| self.sign * TAU / self.period[block];
        for taken in 1..COLUMNS {
            let phase = &mut phase[COLUMNS * block - taken];
            let from_own = (*phase - before - (COLUMNS - taken) as f32 * step(own)).abs();
            let beyond = behind - taken as f32 * step(next) - *phase;
            let turns = turns_in(beyond);
            if (beyond - TAU * turns).abs() < from_own {
                *phase += TAU * turns;
            } else {
                // So, too, where it is unknown.
                return taken - 1;
            }
        }
        COLUMNS - 1
    }
}

#[cfg(test)]
mod tests {
    use super::{Blocks, COLUMNS, DOUBTFUL_RAD, Input, Write};
    use crate::image::Plane;
    use crate::reconstruct::runs::Runs;
    use proptest::prelude::{ProptestConfig, any, prop_assert, proptest};
    use std::f32::consts::{PI, TAU};

    /// Odd, and no multiple of a block.
    const W: usize = 61;
    const H: usize = 3;
    const PERIOD: f32 = 11.0;

    fn wrap(x: f32) -> f32 {
        x - TAU * (x / TAU).round()
    }

    /// Blocks of a phase, a whole one or a wrapped one, NaN where there is none.
    fn blocks(phase: &Plane<f32>, sign: f32) -> Blocks {
        let known = phase.as_slice().iter().map(|x| u8::from(!x.is_nan())).collect();
        let runs = Runs::of(&Plane::from_vec(W, H, known).expect("its size"));
        let (period, misfit) = (Plane::filled(W, H, PERIOD), Plane::filled(W, H, 0.0));
        let input = Input { period: &period, misfit: &misfit, anchor: &Plane::filled(W, H, 0), runs: &runs };
        let mut blocks = Blocks::default();
        blocks.take(phase, &input, sign);
        blocks
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn every_pixel_continues_its_block(
            noise in proptest::collection::vec(-3.0f32..3.0, W * H),
            rough in 0.0f32..1.0,
            rising in any::<bool>(),
            holes in proptest::collection::vec((0..W * H - 12, 0usize..12), 0..12),
        ) {
            let sign = if rising { 1.0 } else { -1.0 };
            let step = sign * TAU / PERIOD;
            let values = (0..W * H).map(|i| wrap((i % W) as f32 * step + rough * noise[i])).collect();
            let mut phase = Plane::from_vec(W, H, values).expect("its size");
            for (at, length) in holes {
                phase.as_mut_slice()[at..at + length].fill(f32::NAN);
            }
            let blocks = blocks(&phase, sign);
            for (v, u) in (0..H).flat_map(|v| (0..W).map(move |u| (v, u))) {
                let (x, block) = (phase.at(u, v), u / COLUMNS);
                if x.is_nan() {
                    continue;
                }
                prop_assert!(blocks.runs.row(v).iter().any(|run| run.columns().contains(&block)));
                let expected = blocks.wrapped.at(block, v) + (u % COLUMNS) as f32 * step;
                let off = x + TAU * blocks.lead(u, v) as f32 - expected;
                prop_assert!(off.abs() <= PI + 1e-3, "({u}, {v}): {off}");
                if (off.abs() - DOUBTFUL_RAD).abs() > 1e-3 {
                    prop_assert!((blocks.leads.at(u, v) & 1 != 0) == (off.abs() > DOUBTFUL_RAD), "({u}, {v}): {off}");
                }
            }
            for v in 0..H {
                for block in 0..W.div_ceil(COLUMNS) {
                    let pixels = COLUMNS * block..(COLUMNS * block + COLUMNS).min(W);
                    let none = phase.row(v)[pixels].iter().all(|x| x.is_nan());
                    prop_assert!(blocks.wrapped.at(block, v).is_nan() == none, "{block} of row {v}");
                }
            }
        }

        #[test]
        fn pixels_beside_a_step_go_with_their_surface(at in 8usize..40, step in 0.5f32..5.7, turns in -3i32..3) {
            let truth = |u: usize| {
                u as f32 * TAU / PERIOD + if u < at { 0.0 } else { step + TAU * turns as f32 }
            };
            let row: Vec<f32> = (0..W).map(truth).collect();
            let values = (0..W * H).map(|i| wrap(row[i % W])).collect();
            let phase = Plane::from_vec(W, H, values).expect("its size");
            let blocks = blocks(&phase, 1.0);
            // The first block whose first pixel lies beyond the step.
            let behind = at.div_ceil(COLUMNS);
            let turns: Vec<i16> = (0..blocks.wrapped.width())
                .map(|block| ((row[COLUMNS * block] - phase.at(COLUMNS * block, 0)) / TAU).round() as i16)
                .collect();
            let written = blocks.row(0, &turns, 1.0);
            let mut found = phase.row(0).to_vec();
            written.add(&mut found, 0..behind, 0);
            let taken = written.part(&mut found, behind, [0, 0]);
            written.add(&mut found, behind..turns.len(), 0);
            prop_assert!(taken == COLUMNS * behind - at, "{taken} of {}", COLUMNS * behind - at);
            for (u, (found, truth)) in found.iter().zip(&row).enumerate() {
                prop_assert!((found - truth).abs() < 1e-3, "{u}: {found} {truth}");
            }
        }
    }
}
