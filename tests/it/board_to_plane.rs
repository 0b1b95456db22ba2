// SPDX-License-Identifier: MIT OR Apache-2.0
//! Rendered photographs of the board -> calibration -> clouds of the board elsewhere, against the true rig and the true
//! plane. One head at half size, so that it takes seconds; `make validate` does it in full.

use fourdbody::base::ids::{CameraId, TriggerIndex};
use fourdbody::base::image::Mono8;
use fourdbody::calibrate::{Board, run};
use fourdbody::config::Rig;
use fourdbody::data::{Calibration, Frame, FrameSource};
use fourdbody::reconstruct::outcome::Outcome;
use fourdbody::reconstruct::pipeline::{Method, Pipeline};
use fourdbody::reconstruct::triangulate::camera_projector::CameraProjector;
use fourdbody::reconstruct::triangulate::triangulator::Triangulator;
use fourdbody_simulator::cache::{CachedImages, Manifest};
use fourdbody_simulator::compare::compare;
use fourdbody_simulator::scenario::{FlatPose, Scenario, Subject};
use fourdbody_simulator::sequence::{Changes, Run};
use nalgebra::Point3;
use std::ops::Range;
use std::path::Path;

/// Rendered images as a session.
struct Rendered {
    cameras: Vec<CameraId>,
    images: Vec<CachedImages>,
    triggers: Range<u64>,
}

impl FrameSource for Rendered {
    fn cameras(&self) -> &[CameraId] {
        &self.cameras
    }

    fn triggers(&self) -> Range<u64> {
        self.triggers.clone()
    }

    fn frame(&self, camera: &CameraId, trigger: TriggerIndex) -> Result<Frame<'_>, String> {
        let place = self.cameras.iter().position(|c| c == camera).ok_or("unknown camera")?;
        self.images[place].image(trigger.0 as i64).map(Frame::Image).ok_or_else(|| "no image".to_owned())
    }
}

fn pose(x: f64, azimuth_deg: f64, tilt_deg: f64, roll_deg: f64) -> FlatPose {
    FlatPose { centre_m: [x, 0.0, 1.0], azimuth_deg, tilt_deg, roll_deg, rpm: None }
}

/// Positions that the first head is calibrated from, then positions that it is judged on.
fn poses() -> (Vec<FlatPose>, Vec<FlatPose>) {
    let calibrated = vec![
        pose(0.55, 0.0, 0.0, 0.0),
        pose(0.10, 18.0, 8.0, 0.0),
        pose(0.10, -18.0, -8.0, 0.0),
        pose(0.35, 10.0, -12.0, 4.0),
        pose(0.35, -10.0, 12.0, -4.0),
        pose(0.0, 45.0, 0.0, 0.0),
        pose(0.0, -45.0, 4.0, 0.0),
    ];
    (calibrated, vec![pose(0.2, 5.0, 3.0, 0.0), pose(0.1, -35.0, 0.0, 0.0)])
}

/// The first head of the shipped rig, the board at these positions, white and with fringes.
fn render(poses: Vec<FlatPose>, directory: &Path) -> (Run, Rendered) {
    let config = Path::new(env!("CARGO_MANIFEST_DIR")).join("config");
    let mut scenario = Scenario::load(&config.join("scenarios/board.toml")).expect("a valid scenario");
    let mut rig = Rig::load(&scenario.rig).expect("a valid rig");
    rig.heads.truncate(1);
    scenario.instants = 2 * poses.len();
    scenario.truth_every = 0;
    scenario.optics.edge_samples = 3;
    let Subject::Flat { poses: stand, .. } = &mut scenario.subject else { panic!("not a board") };
    *stand = poses;
    let run = Run::new(scenario, &rig, &Changes { size_divisor: 2, ..Changes::default() }).expect("fits");
    run.render(directory, |_, _| {}).expect("rendered");
    let manifest = Manifest::load(directory).expect("complete");
    let cameras: Vec<CameraId> = manifest.cameras.iter().map(|camera| camera.id.clone()).collect();
    let open = |id: &CameraId| CachedImages::open(directory, &manifest, id).expect("complete");
    let images = cameras.iter().map(open).collect();
    let triggers = 0..manifest.instants as u64;
    (run, Rendered { cameras, images, triggers })
}

