//! Interrupted and damaged recordings are made whole: nothing wrong is passed on, nothing intact is left behind.

use crate::recording::{end, frame, header, options, pixels, trigger};
use fourdbody::ids::TriggerIndex;
use fourdbody::record::recover::{Recovered, interrupted, recover};
use fourdbody::record::verify::{Severity, verify};
use fourdbody::record::{GapCause, Recording, SessionReader};
use proptest::prelude::*;
use std::path::{Path, PathBuf};

const TRIGGERS: u64 = 40;
const CAMERAS: [&str; 2] = ["h0_up", "h0_low"];

/// A finished session of one node, with a gap; its only segment.
fn session(dir: &Path) -> PathBuf {
    let path = dir.join("session/node-a");
    let mut header = header("a", &CAMERAS, Some(TRIGGERS));
    // The rig would be most of the file.
    header.rig_text = "rig".to_owned();
    let mut recording = Recording::create(&path, header, options(1 << 30)).expect("created");
    for index in 0..TRIGGERS {
        recording.trigger(&trigger(index)).expect("recorded");
        for (number, camera) in CAMERAS.iter().enumerate() {
            let (meta, message) = frame(camera, number, index);
            if (number, index) == (1, 7) {
                recording.gap(1, TriggerIndex(7), GapCause::MissingPackets).expect("recorded");
            } else {
                recording.frame(number, &meta, &message).expect("recorded");
            }
        }
    }
    recording.finish(end(TRIGGERS)).expect("finished");
    path.join("segment-000.mcap")
}

/// Recovers the session in `dir`; every frame of the result is what was recorded, and verification finds nothing but
/// accounted loss.
fn recovered(dir: &Path) -> Option<(Recovered, u64)> {
    let (source, out) = (dir.join("session"), dir.join("out"));
    let _ = std::fs::remove_dir_all(&out);
    let result = recover(&source, &out, |_, _| {}).ok()?.remove(0);
    let report = verify(&out, &|_, _| {}).expect("readable");
    assert_ne!(report.worst, Some(Severity::Corrupt), "{report:?}");
    let reader = SessionReader::open(&out).expect("readable");
    let recording = &reader.recordings()[0];
    let mut frames = 0;
    for (camera, index) in (0..CAMERAS.len()).flat_map(|c| (0..reader_end(&reader)).map(move |i| (c, i))) {
        if let Ok(frame) = recording.frame(camera, TriggerIndex(index)).expect("an outcome for every trigger")
        {
            assert_eq!(frame.image.as_slice(), pixels(camera, index), "camera {camera} trigger {index}");
            frames += 1;
        }
    }
    Some((result, frames))
}

fn reader_end(reader: &SessionReader) -> u64 {
    use fourdbody::reconstruct::FrameSource;
    reader.triggers().end
}

#[test]
fn a_good_recording_is_recovered_as_it_is() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    session(dir.path());
    let (result, frames) = recovered(dir.path()).expect("usable");
    assert!(result.was_whole, "{result:?}");
    assert_eq!((frames, result.damaged, result.absent), (2 * TRIGGERS - 1, 0, 0));
    let gaps: Vec<_> = result.verdict.cameras.iter().map(|c| c.gap_count()).collect();
    assert_eq!((gaps, result.verdict.aborted), (vec![0, 1], None));
}

#[test]
fn what_is_behind_a_damaged_chunk_is_saved() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let segment = session(dir.path());
    let mut bytes = std::fs::read(&segment).expect("readable");
    // The length of a record in the middle of the file: the walk through that chunk breaks there.
    let length = |at: usize| u64::from_le_bytes(bytes[at + 1..at + 9].try_into().expect("8 bytes"));
    let middle = (bytes.len() / 2..bytes.len() - 9)
        .find(|&at| bytes[at] == 5 && (1000..100_000).contains(&length(at)));
    bytes[middle.expect("a message") + 4] ^= 0x40;
    std::fs::write(&segment, &bytes).expect("writable");
    let (result, frames) = recovered(dir.path()).expect("usable");
    assert!(!result.was_whole);
    assert!(frames >= 2 * TRIGGERS - 1 - 4, "one chunk of four frames may be gone: {frames}");
}

#[test]
fn an_unfinished_recording_is_found_and_a_finished_one_is_not() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let segment = session(dir.path());
    assert_eq!(interrupted(dir.path(), "a"), []);
    let bytes = std::fs::read(&segment).expect("readable");
    std::fs::write(&segment, &bytes[..bytes.len() / 3]).expect("writable");
    let found = interrupted(dir.path(), "a");
    assert_eq!(found.len(), 1);
    assert!(found[0].reason.contains("was not closed"), "{found:?}");
    assert_eq!(interrupted(dir.path(), "b"), []);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]
    #[test]
    fn nothing_wrong_is_ever_passed_on(cut in 0.02..1.2f64, flips in prop::collection::vec((0.0..1.0f64, 0u8..8), 0..4)) {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let segment = session(dir.path());
        let mut bytes = std::fs::read(&segment).expect("readable");
        bytes.truncate((bytes.len() as f64 * cut) as usize);
        for (place, bit) in &flips {
            let at = (bytes.len() as f64 * place) as usize;
            bytes[at] ^= 1 << bit;
        }
        let _ = std::fs::remove_file(&segment);
        std::fs::write(&segment, &bytes).expect("writable");
        // The frames that a cut leaves are all but those of the last chunks; a flip costs a chunk at most.
        let whole = if cut >= 1.0 { 2 * TRIGGERS - 1 } else { ((2 * TRIGGERS) as f64 * (cut - 0.02).max(0.0)) as u64 };
        if let Some((_, frames)) = recovered(dir.path()) {
            let lost = 8 + 4 * flips.len() as u64;
            prop_assert!(frames + lost >= whole, "{frames} frames of {whole}, {} flips", flips.len());
        } else {
            prop_assert!(!flips.is_empty() || cut < 0.2, "an intact beginning is always usable");
        }
    }
}

