// SPDX-License-Identifier: MIT OR Apache-2.0
//! An upgrade of the package never ends a session: the maintainer's scripts with stand-ins for systemd, and the lock that
//! a node holds.

use crate::lab::{NodeProcess, assert_contains, fourdbody, laboratory, start_capture, text_of};
use crate::service::{Service, runtime_directory};
use fourdbody::control::client::NodeClient;
use fourdbody::control::request::Phase;
use std::fs::{File, OpenOptions};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::{Duration, Instant};

/// A script of the package, with the directories and programs of systemd replaced by those of a test.
fn run_script(dir: &Path, script: &str, args: &[&str], upgrade: Option<&str>) -> Output {
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("systemd").join(script);
    let text = std::fs::read_to_string(shipped).expect("in the repository");
    let own = |name: &str| dir.join(name).display().to_string();
    let text = text.replace("/run/fourdbody/", &(own("run") + "/")).replace("/run/systemd/system", &own(""));
    let path = dir.join(script.replace('/', "-"));
    std::fs::write(&path, text).expect("writable");
    let programs = dir.join("programs");
    std::fs::create_dir_all(&programs).expect("writable");
    let (calls, state) = (own("calls"), own("state"));
    let write_down = format!("#!/bin/sh\necho \"${{0##*/}} $*\" >>'{calls}'\n");
    program(&programs.join("deb-systemd-invoke"), &write_down);
    program(
        &programs.join("systemctl"),
        &format!("#!/bin/sh\ncase $1 in show) cat '{state}'; exit;; esac\n{write_down}"),
    );
    let mut command = Command::new("sh");
    command.arg(&path).args(args).env_remove("FOURDBODY_UPGRADE");
    command.env("PATH", format!("{}:{}", programs.display(), std::env::var("PATH").unwrap_or_default()));
    if let Some(upgrade) = upgrade {
        command.env("FOURDBODY_UPGRADE", upgrade);
    }
    command.output().expect("sh")
}

fn program(path: &Path, text: &str) {
    std::fs::write(path, text).expect("writable");
    std::fs::set_permissions(path, PermissionsExt::from_mode(0o755)).expect("mine");
}

/// Which commands of systemd were given since the last look.
fn calls(dir: &Path) -> Vec<String> {
    let text = std::fs::read_to_string(dir.join("calls")).unwrap_or_default();
    let _ = std::fs::remove_file(dir.join("calls"));
    text.lines().map(str::to_owned).collect()
}

fn lock_file(dir: &Path) -> PathBuf {
    runtime_directory(dir).join("session.lock")
}

fn lock(path: &Path) -> File {
    let file = OpenOptions::new().append(true).create(true).open(path).expect("writable");
    file.try_lock().expect("free");
    file
}

const UPGRADE: [&str; 3] = ["upgrade", "0.1.0", "0.2.0"];
const RESTARTED: [&str; 2] =
    ["deb-systemd-invoke stop fourdbody-node.service", "systemctl --no-block start fourdbody-node.service"];

#[test]
fn an_upgrade_is_refused_during_a_session_and_at_no_other_time() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let preinst = |args: &[&str], upgrade| run_script(dir.path(), "debian/preinst", args, upgrade);
    for args in [&["install"][..], &UPGRADE] {
        let output = preinst(args, None);
        assert!(output.status.success(), "a fresh install, a stopped node: {}", text_of(&output));
    }
    let path = lock_file(dir.path());
    std::fs::write(&path, "").expect("writable");
    assert!(preinst(&UPGRADE, None).status.success(), "a node between sessions");
    std::fs::write(&path, "session walk-03\n").expect("writable");
    let held = lock(&path);
    let refused = preinst(&UPGRADE, None);
    assert_eq!(refused.status.code(), Some(1));
    assert_contains(
        &text_of(&refused),
        &[
            "expected no session",
            "found session walk-03",
            "wait for its end",
            "FOURDBODY_UPGRADE=now",
            "runs on",
        ],
    );
    assert!(preinst(&UPGRADE, Some("now")).status.success(), "as the administrator wishes");
    assert!(preinst(&["install"], None).status.success());
    drop(held);
    assert!(preinst(&UPGRADE, None).status.success(), "the session has ended");
}

