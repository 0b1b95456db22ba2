// SPDX-License-Identifier: MIT OR Apache-2.0
//! The written list of requests that a node must refuse (docs/design/api.md), against the real binary.

use crate::api_node::{ApiNode, listen, new_token, write_config};
use crate::lab::{assert_contains, fourdbody, text_of};
use fourdbody::api::limits;
use fourdbody::capture::participant::Participant;
use fourdbody::control::client::{Credentials, NodeClient};
use fourdbody::control::status::Via;
use std::io::Write;
use std::os::unix::fs::{FileTypeExt, MetadataExt, PermissionsExt};
use std::path::Path;
use std::time::{Duration, Instant};

const STATUS: &str = "GET /api/v1/status";
const START: &str = "POST /api/v1/session/start";
const BODY: &str = "{\"session_id\":1}";
const REMARK: &str = r#"{"rating":"good","note":null}"#;

/// A row of the table in docs/design/api.md: its number, the request, the answer.
type Row = (u32, Option<&'static str>, &'static str, &'static [&'static str], &'static str, u16);

/// What can be said in one ordinary request.
const ROWS: &[Row] = &[
    (1, None, STATUS, &[], "", 401),
    (1, None, START, &[], BODY, 401),
    (
        2,
        None,
        STATUS,
        &["authorization: Bearer 0000000000000000000000000000000000000000000000000000000000000000"],
        "",
        401,
    ),
    (2, None, STATUS, &["authorization: Basic b3R0bzpvdHRv"], "", 401),
    (2, None, STATUS, &["authorization: Bearer "], "", 401),
    (
        2,
        None,
        STATUS,
        &["cookie: fourdbody_a=0000000000000000000000000000000000000000000000000000000000000000"],
        "",
        401,
    ),
    (3, Some("vera"), START, &[], BODY, 403),
    (3, Some("vera"), "POST /api/v1/session/prepare", &[], "{}", 403),
    (6, Some("otto"), START, &["origin: https://evil.example"], BODY, 403),
    (6, Some("otto"), START, &["origin: null"], BODY, 403),
    (6, Some("otto"), START, &["origin: http://127.0.0.1:1"], BODY, 403),
    (6, Some("otto"), STATUS, &["origin: https://evil.example"], "", 403),
    (6, Some("otto"), START, &["sec-fetch-site: cross-site"], BODY, 403),
    (6, Some("otto"), STATUS, &["sec-fetch-site: same-site"], "", 403),
    (8, Some("otto"), "GET /api/v1/../../etc/passwd", &[], "", 404),
    (8, Some("otto"), "GET /../../etc/passwd", &[], "", 404),
    (8, Some("otto"), "GET /%2e%2e/%2e%2e/etc/passwd", &[], "", 404),
    (8, Some("otto"), "GET /..%2f..%2fetc%2fpasswd", &[], "", 404),
    (
        9,
        Some("otto"),
        "POST /api/v1/session/prepare",
        &[],
        r#"{"session_id":1,"name":"../../tmp/x","triggers":1,"nodes":["a"],"subject":null,"note":null}"#,
        409,
    ),
    (11, Some("otto"), START, &[], "{\"session_id\":", 400),
    (11, Some("otto"), START, &[], "{\"session_id\":-1}", 400),
    (11, Some("otto"), START, &[], "{\"session_id\":18446744073709551616}", 400),
    (11, Some("otto"), START, &[], "[]", 400),
    (12, Some("otto"), START, &[], "{\"session_id\":1,\"sudo\":true}", 400),
    (
        13,
        Some("otto"),
        "POST /api/v1/session/start",
        &["content-type: text/plain", "content-length: 0"],
        "",
        415,
    ),
    (1, None, "POST /api/v1/sessions/walk/remark", &[], "{}", 401),
    (1, None, "GET /api/v1/sessions/walk/free", &[], "", 401),
    (3, Some("vera"), "POST /api/v1/sessions/walk/remark", &[], "{}", 403),
    (3, Some("vera"), "POST /api/v1/peers/b/sessions/walk/remark", &[], "{}", 403),
    (6, Some("otto"), "POST /api/v1/sessions/walk/remark", &["origin: https://evil.example"], "{}", 403),
    (8, Some("otto"), "POST /api/v1/sessions/..%2f..%2ftmp/remark", &[], REMARK, 404),
    (8, Some("otto"), "POST /api/v1/sessions/%2e%2e/remark", &[], REMARK, 404),
    (8, Some("otto"), "POST /api/v1/peers/b/sessions/..%2f..%2fcapture/remark", &[], REMARK, 404),
    (8, Some("otto"), "POST /api/v1/peers/..%2fb/sessions/walk/remark", &[], REMARK, 404),
    (9, Some("otto"), "GET /api/v1/sessions/..%2f..%2fetc/free", &[], "", 409),
    (9, Some("otto"), "GET /api/v1/sessions/-rf/free", &[], "", 409),
    (
        9,
        Some("otto"),
        "POST /api/v1/sessions/walk/remark",
        &[],
        r#"{"rating":null,"note":"two\nlines"}"#,
        409,
    ),
    (9, Some("otto"), "POST /api/v1/sessions/none/remark", &[], REMARK, 404),
    (11, Some("otto"), "POST /api/v1/sessions/walk/remark", &[], r#"{"rating":"best","note":null}"#, 400),
    (11, Some("otto"), "POST /api/v1/sessions/walk/remark", &[], r#"{"rating":null,"note":7}"#, 400),
    (11, Some("otto"), "POST /api/v1/sessions/walk/remark", &[], r#"{"rating":"good"}"#, 400),
    (11, Some("otto"), "POST /api/v1/sessions/walk/remark", &[], "{}", 400),
    (11, Some("otto"), "POST /api/v1/capture", &[], "{}", 400),
    (11, Some("otto"), "POST /api/v1/capture", &[], r#"{"wish":[]}"#, 400),
    (11, Some("otto"), "POST /api/v1/capture", &[], r#"{"wish":{"start_on":[2]}}"#, 400),
    (
        12,
        Some("otto"),
        "POST /api/v1/sessions/walk/remark",
        &[],
        r#"{"rating":null,"note":null,"stars":5}"#,
        400,
    ),
    (1, None, "POST /api/v1/exposure", &[], "{}", 401),
    (1, None, "GET /api/v1/calibration-lights", &[], "", 401),
    (3, Some("vera"), "POST /api/v1/exposure", &[], r#"{"heads":["h0"],"exposure_us":900}"#, 403),
    (3, Some("vera"), "POST /api/v1/peers/b/exposure", &[], r#"{"heads":["h0"],"exposure_us":900}"#, 403),
    (6, Some("otto"), "POST /api/v1/exposure", &["origin: https://evil.example"], "{}", 403),
    (
        8,
        Some("otto"),
        "POST /api/v1/peers/..%2fb/exposure",
        &[],
        r#"{"heads":["h0"],"exposure_us":900}"#,
        404,
    ),
    (8, Some("otto"), "GET /api/v1/peers/..%2fb/calibration-lights", &[], "", 404),
    (11, Some("otto"), "POST /api/v1/exposure", &[], r#"{"heads":"h0","exposure_us":900}"#, 400),
    (11, Some("otto"), "POST /api/v1/exposure", &[], r#"{"heads":["h0"],"exposure_us":1e999}"#, 400),
    (12, Some("otto"), "POST /api/v1/exposure", &[], r#"{"heads":["h0"],"exposure_us":900,"gamma":2}"#, 400),
    (23, Some("otto"), "POST /api/v1/exposure", &[], r#"{"heads":["../h0"],"exposure_us":900}"#, 409),
    (23, Some("otto"), "POST /api/v1/exposure", &[], r#"{"heads":["h0"],"exposure_us":-1e300}"#, 409),
    (23, Some("otto"), "POST /api/v1/exposure", &[], r#"{"heads":["h0"],"gain_db":1e300}"#, 409),
    (1, None, "GET /api/v1/playable", &[], "", 401),
    (1, None, "GET /api/v1/sessions/walk/frame-sets", &[], "", 401),
    (1, None, "GET /api/v1/sessions/walk/frame-sets/0", &[], "", 401),
    (3, Some("vera"), "POST /api/v1/sessions/walk/frame-sets", &[], "{}", 403),
    (8, Some("otto"), "GET /api/v1/sessions/..%2f..%2fetc/frame-sets", &[], "", 404),
    (8, Some("otto"), "GET /api/v1/sessions/%2e%2e/frame-sets/0", &[], "", 404),
    (8, Some("otto"), "GET /api/v1/peers/b/sessions/..%2f..%2fcapture/frame-sets", &[], "", 404),
    (8, Some("otto"), "GET /api/v1/peers/..%2fb/playable", &[], "", 404),
    (11, Some("otto"), "GET /api/v1/sessions/walk/frame-sets/18446744073709551616", &[], "", 400),
    (16, Some("otto"), "DELETE /api/v1/status", &["content-length: 0"], "", 405),
    (16, Some("otto"), "GET /api/v1/nothing", &[], "", 404),
    (16, None, "GET /api/v1/nothing", &[], "", 401),
];

#[test]
fn what_one_request_can_do_wrong_is_refused() {
    let node = ApiNode::start();
    for (row, who, line, headers, body, expected) in ROWS {
        let reply = node.send(*who, line, headers, body);
        assert_eq!(reply.status, *expected, "row {row}: {line} {headers:?} {body}: {reply:?}");
        assert!(!reply.body.contains("root:"), "{reply:?}");
        // Every refusal says why, in the same words as everywhere.
        let fault: serde_json::Value = serde_json::from_str(&reply.body).expect("a fault");
        assert!(fault["message"].is_string() && fault["exit"].is_u64(), "row {row}: {reply:?}");
        for (name, part) in [
            ("x-content-type-options", "nosniff"),
            ("content-security-policy", "frame-ancestors 'none'"),
            ("cache-control", "no-store"),
        ] {
            assert!(reply.header(name).is_some_and(|value| value.contains(part)), "{name}: {reply:?}");
        }
    }
    node.assert_untouched();
    let refused: Vec<_> = node.audit().into_iter().filter(|line| line.status == 403).collect();
    assert!(refused.iter().any(|line| line.who == "vera" && line.what == START), "{refused:#?}");
}

#[test]
fn requests_for_other_hosts_are_refused() {
    let node = ApiNode::start();
    let secret = node.secret("otto");
    let ask = |target: &str, hosts: &str| {
        let text = format!(
            "GET {target} HTTP/1.1\r\n{hosts}authorization: Bearer {secret}\r\nconnection: close\r\n\r\n"
        );
        node.say(text.as_bytes()).expect("an answer").status
    };
    let port = node.port;
    let ours = format!("host: 127.0.0.1:{port}\r\n");
    assert_eq!(ask("/api/v1/status", &ours), 200);
    assert_eq!(ask("/api/v1/status", &format!("host: localhost:{port}\r\n")), 200);
    for hosts in [
        "host: evil.example\r\n".to_owned(),
        format!("host: evil.example:{port}\r\n"),
        format!("host: 127.0.0.1.evil.example:{port}\r\n"),
        "host: 127.0.0.1:1\r\n".to_owned(),
        "host: \r\n".to_owned(),
        format!("{ours}host: evil.example\r\n"),
    ] {
        assert_eq!(ask("/api/v1/status", &hosts), 421, "{hosts:?}");
    }
    // Without any, and with another one in the first line.
    assert!(matches!(ask("/api/v1/status", ""), 400 | 421));
    assert_eq!(ask("http://evil.example/api/v1/status", &ours), 421);
}

#[test]
fn bodies_and_heads_are_bounded() {
    let node = ApiNode::start();
    let secret = node.secret("otto");
    let head = |more: &str| {
        format!(
            "{START} HTTP/1.1\r\nhost: 127.0.0.1:{}\r\nconnection: close\r\ncontent-type: application/json\r\nauthorization: Bearer {secret}\r\n{more}",
            node.port
        )
    };
    let status = |bytes: String| node.say(bytes.as_bytes()).map(|reply| reply.status);
    let large = "x".repeat(limits::BODY_BYTES_MAX + 1);
    assert_eq!(status(head(&format!("content-length: {}\r\n\r\n{large}", large.len()))), Some(413));
    // Announced only: nothing of it is waited for.
    assert_eq!(status(head("content-length: 999999999999\r\n\r\n")), Some(413));
    let chunks = format!("transfer-encoding: chunked\r\n\r\n{:x}\r\n{large}\r\n0\r\n\r\n", large.len());
    assert_eq!(status(head(&chunks)), Some(413));
    let deep = format!("{{\"session_id\":{}1{}}}", "[".repeat(20_000), "]".repeat(20_000));
    assert_eq!(status(head(&format!("content-length: {}\r\n\r\n{deep}", deep.len()))), Some(400));
    assert_eq!(status(head(&format!("x: {}\r\n\r\n", "y".repeat(limits::HEADER_BYTES_MAX)))), Some(431));
    assert_eq!(status(head(&format!("{}\r\n", "x: y\r\n".repeat(limits::HEADERS_MAX)))), Some(431));
    for garbage in [
        "\r\n\r\n\r\n",
        "GET\r\n\r\n",
        "\0\u{1}\u{2}\r\n\r\n",
        "GET / HTTP/9.9\r\n\r\n",
        "GET /a b HTTP/1.1\r\n\r\n",
    ] {
        assert!(matches!(status(garbage.to_owned()), None | Some(400..=505)), "{garbage:?}");
    }
    node.assert_untouched();
}

#[test]
fn nobody_may_dawdle() {
    let node = ApiNode::start();
    let begin = Instant::now();
    let mut half = node.connect();
    half.write_all(b"GET /api/v1/status HTTP/1.1\r\nhost: ").expect("sent");
    let mut slow = node.connect();
    let head = format!(
        "{START} HTTP/1.1\r\nhost: 127.0.0.1:{}\r\nauthorization: Bearer {}\r\ncontent-length: 9\r\n\r\n{{",
        node.port,
        node.secret("otto")
    );
    slow.write_all(head.as_bytes()).expect("sent");
    // Others are served meanwhile.
    assert_eq!(node.send(Some("vera"), STATUS, &[], "").status, 200);
    let reply = listen(slow).expect("an answer");
    assert_eq!(reply.status, 408, "{reply:?}");
    assert!(listen(half).is_none_or(|reply| reply.status == 408));
    let patience = limits::HEADER.max(limits::BODY);
    assert!(begin.elapsed() < patience * 4, "{:?}", begin.elapsed());
}

#[test]
fn connections_and_requests_are_bounded() {
    let node = ApiNode::start();
    // Nobody is given a token by asking often.
    let refused: Vec<u16> = (0..40).map(|_| node.send(None, STATUS, &[], "").status).collect();
    assert_eq!(refused[0], 401);
    assert!(
        refused.contains(&429) && refused.iter().all(|status| matches!(status, 401 | 429)),
        "{refused:?}"
    );
    assert_eq!(node.send(Some("vera"), STATUS, &[], "").status, 200, "who has a token is not concerned");
    // One connection, many requests at once.
    let many = limits::REQUESTS.burst as usize * 3;
    let one = format!(
        "{STATUS} HTTP/1.1\r\nhost: 127.0.0.1:{}\r\nauthorization: Bearer {}\r\n\r\n",
        node.port,
        node.secret("vera")
    );
    let mut flood = node.connect();
    let mut reader = flood.try_clone().expect("a socket");
    let reading = std::thread::spawn(move || {
        let mut text = Vec::new();
        let _ = std::io::Read::read_to_end(&mut reader, &mut text);
        String::from_utf8_lossy(&text).matches("HTTP/1.1 429").count()
    });
    for _ in 0..many {
        let _ = flood.write_all(one.as_bytes());
    }
    let _ = flood.shutdown(std::net::Shutdown::Write);
    assert!(reading.join().expect("read") > 0, "nobody was told to wait");
    assert_eq!(node.send(Some("otto"), STATUS, &[], "").status, 200, "another caller is served");
    // Connections that say nothing keep nobody out: of more than all may hold, the oldest are closed.
    let held: Vec<_> = (0..limits::CONNECTIONS_MAX * 2).map(|_| node.connect()).collect();
    assert_eq!(node.send(Some("otto"), STATUS, &[], "").status, 200);
    assert!(node.client("otto").status().is_ok());
    assert_eq!(listen(&held[0]).map(|reply| reply.status), None, "the oldest one is closed");
    // One caller holds a stated number, however it is known.
    let asks = |who: &str| {
        let mut stream = node.connect();
        let secret = node.secret(who);
        let text = format!(
            "{STATUS} HTTP/1.1\r\nhost: 127.0.0.1:{}\r\nauthorization: Bearer {secret}\r\n\r\n",
            node.port
        );
        stream.write_all(text.as_bytes()).expect("sent");
        let mut head = [0; 12];
        std::io::Read::read_exact(&mut stream, &mut head).expect("an answer");
        (stream, head.ends_with(b"503"))
    };
    // Idle ones are closed by and by, so that on a slow machine it takes a few more.
    let mut kept: Vec<_> = (0..limits::CONNECTIONS_OF_ONE_MAX).map(|_| asks("ada")).collect();
    while kept.last().is_some_and(|(_, refused)| !refused) {
        assert!(kept.len() < 4 * limits::CONNECTIONS_OF_ONE_MAX, "a caller may hold any number");
        kept.push(asks("ada"));
    }
    assert!(!asks("otto").1, "another caller is served");
    drop(kept);
    // The Unix socket has room of its own.
    assert_eq!(node.send_local(STATUS, &[]).status, 200);
    drop(held);
    let deadline = Instant::now() + Duration::from_secs(20);
    while node.client("otto").status().is_err() {
        assert!(Instant::now() < deadline, "the node does not recover");
        std::thread::sleep(Duration::from_millis(50));
    }
    node.assert_untouched();
}

/// Repeats until it holds: the node looks at its tokens twice a second.
pub fn soon(what: &str, holds: impl Fn() -> bool) {
    let deadline = Instant::now() + Duration::from_secs(20);
    while !holds() {
        assert!(Instant::now() < deadline, "{what}");
        std::thread::sleep(Duration::from_millis(100));
    }
}

#[test]
fn tokens_are_renewed_and_revoked_without_a_restart() {
    let node = ApiNode::start();
    let old = node.client("otto");
    assert!(old.status().is_ok());
    new_token(node.dir.path(), "otto", "operate", true);
    soon("the old token works still", || old.status().is_err());
    assert!(node.client("otto").status().is_ok());
    let tokens = node.file("tokens").display().to_string();
    let revoked = fourdbody(&["token", "revoke", "--tokens", &tokens, "--name", "otto"]);
    assert!(revoked.status.success(), "{}", text_of(&revoked));
    soon("the revoked token works still", || node.client("otto").status().is_err());
    assert!(node.client("ada").status().is_ok(), "others are not concerned");
    let listed = text_of(&fourdbody(&["token", "list", "--tokens", &tokens]));
    assert!(
        listed.contains("ada admin") && !listed.contains("otto") && !listed.contains(&node.secret("ada"))
    );
    // A list that others can read is no list; a secret likewise.
    let wide = |path: &Path, mode| std::fs::set_permissions(path, PermissionsExt::from_mode(mode));
    wide(&node.file("tokens"), 0o644).expect("mine");
    soon("a list for all to read is believed", || node.client("ada").status().is_err());
    let warnings = node.local().status().expect("the socket needs no token").warnings;
    assert!(warnings.iter().any(|text| text.contains("644")), "{warnings:?}");
    wide(&node.file("tokens"), 0o600).expect("mine");
    soon("the list is not read again", || node.client("ada").status().is_ok());
    wide(&node.file("ada.token"), 0o640).expect("mine");
    let file = node.file("ada.token").display().to_string();
    let url = format!("http://127.0.0.1:{}", node.port);
    let output = fourdbody(&["status", "--nodes", &url, "--token-file", &file]);
    assert_eq!(output.status.code(), Some(2), "{}", text_of(&output));
    assert_contains(&text_of(&output), &["640", "expected 600", "chmod 600"]);
}

/// What a listener on a node's port is told by a client that shows a token: all that it sent, with an answer to each line.
fn told_to_a_stranger(answers: &[&str], ask: impl FnOnce(NodeClient)) -> String {
    let dir = tempfile::tempdir().expect("a temporary directory");
    new_token(dir.path(), "otto", "operate", false);
    let listener = std::net::TcpListener::bind("127.0.0.1:0").expect("a free port");
    let url = format!("http://{}", listener.local_addr().expect("bound"));
    let token_file = Some(dir.path().join("otto.token"));
    let client = NodeClient::with(&url, &Credentials { token_file, ca: None }).expect("a client");
    let told = std::thread::scope(|scope| {
        let stranger = scope.spawn(|| {
            let (mut stream, _) = listener.accept().expect("a client");
            stream.set_read_timeout(Some(Duration::from_secs(10))).expect("a socket");
            let mut told = String::new();
            for answer in answers {
                let mut bytes = [0; 4096];
                let length = std::io::Read::read(&mut stream, &mut bytes).unwrap_or(0);
                told += &String::from_utf8_lossy(&bytes[..length]);
                let head = format!("HTTP/1.1 200 OK\r\ncontent-length: {}\r\n\r\n", answer.len());
                let _ = stream.write_all(format!("{head}{answer}").as_bytes());
            }
            told
        });
        ask(client);
        stranger.join().expect("no panic")
    });
    let secret = std::fs::read_to_string(dir.path().join("otto.token")).expect("written");
    assert!(!told.contains(secret.trim()), "the secret was told to a stranger: {told}");
    told
}

#[test]
fn a_stranger_on_a_nodes_port_learns_no_secret_and_is_not_believed() {
    let nonce = format!("{{\"nonce\":\"{}\"}}", "0".repeat(64));
    let status = serde_json::to_string(&ApiNode::start().local().status().expect("a status")).expect("JSON");
    let told = told_to_a_stranger(&[&nonce, &status], |client| {
        let fault = client.status().expect_err("a stranger is no node");
        assert_contains(&fault.message, &["does not know this token"]);
    });
    // What it was shown opens nothing at a node, whose connections have other nonces.
    let proof = told.lines().find_map(|line| line.strip_prefix("authorization: ")).expect("a proof");
    assert!(proof.starts_with("Proof "), "{told}");
    let node = ApiNode::start();
    let replayed = node.send(None, STATUS, &[&format!("authorization: {proof}")], "");
    assert_eq!(replayed.status, 401);
    assert!(node.client("otto").status().is_ok());
    assert!(node.client("otto").stop(1).is_err_and(|fault| fault.exit == 2), "a change is proved as well");
}

#[test]
fn a_browser_logs_in_and_out() {
    let node = ApiNode::start();
    let origin = format!("origin: http://127.0.0.1:{}", node.port);
    let login = |token: &str| {
        let body = serde_json::json!({ "token": token }).to_string();
        node.send(None, "POST /api/v1/login", &[&origin], &body)
    };
    assert_eq!(login("0".repeat(64).as_str()).status, 401);
    assert_eq!(login(&node.secret("node-b")).status, 403, "a node is nobody who looks at pages");
    assert_eq!(node.send(Some("node-b"), START, &[], BODY).status, 409, "but one that operates");
    let reply = login(&node.secret("otto"));
    assert_eq!(reply.status, 200, "{reply:?}");
    let cookie = reply.header("set-cookie").expect("a cookie").to_owned();
    for part in ["HttpOnly", "SameSite=Strict", "Path=/", "Max-Age="] {
        assert!(cookie.contains(part), "{cookie}");
    }
    assert!(!cookie.contains(&node.secret("otto")));
    let cookie = format!("cookie: {}", cookie.split(';').next().expect("a pair"));
    assert_eq!(node.send(None, STATUS, &[&cookie], "").status, 200);
    assert_eq!(node.send(None, START, &[&cookie], BODY).status, 403, "no Origin");
    assert_eq!(node.send(None, START, &[&cookie, "origin: https://evil.example"], BODY).status, 403);
    let ours = node.send(None, START, &[&cookie, &origin], BODY);
    assert_eq!(ours.status, 409, "it gets as far as the node, which is in no session: {ours:?}");
    assert_eq!(node.send(None, "GET /api/v1/preview", &[&cookie, "upgrade: websocket"], "").status, 403);
    assert_eq!(
        node.send(None, "POST /api/v1/logout", &[&cookie, &origin, "content-length: 0"], "").status,
        204
    );
    assert_eq!(node.send(None, STATUS, &[&cookie], "").status, 401);
    let audit = node.audit();
    let find =
        |what: &str, status| audit.iter().find(|line| line.what.ends_with(what) && line.status == status);
    let started = audit.iter().find(|line| line.what == START && line.via == Some(Via::Cookie));
    let started = started.filter(|line| line.status == 409).expect("in the log");
    assert_eq!(started.who, "otto");
    assert_eq!(started.session_id.as_deref(), Some("0000000000000001"));
    assert!(find("/login", 200).is_some_and(|line| line.who == "otto" && line.request.is_none()));
    assert!(find("/login", 401).is_some(), "{audit:#?}");
    let log = std::fs::read_to_string(node.file("sessions/audit.jsonl")).expect("readable") + &node.log();
    assert!(!log.contains(&node.secret("otto")), "a secret is in a log");
}

#[test]
fn the_socket_is_for_its_group_and_outlives_a_crash() {
    let mut node = ApiNode::start_with("socket = \"run/node.sock\"\n");
    let path = node.file("run/node.sock");
    let data = std::fs::symlink_metadata(&path).expect("there");
    assert!(data.file_type().is_socket() && data.mode() & 0o777 == 0o660, "{:o}", data.mode());
    let client = NodeClient::new(&format!("unix:{}", path.display()));
    assert!(client.status().is_ok());
    let identity: serde_json::Value = client.get("/api/v1/identity").expect("an answer");
    assert!(identity["via"] == "socket" && identity["name"].as_str().is_some_and(|n| n.starts_with("uid ")));
    let config = node.file("node.toml").display().to_string();
    let second = fourdbody(&["node", "--config", &config]);
    assert_eq!(second.status.code(), Some(2), "{}", text_of(&second));
    assert!(client.status().is_ok(), "the first one goes on");
    node.kill();
    assert!(path.exists(), "it was left behind");
    node.restart();
    assert!(client.status().is_ok());
    // What is no socket is not removed.
    node.kill();
    std::fs::remove_file(&path).expect("mine");
    std::fs::write(&path, "somebody's").expect("writable");
    let refused = fourdbody(&["node", "--config", &config]);
    assert_eq!(refused.status.code(), Some(2), "{}", text_of(&refused));
    assert_eq!(std::fs::read_to_string(&path).expect("still there"), "somebody's");
}

#[test]
fn tls_is_spoken_and_its_key_is_private() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let rcgen::CertifiedKey { cert, signing_key } =
        rcgen::generate_simple_self_signed(vec!["localhost".to_owned()]).expect("a certificate");
    std::fs::write(dir.path().join("cert.pem"), cert.pem()).expect("writable");
    let key = dir.path().join("key.pem");
    std::fs::write(&key, signing_key.serialize_pem()).expect("writable");
    std::fs::set_permissions(&key, PermissionsExt::from_mode(0o644)).expect("mine");
    new_token(dir.path(), "vera", "view", false);
    let api = "listen = \"127.0.0.1:PORT\"\ntokens = \"tokens\"\ntls = { certificate = \"cert.pem\", key = \"key.pem\" }\n";
    let config = write_config(dir.path(), &api.replace("PORT", "0")).display().to_string();
    let wide = fourdbody(&["node", "--config", &config]);
    assert_eq!(wide.status.code(), Some(2), "{}", text_of(&wide));
    assert_contains(&text_of(&wide), &["key.pem", "expected 600"]);
    std::fs::set_permissions(&key, PermissionsExt::from_mode(0o600)).expect("mine");
    let node = ApiNode::start_in(dir, api);
    let url = format!("https://localhost:{}", node.port);
    let token_file = Some(node.file("vera.token"));
    let with = |ca| NodeClient::with(&url, &Credentials { token_file: token_file.clone(), ca });
    let client = with(Some(node.file("cert.pem"))).expect("a client");
    client.status().expect("trusted");
    // The wrong certificate, and none.
    let other = rcgen::generate_simple_self_signed(vec!["localhost".to_owned()]).expect("a certificate");
    std::fs::write(node.file("other.pem"), other.cert.pem()).expect("writable");
    assert!(with(Some(node.file("other.pem"))).expect("a client").status().is_err());
    assert!(node.say(b"GET /api/v1/status HTTP/1.1\r\nhost: localhost\r\n\r\n").is_none(), "plain text");
    let (token, ca) = (node.file("vera.token"), node.file("cert.pem"));
    let args = [
        "status",
        "--json",
        "--nodes",
        &url,
        "--token-file",
        &token.display().to_string(),
        "--ca",
        &ca.display().to_string(),
    ];
    let output = fourdbody(&args);
    assert!(text_of(&output).contains("\"judgements\""), "{}", text_of(&output));
}

#[test]
fn what_is_open_to_a_network_must_be_asked_for() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let check = |api: &str| {
        let config = write_config(dir.path(), api).display().to_string();
        let output = fourdbody(&["check-config", &config]);
        (output.status.code(), text_of(&output))
    };
    let (code, text) = check("listen = \"192.168.1.5:7401\"\n");
    assert_eq!(code, Some(2));
    assert_contains(&text, &["api.listen", "tokens", "api.tls", "plain_text_on_network"]);
    let (code, text) =
        check("listen = \"0.0.0.0:7401\"\ntokens = \"tokens\"\nplain_text_on_network = true\n");
    assert_eq!(code, Some(2));
    assert_contains(&text, &["api.hosts"]);
    let open = "listen = \"0.0.0.0:7401\"\ntokens = \"tokens\"\nplain_text_on_network = true\nhosts = [\"node-a.lab\"]\n";
    assert_eq!(check(open).0, Some(0), "{}", check(open).1);
    assert_eq!(check("").0, Some(2), "nobody could reach it");
    assert_eq!(check("listen = \"127.0.0.1:7401\"\n").0, Some(0));
    let (code, text) = check("socket = \"x.sock\"\n[[peers]]\nname = \"b\"\nurl = \"ftp://b\"\nturl = 1\n");
    assert_eq!(code, Some(2));
    assert_contains(&text, &["api.peers[0].url", "api.peers[0].turl"]);
}
