// SPDX-License-Identifier: MIT OR Apache-2.0
//! Sessions of which a part, or nothing, can be read: the rest is used, the part is named, no exit code says that all is well; and
//! whose fault it is decides the code: 2 where there is no session, 4 where it cannot be read.

use crate::lab::{assert_contains, fourdbody, text_of};
use crate::recording::{header, record};
use crate::reused::{Place, json, reconstruct};
use fourdbody::base::ids::{CameraId, NodeId, TriggerIndex};
use fourdbody::config::Rig;
use fourdbody::data::{Calibration, FrameSource};
use fourdbody::record::{ReadError, SessionReader, node_dir};
use fourdbody_simulator::faults::check::{Shown, check};
use std::path::{Path, PathBuf};

const OF_A: [&str; 4] = ["h0_up", "h0_low", "h1_up", "h1_low"];
const OF_B: [&str; 4] = ["h2_up", "h2_low", "h3_up", "h3_low"];

/// A way to lose a recording: its directory is given.
type Spoil = fn(&Path);

fn segments(recording: &Path) -> Vec<PathBuf> {
    let entries = recording.read_dir().expect("a directory").flatten();
    entries.map(|entry| entry.path()).filter(|path| path.extension().is_some()).collect()
}

fn overwrite_headers(recording: &Path) {
    for path in segments(recording) {
        let mut bytes = std::fs::read(&path).expect("readable");
        bytes[8..400].fill(0xa5);
        std::fs::write(&path, bytes).expect("writable");
    }
}

const SPOILS: [(&str, Spoil); 4] = [
    ("its headers are overwritten", overwrite_headers),
    ("its segments are empty", |recording| {
        segments(recording).iter().for_each(|path| std::fs::write(path, b"").expect("writable"));
    }),
    ("it has no segments", |recording| {
        segments(recording).iter().for_each(|path| std::fs::remove_file(path).expect("ours"));
    }),
    ("its disk is away", |recording| {
        std::fs::remove_dir_all(recording).expect("ours");
        std::os::unix::fs::symlink("/nowhere/at/all", recording).expect("linked");
    }),
];

fn session(root: &Path) -> PathBuf {
    let session = root.join("walk-01");
    for (node, cameras) in [("a", &OF_A), ("b", &OF_B)] {
        record(&node_dir(&session, &NodeId::from(node)), header(node, cameras, Some(3)), 3, &[]);
    }
    session
}

fn text(path: &Path) -> &str {
    path.to_str().expect("UTF-8")
}

/// Runs a command; its output is returned when its exit code is this one.
fn exits(args: &[&str], code: i32) -> String {
    let output = fourdbody(args);
    let said = text_of(&output);
    assert_eq!(output.status.code(), Some(code), "{args:?}: {said}");
    said
}

#[test]
fn a_recording_that_cannot_be_read_does_not_hide_the_other() {
    for (what, spoil) in SPOILS {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let session = session(dir.path());
        spoil(&session.join("node-b"));
        for reader in [SessionReader::open(&session), SessionReader::open_frames(&session)] {
            let reader = reader.unwrap_or_else(|e| panic!("{what}: {e}"));
            let [lost] = reader.unreadable() else { panic!("{what}: {:?}", reader.unreadable()) };
            assert_eq!(lost.node, "b", "{what}");
            assert_eq!(reader.cameras().len(), 8, "{what}: what is lost has its cameras");
            assert_eq!(reader.statement().map(|stated| stated.cameras.len()), Some(4), "{what}");
            for (camera, there) in OF_A.map(|id| (id, true)).into_iter().chain(OF_B.map(|id| (id, false))) {
                let frame = reader.recorded_frame(&CameraId::from(camera), TriggerIndex(1));
                match frame {
                    Ok(frame) => assert!(there && frame.is_ok(), "{what}: {camera}"),
                    Err(reason) => assert!(!there && reason.contains("node b"), "{what}: {reason}"),
                }
            }
        }
        let accounting = check(&[], &[&session], Shown::Scene).expect("readable");
        assert!(accounting.listed.iter().any(|line| line.contains("node b")), "{what}: {accounting:?}");

        let path = |name: &str| dir.path().join(name).display().to_string();
        let session = text(&session);
        assert_contains(&exits(&["info", session], 4), &["node-b", "NOT READABLE", "session     walk-01"]);
        exits(&["verify", session], 4);
        let said = exits(&["report", session, "--out", &path("page.html")], 4);
        assert_contains(&said, &["NOT READABLE", "node b"]);
        let page = std::fs::read_to_string(path("page.html")).expect("a page");
        assert_contains(&page, &["not whole", "node b cannot be read", "Node a"]);
        assert!(!page.contains(">complete<"), "{what}");

        let out = path("pictures");
        let said = exits(&["export", session, "--to", "png,csv", "--out", &out], 4);
        assert_contains(&said, &["NOT READABLE", "node b", "12 damaged"]);
        assert!(OF_A.iter().all(|camera| Path::new(&out).join(camera).join("000002.png").exists()), "{what}");
        let table = std::fs::read_to_string(Path::new(&out).join("timing.csv")).expect("a table");
        assert_eq!(table.lines().filter(|line| line.contains(",a,frame,")).count(), 12, "{what}");
        assert_eq!(table.lines().filter(|line| line.contains("h3_low,,damaged,")).count(), 3, "{what}");
        // Whoever asks for what is there gets it, and is told of the rest.
        let part = ["export", session, "--to", "png", "--cameras", "h0_up", "--out", &path("part")];
        assert_contains(&exits(&part, 0), &["NOT READABLE", "node b"]);
    }
}

