// SPDX-License-Identifier: MIT OR Apache-2.0
//! Finds black circles on a lit white board: connected dark regions, then their outlines to a few hundredths
//! of a pixel.
//!
//! The outline is where the grey level crosses the middle between inside and outside *along each ray*, so that
//! uneven light shifts nothing. A region that is cut by the image, by the edge of the light or by something in
//! front of the board has no complete outline and is left out.

use super::ellipse::Ellipse;
use super::estimate::median;
use crate::base::image::{Mono8, Plane};
use std::ops::RangeInclusive;

/// The image of one black circle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spot {
    pub ellipse: Ellipse,
    /// RMS distance of the outline's points from the ellipse, px.
    pub rms_px: f64,
    /// Grey levels between inside and outside.
    pub contrast: f64,
    /// Width of the edge from a quarter to three quarters of the contrast, px: defocus and motion widen it.
    pub blur_px: f64,
    /// The lightest outside level, grey levels: 255 is saturated.
    pub outside: f64,
}

/// Side of the blocks in which the white level is looked for, px.
const BLOCK: usize = 16;
/// White is the lightest level within this many blocks to each side.
const REACH: usize = 4;
/// Darker than this share of the white around is dark.
const DARK: f32 = 0.5;
/// Regions smaller or larger than this are not circles, px.
const AREA: RangeInclusive<usize> = 40..=12_000;
/// Rays on which the outline is looked for.
const RAYS: usize = 64;
/// Least contrast between a circle and the white around it, grey levels.
const LEAST_CONTRAST: f64 = 12.0;
/// Largest RMS distance of the outline from an ellipse, px.
const LARGEST_RMS: f64 = 0.35;

/// All circles in an image, in no particular order.
pub fn find_spots(image: Mono8<'_>) -> Vec<Spot> {
    let white = white_level(image);
    dark_ellipses(image, &white).iter().filter_map(|coarse| outline(image, coarse)).collect()
}

/// The lightest level of each square block of a picture, or 0.
pub(super) fn lightest_of_blocks(
    width: usize,
    height: usize,
    block: usize,
    level: impl Fn(usize, usize) -> f32,
) -> Plane<f32> {
    let mut blocks = Plane::filled(width.div_ceil(block), height.div_ceil(block), 0.0f32);
    for v in 0..height {
        for u in 0..width {
            let (column, row) = (u / block, v / block);
            blocks.set(column, row, blocks.at(column, row).max(level(u, v)));
        }
    }
    blocks
}

/// The white level around every block: 0 where it is dark all around.
fn white_level(image: Mono8<'_>) -> Plane<f32> {
    let level = |u: usize, v: usize| f32::from(image.row(v)[u]);
    let blocks = lightest_of_blocks(image.width(), image.height(), BLOCK, level);
    let around = |at: usize, count: usize| at.saturating_sub(REACH)..(at + REACH + 1).min(count);
    Plane::from_fn(blocks.width(), blocks.height(), |column, row| {
        let (us, vs) = (around(column, blocks.width()), around(row, blocks.height()));
        vs.flat_map(|v| us.clone().map(move |u| (u, v))).map(|(u, v)| blocks.at(u, v)).fold(0.0, f32::max)
    })
}

/// A pixel and all around it, as steps along u and v.
const AROUND: [[isize; 2]; 9] =
    [[-1, -1], [0, -1], [1, -1], [-1, 0], [0, 0], [1, 0], [-1, 1], [0, 1], [1, 1]];

/// The ellipses with the moments of the connected dark regions, of those that fill their ellipse.
fn dark_ellipses(image: Mono8<'_>, white: &Plane<f32>) -> Vec<Ellipse> {
    let (width, height) = (image.width(), image.height());
    let dark = Plane::from_fn(width, height, |u, v| {
        let level = white.at(u / BLOCK, v / BLOCK);
        f64::from(level) > 2.0 * LEAST_CONTRAST && f32::from(image.row(v)[u]) < DARK * level
    });
    let ellipse = |region: &Vec<usize>| {
        let pixels = region.iter().map(|p| [(p % width) as f64, (p / width) as f64]);
        let (ellipse, filled) = Ellipse::of_region(pixels)?;
        (0.85..1.15).contains(&filled).then_some(ellipse)
    };
    regions(dark, &AROUND, AREA).iter().filter_map(ellipse).collect()
}

