// SPDX-License-Identifier: MIT OR Apache-2.0
//! Whose word counts for the world, and how far: properties on the shipped rig.

use super::{StageError, Vertical, into_world, nearest_motion};
use crate::board::Board;
use crate::bundle::{DeviceModel, Model};
use crate::config::Rig;
use crate::data::{Calibration, World};
use crate::geometry::{Device, Pose};
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use proptest::prelude::{ProptestConfig, Strategy, prop_assert, prop_assume, proptest};
use std::path::Path;

fn board() -> Board {
    Board::load(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/board.toml"))
        .expect("the shipped board")
}

/// The shipped rig: its devices, and which are cameras.
fn rig() -> Vec<(Device, bool)> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/rig.toml");
    let nominal = Calibration::nominal(&Rig::load(&path).expect("the shipped rig"));
    let of_head = |head: &crate::data::CalibratedHead| {
        let cameras = head.cameras.iter().map(|camera| (camera.device.clone(), true));
        cameras.chain([(head.projector.clone(), false)]).collect::<Vec<_>>()
    };
    nominal.heads.iter().flat_map(of_head).collect()
}

/// The board upright before head h0, with its first edge 20 degrees to the side.
fn upright() -> Isometry3<f64> {
    let turn = UnitQuaternion::from_scaled_axis(Vector3::z() * 0.35);
    let stands = UnitQuaternion::from_euler_angles(std::f64::consts::FRAC_PI_2, 0.0, 0.0);
    Isometry3::from_parts(Translation3::new(0.3, 0.1, 1.0), turn * stands)
}

/// What an adjustment gives of these devices in a frame of its own.
fn model(devices: &[(Device, bool)], boards: Vec<Isometry3<f64>>, frame: &Isometry3<f64>) -> Model {
    let devices = devices.iter().map(|(device, _)| DeviceModel {
        lens: device.lens,
        device_from_frame: (frame * device.world_from_device.isometry()).inverse(),
    });
    Model { devices: devices.collect(), boards: boards.into_iter().map(|b| frame * b).collect() }
}

/// A device turned about its own centre, then shifted.
fn moved(device: &Device, turn: Vector3<f64>, shift: Vector3<f64>) -> Device {
    let pose = device.world_from_device.isometry();
    let rotation = UnitQuaternion::from_scaled_axis(turn) * pose.rotation;
    let place = Translation3::from(pose.translation.vector + shift);
    Device { world_from_device: Pose::new(Isometry3::from_parts(place, rotation)), ..device.clone() }
}

fn fit(model: &mut Model, nominal: &[(Device, bool)], verticals: &[Vertical]) -> Result<World, StageError> {
    let positions: Vec<usize> = (0..model.boards.len()).collect();
    into_world(model, nominal, &positions, &board(), verticals)
}

/// How far the devices of a model are turned against the rig's.
fn turned_deg(model: &Model, truth: &[(Device, bool)]) -> f64 {
    let (device, (known, _)) = (&model.devices[0], &truth[0]);
    let found = device.device_from_frame.inverse().rotation;
    found.angle_to(&known.world_from_device.isometry().rotation).to_degrees()
}

