// SPDX-License-Identifier: MIT OR Apache-2.0
//! The node as a service: what systemd is told, and what it makes of the unit.

use crate::lab::{FOURDBODY, laboratory};
use std::os::unix::net::UnixDatagram;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// A node that believes that a service manager has started it.
struct Service {
    child: Child,
    socket: UnixDatagram,
    told: Vec<String>,
}

impl Service {
    fn start(config: &Path, dir: &Path) -> Self {
        let path = dir.join("notify");
        let socket = UnixDatagram::bind(&path).expect("a socket");
        socket.set_read_timeout(Some(Duration::from_millis(200))).expect("a socket");
        let log = std::fs::File::create(dir.join("service.log")).expect("a log file");
        let child = Command::new(FOURDBODY)
            .args(["node", "--config"])
            .arg(config)
            .env("NOTIFY_SOCKET", &path)
            .env("WATCHDOG_USEC", "2000000")
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(log)
            .spawn()
            .expect("the binary starts");
        Self { child, socket, told: Vec::new() }
    }

    /// Reads on until somebody said this; how many lines so far say it.
    fn wait(&mut self, what: &str) -> usize {
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

    fn signal(&self, name: &str) {
        let sent = Command::new("kill").args([name, &self.child.id().to_string()]).status();
        assert!(sent.is_ok_and(|status| status.success()));
    }
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
fn unit(dir: &Path, name: &str) -> std::path::PathBuf {
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

/// A rule for the HSU's line also says who else shall leave it alone.
#[test]
fn whoever_tries_every_serial_port_leaves_the_hsu_alone() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("systemd/60-fourdbody.rules");
    let text = std::fs::read_to_string(path).expect("the rules");
    let named: Vec<&str> = text.lines().filter(|line| line.contains("SYMLINK+=\"fourdbody-hsu\"")).collect();
    assert_eq!(named.len(), 1);
    assert!(named[0].contains("ENV{ID_MM_DEVICE_IGNORE}=\"1\""), "{named:?}");
}
