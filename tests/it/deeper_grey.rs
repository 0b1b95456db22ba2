// SPDX-License-Identifier: MIT OR Apache-2.0
//! Cameras that send grey deeper than 8 bits, in every packing, or a mosaic of colours, beside ones that send 8 bits: what
//! is recorded of each is the picture, and the recording names what the camera sent.

use crate::console::Still;
use crate::lab::{
    SIZE, assert_contains, capture_whole, fourdbody, laboratory, options, say, small_rig, start,
    start_laboratory, start_nodes, text_of,
};
use crate::reused::{Place, json, light, points_of, reconstruct};
use crate::session_faults::check_frames;
use fourdbody::base::ids::TriggerIndex;
use fourdbody::config::SocketMode;
use fourdbody::data::FrameSource;
use fourdbody::record::{GapCause, SessionReader};
use fourdbody_simulator::gige::{Form, Habits, TestImages};
use fourdbody_simulator::images::ImageSource;
use fourdbody_simulator::laboratory::{Laboratory, LaboratoryOptions};
use std::sync::Arc;

/// Cameras, the words for their pixels, and what the recording names.
const SENT: [(&str, usize, &str, &str); 7] = [
    ("h0_up", 0, "mono12p", "Mono12p"),
    ("h0_low", 0, "mono12packed", "Mono12Packed"),
    ("h1_up", 0, "mono12", "Mono12"),
    ("h1_low", 0, "mono10p", "Mono10p"),
    ("h2_up", 1, "mono10packed", "Mono10Packed"),
    ("h2_low", 1, "mono14", "Mono14"),
    ("h3_up", 1, "mono16", "Mono16"),
];

#[test]
fn deeper_grey_is_recorded_as_the_same_picture_and_its_loss_is_named() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = laboratory(dir.path(), 20.0);
    for (camera, node, word, _) in SENT {
        say(&laboratory.nodes[node].path, camera, &format!("pixel = {word:?}"));
    }
    let mut nodes = start_nodes(&laboratory);
    let captured = capture_whole(&laboratory, "deep", 24, &[]);
    assert_eq!(captured.status.code(), Some(0), "{}", text_of(&captured));
    nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
    let session = dir.path().join("sessions/deep");
    let verified = fourdbody(&["verify", &session.display().to_string()]);
    assert_eq!(verified.status.code(), Some(0), "{}", text_of(&verified));
    // Each pixel is that of the 8-bit picture, whatever the lower bits were: what follows from frames is the same.
    assert!(check_frames(&session).iter().all(Vec::is_empty));

    let reader = SessionReader::open(&session).expect("readable");
    let headers = || reader.recordings().iter().flat_map(|recording| &recording.header.cameras);
    let sent: Vec<&str> = headers().map(|camera| camera.pixel_format.as_str()).collect();
    assert_eq!(sent[..7], SENT.map(|(.., name)| name));
    assert_eq!(sent[7], "Mono8");
    let told: Vec<String> = reader
        .recordings()
        .iter()
        .flat_map(|recording| &recording.events)
        .filter(|event| event.kind == "camera_setting" && event.message.contains("are lost"))
        .map(|event| format!("{}: {}", event.camera.as_ref().expect("of one").as_str(), event.message))
        .collect();
    assert_eq!(told.len(), 7, "{told:?}");
    assert_contains(
        &told.join("\n"),
        &[
            "h0_up: its pixels are Mono12p: the upper 8 of their 12 bits are recorded, and the lower 4 are lost",
            "h3_up: its pixels are Mono16: the upper 8 of their 16 bits",
        ],
    );
    let info = fourdbody(&["info", &session.display().to_string()]);
    assert_contains(&text_of(&info), &["Mono12Packed", "Mono10p"]);
}

/// What was agreed on is what is taken: 8 bits where 12 were agreed are no frame, nor are fewer bytes.
#[test]
fn frames_of_another_depth_than_agreed_are_gaps() {
    const FROM: i64 = 4;
    let dir = tempfile::tempdir().expect("a temporary directory");
    let habit = |form| Habits { frames: Some((FROM, form)), ..Habits::default() };
    let twelve = Form { format: 0x010c_0047, told: 0x010c_0047, ..Form::default() };
    let habits = [
        ("h0_up".to_owned(), habit(Form::default())),
        ("h0_low".to_owned(), habit(Form { short: 4, ..twelve })),
    ];
    let options = LaboratoryOptions { habits: habits.into(), ..options(small_rig(20.0), dir.path()) };
    let laboratory = start_laboratory(&options);
    for camera in ["h0_up", "h0_low"] {
        say(&laboratory.nodes[0].path, camera, "pixel = \"mono12p\"");
    }
    let mut nodes = start_nodes(&laboratory);
    let captured =
        fourdbody(&["capture", "--nodes", &laboratory.urls(), "--triggers", "8", "--name", "mixed"]);
    assert_eq!(captured.status.code(), Some(3), "{}", text_of(&captured));
    nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
    let session = dir.path().join("sessions/mixed");
    let gaps = check_frames(&session);
    let of = |cause| (FROM as u64..8).map(|trigger| (trigger, cause)).collect::<Vec<_>>();
    assert_eq!(gaps[0], of(GapCause::WrongFormat));
    assert_eq!(gaps[1], of(GapCause::SizeMismatch));
    assert!(gaps[2..].iter().all(Vec::is_empty));
    let verified = fourdbody(&["verify", &session.display().to_string()]);
    assert_eq!(verified.status.code(), Some(3), "{}", text_of(&verified));
}

