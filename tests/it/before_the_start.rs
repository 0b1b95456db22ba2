// SPDX-License-Identifier: MIT OR Apache-2.0
//! Devices that fail before the first trigger (docs/design/operation.md, the first column of its table): the session is given
//! up on both nodes at once, the device is named, nothing is left, and the next session works.

use crate::kills::{COORDINATOR, PATIENCE, Rig, Stage};
use crate::lab::assert_contains;
use fourdbody::control::request::Phase;
use fourdbody::control::status::{Outcome, path};
use serde_json::{Value, json};
use std::time::{Duration, Instant};

/// What fails, of node b or for both.
#[derive(Debug, Clone, Copy)]
enum Device {
    Camera(usize),
    Link,
    Hsu,
}

impl Device {
    fn fail(self, rig: &mut Rig) {
        match self {
            Self::Camera(camera) => rig.laboratory.unplug(camera),
            Self::Link => rig.laboratory.hsu.set_plugged(1, false),
            Self::Hsu => rig.laboratory.hsu.power_cycle(),
        }
    }

    fn mend(self, rig: &mut Rig) {
        match self {
            Self::Camera(camera) => rig.laboratory.plug(camera).expect("its address is free"),
            Self::Link => rig.laboratory.hsu.set_plugged(1, true),
            Self::Hsu => {}
        }
    }

    /// What an operator must be told.
    fn words(self) -> &'static [&'static str] {
        match self {
            Self::Camera(0) => &["node a", "h0_up"],
            Self::Camera(_) => &["node b", "h2_up"],
            Self::Link => &["node b", "HSU"],
            Self::Hsu => &["HSU"],
        }
    }
}

/// The capture when it has ended, and how many seconds of its countdown were left when that was last seen.
fn ended(rig: &Rig, name: &str) -> (Value, Option<u64>) {
    let deadline = Instant::now() + PATIENCE;
    let mut left_s = None;
    loop {
        let capture: Value = rig.nodes[COORDINATOR].client.get(path::CAPTURE).expect("it answers");
        left_s = capture["stage"]["left_s"].as_u64().or(left_s);
        if capture["running"] == false {
            return (capture, left_s);
        }
        assert!(Instant::now() < deadline, "{name}: never given up: {capture:#}");
        std::thread::sleep(Duration::from_millis(20));
    }
}

#[test]
fn a_device_that_fails_before_the_first_trigger_ends_the_session_at_once() {
    const COUNTDOWN_S: u64 = 50;
    let mut rig = Rig::new();
    for stage in [Stage::Preparing, Stage::CountingDown] {
        for device in [Device::Camera(0), Device::Camera(4), Device::Link, Device::Hsu] {
            let name = format!("{stage:?}-{device:?}").to_lowercase().replace(['(', ')'], "");
            let wish = json!({ "wish": { "name": name, "triggers": 6, "countdown_s": COUNTDOWN_S } });
            rig.nodes[COORDINATOR].client.post(path::CAPTURE, &wish, PATIENCE).expect("the capture begins");
            match stage {
                Stage::CountingDown => {
                    for node in &mut rig.nodes {
                        node.wait_until("ready", |status| status.phase == Phase::Ready);
                    }
                }
                _ => drop(rig.nodes[1].wait_until("preparing", |status| {
                    matches!(status.phase, Phase::Preparing | Phase::Ready)
                })),
            }
            device.fail(&mut rig);
            let (capture, left_s) = ended(&rig, &name);
            let message = capture["fault"]["message"].as_str().unwrap_or_default();
            println!("{name}: {left_s:?} s left: {message}");
            assert_contains(message, device.words());
            assert_eq!(capture["fault"]["exit"], 5, "{name}: {capture:#}");
            assert!(left_s.is_none_or(|left_s| left_s > COUNTDOWN_S / 4), "{name}: told late, {left_s:?}");
            for node in [0, 1] {
                let outcome = rig.end_of(node, &name);
                assert!(!matches!(outcome, Some(Outcome::Recorded(_))), "{name}: {outcome:?}");
                assert!(!rig.part(&name, node).exists(), "{name}: nothing is left");
            }
            device.mend(&mut rig);
            rig.the_next_session_works(&name);
        }
    }
}
