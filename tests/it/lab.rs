//! A simulated laboratory with real node processes, for tests of the whole chain.

use fourdbody::api::client::NodeClient;
use fourdbody::api::dto::NodeStatus;
use fourdbody::config::SocketMode;
use fourdbody_simulator::gige::TestImages;
use fourdbody_simulator::laboratory::{Laboratory, LaboratoryOptions};
use std::net::Ipv4Addr;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// The product's binary.
pub const FOURDBODY: &str = env!("CARGO_BIN_EXE_fourdbody");

/// Columns and rows of the test images: small, so that eight cameras fit on two busy cores.
pub const SIZE: (usize, usize) = (320, 200);

/// The shipped rig with small sensors and this trigger rate.
pub fn small_rig(rate_hz: f64) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/rig.toml");
    let text = std::fs::read_to_string(path).expect("config/rig.toml is in the repository");
    text.replace("trigger_rate_hz = 120.0", &format!("trigger_rate_hz = {rate_hz:?}"))
        .replace("width = 1920", &format!("width = {}", SIZE.0))
        .replace("height = 1200", &format!("height = {}", SIZE.1))
        .replace("focal_px = 2048.0", "focal_px = 341.0")
}

/// A laboratory whose cameras send [`TestImages`]; every test takes its own `subnet` of 127.0.0.0/16.
pub fn laboratory(dir: &Path, subnet: u8, rate_hz: f64) -> Laboratory {
    let mut options = LaboratoryOptions::new(small_rig(rate_hz), dir);
    options.first_address = Ipv4Addr::new(127, 0, subnet, 11);
    options.first_port = 0;
    options.reserve_mib = 1;
    start_laboratory(&options)
}

/// Starts a laboratory with options of the test's own.
pub fn start_laboratory(options: &LaboratoryOptions) -> Laboratory {
    // A packet socket sees the traffic of other tests on this host for a moment after it is made.
    let options = &LaboratoryOptions { socket: SocketMode::Standard, ..options.clone() };
    let mut number = 0;
    let images = |_: &_| {
        number += 1;
        Arc::new(TestImages::new(SIZE.0, SIZE.1, number, TestImages::DISTINCT)) as _
    };
    Laboratory::start(options, images).expect("the laboratory starts")
}

/// A node's process; killed when dropped.
pub struct NodeProcess {
    child: Child,
    /// Its API.
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

    /// Waits until it is in no session.
    pub fn wait_idle(&mut self) -> NodeStatus {
        self.wait_until("idle", |status| status.phase == fourdbody::session::state::Phase::Idle)
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

    /// The process's id.
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

/// Runs the product's binary.
pub fn fourdbody(args: &[&str]) -> Output {
    Command::new(FOURDBODY).args(args).stdin(Stdio::null()).output().expect("the binary starts")
}

/// Standard output and standard error, for messages of failed assertions.
pub fn text_of(output: &Output) -> String {
    format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
}
