// SPDX-License-Identifier: MIT OR Apache-2.0
//! Cameras that answer what no camera can mean: they are lost by name, and nothing else is.

use crate::lab::{
    self, assert_contains, fourdbody, options, small_rig, start_laboratory, start_nodes, text_of,
};
use crate::session_faults::check_frames;
use fourdbody::camera::{AravisCameras, Camera, CameraBackend, PacketTest, Wishes};
use fourdbody::config::NodeConfig;
use fourdbody::data::FrameSource;
use fourdbody::record::{GapCause, SessionReader};
use fourdbody_simulator::faults::FaultPlan;
use fourdbody_simulator::gige::{ClockHabit, Habits};
use fourdbody_simulator::laboratory::{Laboratory, LaboratoryOptions};
use std::path::Path;

/// The first camera of a laboratory, as its node's file has it.
fn first_camera(laboratory: &Laboratory) -> (Box<dyn Camera>, Wishes) {
    let config = NodeConfig::load(&laboratory.nodes[0].path).expect("a node file");
    let camera = AravisCameras.open(&config.cameras[0].address).expect("free");
    (camera, Wishes::of(&config, &config.cameras[0]))
}

/// A laboratory whose first camera has these habits.
fn with_first(dir: &Path, habits: Habits) -> Laboratory {
    let habits = [("h0_up".to_owned(), habits)].into();
    start_laboratory(&LaboratoryOptions { habits, ..options(small_rig(20.0), dir) })
}

/// From the 40th trigger on the state of PTP of one camera is none, and the image of another, which has no clock, has no
/// columns. Each is asked every second, and 180 triggers last 9 s.
#[test]
fn a_camera_that_answers_nonsense_is_lost_by_name_and_all_else_is_complete() {
    const BEGINS: u64 = 40;
    const TRIGGERS: u64 = 180;
    let dir = tempfile::tempdir().expect("a temporary directory");
    let plan = "[faults]\nseed = 1\n\
        [[fault]]\nkind = \"nonsense\"\ncamera = \"h0_low\"\ntrigger = 40\ncount = 100000\n\
        [[fault]]\nkind = \"nonsense\"\ncamera = \"h2_up\"\ntrigger = 40\ncount = 100000\n";
    let no_clock = Habits { clock: ClockHabit::Still, ..Habits::default() };
    let options = LaboratoryOptions {
        faults: Some(FaultPlan::parse(plan).expect("a plan")),
        habits: [("h2_up".to_owned(), no_clock)].into(),
        ..options(small_rig(20.0), dir.path())
    };
    let laboratory = start_laboratory(&options);
    let of_ptp = laboratory.nodes.iter().find(|node| node.node.as_str() == "a").expect("node a");
    lab::say(&of_ptp.path, "h0_low", "settings = [[\"PtpEnable\", true]]");
    let mut nodes = start_nodes(&laboratory);
    let triggers = TRIGGERS.to_string();
    let captured =
        fourdbody(&["capture", "--nodes", &laboratory.urls(), "--triggers", &triggers, "--name", "nonsense"]);
    let logs: Vec<String> = nodes.iter().map(|node| node.log()).collect();
    assert_eq!(captured.status.code(), Some(3), "{}\n{}", text_of(&captured), logs.join("\n"));
    nodes.iter_mut().for_each(|node| drop(node.wait_idle()));

    let session = dir.path().join("sessions/nonsense");
    let verified = fourdbody(&["verify", &session.display().to_string()]);
    assert_eq!(verified.status.code(), Some(3), "{}", text_of(&verified));
    let gaps = check_frames(&session);
    let reader = SessionReader::open(&session).expect("readable");
    for (camera, gaps) in reader.cameras().iter().zip(&gaps) {
        if !["h0_low", "h2_up"].contains(&camera.as_str()) {
            assert_eq!(gaps, &[], "{camera}");
            continue;
        }
        let (first, last) = (gaps.first().expect("a gap").0, gaps.last().expect("a gap").0);
        assert!(first >= BEGINS, "{camera} was there before: {gaps:?}");
        assert_eq!((last, gaps.len() as u64), (TRIGGERS - 1, TRIGGERS - first), "{camera}: one hole");
        let gone = gaps.iter().filter(|(_, cause)| *cause == GapCause::Unplugged).count();
        assert!(gone + 2 >= gaps.len(), "{camera}: but for a frame that was under way: {gaps:?}");
    }
    let recordings = reader.recordings();
    let lost: Vec<String> = recordings
        .iter()
        .flat_map(|recording| &recording.events)
        .filter(|event| event.kind == "camera_lost")
        .map(|event| format!("{}: {}", event.camera.as_ref().expect("its name"), event.message))
        .collect();
    assert_eq!(lost.len(), 2, "{lost:?}");
    let lost = lost.join("\n");
    let of_ptp = ["h0_low: ", "nonsense", "PtpStatus is 77, which none of its entries has"];
    assert_contains(&lost, &of_ptp);
    assert_contains(&lost, &["h2_up: ", "an image of 0 x 200 pixels"]);
}

