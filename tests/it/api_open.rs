// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a node answers without a token: its health, and a login by a link.

use crate::api_node::{ApiNode, new_token};
use crate::api_security::soon;
use crate::browser::Browser;
use crate::lab::{assert_contains, fourdbody, text_of};
use fourdbody::control::status::Via;
use std::io::Write;

const STATUS: &str = "GET /api/v1/status";

/// Runs `fourdbody token link`; the link.
fn link_for(node: &ApiNode, name: &str) -> String {
    let (tokens, url) =
        (node.file("tokens").display().to_string(), format!("http://127.0.0.1:{}/", node.port));
    let output = fourdbody(&["token", "link", "--tokens", &tokens, "--name", name, "--url", &url]);
    assert!(output.status.success(), "{}", text_of(&output));
    let link = String::from_utf8(output.stdout).expect("text");
    assert!(link.starts_with(&format!("{url}#login=")), "nothing before the hash sign is secret: {link}");
    link.trim().to_owned()
}

#[test]
fn a_link_logs_in_once_and_leaves_no_trace_of_its_code() {
    let node = ApiNode::start();
    let origin = format!("origin: http://127.0.0.1:{}", node.port);
    let code_for = |name: &str| link_for(&node, name).split_once("#login=").expect("a code").1.to_owned();
    let login = |code: &str, headers: &[&str]| {
        let body = serde_json::json!({ "code": code }).to_string();
        node.send(None, "POST /api/v1/login/link", headers, &body)
    };
    let code = code_for("otto");
    assert_eq!(
        login(&code, &["origin: https://evil.example"]).status,
        403,
        "no page of another site logs in"
    );
    assert_eq!(login(&code, &["sec-fetch-site: cross-site"]).status, 403);
    let reply = login(&code, &[&origin]);
    assert_eq!(reply.status, 200, "{reply:?}");
    assert!(reply.body.contains("\"otto\"") && !reply.body.contains(&code), "{reply:?}");
    let cookie = reply.header("set-cookie").expect("a cookie").to_owned();
    assert_contains(&cookie, &["HttpOnly", "SameSite=Strict"]);
    let cookie = format!("cookie: {}", cookie.split(';').next().expect("a pair"));
    assert_eq!(node.send(None, STATUS, &[&cookie], "").status, 200);
    let again = login(&code, &[&origin]);
    assert_eq!(again.status, 401, "{again:?}");
    assert_contains(&again.body, &["works once", "fourdbody token link"]);
    assert_eq!(node.send(None, STATUS, &[&format!("authorization: Bearer {code}")], "").status, 401);
    let expired = code_for("vera");
    age_all_links(&node);
    assert_eq!(login(&expired, &[]).status, 401, "it has expired");
    // The login and a link that nobody has used yet end with the token.
    let unused = code_for("otto");
    new_token(node.dir.path(), "otto", "operate", true);
    soon("the login outlives its token", || node.send(None, STATUS, &[&cookie], "").status == 401);
    assert_eq!(login(&unused, &[]).status, 401);
    let left = std::fs::read_dir(node.file("tokens.links")).expect("there").count();
    assert_eq!(left, 0, "each was used up");
    let audit = node.audit();
    let logged = audit.iter().find(|line| line.what.ends_with("/login/link") && line.status == 200);
    let logged = logged.expect("in the audit log");
    assert_eq!((logged.who.as_str(), logged.via, &logged.request), ("otto", Some(Via::Link), &None));
    let log = std::fs::read_to_string(node.file("sessions/audit.jsonl")).expect("readable") + &node.log();
    for code in [&code, &expired, &unused] {
        assert!(!log.contains(code.as_str()), "a code is in a log");
    }
    for (name, words) in [("node-b", "expected a person"), ("nobody", "it has: vera, otto")] {
        let tokens = node.file("tokens").display().to_string();
        let args = ["token", "link", "--tokens", &tokens, "--name", name, "--url", "https://node-a.lab"];
        let refused = fourdbody(&args);
        assert_eq!(refused.status.code(), Some(2));
        assert!(text_of(&refused).contains(words), "{}", text_of(&refused));
    }
}