#[test]
fn the_node_is_restarted_between_takes_only() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let restart = |upgrade| run_script(dir.path(), "restart-between-takes", &[], upgrade);
    let state = |state: &str| std::fs::write(dir.path().join("state"), state).expect("writable");
    state("inactive\n");
    let stopped = restart(None);
    assert!(stopped.status.success() && text_of(&stopped).contains("not running"), "{}", text_of(&stopped));
    assert_eq!(calls(dir.path()), [""; 0]);

    state("active\n");
    runtime_directory(dir.path());
    let unknown = restart(None);
    assert_eq!(unknown.status.code(), Some(75), "{}", text_of(&unknown));
    assert_contains(&text_of(&unknown), &["NOT restarted", "found none", "systemctl restart fourdbody-node"]);
    assert_eq!(calls(dir.path()), [""; 0], "a node that says nothing may be in a session");

    let path = lock_file(dir.path());
    std::fs::write(&path, "session walk-03\n").expect("writable");
    let held = lock(&path);
    let refused = restart(None);
    assert_eq!(refused.status.code(), Some(75), "{}", text_of(&refused));
    assert_contains(&text_of(&refused), &["NOT restarted", "found session walk-03", "restart-between-takes"]);
    assert_eq!(calls(dir.path()), [""; 0]);
    assert!(restart(Some("now")).status.success());
    assert_eq!(calls(dir.path()), RESTARTED);
    drop(held);
    for running in ["active\n", "activating\n"] {
        state(running);
        let output = restart(None);
        assert!(output.status.success(), "{}", text_of(&output));
        assert_eq!(calls(dir.path()), RESTARTED, "{running}");
    }
}

/// cargo-deb's own scripts restart without a question: also where an upgrade was refused.
#[test]
fn nothing_else_in_the_package_restarts_the_node() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let manifest = std::fs::read_to_string(root.join("Cargo.toml")).expect("Cargo.toml");
    let manifest: toml::Table = manifest.parse().expect("TOML");
    let package = &manifest["package"]["metadata"]["deb"];
    for unit in package["systemd-units"].as_array().expect("units") {
        for word in ["start", "restart-after-upgrade", "stop-on-upgrade"] {
            assert_eq!(unit[word].as_bool(), Some(false), "{word} of {unit}");
        }
    }
    let assets = package["assets"].as_array().expect("assets");
    let has = |source: &str| assets.iter().any(|asset| asset[0].as_str() == Some(source));
    assert!(has("systemd/restart-between-takes") && has("systemd/needrestart.conf"));
    let postinst = std::fs::read_to_string(root.join("systemd/debian/postinst")).expect("the script");
    assert!(postinst.contains("/usr/lib/fourdbody/restart-between-takes || true"), "{postinst}");
    let restarts = |line: &&str| line.contains("restart ") && line.contains("fourdbody-node");
    assert_eq!(postinst.lines().filter(restarts).collect::<Vec<_>>(), [""; 0]);
}

#[test]
fn a_node_holds_the_lock_from_the_preparation_to_the_verdict() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = laboratory(dir.path(), 20.0);
    let [a, b] = &laboratory.nodes[..] else { panic!("two nodes") };
    let mut service = Service::start(&a.path, dir.path());
    let mut other = NodeProcess::start(&b.path, b.port);
    service.wait("READY=1");
    other.wait_ready();
    let client = NodeClient::new(&format!("127.0.0.1:{}", a.port));
    let preinst = || run_script(dir.path(), "debian/preinst", &UPGRADE, None);
    let wait_for = |refused: bool| {
        let deadline = Instant::now() + Duration::from_secs(60);
        while preinst().status.success() == refused {
            assert!(Instant::now() < deadline, "{:?}", client.status());
            std::thread::sleep(Duration::from_millis(50));
        }
    };
    let running = || client.status().expect("alive");
    assert!(preinst().status.success(), "no session yet");

    let mut capture = start_capture(&laboratory, "walk");
    wait_for(true);
    assert!(text_of(&preinst()).contains("found session walk"), "{}", text_of(&preinst()));
    let deadline = Instant::now() + Duration::from_secs(60);
    while running().phase != Phase::Running {
        assert!(Instant::now() < deadline, "{:?}", running());
        std::thread::sleep(Duration::from_millis(50));
    }
    let interrupted = Command::new("kill").args(["-INT", &capture.id().to_string()]).status();
    assert!(interrupted.is_ok_and(|status| status.success()));
    wait_for(false);
    let ended = running().session.expect("the last one");
    assert!(ended.outcome.is_some(), "the lock is given back with the verdict, not before: {ended:?}");
    assert!(capture.wait().is_ok());

    // While somebody restarts the node, no session begins.
    let held = lock(&lock_file(dir.path()));
    let capture = |name: &str| {
        fourdbody(&["capture", "--nodes", &laboratory.urls(), "--triggers", "3", "--name", name])
    };
    let refused = capture("not-now");
    assert_eq!(refused.status.code(), Some(2), "{}", text_of(&refused));
    assert!(text_of(&refused).contains("about to be restarted"), "{}", text_of(&refused));
    drop(held);
    let taken = capture("now");
    assert!(matches!(taken.status.code(), Some(0 | 3)), "{}", text_of(&taken));

    // The kernel gives back what a dead process held.
    let mut capture = start_capture(&laboratory, "killed");
    wait_for(true);
    service.signal("-KILL");
    wait_for(false);
    let _ = capture.kill();
    let _ = capture.wait();
}
