// SPDX-License-Identifier: MIT OR Apache-2.0
//! The fringe period Pm of the default method: the paper's count of crossings, found once for a run.
//!
//! The paper's window has a median of its own for each pixel, so that crossings are sought anew in each
//! ([`crate::paper::period`]). Here the threshold is a sliding mean: a sine less its sliding mean is a sine of the
//! same period, so that the distance of crossings of equal direction is unbiased where the period does not change, and
//! one list of crossings serves all windows of a run. The crossings in a window change a few times in a period only,
//! so that whole stretches of pixels have the same period. All sums are whole numbers.

use crate::base::image::{Mono8, Plane};
use crate::kernels::bit_rows::{WORD, bits_of};
use crate::kernels::pixel_runs::{Run, Runs, Surroundings, fill_around};
use crate::kernels::sliding::extremes;
use crate::kernels::{fast_round, simd};

/// Fringe periods that are measured, px: shorter and longer ones count as unknown.
pub(crate) const PERIOD_RANGE_PX: std::ops::RangeInclusive<f32> = 5.0..=24.0;

/// A crossing counts once the light has left the threshold by this share of the window's range.
pub(crate) const HYSTERESIS: f32 = 0.12;

/// Columns to each side over which the period is smoothed.
pub(crate) const SMOOTH_COLUMNS: usize = 6;

/// Rows to each side over which the period is smoothed.
pub(crate) const SMOOTH_ROWS: usize = 1;

/// Crossings are counted over this many nominal periods to each side: the least that holds two whole periods.
pub(crate) const WINDOW_PERIODS: f32 = 1.3;

/// The threshold is the mean over this many nominal periods to each side. Shorter means find more crossings where the
/// light falls off towards an outline, and more wrong ones.
const LIGHT_PERIODS: f32 = 1.3;

/// Steps per px in which distances of crossings are summed, as whole numbers.
const STEPS: f32 = 4096.0;

/// Low bits of a sum, which count its distances; the bits above hold the distances themselves.
const COUNT_BITS: u32 = 8;

/// Rows that [`measure`] uses again from frame to frame.
#[derive(Debug, Default)]
pub struct Buffers {
    /// Largest and smallest value of the window that begins at each pixel; each with memory to compute it.
    high: [Vec<u8>; 2],
    low: [Vec<u8>; 2],
    /// Sums of the run's pixels before each.
    sums: Vec<u32>,
    /// Bits [`ABOVE`] and [`FAR`] of each pixel.
    sides: Vec<u8>,
    /// How far each pixel is above its threshold, times the length of the window that this is taken from.
    beyond: Vec<f32>,
    /// The crossings of a run, between [`NONE_BEFORE`] placeholders on either side.
    crossings: Vec<Crossing>,
    /// The first two crossings of the window that begins at each place; the last two of the window that ends there.
    after: Beside,
    before: Beside,
    /// Distances of crossings and their count, for the last three rows, with zeros to either side.
    raw: Vec<Vec<u32>>,
    /// Sums of `raw` over three rows, and of these over two and four neighbours.
    sums_of_rows: Vec<u32>,
    pairs: Vec<u32>,
    fours: Vec<u32>,
}

/// Placeholders in a list of crossings, before the first and behind the last, so that all have two neighbours on each
/// side.
const NONE_BEFORE: usize = 2;

/// Where the light crosses the threshold.
#[derive(Debug, Clone, Copy)]
struct Crossing {
    /// Column in the run, with its fraction.
    at: f32,
    /// The first whole column behind it.
    behind: u32,
    /// The column in the run at which the light had left the threshold by the margin.
    certain: u32,
}

