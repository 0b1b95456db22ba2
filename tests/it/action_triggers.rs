// SPDX-License-Identifier: MIT OR Apache-2.0
//! Sessions without an HSU: this node triggers its cameras by action commands (docs/design/action-triggers.md).

use crate::lab::{
    FOURDBODY, NodeProcess, assert_contains, fourdbody, options, say, small_rig, start_capture,
    start_laboratory, start_nodes, text_of,
};
use crate::session_faults::check_frames;
use fourdbody::camera::{AravisCameras, CameraBackend, Wishes};
use fourdbody::config::NodeConfig;
use fourdbody::data::FrameSource;
use fourdbody::record::{GapCause, SessionReader};
use fourdbody_simulator::gige::{ActionFate, ActionFilter, Habits};
use fourdbody_simulator::laboratory::{Laboratory, LaboratoryOptions};
use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Command, Output};
use std::time::Duration;

/// The first two heads of the shipped rig, all on one node.
fn rig(rate_hz: f64) -> String {
    let text = small_rig(rate_hz);
    let parts: Vec<&str> = text.split("\n[[head]]\n").collect();
    parts[..3].join("\n[[head]]\n")
}

fn bench(dir: &Path, trigger: &str) -> LaboratoryOptions {
    LaboratoryOptions { trigger: Some(format!("source = \"action\"\n{trigger}")), ..options(rig(20.0), dir) }
}

fn capture(laboratory: &Laboratory, nodes: &mut [NodeProcess], name: &str, triggers: u64) -> Output {
    let triggers = triggers.to_string();
    let args = ["capture", "--nodes", &laboratory.urls(), "--triggers", &triggers, "--name", name];
    let captured = fourdbody(&args);
    nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
    captured
}

fn verify(session: &Path) -> Output {
    fourdbody(&["verify", &session.display().to_string()])
}

/// What the recording says of each camera's action commands.
fn commands(session: &Path) -> BTreeMap<String, String> {
    let reader = SessionReader::open(session).expect("readable");
    let events = reader.recordings().iter().flat_map(|recording| &recording.events);
    let commands = events.filter(|event| event.kind == "action_commands");
    commands.map(|e| (e.camera.as_ref().expect("a camera").to_string(), e.message.clone())).collect()
}

/// Takes some 8 s. The clock is that of PTP; one camera hears some commands not, one some twice, one some late.
#[test]
fn what_becomes_of_a_command_shows_at_exactly_its_trigger() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let fate = |triggers: &'static [i64], fate: ActionFate| {
        ActionFilter::new(move |number| if triggers.contains(&number) { fate } else { ActionFate::Arrives })
    };
    let action_fates = [
        ("h0_low".to_owned(), fate(&[7, 8, 20], ActionFate::Lost)),
        ("h1_up".to_owned(), fate(&[-5, 5, 6], ActionFate::Twice)),
        // It leaves 10 ms early, and acts 5 ms after its time.
        ("h1_low".to_owned(), fate(&[11], ActionFate::Late(Duration::from_millis(15)))),
    ];
    let options = LaboratoryOptions { action_fates: action_fates.into(), ..bench(dir.path(), "") };
    let laboratory = start_laboratory(&options);
    let checked = fourdbody(&["check-config", &laboratory.nodes[0].path.display().to_string()]);
    assert_eq!(checked.status.code(), Some(0), "{}", text_of(&checked));
    let mut nodes = start_nodes(&laboratory);
    let captured = capture(&laboratory, &mut nodes, "fates", 30);
    assert_eq!(captured.status.code(), Some(3), "{}", text_of(&captured));
    let session = dir.path().join("sessions/fates");
    let gaps = check_frames(&session);
    // A host that is too busy is late with a command, or stands still: that is given up by name, and none stands wrong.
    let by_host = |cause: &GapCause| matches!(cause, GapCause::IdentityMismatch | GapCause::NodePaused);
    for (camera, expected) in [vec![], vec![7, 8, 20], vec![], vec![11]].into_iter().enumerate() {
        let (told, others): (Vec<_>, Vec<_>) =
            gaps[camera].iter().partition(|(trigger, _)| expected.contains(trigger));
        assert_eq!(told.iter().map(|(trigger, _)| *trigger).collect::<Vec<_>>(), expected, "{gaps:?}");
        assert!(others.len() <= 6 && others.iter().all(|(_, cause)| by_host(cause)), "{gaps:?}");
    }
    // What was taken at another time than the trigger's is of no use to the others.
    assert!(gaps[3].iter().all(|(_, cause)| by_host(cause)), "{gaps:?}");
    let verified = verify(&session);
    assert_eq!(verified.status.code(), Some(3), "{}", text_of(&verified));
    let commands = commands(&session);
    // Two answers to a command that came twice count once. A busy host may be late with more than the one.
    for (camera, unanswered) in [("h0_up", 0), ("h0_low", 3), ("h1_up", 0), ("h1_low", 0)] {
        let expected = [format!("{unanswered} unanswered"), "0 refused".to_owned(), "0 not sent".to_owned()];
        assert_contains(&commands[camera], &["38 action commands sent"]);
        assert_contains(&commands[camera], &expected.each_ref().map(String::as_str));
    }
    assert!(!commands["h1_low"].contains(" 0 late"), "{commands:?}");
    let info = fourdbody(&["info", &session.display().to_string()]);
    assert_contains(&text_of(&info), &["action-commands"]);
}

