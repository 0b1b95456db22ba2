// SPDX-License-Identifier: MIT OR Apache-2.0
//! Real nodes that record onto disks that are slow, full or fail: what is lost is accounted for, what is counted as
//! recorded can be read, and the other node is none the worse.

use crate::lab::{NodeProcess, fourdbody, options, small_rig, start_laboratory, start_nodes, text_of};
use crate::session_faults::check_frames;
use fourdbody::record::{GapCause, SessionReader, Status};
use fourdbody_simulator::disk::{DiskPlan, SimulatedDisk};
use fourdbody_simulator::faults::{DiskEvent, DiskFault, Shown, check_with_disks, read_disk_truth};
use fourdbody_simulator::laboratory::{Laboratory, LaboratoryOptions, TRUTH_FILE};
use std::path::{Path, PathBuf};
use std::process::Output;

const RATE_HZ: f64 = 20.0;
/// Bytes of a frame set of one node, without envelopes.
const SET_BYTES: u64 = 4 * 320 * 200;

/// A laboratory whose nodes record onto disks with this plan; `None`, and it is said, where there is no FUSE.
fn laboratory_on(dir: &Path, plan: &str, change: impl FnOnce(&mut LaboratoryOptions)) -> Option<Laboratory> {
    if let Some(reason) = SimulatedDisk::unavailable() {
        eprintln!("skipped, no disk can be simulated here: {reason}");
        return None;
    }
    let mut options = options(small_rig(RATE_HZ), dir);
    options.disk = Some(DiskPlan::parse(plan).expect("a valid plan").expect("a table [disk]"));
    change(&mut options);
    Some(start_laboratory(&options))
}

/// A session that has ended, and what the disks did meanwhile.
struct Recorded {
    output: Output,
    session: PathBuf,
    disks: Vec<DiskEvent>,
}

impl Recorded {
    /// Captures with all nodes of the laboratory.
    fn capture(dir: &Path, laboratory: &Laboratory, nodes: &mut [NodeProcess], triggers: &str) -> Self {
        let urls = laboratory.urls();
        let output = fourdbody(&["capture", "--nodes", &urls, "--triggers", triggers, "--name", "disk"]);
        nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
        let disks = read_disk_truth(&dir.join(TRUTH_FILE)).expect("the truth");
        Self { output, session: dir.join("sessions/disk"), disks }
    }

    fn text(&self) -> String {
        format!("{}\n{:#?}", text_of(&self.output), self.disks)
    }

    fn assert_exit(&self, code: i32) {
        assert_eq!(self.output.status.code(), Some(code), "{}", self.text());
    }

    /// `fourdbody verify` of a part of the session; its words.
    fn assert_verified(&self, part: &str, code: i32) -> String {
        let output = fourdbody(&["verify", &self.session.join(part).display().to_string()]);
        assert_eq!(output.status.code(), Some(code), "{}{}", text_of(&output), self.text());
        text_of(&output)
    }

    /// Everything that is missing is explained by what the disks did.
    fn assert_accounted(&self) {
        let accounting =
            check_with_disks(&[], &self.disks, &[&self.session], Shown::TestImages).expect("a session");
        assert_eq!(accounting.mismatches, 0, "{:#?}{}", accounting.listed, self.text());
        // And by nothing else.
        let missing = gaps(&self.session, "node-b").len() + gaps(&self.session, "node-a").len();
        if missing > 0 {
            let accounting =
                check_with_disks(&[], &[], &[&self.session], Shown::TestImages).expect("a session");
            // Sets that a node dropped and named are counted apart: that disk may have been a slow one by itself.
            let found = accounting.mismatches + accounting.dropped_by_host;
            assert!(found > 0, "the check takes anything");
        }
    }

    fn happened(&self, kind: DiskFault) -> bool {
        self.disks.iter().any(|event| event.kind == kind)
    }
}

/// The gaps of a node's recording, its frames looked at.
fn gaps(session: &Path, node: &str) -> Vec<(u64, GapCause)> {
    let path = session.join(node);
    let reader = SessionReader::open(&path).expect("readable");
    let outcomes = reader.recordings()[0].header.cameras.len();
    (0..outcomes)
        .flat_map(|camera| {
            let recording = &reader.recordings()[0];
            (0..recording.triggers_end()).filter_map(move |trigger| {
                match recording.frame(camera, fourdbody::base::ids::TriggerIndex(trigger)) {
                    Ok(Err(cause)) => Some((trigger, cause)),
                    _ => None,
                }
            })
        })
        .collect()
}

