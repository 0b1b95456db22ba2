// SPDX-License-Identifier: MIT OR Apache-2.0
//! A session where everybody must show who they are: the operator to the nodes, the nodes to each other. The audit logs
//! say afterwards who did what, and at which trigger.

use crate::api_node::{new_token, start_with_own_tokens};
use crate::lab::{
    NodeProcess, fourdbody, laboratory, options, small_rig, start_laboratory, start_nodes, text_of,
};
use fourdbody::api::AuditLine;
use fourdbody::control::client::{Credentials, NodeClient};
use fourdbody::control::status::path;
use fourdbody_simulator::laboratory::LaboratoryOptions;
use serde_json::{Value, json};
use std::io::Write;
use std::net::TcpStream;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

fn audit(dir: &Path, node: &str) -> Vec<AuditLine> {
    let text = std::fs::read_to_string(dir.join(format!("audit-{node}.jsonl"))).unwrap_or_default();
    text.lines().map(|line| serde_json::from_str(line).expect("a line of JSON")).collect()
}

#[test]
fn everybody_shows_who_they_are_and_the_logs_say_who_did_what() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = laboratory(dir.path(), 20.0);
    for (name, role) in [("otto", "operate"), ("node", "peer")] {
        new_token(dir.path(), name, role, false);
    }
    let mut nodes = Vec::new();
    for file in &laboratory.nodes {
        let text = std::fs::read_to_string(&file.path).expect("readable");
        let socket = dir.path().join(format!("{}.sock", file.node));
        let closed = format!("[api]\ntokens = \"tokens\"\nsocket = \"{}\"\n", socket.display());
        let text = text.replacen("[api]\n", &closed, 1);
        let text = text.replace("[[api.peers]]\n", "[[api.peers]]\ntoken_file = \"node.token\"\n");
        std::fs::write(&file.path, text).expect("writable");
        let mut node = NodeProcess::start(&file.path, file.port);
        node.client = NodeClient::new(&format!("unix:{}", socket.display()));
        nodes.push(node);
    }
    nodes.iter_mut().for_each(|node| drop(node.wait_ready()));

    let urls = laboratory.urls();
    let token = dir.path().join("otto.token").display().to_string();
    let args = ["capture", "--nodes", &urls, "--triggers", "10", "--name", "by-command"];
    let refused = fourdbody(&args);
    assert_eq!(refused.status.code(), Some(2), "{}", text_of(&refused));
    assert!(text_of(&refused).contains("Bearer"), "{}", text_of(&refused));
    let output = fourdbody(&[&args[..], &["--token-file", &token]].concat());
    assert_eq!(output.status.code(), Some(0), "{}", text_of(&output));
    for node in ["a", "b"] {
        let lines = audit(dir.path(), node);
        let prepared = lines.iter().find(|line| line.what.ends_with("/session/prepare")).expect("in the log");
        assert_eq!((prepared.who.as_str(), prepared.status), ("otto", 204));
        assert_eq!(prepared.session.as_deref(), Some("by-command"));
    }

    // A node on behalf of an operator: to the other one it shows that it is a node.
    let credentials = Credentials { token_file: Some(dir.path().join("otto.token")), ca: None };
    let otto = NodeClient::with(&format!("http://127.0.0.1:{}", laboratory.nodes[0].port), &credentials);
    let otto = otto.expect("a client");
    let wish = json!({ "wish": { "triggers": 0, "name": "by-node" }, "takes": 1, "pause_s": 0 });
    otto.post(path::CAPTURE, &wish, Duration::from_secs(20)).expect("begun");
    nodes[0].wait_until("a few triggers", |status| {
        status.session.as_ref().is_some_and(|s| s.name == "by-node" && s.triggers > 5)
    });
    otto.post(path::CAPTURE_STOP, &json!({}), Duration::from_secs(20)).expect("told");
    let deadline = Instant::now() + Duration::from_secs(60);
    let ended = loop {
        let capture: Value = otto.get(path::CAPTURE).expect("the capture");
        if capture["running"] == false {
            break capture;
        }
        assert!(Instant::now() < deadline, "{capture}");
        std::thread::sleep(Duration::from_millis(100));
    };
    assert_eq!(ended["takes"][0]["verdict"], "complete", "{ended}");
    let lines = audit(dir.path(), "a");
    let stopped = lines.iter().find(|line| line.what.ends_with(path::CAPTURE_STOP)).expect("in the log");
    assert_eq!((stopped.who.as_str(), stopped.session.as_deref()), ("otto", Some("by-node")));
    assert!(stopped.trigger.is_some_and(|trigger| trigger > 5), "{stopped:?}");
    let lines = audit(dir.path(), "b");
    let by_node = lines.iter().find(|line| line.session.as_deref() == Some("by-node")).expect("in the log");
    assert_eq!(
        (by_node.who.as_str(), by_node.role.map(|role| role.to_string())),
        ("node", Some("peer".to_owned()))
    );
    let asked = lines.iter().find(|line| line.what.ends_with("/session/prepare") && line.who == "node");
    let request = asked.and_then(|line| line.request.as_ref()).expect("in the log");
    assert_eq!(request["on_behalf_of"], "otto", "{request}");
}

