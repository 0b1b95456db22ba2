// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a frame is, and what a camera's clock is: cameras that send something else than their features say, that are set
//! to something else than a session records, or whose clock has another unit, beside ones that do not.

use crate::lab::{
    WORDS, assert_contains, capture_whole, fourdbody, options, say, small_rig, start_laboratory, start_nodes,
    text_of,
};
use crate::session_faults::check_frames;
use fourdbody::config::FEATURES_OF_WORDS;
use fourdbody::record::{ClockSample, GapCause, NodeEvent, SessionReader};
use fourdbody_simulator::gige::{ClockHabit, Form, Habits, Payload};
use fourdbody_simulator::laboratory::{Laboratory, LaboratoryOptions};
use std::collections::BTreeMap;
use std::path::Path;
use std::process::Output;

const MONO16: u32 = 0x0110_0007;
const MONO12P: u32 = 0x010c_0047;
const RGB8: u32 = 0x0218_0014;

fn capture(laboratory: &Laboratory, triggers: u64, name: &str) -> Output {
    capture_whole(laboratory, name, triggers, &[])
}

fn habits<const N: usize>(of: [(&str, Habits); N]) -> BTreeMap<String, Habits> {
    of.into_iter().map(|(camera, habits)| (camera.to_owned(), habits)).collect()
}

/// Texts of a camera's events of a kind.
fn events(session: &SessionReader, camera: &str, kind: &str) -> Vec<String> {
    let of = |event: &&NodeEvent| {
        event.kind == kind && event.camera.as_ref().is_some_and(|id| id.as_str() == camera)
    };
    let all = session.recordings().iter();
    all.flat_map(|r| r.events.iter().filter(of)).map(|event| event.message.clone()).collect()
}

#[test]
fn frames_that_are_no_plain_mono8_of_their_size_are_gaps_that_say_so() {
    const FROM: i64 = 6;
    const TRIGGERS: u64 = 16;
    let plain = Form::default();
    let cases: [(&str, Form, GapCause, &str); 7] = [
        ("h0_up", Form { told: MONO16, ..plain }, GapCause::WrongFormat, "its pixels are Mono16"),
        (
            "h0_low",
            Form { told: RGB8, format: RGB8, ..plain },
            GapCause::WrongFormat,
            "its pixels are RGB8, expected Mono8",
        ),
        ("h1_up", Form { padding: 4, ..plain }, GapCause::SizeMismatch, "4 bytes of padding after every row"),
        (
            "h1_low",
            Form { appended: 16, payload: Payload::ImageWithChunks, ..plain },
            GapCause::WrongFormat,
            "it carries chunks beside the image",
        ),
        ("h2_up", Form { appended: 16, ..plain }, GapCause::SizeMismatch, "more than the 64000 bytes"),
        (
            "h2_low",
            Form { short: 4, ..plain },
            GapCause::SizeMismatch,
            "its packets are shorter than the packet size",
        ),
        ("h3_up", Form { told: MONO12P, format: MONO12P, ..plain }, GapCause::WrongFormat, "Mono12p"),
    ];
    let habit = |form| Habits { frames: Some((FROM, form)), ..Habits::default() };
    let dir = tempfile::tempdir().expect("a temporary directory");
    let options = LaboratoryOptions {
        habits: cases.iter().map(|(camera, form, ..)| ((*camera).to_owned(), habit(*form))).collect(),
        ..options(small_rig(20.0), dir.path())
    };
    let laboratory = start_laboratory(&options);
    let mut nodes = start_nodes(&laboratory);
    let captured = capture(&laboratory, TRIGGERS, "formats");
    assert_eq!(captured.status.code(), Some(3), "losses, all accounted for: {}", text_of(&captured));
    nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
    let session = dir.path().join("sessions/formats");
    let gaps = check_frames(&session);
    let reader = SessionReader::open(&session).expect("readable");
    for ((camera, _, cause, words), gaps) in cases.iter().zip(&gaps) {
        let expected: Vec<(u64, GapCause)> = (FROM as u64..TRIGGERS).map(|t| (t, *cause)).collect();
        assert_eq!(*gaps, expected, "{camera}");
        let said = events(&reader, camera, "frame_refused");
        assert!(said.len() == 1 && said[0].contains(words), "{camera}: {said:?}");
        assert!(events(&reader, camera, "frames_refused")[0].starts_with("10 frames"), "{camera}");
    }
    assert_eq!(gaps[7], [], "a camera beside them loses nothing");
    let verified = fourdbody(&["verify", &session.display().to_string()]);
    assert_eq!(verified.status.code(), Some(3), "{}", text_of(&verified));
}