#[test]
fn a_value_without_entry_is_set_and_names_of_any_bytes_are_told() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let habits = Habits { no_entry: true, foreign_names: true, ..Habits::default() };
    let laboratory = with_first(dir.path(), habits);
    let listed = fourdbody(&["cameras", "--json"]);
    assert_contains(&text_of(&listed), &["Sim23M\u{fffd}"]);
    let (mut camera, wishes) = first_camera(&laboratory);
    assert_eq!(camera.identity().model, "Sim23M\u{fffd}");
    let state = camera.state().expect("read");
    assert_eq!(state["AcquisitionMode"], "77, which none of its entries has");
    let set_up = camera.set_up(&wishes).expect("what is wrong is set");
    assert!(
        set_up.remarks.iter().any(|remark| remark.contains("AcquisitionMode was 77")),
        "{:?}",
        set_up.remarks
    );
    assert_eq!(camera.state().expect("read")["AcquisitionMode"], "Continuous");
    drop(camera);
    let config = laboratory.nodes[0].path.display().to_string();
    for command in [
        &["doctor", "--disk-seconds", "0", "--config", &config][..],
        &["cameras", "dump", "--config", &config],
    ] {
        let output = fourdbody(command);
        assert_contains(&text_of(&output), &["Sim23M\u{fffd}"]);
        assert!(output.status.code().is_some(), "it ends by itself: {}", text_of(&output));
    }
}

/// Aravis' own test receives a packet as large as the register says into memory as large as the description says.
#[test]
fn test_packets_larger_than_the_camera_says_are_not_asked_for() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = with_first(dir.path(), Habits { packet_max_told: 1500, ..Habits::default() });
    let (mut camera, _) = first_camera(&laboratory);
    let test = camera.test_packet_size(9000).expect("it answers");
    assert_eq!(test, Some(PacketTest { arrived: 1500, camera_takes: Some(1500) }));
    drop(camera);
    let config = laboratory.nodes[0].path.display().to_string();
    let output = fourdbody(&["doctor", "--disk-seconds", "0", "--config", &config]);
    assert_contains(&text_of(&output), &["packets of 1500 bytes at most", "packet_bytes = 1500"]);
}

#[test]
fn slow_test_packets_are_no_matter_of_the_network() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = with_first(dir.path(), Habits { test_packet_late_ms: 80, ..Habits::default() });
    let (mut camera, _) = first_camera(&laboratory);
    let test = camera.test_packet_size(9000).expect("it answers");
    assert_eq!(test, Some(PacketTest { arrived: 9000, camera_takes: None }));
}

/// Names without a feature, and features that point to nothing: none is read, and the others are.
#[test]
fn a_description_may_name_what_is_not_there() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = with_first(dir.path(), Habits { broken_description: true, ..Habits::default() });
    let (mut camera, wishes) = first_camera(&laboratory);
    let state = camera.state().expect("read");
    assert!(state.len() > 40 && !state.contains_key("NotThere"), "{state:?}");
    camera.set_up(&wishes).expect("what it needs is there");
    println!("{:?}", state.iter().filter(|(name, _)| name.starts_with("Broken")).collect::<Vec<_>>());
}