/// Takes some 12 s. One camera gets commands a millisecond late, which no stamp shows; another one loses PTP's master for
/// two seconds, and acts by its clock as before.
#[test]
fn exposures_that_were_not_at_one_time_are_named_with_camera_and_triggers() {
    const LATE: [u64; 4] = [11, 12, 13, 130];
    const AWAY: std::ops::Range<u64> = 50..100;
    let dir = tempfile::tempdir().expect("a temporary directory");
    let late = ActionFilter::new(|number| match u64::try_from(number).is_ok_and(|n| LATE.contains(&n)) {
        // It leaves 10 ms early.
        true => ActionFate::Late(Duration::from_millis(11)),
        false => ActionFate::Arrives,
    });
    let away = Habits { ptp_away: Some((AWAY.start as i64, AWAY.end as i64)), ..Habits::default() };
    let options = LaboratoryOptions {
        action_fates: [("h1_low".to_owned(), late)].into(),
        habits: [("h0_low".to_owned(), away)].into(),
        ..bench(dir.path(), "")
    };
    let laboratory = start_laboratory(&options);
    let mut nodes = start_nodes(&laboratory);
    let captured = capture(&laboratory, &mut nodes, "late", 160);
    assert_eq!(captured.status.code(), Some(3), "{}", text_of(&captured));
    let session = dir.path().join("sessions/late");
    let by_host = |cause: &GapCause| matches!(cause, GapCause::IdentityMismatch | GapCause::NodePaused);
    let gaps = check_frames(&session);
    let lost: Vec<_> = gaps.iter().flatten().collect();
    assert!(lost.len() <= 12 && lost.iter().all(|(_, cause)| by_host(cause)), "{gaps:?}");

    // The node, `verify` and `info` say the same of it, in the same words.
    let outcome = nodes[0].client.status().expect("the node answers").session.expect("a session").outcome;
    let verdict = serde_json::to_value(outcome).expect("a value")["recorded"].clone();
    let lines: Vec<String> = serde_json::from_value(verdict["not_simultaneous"].clone()).unwrap_or_default();
    let of = |camera: &str, why: &str| {
        let begin = format!("{camera}, trigger");
        lines.iter().find(|line| line.starts_with(&begin) && line.contains(why)).cloned()
    };
    let late = of("h1_low", "late").unwrap_or_else(|| panic!("{verdict}"));
    let away = of("h0_low", "Listening").unwrap_or_else(|| panic!("{verdict}"));
    // A host that is too busy is late with commands of its own.
    assert!(lines.iter().all(|line| *line == away || line.contains("came late")), "{lines:?}");
    if lost.is_empty() {
        assert_eq!(verdict["status"], "unconfirmed");
    }
    let path = session.display().to_string();
    let info = fourdbody(&["info", &path]);
    let status = fourdbody(&["status", "--nodes", &laboratory.urls()]);
    let verified = verify(&session);
    assert_eq!(verified.status.code(), Some(3), "{}", text_of(&verified));
    for output in [&captured, &info, &status, &verified] {
        assert_contains(&text_of(output), &[&late, &away]);
    }

    // Each trigger by number, for a script.
    let found: serde_json::Value =
        serde_json::from_slice(&fourdbody(&["verify", "--json", &path]).stdout).expect("JSON");
    let covered = |camera: &str, trigger: u64| {
        let findings = found["reports"][0]["findings"].as_array().into_iter().flatten();
        findings.filter(|f| f["severity"] == "unconfirmed" && f["camera"] == camera).any(|f| {
            let [first, last] = [0, 1].map(|place| f["triggers"][place].as_u64().unwrap_or(u64::MAX));
            (first..=last).contains(&trigger)
        })
    };
    assert!(LATE.into_iter().all(|trigger| covered("h1_low", trigger)), "{found}");
    assert!(AWAY.into_iter().all(|trigger| covered("h0_low", trigger)), "{found}");
    let told: serde_json::Value =
        serde_json::from_slice(&fourdbody(&["info", "--json", &path]).stdout).expect("JSON");
    let actions = told["recordings"][0]["actions"].as_array().cloned().unwrap_or_default();
    assert_eq!(actions.len(), 4, "{actions:?}");
    for camera in &actions {
        let count = |what: &str| camera["commands"][what].as_u64().unwrap_or_else(|| panic!("{camera}"));
        assert_eq!(count("sent"), 168, "{camera}");
        let answers = ["acknowledged", "late", "refused", "unanswered"].map(count);
        assert_eq!(answers.iter().sum::<u64>(), 168, "{camera}");
        assert!(camera["camera"] != "h1_low" || count("late") >= 4, "{camera}");
    }
    let ptp = told["recordings"][0]["ptp"].as_array().cloned().unwrap_or_default();
    assert_eq!(ptp.len(), 4, "{ptp:?}");
    for camera in &ptp {
        let listened = camera["statuses"].get("Listening").is_some();
        assert_eq!(listened, camera["camera"] == "h0_low", "{camera}");
    }
    assert_contains(&text_of(&info), &["168 action commands sent", "Listening 1, Slave"]);
}

