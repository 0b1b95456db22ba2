// SPDX-License-Identifier: MIT OR Apache-2.0
//! Calibrations from bad photographs: every fault is recognised and named with camera and position, and either left
//! out or refused. Never is there a calibration that is silently bad.

use crate::board_photographs::{Photographs, errors, flat, good, scene};
use fourdbody::base::image::Plane;
use fourdbody::calibrate::rigging::StageError;
use fourdbody::calibrate::run::{CalibrateError, Outcome};
use fourdbody::calibrate::{Board, Finding, Kind};
use fourdbody_simulator::scenario::Light;
use std::path::Path;

/// A calibration that came to be is good, whatever was wrong with the photographs.
fn good_outcome(photographs: &Photographs) -> Outcome {
    let outcome = photographs.calibrate().unwrap_or_else(|e| panic!("{e}"));
    let (focal, place_m) = errors(&outcome.calibration, &scene().truth);
    println!("focal {focal:.6}, second camera {:.3} mm off", place_m * 1e3);
    outcome.lines().iter().for_each(|line| println!("{line}"));
    assert!(focal < 3e-4 && place_m < 4e-4, "focal {focal}, second camera {place_m} m off");
    outcome
}

fn refusal(photographs: &Photographs) -> (StageError, Vec<Finding>) {
    match photographs.calibrate().err() {
        Some(CalibrateError::Stage { error, findings }) => {
            println!("{}", CalibrateError::Stage { error: error.clone(), findings: findings.clone() });
            (error, findings)
        }
        other => panic!("must be refused, found {other:?}"),
    }
}

/// Camera, position and kind of every finding.
fn named(findings: &[Finding]) -> Vec<(&str, Option<usize>, Kind)> {
    findings.iter().map(|f| (f.camera.as_str(), f.position, f.kind)).collect()
}

fn flipped(image: &Plane<u8>) -> Plane<u8> {
    let mut out = image.clone();
    (0..out.height()).for_each(|v| out.row_mut(v).reverse());
    out
}

/// Averages over a square of `2 reach + 1` px, three times: nearly a Gaussian.
fn blurred(image: &Plane<u8>, reach: usize) -> Plane<u8> {
    let mut out = image.clone();
    for _ in 0..3 {
        let from = out.clone();
        let (w, h) = (from.width(), from.height());
        for v in reach..h - reach {
            for u in reach..w - reach {
                let rows = v - reach..=v + reach;
                let sum: u32 = rows
                    .map(|y| from.row(y)[u - reach..=u + reach].iter().map(|p| u32::from(*p)).sum::<u32>())
                    .sum();
                let side = 2 * reach as u32 + 1;
                out.set(u, v, (sum / (side * side)) as u8);
            }
        }
    }
    out
}

/// Something grey before the upper part of the board (columns run down).
fn covered(image: &Plane<u8>, share: f64) -> Plane<u8> {
    let mut out = image.clone();
    let columns = (share * out.width() as f64) as usize;
    for v in 0..out.height() {
        for u in 0..columns {
            out.set(u, v, 90 + ((u * 7 + v * 13) % 5) as u8);
        }
    }
    out
}

fn board_like(changes: &[(&str, &str)]) -> Board {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/board.toml");
    let mut text = std::fs::read_to_string(path).expect("in the repository");
    for (from, to) in changes {
        assert!(text.contains(from), "{from}");
        text = text.replace(from, to);
    }
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("board.toml");
    std::fs::write(&path, text).expect("writable");
    Board::load(&path).expect("a good file")
}