/// Measures the period of each pixel of the runs, px, as the mean of those around it; 0 where it is unknown and around
/// the runs. Windows never leave a run.
pub(crate) fn measure(
    image: Mono8<'_>,
    (runs, around): (&Runs, &Surroundings),
    nominal_px: f32,
    buffers: &mut Buffers,
    period: &mut Plane<f32>,
) {
    let half = (WINDOW_PERIODS * nominal_px).round() as usize;
    let reach = (LIGHT_PERIODS * nominal_px).round() as usize;
    let (w, h) = (image.width(), image.height());
    period.reshape(w, h, 0.0);
    const RING: usize = 2 * SMOOTH_ROWS + 1;
    buffers.raw.resize(RING, Vec::new());
    for row in &mut buffers.raw {
        row.clear();
        row.resize(w + 2 * SMOOTH_COLUMNS, 0);
    }
    simd::dispatch(
        #[inline(always)]
        || {
            for v in 0..h + SMOOTH_ROWS {
                let mut raw = std::mem::take(&mut buffers.raw[v % RING]);
                if v >= h {
                    raw.fill(0);
                } else {
                    let row = &mut raw[SMOOTH_COLUMNS..SMOOTH_COLUMNS + w];
                    // The ring still holds the row that was there before.
                    let before = v.checked_sub(RING).map(|v| runs.row(v)).unwrap_or_default();
                    before.iter().for_each(|run| row[run.columns()].fill(0));
                    for run in runs.row(v) {
                        let light = &image.row(v)[run.columns()];
                        measure_run(light, half, reach, buffers, &mut row[run.columns()]);
                    }
                }
                buffers.raw[v % RING] = raw;
                if let Some(v) = v.checked_sub(SMOOTH_ROWS) {
                    let period = period.row_mut(v);
                    fill_around(runs.row(v), period, around.columns(v), 0.0);
                    smooth(runs.row(v), buffers, period);
                }
            }
        },
    );
}

/// Periods of one run before they are smoothed, from windows of +-`half` and thresholds of +-`reach`: distance in
/// [`STEPS`] and a count of 1, or 0.
#[inline(always)]
fn measure_run(row: &[u8], half: usize, reach: usize, buffers: &mut Buffers, raw: &mut [u32]) {
    let length = (2 * half + 1).min(row.len());
    let windows = row.len() - length + 1;
    let light = LightWindow { reach, length: (2 * reach + 1).min(row.len()) };
    extremes(row, 0, light.length, &mut buffers.high, u8::max);
    extremes(row, 0, light.length, &mut buffers.low, u8::min);
    add_up(row, &mut buffers.sums);
    find_sides(row, light, buffers);
    find_crossings(row.len(), buffers);
    let Buffers { crossings, after, before, .. } = buffers;
    after.spread(crossings, NONE_BEFORE, windows, |x| x.behind);
    before.spread(crossings, 0, row.len() + 1, |x| x.certain + 1);
    // Near the run's ends the window is shifted, not cut: two whole periods are needed.
    let from = if windows == 1 { 0 } else { half };
    let own = &mut raw[from..from + windows];
    mean_distances(after, before, length, own);
    let (first, last) = (own[0], own[windows - 1]);
    raw[..from].fill(first);
    raw[from + windows..].fill(last);
}

/// For each place of a run, how many crossings lie before it, and where the two crossings next to it on one side are.
#[derive(Debug, Default)]
struct Beside {
    count: Vec<f32>,
    at: [Vec<f32>; 2],
}

/// Places that are written at once: as many as there are between most crossings.
const BLOCK: usize = 8;

impl Beside {
    /// Fills the tables for `places` places. A crossing counts as before a place from the place `from` on. `skip` is
    /// the number in the list of the first of the two crossings of a place that has none before it.
    #[inline(always)]
    fn spread(
        &mut self,
        crossings: &[Crossing],
        skip: usize,
        places: usize,
        from: impl Fn(&Crossing) -> u32,
    ) {
        let room = places + BLOCK;
        let Self { count, at: [left, right] } = self;
        for row in [&mut *count, left, right] {
            row.resize(row.len().max(room), 0.0);
        }
        let (count, left, right) = (&mut count[..room], &mut left[..room], &mut right[..room]);
        let (mut place, mut passed) = (0, 0.0);
        for (next, two) in crossings[NONE_BEFORE..].iter().zip(crossings[skip..].windows(2)) {
            let end = (from(next) as usize).min(places);
            while place < end {
                // Places beyond `end` are written again by the next crossing.
                block(count, place, passed);
                block(left, place, two[0].at);
                block(right, place, two[1].at);
                place += BLOCK;
            }
            (place, passed) = (end, passed + 1.0);
        }
    }
}

/// Writes a value to a block of places that begins at `place`.
#[inline(always)]
fn block(row: &mut [f32], place: usize, value: f32) {
    if let Some(block) = row[place..].first_chunk_mut::<BLOCK>() {
        *block = [value; BLOCK];
    }
}