/// The regions of set places that are connected by these steps along u and v, do not reach the rim and have an area in
/// this range, px: each as its places, `v * width + u`.
pub(super) fn regions(
    mut set: Plane<bool>,
    steps: &[[isize; 2]],
    area: RangeInclusive<usize>,
) -> Vec<Vec<usize>> {
    let (width, height) = (set.width(), set.height());
    let unseen = set.as_mut_slice();
    let (mut found, mut stack) = (Vec::new(), Vec::new());
    for start in 0..unseen.len() {
        if !std::mem::take(&mut unseen[start]) {
            continue;
        }
        stack.push(start);
        let (mut places, mut at_rim) = (Vec::new(), false);
        while let Some(place) = stack.pop() {
            places.push(place);
            let (u, v) = (place % width, place / width);
            at_rim |= u == 0 || v == 0 || u + 1 == width || v + 1 == height;
            for [du, dv] in steps {
                // Steps below 0 wrap to places beyond the rim.
                let (u, v) = (u.wrapping_add_signed(*du), v.wrapping_add_signed(*dv));
                if u < width && v < height && std::mem::take(&mut unseen[v * width + u]) {
                    stack.push(v * width + u);
                }
            }
        }
        if !at_rim && area.contains(&places.len()) {
            found.push(places);
        }
    }
    found
}

fn outline(image: Mono8<'_>, coarse: &Ellipse) -> Option<Spot> {
    let mut edges = Vec::with_capacity(RAYS);
    for ray in 0..RAYS {
        edges.push(edge(image, coarse, ray as f64 * std::f64::consts::TAU / RAYS as f64)?);
    }
    let points: Vec<[f64; 2]> = edges.iter().map(|edge| edge.point).collect();
    let first = Ellipse::fit(&points)?;
    let gate = (4.0 * 1.4826 * median(points.iter().map(|p| first.distance(*p).abs()))).max(0.05);
    let kept: Vec<[f64; 2]> = points.into_iter().filter(|p| first.distance(*p).abs() <= gate).collect();
    if kept.len() * 4 < RAYS * 3 {
        return None;
    }
    let ellipse = Ellipse::fit(&kept)?;
    let mean = |value: &dyn Fn(&Edge) -> f64| edges.iter().map(value).sum::<f64>() / RAYS as f64;
    let rms_px = (kept.iter().map(|p| ellipse.distance(*p).powi(2)).sum::<f64>() / kept.len() as f64).sqrt();
    let spot = Spot {
        ellipse,
        rms_px,
        contrast: mean(&|edge| edge.outside - edge.inside),
        blur_px: mean(&|edge| edge.width),
        outside: edges.iter().map(|edge| edge.outside).fold(0.0, f64::max),
    };
    let round = ellipse.axes[1] > 0.2 * ellipse.axes[0];
    (round && rms_px < LARGEST_RMS && spot.contrast > LEAST_CONTRAST).then_some(spot)
}

struct Edge {
    point: [f64; 2],
    inside: f64,
    outside: f64,
    width: f64,
}

/// Step along a ray, px.
const STEP: f64 = 0.25;

/// Where the ray from the centre at eccentric anomaly `t` leaves the dark; `None` where it does not, or where the
/// light ends just outside.
fn edge(image: Mono8<'_>, coarse: &Ellipse, t: f64) -> Option<Edge> {
    let [u0, v0] = coarse.centre;
    let [u1, v1] = coarse.at(t);
    let length = ((u1 - u0).powi(2) + (v1 - v0).powi(2)).sqrt();
    let (du, dv) = ((u1 - u0) / length, (v1 - v0) / length);
    let level = |r: f64| sample(image, u0 + r * du, v0 + r * dv);
    let mean = |from: f64, to: f64| {
        let count = ((to - from) / 0.5).ceil().max(1.0);
        let mut sum = 0.0;
        for i in 0..=count as usize {
            sum += level(from + (to - from) * i as f64 / count)?;
        }
        Some(sum / (count + 1.0))
    };
    // Plateaus: well inside, and a few pixels outside of the blur.
    let inside = mean(0.0, (length - 3.5).max(0.3 * length))?;
    let outside = mean(length + 2.5, length + 5.0)?;
    let farther = mean(length + 5.0, length + 7.5)?;
    if outside - inside < LEAST_CONTRAST || farther < inside + 0.75 * (outside - inside) {
        return None;
    }
    let crossing = |share: f64| {
        let threshold = inside + share * (outside - inside);
        let (mut r, end) = ((length - 4.0).max(0.2 * length), length + 4.0);
        let mut before = level(r)?;
        while r < end {
            let after = level(r + STEP)?;
            if before < threshold && after >= threshold {
                return Some(r + STEP * (threshold - before) / (after - before));
            }
            (r, before) = (r + STEP, after);
        }
        None
    };
    let r = crossing(0.5)?;
    let width = crossing(0.75)? - crossing(0.25)?;
    Some(Edge { point: [u0 + r * du, v0 + r * dv], inside, outside, width })
}

