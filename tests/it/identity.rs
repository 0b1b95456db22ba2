// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which trigger a frame is of: cameras that stamp late, not at all or wrongly, that send late, and whose clock cannot
//! be read, against real nodes; and recordings whose frames are not those of their triggers.

use crate::lab::{fourdbody, options, small_rig, start_laboratory, start_nodes, text_of};
use crate::session_faults::check_frames;
use fourdbody::record::{GapCause, SessionReader, Status, WarmUp};
use fourdbody_simulator::faults::{FaultPlan, Shown, check, read_truth};
use fourdbody_simulator::gige::{ClockHabit, Habits};
use fourdbody_simulator::laboratory::{LaboratoryOptions, TRUTH_FILE};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

const TRIGGERS: u64 = 120;

/// At 40 Hz a period is 25 ms. Every frame must show the trigger that it is recorded under (`check_frames`).
#[test]
fn cameras_that_stamp_and_send_when_they_like_are_never_a_trigger_off() {
    let late = |stamp_ms, send_ms| Habits {
        stamp_late: Duration::from_millis(stamp_ms),
        send_late: Duration::from_millis(send_ms),
        ..Habits::default()
    };
    let no_clock = |habits| Habits { clock: ClockHabit::NoFrequency, ..habits };
    let habits = [
        // The end of exposure, of readout, the leader's sending.
        ("h0_up", late(13, 14)),
        ("h0_low", late(35, 36)),
        // No clock that can be read, and frames that come up to two and a half periods after their triggers.
        ("h1_up", no_clock(late(0, 36))),
        ("h1_low", no_clock(late(20, 62))),
        // No stamps.
        ("h2_up", Habits { no_stamps: true, ..late(0, 36) }),
        ("h2_low", Habits { no_stamps: true, ..no_clock(late(0, 1)) }),
    ];
    let text = "[faults]\nseed = 5\n[[fault]]\ncamera = \"h3_up\"\ntrigger = 20\nkind = \"stamp_glitch\"\n\
        [[fault]]\ncamera = \"h3_low\"\ntrigger = 30\nkind = \"stamp_absent\"\n\
        [[fault]]\ncamera = \"h0_low\"\ntrigger = 40\nkind = \"stamp_glitch\"\n\
        [[fault]]\ncamera = \"h3_low\"\ntrigger = 60\nkind = \"stamp_glitch\"\n";
    let dir = tempfile::tempdir().expect("a temporary directory");
    let options = LaboratoryOptions {
        habits: habits.into_iter().map(|(camera, habits)| (camera.to_owned(), habits)).collect(),
        faults: Some(FaultPlan::parse(text).expect("a valid plan")),
        ..options(small_rig(40.0), dir.path())
    };
    let laboratory = start_laboratory(&options);
    let mut nodes = start_nodes(&laboratory);
    let triggers = TRIGGERS.to_string();
    let captured =
        fourdbody(&["capture", "--nodes", &laboratory.urls(), "--triggers", &triggers, "--name", "habits"]);
    nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
    let session = dir.path().join("sessions/habits");
    let gaps = check_frames(&session);
    // A host that is too busy makes frames late: some are given up by name then, and none stands wrong.
    let missing: Vec<_> = gaps.iter().flatten().collect();
    let by_host = [GapCause::IdentityMismatch, GapCause::Timeout, GapCause::NodePaused];
    assert!(missing.iter().all(|(_, cause)| by_host.contains(cause)), "{gaps:?}");
    // Four cameras have no timestamps: where the host sleeps through the warm-up they are not placed, and named.
    let reader = SessionReader::open(&session).expect("readable");
    let events = || reader.recordings().iter().flat_map(|recording| &recording.events);
    let named = events().filter(|event| event.kind == "place_unknown").count() as u64;
    // One without stamps that was placed has the arrivals alone beside its ids: a busy host can cost it all
    // (`acquisition.md`), and no other that.
    let whole = gaps.iter().enumerate().filter(|(_, gaps)| gaps.len() as u64 == TRIGGERS);
    let unstamped = whole.filter(|(camera, _)| [4, 5].contains(camera)).count() as u64;
    let lost = named.max(unstamped.min(1));
    assert!(named <= 4 && missing.len() as u64 <= (8 * TRIGGERS) / 10 + lost * TRIGGERS, "{gaps:?}");
    let expected = if missing.is_empty() { 0 } else { 3 };
    assert_eq!(captured.status.code(), Some(expected), "{}", text_of(&captured));
    let verified = fourdbody(&["verify", &session.display().to_string()]);
    assert_eq!(verified.status.code(), Some(expected), "{}", text_of(&verified));
    let truth = read_truth(&dir.path().join(TRUTH_FILE)).expect("the truth");
    let accounting = check(&truth, &[&session], Shown::TestImages).expect("a session");
    assert!(accounting.mismatches <= missing.len() as u64, "{:#?}", accounting.listed);
    for recording in reader.recordings() {
        let warm_up = recording.events.iter().filter_map(WarmUp::of).count();
        assert!(warm_up == 8 + 4 * 8 || named > 0, "{warm_up} raw triggers and frames of the warm-up");
        let status = recording.verdict.as_ref().map(|verdict| verdict.status);
        assert!(status == Some(Status::Complete) || !missing.is_empty(), "{status:?}");
    }
}

/// Where the recordings of others are, if they are here.
fn shared(name: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/recordings").join(name);
    if !path.exists() {
        println!("skipped: {} is not here", path.display());
    }
    path.exists().then_some(path)
}

/// One stream leader with a forged stamp, and from then on node a's frames are those of the next triggers.
#[test]
fn recordings_whose_frames_are_a_trigger_late_are_corrupt() {
    for name in ["one-forged-leader", "one-forged-leader-60ms-all-cameras"] {
        let Some(archive) = shared(&format!("{name}.tar.xz")) else { return };
        let dir = tempfile::tempdir().expect("a temporary directory");
        let unpacked = Command::new("tar").arg("xf").arg(&archive).arg("-C").arg(dir.path()).status();
        assert!(unpacked.is_ok_and(|status| status.success()), "{}", archive.display());
        let verified = fourdbody(&["verify", &dir.path().join(name).display().to_string()]);
        let text = text_of(&verified);
        assert_eq!(verified.status.code(), Some(4), "{name}: {text}");
        assert!(text.contains("not the frames of these triggers"), "{name}: {text}");
        let named = |camera: &str| {
            let line =
                |line: &&str| line.contains(camera) && line.contains("not the frames of these triggers");
            text.lines().any(|text| line(&text) && text.contains("triggers"))
        };
        assert!(["h0_up", "h0_low", "h1_up", "h1_low"].iter().any(|camera| named(camera)), "{name}: {text}");
    }
}