#[test]
fn a_slow_disk_costs_whole_frame_sets_that_are_named() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    // A quarter of what comes.
    let rate = SET_BYTES as f64 * RATE_HZ / 4.0;
    let plan = format!(
        "[disk]\nseed = 1\nnodes = [\"a\"]\n[disk.slow]\nbytes_per_s = {rate:.0}\nfrom_byte = 1_000_000\n"
    );
    let Some(laboratory) = laboratory_on(dir.path(), &plan, |_| {}) else { return };
    let mut nodes = start_nodes(&laboratory);
    let recorded = Recorded::capture(dir.path(), &laboratory, &mut nodes, "80");
    recorded.assert_exit(3);
    recorded.assert_verified("", 3);
    recorded.assert_accounted();
    assert!(recorded.happened(DiskFault::Slow));
    let gaps = check_frames(&recorded.session);
    assert!(gaps[0].len() >= 20, "a quarter goes through, and what the ring holds: {gaps:?}");
    assert!(gaps[0].len() < 70, "a quarter goes through: {gaps:?}");
    for camera in &gaps[..4] {
        assert_eq!(camera, &gaps[0], "whole frame sets");
    }
    assert!(gaps[0].iter().all(|(_, cause)| *cause == GapCause::DroppedRingFull), "{gaps:?}");
    assert!(gaps[4..].iter().all(Vec::is_empty), "the other node has a disk of its own: {gaps:?}");
}

#[test]
fn a_slow_disk_ends_the_session_where_that_is_configured() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let plan =
        "[disk]\nseed = 1\nnodes = [\"b\"]\n[disk.slow]\nbytes_per_s = 1_000_000\nfrom_byte = 1_000_000\n";
    let Some(laboratory) = laboratory_on(dir.path(), plan, |_| {}) else { return };
    for node in &laboratory.nodes {
        let text = std::fs::read_to_string(&node.path).expect("written by the laboratory");
        let text = text.replace("[acquisition]\n", "[acquisition]\nwhen_full = \"stop\"\n");
        std::fs::write(&node.path, text).expect("writable");
    }
    let mut nodes = start_nodes(&laboratory);
    let recorded = Recorded::capture(dir.path(), &laboratory, &mut nodes, "0");
    recorded.assert_exit(3);
    assert!(recorded.text().contains("the ring is full"), "{}", recorded.text());
    recorded.assert_verified("", 3);
    recorded.assert_accounted();
    let gaps = check_frames(&recorded.session);
    assert!(gaps[..4].iter().all(Vec::is_empty), "the other node ends without a loss: {gaps:?}");
    assert!(!gaps[4].is_empty() && gaps[5..].iter().all(|camera| *camera == gaps[4]), "{gaps:?}");
}

#[test]
fn a_slow_disk_costs_nothing_while_the_ring_suffices() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let plan = "[disk]\nseed = 3\n[disk.slow]\nlatency_ms = 10.0\nspread = 0.6\n";
    let Some(laboratory) = laboratory_on(dir.path(), plan, |o| o.buffers_per_camera = 128) else {
        return;
    };
    let mut nodes = start_nodes(&laboratory);
    let recorded = Recorded::capture(dir.path(), &laboratory, &mut nodes, "60");
    recorded.assert_exit(0);
    recorded.assert_verified("", 0);
    recorded.assert_accounted();
    for node in ["a", "b"] {
        assert!(recorded.disks.iter().any(|e| e.kind == DiskFault::Slow && e.disk == node), "{node}");
    }
}

