// SPDX-License-Identifier: MIT OR Apache-2.0
//! A reader that is not ours agrees: the PyPI package `mcap`, with every checksum validated.
//!
//! It is looked for in `$FOURDBODY_TEST_PYTHON`, in `tests/.venv` (made by `make test`) and on the system.

use crate::recording::{header, record};
use std::path::{Path, PathBuf};
use std::process::Command;

/// A Python that can import `mcap`.
pub fn python() -> Option<PathBuf> {
    let own = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/.venv/bin/python");
    let named = std::env::var_os("FOURDBODY_TEST_PYTHON").map(PathBuf::from);
    let candidates = [named, Some(own), Some(PathBuf::from("python3"))];
    candidates.into_iter().flatten().find(|python| {
        let import = Command::new(python).args(["-c", "import mcap.reader"]).output();
        import.is_ok_and(|output| output.status.success())
    })
}

#[test]
fn the_python_reader_finds_every_message() {
    let Some(python) = python() else {
        println!("skipped: no Python with the `mcap` package (`make test` installs it into tests/.venv)");
        return;
    };
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("node-a");
    record(&path, header("a", &["h0_up", "h0_low"], Some(50)), 50, &[(1, 7), (0, 49)]);
    let mut segments: Vec<PathBuf> =
        path.read_dir().expect("a directory").map(|entry| entry.expect("an entry").path()).collect();
    segments.sort();
    assert!(segments.len() > 1);
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/it/third_party_mcap.py");
    let output = Command::new(&python).arg(script).args(&segments).output().expect("Python runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let found: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
    let counts = &found["counts"];
    assert_eq!(counts["/camera/h0_up/image"], 49);
    assert_eq!(counts["/camera/h0_low/image"], 49);
    assert_eq!((&counts["/gaps"], &counts["/hsu/triggers"]), (&2.into(), &50.into()));
    let metadata: Vec<&str> =
        found["metadata"].as_array().expect("a list").iter().filter_map(|name| name.as_str()).collect();
    assert_eq!(metadata.iter().filter(|name| **name == "fourdbody.header").count(), segments.len());
    assert_eq!(metadata.last(), Some(&"fourdbody.verdict"));
    match found["decoded"].as_u64() {
        Some(decoded) => assert_eq!(decoded, 98),
        None => println!("frames not decoded: no Python package `mcap-protobuf-support`"),
    }
}
