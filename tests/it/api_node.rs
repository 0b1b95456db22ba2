// SPDX-License-Identifier: MIT OR Apache-2.0
//! A node's process without devices, for tests of its API alone; and a client that says whatever a test wants.

use crate::lab::{FOURDBODY, NodeProcess, fourdbody, small_rig, text_of};
use fourdbody::api::AuditLine;
use fourdbody::control::client::{Credentials, NodeClient};
use fourdbody_simulator::laboratory::Laboratory;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// Who has a token of the node, and which.
pub const BEARERS: [(&str, &str); 4] =
    [("vera", "view"), ("otto", "operate"), ("ada", "admin"), ("node-b", "peer")];

/// A running node; killed when dropped.
pub struct ApiNode {
    pub dir: tempfile::TempDir,
    pub port: u16,
    child: Child,
}

/// Status, headers and body of a node's answer.
#[derive(Debug)]
pub struct Reply {
    pub status: u16,
    pub head: String,
    pub body: String,
}

impl Reply {
    /// The value of a header, by its name.
    pub fn header(&self, name: &str) -> Option<&str> {
        let lines = self.head.lines().filter_map(|line| line.split_once(": "));
        lines.into_iter().find(|(found, _)| found.eq_ignore_ascii_case(name)).map(|(_, value)| value)
    }
}

impl ApiNode {
    /// The usual one: tokens for [`BEARERS`], a socket, TCP on a loopback address.
    pub fn start() -> Self {
        Self::start_with("listen = \"127.0.0.1:PORT\"\nsocket = \"node.sock\"\ntokens = \"tokens\"\n")
    }

    /// With this `[api]` section; `PORT` in it is a free port.
    pub fn start_with(api: &str) -> Self {
        let dir = tempfile::tempdir().expect("a temporary directory");
        for (name, role) in BEARERS {
            new_token(dir.path(), name, role, false);
        }
        Self::start_in(dir, api)
    }

    /// In a directory that has files already.
    pub fn start_in(dir: tempfile::TempDir, api: &str) -> Self {
        let port = free_port();
        let config = write_config(dir.path(), &api.replace("PORT", &port.to_string()));
        let mut node = Self { child: spawn(&config), dir, port };
        node.wait();
        node
    }

    /// Starts it again after [`Self::kill`].
    pub fn restart(&mut self) {
        self.child = spawn(&self.dir.path().join("node.toml"));
        self.wait();
    }