/// Cameras whose chunks cannot be switched off: the image is taken, the chunks are left, and both are named. What does not
/// begin with the image that was agreed on is a gap.
#[test]
fn an_image_that_chunks_follow_is_taken_where_they_cannot_be_switched_off() {
    const FROM: i64 = 6;
    const TRIGGERS: u64 = 16;
    let with = |payload, appended| Form { payload, appended, ..Form::default() };
    let twelve = |form| Form { format: MONO12P, told: MONO12P, ..form };
    let data = with(Payload::ChunkData, 24);
    let cases: [(&str, Form, Option<Form>); 7] = [
        ("h0_up", with(Payload::ImageWithChunks, 16), None),
        ("h0_low", with(Payload::ExtendedChunks, 24), None),
        ("h1_up", data, None),
        ("h1_low", twelve(data), None),
        // Without chunks for a while, which a camera may do.
        ("h2_up", with(Payload::ImageWithChunks, 16), Some(Form::default())),
        // No whole chunks, in frames whose leader says nothing of an image; and an image of another depth.
        ("h2_low", data, Some(with(Payload::ChunkData, 12))),
        ("h3_up", data, Some(twelve(data))),
    ];
    let habit = |power_on, frames: Option<Form>| Habits {
        power_on,
        frames: frames.map(|form| (FROM, form)),
        ..Habits::default()
    };
    let dir = tempfile::tempdir().expect("a temporary directory");
    let options = LaboratoryOptions {
        habits: cases.iter().map(|(id, form, frames)| ((*id).to_owned(), habit(*form, *frames))).collect(),
        ..options(small_rig(20.0), dir.path())
    };
    let laboratory = start_laboratory(&options);
    say(&laboratory.nodes[0].path, "h1_low", "pixel = \"mono12p\"");
    let mut nodes = start_nodes(&laboratory);
    let captured = capture(&laboratory, TRIGGERS, "chunks");
    assert_eq!(captured.status.code(), Some(3), "two cameras lose frames: {}", text_of(&captured));
    nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
    let session = dir.path().join("sessions/chunks");
    let gaps = check_frames(&session);
    let refused = |cause| (FROM as u64..TRIGGERS).map(|trigger| (trigger, cause)).collect::<Vec<_>>();
    let reader = SessionReader::open(&session).expect("readable");
    for (place, (camera, form, _)) in cases.iter().enumerate() {
        match place {
            5 => assert_eq!(gaps[place], refused(GapCause::WrongFormat)),
            6 => {
                assert!(gaps[place].iter().map(|(trigger, _)| *trigger).eq(FROM as u64..TRIGGERS), "{gaps:?}")
            }
            _ => assert_eq!(gaps[place], [], "{camera}"),
        }
        let told = events(&reader, camera, "camera_setting").join("\n");
        let expected =
            format!("up to {} bytes of chunks follow each image, and are not recorded", form.appended);
        assert_contains(&told, &[&expected, "ChunkModeActive is true, expected false, and cannot be set"]);
    }
    assert_eq!(gaps[7], [], "a camera beside them loses nothing");
    let said = events(&reader, "h2_low", "frame_refused");
    assert!(said.len() == 1 && said[0].contains("is no whole row of chunks"), "{said:?}");
    let verified = fourdbody(&["verify", &session.display().to_string()]);
    assert_eq!(verified.status.code(), Some(3), "{}", text_of(&verified));
}

/// A list of raw settings, with the words that are left to it.
fn list(settings: &str) -> String {
    let named =
        |features: &[&str]| features.iter().any(|feature| settings.contains(&format!("[{feature:?}")));
    let left = FEATURES_OF_WORDS.iter().filter(|(_, features)| named(features)).map(|(word, _)| *word);
    format!("left_to_settings = {:?}\nsettings = [{settings}]\n", left.collect::<Vec<_>>())
}

/// Replaces the settings of all cameras of a node's file, by their place; `common` become those of `[acquisition]`.
fn set(file: &Path, common: &str, own: impl Fn(usize) -> String) {
    let text = std::fs::read_to_string(file).expect("a node file");
    let mut parts = text.split(WORDS);
    let mut changed = parts.next().expect("its head").replacen(
        "[acquisition]\n",
        &format!("[acquisition]\n{}", list(common)),
        1,
    );
    for (place, part) in parts.enumerate() {
        changed += &format!("{}{part}", list(&own(place)));
    }
    std::fs::write(file, changed).expect("writable");
}

const COMMON: &str = r#"["PixelFormat", "Mono8"], ["Width", 320], ["Height", 200], ["TriggerSelector", "FrameStart"],
    ["TriggerMode", "On"], ["TriggerSource", "Line0"], ["ExposureTime", 1000.0]"#;

