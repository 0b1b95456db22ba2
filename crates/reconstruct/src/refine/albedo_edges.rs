// SPDX-License-Identifier: MIT OR Apache-2.0
//! Phase at edges of colour, and what error to expect of a phase.
//!
//! A demodulation window that crosses an edge of colour (a disc of the calibration board, a mole, a hair line)
//! holds two fringes of different height: its phase is off by up to half a radian, while the surface below is
//! smooth. The misfit of the fringe model marks such windows: over boards and bodies the RMS error grows in
//! proportion to it ([`own_error`]). For each pixel of doubtful misfit a plane is laid through the absolute
//! phases of good pixels around it. Where these lie in a plane, so that its value at the pixel is more certain
//! than the pixel's own phase, it is taken instead; on the strongly curved skin beside an outline, where the
//! misfit grows too, they do not, and the pixel keeps its own. What remains uncertain beyond a bound is dropped.

use super::FrameMaps;
use crate::base::image::Plane;
use crate::kernels::fast_round::whole;
use crate::kernels::pixel_runs::each_not_0;
use crate::kernels::row_support::Support;
use crate::kernels::{simd, subpixel};
use crate::phase::window_quality::{self, DOUBTFUL_MISFIT, GOOD_MISFIT, LEAST_AMPLITUDE_DN};
use std::f32::consts::TAU;
use std::ops::Range;

/// A phase of which a larger error is expected is dropped, rad.
const MAX_ERROR: f32 = 0.25;

/// RMS error of a phase relative to the misfit of its window, rad, as measured.
const ERROR_PER_MISFIT: f32 = 0.8;

/// Noise of a sample, DN: the misfit that it causes is no sign of an edge.
const NOISE_DN: f32 = 0.6;

/// Columns and rows to each side that a plane is laid through.
const REACH: (usize, usize) = (12, 5);

/// Of these every such column is taken: neighbours in a row share most of their windows.
const COLUMN_STEP: usize = 3;

/// Fewer good pixels than this make no plane.
const MIN_SUPPORT: usize = 20;

/// Variance of the plane at the pixel relative to that of one phase: beyond this it is an extrapolation.
const MAX_LEVERAGE: f32 = 0.3;

/// Phases around a pixel are not independent: they share windows and rows. The error of the plane at the pixel
/// is this times what it would be if they were.
const DEPENDENCE: f32 = 6.0;

/// Pixels this far from the carrier are on another surface, rad.
const SAME_SURFACE: f32 = 1.5;

/// Gives pixels of doubtful misfit the phase of the good ones around where that is more certain, and drops those
/// (NaN) of which a larger error than the bound is to be expected. Pixels of `zone`, around the marker, stay.
/// The error to expect of the doubtful ones goes to `expected`, where it is given, rad. Returns how many were
/// dropped. `absolute` is known within `runs` only.
pub fn refine(
    absolute: &mut Plane<f32>,
    FrameMaps { runs, windows, period, zone: outside, sign }: FrameMaps<'_>,
    mut expected: Option<&mut Plane<f32>>,
) -> usize {
    let (mut support, mut known, mut doubtful) = (Support::default(), Known::default(), Vec::new());
    simd::dispatch(
        #[inline(always)]
        || {
            support.begin(absolute, REACH.1, PAD);
            known.begin(absolute.width());
            let mut dropped = 0;
            for v in 0..absolute.height() {
                let (misfit, zone) = (windows.misfit.row(v), outside.row(v));
                if let Some(leaves) = v.checked_sub(ROWS - REACH.1) {
                    known.take_off(support.row(v - 1, 0), runs.span(leaves));
                }
                support.advance(
                    v,
                    absolute,
                    runs,
                    #[inline(always)]
                    |v, run, phase, to| {
                        let columns = run.columns();
                        let (misfit, zone) =
                            (&windows.misfit.row(v)[columns.clone()], &outside.row(v)[columns]);
                        for (((to, &phase), &misfit), &zone) in to.iter_mut().zip(phase).zip(misfit).zip(zone)
                        {
                            let good = (misfit <= GOOD_MISFIT) & (zone == 0);
                            *to = if good { phase } else { f32::NAN };
                        }
                    },
                );
                let enter = if v == 0 { 0 } else { v + REACH.1 }..=v + REACH.1;
                for row in enter.filter(|&row| row < absolute.height()) {
                    known.add(support.row(v, row + REACH.1 - v), runs.span(row));
                }
                doubtful.clear();
                for run in runs.row(v) {
                    let part = run.columns();
                    let stretch = (&absolute.row(v)[part.clone()], &misfit[part.clone()], &zone[part]);
                    list_doubtful(stretch, run.start(), &mut doubtful);
                }
                let mut good: [&[f32]; ROWS] = [&[]; ROWS];
                for (row, good) in good.iter_mut().enumerate() {
                    *good = support.row(v, row);
                }
                let mut left = &doubtful[..];
                while let Some(&first) = left.first() {
                    let count = left.iter().take_while(|&&u| u < first + LANES).count();
                    let block;
                    (block, left) = left.split_at(count);
                    let laid = if known.support(first, block) {
                        let around = around(&good, first);
                        let phase = subpixel::part(absolute.row(v), first, f32::NAN);
                        let mut carrier: Lanes = subpixel::part(period.row(v), first, f32::NAN);
                        for carrier in &mut carrier {
                            *carrier = sign * TAU / *carrier;
                        }
                        lay_planes(&around, &phase, &carrier)
                    } else {
                        Laid { phase: [0.0; LANES], error: [f32::INFINITY; LANES] }
                    };
                    for &u in block {
                        let amplitude = window_quality::amplitude(windows.strength.at(u, v));
                        let mut error = own_error(misfit[u], amplitude);
                        let i = u - first;
                        if laid.error[i] < error {
                            absolute.set(u, v, laid.phase[i]);
                            error = laid.error[i];
                        }
                        if let Some(expected) = expected.as_deref_mut() {
                            expected.set(u, v, error);
                        }
                        if error > MAX_ERROR {
                            absolute.set(u, v, f32::NAN);
                            dropped += 1;
                        }
                    }
                }
            }
            dropped
        },
    )
}