fn direction() -> impl Strategy<Value = Vector3<f64>> {
    proptest::array::uniform3(-1.0..1.0f64).prop_map(Vector3::from)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// Eight cameras: an eighth of what one camera adds, at the very most.
    #[test]
    fn one_wrong_pose_moves_the_world_by_less_than_its_share(which in 0..8usize, axis in direction()) {
        prop_assume!(axis.norm() > 0.1);
        let truth = rig();
        let mut nominal = truth.clone();
        let camera = nominal.iter_mut().filter(|(_, is_camera)| *is_camera).nth(which).expect("eight cameras");
        camera.0 = moved(&camera.0, axis.normalize() * 1f64.to_radians(), Vector3::zeros());
        let mut found = model(&truth, vec![upright()], &Isometry3::identity());
        let world = fit(&mut found, &nominal, &[]).expect("a world");
        let turned = turned_deg(&found, &truth);
        prop_assert!(turned < 1.0 / 8.0 && turned > 0.0, "{turned} degrees");
        prop_assert!((world.attitudes_rms_deg - 1.0 / 8f64.sqrt()).abs() < 0.05, "{world:?}");
    }

    #[test]
    fn the_frame_of_the_adjustment_does_not_matter(turn in direction(), shift in direction()) {
        let truth = rig();
        let mut found = model(&truth, vec![upright()], &Isometry3::new(shift, turn));
        let world = fit(&mut found, &truth, &[]).expect("a world");
        prop_assert!(turned_deg(&found, &truth) < 1e-6, "{world:?}");
        prop_assert!(world.places_rms_mm < 1e-6 && world.cameras == 8, "{world:?}");
        let corner = Point3::new(0.7, 0.9, 0.0);
        prop_assert!((found.boards[0] * corner - upright() * corner).norm() < 1e-9);
    }

    #[test]
    fn projectors_have_no_vote(axis in direction()) {
        let truth = rig();
        let mut nominal = truth.clone();
        for (device, _) in nominal.iter_mut().filter(|(_, is_camera)| !is_camera) {
            *device = moved(device, axis * 0.1, axis);
        }
        let mut found = model(&truth, vec![upright()], &Isometry3::identity());
        fit(&mut found, &nominal, &[]).expect("a world");
        prop_assert!(turned_deg(&found, &truth) < 1e-9);
    }

    /// However wrong the rig file is as a whole: with a plumb board the world is upright to what the board's pose is.
    #[test]
    fn a_declared_position_says_what_is_vertical(
        turn in direction(), quarter in 0..4u8, level: bool, face_down: bool,
    ) {
        prop_assume!(turn.norm() < 1.0);
        let nominal = rig();
        let off = Isometry3::new(Vector3::zeros(), turn * 0.1);
        let truth: Vec<_> = nominal.iter().map(|(device, is_camera)| {
            let pose = Pose::new(off * device.world_from_device.isometry());
            (Device { world_from_device: pose, ..device.clone() }, *is_camera)
        }).collect();
        let quarters = UnitQuaternion::from_scaled_axis(Vector3::z() * f64::from(quarter) * std::f64::consts::FRAC_PI_2);
        let flip = UnitQuaternion::from_scaled_axis(Vector3::x() * if face_down { std::f64::consts::PI } else { 0.0 });
        let stand = if level {
            Isometry3::from_parts(Translation3::new(0.1, 0.0, 0.2), flip * quarters)
        } else {
            upright() * quarters
        };
        let declared = if level { Vertical::Level(2) } else { Vertical::Upright(2) };
        // The first position is anyhow.
        let mut found = model(&truth, vec![Isometry3::identity(), stand], &Isometry3::identity());
        let world = fit(&mut found, &nominal, &[declared]).expect("a world");
        let turned = found.boards[1].rotation;
        let lean = if level {
            (turned * Vector3::z()).z.abs().min(1.0).acos()
        } else {
            [Vector3::x(), Vector3::y()].map(|axis| (turned * axis).z.abs().min(1.0).acos()).into_iter().fold(9.0, f64::min)
        };
        prop_assert!(lean < 1e-6, "{lean} rad, {world:?}");
        prop_assert!(world.vertical_positions == [2]);
        // The heading is the fit's: the turn was about a horizontal axis.
        let tilt = (off.rotation * Vector3::z()).z.acos().to_degrees();
        prop_assert!((world.vertical_turn_deg - tilt).abs() < 0.35 * tilt + 1e-6, "{world:?} {tilt}");
    }
}

#[test]
fn one_camera_is_where_the_rig_file_has_it() {
    let truth = rig();
    let pose = *truth[0].0.world_from_device.isometry();
    let motion =
        nearest_motion(&[(Isometry3::new(Vector3::x(), Vector3::y()), pose)]).expect("one is enough");
    let placed = motion * Isometry3::new(Vector3::x(), Vector3::y());
    assert!((placed.translation.vector - pose.translation.vector).norm() < 1e-9);
    assert!(placed.rotation.angle_to(&pose.rotation) < 1e-9);
    assert_eq!(nearest_motion(&[]), None);
}

#[test]
fn verticals_that_cannot_be_are_refused() {
    let truth = rig();
    let refused = |vertical| {
        let mut found = model(&truth, vec![upright()], &Isometry3::identity());
        fit(&mut found, &truth, &[vertical]).expect_err("refused").to_string()
    };
    assert_eq!(
        refused(Vertical::Upright(7)),
        "position 7 was declared upright, but is not among the 1 positions used: 1"
    );
    let lying = refused(Vertical::Level(1));
    assert!(lying.starts_with("position 1 was declared level, but is 90.0 degrees off"), "{lying}");
}
