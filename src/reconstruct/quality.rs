//! Verticality Vm, border distance Bm and quality Qm (paper, 4.1, Equations 1 to 4, Figure 8).
//!
//! Equation 3 of the paper repeats Equation 2 by mistake. Its text says that the quotient of the horizontal
//! over the vertical gradient measures verticality; `Vm = gH / (gH + gV)` grows with that quotient, lies in
//! 0..1 and needs no guard against division by zero.

use super::runs::Runs;
use super::sample::{self, LANES, Lanes};
use super::simd;
use crate::image::{Mono8, Plane};

/// Equation 4's weights and which exponents are two and not one, as printed: Bm, Am, Vm, Sm.
const WEIGHTS: [f32; 4] = [1.0, 5.0, 3.0, 1.0];
const SQUARED: [bool; 4] = [false, true, false, false];

/// Half side of the box that blurs Om to Bm, px.
const BORDER_PX: usize = 12;

/// Vm: Equations 1 and 2 with the window w = round(Pm); 0 where the period is unknown. Sums are taken from
/// running sums of absolute differences along rows and columns; windows end at the image's borders. The period is known
/// within `runs` only.
pub fn verticality(image: Mono8<'_>, runs: &Runs, period: &Plane<f32>) -> Plane<f32> {
    let (w, h) = (image.width(), image.height());
    let mut out = Plane::filled(w, h, 0f32);
    // down[v][u]: sum of |I(v', u) - I(v' - 1, u)| over 1 <= v' <= v. It may run over: differences over a window do not.
    let mut down = Plane::filled(w, h, 0u16);
    // right[PAD + u]: the same along the row.
    let mut right = vec![0u32; w + 2 * PAD];
    simd::dispatch(
        #[inline(always)]
        || {
            let mut sums = vec![0u16; w];
            for v in 1..h {
                let steps = sums.iter_mut().zip(image.row(v)).zip(image.row(v - 1));
                steps.for_each(|((sum, a), b)| *sum = sum.wrapping_add(u16::from(a.abs_diff(*b))));
                down.row_mut(v).copy_from_slice(&sums);
            }
            for v in 0..h {
                let mut sum = 0;
                for (out, x) in right[PAD + 1..].iter_mut().zip(image.row(v).windows(2)) {
                    sum += u32::from(x[1].abs_diff(x[0]));
                    *out = sum;
                }
                right[PAD + w..].fill(sum);
                for run in runs.row(v) {
                    for first in run.columns().step_by(LANES) {
                        let count = LANES.min(run.end() - first);
                        let period = sample::load(period.row(v), first);
                        let block = verticality_block(&down, &right, (v, first), &period);
                        sample::store(out.row_mut(v), first, count, &block);
                    }
                }
            }
        },
    );
    out
}

/// Room beside a row of sums: no window is longer.
const PAD: usize = 64;

/// [`verticality`] of a block: each window that one of its pixels has is tried for all.
#[inline(always)]
fn verticality_block(down: &Plane<u16>, right: &[u32], (v, first): (usize, usize), period: &Lanes) -> Lanes {
    let mut window = [0u32; LANES];
    let (mut least, mut most) = (u32::MAX, 0);
    for i in 0..LANES {
        window[i] = ((period[i] + 0.5) as i32).clamp(0, PAD as i32) as u32;
        least = if (window[i] > 0) & (window[i] < least) { window[i] } else { least };
        most = most.max(window[i]);
    }
    let mut out = [0f32; LANES];
    let columns = LANES.min(down.width() - first);
    for k in least..=most {
        let reach = k as usize;
        let (below, above) =
            (down.row((v + reach).min(down.height() - 1)), down.row(v.saturating_sub(reach)));
        let (behind, before) = (&right[PAD + first + reach..], &right[PAD + first - reach..]);
        let (below, above) = (&below[first..][..columns], &above[first..][..columns]);
        let (behind, before) = (&behind[..columns], &before[..columns]);
        for i in 0..columns {
            let horizontal = (behind[i] - before[i]) as i32 as f32;
            let vertical = f32::from(below[i].wrapping_sub(above[i]));
            let sum = horizontal + vertical;
            let share = horizontal / if sum < 1.0 { 1.0 } else { sum };
            out[i] = if window[i] == k { share } else { out[i] };
        }
    }
    out
}