/// Takes some 10 s: without PTP, and then with a camera whose keys are otherwise.
#[test]
fn at_once_a_session_is_complete_and_keys_that_differ_are_refused_by_name() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = start_laboratory(&bench(dir.path(), "ptp = false\ngroup_key = 7\ngroup_mask = 2"));
    let mut nodes = start_nodes(&laboratory);
    let captured = capture(&laboratory, &mut nodes, "at-once", 30);
    let session = dir.path().join("sessions/at-once");
    let gaps = check_frames(&session);
    // As above: a host that is too busy gives up frames by name.
    let causes = |cause: &GapCause| matches!(cause, GapCause::IdentityMismatch | GapCause::NodePaused);
    assert!(gaps.iter().all(|of| of.len() <= 6 && of.iter().all(|(_, cause)| causes(cause))), "{gaps:?}");
    let expected = if gaps.iter().all(Vec::is_empty) { 0 } else { 3 };
    assert_eq!(captured.status.code(), Some(expected), "{}", text_of(&captured));
    let verified = verify(&session);
    assert_eq!(verified.status.code(), Some(expected), "{}", text_of(&verified));
    let warnings = nodes[0].client.status().expect("the node answers").warnings;
    assert_contains(&warnings.join("\n"), &["exposures of a trigger differ"]);
    drop(nodes);
    say(&laboratory.nodes[0].path, "h1_up", "settings = [[\"ActionGroupKey\", 5]]");
    let mut nodes = start_nodes(&laboratory);
    let refused = capture(&laboratory, &mut nodes, "keys", 5);
    assert_ne!(refused.status.code(), Some(0), "{}", text_of(&refused));
    assert_contains(
        &text_of(&refused),
        &["camera h1_up: an action command with device key 1, group key 7", "ActionGroupKey"],
    );
    assert!(!text_of(&refused).contains("camera h1_low:"), "{}", text_of(&refused));
}

/// Takes some 12 s. The camera by whose clock the common one is known is away for a while.
#[test]
fn the_camera_whose_clock_is_read_is_lost_and_the_others_go_on() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let mut laboratory = start_laboratory(&bench(dir.path(), ""));
    let mut nodes = start_nodes(&laboratory);
    let child = start_capture(&laboratory, "away");
    let triggers = |node: &mut NodeProcess, at_least: u64| {
        node.wait_until("more triggers", |s| s.session.as_ref().is_some_and(|s| s.triggers >= at_least));
    };
    triggers(&mut nodes[0], 10);
    laboratory.unplug(0);
    let lost = nodes[0].wait_until("one lost", |s| s.cameras[0].problem.is_some());
    laboratory.plug(0).expect("its address is free");
    nodes[0].wait_until("back", |s| s.cameras[0].problem.is_none());
    let at = lost.session.map_or(0, |session| session.triggers);
    triggers(&mut nodes[0], at + 40);
    let stopped =
        Command::new("kill").args(["-INT", &child.id().to_string()]).status().expect("kill is installed");
    assert!(stopped.success());
    let captured = child.wait_with_output().expect("it ends");
    nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
    assert_eq!(captured.status.code(), Some(3), "{}", text_of(&captured));
    let session = dir.path().join("sessions/away");
    let verified = verify(&session);
    assert_eq!(verified.status.code(), Some(3), "{}", text_of(&verified));
    // Every frame shows the trigger that it is filed under.
    let gaps = check_frames(&session);
    let (first, last) = (gaps[0].first().expect("a gap").0, gaps[0].last().expect("a gap").0);
    assert!(first >= 9 && gaps[0].len() as u64 == last - first + 1, "one hole: {gaps:?}");
    let reader = SessionReader::open(&session).expect("readable");
    assert!(last + 5 < reader.triggers().end, "it came back: {gaps:?}");
    let by_host = |cause: &GapCause| matches!(cause, GapCause::IdentityMismatch | GapCause::NodePaused);
    let others = gaps[1..].iter().flatten();
    assert!(others.clone().count() <= 6 && others.clone().all(|(_, cause)| by_host(cause)), "{gaps:?}");
}