/// Adds the columns of a run, which begins at `start`, whose phase is known and doubtful.
#[inline(always)]
fn list_doubtful((phase, misfit, zone): (&[f32], &[f32], &[u8]), start: usize, list: &mut Vec<usize>) {
    /// Pixels that are searched at once.
    const SEARCHED: usize = 64;
    let parts = phase.chunks(SEARCHED).zip(misfit.chunks(SEARCHED)).zip(zone.chunks(SEARCHED));
    let mut doubtful = [0u8; SEARCHED];
    for (part, ((phase, misfit), zone)) in parts.enumerate() {
        let count = phase.len();
        let bytes = doubtful[..count].iter_mut().zip(phase).zip(misfit).zip(zone);
        for (((doubtful, phase), &misfit), &zone) in bytes {
            *doubtful = u8::from(!phase.is_nan() & (misfit >= DOUBTFUL_MISFIT) & (zone == 0));
        }
        each_not_0(&doubtful[..count], |i| list.push(start + part * SEARCHED + i));
    }
}

/// The RMS error to expect of a phase from its window's misfit and the fringe's amplitude, rad.
#[inline(always)]
pub fn own_error(misfit: f32, amplitude: f32) -> f32 {
    let noise = NOISE_DN / amplitude.max(LEAST_AMPLITUDE_DN);
    ERROR_PER_MISFIT * (misfit * misfit - noise * noise).max(0.0).sqrt()
}

/// Pixels beside each other whose planes are laid at once: doubtful ones come in stretches, and their samples lie side
/// by side in memory.
const LANES: usize = 8;
type Lanes = [f32; LANES];

/// Columns that a plane is laid through.
const COLUMNS: usize = 2 * REACH.0 / COLUMN_STEP + 1;

/// Rows that a plane is laid through.
const ROWS: usize = 2 * REACH.1 + 1;

/// Room beside the rows of support: the reach, and lanes beyond the row's end.
const PAD: usize = REACH.0 + LANES;

/// Phase and expected error of the pixels in the middle of planes through good phases, rad.
struct Laid {
    phase: Lanes,
    /// Infinite where there is no plane.
    error: Lanes,
}

/// Good phases around a block: those within reach of its pixels, row by row.
type Around<'a> = [&'a [f32; SPAN]; ROWS];

/// Columns within reach of a block's pixels.
const SPAN: usize = 2 * REACH.0 + LANES;

/// The good phases around the block that begins at column u. All rows are long enough for it.
#[inline(always)]
fn around<'a>(good: &[&'a [f32]; ROWS], u: usize) -> Around<'a> {
    let mut around = [&[f32::NAN; SPAN]; ROWS];
    for (around, good) in around.iter_mut().zip(good) {
        *around = good[u + PAD - REACH.0..].first_chunk().unwrap_or(&[f32::NAN; SPAN]);
    }
    around
}