#[test]
fn a_small_disk_refuses_what_it_cannot_hold_and_is_never_filled() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    // 16 MiB for the accounting, 2 MiB of reserve (less than what comes between two syncs), and a little more.
    let capacity = 24 << 20;
    let plan = format!("[disk]\nseed = 1\nnodes = [\"a\"]\n[disk.full]\ncapacity_bytes = {capacity}\n");
    let change = |options: &mut LaboratoryOptions| {
        (options.reserve_mib, options.rig_text) = (2, small_rig(2.0 * RATE_HZ));
    };
    let Some(laboratory) = laboratory_on(dir.path(), &plan, change) else { return };
    let mut nodes = start_nodes(&laboratory);
    let refused = Recorded::capture(dir.path(), &laboratory, &mut nodes, "100");
    refused.assert_exit(1);
    for word in ["node a", "MiB are free", "delete or move sessions"] {
        assert!(refused.text().contains(word), "{word}: {}", refused.text());
    }
    assert!(!refused.session.exists() && refused.disks.is_empty(), "{}", refused.text());

    let recorded = Recorded::capture(dir.path(), &laboratory, &mut nodes, "0");
    recorded.assert_exit(3);
    assert!(recorded.text().contains("the reserve is 2 MiB"), "{}", recorded.text());
    assert!(recorded.happened(DiskFault::Limited));
    assert!(!recorded.happened(DiskFault::Full), "it stopped before that: {}", recorded.text());
    recorded.assert_verified("", 3);
    recorded.assert_accounted();
    let gaps = check_frames(&recorded.session);
    assert!(gaps[4..].iter().all(Vec::is_empty), "{gaps:?}");
    // Triggers that came before the train was stopped.
    assert!(gaps[..4].iter().flatten().all(|(_, cause)| *cause == GapCause::DroppedDisk), "{gaps:?}");
    let used: u64 = std::fs::read_dir(recorded.session.join("node-a"))
        .expect("a recording")
        .map(|entry| entry.and_then(|entry| entry.metadata()).expect("a segment").len())
        .sum();
    assert!(used > 18 << 20, "all but the reserve was used: {used}");
}

/// What became of the accounting of a recording whose disk failed.
#[derive(Debug, PartialEq, Eq)]
enum Accounting {
    /// The disk failed before the first trigger: the session was given up.
    NeverOpened,
    /// The session ended with a verdict.
    Closed,
    /// They could not be written any more.
    Missing,
}

/// A session during which one node's disk fails by this plan (without seed and nodes), and everything that must hold
/// whatever the moment of the failure.
fn recorded_on_a_failing_disk(dir: &Path, seed: u64, plan: &str) -> Option<(Recorded, Accounting)> {
    let (failing, other) = if seed % 2 == 1 { ("b", "a") } else { ("a", "b") };
    let plan = format!("[disk]\nseed = {seed}\nnodes = [\"{failing}\"]\n{plan}");
    let laboratory = laboratory_on(dir, &plan, |_| {})?;
    let mut nodes = start_nodes(&laboratory);
    let recorded = Recorded::capture(dir, &laboratory, &mut nodes, "200");
    let failed = recorded.happened(DiskFault::Full) || recorded.happened(DiskFault::IoError);
    assert!(failed, "the disk failed: {}", recorded.text());
    if recorded.output.status.code() == Some(1) {
        let named = recorded.text().contains(&format!("node {failing}: "));
        assert!(named && recorded.text().contains("cannot be written"), "{}", recorded.text());
        let gone = recorded.disks.iter().any(|event| event.for_good);
        assert!(gone || !recorded.session.exists(), "nothing is left behind: {}", recorded.text());
        return Some((recorded, Accounting::NeverOpened));
    }
    recorded.assert_exit(3);
    // The other node has every frame of every trigger that there was.
    recorded.assert_verified(&format!("node-{other}"), 3);
    assert_eq!(gaps(&recorded.session, &format!("node-{other}")), [], "{}", recorded.text());

    let reader = SessionReader::open(&recorded.session.join(format!("node-{failing}")))
        .expect("readable to where it came");
    let stored = reader.recordings()[0].verdict.clone();
    match &stored {
        Some(verdict) => {
            assert_eq!(verdict.status, Status::Aborted);
            let words = recorded.assert_verified("", 3);
            assert!(words.contains("dropped_disk"), "{words}");
            let gaps = check_frames(&recorded.session);
            let lost = gaps.iter().flatten();
            assert!(lost.clone().all(|(_, cause)| *cause == GapCause::DroppedDisk), "{gaps:?}");
            assert_eq!(lost.count() as u64, verdict.gaps());
        }
        None => {
            let words = recorded.assert_verified("", 4);
            assert!(words.contains("the recording was not finished"), "{words}");
            check_recovered(dir, &recorded, failing, other);
        }
    }
    recorded.assert_accounted();
    Some((recorded, if stored.is_some() { Accounting::Closed } else { Accounting::Missing }))
}