#[test]
fn clouds_of_half_a_session_are_never_those_of_a_whole_one() {
    let place = Place::new();
    let rig = std::fs::read_to_string(place.path("rig.toml")).expect("readable");
    let mut rig: toml::Table = rig.parse().expect("valid");
    rig["head"][0]["camera"][1]["node"] = "b".into();
    std::fs::write(place.path("rig.toml"), rig.to_string()).expect("writable");
    let session = place.session("walk");
    assert_eq!(reconstruct(&place, &session, &place.path("whole"), &[]).status.code(), Some(0));
    overwrite_headers(&session.join("node-b"));
    let half = reconstruct(&place, &session, &place.path("half"), &[]);
    assert_eq!(half.status.code(), Some(4), "{}", text_of(&half));
    assert_contains(&text_of(&half), &["NOT READABLE  node b", "NOT WHOLE: node b"]);
    let summary = json(&place.path("half").join("summary.json"));
    assert_eq!((&summary["frames"], &summary["damaged"]), (&2.into(), &1.into()), "{summary}");
    assert!(summary["unreadable"][0].as_str().is_some_and(|told| told.contains("node b")), "{summary}");
    // Neither is the half taken for the whole one that is there already.
    let again = reconstruct(&place, &session, &place.path("whole"), &[]);
    assert_eq!(again.status.code(), Some(2), "{}", text_of(&again));
    let asked = reconstruct(&place, &session, &place.path("asked"), &["--cameras", "h0_up"]);
    assert_contains(&text_of(&asked), &["NOT READABLE  node b"]);
    assert!(json(&place.path("asked").join("summary.json"))["unreadable"].is_null());
}

/// What no session is, is a mistake of whoever named it; what is one and cannot be read is corrupt.
#[test]
fn the_exit_code_tells_a_wrong_path_from_a_session_that_cannot_be_read() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = |name: &str| dir.path().join(name).display().to_string();
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let (rig, board) = (root.join("config/rig.toml"), root.join("config/board.toml"));
    let calibration = path("calibration.json");
    let nominal = Calibration::nominal(&Rig::load(&rig).expect("the shipped rig"));
    nominal.save(Path::new(&calibration)).expect("writable");
    let spoiled = session(dir.path());
    overwrite_headers(&spoiled.join("node-a"));
    overwrite_headers(&spoiled.join("node-b"));
    assert!(matches!(SessionReader::open(&spoiled), Err(ReadError::Unreadable(_))));
    let (out, nothing) = (path("out"), path("nothing"));
    let (rig, board) = (text(&rig), text(&board));
    for (session, code) in [(text(&spoiled), 4), (&nothing, 2)] {
        exits(&["info", session], code);
        exits(&["verify", session], code);
        exits(&["report", session, "--out", &path("page.html")], code);
        exits(&["export", session, "--to", "png", "--out", &out], code);
        exits(&["export", session, "--to", "csv", "--out", &out], code);
        exits(&["reconstruct", session, "--calibration", &calibration, "--out", &out], code);
        let result = ["--rig", rig, "--board", board, "--out", &path("new.json")];
        exits(&[&["calibrate", "--session", session][..], &result].concat(), code);
        let what = ["--clouds", &path("clouds"), "--board", board, "--calibration", &calibration];
        exits(&[&["validate", "distance", "--session", session][..], &what].concat(), code);
    }
    exits(&["recover", &nothing, "--out", &path("saved")], 2);
    // One segment by itself, and a disk that gives nothing.
    exits(&["export", text(&segments(&spoiled.join("node-a"))[0]), "--to", "png", "--out", &out], 4);
    // A directory of something else is no session.
    std::fs::create_dir(path("else")).expect("writable");
    exits(&["export", &path("else"), "--to", "png", "--out", &out], 2);
    exits(&["reconstruct", &path("else"), "--calibration", &calibration, "--out", &out], 2);
    // Clouds.
    exits(&["view", &path("no.ply"), "--out", &path("no.png")], 2);
    std::fs::write(path("bad.ply"), "ply\nnothing").expect("writable");
    exits(&["view", &path("bad.ply"), "--out", &path("no.png")], 4);
    exits(&["validate", "spacing", "--clouds", &nothing], 2);
}