/// The number of good phases in the rows around the current one, column by column with [`PAD`] to either side. It is kept from
/// row to row: counting anew for each block makes this stage three quarters slower.
#[derive(Debug, Default)]
struct Known(Vec<u8>);

impl Known {
    /// Begins a frame of this width.
    fn begin(&mut self, width: usize) {
        self.0.clear();
        self.0.resize(width + 2 * PAD, 0);
    }

    /// Adds a row of support, which is known within `columns`.
    #[inline(always)]
    fn add(&mut self, row: &[f32], columns: Range<usize>) {
        let columns = columns.start + PAD..columns.end + PAD;
        for (count, phase) in self.0[columns.clone()].iter_mut().zip(&row[columns]) {
            *count += u8::from(!phase.is_nan());
        }
    }

    /// Subtracts a row that was added.
    #[inline(always)]
    fn take_off(&mut self, row: &[f32], columns: Range<usize>) {
        let columns = columns.start + PAD..columns.end + PAD;
        for (count, phase) in self.0[columns.clone()].iter_mut().zip(&row[columns]) {
            *count -= u8::from(!phase.is_nan());
        }
    }

    /// Whether one of the pixels of a block, which begins at column u, has enough good ones around it for a plane.
    #[inline(always)]
    fn support(&self, u: usize, block: &[usize]) -> bool {
        const { assert!(ROWS * COLUMNS <= u8::MAX as usize) };
        let around: &[u8; SPAN] = subpixel::chunk(&self.0, u + PAD - REACH.0);
        let mut known = [0u8; LANES];
        for column in 0..COLUMNS {
            for i in 0..LANES {
                known[i] += around[column * COLUMN_STEP + i];
            }
        }
        block.iter().any(|at| usize::from(known[(at - u) % LANES]) >= MIN_SUPPORT)
    }
}

/// Sums of 1, x, y and of their products; of the residual phase z, and of its products with them.
#[derive(Default)]
struct Sums {
    n: Lanes,
    x: Lanes,
    y: Lanes,
    xx: Lanes,
    xy: Lanes,
    yy: Lanes,
    z: Lanes,
    xz: Lanes,
    yz: Lanes,
    zz: Lanes,
}

/// One, a row and the square of its distance in one number, so that one addition counts all three: how many pixels of a
/// column there are, and above these the sums of rows and of squares. They take 17 bits, and a float has 24.
const COUNTS: [f32; ROWS] = {
    let mut counts = [0.0; ROWS];
    let mut row = 0;
    while row < ROWS {
        let from_middle = row.abs_diff(REACH.1);
        counts[row] = (1 | row << ROW_BITS | (from_middle * from_middle) << SQUARE_BITS) as f32;
        row += 1;
    }
    counts
};

/// The bit at which the sum of rows begins in [`COUNTS`]: there are up to 11 pixels.
const ROW_BITS: u32 = 4;

/// The bit at which the sum of squares begins in [`COUNTS`]: rows come to 55.
const SQUARE_BITS: u32 = 10;

impl Sums {
    /// Of the good phases around each pixel of a block, those on the surface of its `phase`.
    #[inline(always)]
    fn of(around: &Around<'_>, phase: &Lanes, carrier: &Lanes) -> Self {
        let mut sums = Self::default();
        for column in 0..COLUMNS {
            let place = column * COLUMN_STEP;
            let x = place as f32 - REACH.0 as f32;
            let mut along = [0f32; LANES];
            for i in 0..LANES {
                along[i] = carrier[i] * x;
            }
            // Sums of this column alone, in which x is the same.
            let [mut counts, mut z1, mut yz] = [[0f32; LANES]; 3];
            for ((row, good), count) in around.iter().enumerate().zip(COUNTS) {
                let y = row as f32 - REACH.1 as f32;
                for i in 0..LANES {
                    let z = good[place + i] - phase[i] - along[i];
                    // False for NaN.
                    let same = if z.abs() < SAME_SURFACE { u32::MAX } else { 0 };
                    let z = f32::from_bits(z.to_bits() & same);
                    counts[i] += f32::from_bits(count.to_bits() & same);
                    z1[i] += z;
                    yz[i] += y * z;
                    sums.zz[i] += z * z;
                }
            }
            for i in 0..LANES {
                let counts = whole(counts[i]);
                let pixels = counts & ((1 << ROW_BITS) - 1);
                let rows = counts >> ROW_BITS & ((1 << (SQUARE_BITS - ROW_BITS)) - 1);
                let (n, y1) = (pixels as f32, (rows - REACH.1 as i32 * pixels) as f32);
                sums.n[i] += n;
                sums.x[i] += x * n;
                sums.y[i] += y1;
                sums.xx[i] += x * x * n;
                sums.xy[i] += x * y1;
                sums.yy[i] += (counts >> SQUARE_BITS) as f32;
                sums.z[i] += z1[i];
                sums.xz[i] += x * z1[i];
                sums.yz[i] += yz[i];
            }
        }
        sums
    }
}

