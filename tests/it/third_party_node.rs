// SPDX-License-Identifier: MIT OR Apache-2.0
//! Our node records from a camera that others made: Aravis' own `arv-fake-gv-camera-0.8`.
//!
//! It has no hardware trigger: it runs freely at 25 Hz, and the HSU at the same rate. Its frames arrive whole, and no two
//! witnesses say of any which trigger it is of: the node must give up every one by name, and account for all triggers.

use crate::lab::{NodeProcess, fourdbody, text_of};
use fourdbody::record::{GapCause, SessionReader};
use fourdbody_simulator::hsu::{HsuOptions, SimulatedHsu};
use std::process::{Child, Command, Stdio};

struct FakeCamera(Child);

impl Drop for FakeCamera {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// The shipped rig cut down to one head with one camera of 512 x 512 at 25 Hz.
fn rig() -> String {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("config/rig.toml");
    let mut rig: toml::Table =
        std::fs::read_to_string(path).expect("in the repository").parse().expect("valid TOML");
    rig.insert("trigger_rate_hz".to_owned(), 25.0.into());
    let heads = rig["head"].as_array_mut().expect("heads");
    heads.truncate(1);
    let cameras = heads[0]["camera"].as_array_mut().expect("cameras");
    cameras.truncate(1);
    for side in ["width", "height"] {
        cameras[0].as_table_mut().expect("a table").insert(side.to_owned(), 512.into());
    }
    toml::to_string(&rig).expect("serializes")
}

const TRIGGERS: u64 = 20;

#[test]
fn our_node_takes_no_frame_of_a_free_running_camera_for_a_triggers() {
    const PROGRAM: &str = "arv-fake-gv-camera-0.8";
    let started = Command::new(PROGRAM)
        .args(["-i", "127.0.0.1", "-s", "FOURDBODY"])
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn();
    let Ok(child) = started else {
        println!("skipped: {PROGRAM} is not installed (Debian package aravis-tools)");
        return;
    };
    let _camera = FakeCamera(child);
    let dir = tempfile::tempdir().expect("a temporary directory");
    let hsu =
        SimulatedHsu::start(HsuOptions { links: vec![dir.path().join("hsu-a")], ..HsuOptions::default() })
            .expect("a pty");
    std::fs::write(dir.path().join("rig.toml"), rig()).expect("writable");
    let port =
        std::net::TcpListener::bind("127.0.0.1:0").and_then(|l| l.local_addr()).expect("a free port").port();
    let node = format!(
        "format = 1\nnode = \"a\"\nrig = \"rig.toml\"\n[api]\nlisten = \"127.0.0.1:{port}\"\n\
         [hsu]\ndevice = \"{}\"\n[storage]\nsessions_dir = \"sessions\"\nreserve_mib = 1\n\
         [acquisition]\nbuffers_per_camera = 32\npacket_bytes = 1400\nsocket = \"standard\"\nsilence_gate_ms = 0\n\
         exposure_us = 10000.0\nleft_to_settings = [\"trigger_line\"]\nsettings = [[\"TriggerMode\", \"Off\"]]\n[[camera]]\nid = \"h0_up\"\naddress = \"127.0.0.1\"\n",
        hsu.link(0).display()
    );
    let file = dir.path().join("node.toml");
    std::fs::write(&file, node).expect("writable");
    let mut node = NodeProcess::start(&file, port);
    node.wait_ready();
    let (url, triggers) = (node.client.url().to_owned(), TRIGGERS.to_string());
    let captured = fourdbody(&["capture", "--nodes", &url, "--triggers", &triggers, "--name", "fake"]);
    assert_eq!(captured.status.code(), Some(3), "{}", text_of(&captured));
    let session = dir.path().join("sessions/fake");
    let verified = fourdbody(&["verify", &session.display().to_string()]);
    assert_eq!(verified.status.code(), Some(3), "{}", text_of(&verified));
    let reader = SessionReader::open(&session).expect("readable");
    let recording = &reader.recordings()[0];
    let outcomes = &recording.verdict.as_ref().expect("closed").cameras[0];
    assert_eq!((outcomes.frames, outcomes.gap_count()), (0, TRIGGERS), "{outcomes:?}");
    // A host that stood still says so.
    let by_host = [GapCause::IdentityMismatch, GapCause::NodePaused];
    let given_up: u64 = by_host.iter().filter_map(|cause| outcomes.gaps.get(cause)).sum();
    assert!(given_up >= TRIGGERS * 3 / 4, "its frames arrived, and none is of a trigger: {outcomes:?}");
}