/// Bilinear; `None` outside the image.
fn sample(image: Mono8<'_>, u: f64, v: f64) -> Option<f64> {
    let (column, row) = (u.floor(), v.floor());
    if !(column >= 0.0
        && row >= 0.0
        && column + 1.0 < image.width() as f64
        && row + 1.0 < image.height() as f64)
    {
        return None;
    }
    let (a, b) = (u - column, v - row);
    let (column, row) = (column as usize, row as usize);
    let (upper, lower) = (image.row(row), image.row(row + 1));
    let at = |line: &[u8]| f64::from(line[column]) * (1.0 - a) + f64::from(line[column + 1]) * a;
    Some(at(upper) * (1.0 - b) + at(lower) * b)
}

#[cfg(test)]
mod tests {
    use super::find_spots;
    use crate::base::image::{Mono8, Plane};

    /// Discs drawn with pixel integration (8 x 8 subsamples) under light that falls off.
    fn drawn(discs: &[([f64; 2], f64)], size: (usize, usize)) -> Plane<u8> {
        let mut plane = Plane::filled(size.0, size.1, 0u8);
        for v in 0..size.1 {
            for u in 0..size.0 {
                let mut sum = 0.0;
                for k in 0..64 {
                    let (x, y) = (
                        u as f64 - 0.4375 + f64::from(k % 8) / 8.0,
                        v as f64 - 0.4375 + f64::from(k / 8) / 8.0,
                    );
                    let dark = discs.iter().any(|(c, r)| (x - c[0]).powi(2) + (y - c[1]).powi(2) < r * r);
                    let light = 200.0 - 0.3 * x - 0.2 * y;
                    sum += if dark { 0.05 * light } else { light };
                }
                plane.set(u, v, (sum / 64.0 + 0.5) as u8);
            }
        }
        plane
    }

    #[test]
    fn centres_are_exact_under_uneven_light() {
        let discs = [([60.3, 70.7], 14.0), ([140.25, 66.5], 9.2), ([80.9, 150.1], 20.5)];
        let plane = drawn(&discs, (200, 200));
        let mut spots = find_spots(Mono8::from(&plane));
        assert_eq!(spots.len(), 3);
        spots.sort_by(|a, b| a.ellipse.radius().total_cmp(&b.ellipse.radius()));
        let mut sorted = discs;
        sorted.sort_by(|a, b| a.1.total_cmp(&b.1));
        for (spot, (centre, radius)) in spots.iter().zip(sorted) {
            let [u, v] = spot.ellipse.centre;
            assert!((u - centre[0]).abs() < 0.02 && (v - centre[1]).abs() < 0.02, "{spot:?} at {centre:?}");
            assert!((spot.ellipse.radius() - radius).abs() < 0.05, "{spot:?} of {radius}");
        }
    }

    #[test]
    fn cut_circles_are_left_out() {
        // One at the image's edge, one whose surroundings go dark, one whole.
        let mut plane =
            drawn(&[([4.0, 100.0], 14.0), ([100.0, 100.0], 14.0), ([100.0, 170.0], 14.0)], (200, 200));
        for v in 178..200 {
            plane.row_mut(v).fill(2);
        }
        let spots = find_spots(Mono8::from(&plane));
        assert_eq!(spots.len(), 1, "{spots:?}");
        assert!((spots[0].ellipse.centre[0] - 100.0).abs() < 0.05);
    }
}
