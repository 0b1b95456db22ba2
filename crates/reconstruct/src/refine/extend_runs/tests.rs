// SPDX-License-Identifier: MIT OR Apache-2.0
//! Runs whose ends are known, lit as a frame is.

use super::{Input, complete};
use crate::base::image::{Mono8, Plane};
use crate::kernels::pixel_runs::Runs;
use crate::phase::demodulate::Gains;
use crate::phase::for_tests::{self, demodulate, wrapped};
use crate::phase::window_quality::Windows;
use std::f32::consts::TAU;

const WIDTH: usize = 160;

/// A surface that turns away: the fringes become shorter towards both ends.
fn truth(u: usize) -> f32 {
    let x = u as f32 - 80.0;
    TAU * (x / 13.0 + x * x * x / 1.6e5) + 900.0
}

/// Lit fringes on black; the mask ends with the light, as that of a frame does.
fn scene() -> (Plane<u8>, Plane<u8>) {
    let light = |u: usize| {
        let lit = (25..135).contains(&u);
        if lit { (2.0 + 50.0 * (1.0 + 0.95 * truth(u).cos())) as u8 } else { 2 }
    };
    let row: Vec<u8> = (0..WIDTH).map(light).collect();
    let bright = |u: &usize| row[*u] > 10;
    let (first, last) = ((0..WIDTH).find(bright), (0..WIDTH).rfind(bright));
    let on_mask = |u: usize| u8::from(Some(u) >= first && Some(u) <= last);
    let mask = (0..WIDTH).map(on_mask).collect();
    let plane = |data| Plane::from_vec(WIDTH, 1, data).expect("a row");
    (plane(row), plane(mask))
}

/// Absolute phases as a frame has them before, and what else is needed.
fn before(image: &Plane<u8>, mask: &Plane<u8>, sign: f32) -> (Plane<f32>, Windows, Plane<f32>) {
    // As it is counted: that of the middle reaches to the ends.
    let period = Plane::filled(WIDTH, 1, 12.0);
    let phasors = demodulate(Mono8::from(image), mask, &period, &Gains::new(), sign);
    let mut absolute = wrapped(&phasors);
    for (u, phase) in absolute.as_mut_slice().iter_mut().enumerate() {
        *phase += TAU * ((sign * truth(u) - *phase) / TAU).round();
    }
    (absolute, for_tests::windows(phasors, &Runs::of(mask)), period)
}

/// Pixels known, and the RMS and largest error of those up to 16 px from the ends of the mask.
fn errors(absolute: &Plane<f32>, mask: &Plane<u8>, sign: f32) -> (usize, f32, f32) {
    let runs = Runs::of(mask);
    let run = runs.row(0)[0].columns();
    let near = run.clone().filter(|u| (u - run.start).min(run.end - 1 - u) < 16);
    let errors = near.map(|u| (absolute.at(u, 0) - sign * truth(u)).abs()).filter(|e| !e.is_nan());
    let errors: Vec<f32> = errors.collect();
    let square = errors.iter().map(|e| e * e).sum::<f32>() / errors.len() as f32;
    (errors.len(), square.sqrt(), errors.iter().copied().fold(0.0, f32::max))
}

#[test]
fn runs_are_completed_to_where_their_windows_end_in_the_dark() {
    let (image, mask) = scene();
    let (runs, zone, gains) = (Runs::of(&mask), Plane::filled(WIDTH, 1, 0), Gains::new());
    for sign in [1.0, -1.0] {
        let (mut absolute, mut windows, mut period) = before(&image, &mask, sign);
        let (known, rms, _) = errors(&absolute, &mask, sign);
        let input = Input { image: &image, runs: &runs, zone: &zone, gains: &gains, sign };
        let added = complete(&input, &mut absolute, &mut windows, &mut period);
        let (known_after, rms_after, worst) = errors(&absolute, &mask, sign);
        println!(
            "{added} added: {known} known, {rms} rad rms; then {known_after}, {rms_after}, worst {worst}"
        );
        assert_eq!(known_after, known + added);
        assert!(added >= 5, "{added}");
        assert!(rms_after < 0.92 * rms && worst < 0.15, "{rms} {rms_after} {worst}");
    }
}

#[test]
fn nothing_is_added_beside_an_open_order_or_the_marker() {
    let (image, mask) = scene();
    let (runs, gains) = (Runs::of(&mask), Gains::new());
    for marked in [0, 1] {
        let zone = Plane::filled(WIDTH, 1, marked);
        let (mut absolute, mut windows, mut period) = before(&image, &mask, 1.0);
        if marked == 0 {
            absolute.as_mut_slice().fill(f32::NAN);
        }
        let known = absolute.clone();
        let input = Input { image: &image, runs: &runs, zone: &zone, gains: &gains, sign: 1.0 };
        assert_eq!(complete(&input, &mut absolute, &mut windows, &mut period), 0);
        let same = |(a, b): (&f32, &f32)| a.to_bits() == b.to_bits();
        assert!(absolute.as_slice().iter().zip(known.as_slice()).all(same));
    }
}

/// A dark stripe: on one surface, or between two.
#[test]
fn the_ends_at_a_spot_stay_as_they_are() {
    let (mut image, mut mask) = scene();
    image.row_mut(0)[70..95].fill(2);
    mask.row_mut(0)[70..95].fill(0);
    let (runs, zone, gains) = (Runs::of(&mask), Plane::filled(WIDTH, 1, 0), Gains::new());
    let beside = |absolute: &Plane<f32>| (56..109).filter(|&u| !absolute.at(u, 0).is_nan()).count();
    for (turns, spot) in [(0.0, true), (3.0, false)] {
        let (mut absolute, mut windows, mut period) = before(&image, &mask, 1.0);
        absolute.row_mut(0)[95..].iter_mut().for_each(|phase| *phase += turns * TAU);
        let known = beside(&absolute);
        let input = Input { image: &image, runs: &runs, zone: &zone, gains: &gains, sign: 1.0 };
        complete(&input, &mut absolute, &mut windows, &mut period);
        assert_eq!(beside(&absolute) == known, spot, "{known} {}", beside(&absolute));
    }
}

/// Beyond the mask there is another surface, not the dark: what the window sees does not go on.
#[test]
fn a_window_that_reaches_another_surface_gives_nothing() {
    let (mut image, mask) = scene();
    let (runs, zone, gains) = (Runs::of(&mask), Plane::filled(WIDTH, 1, 0), Gains::new());
    let run = runs.row(0)[0].columns();
    image.row_mut(0)[..run.start].fill(120);
    image.row_mut(0)[run.end..].fill(120);
    let (mut absolute, mut windows, mut period) = before(&image, &mask, 1.0);
    let input = Input { image: &image, runs: &runs, zone: &zone, gains: &gains, sign: 1.0 };
    complete(&input, &mut absolute, &mut windows, &mut period);
    let (_, _, worst) = errors(&absolute, &mask, 1.0);
    println!("worst {worst}");
    assert!(worst < 0.3, "{worst}");
}
