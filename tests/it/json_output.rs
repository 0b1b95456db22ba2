// SPDX-License-Identifier: MIT OR Apache-2.0
//! The keys of `--json` that docs/guide/json.md promises, against real output.

use crate::lab::{capture_whole, fourdbody, laboratory, start_nodes, text_of};
use crate::recording::{header, record};
use serde_json::Value;
use std::process::Output;

/// A row of a table of the page.
struct Promise {
    key: String,
    kinds: Vec<String>,
}

/// The table of a command.
fn promised(command: &str) -> Vec<Promise> {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/docs/guide/json.md");
    let page = std::fs::read_to_string(path).expect("the page");
    let section = page.split("\n## ").find(|part| part.starts_with(&format!("`fourdbody {command} ")));
    let section = section.unwrap_or_else(|| panic!("docs/guide/json.md has no section of {command}"));
    let rows = section.lines().filter_map(|line| line.strip_prefix("| `"));
    let promise = |row: &str| {
        let mut cells = row.split('|').map(str::trim);
        let key = cells.next().expect("a key").trim_end_matches('`').to_owned();
        let kinds = cells.next().expect("a type").split(" or ").map(str::to_owned).collect();
        Promise { key, kinds }
    };
    let rows: Vec<Promise> = rows.map(promise).collect();
    assert!(rows.len() > 5, "{command}");
    rows
}

/// The values at a key such as `a[].b`; what lacks it is an error.
fn values<'a>(value: &'a Value, key: &str) -> Result<Vec<&'a Value>, String> {
    let mut found = vec![value];
    for part in key.split('.') {
        let (name, is_list) = part.strip_suffix("[]").map_or((part, false), |name| (name, true));
        let mut next = Vec::new();
        for value in found {
            let value = value.get(name).ok_or_else(|| format!("{key}: no {name:?} in {value}"))?;
            match value.as_array().filter(|_| is_list) {
                Some(list) => next.extend(list),
                None if is_list => return Err(format!("{key}: {name:?} is no list: {value}")),
                None => next.push(value),
            }
        }
        found = next;
    }
    Ok(found)
}

fn is(value: &Value, kind: &str) -> bool {
    match kind {
        "text" => value.is_string(),
        "number" => value.is_number(),
        "truth" => value.is_boolean(),
        "list" => value.is_array(),
        "object" => value.is_object(),
        "null" => value.is_null(),
        other => panic!("docs/guide/json.md: {other:?} is no type"),
    }
}

/// One line, one value, with all that is promised; and nothing at its top that the page does not name.
fn keeps(command: &str, outputs: &[Output]) {
    let promises = promised(command);
    let mut seen = vec![0; promises.len()];
    for output in outputs {
        let text = String::from_utf8(output.stdout.clone()).expect("text");
        assert_eq!(text.lines().count(), 1, "{command}: {}", text_of(output));
        let value: Value = serde_json::from_str(&text).expect("JSON");
        for (Promise { key, kinds }, seen) in promises.iter().zip(&mut seen) {
            let found = values(&value, key).unwrap_or_else(|why| panic!("{command}: {why}"));
            for value in &found {
                assert!(
                    kinds.iter().any(|kind| is(value, kind)),
                    "{command}: {key} is {value}, not {kinds:?}"
                );
            }
            *seen += found.len();
        }
        for name in value.as_object().expect("an object").keys() {
            let is_named = promises.iter().any(|promise| promise.key.split(['.', '[']).next() == Some(name));
            assert!(is_named, "{command}: docs/guide/json.md does not name {name}");
        }
    }
    for (Promise { key, .. }, seen) in promises.iter().zip(seen) {
        assert!(seen > 0, "{command}: {key} was in no output of this test");
    }
}

#[test]
fn the_promised_keys_are_in_the_output() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = laboratory(dir.path(), 20.0);
    let nodes = start_nodes(&laboratory);
    let captured = capture_whole(&laboratory, "walk", 10, &["--json"]);
    keeps("capture", &[captured]);
    let status = fourdbody(&["status", "--nodes", &laboratory.urls(), "--json"]);
    assert_eq!(status.status.code(), Some(0), "{}", text_of(&status));
    keeps("status", &[status]);
    drop(nodes);
    let session = laboratory.nodes[0].path.with_file_name("sessions").join("walk").display().to_string();
    let lossy = dir.path().join("lossy");
    record(&lossy.join("node-a"), header("a", &["h0_up", "h0_low"], Some(10)), 10, &[(0, 4)]);
    let lossy = lossy.display().to_string();
    for command in ["info", "verify"] {
        keeps(command, &[fourdbody(&[command, &session, "--json"]), fourdbody(&[command, &lossy, "--json"])]);
    }
}