/// What a hostile client does for as long as it is let.
fn pester(port: u16, kind: usize) -> std::io::Result<()> {
    let mut stream = TcpStream::connect(("127.0.0.1", port))?;
    stream.set_read_timeout(Some(Duration::from_millis(200)))?;
    let head = |line: &str| format!("{line} HTTP/1.1\r\nhost: 127.0.0.1:{port}\r\n");
    match kind {
        // Many requests, whose answers nobody reads.
        0 => (0..200).try_for_each(|_| stream.write_all((head("GET /api/v1/metrics") + "\r\n").as_bytes())),
        // A body that is too large.
        1 => {
            stream.write_all((head("POST /api/v1/capture") + "content-length: 60000\r\n\r\n").as_bytes())?;
            stream.write_all(&[b'x'; 60_000])
        }
        // A connection that says nothing.
        2 => std::io::Read::read(&mut stream, &mut [0; 1]).map(drop),
        _ => stream.write_all(&[0xff; 4096]),
    }
}

#[test]
fn a_hostile_client_costs_the_recording_nothing() {
    const TRIGGERS: u64 = 120;
    let dir = tempfile::tempdir().expect("a temporary directory");
    // From one address everybody is one client: the nodes do not watch each other, the operator uses the sockets.
    let options = options(small_rig(30.0), dir.path());
    let laboratory = start_laboratory(&LaboratoryOptions { peers: false, ..options });
    let mut urls = Vec::new();
    for file in &laboratory.nodes {
        let socket = dir.path().join(format!("{}.sock", file.node)).display().to_string();
        let text = std::fs::read_to_string(&file.path).expect("readable");
        let text = text.replacen("[api]\n", &format!("[api]\nsocket = \"{socket}\"\n"), 1);
        std::fs::write(&file.path, text).expect("writable");
        urls.push(format!("unix:{socket}"));
    }
    let mut nodes = start_nodes(&laboratory);
    let urls = urls.join(",");
    let over = AtomicBool::new(false);
    let port = laboratory.nodes[0].port;
    let (output, attempts) = std::thread::scope(|scope| {
        let hostile = |kind| {
            let over = &over;
            scope.spawn(move || {
                let mut attempts = 0u64;
                while !over.load(Ordering::Relaxed) {
                    // Being refused is what is expected.
                    let _ = pester(port, kind);
                    attempts += 1;
                }
                attempts
            })
        };
        let pests: Vec<_> = (0..4).map(hostile).collect();
        let triggers = TRIGGERS.to_string();
        let args = ["capture", "--nodes", &urls, "--triggers", &triggers, "--name", "pestered"];
        let output = fourdbody(&args);
        over.store(true, Ordering::Relaxed);
        let attempts: u64 = pests.into_iter().map(|pest| pest.join().expect("no panic")).sum();
        (output, attempts)
    });
    assert_eq!(output.status.code(), Some(0), "{}", text_of(&output));
    assert!(attempts > 100, "{attempts} attempts are no attack");
    // By and by its connections end.
    nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
    assert!(!nodes[0].log().contains("panicked"));
}

/// Each node has a list of its own: one token opens one of them, a token for each opens both.
#[test]
fn a_capture_shows_each_node_its_own_token() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = laboratory(dir.path(), 20.0);
    let (_nodes, tokens) = start_with_own_tokens(&laboratory, dir.path());
    let urls = laboratory.urls();
    let capture = |files: &str| {
        fourdbody(&["capture", "--nodes", &urls, "--triggers", "6", "--name", "own", "--token-file", files])
    };
    let (first, _) = tokens.split_once(',').expect("two files");
    let one = capture(first);
    assert_ne!(one.status.code(), Some(0), "{}", text_of(&one));
    let three = capture(&format!("{tokens},{first}"));
    assert_eq!(three.status.code(), Some(2), "{}", text_of(&three));
    assert!(text_of(&three).contains("3 token files for 2 nodes"), "{}", text_of(&three));
    let each = capture(&tokens);
    assert_eq!(each.status.code(), Some(0), "{}", text_of(&each));
}