#[test]
fn good_photographs_give_a_good_calibration_without_complaint() {
    let outcome = good_outcome(&good());
    assert_eq!(named(&outcome.findings), []);
    assert_eq!(outcome.positions.len(), 8);
    println!("{:#?}", outcome.calibration.valid);
    // What the file says beside the geometry.
    let quality = outcome.calibration.quality.as_ref().expect("made from photographs");
    let (_, response) = &quality.responses[0];
    assert!((response.gamma - 1.0).abs() < 0.03 && response.sigma < 0.02, "{response:?}");
    let volume = outcome.calibration.valid.as_ref().expect("made from photographs").any;
    assert!(volume.min_m[2] < 0.4 && volume.max_m[2] > 1.6 && volume.max_m[0] < 0.8, "{volume:?}");
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("calibration.json");
    outcome.calibration.save(&path).expect("writable");
    let back = fourdbody::data::Calibration::load(&path).expect("valid");
    assert_eq!(
        (&back.quality, &back.identity),
        (&outcome.calibration.quality, &outcome.calibration.identity)
    );
    assert_eq!(back.valid, outcome.calibration.valid);
    // The report stands alone, and names what it shows.
    let page = fourdbody::calibrate::report::page(&outcome);
    for part in ["h0_low", "<svg", "gamma", "Coverage of the volume", "Loop error"] {
        assert!(page.contains(part), "{part}");
    }
    assert!(!page.contains("src=") && !page.contains("href=") && !page.contains("NaN"), "not self-contained");
    if let Some(path) = std::env::var_os("CALIBRATION_REPORT") {
        std::fs::write(path, page).expect("writable");
    }
}

#[test]
fn too_few_positions_are_refused() {
    let mut photographs = good();
    photographs.keep(|trigger| trigger < 10);
    let five = StageError::Positions { head: "h0".to_owned(), found: 5 };
    assert_eq!(refusal(&photographs).0, five);
    // The same five again are no more.
    let mut twice = good();
    twice.keep(|trigger| trigger < 10);
    for trigger in 0..10 {
        (0..2).for_each(|camera| twice.set(trigger + 10, camera, good().image(trigger, camera).clone()));
    }
    assert_eq!(refusal(&twice).0, five);
}

#[test]
fn parallel_positions_are_refused() {
    let poses: Vec<_> = (0..6).map(|i| flat(0.1 + 0.07 * f64::from(i), 5.0, f64::from(i), 0.0)).collect();
    let photographs = Photographs::take(scene(), &poses);
    let (error, _) = refusal(&photographs);
    let tilted = |degrees| error.to_string().contains(&format!("by at most {degrees} degrees"));
    assert!((3..=6).any(tilted), "{error}");
}

#[test]
fn the_wrong_board_file_is_refused() {
    let code = [(
        "large = [[4, 13], [4, 16], [5, 13], [7, 13], [10, 4]]",
        "large = [[3, 3], [9, 9], [10, 9], [2, 14], [3, 14]]",
    )];
    let pitch = [("pitch_m = 0.1", "pitch_m = 0.115")];
    for (changes, kind) in [(code, Kind::WrongBoard), (pitch, Kind::CircleSize)] {
        let board = board_like(&changes);
        let error = good().with_board(&board).calibrate_in(scene(), &board).expect_err("must be refused");
        println!("{error}");
        let CalibrateError::Stage { error: StageError::Positions { found: 0, .. }, findings } = error else {
            panic!("{error}")
        };
        let whites = findings.iter().filter(|f| f.kind == kind).count();
        assert_eq!(whites, 16, "{findings:?}");
    }
    // Everything a tenth larger looks the same to each camera; the distance of the cameras gives it away.
    let board = board_like(&[
        ("pitch_m = 0.1", "pitch_m = 0.11"),
        ("large_radius_m = 0.024", "large_radius_m = 0.0264"),
        ("\nradius_m = 0.015", "\nradius_m = 0.0165"),
    ]);
    let error = good().with_board(&board).calibrate_in(scene(), &board).expect_err("must be refused");
    let scale = |percent| error.to_string().contains(&format!("come out {percent} % as far apart"));
    assert!((108..=112).any(scale), "{error}");
}

#[test]
fn mirrored_images_are_named() {
    let mut one = good();
    one.change(&[4], &[1], flipped);
    let outcome = good_outcome(&one);
    let found = named(&outcome.findings);
    assert!(found.contains(&("h0_low", Some(3), Kind::Mirrored)), "{found:?}");
    assert!(
        found.iter().all(|(camera, position, _)| (*camera, *position) == ("h0_low", Some(3))),
        "{found:?}"
    );
    let mut all = good();
    all.change(&[0, 2, 4, 6, 8, 10, 12, 14], &[1], flipped);
    let (error, findings) = refusal(&all);
    assert!(error.to_string().starts_with("camera h0_low: usable views in 0 of 8 positions"), "{error}");
    assert_eq!(findings.iter().filter(|f| f.kind == Kind::Mirrored).count(), 8);
}

