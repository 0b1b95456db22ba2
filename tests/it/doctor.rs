// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody doctor` in the simulated laboratory: good devices pass, bad ones are named.
//!
//! What it thinks of the host that runs the tests is not tested here, only that it says something.

use crate::lab::{NodeProcess, fourdbody, host, laboratory, text_of};
use crate::profiles::tables;
use fourdbody_simulator::gige::{CameraOptions, Habits, Make, SimulatedCamera, TestImages};
use fourdbody_simulator::hsu::{HsuOptions, SimulatedHsu};
use fourdbody_simulator::laboratory::Laboratory;
use hsu_firmware_proto::{Identity, NodeName};
use serde_json::Value;
use std::path::Path;
use std::sync::Arc;

/// Runs it on node a and gives its exit code and its findings.
fn examine(laboratory: &Laboratory, more: &[&str]) -> (Option<i32>, Vec<Value>) {
    let config = laboratory.nodes[0].path.display().to_string();
    let arguments = [&["doctor", "--config", &config, "--json"], more].concat();
    let output = fourdbody(&arguments);
    let json: Value =
        serde_json::from_slice(&output.stdout).unwrap_or_else(|_| panic!("{}", text_of(&output)));
    let findings = json["findings"].as_array().expect("findings").clone();
    assert_eq!(json["fit"], output.status.code() == Some(0));
    (output.status.code(), findings)
}

/// The names of findings of this subject and grade.
fn names(findings: &[Value], subject: &str, grade: &str) -> Vec<String> {
    let wanted = findings.iter().filter(|f| f["subject"] == subject && f["grade"] == grade);
    wanted.map(|f| f["check"].as_str().expect("a name").to_owned()).collect()
}

fn finding<'a>(findings: &'a [Value], check: &str) -> &'a Value {
    let found = findings.iter().find(|f| f["check"] == check);
    found.unwrap_or_else(|| panic!("no finding on {check} in {findings:#?}"))
}

fn assert_no_trace(dir: &Path) {
    let entries = std::fs::read_dir(dir).expect("a directory");
    let left = entries.flatten().filter(|e| e.file_name().to_string_lossy().contains("doctor"));
    assert_eq!(left.count(), 0, "the test recording was left behind");
    assert!(!dir.join("sessions").exists(), "nothing was recorded yet");
}

#[test]
fn good_devices_pass_and_the_disk_is_measured() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = laboratory(dir.path(), 20.0);
    let (_, findings) = examine(&laboratory, &["--disk-seconds", "1"]);
    let expected = ["h0_up", "h0_low", "h1_up", "h1_low"]
        .iter()
        .flat_map(|id| {
            ["", ": settings", ": packet size", ": clock"].map(|what| format!("camera {id}{what}"))
        })
        .chain(["HSU device", "HSU", "HSU clock"].map(str::to_owned));
    assert_eq!(names(&findings, "device", "ok"), expected.collect::<Vec<_>>(), "{findings:#?}");
    let camera = finding(&findings, "camera h0_up")["found"].as_str().expect("text");
    assert!(camera.contains("Sim23M") && camera.contains("SIM0000"), "{camera}");
    assert!(finding(&findings, "HSU")["found"].as_str().expect("text").contains("fourdbody-hsu"));
    assert_eq!(finding(&findings, "way to camera h1_low")["grade"], "ok");
    let speed = finding(&findings, "disk speed")["found"].as_str().expect("text");
    assert!(speed.contains("MB/s over"), "{speed}");
    for host in [
        "reverse-path filter of lo",
        "packet socket",
        "net.core.rmem_max",
        "memory lock",
        "clock source",
        "disk space",
    ] {
        finding(&findings, host);
    }
    assert_no_trace(dir.path());
}

#[test]
fn a_camera_in_a_wrong_subnet_is_named() {
    let Some(tables) = tables() else { return };
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = laboratory(dir.path(), 20.0);
    let network = laboratory.cameras[0].address();
    let images = Arc::new(TestImages::new(64, 48, 1, TestImages::DISTINCT));
    let mut camera = CameraOptions::new("AWAY", host(network, 77), images);
    camera.make = Some(Arc::new(Make::load(&tables.join("basler_aca1920_25gm.json")).expect("a table")));
    camera.habits = Habits { link_local: true, ..Habits::default() };
    let _away = SimulatedCamera::start(camera).expect("its address is free");
    let (_, findings) = examine(&laboratory, &["--disk-seconds", "0"]);
    let place = format!("AWAY at 169.254.{}.77", network.octets()[2]);
    let of_it = |f: &&Value| f["found"].as_str().is_some_and(|found| found.contains(&place));
    let finding = findings.iter().find(of_it).unwrap_or_else(|| panic!("not named in {findings:#?}"));
    assert_eq!(
        (&finding["check"], &finding["grade"]),
        (&"a camera in a wrong subnet".into(), &"warning".into())
    );
    assert!(finding["advice"].as_str().expect("text").contains("cameras setup"), "{finding}");
}

