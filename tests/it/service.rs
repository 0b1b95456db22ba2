// SPDX-License-Identifier: MIT OR Apache-2.0
//! The node as a service: what systemd is told, and what it makes of the unit.

use crate::lab::{FOURDBODY, laboratory, text_of};
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::os::unix::net::UnixDatagram;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// A node that believes that a service manager has started it.
pub struct Service {
    pub child: Child,
    socket: UnixDatagram,
    told: Vec<String>,
}

impl Service {
    pub fn start(config: &Path, dir: &Path) -> Self {
        let path = dir.join("notify");
        let socket = UnixDatagram::bind(&path).expect("a socket");
        socket.set_read_timeout(Some(Duration::from_millis(200))).expect("a socket");
        let log = std::fs::File::create(dir.join("service.log")).expect("a log file");
        let child = Command::new(FOURDBODY)
            .args(["node", "--config"])
            .arg(config)
            .env("NOTIFY_SOCKET", &path)
            .env("RUNTIME_DIRECTORY", runtime_directory(dir))
            .env("WATCHDOG_USEC", "2000000")
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(log)
            .spawn()
            .expect("the binary starts");
        Self { child, socket, told: Vec::new() }
    }

    /// Reads on until somebody said this; how many lines so far say it.
    pub fn wait(&mut self, what: &str) -> usize {
        let deadline = Instant::now() + Duration::from_secs(60);
        let before = self.count(what);
        while self.count(what) == before {
            assert!(Instant::now() < deadline, "never {what}: {:#?}", self.told);
            let mut message = [0; 4096];
            if let Ok(length) = self.socket.recv(&mut message) {
                let text = String::from_utf8_lossy(&message[..length]).into_owned();
                self.told.extend(text.lines().map(str::to_owned));
            }
        }
        self.count(what)
    }

    fn count(&self, what: &str) -> usize {
        self.told.iter().filter(|line| line.contains(what)).count()
    }

    pub fn signal(&self, name: &str) {
        let sent = Command::new("kill").args([name, &self.child.id().to_string()]).status();
        assert!(sent.is_ok_and(|status| status.success()));
    }
}

/// What `RuntimeDirectory=` of the unit makes.
pub fn runtime_directory(dir: &Path) -> PathBuf {
    let runtime = dir.join("run");
    std::fs::create_dir_all(&runtime).expect("writable");
    runtime
}

impl Drop for Service {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[test]
fn a_node_is_ready_when_its_devices_are_and_stops_in_good_order() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let mut laboratory = laboratory(dir.path(), 20.0);
    laboratory.unplug(1);
    let mut service = Service::start(&laboratory.nodes[0].path, dir.path());
    service.wait("STATUS=not ready");
    // Fed although it is not ready: its threads move.
    service.wait("WATCHDOG=1");
    assert_eq!(service.count("READY=1"), 0, "{:#?}", service.told);
    laboratory.plug(1).expect("the camera starts");
    service.wait("READY=1");
    service.wait("STATUS=ready: 4 cameras");
    service.wait("WATCHDOG=1");
    service.signal("-TERM");
    service.wait("STOPPING=1");
    assert!(service.child.wait().expect("a child").success());
    assert_eq!(service.count("READY=1"), 1);
}

/// A unit with this machine's program in it, because systemd looks whether it is there.
fn unit(dir: &Path, name: &str) -> PathBuf {
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("systemd").join(name);
    let text = std::fs::read_to_string(shipped).expect("in the repository");
    let path = dir.join(name);
    let lines = text.lines().filter(|line| !line.starts_with("Documentation=man:"));
    let lines = lines.map(|line| line.replace("/usr/bin/fourdbody", FOURDBODY) + "\n");
    std::fs::write(&path, lines.collect::<String>()).expect("writable");
    path
}