/// Mean distance of each crossing of a window to the next but one, which has its direction, in the form of
/// [`measure_run`]. All distances but those of the ends cancel.
#[inline(always)]
fn mean_distances(after: &Beside, before: &Beside, length: usize, raw: &mut [u32]) {
    let n = raw.len();
    let [passed, a, b] = [&after.count, &after.at[0], &after.at[1]].map(|x| &x[..n]);
    let [seen, c, d] = [&before.count, &before.at[0], &before.at[1]].map(|x| &x[length..length + n]);
    for i in 0..n {
        let distances = seen[i] - passed[i] - 2.0;
        let mean = (d[i] + c[i] - b[i] - a[i]) / distances;
        let mean = if distances == 1.0 { d[i] - a[i] } else { mean };
        let packed = packed(mean);
        raw[i] = if distances >= 1.0 { packed } else { 0 };
    }
}

/// A period, px: in [`STEPS`], with a count of one; 0 where it is none.
#[inline(always)]
fn packed(distance: f32) -> u32 {
    let packed = (fast_round::floor(distance * STEPS) as u32) << COUNT_BITS | 1;
    let known = (distance >= *PERIOD_RANGE_PX.start()) & (distance <= *PERIOD_RANGE_PX.end());
    if known { packed } else { 0 }
}

/// The windows that thresholds and margins are taken from.
#[derive(Debug, Clone, Copy)]
struct LightWindow {
    /// Columns to each side of a pixel, as far as the run goes, and all in all.
    reach: usize,
    length: usize,
}

/// Computes the sum of the row's pixels before each pixel.
#[inline(always)]
fn add_up(row: &[u8], sums: &mut Vec<u32>) {
    sums.resize(row.len() + 1, 0);
    sums[0] = 0;
    let mut sum = 0;
    for (out, &x) in sums[1..].iter_mut().zip(row) {
        sum += u32::from(x);
        *out = sum;
    }
}

/// Bit of a pixel whose light is above the threshold.
const ABOVE: u8 = 1;

/// Bit of a pixel whose light differs from the threshold by more than the margin.
const FAR: u8 = 2;

/// On which side of its threshold a pixel of `light` is, of whose window `length` pixels have this sum and range. All
/// is times that length.
#[inline(always)]
fn side(light: u8, length: i32, sum: u32, range: u8) -> (u8, f32) {
    let value = (i32::from(light) * length - sum as i32) as f32;
    let margin = HYSTERESIS * length as f32 * f32::from(range);
    ((if value > 0.0 { ABOVE } else { 0 }) | if value.abs() > margin { FAR } else { 0 }, value)
}

/// Finds on which side of its threshold each pixel of a run is.
#[inline(always)]
fn find_sides(row: &[u8], LightWindow { reach, length }: LightWindow, buffers: &mut Buffers) {
    let Buffers { high, low, sums, sides, beyond, .. } = buffers;
    beyond.resize(row.len(), 0.0);
    let (windows, length_px) = (row.len() - length + 1, length as i32);
    sides.resize(row.len().next_multiple_of(WORD), 0);
    sides[row.len()..].fill(0);
    let (starts, ends) = (&sums[..windows], &sums[length..length + windows]);
    let (high, low) = (&high[0][..windows], &low[0][..windows]);
    // Near the run's ends the window is shifted, not cut.
    let from = reach.min(row.len());
    let (before, rest) = sides[..row.len()].split_at_mut(from);
    let (own, behind) = rest.split_at_mut(windows.min(row.len() - from));
    let light = &row[from..from + own.len()];
    let n = own.len();
    let (starts_own, ends_own, high_own, low_own) = (&starts[..n], &ends[..n], &high[..n], &low[..n]);
    let beyond_own = &mut beyond[from..from + n];
    for i in 0..n {
        (own[i], beyond_own[i]) =
            side(light[i], length_px, ends_own[i] - starts_own[i], high_own[i] - low_own[i]);
    }
    let last = windows - 1;
    for (sides, from, window) in [(before, 0, 0), (behind, from + n, last)] {
        let (sum, range) = (ends[window] - starts[window], high[window] - low[window]);
        for ((side_of, beyond), &light) in sides.iter_mut().zip(&mut beyond[from..]).zip(&row[from..]) {
            (*side_of, *beyond) = side(light, length_px, sum, range);
        }
    }
}

