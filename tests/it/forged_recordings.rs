// SPDX-License-Identifier: MIT OR Apache-2.0
//! Recordings whose checksums are right and whose contents are not: `verify`, `info`, `recover` and `export` name them, each
//! in the same words. How frames are forged source by source is `record::verify::tests`.

use crate::lab::{assert_contains, fourdbody, text_of};
use crate::recording::{begin, end, frame, header, options, quick_dir, record, trigger};
use crate::recording_damage::{as_recording, one_segment};
use fourdbody::base::ids::NodeId;
use fourdbody::record::{Recording, node_dir};
use std::path::{Path, PathBuf};
use std::process::Command;

/// Where what others made is, if it is here.
fn shared(name: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data").join(name);
    if !path.exists() {
        println!("skipped: {} is not here", path.display());
    }
    path.exists().then_some(path)
}

/// Exit code and text of a command on a path.
fn run(arguments: &[&str]) -> (Option<i32>, String) {
    let output = fourdbody(arguments);
    (output.status.code(), text_of(&output))
}

/// From a trigger on one camera's leaders carry the stamp of the frame before: the program filed its frames one trigger wrong.
#[test]
fn stamps_one_trigger_behind_are_corrupt() {
    let Some(archive) = shared("recordings/stamps-one-trigger-behind.tar.xz") else { return };
    let dir = quick_dir();
    let unpacked = Command::new("tar").arg("xf").arg(&archive).arg("-C").arg(dir.path()).status();
    assert!(unpacked.is_ok_and(|status| status.success()), "{}", archive.display());
    let session =
        std::fs::read_dir(dir.path()).expect("a directory").next().expect("a session").expect("read").path();
    let (code, text) = run(&["verify", &session.display().to_string()]);
    assert_eq!(code, Some(4), "{text}");
    assert_contains(
        &text,
        &["corrupt: node a camera h0_up triggers 51 to 198: not the frames of these triggers"],
    );
    let corrupt = text.lines().filter(|line| line.starts_with("corrupt:")).count();
    assert_eq!(corrupt, 1, "the other seven cameras are right: {text}");
    // Node b by itself is good.
    let (code, text) = run(&["verify", &session.join("node-b").display().to_string()]);
    assert_eq!(code, Some(0), "{text}");
    assert_contains(&text, &["two sources agree on each frame's trigger"]);
}

/// All commands say how to decompress it, and none makes an empty recording of it.
fn assert_compressed(path: &Path, out: &Path) {
    let (path, shown) = (path.display().to_string(), out.display().to_string());
    for arguments in [
        &["info", &path][..],
        &["verify", &path],
        &["recover", &path, "--out", &shown],
        &["export", &path, "--to", "png", "--out", &shown],
    ] {
        let (code, text) = run(arguments);
        assert_eq!(code, Some(4), "{arguments:?}: {text}");
        assert_contains(&text, &["compressed (zstd)", "mcap decompress"]);
        assert!(!out.exists(), "{arguments:?}");
    }
}

#[test]
fn a_compressed_recording_is_refused_with_what_to_do() {
    const CHUNK: u8 = 6;
    let (bytes, dir) = (one_segment(5), quick_dir());
    // What a chunk claims to hold once decompressed is not even looked at.
    let (mut at, mut compressed) = (8, bytes[..8].to_vec());
    while at < bytes.len() - 8 {
        let length = u64::from_le_bytes(bytes[at + 1..at + 9].try_into().expect("8 bytes")) as usize;
        let body = &bytes[at + 9..at + 9 + length];
        if bytes[at] == CHUNK {
            let fields =
                [&body[..16], &(1u64 << 40).to_le_bytes(), &body[24..28], &4u32.to_le_bytes(), b"zstd"]
                    .concat();
            let body = [&fields[..], &body[32..]].concat();
            compressed.extend([&[CHUNK][..], &(body.len() as u64).to_le_bytes(), &body].concat());
        } else {
            compressed.extend(&bytes[at..at + 9 + length]);
        }
        at += 9 + length;
    }
    compressed.extend(&bytes[bytes.len() - 8..]);
    let path = as_recording(dir.path(), &compressed);
    assert_compressed(&path, &dir.path().join("out"));
    assert_compressed(&path.join("segment-000.mcap"), &dir.path().join("out"));
    if let Some(theirs) = shared("reports/zstd_recording") {
        assert_compressed(&theirs, &dir.path().join("out"));
    }
}

/// A segment's number, its first trigger, and a frame's trigger: whatever a file says, it is named, and costs no more than the file.
#[test]
fn absurd_numbers_of_segments_and_triggers_are_named() {
    let dir = quick_dir();
    let path = dir.path().join("walk-01/node-a");
    record(&path, header("a", &["h0_up"], Some(20)), 20, &[]);
    let segment = |name: &str| path.join(name);
    let count = std::fs::read_dir(&path).expect("a directory").count();
    for (name, expected) in [
        ("segment-4294967295.mcap", format!("expected segment {count} here")),
        ("segment-0000.mcap", "two files have this segment's number".to_owned()),
    ] {
        std::fs::copy(segment("segment-000.mcap"), segment(name)).expect("copied");
        let (code, text) = run(&["verify", &path.display().to_string()]);
        assert_eq!(code, Some(4), "{name}: {text}");
        assert_contains(&text, &[&expected]);
        assert_contains(&run(&["info", &path.display().to_string()]).1, &[&expected]);
        std::fs::remove_file(segment(name)).expect("there");
    }
    for name in ["segment-4294967295.mcap", "segment-04294967295.mcap", "segment-0000.mcap"] {
        std::fs::copy(segment("segment-000.mcap"), segment(name)).expect("copied");
    }
    assert_eq!(run(&["verify", &path.display().to_string()]).0, Some(4));
    let out = dir.path().join("recovered");
    let (code, text) = run(&["recover", &path.display().to_string(), "--out", &out.display().to_string()]);
    assert_eq!(code, Some(3), "{text}");
    assert!(!text.contains("panicked"), "{text}");
}