/// A recording without accounting: `recover` passes on as many frames as the node said that it had recorded, and what is
/// missing against the other node's recording gets its gap records.
fn check_recovered(dir: &Path, recorded: &Recorded, failing: &str, other: &str) {
    let text = text_of(&recorded.output);
    let said = text.split("it is: ").nth(1).and_then(|rest| rest.split(" frames").next());
    let said = said.and_then(|words| words.rsplit(' ').next()).and_then(|n| n.parse::<u64>().ok());
    let said = said.unwrap_or_else(|| panic!("the node says what it could not write: {text}"));
    let out = dir.join("recovered");
    let (source, target) = (recorded.session.display().to_string(), out.display().to_string());
    let output = fourdbody(&["recover", &source, "--out", &target]);
    assert_eq!(output.status.code(), Some(3), "{}", text_of(&output));
    let verified = fourdbody(&["verify", &target]);
    assert_eq!(verified.status.code(), Some(3), "{}", text_of(&verified));
    let reader = SessionReader::open(&out).expect("readable");
    let frames = |node: &str| {
        let recording = reader.recordings().iter().find(|r| r.header.node.as_str() == node);
        recording.and_then(|r| r.verdict.as_ref()).map(|verdict| (verdict.frames(), verdict.triggers))
    };
    let (whole, failed) = (frames(other).expect("finished"), frames(failing).expect("finished"));
    assert_eq!((failed.0, failed.1), (said, whole.1), "{}{text}", text_of(&output));
    assert_eq!(whole.0, 4 * whole.1, "the other node lost nothing");
}

/// Seeds of every test of failing disks: `FOURDBODY_DISK_SEEDS`, or few.
fn seeds() -> std::ops::RangeInclusive<u64> {
    1..=std::env::var("FOURDBODY_DISK_SEEDS").ok().and_then(|n| n.parse().ok()).unwrap_or(2)
}

#[test]
fn a_disk_that_is_full_at_any_byte_leaves_a_readable_recording() {
    for seed in seeds() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let plan =
            "[disk.full]\ncapacity_bytes = [1_000_000, 10_000_000]\nannounced_bytes = 1_000_000_000_000\n";
        let Some((recorded, _)) = recorded_on_a_failing_disk(dir.path(), seed, plan) else { return };
        assert!(recorded.happened(DiskFault::Full), "{}", recorded.text());
    }
}

#[test]
fn a_write_that_fails_once_costs_what_was_under_way_and_the_books_are_closed() {
    for seed in seeds() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let plan = "[[disk.error]]\non = \"write\"\nat_byte = [500_000, 10_000_000]\n";
        let Some((recorded, accounting)) = recorded_on_a_failing_disk(dir.path(), seed, plan) else {
            return;
        };
        assert!(accounting != Accounting::Missing, "there is room for the accounting: {}", recorded.text());
    }
}

#[test]
fn a_failed_fdatasync_costs_what_it_should_have_made_durable() {
    for seed in seeds() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let plan = "[[disk.error]]\non = \"sync\"\nnth = [4, 14]\n";
        let Some((recorded, accounting)) = recorded_on_a_failing_disk(dir.path(), seed, plan) else {
            return;
        };
        assert!(accounting != Accounting::Missing, "there is room for the accounting: {}", recorded.text());
    }
}

#[test]
fn a_disk_that_is_gone_leaves_what_was_durable() {
    for (seed, on) in seeds().zip(["write", "sync"].into_iter().cycle()) {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let nth = if on == "sync" { "[4, 12]" } else { "[20, 60]" };
        let plan = format!("[[disk.error]]\non = \"{on}\"\nnth = {nth}\nfor_good = true\n");
        let Some((recorded, accounting)) = recorded_on_a_failing_disk(dir.path(), seed, &plan) else {
            return;
        };
        assert!(accounting != Accounting::Closed, "nothing can be written any more: {}", recorded.text());
    }
}

#[test]
fn a_disk_that_fails_before_the_session_refuses_it_and_keeps_nothing() {
    for on in ["write", "sync"] {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let plan = format!("[disk]\nseed = 1\nnodes = [\"b\"]\n[[disk.error]]\non = \"{on}\"\nnth = 1\n");
        let Some(laboratory) = laboratory_on(dir.path(), &plan, |_| {}) else { return };
        let mut nodes = start_nodes(&laboratory);
        let refused = Recorded::capture(dir.path(), &laboratory, &mut nodes, "10");
        refused.assert_exit(1);
        assert!(refused.text().contains("node b") && refused.text().contains("cannot be written"));
        assert!(!refused.session.exists(), "{}", refused.text());
        // The next session is as good as any.
        let recorded = Recorded::capture(dir.path(), &laboratory, &mut nodes, "10");
        recorded.assert_exit(0);
        recorded.assert_verified("", 0);
    }
}