/// The least-squares planes through the good phases around each pixel of a block, those on the surface of its `phase`.
#[inline(always)]
fn lay_planes(around: &Around<'_>, phase: &Lanes, carrier: &Lanes) -> Laid {
    let sums = Sums::of(around, phase, carrier);
    let mut laid = Laid { phase: [0.0; LANES], error: [0.0; LANES] };
    for (i, own) in phase.iter().enumerate() {
        let (n, x1, y1, z1) = (sums.n[i], sums.x[i], sums.y[i], sums.z[i]);
        // Moments about the centre of gravity; the plane there is the mean.
        let per_n = 1.0 / n;
        let (x0, y0, z0) = (x1 * per_n, y1 * per_n, z1 * per_n);
        let (xx, xy, yy) = (sums.xx[i] - x0 * x1, sums.xy[i] - x0 * y1, sums.yy[i] - y0 * y1);
        let (xz, yz, zz) = (sums.xz[i] - x0 * z1, sums.yz[i] - y0 * z1, sums.zz[i] - z0 * z1);
        let det = xx * yy - xy * xy;
        let per_det = 1.0 / det;
        let (a, b) = ((yy * xz - xy * yz) * per_det, (xx * yz - xy * xz) * per_det);
        let leverage = per_n + (yy * x0 * x0 - 2.0 * xy * x0 * y0 + xx * y0 * y0) * per_det;
        let rest = zz - a * xz - b * yz;
        let residual = (if rest > 0.0 { rest } else { 0.0 } * per_n).sqrt();
        let error = DEPENDENCE * leverage.sqrt() * residual;
        let good = (n >= MIN_SUPPORT as f32) & (det > 0.0) & (leverage <= MAX_LEVERAGE);
        laid.phase[i] = own + z0 - a * x0 - b * y0;
        laid.error[i] = if good { error } else { f32::INFINITY };
    }
    laid
}

#[cfg(test)]
mod tests {
    use super::{FrameMaps, refine};
    use crate::base::image::{Mono8, Plane};
    use crate::kernels::pixel_runs::Runs;
    use crate::phase::demodulate::Gains;
    use crate::phase::for_tests::{self, Phasors, demodulate, wrapped};
    use crate::phase::period::tests::measured;
    use crate::refine::curvature;
    use std::f32::consts::TAU;

    const W: usize = 240;
    const H: usize = 120;
    const PERIOD: f32 = 11.3;

    /// The phase of a tilted plane.
    fn truth(u: usize, v: usize) -> f32 {
        TAU * u as f32 / PERIOD + 0.09 * v as f32 + 400.0
    }

    /// Distance from the centre of the nearest disc; each lies otherwise on the fringes.
    fn from_disc(x: f32, y: f32) -> f32 {
        ((x - 20.0).rem_euclid(50.0) - 25.0).hypot((y + 3.0).rem_euclid(42.0) - 21.0)
    }

    /// Fringes on a white surface with discs of a colour, blurred by a lens.
    fn photograph(colour: f32) -> Plane<u8> {
        let sharp = |x: f32, y: f32| {
            let reflected = if from_disc(x, y) < 11.0 { colour } else { 1.0 };
            reflected * (62.0 + 55.0 * (TAU * x / PERIOD + 0.09 * y + 400.0).cos())
        };
        let mut image = Plane::filled(W, H, 0u8);
        // 7 x 7 samples over +-1.5 px under a Gaussian of 0.67 px.
        let taps: Vec<(f32, f32)> =
            (-3..=3).map(|k| (k as f32 / 2.0, (-(k as f32 / 2.0 / 0.67).powi(2) / 2.0).exp())).collect();
        let total = taps.iter().map(|tap| tap.1).sum::<f32>().powi(2);
        for v in 0..H {
            for u in 0..W {
                let light = |(y, a): &(f32, f32)| {
                    let row = taps.iter().map(|(x, b)| b * sharp(u as f32 + x, v as f32 + y));
                    a * row.sum::<f32>()
                };
                image.set(u, v, (2.0 + taps.iter().map(light).sum::<f32>() / total).round() as u8);
            }
        }
        image
    }

