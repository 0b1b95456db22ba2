// SPDX-License-Identifier: MIT OR Apache-2.0
//! Cameras that run for an open console: the preview gives way to everything else, hides no verdict, leaves nothing on the
//! disk, and ends when nobody looks. Twelve seconds.

use crate::lab::{NodeProcess, SIZE, options, small_rig, start, start_nodes};
use fourdbody::control::request::Phase;
use fourdbody::control::status::{NodeStatus, Outcome, path};
use serde_json::json;
use std::time::{Duration, Instant};

const PATIENCE: Duration = Duration::from_secs(30);

/// Looks at the pictures of this node's page until all nodes are where this is true.
fn look_until(nodes: &[NodeProcess], from: usize, what: &str, holds: impl Fn(&NodeStatus) -> bool) {
    let deadline = Instant::now() + Duration::from_secs(90);
    loop {
        nodes[from].client.post(path::PREVIEW, &json!({}), PATIENCE).expect("a preview");
        if nodes.iter().all(|node| node.client.status().is_ok_and(|status| holds(&status))) {
            return;
        }
        assert!(Instant::now() < deadline, "never {what}");
        std::thread::sleep(Duration::from_millis(50));
    }
}

fn runs(status: &NodeStatus) -> bool {
    status.is_in_preview()
        && status.phase == Phase::Running
        && status.preview.as_ref().is_some_and(|p| p.triggers > 0)
}

#[test]
fn a_preview_gives_way_and_ends_when_nobody_looks() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = start(&options(small_rig(40.0), dir.path()), SIZE);
    let mut nodes = start_nodes(&laboratory);
    nodes.iter_mut().for_each(|node| drop(node.wait_ready()));
    look_until(&nodes, 0, "in a preview", runs);
    let first = nodes[1].client.status().expect("answers").preview.expect("runs").session_id;

    // The other node's page shows the same preview, and begins none of its own.
    look_until(&nodes, 1, "in the same preview", |status| {
        runs(status) && status.preview.as_ref().is_some_and(|preview| preview.session_id == first)
    });

    // A setting ends it for a moment.
    let request = json!({ "heads": ["h0"], "exposure_us": 900.0 });
    nodes[0].client.post(path::EXPOSURE, &request, PATIENCE).expect("it is set");
    look_until(&nodes, 0, "in a preview again", |status| {
        runs(status) && status.preview.as_ref().is_some_and(|preview| preview.session_id != first)
    });

    // Record, in one press.
    let wish = json!({ "wish": { "name": "walk", "duration_s": 0.5 }, "takes": 1 });
    nodes[0].client.post(path::CAPTURE, &wish, PATIENCE).expect("it begins");
    let recorded = |status: &NodeStatus| {
        let session = status.session.as_ref().filter(|session| session.name == "walk");
        session.is_some_and(|session| matches!(session.outcome, Some(Outcome::Recorded(_))))
    };
    look_until(&nodes, 0, "recorded", recorded);
    look_until(&nodes, 0, "in a preview behind it", |status| runs(status) && recorded(status));
    let capture: serde_json::Value = nodes[0].client.get(path::CAPTURE).expect("answers");
    assert_eq!((&capture["fault"], &capture["takes"][0]["name"]), (&serde_json::Value::Null, &json!("walk")));

    // Nobody looks any more.
    nodes.iter_mut().for_each(|node| {
        drop(node.wait_until("at rest", |status| status.phase == Phase::Idle));
    });
    let recordings: Vec<_> = std::fs::read_dir(dir.path().join("sessions"))
        .expect("recorded")
        .flatten()
        .map(|one| one.file_name())
        .collect();
    assert!(!recordings.iter().any(|name| name == "preview"), "{recordings:?}");
    let audit = std::fs::read_to_string(dir.path().join("audit-a.jsonl")).expect("a log");
    let begun = audit.lines().filter(|line| line.contains("POST /api/v1/preview")).count();
    assert!((1..10).contains(&begun), "{begun} lines: only what begins a preview is in the audit log");
}
