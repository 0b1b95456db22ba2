//! The fringe period Pm of the default method: the paper's count of crossings, found once for a run.
//!
//! The paper's window has a median of its own for each pixel, so that crossings are sought anew in each
//! ([`super::period`]). Here the threshold is a sliding mean: a sine less its sliding mean is a sine of
//! the same period, so that the distance of crossings of equal direction is unbiased where the period does not change,
//! and one list of crossings serves all windows of a run. Which of them lie in a window changes a few times in a
//! period, so that the figure is that of whole stretches of pixels. All sums are whole numbers.

use super::bits::{WORD, bits_of};
use super::period::{HYSTERESIS, PERIOD_RANGE_PX, SMOOTH_COLUMNS, SMOOTH_ROWS};
use super::runs::{Run, Runs, fill_beside};
use super::simd;
use crate::image::{Mono8, Plane};

/// The threshold is the mean over this many nominal periods to each side. Shorter means find more crossings where the
/// light falls off towards an outline, and more wrong ones (docs/design/reconstruction-experiments.md).
const LIGHT_PERIODS: f32 = 1.3;

/// Steps of a pixel in which distances are summed.
const STEPS: f32 = 4096.0;

/// Bits of a sum that count how many distances it has; above are the distances.
const COUNT_BITS: u32 = 8;

/// Rows that [`measure`] uses again from frame to frame.
#[derive(Debug, Default)]
pub struct Buffers {
    /// Largest and smallest value from each pixel on, and what they are made from.
    high: [Vec<u8>; 2],
    low: [Vec<u8>; 2],
    /// Sums of the run's pixels before each.
    sums: Vec<u32>,
    /// 1 above the threshold; above it, and below it, by more than the margin.
    sides: Vec<u8>,
    crossings: Vec<Crossing>,
    /// Distances and their count, of the last rows, with zeros to either side.
    raw: Vec<Vec<u32>>,
    /// Sums of these over three rows, and of two and four neighbours of those.
    sums_of_rows: Vec<u32>,
    pairs: Vec<u32>,
    fours: Vec<u32>,
}

/// Where the light crosses the threshold.
#[derive(Debug, Clone, Copy)]
struct Crossing {
    /// Column in the run, with its fraction.
    at: f32,
    /// The first whole column behind it.
    behind: u32,
    /// Column in the run where it was certain.
    certain: u32,
}

/// Period of each mask pixel, px; 0 where it is unknown and off the mask. Windows never leave the mask's runs.
pub fn measure(
    image: Mono8<'_>,
    runs: &Runs,
    nominal_px: f32,
    buffers: &mut Buffers,
    period: &mut Plane<f32>,
) {
    let half = (1.3 * nominal_px).round() as usize;
    let reach = (LIGHT_PERIODS * nominal_px).round() as usize;
    measure_with(
        runs,
        (image.width(), image.height()),
        buffers,
        period,
        #[inline(always)]
        |v, run, buffers, raw| measure_run(&image.row(v)[run.columns()], half, reach, buffers, raw),
    );
}

/// The mean of the periods around each pixel of the runs, where `each` gives those of a run of a row: see [`packed`].
pub(super) fn measure_with(
    runs: &Runs,
    (w, h): (usize, usize),
    buffers: &mut Buffers,
    period: &mut Plane<f32>,
    mut each: impl FnMut(usize, &Run, &mut Buffers, &mut [u32]),
) {
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
                    fill_beside(runs.row(v), row, 0);
                    for run in runs.row(v) {
                        each(v, run, buffers, &mut row[run.columns()]);
                    }
                }
                buffers.raw[v % RING] = raw;
                if let Some(v) = v.checked_sub(SMOOTH_ROWS) {
                    smooth(runs.row(v), buffers, period.row_mut(v));
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
    extremes(row, light.length, &mut buffers.high, u8::max);
    extremes(row, light.length, &mut buffers.low, u8::min);
    add_up(row, &mut buffers.sums);
    find_sides(row, light, buffers);
    find_crossings(row, light, buffers);
    // What no window reaches.
    buffers.crossings.push(Crossing { at: 0.0, behind: u32::MAX, certain: u32::MAX });
    let crossings = &buffers.crossings[..];
    // Window `start` holds the crossings `first .. end`. Which comes next, one that leaves or one that enters, is not to be
    // foreseen: no branches. (Two may leave together: then one of the stretches is empty.)
    let (mut start, mut first) = (0, 0);
    let mut end = crossings.iter().take_while(|x| (x.certain as usize) < length).count();
    loop {
        let (leaves, enters) =
            (crossings[first].behind as usize, crossings[end].certain as usize + 1 - length);
        let next = leaves.min(enters).min(windows);
        let value = mean_distance(crossings.get(first..end).unwrap_or(&[]));
        // Near the run's ends the window is shifted, not cut: two whole periods are needed.
        let from = if start == 0 { 0 } else { start + half };
        if next == windows {
            raw[from..].fill(value);
            return;
        }
        fill(raw, from, next + half, value);
        (first, end) = (first + usize::from(leaves == next), end + usize::from(enters == next));
        start = next;
    }
}