/// Has every link of the node ended a moment ago.
fn age_all_links(node: &ApiNode) {
    for entry in std::fs::read_dir(node.file("tokens.links")).expect("there") {
        let path = entry.expect("an entry").path();
        let text = std::fs::read_to_string(&path).expect("readable");
        let (rest, _) = text.trim().rsplit_once(' ').expect("three words");
        std::fs::write(&path, format!("{rest} {}\n", fourdbody::base::time::host_time_ns())).expect("mine");
    }
}

/// What a monitor without a token learns of a node, and who may ask.
#[test]
fn health_is_open_and_says_nothing_that_is_secret() {
    let node = ApiNode::start();
    soon("it is starting", || !node.send(None, "GET /health", &[], "").body.contains("starting"));
    let reply = node.send(None, "GET /health", &[], "");
    assert_eq!(reply.status, 503, "a node without devices: {reply:?}");
    let told: serde_json::Value = serde_json::from_str(&reply.body).expect("JSON");
    assert_eq!(told["fit"], false);
    assert_eq!(
        told["reasons"],
        serde_json::json!(["4 of 4 cameras cannot be used", "the HSU cannot be used"])
    );
    assert!(reply.body.len() < 500);
    let fields: Vec<_> = told.as_object().expect("an object").keys().collect();
    assert_eq!(fields, ["fit", "reasons"]);
    assert_eq!(reply.header("cache-control"), Some("no-store"));
    assert_eq!(node.send(None, "HEAD /health", &[], "").status, 503);
    assert_eq!(node.send_local("GET /health", &[]).status, 503);
    // The guards of every route.
    let host = "GET /health HTTP/1.1\r\nhost: evil.example\r\nconnection: close\r\n\r\n";
    assert_eq!(node.say(host.as_bytes()).expect("an answer").status, 421);
    for header in ["origin: https://evil.example", "sec-fetch-site: cross-site", "sec-fetch-site: same-site"]
    {
        assert_eq!(node.send(None, "GET /health", &[header], "").status, 403, "{header}");
    }
    assert_eq!(node.send(None, "POST /health", &["content-length: 0"], "").status, 401);
    assert_eq!(node.send(None, "GET /health/", &[], "").status, 404);
    // One caller's rate, as everywhere.
    let port = node.port;
    let many = format!("GET /health HTTP/1.1\r\nhost: 127.0.0.1:{port}\r\n\r\n").repeat(600);
    let last = format!("GET /health HTTP/1.1\r\nhost: 127.0.0.1:{port}\r\nconnection: close\r\n\r\n");
    let mut stream = node.connect();
    let mut reading = stream.try_clone().expect("a socket");
    let answers = std::thread::spawn(move || {
        let mut bytes = Vec::new();
        let _ = std::io::Read::read_to_end(&mut reading, &mut bytes);
        String::from_utf8_lossy(&bytes).into_owned()
    });
    let _ = stream.write_all((many + &last).as_bytes());
    let answers = answers.join().expect("no panic");
    assert!(
        answers.contains("HTTP/1.1 429"),
        "{} answers, none of them 429",
        answers.matches("HTTP/1.1").count()
    );
    node.assert_untouched();
}

/// The code leaves the address bar at once, also where it does not work.
#[test]
fn a_browser_opens_a_link() {
    let Some(browser) = Browser::start() else { return };
    let node = ApiNode::start();
    let link = link_for(&node, "otto");
    let open = |link: &str| drop(browser.run(&format!("location.href = {link:?}")));
    let clean = || {
        browser.wait("a clean address", "return location.hash === '' && !location.href.includes('login')");
    };
    let log_out = || {
        browser.run("document.getElementById('logout').click()");
        browser.wait("logged out", "return !document.getElementById('login').hidden");
    };
    browser.open(&link);
    browser.wait("logged in by the link", "return !document.getElementById('console').hidden");
    assert_eq!(browser.text("who"), "otto (operate)");
    clean();
    log_out();
    // In the page that is open already, and used up.
    open(&link);
    browser.wait_text("login-problem", "works once");
    clean();
    assert_eq!(browser.run("return document.getElementById('login').hidden"), false);
    open(&link_for(&node, "vera"));
    browser.wait("logged in by another link", "return !document.getElementById('console').hidden");
    browser.wait_text("who", "vera (view)");
    clean();
}
