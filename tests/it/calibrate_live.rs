// SPDX-License-Identifier: MIT OR Apache-2.0
//! `calibrate --live` on a real node and simulated cameras: an operator is led through the positions of the board, each a
//! session of its own, and a calibration comes out.

use crate::api_node::start_with_own_tokens;
use crate::board_photographs::{errors, good, scene};
use crate::lab::{FOURDBODY, host, own_network};
use fourdbody::base::image::Plane;
use fourdbody::config::SocketMode;
use fourdbody::data::Calibration;
use fourdbody_simulator::images::ImageSource;
use fourdbody_simulator::laboratory::{Laboratory, LaboratoryOptions};
use fourdbody_simulator::rig_file::to_toml;
use std::io::Write;
use std::process::{Command, Stdio};
use std::sync::Arc;

/// One camera's photographs, in the order of the walk; the last one stays.
struct Walk(Vec<Plane<u8>>);

impl ImageSource for Walk {
    fn size(&self) -> (usize, usize) {
        (self.0[0].width(), self.0[0].height())
    }

    fn pixels(&self, instant: i64) -> &[u8] {
        let last = self.0.len() - 1;
        self.0[usize::try_from(instant).unwrap_or(0).min(last)].as_slice()
    }
}

#[test]
fn an_operator_is_led_to_a_calibration() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let mut rig = scene().rig().clone();
    rig.trigger_rate_hz = 10.0;
    let mut options = LaboratoryOptions::new(to_toml(&rig), dir.path());
    options.first_address = host(own_network(), 11);
    options.first_port = 0;
    options.reserve_mib = 1;
    options.socket = SocketMode::Standard;
    options.carry_on = true;
    // Before the eight good positions one in the dark.
    let photographs = good();
    let mut camera = 0..;
    let laboratory = Laboratory::start(&options, |_| {
        let camera = camera.next().expect("endless");
        let first = photographs.image(0, camera);
        let dark = Plane::filled(first.width(), first.height(), 2);
        let good = (0..16).map(|trigger| photographs.image(trigger, camera).clone());
        Arc::new(Walk([dark.clone(), dark].into_iter().chain(good).collect()))
    })
    .expect("the laboratory starts");
    // A node takes nobody without a token of its own.
    let (_nodes, tokens) = start_with_own_tokens(&laboratory, dir.path());

    let (rig_file, out) = (dir.path().join("rig-nominal.toml"), dir.path().join("calibration.json"));
    std::fs::write(&rig_file, to_toml(scene().rig())).expect("writable");
    let mut walk = Command::new(FOURDBODY)
        .args(["calibrate", "--live", "--board", "config/board.toml", "--name", "walk", "--json"])
        .args(["--nodes", &laboratory.urls(), "--token-file", &tokens, "--rig"])
        .arg(&rig_file)
        .arg("--out")
        .arg(&out)
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("the program starts");
    // What the operator types: into the dark, something that is no answer, then position after position.
    let mut keyboard = walk.stdin.take().expect("piped");
    keyboard.write_all(b"\nyes\n\n\n\n\n\n\n\n\n").expect("written");
    drop(keyboard);
    let walked = walk.wait_with_output().expect("it ends");
    let said = String::from_utf8_lossy(&walked.stderr);
    println!("{said}");
    assert_eq!(walked.status.code(), Some(0), "{said}");
    for expected in [
        "this position is not usable and does not count",
        "expected Enter, u or q, found \"yes\"",
        "[h0 0/8] head h0: 0 of 8 positions. Put the board before it, facing the head",
        "[h0 7/8]",
        "good for h0",
        "8 positions, 9 sessions taken",
    ] {
        assert!(said.contains(expected), "{expected:?} is missing in\n{said}");
    }
    let found = Calibration::load(&out).expect("a calibration");
    let (focal, place_m) = errors(&found, &scene().truth);
    assert!(focal < 5e-4 && place_m < 5e-4, "focal {focal}, second camera {place_m} m off");
    let identity = found.identity.expect("stated");
    assert_eq!(identity.cameras.len(), 2, "the recordings name the cameras: {identity:?}");
    assert!(dir.path().join("sessions/walk-p009").is_dir(), "every position is a session");
}