#[test]
fn swapped_cameras_are_refused() {
    let mut photographs = good();
    photographs.swap_cameras();
    let (error, _) = refusal(&photographs);
    assert!(error.to_string().starts_with("cameras h0_up and h0_low are swapped"), "{error}");
}

#[test]
fn blurred_and_saturated_positions_are_left_out() {
    let mut photographs = good();
    photographs.change(&[2], &[0], |image| blurred(image, 3));
    let brighter = |image: &Plane<u8>| {
        let pixels = image.as_slice().iter().map(|p| p.saturating_mul(3)).collect();
        Plane::from_vec(image.width(), image.height(), pixels).expect("the same size")
    };
    photographs.change(&[8], &[1], brighter);
    let outcome = good_outcome(&photographs);
    let found = named(&outcome.findings);
    assert!(found.contains(&("h0_up", Some(2), Kind::Blurred)), "{found:?}");
    assert!(found.contains(&("h0_low", Some(5), Kind::Saturated)), "{found:?}");
}

#[test]
fn a_hand_before_a_third_of_the_board_is_named() {
    for frames in [&[6u64, 7][..], &[6], &[7]] {
        let mut photographs = good();
        photographs.change(frames, &[0], |image| covered(image, 0.4));
        let outcome = good_outcome(&photographs);
        let found = named(&outcome.findings);
        assert!(found.contains(&("h0_up", Some(4), Kind::Hidden)), "{frames:?}: {found:?}");
    }
}

/// The board gives the fringe orders, as long as some markers agree on them.
#[test]
fn fringes_without_marker_are_used_as_long_as_others_have_one() {
    let plain = crate::board_photographs::Scene::new(7, 2).without_marker();
    let mut photographs = good();
    let poses = crate::board_photographs::poses();
    for (position, pose) in poses.iter().enumerate() {
        let images = plain.photograph(*pose, Light::Fringes, 2 * position as u64 + 1);
        for (camera, image) in images.into_iter().enumerate() {
            photographs.set(2 * position as u64 + 1, camera, image);
        }
        if [0, 4].contains(&position) {
            let outcome = good_outcome(&photographs);
            let without =
                (1..=position + 1).flat_map(|p| ["h0_up", "h0_low"].map(|camera| (camera, Some(p))));
            let expected: Vec<_> = without.map(|(camera, p)| (camera, p, Kind::NoMarker)).collect();
            assert_eq!(named(&outcome.findings), expected);
            assert!(outcome.findings.iter().all(|finding| !finding.left_out), "{:?}", outcome.findings);
        }
    }
    let (error, findings) = refusal(&photographs);
    assert!(error.to_string().starts_with("head h0: the markers in 0 of 0 frames"), "{error}");
    assert_eq!(findings.iter().filter(|f| f.kind == Kind::NoMarker).count(), 16);
}

/// Markers misread by whole fringes: the calibration is the same, and nothing is called motion.
#[test]
fn markers_misread_by_any_number_of_fringes_cost_no_view() {
    let right = good_outcome(&good());
    let same = |misread: &[(usize, usize, i32)]| {
        let outcome = good().calibrate_misread(misread).unwrap_or_else(|e| panic!("{misread:?}: {e}"));
        let camera = |camera| ["h0_up", "h0_low"][camera];
        let mut expected: Vec<_> =
            misread.iter().map(|&(p, c, _)| (camera(c), Some(p + 1), Kind::MarkerMisread)).collect();
        let mut found = named(&outcome.findings);
        expected.sort_by_key(|(camera, position, _)| (*position, *camera));
        found.sort_by_key(|(camera, position, _)| (*position, *camera));
        assert_eq!(found, expected);
        // One by one, since the order of findings is another.
        for (finding, (_, _, fringes)) in
            outcome.findings.iter().zip(misread).take(usize::from(misread.len() == 1))
        {
            assert!(finding.message.contains(&format!("read {fringes} fringes")), "{finding}");
        }
        let (found, right) = (&outcome.together.all, &right.together.all);
        for ((a, b), sigma) in found.model.devices.iter().zip(&right.model.devices).zip(&right.device_sigma) {
            let shift = a.device_from_frame.translation.vector - b.device_from_frame.translation.vector;
            let moved = (0..3).map(|axis| shift[axis].abs() / sigma[12 + axis].max(1e-6)).fold(0.0, f64::max);
            let focal = (a.lens.fx - b.lens.fx).abs() / sigma[0];
            assert!(focal < 0.3 && moved < 0.3, "{misread:?}: {focal} and {moved} standard deviations off");
        }
    };
    // 2, 89 and 124 fringes, and 10, 25 and 81, are what other photographs had.
    for (i, fringes) in [1, -1, 2, 10, 25, -41, 81, 89, 124].into_iter().enumerate() {
        same(&[(i % 8, i % 2, fringes)]);
    }
    // Seven of sixteen, each by another number.
    same(&[(0, 0, 89), (0, 1, 2), (1, 0, -3), (3, 1, 124), (4, 0, 41), (6, 1, -82), (7, 0, 1)]);
}