/// What a session needs is asked of the camera, whatever its list sets; a list's order is its own.
#[test]
fn what_a_session_needs_is_asked_of_cameras_and_lists_keep_their_order() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let form = Form { format: RGB8, told: RGB8, ..Form::default() };
    let padded = Form { padding: 4, ..Form::default() };
    let power_on = |power_on| Habits { power_on, ..Habits::default() };
    let options = LaboratoryOptions {
        habits: habits([("h0_up", power_on(form)), ("h0_low", power_on(padded))]),
        ..options(small_rig(20.0), dir.path())
    };
    let laboratory = start_laboratory(&options);
    // The trigger of the acquisition is left on, that of the frame off: in another order it would be right.
    let wrong = r#", ["TriggerSelector", "FrameStart"], ["TriggerMode", "Off"],
        ["TriggerSelector", "AcquisitionStart"], ["TriggerMode", "On"]"#;
    let own = |place| match place {
        0 => r#"["PixelFormat", "RGB8"]"#.to_owned(),
        2 => r#"["TriggerMode", "Off"]"#.to_owned(),
        3 => format!("{COMMON}{wrong}"),
        _ => String::new(),
    };
    set(&laboratory.nodes[0].path, "", own);
    let nodes = start_nodes(&laboratory);
    let refused = capture(&laboratory, 5, "refused");
    let text = text_of(&refused);
    assert_eq!(refused.status.code(), Some(5), "{text}");
    assert_contains(
        &text,
        &[
            "camera h0_up: ",
            "PixelFormat is RGB8, expected one of Mono8, Mono10p",
            "set pixel = \"mono8\"",
            "PayloadSize is 192000, expected 64000",
            "camera h0_low: ",
            "PayloadSize is 64800, expected 64000: switch off what it appends",
            "camera h1_up: ",
            "TriggerMode is Off, expected On",
            "camera h1_low: ",
            "TriggerMode is On for AcquisitionStart, expected for FrameStart",
        ],
    );
    drop(nodes);
    assert!(!dir.path().join("sessions/refused").exists());
}

/// Node b's cameras are set as Basler's need it: `TriggerMode` twice, each time behind its selector.
#[test]
fn a_clock_is_read_in_its_own_unit_or_not_at_all() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let clock = |clock| Habits { clock, ..Habits::default() };
    let options = LaboratoryOptions {
        habits: habits([
            ("h0_up", clock(ClockHabit::Bootstrap)),
            ("h0_low", clock(ClockHabit::Nanoseconds)),
            ("h1_up", clock(ClockHabit::ZeroFrequency)),
            ("h1_low", clock(ClockHabit::NoFrequency)),
            ("h2_up", clock(ClockHabit::Still)),
        ]),
        ..options(small_rig(20.0), dir.path())
    };
    let laboratory = start_laboratory(&options);
    set(&laboratory.nodes[1].path, COMMON, |_| {
        r#"["TriggerSelector", "AcquisitionStart"], ["TriggerMode", "Off"],
            ["TriggerSelector", "FrameStart"], ["TriggerMode", "On"]"#
            .to_owned()
    });
    let mut nodes = start_nodes(&laboratory);
    let captured = capture(&laboratory, 24, "clocks");
    let text = text_of(&captured);
    assert!(matches!(captured.status.code(), Some(0 | 3)), "{text}");
    nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
    let session = dir.path().join("sessions/clocks");
    // Frames without a stamp rest on their ids alone, if at all: what is recorded of them is right in any case.
    let gaps = check_frames(&session);
    let unstamped = |place: &usize| [2, 3].contains(place);
    assert!(gaps.iter().enumerate().all(|(place, gaps)| gaps.is_empty() || unstamped(&place)), "{text}");

    // Every reading of a clock keeps time with the host's.
    let reader = SessionReader::open(&session).expect("readable");
    let recordings = reader.recordings();
    let drift = |camera: &str| {
        let of = |s: &&ClockSample| s.camera.as_ref().is_some_and(|c| c.as_str() == camera);
        let samples: Vec<_> = recordings.iter().flat_map(|r| r.clock_samples.iter().filter(of)).collect();
        let (first, last) = (samples.first()?, samples.last()?);
        let host = last.host_send_ns - first.host_send_ns;
        Some((last.device_time_ns - first.device_time_ns) as f64 / host as f64)
    };
    for camera in ["h0_up", "h0_low", "h2_low", "h3_up", "h3_low"] {
        let rate = drift(camera).expect("readings");
        assert!((0.95..1.05).contains(&rate), "{camera}: {rate}");
        assert_eq!(events(&reader, camera, "no_camera_clock"), [""; 0]);
    }
    let none = [
        ("h1_up", "its tick frequency is 0"),
        ("h1_low", "frequency is 0 or cannot be read"),
        ("h2_up", "stands still"),
    ];
    for (camera, why) in none {
        assert_eq!(drift(camera), None, "{camera}");
        let said = events(&reader, camera, "no_camera_clock");
        assert!(said.len() == 1 && said[0].contains(why), "{camera}: {said:?}");
    }
    // What a list sets is what the camera has in the end.
    let set: Vec<String> = recordings[1].header.cameras[0]
        .settings
        .iter()
        .map(|setting| format!("{} {}", setting.feature, setting.value))
        .collect();
    let trigger: Vec<&str> = set.iter().map(String::as_str).filter(|s| s.starts_with("Trigger")).collect();
    assert_eq!(
        trigger,
        [
            "TriggerSelector FrameStart",
            "TriggerMode On",
            "TriggerSource Line0",
            "TriggerSelector AcquisitionStart",
            "TriggerMode Off",
            "TriggerSelector FrameStart",
            "TriggerMode On",
        ]
    );
}