/// The crossings of a run: a change of sign counts once the light has left the threshold by the margin on the other
/// side.
#[inline(always)]
fn find_crossings(pixels: usize, buffers: &mut Buffers) {
    let Buffers { sides, beyond, crossings, .. } = buffers;
    let beyond = &beyond[..pixels];
    crossings.clear();
    crossings.extend([Crossing { at: 0.0, behind: 0, certain: 0 }; NONE_BEFORE]);
    // Where the light last changed its side, and on which side it was last certain to be: 1 above.
    let (mut before, mut changed) = (u64::from(sides[0] & ABOVE), 0);
    let mut settled = None;
    for (k, word) in sides.as_chunks::<WORD>().0.iter().enumerate() {
        let (above, far) = (bits_of(word, ABOVE), bits_of(word, FAR));
        let changes = above ^ (above << 1 | before);
        before = above >> (WORD - 1);
        let last = |changes: u64| k * WORD + changes.ilog2() as usize;
        // Pixels of this word at which the light is far below and far above the threshold.
        let mut far = [far & !above, far & above];
        let first = (far[0] | far[1]).trailing_zeros();
        let mut side = settled.unwrap_or_else(|| usize::from(far[1].trailing_zeros() == first));
        while far[1 - side] != 0 {
            side = 1 - side;
            let certain = far[side].trailing_zeros();
            let until = changes & u64::MAX >> (WORD as u32 - 1 - certain);
            let seen = if until == 0 { changed } else { last(until) };
            if let Some([a, b]) = beyond[seen - 1..].first_chunk() {
                let column = seen as i32 as f32;
                let at = column - b / (b - a);
                let behind = seen as u32 + u32::from(at >= column);
                crossings.push(Crossing { at, behind, certain: (k * WORD) as u32 + certain });
            }
            far = far.map(|far| far & u64::MAX << certain);
        }
        settled = if first < u64::BITS { Some(side) } else { settled };
        changed = if changes == 0 { changed } else { last(changes) };
    }
    // Placeholders that no window reaches.
    crossings.extend([Crossing { at: 0.0, behind: u32::MAX, certain: u32::MAX - 1 }; NONE_BEFORE]);
}

/// Mean of the known values in the box around each pixel of a row's runs, from the ring of rows.
#[inline(always)]
fn smooth(runs: &[Run], buffers: &mut Buffers, period: &mut [f32]) {
    let ([first, ..], [.., last]) = (runs, runs) else { return };
    let (start, n) = (first.start(), last.end() - first.start());
    const { assert!(SMOOTH_ROWS == 1 && SMOOTH_COLUMNS == 6, "three rows are added, and thirteen columns") };
    let Buffers { raw, sums_of_rows: sums, pairs, fours, .. } = buffers;
    for row in [&mut *sums, pairs, fours] {
        row.resize(row.len().max(n + 12), 0);
    }
    let (sums, pairs, fours) = (&mut sums[..n + 12], &mut pairs[..n + 11], &mut fours[..n + 9]);
    let [a, b, c] =
        [&raw[0][start..start + n + 12], &raw[1][start..start + n + 12], &raw[2][start..start + n + 12]];
    for i in 0..n + 12 {
        sums[i] = a[i] + b[i] + c[i];
    }
    for i in 0..n + 11 {
        pairs[i] = sums[i] + sums[i + 1];
    }
    for i in 0..n + 9 {
        fours[i] = pairs[i] + pairs[i + 2];
    }
    for run in runs {
        let (from, n) = (run.start() - start, run.columns().len());
        let (fours, last) = (&fours[from..from + n + 8], &sums[from + 12..from + 12 + n]);
        let period = &mut period[run.columns()];
        for i in 0..n {
            period[i] = mean_of(fours[i] + fours[i + 4] + fours[i + 8] + last[i]);
        }
    }
}

#[inline(always)]
fn mean_of(sum: u32) -> f32 {
    let count = (sum & ((1 << COUNT_BITS) - 1)) as i32 as f32;
    (sum >> COUNT_BITS) as i32 as f32 / STEPS / count.max(1.0)
}

#[cfg(test)]
pub(crate) mod tests {
    use super::{Buffers, LIGHT_PERIODS, measure};
    use crate::base::image::{Mono8, Plane};
    use crate::kernels::pixel_runs::{Run, Runs, Surroundings};
    use proptest::prelude::{ProptestConfig, any, prop_assert, proptest};

    pub(crate) fn measured(image: &Plane<u8>, mask: &Plane<u8>, nominal: f32) -> Plane<f32> {
        let mut found = Plane::filled(1, 1, f32::NAN);
        let (runs, mut around) = (Runs::of(mask), Surroundings::default());
        around.find(&runs, mask.width(), false);
        measure(Mono8::from(image), (&runs, &around), nominal, &mut Buffers::default(), &mut found);
        found
    }

