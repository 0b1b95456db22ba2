// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody report` of a session with gaps.

use crate::lab::{assert_contains, fourdbody, laboratory, start_capture, start_nodes, text_of};
use std::process::Command;

#[test]
fn a_page_tells_what_is_missing_and_shows_every_camera() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let mut laboratory = laboratory(dir.path(), 20.0);
    let mut nodes = start_nodes(&laboratory);
    let mut capture = start_capture(&laboratory, "gaps");
    let reached = |triggers: u64| {
        move |status: &fourdbody::control::status::NodeStatus| {
            status.session.as_ref().is_some_and(|session| session.triggers >= triggers)
        }
    };
    nodes[0].wait_until("some triggers", reached(10));
    laboratory.unplug(2);
    nodes[0].wait_until("a gap", |status| {
        status.session.as_ref().is_some_and(|session| session.cameras.iter().any(|camera| camera.silent))
    });
    let interrupt = Command::new("kill").args(["-INT", &capture.id().to_string()]).status();
    assert!(interrupt.is_ok_and(|status| status.success()));
    assert_eq!(capture.wait().expect("a child").code(), Some(3));
    let (session, page) = (dir.path().join("sessions/gaps"), dir.path().join("page.html"));
    let (session, out) = (session.display().to_string(), page.display().to_string());
    let made = fourdbody(&["report", &session, "--out", &out]);
    assert_eq!(made.status.code(), Some(0), "{}", text_of(&made));
    let text = std::fs::read_to_string(&page).expect("written");
    assert_contains(
        &text,
        &[
            "incomplete",
            "Node a",
            "Node b",
            "h1_up",
            "unplugged",
            "class=\"gap\"",
            "modulation",
            "right exposure",
        ],
    );
    assert_eq!(text.matches("data:image/png;base64,").count(), 8);
    for outside in ["http://", "https://"] {
        assert!(!text.contains(outside), "the page needs {outside}");
    }
    let nothing = fourdbody(&["report", &dir.path().join("nowhere").display().to_string(), "--out", &out]);
    assert_eq!(nothing.status.code(), Some(2), "{}", text_of(&nothing));
}
