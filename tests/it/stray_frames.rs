// SPDX-License-Identifier: MIT OR Apache-2.0
//! Cameras that send what they have left over when an acquisition starts, as some of FLIR do (aravis#762): one such frame
//! is left out by name, and a camera that goes on sending refuses the session.

use crate::lab::{assert_contains, fourdbody, options, small_rig, start_laboratory, start_nodes, text_of};
use crate::session_faults::check_frames;
use fourdbody::record::{GapCause, SessionReader};
use fourdbody_simulator::gige::Habits;
use fourdbody_simulator::laboratory::{Laboratory, LaboratoryOptions};
use std::net::UdpSocket;
use std::process::Output;
use std::time::Duration;

/// The port that a camera would send its stream to, by its bootstrap registers.
fn host_port(camera: &str) -> u32 {
    const READ_HOST_PORT: [u8; 12] = [0x42, 1, 0, 0x80, 0, 4, 0, 1, 0, 0, 0x0d, 0];
    let socket = UdpSocket::bind("127.0.0.1:0").expect("a socket");
    socket.set_read_timeout(Some(Duration::from_secs(5))).expect("a socket");
    socket.send_to(&READ_HOST_PORT, (camera, 3956)).expect("sent");
    let mut answer = [0; 64];
    let length = socket.recv(&mut answer).expect("it answers");
    assert_eq!((length, &answer[..4]), (12, &[0, 0, 0, 0x81][..]));
    u32::from_be_bytes([answer[8], answer[9], answer[10], answer[11]])
}

fn capture(urls: &str, name: &str, more: &[&str]) -> Output {
    let args = [&["capture", "--nodes", urls, "--triggers", "16", "--name", name], more].concat();
    fourdbody(&args)
}

/// The first session of a camera has none; the others have one each, and their ids begin behind it.
#[test]
fn one_stray_frame_is_left_out_by_name_and_a_camera_that_goes_on_sending_refuses_the_session() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let strays = |strays, ids_go_on| Habits {
        strays,
        stray_after: Duration::from_millis(30),
        ids_go_on,
        ..Habits::default()
    };
    let habits = [
        ("h0_up", strays(1, true)),
        ("h0_low", strays(1, false)),
        ("h1_up", strays(0, true)),
        ("h2_up", strays(3, true)),
    ];
    let options = LaboratoryOptions {
        habits: habits.into_iter().map(|(camera, habits)| (camera.to_owned(), habits)).collect(),
        ..options(small_rig(40.0), dir.path())
    };
    let laboratory: Laboratory = start_laboratory(&options);
    let mut nodes = start_nodes(&laboratory);
    let urls = laboratory.urls();
    let session = |name: &str| dir.path().join("sessions").join(name);
    let sound = |name: &str, captured: &Output| {
        // A host that is too busy makes frames late: some are given up by name then, and none stands wrong.
        let gaps = check_frames(&session(name));
        let late = |(_, cause): &(u64, GapCause)| *cause == GapCause::IdentityMismatch;
        assert!(gaps.iter().flatten().all(late), "{name}: {gaps:?} {}", text_of(captured));
        let expected = if gaps.iter().flatten().count() == 0 { 0 } else { 3 };
        assert_eq!(captured.status.code(), Some(expected), "{name}: {}", text_of(captured));
    };
    let strays_of = |name: &str, camera: &str| {
        let reader = SessionReader::open(&session(name)).expect("readable");
        let events = reader.recordings().iter().flat_map(|recording| &recording.events);
        let of = |event: &&fourdbody::record::NodeEvent| {
            event.kind == "stray_frame" && event.camera.as_ref().is_some_and(|id| id.as_str() == camera)
        };
        events.filter(of).count()
    };

    let first = capture(&urls, "first", &[]);
    sound("first", &first);
    nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
    let address = laboratory.cameras[0].address().to_string();
    assert_eq!(host_port(&address), 0, "nobody takes what the camera has left over");

    let node_a = urls.split(',').next().expect("two nodes");
    for name in ["second", "third"] {
        let captured = capture(node_a, name, &["--partial"]);
        nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
        sound(name, &captured);
        for (camera, expected) in [("h0_up", 1), ("h0_low", 1), ("h1_up", 0), ("h1_low", 0)] {
            assert_eq!(strays_of(name, camera), expected, "{name} {camera}");
        }
        let verified = fourdbody(&["verify", &session(name).display().to_string()]);
        assert!(matches!(verified.status.code(), Some(0 | 3)), "{}", text_of(&verified));
    }

    let refused = capture(&urls, "refused", &[]);
    assert_eq!(refused.status.code(), Some(5), "{}", text_of(&refused));
    let expected = ["h2_up sent frames although nothing was triggered", "TriggerMode", "silence_gate_ms = 0"];
    assert_contains(&text_of(&refused), &expected);
    assert!(!text_of(&refused).contains("h0_up"), "{}", text_of(&refused));
    nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
    assert!(!session("refused").exists());
}