#[test]
fn a_calibration_from_rendered_photographs_puts_the_board_where_it_is() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (calibrated, judged) = poses();
    let split = 2 * calibrated.len() as u64;
    let all = calibrated.iter().chain(&judged).copied().collect();
    let (rendered, mut source) = render(all, dir.path());
    source.triggers = 0..split;
    let nominal = Calibration::nominal(&rendered.rig);
    let board = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/board.toml");
    let board = Board::load(&board).expect("a good board");
    let outcome = run::calibrate(&source, &nominal, &board, &run::Options::default()).expect("calibrated");
    assert!(outcome.findings.is_empty(), "{:?}", outcome.findings);
    let found = outcome.calibration;

    let before = compare(&nominal, &rendered.calibration).expect("the same cameras");
    let after = compare(&found, &rendered.calibration).expect("the same cameras");
    println!("nominal {:?}, calibrated {:?}", before.together, after.together);
    assert!(before.together.rms_mm > 5.0, "without a calibration there is nothing to show: {before:?}");
    assert!(after.together.rms_mm < 0.06, "{after:?}");

    let head = &found.heads[0];
    let mut clouds = 0;
    for (place, pose) in judged.iter().enumerate() {
        let trigger = TriggerIndex(split + 2 * place as u64 + 1);
        for camera in &head.cameras {
            let pair = CameraProjector::new(head, camera, &found).expect("a usable pair");
            let frame = source.frame(&camera.id, trigger).expect("an image");
            let Frame::Image(image) = frame else { panic!("not an image") };
            let Some(off) = distances(pair, image, pose, &after.true_from_found, &board) else { continue };
            clouds += 1;
            let share = |q: f64| off[(q * (off.len() - 1) as f64) as usize];
            println!(
                "{} {place}: {} points, median {:.3}, p95 {:.3} mm",
                camera.id,
                off.len(),
                share(0.5),
                share(0.95)
            );
            assert!(off.len() > 20_000, "{} points", off.len());
            assert!(share(0.5) < 0.07 && share(0.95) < 0.25, "median {}, p95 {} mm", share(0.5), share(0.95));
        }
    }
    assert!(clouds >= 2, "{clouds} of 4 frames gave a cloud");
}

/// Distances of a cloud's points from the true plane of the board, mm, in order. The board's border is left out, and
/// what is so near to a circle that the fringes around a pixel reach it: a period is 25 mm long at half size. `None` where the
/// frame was refused: few fringes and large circles leave the marker hard to see at this size.
fn distances(
    pair: CameraProjector,
    image: Mono8<'_>,
    pose: &FlatPose,
    true_from_found: &nalgebra::Isometry3<f64>,
    board: &Board,
) -> Option<Vec<f64>> {
    const CLEAR_M: f64 = 0.045;
    let board_from_world = pose.world_from_board().inverse();
    let made = Pipeline::new(Triangulator::new(pair), Method::Joint, false).run(image);
    if let Outcome::Refused(reason) = &made.outcome {
        println!("refused: {reason}");
        return None;
    }
    let local = |p: &[f32; 3]| board_from_world * (true_from_found * Point3::from(*p).cast::<f64>());
    let near = |p: &Point3<f64>, c: [f64; 3]| (p.x - c[0]).hypot(p.y - c[1]) < CLEAR_M;
    let inside = |p: &Point3<f64>| {
        let clear = || board.circles().iter().all(|circle| !near(p, circle.centre_m));
        p.x.abs() < 0.70 && p.y.abs() < 0.95 && clear()
    };
    let mut off: Vec<f64> =
        made.cloud.position_m.iter().map(local).filter(inside).map(|p| 1e3 * p.z.abs()).collect();
    off.sort_by(f64::total_cmp);
    Some(off)
}
