// SPDX-License-Identifier: MIT OR Apache-2.0
//! A simulated laboratory with real node processes, for tests of the whole chain.

use fourdbody::base::ids::TriggerIndex;
use fourdbody::config::SocketMode;
use fourdbody::control::client::NodeClient;
use fourdbody::control::request::Phase;
use fourdbody::control::status::NodeStatus;
use fourdbody::data::FrameSource;
use fourdbody::record::{GapCause, SessionReader};
use fourdbody_simulator::gige::TestImages;
use fourdbody_simulator::laboratory::{Laboratory, LaboratoryOptions};
use std::net::{Ipv4Addr, UdpSocket};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// The path of the program under test.
pub const FOURDBODY: &str = env!("CARGO_BIN_EXE_fourdbody");

/// Columns and rows of the test images: small, so that eight cameras fit on two busy cores.
pub const SIZE: (usize, usize) = (320, 200);

/// The shipped rig with small sensors and this trigger rate.
pub fn small_rig(rate_hz: f64) -> String {
    rig_of(rate_hz, SIZE)
}

/// The shipped rig with sensors of this size.
pub fn rig_of(rate_hz: f64, (width, height): (usize, usize)) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/rig.toml");
    let text = std::fs::read_to_string(path).expect("config/rig.toml is in the repository");
    text.replace("trigger_rate_hz = 120.0", &format!("trigger_rate_hz = {rate_hz:?}"))
        .replace("width = 1920", &format!("width = {width}"))
        .replace("height = 1200", &format!("height = {height}"))
        .replace("focal_px = 2048.0", &format!("focal_px = {:?}", (2048 * width / 1920) as f64))
}

/// The address 1 of a network 127.0.N.0/24 that belongs to the caller alone for as long as this process runs: tests run
/// beside each other, in several processes. A socket on a port that nobody else needs holds the network.
pub fn own_network() -> Ipv4Addr {
    static NEXT: AtomicU8 = AtomicU8::new(20);
    static HELD: Mutex<Vec<UdpSocket>> = Mutex::new(Vec::new());
    const LOCK_PORT: u16 = 3955;
    loop {
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        assert!(number < u8::MAX, "expected fewer laboratories in one process than networks of 127.0.0.0/16");
        if let Ok(socket) = UdpSocket::bind((Ipv4Addr::new(127, 0, number, 250), LOCK_PORT)) {
            HELD.lock().unwrap_or_else(PoisonError::into_inner).push(socket);
            return Ipv4Addr::new(127, 0, number, 1);
        }
    }
}

/// Another address of the same network.
pub fn host(network: Ipv4Addr, number: u8) -> Ipv4Addr {
    let [a, b, c, _] = network.octets();
    Ipv4Addr::new(a, b, c, number)
}

/// A laboratory below `dir`, in a network of its own.
pub fn options(rig_text: String, dir: &Path) -> LaboratoryOptions {
    LaboratoryOptions {
        first_address: host(own_network(), 11),
        first_port: 0,
        reserve_mib: 1,
        ..LaboratoryOptions::new(rig_text, dir)
    }
}

/// A laboratory whose cameras send [`TestImages`].
pub fn laboratory(dir: &Path, rate_hz: f64) -> Laboratory {
    start_laboratory(&options(small_rig(rate_hz), dir))
}

/// A laboratory with sensors of this size, whose block ids begin at `first_block_id`.
pub fn laboratory_of(dir: &Path, rate_hz: f64, size: (usize, usize), first_block_id: u64) -> Laboratory {
    let options = options(rig_of(rate_hz, size), dir);
    start(&LaboratoryOptions { first_block_id, ..options }, size)
}

/// Starts a laboratory with options of the test's own.
pub fn start_laboratory(options: &LaboratoryOptions) -> Laboratory {
    start(options, SIZE)
}

/// Starts a laboratory whose sensors have this size.
pub fn start(options: &LaboratoryOptions, size: (usize, usize)) -> Laboratory {
    // A packet socket sees the traffic of other tests on this host for a moment after it is made.
    let options = &LaboratoryOptions { socket: SocketMode::Standard, ..options.clone() };
    let mut number = 0;
    let images = |_: &_| {
        number += 1;
        Arc::new(TestImages::new(size.0, size.1, number, TestImages::DISTINCT)) as _
    };
    Laboratory::start(options, images).expect("the laboratory starts")
}

/// What only a host that is too busy makes of a frame.
pub fn is_by_host(cause: &GapCause) -> bool {
    [GapCause::IdentityMismatch, GapCause::Timeout, GapCause::NodePaused].contains(cause)
}

/// Captures a session that has to be whole, of this many triggers. Where all that it lacks was given up by name because
/// this host was too busy, it is captured again: twice at most.
pub fn capture_whole(laboratory: &Laboratory, name: &str, triggers: u64, more: &[&str]) -> Output {
    let (urls, triggers) = (laboratory.urls(), triggers.to_string());
    let args = ["capture", "--nodes", &urls, "--triggers", &triggers, "--name", name];
    let capture = || fourdbody(&[&args, more].concat());
    let session = laboratory.nodes[0].path.with_file_name("sessions").join(name);
    for _ in 0..2 {
        let captured = capture();
        if captured.status.code() != Some(3) || !all_by_host(&session) {
            return captured;
        }
        println!("this host is busy; captured again: {}", text_of(&captured));
        std::fs::remove_dir_all(&session).expect("removable");
        for node in &laboratory.nodes {
            let client = NodeClient::new(&format!("127.0.0.1:{}", node.port));
            let deadline = Instant::now() + Duration::from_secs(60);
            while client.status().is_ok_and(|status| status.phase != Phase::Idle) && Instant::now() < deadline
            {
                std::thread::sleep(Duration::from_millis(20));
            }
        }
    }
    capture()
}

