// SPDX-License-Identifier: MIT OR Apache-2.0
//! Mistakes on the command line: what was expected, what was found, and what to do, without words of the program's code.

use crate::export::reconstruction;
use crate::lab::{FOURDBODY, text_of};
use crate::recording::{header, record};
use fourdbody::base::ids::NodeId;
use fourdbody::record::node_dir;
use std::path::Path;
use std::process::{Command, Output};

fn run(dir: &Path, args: &[&str]) -> Output {
    Command::new(FOURDBODY).current_dir(dir).args(args).output().expect("the program runs")
}

/// Refused as wrong usage, with all of these words, and with none of Rust's.
fn refused(dir: &Path, args: &[&str], words: &[&str]) {
    let output = run(dir, args);
    let text = text_of(&output);
    assert_eq!(output.status.code(), Some(2), "{args:?}: {text}");
    for word in words {
        assert!(text.contains(word), "{args:?}: no {word:?} in {text}");
    }
    for word in ["Some(", "None", "os error", "invalid type", "EOF while", "ident at", "missing field"] {
        assert!(!text.contains(word), "{args:?}: {word:?} in {text}");
    }
}

/// A session `walk` of ten triggers, and a reconstruction `clouds` of three.
fn places() -> tempfile::TempDir {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let recording = node_dir(&dir.path().join("walk"), &NodeId::from("a"));
    record(&recording, header("a", &["h0_up", "h0_low"], Some(10)), 10, &[]);
    reconstruction(&dir.path().join("clouds"), &[4, 5, 6]);
    dir
}

#[test]
fn what_is_no_reconstruction_is_named() {
    let place = places();
    let dir = place.path();
    refused(
        dir,
        &["view", "nowhere", "--out", "a.png"],
        &["nowhere", "expected what", "found nothing of this"],
    );
    refused(dir, &["view", "nowhere", "--trigger", "500", "--out", "a.png"], &["found nothing of this name"]);
    refused(dir, &["export", "nowhere", "--out", "x"], &["expected what", "found nothing of this name"]);
    let what_to_do = ["found a session", "fourdbody reconstruct walk --calibration FILE --out DIR"];
    refused(dir, &["view", "walk", "--out", "a.png"], &what_to_do);
    refused(dir, &["export", "walk", "--to", "ply", "--out", "x"], &what_to_do);
    refused(dir, &["export", "walk", "--out", "x"], &["fourdbody export walk --to png,csv --out DIR"]);
    refused(dir, &["export", "walk/node-a", "--to", "e57", "--out", "x"], &["found a session"]);
}

#[test]
fn triggers_that_are_not_there_are_named_with_those_that_are() {
    let place = places();
    let dir = place.path();
    refused(
        dir,
        &["view", "clouds", "--trigger", "500", "--out", "a.png"],
        &["--trigger 500", "clouds has a cloud of: 4 to 6 (3 of them)"],
    );
    let export = ["export", "walk", "--to", "csv", "--out", "x", "--triggers"];
    let of = |triggers: &'static str| [&export[..], &[triggers]].concat();
    refused(dir, &of("8..12"), &["--triggers 8..12", "expected a part of 0..10", "the last trigger is 9"]);
    refused(dir, &of("12"), &["--triggers 12..13", "the last trigger is 9"]);
    refused(dir, &of("9..2"), &["expected A..B with A below B", "or one index such as 12", "9..2"]);
}

#[test]
fn one_index_is_a_range_of_one_trigger() {
    let place = places();
    let dir = place.path();
    let output = run(dir, &["export", "walk", "--to", "csv", "--triggers", "7", "--out", "x", "--json"]);
    assert_eq!(output.status.code(), Some(0), "{}", text_of(&output));
    let table = std::fs::read_to_string(dir.join("x/timing.csv")).expect("written");
    let triggers: Vec<&str> = table.lines().skip(1).filter_map(|line| line.split(',').next()).collect();
    assert!(!triggers.is_empty() && triggers.iter().all(|trigger| *trigger == "7"), "{table}");
    let output = run(dir, &["export", "clouds", "--to", "xyz", "--triggers", "5", "--out", "y"]);
    assert_eq!(output.status.code(), Some(0), "{}", text_of(&output));
}

#[test]
fn what_is_no_calibration_is_described() {
    let place = places();
    let dir = place.path();
    let known = std::fs::read_dir(dir).expect("there").count();
    let write = |name: &str, text: &str| std::fs::write(dir.join(name), text).expect("writable");
    write("empty.json", "");
    write("rig.toml", "name = \"lab\"\n");
    write("half.json", "{\"format\": \"fourdbody-calibration\",\n");
    write("other.json", "{\"type\": 1}");
    write("part.json", "{\"format\": \"fourdbody-calibration\", \"version\": 3, \"sha256\": \"0\"}");
    std::fs::write(dir.join("picture.png"), [0x89, b'P', b'N', b'G', 0xff]).expect("writable");
    for (file, found) in [
        ("empty.json", "found: an empty file"),
        ("rig.toml", "found: text that is not JSON from line 1, column 2 on"),
        ("half.json", "found: JSON that breaks off at line 2"),
        ("other.json", "found: JSON of something else, with the fields \"type\""),
        ("part.json", "found: a calibration without the field"),
        ("picture.png", "found: a file of another kind, which is not text"),
        ("nowhere.json", "found: no file of this name"),
    ] {
        let args = ["reconstruct", "walk", "--calibration", file, "--out", "x"];
        refused(dir, &args, &[file, found, "expected a calibration.json", "lies beside each result"]);
        refused(dir, &["calibration", "check", "walk", "--calibration", file], &[found]);
    }
    assert_eq!(std::fs::read_dir(dir).expect("there").count(), known + 6, "nothing was written");
}
