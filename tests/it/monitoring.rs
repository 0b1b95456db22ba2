// SPDX-License-Identifier: MIT OR Apache-2.0
//! The alerts and the dashboard in `config/monitoring`: they use what a node tells, with the bounds of its own judgements.

use fourdbody::telemetry::{Family, Kind, Threshold, thresholds};
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;

fn place(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("config/monitoring").join(name)
}

fn read(name: &str) -> String {
    std::fs::read_to_string(place(name)).unwrap_or_else(|e| panic!("{name}: {e}"))
}

/// The expressions of all panels and variables.
fn dashboard_expressions() -> Vec<String> {
    let board: Value = serde_json::from_str(&read("grafana-dashboard.json")).expect("JSON");
    let panels = board["panels"].as_array().expect("panels").iter();
    let targets = panels.flat_map(|panel| panel["targets"].as_array().expect("targets"));
    let expressions = targets.map(|target| target["expr"].as_str().expect("an expression").to_owned());
    let variables = board["templating"]["list"].as_array().expect("variables").iter();
    let queries = variables.filter_map(|variable| Some(variable["query"].as_str()?.to_owned()));
    expressions.chain(queries).collect()
}

/// The names of metrics in a text.
fn names_in(text: &str) -> BTreeSet<String> {
    let words = text.split(|c: char| !(c.is_ascii_alphanumeric() || c == '_'));
    words.filter(|word| word.starts_with("fourdbody_")).map(str::to_owned).collect()
}

/// The values of a label that expressions ask for: `label="value"`.
fn values_of<'a>(text: &'a str, label: &str) -> BTreeSet<&'a str> {
    let begin = format!("{label}=\"");
    text.split(begin.as_str()).skip(1).filter_map(|rest| rest.split('"').next()).collect()
}

/// Every metric and every stage that the files name is in what a node told after a session.
pub fn assert_all_are_told(told: &[Family]) {
    let mut known = BTreeMap::new();
    for Family { name, kind, samples, .. } in told {
        let ends: &[&str] = if *kind == Kind::Histogram { &["_bucket", "_sum", "_count"] } else { &[""] };
        for end in ends {
            known.insert(format!("{name}{end}"), samples);
        }
    }
    let text = read("alerts.yml") + &dashboard_expressions().join("\n");
    let names = names_in(&text);
    assert!(names.len() > 8, "{names:?}");
    for name in &names {
        assert!(
            known.contains_key(name),
            "config/monitoring names {name}, which no node tells: {:?}",
            known.keys()
        );
    }
    let labels = |label: &str| {
        let of_all = known.values().flat_map(|samples| samples.iter());
        let found: BTreeSet<&str> =
            of_all.filter_map(|sample| sample.labels.get(label).map(String::as_str)).collect();
        assert!(!found.is_empty(), "{label}");
        found
    };
    let stages = labels("stage");
    assert!(values_of(&text, "stage").is_subset(&stages), "{stages:?}");
    labels("camera");
    labels("cause");
}

#[test]
fn alerts_have_the_bounds_of_the_nodes_own_judgements() {
    let alerts = read("alerts.yml");
    let Threshold { good, bad, .. } = thresholds::DISK_TIME_LEFT;
    let ring = thresholds::RING_HIGH_WATER.bad / 100.0;
    let durable = thresholds::DURABLE_P99.bad / 1000.0;
    for expected in [
        format!("fourdbody_disk_left_seconds < {good}\n"),
        format!("fourdbody_disk_left_seconds <= {bad}\n"),
        format!("/ fourdbody_ring_capacity_frames >= {ring}\n"),
        format!("{{stage=\"write_to_durable\"}})) >= {durable}\n"),
    ] {
        assert!(alerts.contains(&expected), "expected {expected:?} in alerts.yml");
    }
    // Every alert says what it means and what to do.
    let count = |what: &str| alerts.matches(what).count();
    assert!(count("- alert: ") >= 10);
    assert_eq!([count("summary: "), count("action: "), count("severity: ")], [count("- alert: "); 3]);
}

#[test]
fn prometheus_accepts_the_alerts() {
    let check = |args: [&str; 2], file: &str| Command::new("promtool").args(args).arg(place(file)).output();
    let Ok(rules) = check(["check", "rules"], "alerts.yml") else {
        println!("skipped: promtool is not installed (Debian package prometheus)");
        return;
    };
    assert!(rules.status.success(), "{}", crate::lab::text_of(&rules));
}

#[test]
fn the_dashboard_has_a_place_and_a_source_for_every_panel() {
    let board: Value = serde_json::from_str(&read("grafana-dashboard.json")).expect("JSON");
    let mut taken = BTreeSet::new();
    for panel in board["panels"].as_array().expect("panels") {
        let at = |key: &str| panel["gridPos"][key].as_u64().expect("a place");
        assert!(at("x") + at("w") <= 24, "{panel}");
        for (x, y) in
            (at("x")..at("x") + at("w")).flat_map(|x| (at("y")..at("y") + at("h")).map(move |y| (x, y)))
        {
            assert!(taken.insert((x, y)), "two panels at {x}, {y}");
        }
        assert_eq!(panel["datasource"]["uid"], "${datasource}");
        assert!(panel["description"].as_str().is_some_and(|text| text.ends_with('.')), "{panel}");
    }
    assert!(taken.len() > 200);
}
