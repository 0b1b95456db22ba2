// SPDX-License-Identifier: MIT OR Apache-2.0
//! What goes wrong before a session: the error says what to do, the exit code is right, nothing is left behind.

use crate::lab::{
    NodeProcess, assert_contains, fourdbody, laboratory, options, small_rig, start_laboratory, start_nodes,
    text_of,
};
use fourdbody_simulator::laboratory::{Laboratory, LaboratoryOptions};
use std::path::Path;
use std::process::Output;

fn capture(laboratory: &Laboratory, triggers: &str) -> Output {
    fourdbody(&["capture", "--nodes", &laboratory.urls(), "--triggers", triggers, "--name", "refused"])
}

/// Exit code and words of the error; and that there is neither a session nor a node that is in one.
fn assert_refused(dir: &Path, nodes: &mut [NodeProcess], output: &Output, code: i32, words: &[&str]) {
    let text = text_of(output);
    assert_eq!(output.status.code(), Some(code), "{text}");
    assert_contains(&text, words);
    nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
    let session = dir.join("sessions/refused");
    assert!(!session.exists(), "{} was left behind", session.display());
}

#[cfg(feature = "aravis")]
#[test]
fn a_missing_camera_is_named_and_a_later_session_works() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let mut laboratory = laboratory(dir.path(), 20.0);
    let mut nodes = start_nodes(&laboratory);
    let number = laboratory.rig.cameras().position(|(_, c)| c.id.as_str() == "h2_low").expect("in the rig");
    drop(laboratory.cameras.remove(number));
    // Aravis notices by its heartbeat; until then the settings cannot be read back.
    let output = capture(&laboratory, "5");
    assert_refused(dir.path(), &mut nodes, &output, 5, &["node b", "h2_low", "cable"]);
}

#[cfg(feature = "aravis")]
#[test]
fn a_camera_of_another_program_is_recognized() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = laboratory(dir.path(), 20.0);
    use fourdbody::camera::{AravisCameras, CameraBackend};
    let address = laboratory.cameras[1].address().to_string();
    let other = AravisCameras.open(&address).expect("the other program opens it first");
    let mut nodes: Vec<NodeProcess> =
        laboratory.nodes.iter().map(|node| NodeProcess::start(&node.path, node.port)).collect();
    nodes[0].wait_until("one camera owned", |status| {
        status.cameras.iter().any(|c| c.problem.as_ref().is_some_and(|p| p.contains("another program")))
    });
    nodes[1].wait_ready();
    let output = capture(&laboratory, "5");
    assert_refused(
        dir.path(),
        &mut nodes,
        &output,
        5,
        &["h0_low", &address, "controlled by another program"],
    );
    drop(other);
    let output = capture(&laboratory, "5");
    assert_eq!(output.status.code(), Some(0), "{}", text_of(&output));
}

#[cfg(feature = "aravis")]
#[test]
fn an_hsu_that_does_not_answer_is_told() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = laboratory(dir.path(), 20.0);
    let mut nodes = start_nodes(&laboratory);
    laboratory.hsu.set_unresponsive(true);
    let output = capture(&laboratory, "5");
    assert_refused(dir.path(), &mut nodes, &output, 5, &["HSU", "hsu-", "answer"]);
    laboratory.hsu.set_unresponsive(false);
    nodes.iter_mut().for_each(|node| drop(node.wait_ready()));
    let output = capture(&laboratory, "5");
    assert_eq!(output.status.code(), Some(0), "{}", text_of(&output));
}

#[cfg(feature = "aravis")]
#[test]
fn a_disk_that_cannot_hold_the_session_refuses_it() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let options = options(small_rig(20.0), dir.path());
    let laboratory = start_laboratory(&LaboratoryOptions { reserve_mib: 1 << 30, ..options });
    let mut nodes = start_nodes(&laboratory);
    let output = capture(&laboratory, "5");
    assert_refused(dir.path(), &mut nodes, &output, 1, &["MiB are free", "delete or move sessions"]);
}

#[test]
fn nodes_that_are_not_there_or_named_twice_are_told() {
    let output =
        fourdbody(&["capture", "--nodes", "http://127.0.0.1:9,http://127.0.0.1:9", "--triggers", "5"]);
    assert_eq!(output.status.code(), Some(5), "{}", text_of(&output));
    assert!(text_of(&output).contains("is `fourdbody node` running there?"));
}

#[test]
fn mistakes_in_a_configuration_are_problems_with_key_paths() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    std::fs::write(dir.path().join("rig.toml"), small_rig(120.0)).expect("writable");
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/node-a.toml");
    let text = std::fs::read_to_string(shipped).expect("config/node-a.toml is in the repository");
    let broken = text
        .replacen("listen = \"127.0.0.1:7401\"", "listen = \"0.0.0.0:7401\"", 1)
        .replacen("reserve_mib = 4096", "reserve_mb = 4096", 1)
        .replacen("packet_bytes = 9000", "packet_bytes = 90000", 1)
        .replacen("id = \"h1_low\"", "id = \"h3_low\"", 1)
        .replacen("gain_db = 0.0", "gain_db = \"low\"\nsettings = [[\"BlackLevel\"]]", 1);
    let file = dir.path().join("node.toml");
    std::fs::write(&file, broken).expect("writable");
    let output = fourdbody(&["check-config", &file.display().to_string()]);
    let text = text_of(&output);
    assert_eq!(output.status.code(), Some(2), "{text}");
    assert_contains(
        &text,
        &[
            "api.listen",
            "storage.reserve_mb",
            "acquisition.packet_bytes",
            "camera[3].id",
            "acquisition.gain_db",
            "acquisition.settings[0]",
        ],
    );
    // The daemon refuses the same file in the same way.
    let output = fourdbody(&["node", "--config", &file.display().to_string()]);
    assert_eq!(output.status.code(), Some(2), "{}", text_of(&output));
    assert!(text_of(&output).contains("storage.reserve_mb"));
}