/// Nine of sixteen: nobody can tell who is right.
#[test]
fn markers_that_disagree_by_majority_are_refused() {
    let misread: Vec<_> = (0..9).map(|i| (i / 2, i % 2, 7 * i as i32 - 40)).collect();
    let error = good().calibrate_misread(&misread).expect_err("must be refused");
    assert!(error.to_string().starts_with("head h0: the markers in 7 of 16 frames"), "{error}");
}

/// All over, and but for the first columns.
#[test]
fn fringes_that_are_too_dark_to_compare_are_not_called_motion() {
    for lit in [0, 120] {
        let mut photographs = good();
        photographs.change(&[7], &[0], |image| {
            let mut out = image.clone();
            (0..out.height()).for_each(|v| out.row_mut(v)[lit..].iter_mut().for_each(|p| *p /= 10));
            out
        });
        let outcome = good_outcome(&photographs);
        assert_eq!(named(&outcome.findings), [("h0_up", Some(4), Kind::TooDark)], "{lit} columns are lit");
    }
}

#[test]
fn fringes_before_white_are_paired_by_the_circles_and_named() {
    let mut photographs = good();
    photographs.renumber(|trigger| trigger ^ 1);
    let outcome = good_outcome(&photographs);
    let swapped = outcome.findings.iter().filter(|f| f.kind == Kind::OrderSwapped).count();
    assert_eq!((swapped, outcome.findings.len()), (16, 16), "{:?}", outcome.findings);
}

/// The board moves after its white frame: a little towards the head, so that circles stay within a pixel or so and
/// only the phase tells; and far.
#[test]
fn a_board_that_moved_before_its_fringes_is_named() {
    let poses = crate::board_photographs::poses();
    for shift_m in [0.004, 0.06] {
        let mut photographs = good();
        let mut moved = poses[5];
        moved.centre_m[0] += shift_m;
        moved.centre_m[2] += shift_m;
        for (camera, image) in scene().photograph(moved, Light::Fringes, 11).into_iter().enumerate() {
            photographs.set(11, camera, image);
        }
        let outcome = good_outcome(&photographs);
        let found = named(&outcome.findings);
        for camera in ["h0_up", "h0_low"] {
            assert!(found.contains(&(camera, Some(6), Kind::Moved)), "moved by {shift_m} m: {found:?}");
        }
        assert!(found.iter().all(|(_, position, _)| *position == Some(6)), "{found:?}");
        if shift_m > 0.01 {
            continue;
        }
        // Also where the marker is misread, whatever whole fringes there are on top of the motion.
        for fringes in [1, -2, 89] {
            let misread = photographs.calibrate_misread(&[(5, 0, fringes), (5, 1, fringes)]);
            let outcome = misread.unwrap_or_else(|e| panic!("{e}"));
            let found = named(&outcome.findings);
            for camera in ["h0_up", "h0_low"] {
                assert!(found.contains(&(camera, Some(6), Kind::Moved)), "{fringes} fringes: {found:?}");
            }
        }
    }
}

#[test]
fn cameras_without_frames_take_one_line_each() {
    let mut photographs = good();
    photographs.miss(&[3, 5, 7], 1);
    let outcome = good_outcome(&photographs);
    let missing: Vec<&Finding> = outcome.findings.iter().filter(|f| f.kind == Kind::NoFrames).collect();
    assert_eq!(missing.len(), 1, "{:?}", outcome.findings);
    assert!(missing[0].message.contains("3 of 16"), "{}", missing[0]);
}