#[test]
fn systemd_understands_the_units_and_finds_them_hardened() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    for name in ["fourdbody-node.service", "fourdbody-worker.service"] {
        let unit = unit(dir.path(), name);
        let analyze = |args: &[&str]| Command::new("systemd-analyze").args(args).arg(&unit).output();
        let Ok(verified) = analyze(&["verify", "--man=no"]) else {
            println!("skipped: systemd-analyze is not installed (Debian package systemd)");
            return;
        };
        let complaints = String::from_utf8_lossy(&verified.stderr).into_owned();
        let ours: Vec<&str> = complaints.lines().filter(|line| line.contains(name)).collect();
        assert!(ours.is_empty(), "{complaints}");
        // Exposure in tenths: 25 is 2.5.
        let score =
            analyze(&["security", "--offline=true", "--threshold=25", "--no-pager"]).expect("it ran before");
        assert!(score.status.success(), "{name}: {}", String::from_utf8_lossy(&score.stdout));
    }
}

/// Runs `fourdbody export` in a directory whose group is inherited, with this umask; mode and group of what it wrote.
fn modes_under(umask: &str, group: u32) -> Vec<(String, u32, u32)> {
    let dir = tempfile::tempdir().expect("a temporary directory");
    crate::export::reconstruction(&dir.path().join("walk"), &[1]);
    let results = dir.path().join("results");
    std::fs::create_dir(&results).expect("writable");
    std::os::unix::fs::chown(&results, None, Some(group)).expect("mine, or as root");
    std::fs::set_permissions(&results, PermissionsExt::from_mode(0o2750)).expect("mine");
    let command = format!("umask {umask}; exec {FOURDBODY} export walk --to xyz --out results/walk");
    let output = Command::new("sh").current_dir(dir.path()).args(["-c", &command]).output().expect("sh");
    assert!(output.status.success(), "{}", text_of(&output));
    // Recordings are made with modes of their own.
    let recording = results.join("session/node-a");
    crate::recording::record(&recording, crate::recording::header("a", &["h0_up"], Some(3)), 3, &[]);
    let mut found = Vec::new();
    let mut folders = vec![results];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).expect("there") {
            let path = entry.expect("an entry").path();
            let data = std::fs::metadata(&path).expect("there");
            found.push((path.display().to_string(), data.mode() & 0o7777, data.gid()));
            folders.extend(data.is_dir().then_some(path));
        }
    }
    assert!(found.len() >= 5, "{found:?}");
    found
}

/// The guide to administration shares sessions and results with a group: the service's umask lets it read, another one
/// lets it write beside results, and nobody else ever gets in.
#[test]
fn what_the_service_writes_is_for_its_group_and_nobody_else() {
    let own = std::fs::metadata(tempfile::tempdir().expect("a temporary directory").path()).expect("there");
    // Only root may give files to a group that it is not in.
    let group = if own.uid() == 0 { 54_321 } else { own.gid() };
    for unit in ["fourdbody-node.service", "fourdbody-worker.service"] {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("systemd").join(unit);
        let text = std::fs::read_to_string(path).expect("in the repository");
        let umask = text.lines().find_map(|line| line.strip_prefix("UMask=")).expect("a umask");
        for (path, mode, owner) in modes_under(umask, group) {
            assert_eq!(owner, group, "{path}");
            let expected = if mode & 0o2000 == 0 { 0o640 } else { 0o2750 };
            assert_eq!(mode, expected, "{path}: {mode:o}");
        }
    }
    let shared = modes_under("0007", group);
    let of_results = shared.iter().filter(|(path, ..)| !path.contains("/session"));
    for (path, mode, _) in of_results {
        assert!([0o660, 0o2770].contains(mode), "{path}: {mode:o}");
    }
}

/// A rule for the HSU's line also says who else shall leave it alone.
#[test]
fn whoever_tries_every_serial_port_leaves_the_hsu_alone() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("systemd/60-fourdbody.rules");
    let text = std::fs::read_to_string(path).expect("the rules");
    let named: Vec<&str> = text.lines().filter(|line| line.contains("SYMLINK+=\"fourdbody-hsu\"")).collect();
    assert_eq!(named.len(), 1);
    assert!(named[0].contains("ENV{ID_MM_DEVICE_IGNORE}=\"1\""), "{named:?}");
}