#[cfg(feature = "aravis")]
mod crash {
    use crate::lab::{FOURDBODY, fourdbody, laboratory, start_nodes, text_of};
    use fourdbody::ids::TriggerIndex;
    use fourdbody::reconstruct::FrameSource;
    use fourdbody::record::SessionReader;
    use fourdbody_simulator::gige::TestImages;
    use std::path::Path;
    use std::process::{Command, Stdio};
    use std::time::Duration;

    /// Frames that a crash of the process may cost beyond those that were reported: three chunks of four.
    const BOUND: u64 = 12;

    /// Frames in the recovered recording, each the right one.
    fn right_frames(session: &Path) -> u64 {
        let reader = SessionReader::open(session).expect("readable");
        let mut frames = 0;
        for (number, camera) in (1..).zip(reader.cameras()) {
            for trigger in reader.triggers() {
                let outcome = reader.recorded_frame(camera, TriggerIndex(trigger)).expect("an outcome");
                let Ok(frame) = outcome else { continue };
                let stamp =
                    TestImages::identify(frame.image.as_slice(), frame.image.width()).expect("a test image");
                assert_eq!((stamp.camera, u64::from(stamp.instant)), (number, trigger), "{camera} {trigger}");
                frames += 1;
            }
        }
        frames
    }

    /// `FOURDBODY_CRASHES` times: a session, the node killed at a moment of its own, recovered, verified.
    #[test]
    fn a_killed_node_loses_no_more_than_stated() {
        let runs: u64 = std::env::var("FOURDBODY_CRASHES").ok().and_then(|n| n.parse().ok()).unwrap_or(10);
        let dir = tempfile::tempdir().expect("a temporary directory");
        let laboratory = laboratory(dir.path(), 132, 60.0);
        let (mut state, mut losses, mut total) = (0x1234_5678_9abc_def1u64, Vec::new(), 0);
        let mut nodes = start_nodes(&laboratory);
        for run in 0..runs {
            let name = format!("run-{run}");
            let capture = Command::new(FOURDBODY)
                .args(["capture", "--nodes", &laboratory.urls(), "--triggers", "0", "--name", &name])
                .stdin(Stdio::null())
                .stdout(Stdio::null())
                .stderr(Stdio::null())
                .spawn()
                .expect("the binary starts");
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            let least = 1 + state % 80;
            nodes[0].wait_until("a moment to crash", |s| {
                s.session.as_ref().is_some_and(|s| s.name == name && s.triggers >= least)
            });
            std::thread::sleep(Duration::from_micros(state >> 8 & 0x7fff));
            let reported = nodes[0].client.status().expect("alive").session.expect("in it");
            let reported: u64 = reported.cameras.iter().map(|camera| camera.frames).sum();
            nodes[0].kill();
            let mut capture = capture;
            capture.wait().expect("it ends");

            let source = dir.path().join("sessions").join(&name).join("node-a");
            let out = dir.path().join("recovered").join(&name);
            let (source, target) = (source.display().to_string(), out.display().to_string());
            let output = fourdbody(&["recover", &source, "--out", &target]);
            let nothing_yet = reported <= BOUND && output.status.code() == Some(4);
            if !nothing_yet {
                assert!(matches!(output.status.code(), Some(0 | 3)), "run {run}: {}", text_of(&output));
                let verified = fourdbody(&["verify", &target]);
                assert!(matches!(verified.status.code(), Some(0 | 3)), "run {run}: {}", text_of(&verified));
                let frames = right_frames(&out);
                assert!(frames + BOUND >= reported, "run {run}: {frames} of {reported} reported frames");
                losses.push(reported.saturating_sub(frames));
                total += frames;
            }
            let file = &laboratory.nodes[0];
            nodes[0] = crate::lab::NodeProcess::start(&file.path, file.port);
            nodes.iter_mut().for_each(|node| drop(node.wait_ready()));
            assert!(nodes[0].log().contains("fourdbody recover"), "the operator is told how to recover");
            nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
            let _ = std::fs::remove_dir_all(dir.path().join("sessions"));
            let _ = std::fs::remove_dir_all(dir.path().join("recovered"));
        }
        losses.sort_unstable();
        println!(
            "{runs} kills: {total} frames recovered, all right; reported frames lost per kill: median {}, most {}",
            losses.get(losses.len() / 2).copied().unwrap_or(0),
            losses.last().copied().unwrap_or(0)
        );
    }
}