/// Fills `from .. to`, a few pixels, and may write beyond: what follows is written next.
#[inline(always)]
fn fill(raw: &mut [u32], from: usize, to: usize, value: u32) {
    match raw[from..].first_chunk_mut::<8>() {
        Some(eight) if to - from <= 8 => *eight = [value; 8],
        _ => raw[from..to].fill(value),
    }
}

/// Mean distance of each crossing to the next but one, which has its direction, in the form of [`measure_run`].
#[inline(always)]
fn mean_distance(crossings: &[Crossing]) -> u32 {
    // All distances but those of the ends cancel.
    let [a, b, .., c, d] = crossings else {
        let [a, _, c] = crossings else { return 0 };
        return packed(c.at - a.at);
    };
    packed((d.at + c.at - b.at - a.at) / (crossings.len() - 2) as f32)
}

/// A period, px: in [`STEPS`], with a count of one; 0 where it is none.
#[inline(always)]
pub(super) fn packed(distance: f32) -> u32 {
    if PERIOD_RANGE_PX.contains(&distance) { ((distance * STEPS) as u32) << COUNT_BITS | 1 } else { 0 }
}

/// The windows that thresholds and margins are taken from.
#[derive(Debug, Clone, Copy)]
struct LightWindow {
    /// Columns to each side of a pixel, as far as the run goes, and all in all.
    reach: usize,
    length: usize,
}

/// Sums of the row's pixels before each.
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

/// `out[0][i]` = extreme of `row[i .. i + length]`, by doubling.
#[inline(always)]
fn extremes(row: &[u8], length: usize, out: &mut [Vec<u8>; 2], extreme: impl Fn(u8, u8) -> u8 + Copy) {
    let [from, to] = out;
    from.clear();
    from.extend_from_slice(row);
    to.resize(row.len(), 0);
    let mut covered = 1;
    while covered < length {
        let step = covered.min(length - covered);
        let n = row.len() + 1 - covered - step;
        for ((to, &a), &b) in to[..n].iter_mut().zip(&from[..n]).zip(&from[step..step + n]) {
            *to = extreme(a, b);
        }
        std::mem::swap(from, to);
        covered += step;
    }
}

/// Above the threshold.
const ABOVE: u8 = 1;

/// On either side of it by more than the margin.
const FAR: u8 = 2;

/// On which side of its threshold a pixel of `light` is, of whose window `length` pixels have this sum and range. All is
/// times that length.
#[inline(always)]
fn side(light: u8, length: i32, sum: u32, range: u8) -> u8 {
    let value = i32::from(light) * length - sum as i32;
    let margin = HYSTERESIS * length as f32 * f32::from(range);
    (if value > 0 { ABOVE } else { 0 }) | if value.abs() as f32 > margin { FAR } else { 0 }
}

/// The sides of a run's pixels.
#[inline(always)]
fn find_sides(row: &[u8], LightWindow { reach, length }: LightWindow, buffers: &mut Buffers) {
    let Buffers { high, low, sums, sides, .. } = buffers;
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
    for i in 0..n {
        own[i] = side(light[i], length_px, ends_own[i] - starts_own[i], high_own[i] - low_own[i]);
    }
    let last = windows - 1;
    for (sides, from, window) in [(before, 0, 0), (behind, from + n, last)] {
        let (sum, range) = (ends[window] - starts[window], high[window] - low[window]);
        for (side_of, &light) in sides.iter_mut().zip(&row[from..]) {
            *side_of = side(light, length_px, sum, range);
        }
    }
}