    fn wait(&mut self) {
        let deadline = Instant::now() + Duration::from_secs(60);
        while !self.log().contains("node is up") {
            let ended = self.child.try_wait().expect("a child");
            assert!(ended.is_none() && Instant::now() < deadline, "{ended:?}\n{}", self.log());
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    pub fn kill(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }

    pub fn log(&self) -> String {
        std::fs::read_to_string(self.dir.path().join("node.log")).unwrap_or_default()
    }

    /// A file of the node.
    pub fn file(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    /// The secret of a token.
    pub fn secret(&self, name: &str) -> String {
        std::fs::read_to_string(self.file(&format!("{name}.token"))).expect("written").trim().to_owned()
    }

    /// A client that shows somebody's token.
    pub fn client(&self, name: &str) -> NodeClient {
        let token_file = Some(self.file(&format!("{name}.token")));
        let url = format!("http://127.0.0.1:{}", self.port);
        NodeClient::with(&url, &Credentials { token_file, ca: None }).expect("a client")
    }

    /// A client over the Unix socket.
    pub fn local(&self) -> NodeClient {
        NodeClient::new(&format!("unix:{}", self.file("node.sock").display()))
    }

    /// Sends a request with somebody's token and these further header lines.
    pub fn send(&self, who: Option<&str>, line: &str, headers: &[&str], body: &str) -> Reply {
        let mut text = format!("{line} HTTP/1.1\r\nhost: 127.0.0.1:{}\r\nconnection: close\r\n", self.port);
        if let Some(who) = who {
            text += &format!("authorization: Bearer {}\r\n", self.secret(who));
        }
        if !body.is_empty() {
            text += &format!("content-type: application/json\r\ncontent-length: {}\r\n", body.len());
        }
        headers.iter().for_each(|header| text += &format!("{header}\r\n"));
        self.say(format!("{text}\r\n{body}").as_bytes()).expect("an answer")
    }

    /// Sends these bytes over TCP; `None` when nothing that is an answer comes back.
    pub fn say(&self, bytes: &[u8]) -> Option<Reply> {
        let mut stream = self.connect();
        // A node that has heard enough closes while more is sent.
        let _ = stream.write_all(bytes);
        listen(stream)
    }

    pub fn connect(&self) -> TcpStream {
        let stream = TcpStream::connect(("127.0.0.1", self.port)).expect("the node listens");
        stream.set_read_timeout(Some(Duration::from_secs(30))).expect("a socket");
        stream
    }

    /// Sends a request over the Unix socket.
    pub fn send_local(&self, line: &str, headers: &[&str]) -> Reply {
        let mut stream = UnixStream::connect(self.file("node.sock")).expect("the node listens");
        let mut text = format!("{line} HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n");
        headers.iter().for_each(|header| text += &format!("{header}\r\n"));
        stream.write_all(format!("{text}\r\n").as_bytes()).expect("sent");
        listen(stream).expect("an answer")
    }

    /// The audit log so far.
    pub fn audit(&self) -> Vec<AuditLine> {
        let text = std::fs::read_to_string(self.file("sessions/audit.jsonl")).unwrap_or_default();
        text.lines().map(|line| serde_json::from_str(line).expect("a line of JSON")).collect()
    }

    /// Nothing was changed by anybody: no session, no directory of one, no line that says that something was done.
    pub fn assert_untouched(&self) {
        let status = self.local().status().expect("alive");
        assert!(status.session.is_none(), "{status:?}");
        let entries = std::fs::read_dir(self.file("sessions")).expect("the audit log is there");
        let names = entries.map(|entry| entry.expect("an entry").file_name().to_string_lossy().into_owned());
        let names: Vec<String> = names.filter(|name| !name.starts_with('.')).collect();
        assert_eq!(names, ["audit.jsonl"]);
        let done: Vec<AuditLine> = self.audit().into_iter().filter(|line| line.status < 400).collect();
        assert!(done.is_empty(), "{done:#?}");
    }
}

impl Drop for ApiNode {
    fn drop(&mut self) {
        self.kill();
    }
}

/// Reads an answer to its end.
pub fn listen(mut stream: impl Read) -> Option<Reply> {
    let mut bytes = Vec::new();
    // Closed in the middle: what came counts.
    let _ = stream.read_to_end(&mut bytes);
    let text = String::from_utf8_lossy(&bytes).into_owned();
    let (head, body) = text.split_once("\r\n\r\n")?;
    let status = head.split(' ').nth(1)?.parse().ok()?;
    Some(Reply { status, head: head.to_owned(), body: body.to_owned() })
}

fn spawn(config: &Path) -> Child {
    let log = std::fs::File::create(config.with_extension("log")).expect("a log file");
    Command::new(FOURDBODY)
        .args(["node", "--config"])
        .arg(config)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(log)
        .spawn()
        .expect("the binary starts")
}

/// The shipped node file with this `[api]` section and no devices at the other end. Where `dir` has results, its worker's.
pub fn write_config(dir: &Path, api: &str) -> PathBuf {
    std::fs::write(dir.join("rig.toml"), small_rig(20.0)).expect("writable");
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/node-a.toml");
    let text = std::fs::read_to_string(shipped).expect("config/node-a.toml is in the repository");
    let mut table: toml::Table = text.parse().expect("TOML");
    table.insert("api".to_owned(), toml::Value::Table(api.parse().expect("a section")));
    table["storage"]["sessions_dir"] = "sessions".into();
    table["storage"]["reserve_mib"] = 1.into();
    table["hsu"]["device"] = "no-hsu".into();
    if dir.join("results").is_dir() {
        let worker = toml::Table::from_iter([("results".to_owned(), "results".into())]);
        table.insert("worker".to_owned(), worker.into());
    }
    for (i, camera) in table["camera"].as_array_mut().expect("cameras").iter_mut().enumerate() {
        camera["address"] = format!("127.0.99.{}", i + 1).into();
    }
    let path = dir.join("node.toml");
    std::fs::write(&path, table.to_string()).expect("writable");
    path
}

/// Runs `fourdbody token new` for this name and role.
pub fn new_token(dir: &Path, name: &str, role: &str, replace: bool) {
    let (tokens, file) = (dir.join("tokens"), dir.join(format!("{name}.token")));
    let (tokens, file) = (tokens.display().to_string(), file.display().to_string());
    let mut args = vec!["token", "new", "--tokens", &tokens, "--name", name, "--role", role, "--file", &file];
    args.extend(replace.then_some("--replace"));
    let output = fourdbody(&args);
    assert!(output.status.success(), "{}", text_of(&output));
}

/// Gives each node a list of its own, with one operator (`NODE/otto.token`) and the other node, and starts
/// them. The files of the operator's tokens, in the nodes' order, as `--token-file` takes them.
pub fn start_with_own_tokens(laboratory: &Laboratory, dir: &Path) -> (Vec<NodeProcess>, String) {
    let of = |node: &str| dir.join(node).join("otto.token");
    for node in ["a", "b"] {
        std::fs::create_dir(dir.join(node)).expect("writable");
        new_token(&dir.join(node), "otto", "operate", false);
        new_token(&dir.join(node), "peer", "peer", false);
    }
    let mut nodes = Vec::new();
    for (file, other) in laboratory.nodes.iter().zip(["b", "a"]) {
        let text = std::fs::read_to_string(&file.path).expect("written");
        let text = text.replacen("[api]\n", &format!("[api]\ntokens = \"{}/tokens\"\n", file.node), 1);
        let peer = format!("[[api.peers]]\ntoken_file = \"{other}/peer.token\"\n");
        std::fs::write(&file.path, text.replace("[[api.peers]]\n", &peer)).expect("writable");
        let mut node = NodeProcess::start(&file.path, file.port);
        let credentials = Credentials { token_file: Some(of(file.node.as_str())), ca: None };
        let url = format!("http://127.0.0.1:{}", file.port);
        node.client = NodeClient::with(&url, &credentials).expect("a client");
        nodes.push(node);
    }
    nodes.iter_mut().for_each(|node| drop(node.wait_ready()));
    let files: Vec<String> =
        laboratory.nodes.iter().map(|n| of(n.node.as_str()).display().to_string()).collect();
    (nodes, files.join(","))
}

fn free_port() -> u16 {
    let listener = std::net::TcpListener::bind("127.0.0.1:0").expect("a free port");
    listener.local_addr().expect("bound").port()
}