/// Cameras with a mosaic of filters: the pixels of the head's colour are recorded, at half the size; beside them ones that
/// send grey of the rig's size.
#[test]
fn the_plane_of_the_heads_colour_is_recorded_at_half_the_size() {
    const SENSOR: (usize, usize) = (640, 400);
    // The simulator's are BayerRG8; the heads are red, green and blue.
    const PLANES: [(&str, usize, usize, (usize, usize)); 3] =
        [("h0_up", 0, 0, (0, 0)), ("h1_up", 0, 2, (1, 0)), ("h2_up", 1, 4, (1, 1))];
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = start(&options(small_rig(20.0), dir.path()), SENSOR);
    for (camera, node, ..) in PLANES {
        say(&laboratory.nodes[node].path, camera, "pixel = \"bayer8\"");
    }
    let mut nodes = start_nodes(&laboratory);
    let captured = capture_whole(&laboratory, "planes", 12, &[]);
    assert_eq!(captured.status.code(), Some(0), "{}", text_of(&captured));
    nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
    let session = dir.path().join("sessions/planes");
    let verified = fourdbody(&["verify", &session.display().to_string()]);
    assert_eq!(verified.status.code(), Some(0), "{}", text_of(&verified));
    let reader = SessionReader::open(&session).expect("readable");
    for (number, camera) in reader.cameras().iter().enumerate() {
        let light = TestImages::new(SENSOR.0, SENSOR.1, number as u32 + 1, TestImages::DISTINCT);
        let plane = PLANES.iter().find(|(.., at, _)| *at == number).map(|(.., place)| *place);
        for trigger in reader.triggers() {
            let frame =
                reader.recorded_frame(camera, TriggerIndex(trigger)).expect("intact").expect("no gap");
            assert_eq!((frame.image.width(), frame.image.height()), SIZE);
            let sent = light.pixels(trigger as i64);
            let pixel = |at: usize| {
                let (u, v) = (at % SIZE.0, at / SIZE.0);
                let (u, v) = plane.map_or((u, v), |(column, row)| (2 * u + column, 2 * v + row));
                sent[v * SENSOR.0 + u]
            };
            assert!(
                frame.image.as_slice().iter().enumerate().all(|(at, found)| *found == pixel(at)),
                "{camera}"
            );
        }
    }
    let headers = || reader.recordings().iter().flat_map(|recording| &recording.header.cameras);
    assert_eq!(headers().filter(|camera| camera.pixel_format == "BayerRG8").count(), 3);
    let events = || reader.recordings().iter().flat_map(|recording| &recording.events);
    assert!(events().any(|event| event.message.contains(
        "of its BayerRG8 of 640 x 400 the plane of the head's colour is recorded, 320 x 200: pixel (u, v) of frames and \
         calibration is pixel (2u + 1, 2v + 1) of the camera"
    )));
}

/// One head photographs a ball, with 8 bits and with 12: the clouds are the same to the last byte.
#[test]
fn clouds_of_12_bit_sessions_are_those_of_8_bit_ones() {
    let place = Place::new();
    let rig = std::fs::read_to_string(place.path("rig.toml")).expect("a rig");
    let rig = rig.replace("trigger_rate_hz = 120.0", "trigger_rate_hz = 5.0");
    let dir = tempfile::tempdir().expect("a temporary directory");
    let options = LaboratoryOptions { socket: SocketMode::Standard, ..options(rig, dir.path()) };
    let mut photographs = light().iter();
    let laboratory =
        Laboratory::start(&options, |_| Arc::new(Still(photographs.next().expect("two cameras").clone())))
            .expect("the laboratory starts");
    let mut clouds = Vec::new();
    for (name, words) in [("eight", ["mono8", "mono8"]), ("twelve", ["mono12p", "mono12packed"])] {
        for (camera, word) in ["h0_up", "h0_low"].into_iter().zip(words) {
            say(&laboratory.nodes[0].path, camera, &format!("pixel = {word:?}"));
        }
        let mut nodes = start_nodes(&laboratory);
        let captured = capture_whole(&laboratory, name, 2, &[]);
        assert_eq!(captured.status.code(), Some(0), "{}", text_of(&captured));
        nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
        drop(nodes);
        let out = place.path(name);
        let made = reconstruct(&place, &dir.path().join("sessions").join(name), &out, &[]);
        assert_eq!(made.status.code(), Some(0), "{}", text_of(&made));
        assert!(json(&out.join("summary.json")).is_object());
        clouds.push(
            ["clouds/h0_up_000001.ply", "clouds/h0_low_000001.ply", "merged/000001.ply"]
                .map(|file| points_of(&out.join(file))),
        );
    }
    assert!(clouds[0].iter().all(|cloud| cloud.len() > 100_000), "there is something to compare");
    assert!(clouds[0] == clouds[1], "the points differ");
}
