// SPDX-License-Identifier: MIT OR Apache-2.0
//! Commands whose output nobody reads do their work, and tell how it ended by their exit code.

use crate::lab::{FOURDBODY, fourdbody, text_of};
use std::path::Path;
use std::process::{Command, Stdio};

/// The exit code of a command whose standard output and standard error have no reader from the beginning.
fn exit_code(args: &[&str]) -> Option<i32> {
    let unread = || {
        let (_, writer) = std::io::pipe().expect("a pipe");
        writer
    };
    let status = Command::new(FOURDBODY)
        .args(args)
        .stdin(Stdio::null())
        .stdout(unread())
        .stderr(unread())
        .status()
        .expect("the binary starts");
    status.code()
}

#[test]
fn the_work_is_done() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let rig = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/rig.toml").display().to_string();
    let files = |name: &str, run: &dyn Fn(&[&str])| {
        let out = dir.path().join(name);
        run(&["pattern", "--rig", &rig, "--out", &out.display().to_string()]);
        let entries = std::fs::read_dir(&out).expect("it was made").flatten();
        let mut found: Vec<_> =
            entries.map(|e| (e.file_name(), std::fs::read(e.path()).expect("readable"))).collect();
        found.sort();
        found
    };
    let read = files("read", &|args| {
        let output = fourdbody(args);
        assert!(output.status.success() && !output.stdout.is_empty(), "{}", text_of(&output));
    });
    let unread = files("unread", &|args| assert_eq!(exit_code(args), Some(0)));
    assert!(read.len() >= 4 && read == unread, "{} and {} files", read.len(), unread.len());
}

#[test]
fn failures_keep_their_exit_codes() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let bad = dir.path().join("bad.toml");
    std::fs::write(&bad, "[node]\nname = 7\n").expect("writable");
    let (bad, missing) = (bad.display().to_string(), dir.path().join("missing").display().to_string());
    for args in [["check-config", &bad], ["info", &missing], ["verify", &missing]] {
        let read = fourdbody(&args);
        assert!(!read.status.success(), "{args:?}: {}", text_of(&read));
        assert_eq!(exit_code(&args), read.status.code(), "{args:?}");
    }
}
