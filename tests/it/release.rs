// SPDX-License-Identifier: MIT OR Apache-2.0
//! `make release`: what it refuses, and what it leaves; with stand-ins for the build.

use crate::lab::text_of;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::{Command, Output};

fn run(dir: &Path, program: &str, args: &[&str]) -> Output {
    let path = format!("{}:{}", dir.join(".programs").display(), std::env::var("PATH").unwrap_or_default());
    let mut command = Command::new(program);
    command.current_dir(dir).args(args).env("PATH", path).env_remove("CARGO");
    command.env_remove("FOURDBODY_RELEASE").output().expect("it starts")
}

fn program(dir: &Path, name: &str, text: &str) {
    let path = dir.join(".programs").join(name);
    std::fs::write(&path, format!("#!/bin/sh\n{text}\n")).expect("writable");
    std::fs::set_permissions(&path, PermissionsExt::from_mode(0o755)).expect("mine");
}

/// A repository with the script, and with `cargo` and `make` that do what these texts say.
fn repository() -> tempfile::TempDir {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let place = dir.path();
    for folder in ["scripts", ".programs"] {
        std::fs::create_dir(place.join(folder)).expect("writable");
    }
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("scripts/release.sh");
    std::fs::copy(script, place.join("scripts/release.sh")).expect("in the repository");
    std::fs::write(place.join("Cargo.toml"), "[workspace.package]\nversion = \"1.2.3\"\n").expect("writable");
    std::fs::write(place.join(".gitignore"), "target\n.programs\n").expect("writable");
    program(place, "cargo", "test \"$FOURDBODY_RELEASE\" = 1");
    program(place, "dpkg", "echo amd64");
    program(
        place,
        "make",
        "mkdir -p target/debian; echo old >target/debian/fourdbody_1.0.0-1_amd64.deb; \
         echo new >target/debian/fourdbody_1.2.3-1_amd64.deb",
    );
    for args in [
        &["init", "--quiet"][..],
        &["add", "."],
        &["-c", "user.name=t", "-c", "user.email=t@t", "commit", "--quiet", "-m", "t"],
    ] {
        let output = run(place, "git", args);
        assert!(output.status.success(), "{}", text_of(&output));
    }
    dir
}

fn refused(dir: &Path, words: &[&str]) {
    let output = run(dir, "scripts/release.sh", &[]);
    let text = text_of(&output);
    assert!(!output.status.success(), "{text}");
    words.iter().for_each(|word| assert!(text.contains(word), "no {word:?} in {text}"));
    assert!(!dir.join("target/debian/SHA256SUMS").exists());
}

#[test]
fn a_release_has_sums_that_hold_and_says_what_it_made() {
    let place = repository();
    let output = run(place.path(), "scripts/release.sh", &[]);
    let text = text_of(&output);
    assert!(output.status.success(), "{text}");
    for word in ["fourdbody 1.2.3, commit ", "fourdbody_1.2.3-1_amd64.deb (4 bytes)", "SHA256SUMS"] {
        assert!(text.contains(word), "{text}");
    }
    let folder = place.path().join("target/debian");
    let sums = std::fs::read_to_string(folder.join("SHA256SUMS")).expect("written");
    assert_eq!(sums.lines().count(), 1, "an older package is no part of it: {sums}");
    assert!(run(&folder, "sha256sum", &["-c", "SHA256SUMS"]).status.success());
    std::fs::write(folder.join("fourdbody_1.2.3-1_amd64.deb"), "forged").expect("writable");
    assert!(!run(&folder, "sha256sum", &["-c", "SHA256SUMS"]).status.success());
}

#[test]
fn a_tree_with_changes_and_documents_of_another_version_are_refused() {
    let place = repository();
    let place = place.path();
    program(place, "cargo", "exit 101");
    refused(place, &["expected documents of this version", "make figures"]);
    program(place, "cargo", "exit 0");
    std::fs::write(place.join("forgotten.txt"), "x").expect("writable");
    refused(place, &["expected a clean tree", "forgotten.txt"]);
    std::fs::remove_file(place.join("forgotten.txt")).expect("there");
    // A build that changes what is committed is no build of the commit.
    program(place, "make", "echo >>Cargo.toml");
    refused(place, &["expected a clean tree", "Cargo.toml"]);
    assert!(run(place, "git", &["checkout", "--quiet", "Cargo.toml"]).status.success());
    program(place, "make", "exit 0");
    refused(place, &["expected target/debian/fourdbody_1.2.3-1_amd64.deb", "found none"]);
}