/// Bm: Om, whose runs these are, blurred by a box of 25 x 25 px and stretched, 0 at a straight border and 1 well inside.
pub fn border(mask: &Plane<u8>, runs: &Runs) -> Plane<f32> {
    let (w, h) = (mask.width(), mask.height());
    let mut out = Plane::filled(w, h, 0f32);
    let mut columns = vec![0u8; w];
    let mut prefix = vec![0u32; w + 2 * BORDER_PX + 1];
    let area = (2 * BORDER_PX + 1).pow(2) as f32;
    simd::dispatch(
        #[inline(always)]
        || {
            for next in 0..h + BORDER_PX {
                if next < h {
                    columns.iter_mut().zip(mask.row(next)).for_each(|(sum, x)| *sum += x);
                }
                if let Some(gone) = next.checked_sub(2 * BORDER_PX + 1) {
                    columns.iter_mut().zip(mask.row(gone)).for_each(|(sum, x)| *sum -= x);
                }
                let Some(v) = next.checked_sub(BORDER_PX) else { continue };
                let mut sum = 0;
                for (out, &x) in prefix[BORDER_PX + 1..].iter_mut().zip(&columns) {
                    sum += u32::from(x);
                    *out = sum;
                }
                prefix[BORDER_PX + 1 + w..].fill(sum);
                for run in runs.row(v) {
                    let (start, n) = (run.start(), run.columns().len());
                    let (before, last) = (&prefix[start..][..n], &prefix[start + 2 * BORDER_PX + 1..][..n]);
                    let out = &mut out.row_mut(v)[run.columns()][..n];
                    for i in 0..n {
                        let share = (last[i] - before[i]) as i32 as f32 / area;
                        let stretched = 2.0 * share - 1.0;
                        let stretched = if stretched > 0.0 { stretched } else { 0.0 };
                        out[i] = if stretched < 1.0 { stretched } else { 1.0 };
                    }
                }
            }
        },
    );
    out
}

/// Am scaled by its 95th percentile on the mask, whose runs these are, at most 1.
pub fn normalized_amplitude(amplitude: &Plane<u8>, runs: &Runs) -> Plane<f32> {
    let mut counts = [0usize; 256];
    for v in 0..runs.height() {
        for run in runs.row(v) {
            amplitude.row(v)[run.columns()].iter().for_each(|&a| counts[usize::from(a)] += 1);
        }
    }
    let total: usize = counts.iter().sum();
    let mut seen = 0;
    let percentile = counts.iter().position(|&n| {
        seen += n;
        seen * 20 >= total * 19
    });
    let scale = 1.0 / percentile.unwrap_or(0).max(1) as f32;
    let mut out = Plane::filled(amplitude.width(), amplitude.height(), 0f32);
    for v in 0..runs.height() {
        for run in runs.row(v) {
            let pixels = out.row_mut(v)[run.columns()].iter_mut().zip(&amplitude.row(v)[run.columns()]);
            pixels.for_each(|(out, &a)| *out = (f32::from(a) * scale).min(1.0));
        }
    }
    out
}

/// Qm: Equation 4, from Bm, Am, Vm and Sm, each 0 to 1, where they are known.
pub fn quality(maps: [&Plane<f32>; 4], runs: &Runs) -> Plane<f32> {
    let total: f32 = WEIGHTS.iter().sum();
    let mut out = Plane::filled(maps[0].width(), maps[0].height(), 0f32);
    simd::dispatch(
        #[inline(always)]
        || {
            for v in 0..maps[0].height() {
                for run in runs.row(v) {
                    let n = run.columns().len();
                    let maps = [0, 1, 2, 3].map(|k: usize| &maps[k].row(v)[run.columns()][..n]);
                    let out = &mut out.row_mut(v)[run.columns()][..n];
                    for i in 0..n {
                        let mut sum = 0.0;
                        for k in 0..4 {
                            let x = maps[k][i];
                            sum += WEIGHTS[k] * if SQUARED[k] { x * x } else { x };
                        }
                        out[i] = sum / total;
                    }
                }
            }
        },
    );
    out
}

#[cfg(test)]
mod tests {
    use super::{border, quality, verticality};
    use crate::image::{Mono8, Plane};
    use crate::reconstruct::runs::Runs;

    #[test]
    fn upright_fringes_are_vertical_and_lying_ones_are_not() {
        let mut upright = Plane::filled(60, 60, 0u8);
        let mut lying = upright.clone();
        for v in 0..60 {
            for u in 0..60 {
                let wave = |x: usize| (100.0 + 80.0 * (std::f32::consts::TAU * x as f32 / 10.0).cos()) as u8;
                upright.set(u, v, wave(u));
                lying.set(u, v, wave(v));
            }
        }
        let period = Plane::filled(60, 60, 10.0f32);
        let all = Runs::of(&Plane::filled(60, 60, 1));
        assert!(verticality(Mono8::from(&upright), &all, &period).at(30, 30) > 0.99);
        assert!(verticality(Mono8::from(&lying), &all, &period).at(30, 30) < 0.01);
    }

    #[test]
    fn the_border_map_grows_inwards_and_the_weights_are_those_printed() {
        let mut mask = Plane::filled(100, 100, 0u8);
        for v in 20..80 {
            mask.row_mut(v)[20..80].fill(1);
        }
        let map = border(&mask, &Runs::of(&mask));
        assert!(map.at(20, 50) < 0.1 && map.at(50, 50) == 1.0 && map.at(10, 50) == 0.0);
        let one = |x: f32| Plane::filled(1, 1, x);
        let found = quality([&one(0.5), &one(0.5), &one(0.5), &one(0.5)], &Runs::of(&Plane::filled(1, 1, 1)))
            .at(0, 0);
        assert!((found - (0.5 + 5.0 * 0.25 + 3.0 * 0.5 + 0.5) / 10.0).abs() < 1e-6, "{found}");
    }
}