/// Whether a busy host explains all that a session lacks.
fn all_by_host(session: &Path) -> bool {
    let Ok(reader) = SessionReader::open(session) else { return false };
    let mut causes = Vec::new();
    for camera in reader.cameras() {
        let outcomes = reader.triggers().map(|trigger| reader.recorded_frame(camera, TriggerIndex(trigger)));
        causes.extend(outcomes.filter_map(|outcome| outcome.ok()?.err()));
    }
    !causes.is_empty() && causes.iter().all(is_by_host)
}

/// What a laboratory's node file says of each of the simulator's own cameras.
pub const WORDS: &str = "trigger_line = \"Line0\"\n";

/// Has a node file say something of a camera, after its address.
pub fn say(file: &Path, camera: &str, words: &str) {
    let text = std::fs::read_to_string(file).expect("a node file");
    let (before, after) = text.split_once(&format!("id = \"{camera}\"\n")).expect("the camera");
    let (address, after) = after.split_once('\n').expect("its address");
    // What is said anew is not said twice.
    let key = words.split(' ').next().unwrap_or_default();
    let after: Vec<&str> = match after.split_once("[[camera]]") {
        Some((own, others)) => vec![own, "[[camera]]", others],
        None => vec![after],
    };
    let own: String =
        after[0].lines().filter(|line| !line.starts_with(key)).map(|line| format!("{line}\n")).collect();
    let rest: String = after[1..].concat();
    let text = format!("{before}id = \"{camera}\"\n{address}\n{words}\n{own}{rest}");
    std::fs::write(file, text).expect("writable");
}

/// Laboratories that need two processors for themselves take turns: at once, each finds the other's time missing.
pub fn turn() -> MutexGuard<'static, ()> {
    static TURN: Mutex<()> = Mutex::new(());
    TURN.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A node's process; killed when dropped.
pub struct NodeProcess {
    child: Child,
    /// A client of the node's API.
    pub client: NodeClient,
    log: PathBuf,
}

impl NodeProcess {
    /// Starts `fourdbody node` with this file.
    pub fn start(config: &Path, port: u16) -> Self {
        let log = config.with_extension("log");
        let file = std::fs::File::create(&log).expect("a log file");
        let child = Command::new(FOURDBODY)
            .args(["node", "--config"])
            .arg(config)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(file)
            .spawn()
            .expect("the binary starts");
        Self { child, client: NodeClient::new(&format!("127.0.0.1:{port}")), log }
    }

    /// Waits until the node says that this holds; panics with its log after half a minute.
    pub fn wait_until(&mut self, what: &str, holds: impl Fn(&NodeStatus) -> bool) -> NodeStatus {
        let deadline = Instant::now() + Duration::from_secs(60);
        loop {
            let status = self.client.status();
            if let Ok(status) = &status
                && holds(status)
            {
                return status.clone();
            }
            if Instant::now() > deadline || self.child.try_wait().expect("a child").is_some() {
                let log = std::fs::read_to_string(&self.log).unwrap_or_default();
                panic!("node never reached {what:?}; last status {status:#?}; log:\n{log}");
            }
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// Waits until all devices are usable.
    pub fn wait_ready(&mut self) -> NodeStatus {
        self.wait_until("all devices usable", |status| {
            status.hsu.problem.is_none() && status.cameras.iter().all(|camera| camera.problem.is_none())
        })
    }

    /// Waits until it is in no session; a preview is none.
    pub fn wait_idle(&mut self) -> NodeStatus {
        self.wait_until("idle", NodeStatus::is_free)
    }

    /// Kills it at once, as a crash would.
    pub fn kill(&mut self) {
        self.child.kill().expect("a child");
        self.child.wait().expect("a child");
    }

    /// What it has logged so far.
    pub fn log(&self) -> String {
        std::fs::read_to_string(&self.log).unwrap_or_default()
    }

    /// Waits until the process has ended by itself, orderly.
    pub fn wait_exit(&mut self) {
        let deadline = Instant::now() + Duration::from_secs(30);
        loop {
            if let Some(status) = self.child.try_wait().expect("a child") {
                let log = std::fs::read_to_string(&self.log).unwrap_or_default();
                return assert!(status.success(), "{status}; log:\n{log}");
            }
            assert!(Instant::now() < deadline, "the node did not end");
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// The process id of the node.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }
}

impl Drop for NodeProcess {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// One process per node of the laboratory, all devices usable.
pub fn start_nodes(laboratory: &Laboratory) -> Vec<NodeProcess> {
    let start = |node: &fourdbody_simulator::laboratory::NodeFile| NodeProcess::start(&node.path, node.port);
    let mut nodes: Vec<NodeProcess> = laboratory.nodes.iter().map(start).collect();
    nodes.iter_mut().for_each(|node| drop(node.wait_ready()));
    nodes
}

/// Runs the program under test and waits for its end.
pub fn fourdbody(args: &[&str]) -> Output {
    Command::new(FOURDBODY).args(args).stdin(Stdio::null()).output().expect("the binary starts")
}

/// A capture that runs until it is stopped.
pub fn start_capture(laboratory: &Laboratory, name: &str) -> Child {
    Command::new(FOURDBODY)
        .args(["capture", "--nodes", &laboratory.urls(), "--triggers", "0", "--name", name])
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("the binary starts")
}

/// Every one of these must be in the text.
pub fn assert_contains(text: &str, expected: &[&str]) {
    expected.iter().for_each(|part| assert!(text.contains(part), "{part:?} missing in\n{text}"));
}

/// Standard output and standard error, for messages of failed assertions.
pub fn text_of(output: &Output) -> String {
    format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
}