/// Where the light crosses its threshold before pixel `seen`, and the first whole column behind that.
#[inline(always)]
fn crossing(row: &[u8], light: LightWindow, sums: &[u32], seen: usize) -> (f32, u32) {
    let (a, b) = (beyond(row, light, sums, seen - 1), beyond(row, light, sums, seen));
    let at = seen as u32 as f32 - b / (b - a);
    (at, at as u32 + 1)
}

/// How far a pixel is above its threshold, times the length of the window that this is taken from.
#[inline(always)]
fn beyond(row: &[u8], LightWindow { reach, length }: LightWindow, sums: &[u32], pixel: usize) -> f32 {
    let window = pixel.saturating_sub(reach).min(row.len() - length);
    ((u32::from(row[pixel]) * length as u32 + sums[window]) as i32 - sums[window + length] as i32) as f32
}

/// The crossings of a run: a change of sign counts once the light has left the threshold by the margin on the other
/// side.
#[inline(always)]
fn find_crossings(row: &[u8], light: LightWindow, buffers: &mut Buffers) {
    let Buffers { sums, sides, crossings, .. } = buffers;
    let sums = &sums[..row.len() + 1];
    crossings.clear();
    // Where it is certain on which side, and since when the light is on the side where it is.
    let mut before = u64::from(sides[0] & ABOVE);
    let (mut settled, mut seen) = (None, 0);
    for (k, word) in sides.as_chunks::<WORD>().0.iter().enumerate() {
        let (above, mut far) = (bits_of(word, ABOVE), bits_of(word, FAR));
        let mut changes = above ^ (above << 1 | before);
        loop {
            let end = changes.trailing_zeros();
            let here = far & u64::MAX.checked_shr(u64::BITS - end).unwrap_or(0);
            if here != 0 && settled != Some(before) {
                if settled.is_some() {
                    let (at, behind) = crossing(row, light, sums, seen);
                    let certain = (k * WORD) as u32 + here.trailing_zeros();
                    crossings.push(Crossing { at, behind, certain });
                }
                settled = Some(before);
            }
            if changes == 0 {
                break;
            }
            changes &= changes - 1;
            far &= u64::MAX << end;
            (before, seen) = (before ^ 1, k * WORD + end as usize);
        }
    }
}

/// Mean of the known values in the box around each pixel of a row's runs, from the ring of rows.
#[inline(always)]
fn smooth(runs: &[Run], buffers: &mut Buffers, period: &mut [f32]) {
    fill_beside(runs, period, 0.0);
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
mod tests {
    use super::{Buffers, LIGHT_PERIODS, measure};
    use crate::image::{Mono8, Plane};
    use crate::reconstruct::period;
    use crate::reconstruct::runs::Runs;
    use proptest::prelude::{ProptestConfig, any, prop_assert, proptest};

    fn measured(image: &Plane<u8>, mask: &Plane<u8>, nominal: f32) -> Plane<f32> {
        let mut found = Plane::filled(1, 1, f32::NAN);
        measure(Mono8::from(image), &Runs::of(mask), nominal, &mut Buffers::default(), &mut found);
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
        fn the_period_of_a_noisy_sine_is_found(period in 6.0f32..18.0, phase in -3.0f32..3.0, amplitude in 15.0f32..100.0) {
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
            for run in period::runs(mask.row(0)) {
                raw[run.clone()].copy_from_slice(&plain_row(&row[run], nominal));
            }
            let found = measured(&Plane::from_vec(120, 1, row).expect("120 pixels"), &mask, nominal);
            for u in (0..120).filter(|&u| u != gap) {
                let near = raw[u.saturating_sub(6)..(u + 7).min(120)].iter().filter(|x| **x > 0.0);
                let (sum, count) = near.fold((0.0, 0), |(sum, count), x| (sum + x, count + 1));
                let expected = if count > 0 { sum / f64::from(count) } else { 0.0 };
                prop_assert!((f64::from(found.at(u, 0)) - expected).abs() < 1e-3, "{} {expected} at {u}", found.at(u, 0));
            }
            prop_assert!(found.at(gap, 0) == 0.0);
        }
    }
}