#[test]
fn a_trigger_far_behind_all_others_costs_no_more_than_its_file() {
    let dir = quick_dir();
    let path = dir.path().join("walk-01/node-a");
    let header = header("a", &["h0_up", "h0_low"], None);
    let mut recording = Recording::create(&path, header.clone(), options(1 << 30)).expect("created");
    begin(&mut recording, &header);
    for index in [0, 1, 2, 16_000_000] {
        recording.trigger(&trigger(index)).expect("recorded");
        for (number, camera) in header.cameras.iter().enumerate() {
            let (meta, message) = frame(camera.id.as_str(), number, index);
            recording.frame(number, &meta, &message).expect("recorded");
        }
    }
    recording.tick().expect("kept");
    drop(recording);
    let (shown, out) = (path.display().to_string(), dir.path().join("out").display().to_string());
    for (arguments, expected) in [(&["verify", &shown][..], Some(4)), (&["info", &shown], Some(0))] {
        let (code, text) = run(arguments);
        assert_eq!(code, expected, "{arguments:?}: {text}");
        assert_contains(&text, &["bytes cannot have that many triggers"]);
    }
    let (_, text) = run(&["export", &shown, "--to", "png", "--out", &out]);
    assert!(text.len() < 1 << 20, "{} bytes of complaints", text.len());
    let (code, text) = run(&["recover", &shown, "--out", &out]);
    assert!(matches!(code, Some(2 | 3)), "{text}");
}

/// A node that is killed while it holds frames before Record leaves a recording without triggers: `recover` and `verify`
/// tell the same of it.
#[test]
fn a_recording_without_triggers_is_the_same_to_recover_and_to_verify() {
    let dir = quick_dir();
    let session = dir.path().join("walk-01");
    for (node, cameras) in [("a", ["h0_up", "h0_low"]), ("b", ["h2_up", "h2_low"])] {
        let header = header(node, &cameras, None);
        let path = node_dir(&session, &NodeId::from(node));
        let mut recording = Recording::create(&path, header.clone(), options(1 << 30)).expect("created");
        begin(&mut recording, &header);
        recording.tick().expect("kept");
        drop(recording);
    }
    let out = dir.path().join("recovered").display().to_string();
    let recovered = run(&["recover", &session.display().to_string(), "--out", &out]);
    let verified = run(&["verify", &out]);
    assert_eq!((recovered.0, verified.0), (Some(3), Some(3)), "{}\n{}", recovered.1, verified.1);
    assert_contains(&recovered.1, &["it was interrupted"]);
    assert_contains(&verified.1, &["interrupted before the first trigger"]);
}

/// A header that nobody can read is rebuilt from the frames: the result is what `verify` accepts, and says what it rests on.
#[test]
fn a_header_made_anew_is_accepted_by_verify() {
    let dir = quick_dir();
    for rig in [true, false] {
        let path = dir.path().join(format!("walk-{rig}/node-a"));
        let mut header = header("a", &["h0_up", "h0_low"], Some(12));
        if !rig {
            header.rig_text = "rig".to_owned();
        }
        let mut recording = Recording::create(&path, header.clone(), options(1 << 30)).expect("created");
        begin(&mut recording, &header);
        for index in 0..12 {
            recording.trigger(&trigger(index)).expect("recorded");
            for (number, camera) in header.cameras.iter().enumerate() {
                let (meta, message) = frame(camera.id.as_str(), number, index);
                recording.frame(number, &meta, &message).expect("recorded");
            }
        }
        recording.finish(end(12)).expect("finished");
        let segment = path.join("segment-000.mcap");
        let mut bytes = std::fs::read(&segment).expect("readable");
        // The JSON of the header, wherever it stands.
        let wanted = b"\"trigger_rate_hz\"";
        let places: Vec<usize> =
            (0..bytes.len() - wanted.len()).filter(|at| bytes[*at..].starts_with(wanted)).collect();
        places.iter().for_each(|at| bytes[*at] = b'?');
        std::fs::write(&segment, bytes).expect("written");
        let (code, text) = run(&["verify", &path.display().to_string()]);
        assert_eq!(code, Some(4), "{text}");
        let out = dir.path().join(format!("recovered-{rig}")).display().to_string();
        let (code, text) = run(&["recover", &path.display().to_string(), "--out", &out]);
        assert_eq!(code, Some(3), "{text}");
        let (code, text) = run(&["verify", &out]);
        assert!(matches!(code, Some(0 | 3)), "{text}");
    }
}