    /// RMS and largest error, rad, and pixels, before and after the corrections. Where discs are black, the mask
    /// ends on their blurred edges.
    fn errors(image: &Plane<u8>, black: bool, period: Option<f32>) -> [(f32, f32, usize); 2] {
        let (plane, image) = (image, Mono8::from(image));
        let mut object = Plane::filled(W, H, 1u8);
        for v in 0..H {
            for (u, x) in object.row_mut(v).iter_mut().enumerate() {
                *x = u8::from(!black || from_disc(u as f32, v as f32) > 10.0);
            }
        }
        let none = Plane::filled(W, H, 0u8);
        let period = period.map_or_else(|| measured(plane, &object, PERIOD), |px| Plane::filled(W, H, px));
        let absolute = |phasors: &Phasors| {
            let mut phase = wrapped(phasors);
            for v in 0..H {
                for (u, x) in phase.row_mut(v).iter_mut().enumerate() {
                    *x += TAU * ((truth(u, v) - *x) / TAU).round();
                }
            }
            phase
        };
        let score = |phase: &Plane<f32>| {
            let all = (0..H).flat_map(|v| (0..W).map(move |u| (u, v)));
            let known: Vec<f32> =
                all.map(|(u, v)| (phase.at(u, v) - truth(u, v)).abs()).filter(|e| !e.is_nan()).collect();
            let mean = known.iter().map(|e| e * e).sum::<f32>() / known.len() as f32;
            (mean.sqrt(), known.iter().copied().fold(0.0, f32::max), known.len())
        };
        let runs = Runs::of(&object);
        let mut phasors = demodulate(image, &object, &period, &Gains::new(), 1.0);
        let before = score(&absolute(&phasors));
        for_tests::correct_shading(&mut phasors, &period, &none, 1.0);
        for_tests::average_rows(&mut phasors, &none);
        let mut phase = absolute(&phasors);
        let windows = for_tests::windows(phasors, &runs);
        let maps = FrameMaps { runs: &runs, windows: &windows, period: &period, zone: &none, sign: 1.0 };
        curvature::correct(&mut phase, maps, (5.0, 12.0));
        refine(&mut phase, maps, None);
        [before, score(&phase)]
    }

    #[test]
    fn discs_of_another_colour_bias_no_phase() {
        // Colour; the period, where it is known; RMS before, at least; RMS, largest error and share of pixels after.
        // Discs of 0.35 disturb the measured period, too, and what is left is of that.
        let exact = Some(PERIOD);
        let cases = [
            (0.05, exact, 0.03, 0.02, 0.4, 0.98),
            (0.35, exact, 0.1, 0.025, 0.45, 0.99),
            (0.7, exact, 0.04, 0.03, 0.25, 0.99),
            (0.05, None, 0.03, 0.025, 0.4, 0.98),
            (0.35, None, 0.2, 0.09, 0.9, 0.92),
            (0.7, None, 0.04, 0.03, 0.25, 0.98),
        ];
        for (colour, period, biased, rms, worst, share) in cases {
            let [before, after] = errors(&photograph(colour), colour < 0.1, period);
            println!("{colour}, period {period:?}: before {before:?}, after {after:?}");
            assert!(before.0 > biased, "{colour}: {before:?}");
            assert!(after.0 < rms && after.1 < worst, "{colour}: {after:?}");
            assert!(after.2 as f32 > share * before.2 as f32, "{colour}: {after:?} of {before:?}");
        }
    }

    #[test]
    fn a_phase_that_nothing_near_supports_is_dropped_where_it_is_doubtful() {
        let image = photograph(1.0);
        let object = Plane::filled(W, H, 1u8);
        let period = Plane::filled(W, H, PERIOD);
        let (none, runs) = (Plane::filled(W, H, 0u8), Runs::of(&object));
        let mut phasors = demodulate(Mono8::from(&image), &object, &period, &Gains::new(), 1.0);
        phasors.misfit = Plane::filled(W, H, 0.5);
        phasors.misfit.row_mut(60)[100..110].fill(0.01);
        let mut phase = wrapped(&phasors);
        let known = phase.as_slice().iter().filter(|x| !x.is_nan()).count();
        let windows = for_tests::windows(phasors, &runs);
        let maps = FrameMaps { runs: &runs, windows: &windows, period: &period, zone: &none, sign: 1.0 };
        let dropped = refine(&mut phase, maps, None);
        assert_eq!(dropped, known - 10);
        assert!(phase.row(60)[100..110].iter().all(|x| !x.is_nan()));
    }
}
