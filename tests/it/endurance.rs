// SPDX-License-Identifier: MIT OR Apache-2.0
//! Many sessions in one process, and one session that is long: nothing grows, ids wrap unnoticed.

use crate::lab::{self, fourdbody, laboratory_of, start_nodes, text_of, turn};
use fourdbody::base::ids::TriggerIndex;
use fourdbody::data::FrameSource;
use fourdbody::record::SessionReader;
use fourdbody_simulator::gige::TestImages;
use std::path::Path;
use std::time::{Duration, Instant};

fn asked(variable: &str, otherwise: u64) -> u64 {
    std::env::var(variable).ok().and_then(|n| n.parse().ok()).unwrap_or(otherwise)
}

/// Resident memory (KiB), threads and open descriptors of a process.
fn usage(pid: u32) -> [u64; 3] {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).expect("a process");
    let field = |name: &str| {
        let line = status.lines().find(|line| line.starts_with(name)).expect("a field");
        line.split_whitespace().nth(1).and_then(|n| n.parse().ok()).expect("a number")
    };
    let descriptors = std::fs::read_dir(format!("/proc/{pid}/fd")).expect("a process").count() as u64;
    [field("VmRSS:"), field("Threads:"), descriptors]
}

/// Usage at rest: threads and descriptors that have not changed for a second. A connection whose other end has gone is closed
/// a moment later.
fn usage_at_rest(pid: u32) -> [u64; 3] {
    let deadline = Instant::now() + Duration::from_secs(60);
    let mut last = usage(pid);
    let mut unchanged = 0;
    while unchanged < 20 {
        assert!(Instant::now() < deadline, "threads and descriptors still change: {last:?}");
        std::thread::sleep(Duration::from_millis(50));
        let now = usage(pid);
        unchanged = if now[1..] == last[1..] { unchanged + 1 } else { 0 };
        last = now;
    }
    last
}

/// What the sessions after the first quarter may leave in a process, however many they are, KiB. Measured: 70 to 140 in
/// 15 to 225 sessions (allocator arenas that fill up), where one session has 9,500 for itself.
const LEFT_KIB: u64 = 2048;

/// `FOURDBODY_CYCLES` sessions of three triggers in the same two node processes.
#[test]
fn sessions_in_a_row_leave_nothing_behind() {
    let _turn = turn();
    let cycles = asked("FOURDBODY_CYCLES", 20).max(4);
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = laboratory_of(dir.path(), 100.0, (64, 48), 1);
    let mut nodes = start_nodes(&laboratory);
    // Beside other tests one session in twenty has lost a node's frames, why is not known; the loss was told each time.
    let mut incomplete = Vec::new();
    let mut seen = Vec::new();
    for cycle in 0..cycles {
        let name = format!("cycle-{cycle}");
        let output =
            fourdbody(&["capture", "--nodes", &laboratory.urls(), "--triggers", "3", "--name", &name]);
        let logs = || nodes.iter().map(lab::NodeProcess::log).collect::<Vec<_>>().join("\n");
        match output.status.code() {
            Some(0) => {}
            Some(3) => {
                println!("cycle {cycle}: {}\n{}", text_of(&output), logs());
                incomplete.push(cycle);
            }
            _ => panic!("cycle {cycle}: {}\n{}", text_of(&output), logs()),
        }
        let most = cycles / 10;
        assert!(
            incomplete.len() as u64 <= most,
            "cycles {incomplete:?} lost frames, expected {most} of {cycles} at most"
        );
        nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
        std::fs::remove_dir_all(dir.path().join("sessions").join(&name)).expect("recorded");
        if cycle + 1 == cycles / 4 || cycle + 1 == cycles {
            seen.push(nodes.iter().map(|node| usage_at_rest(node.pid())).collect::<Vec<_>>());
        }
    }
    println!("{cycles} cycles: KiB, threads and descriptors of each node after a quarter {:?}", seen[0]);
    println!("{cycles} cycles: KiB, threads and descriptors of each node at the end {:?}", seen[1]);
    for (quarter, end) in seen[0].iter().zip(&seen[1]) {
        let ([before, threads, descriptors], [after, threads_after, descriptors_after]) = (*quarter, *end);
        assert_eq!((threads_after, descriptors_after), (threads, descriptors));
        assert!(after < before + LEFT_KIB, "{before} KiB after a quarter, {after} KiB at the end");
    }
}

/// `FOURDBODY_TRIGGERS` triggers; the ids begin shortly before their wrap, so that a short run wraps as well.
#[test]
fn block_ids_wrap_within_a_session() {
    let _turn = turn();
    let triggers = asked("FOURDBODY_TRIGGERS", 600);
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = laboratory_of(dir.path(), 200.0, (64, 48), 65_300);
    let _nodes = start_nodes(&laboratory);
    let count = triggers.to_string();
    let output =
        fourdbody(&["capture", "--nodes", &laboratory.urls(), "--triggers", &count, "--name", "long"]);
    assert!(matches!(output.status.code(), Some(0 | 3)), "{}", text_of(&output));
    let session = dir.path().join("sessions/long");
    let verified = fourdbody(&["verify", &session.display().to_string()]);
    assert_eq!(verified.status.code(), output.status.code(), "{}", text_of(&verified));
    println!("{}", text_of(&output));
    let (frames, wrapped) = right_frames(&session, triggers);
    println!("{triggers} triggers: {frames} frames of {}, {wrapped} cameras whose ids wrapped", 8 * triggers);
    assert_eq!(wrapped, 8, "{}", text_of(&verified));
    // A busy machine may lose some. Without all from before or all from behind the wrap three fifths would be left, at most.
    assert!(frames * 4 >= 8 * triggers * 3, "too few: {frames}");
}

/// Frames, each checked against its image; and the cameras whose block ids fell once.
fn right_frames(session: &Path, triggers: u64) -> (u64, usize) {
    let reader = SessionReader::open(session).expect("readable");
    assert_eq!(reader.triggers(), 0..triggers);
    let (mut frames, mut wrapped) = (0, 0);
    for (number, camera) in (1..).zip(reader.cameras()) {
        let (mut last, mut falls) = (0, 0);
        for trigger in reader.triggers() {
            let Ok(frame) = reader.recorded_frame(camera, TriggerIndex(trigger)).expect("intact") else {
                continue;
            };
            let stamp =
                TestImages::identify(frame.image.as_slice(), frame.image.width()).expect("a test image");
            let shown = (stamp.camera, u64::from(stamp.instant) % TestImages::DISTINCT as u64);
            assert_eq!(shown, (number, trigger % TestImages::DISTINCT as u64), "{camera} {trigger}");
            falls += usize::from(frame.meta.block.0 < last);
            last = frame.meta.block.0;
            frames += 1;
        }
        wrapped += usize::from(falls > 0);
    }
    (frames, wrapped)
}