    /// The same figure by its definition: for each pixel, the crossings in its window.
    fn plain_row(row: &[u8], nominal: f32) -> Vec<f64> {
        let window = |u: usize, periods: f32| {
            let half = (periods * nominal).round() as usize;
            let length = (2 * half + 1).min(row.len());
            let start = u.saturating_sub(half).min(row.len() - length);
            start..start + length
        };
        let value = |u: usize| {
            let window = &row[window(u, LIGHT_PERIODS)];
            let length = window.len();
            let sum: i64 = window.iter().map(|&x| i64::from(x)).sum();
            let range = window.iter().max().unwrap_or(&0) - window.iter().min().unwrap_or(&0);
            let margin = (0.12f32 * length as f32 * f32::from(range)) as i64;
            (i64::from(row[u]) * length as i64 - sum, margin)
        };
        let (mut crossings, mut settled, mut seen) = (Vec::new(), 0, 0);
        for u in 0..row.len() {
            let (now, margin) = value(u);
            if u > 0 && (now > 0) != (value(u - 1).0 > 0) {
                seen = u;
            }
            let side = if now > 0 { 1 } else { -1 };
            if now.abs() > margin && side != settled {
                if settled != 0 {
                    let (a, b) = (value(seen - 1).0 as f64, value(seen).0 as f64);
                    crossings.push((seen as f64 - b / (b - a), u));
                }
                settled = side;
            }
        }
        let at = |u: usize| {
            let window = window(u, 1.3);
            let inside = crossings.iter().filter(|x| x.0 >= window.start as f64 && x.1 < window.end);
            let inside: Vec<f64> = inside.map(|x| x.0).collect();
            let distances: Vec<f64> = inside.windows(3).map(|x| x[2] - x[0]).collect();
            let mean = distances.iter().sum::<f64>() / distances.len().max(1) as f64;
            if (5.0..=24.0).contains(&mean) { mean } else { 0.0 }
        };
        (0..row.len()).map(at).collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn the_period_of_a_noisy_sine_is_found(
            period in 6.0f32..18.0, phase in -3.0f32..3.0, amplitude in 15.0f32..100.0,
        ) {
            let mut image = Plane::filled(200, 3, 0u8);
            for v in 0..3 {
                for u in 0..200 {
                    let noise = ((u * 7919 + v * 104_729) % 13) as f32 / 6.5 - 1.0;
                    let wave = (std::f32::consts::TAU * u as f32 / period + phase).cos();
                    image.set(u, v, (110.0 + amplitude * wave + noise) as u8);
                }
            }
            let found = measured(&image, &Plane::filled(200, 3, 1), 11.0);
            for u in 20..180 {
                let p = found.at(u, 1);
                prop_assert!((p / period - 1.0).abs() < 0.03, "{p} at {u}, true {period}");
            }
        }

        /// Whatever the light, runs and window: the box mean of what the definition gives.
        #[test]
        fn periods_are_those_of_the_definition(
            values in proptest::collection::vec(any::<u8>(), 120),
            gap in 20usize..100,
            nominal in 4.0f32..14.0,
            period in 5.5f32..20.0,
            noise in 0.0f32..1.0,
        ) {
            let fringe = |u: usize| 120.0 + 100.0 * (std::f32::consts::TAU * u as f32 / period).cos();
            let light = |(u, &x): (usize, &u8)| (fringe(u) * (1.0 - noise) + noise * f32::from(x)) as u8;
            let row: Vec<u8> = values.iter().enumerate().map(light).collect();
            let mut mask = Plane::filled(120, 1, 1u8);
            mask.set(gap, 0, 0);
            let mut raw = vec![0.0; 120];
            for run in Runs::of(&mask).all().iter().map(Run::columns) {
                raw[run.clone()].copy_from_slice(&plain_row(&row[run], nominal));
            }
            let found = measured(&Plane::from_vec(120, 1, row).expect("120 pixels"), &mask, nominal);
            for u in (0..120).filter(|&u| u != gap) {
                let near = raw[u.saturating_sub(6)..(u + 7).min(120)].iter().filter(|x| **x > 0.0);
                let (sum, count) = near.fold((0.0, 0), |(sum, count), x| (sum + x, count + 1));
                let expected = if count > 0 { sum / f64::from(count) } else { 0.0 };
                let found = f64::from(found.at(u, 0));
                prop_assert!((found - expected).abs() < 1e-3, "{found} {expected} at {u}");
            }
            prop_assert!(found.at(gap, 0) == 0.0);
        }
    }
}
