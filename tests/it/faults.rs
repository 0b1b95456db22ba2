// SPDX-License-Identifier: MIT OR Apache-2.0
//! Real nodes while cameras and network misbehave by a plan: every injected fault must be accounted for, at its
//! trigger and by its cause, and nothing else may be missing.

use crate::lab::{fourdbody, options, small_rig, start_laboratory, start_nodes, text_of, turn};
use fourdbody_simulator::faults::{FaultPlan, Injected, Kind, Shown, check, read_truth};
use fourdbody_simulator::laboratory::{LaboratoryOptions, TRUTH_FILE};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

const TRIGGERS: usize = 300;

/// Records a train with these faults; the truth and the session.
fn recorded(dir: &Path, plan: FaultPlan) -> (Vec<Injected>, PathBuf) {
    let _turn = turn();
    let options = options(small_rig(40.0), dir);
    let options = LaboratoryOptions { buffers_per_camera: 64, faults: Some(plan), ..options };
    let laboratory = start_laboratory(&options);
    let mut nodes = start_nodes(&laboratory);
    let triggers = TRIGGERS.to_string();
    let urls = laboratory.urls();
    let captured = fourdbody(&["capture", "--nodes", &urls, "--triggers", &triggers, "--name", "faulty"]);
    assert_eq!(captured.status.code(), Some(3), "losses, all accounted for: {}", text_of(&captured));
    nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
    drop(nodes);
    let truth = read_truth(&dir.join(TRUTH_FILE)).expect("the truth");
    (truth, dir.join("sessions/faulty"))
}

/// Aravis takes a payload packet of any length for the whole one; the marks in the block tell.
#[test]
fn a_packet_cut_short_is_a_loss() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let probability = BTreeMap::from([(Kind::Truncated, 0.02)]);
    let plan = FaultPlan { seed: 1, probability, ..FaultPlan::default() };
    let (truth, session) = recorded(dir.path(), plan);
    let accounting = check(&truth, &[&session], Shown::TestImages).expect("a session");
    assert_eq!(accounting.mismatches, 0, "{:#?}", accounting.listed);
}

#[test]
fn every_injected_fault_is_accounted_for_and_nothing_else_is_missing() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let mut plan = FaultPlan::mixed(2026, 0.008);
    // In a test of its own.
    plan.probability.remove(&Kind::Truncated);
    let (truth, session) = recorded(dir.path(), plan);
    let accounting = check(&truth, &[&session], Shown::TestImages).expect("a session");
    println!("{}", serde_json::json!(accounting));
    assert_eq!(accounting.mismatches, 0, "{:#?}", accounting.listed);
    assert!(
        accounting.given_up * 100 <= accounting.outcomes,
        "more than 1 % given up: {}",
        accounting.given_up
    );
    assert_eq!(accounting.outcomes, 8 * TRIGGERS as u64);
    assert_eq!(accounting.total.injected, truth.len() as u64);
    assert_eq!(accounting.kinds.len(), Kind::all().len() - 1, "every kind: {:?}", accounting.kinds.keys());

    // The check itself must notice a fault that nobody injected, and one that left no trace.
    let loss = truth.iter().position(|fault| fault.kind == "frame_lost").expect("a lost frame");
    let mut wrong = truth.clone();
    wrong[loss].trigger += 1;
    let accounting = check(&wrong, &[&session], Shown::TestImages).expect("a session");
    assert_eq!(accounting.mismatches, 2, "{:#?}", accounting.listed);
}