/// This test takes a second.
#[test]
fn a_camera_tells_of_ptp_and_its_clock_is_that_of_the_others() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let listens = Habits { ptp_listens: true, ..Habits::default() };
    let options =
        LaboratoryOptions { habits: [("h1_low".to_owned(), listens)].into(), ..bench(dir.path(), "") };
    let laboratory = start_laboratory(&options);
    let config = NodeConfig::load(&laboratory.nodes[0].path).expect("a node file");
    let mut told = Vec::new();
    for camera in &config.cameras {
        let mut opened = AravisCameras.open(&camera.address).expect("a camera");
        opened.set_up(&Wishes::of(&config, camera)).expect("it is set up");
        let status = opened.ptp_status().expect("it answers");
        let clock = opened.sample_clock().expect("it answers").expect("a clock");
        told.push((status, clock.camera_ns.wrapping_sub(clock.host_before_ns)));
    }
    let states: Vec<&str> = told.iter().map(|(state, _)| state.as_deref().unwrap_or("none")).collect();
    assert_eq!(states, ["Slave", "Slave", "Slave", "Listening"]);
    let apart = |camera: usize| told[camera].1.abs_diff(told[0].1);
    assert!(apart(1).max(apart(2)) < 1_000_000_000 && apart(3) > 1_000_000_000_000, "{told:?}");
}

/// This test only parses text.
#[test]
fn what_action_commands_cannot_do_is_refused_with_its_key() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let problems = |rig: &str, node: &str| {
        std::fs::write(dir.path().join("rig.toml"), rig).expect("writable");
        let file = dir.path().join("node-a.toml");
        std::fs::write(&file, node).expect("writable");
        let output = Command::new(FOURDBODY).arg("check-config").arg(&file).output().expect("it starts");
        text_of(&output)
    };
    let shipped = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("config/node-a.toml"));
    let shipped = shipped.expect("config/node-a.toml is in the repository");
    let hsu = "[hsu]\ndevice = \"/dev/fourdbody-hsu\"   # a udev link; see docs\n";
    assert!(shipped.contains(hsu));
    let node = |trigger: &str| {
        shipped
            .replace(hsu, trigger)
            .replace("trigger_line = \"Line0\"", "")
            .replace("trigger_edge = \"rising\"", "")
    };
    let action = "[trigger]\nsource = \"action\"\n";
    assert_contains(&problems(&rig(120.0), &node(action)), &["node-a.toml: ok"]);
    assert_contains(&problems(&rig(120.0), &node("")), &["hsu"]);
    let both = format!("{action}{hsu}");
    assert_contains(&problems(&rig(120.0), &node(&both)), &["hsu:", "leave out one of the two"]);
    let with_line = shipped.replace(hsu, action);
    assert_contains(&problems(&rig(120.0), &with_line), &["camera[0].trigger_line", "leave it out"]);
    let two_nodes = small_rig(120.0);
    assert_contains(&problems(&two_nodes, &node(action)), &["trigger.source", "the rig has 2", "one node"]);
    let turns = rig(120.0).replacen("delay_us = 200.0", "delay_us = 1400.0", 1);
    assert_contains(&problems(&turns, &node(action)), &["trigger.source", "takes turns", "stand still"]);
    let by_name = node(action).replace("192.168.10.2", "FLIR-0123456789");
    assert_contains(&problems(&rig(120.0), &by_name), &["camera[0].address", "IPv4"]);
    let mask = node(&format!("{action}group_mask = 0\n"));
    assert_contains(&problems(&rig(120.0), &mask), &["trigger.group_mask"]);
}