#[test]
fn test_packets_that_do_not_arrive_name_what_lists_the_firewalls_rules() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let mut laboratory = laboratory(dir.path(), 20.0);
    let address = laboratory.cameras[1].address();
    drop::<SimulatedCamera>(laboratory.cameras.remove(1));
    // A firewall drops packets; these come long after the doctor has given up.
    let images = Arc::new(TestImages::new(64, 48, 1, TestImages::DISTINCT));
    let mut camera = CameraOptions::new("MUTE", address, images);
    camera.habits = Habits { test_packet_late_ms: 20_000, ..Habits::default() };
    let _mute = SimulatedCamera::start(camera).expect("its address is free");
    let (code, findings) = examine(&laboratory, &["--disk-seconds", "0"]);
    assert_eq!(code, Some(5), "{findings:#?}");
    let packets = finding(&findings, "camera h0_low: packet size");
    assert_eq!(packets["grade"], "failed", "{packets}");
    let advice = packets["advice"].as_str().expect("text");
    assert!(advice.contains("nft list ruleset") && advice.contains("iptables -S"), "{advice}");
    assert_eq!(finding(&findings, "camera h0_up: packet size")["grade"], "ok");
}

#[test]
fn an_absent_camera_and_a_wrong_hsu_device_are_named() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let mut laboratory = laboratory(dir.path(), 20.0);
    let address = laboratory.cameras[1].address().to_string();
    drop::<SimulatedCamera>(laboratory.cameras.remove(1));
    // Something that speaks the protocol and is another product, and something that is no serial port.
    let identity =
        Identity { name: NodeName::new("lamp-driver").expect("short"), ..HsuOptions::default().identity };
    let link = dir.path().join("lamp");
    let options = HsuOptions { links: vec![link.clone()], identity, ..HsuOptions::default() };
    let _lamp = SimulatedHsu::start(options).expect("a pty");
    let lamp = link.display().to_string();
    let config = &laboratory.nodes[0].path;
    let text = std::fs::read_to_string(config).expect("readable");
    let link = format!("{:?}", laboratory.hsu.link(0).display().to_string());
    assert!(text.contains(&link));
    let examine_with = |device: &str| {
        std::fs::write(config, text.replace(&link, &format!("{device:?}"))).expect("writable");
        let (code, findings) = examine(&laboratory, &["--disk-seconds", "0"]);
        assert_eq!(code, Some(5), "{findings:#?}");
        assert_eq!(names(&findings, "device", "failed"), ["camera h0_low", "HSU"], "{findings:#?}");
        findings
    };
    let findings = examine_with(&lamp);
    assert!(
        finding(&findings, "HSU")["found"].as_str().expect("text").contains("lamp-driver"),
        "{findings:#?}"
    );
    let findings = examine_with("/dev/null");
    let absent = finding(&findings, "camera h0_low");
    assert!(absent["found"].as_str().expect("text").contains(&address), "{absent}");
    assert!(absent["advice"].as_str().expect("text").contains("cable"), "{absent}");
    let hsu = finding(&findings, "HSU");
    assert!(hsu["expected"].as_str().expect("text").contains("/dev/null"), "{hsu}");
    assert_eq!(finding(&findings, "disk speed")["found"], "not measured");
}

#[test]
fn a_camera_of_another_program_is_named_with_its_holder() {
    use fourdbody::camera::{AravisCameras, CameraBackend};
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = laboratory(dir.path(), 20.0);
    let other = AravisCameras
        .open(&laboratory.cameras[2].address().to_string())
        .expect("the other program opens it first");
    let (code, findings) = examine(&laboratory, &["--disk-seconds", "0"]);
    assert_eq!(code, Some(5), "{findings:#?}");
    assert_eq!(names(&findings, "device", "failed"), ["camera h1_up"], "{findings:#?}");
    let found = finding(&findings, "camera h1_up")["found"].as_str().expect("text");
    assert!(found.contains("controlled by another program on 127."), "{found}");
    drop(other);
}

#[test]
fn a_running_node_keeps_its_devices() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = laboratory(dir.path(), 20.0);
    let mut node = NodeProcess::start(&laboratory.nodes[0].path, laboratory.nodes[0].port);
    node.wait_ready();
    let (_, findings) = examine(&laboratory, &["--disk-seconds", "5"]);
    let ids = ["h0_up", "h0_low", "h1_up", "h1_low"].map(|id| format!("camera {id}"));
    let expected: Vec<String> = ids.into_iter().chain(["HSU".to_owned()]).collect();
    assert_eq!(names(&findings, "device", "ok"), expected, "{findings:#?}");
    assert_eq!(finding(&findings, "disk speed")["found"], "not measured");
    // It has not noticed anything.
    node.wait_ready();
}

#[test]
fn without_a_configuration_the_host_alone_is_examined() {
    let output = fourdbody(&["doctor"]);
    let text = text_of(&output);
    assert!(matches!(output.status.code(), Some(0 | 1)), "{text}");
    assert!(text.contains("packet socket: ") && !text.contains("camera h0"), "{text}");
    let missing = fourdbody(&["doctor", "--config", "/nonexistent/node.toml"]);
    assert_eq!(missing.status.code(), Some(2), "{}", text_of(&missing));
}
