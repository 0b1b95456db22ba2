// SPDX-License-Identifier: MIT OR Apache-2.0
//! Recordings on a disk that cannot be read everywhere, and segments that are no files: every command says so, uses
//! the rest, and ends.

use crate::lab::{assert_contains, fourdbody, text_of};
use crate::recording_regions::{Region, frames, good};
use fourdbody::record::recover::recover;
use fourdbody::record::verify::{Severity, verify};
use fourdbody::record::{SessionReader, catalogue, open_each};
use fourdbody_simulator::disk::{DiskPlan, ReadFault, SimulatedDisk};
use std::collections::BTreeSet;
use std::ffi::CString;
use std::os::unix::net::UnixListener;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

const BLOCK: usize = 4096;

fn segment(number: usize) -> String {
    format!("walk/node-a/segment-{number:03}.mcap")
}

/// The good recording in a session's directory below `root`.
fn write(root: &Path) -> PathBuf {
    std::fs::create_dir_all(root.join("walk/node-a")).expect("directories");
    for (number, anatomy) in good().iter().enumerate() {
        std::fs::write(root.join(segment(number)), &anatomy.bytes).expect("written");
    }
    root.join("walk")
}

/// A disk with the good recording; `None`, and it is said, where there is no FUSE.
fn disk(dir: &Path) -> Option<SimulatedDisk> {
    if let Some(reason) = SimulatedDisk::unavailable() {
        eprintln!("skipped, no disk can be simulated here: {reason}");
        return None;
    }
    write(&dir.join("backing"));
    let plan = DiskPlan::parse("[disk]\nseed = 1\n").expect("valid").expect("there");
    let mounted = SimulatedDisk::mount(&plan, "a", &dir.join("backing"), &dir.join("disk"), None);
    Some(mounted.expect("it can be mounted"))
}

/// Every frame of the recording, but for those with a byte in this range.
fn untouched(number: usize, from: usize, to: usize) -> BTreeSet<(usize, u64)> {
    let all = good().iter().enumerate().flat_map(|(n, segment)| segment.frames.iter().map(move |f| (n, f)));
    all.filter(|(n, (_, _, at))| *n != number || at.end <= from || at.start >= to)
        .map(|(_, (camera, trigger, _))| (*camera, *trigger))
        .collect()
}

#[test]
fn a_sector_that_cannot_be_read_costs_what_is_in_it() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let Some(disk) = disk(dir.path()) else { return };
    let session = disk.mount_point().join("walk");
    let mut tried = BTreeSet::new();
    for (number, anatomy) in good().iter().enumerate() {
        for (region, ranges) in &anatomy.regions {
            let range = &ranges[ranges.len() / 2];
            let from = range.start - range.start % BLOCK;
            let to = (from + BLOCK).min(anatomy.bytes.len());
            if !tried.insert((*region, number, from)) {
                continue;
            }
            let what = format!("segment {number} bytes {from} to {to}, {region:?}");
            let fault = ReadFault { path: segment(number), from: from as u64, to: Some(to as u64) };
            disk.set_unreadable(vec![fault]);

            let report = verify(&session, &|_, _| ()).unwrap_or_else(|e| panic!("{what}: {e}"));
            assert_eq!(report.worst, Some(Severity::Corrupt), "{what}");
            let named = report.findings.iter().any(|finding| {
                finding.segment == Some(number as u32) && finding.message.contains("cannot be read")
            });
            assert!(named, "{what}: {:#?}", report.findings);

            let (recordings, unreadable) = open_each(&session).expect("listed");
            assert!(unreadable.is_empty() && recordings.len() == 1, "{what}: {unreadable:?}");
            let expected = untouched(number, from, to);
            let reader = SessionReader::open_frames(&session).unwrap_or_else(|e| panic!("{what}: {e}"));
            for (camera, trigger) in &expected {
                let frame =
                    reader.recordings()[0].frame(*camera, fourdbody::base::ids::TriggerIndex(*trigger));
                // Where the index is what cannot be read, a frame whose record is there but whose way to it is not is
                // what `recover` finds.
                if *region == Region::Pixels {
                    assert!(matches!(frame, Ok(Ok(_))), "{what}: {camera} {trigger}: {:?}", frame.err());
                }
            }
            fourdbody::report::gather(&session, None).unwrap_or_else(|e| panic!("{what}: {e}"));

            let out = dir.path().join(format!("out-{number}-{from}-{region:?}"));
            let recovery = recover(&session, &out, &|_, _| ()).unwrap_or_else(|e| panic!("{what}: {e}"));
            assert!(!recovery.lossless(), "{what}");
            let damage = recovery.recordings[0].damage.iter();
            assert!(damage.map(ToString::to_string).any(|d| d.contains("cannot be read")), "{what}");
            let report = verify(&out, &|_, _| ()).expect("readable");
            assert_ne!(report.worst, Some(Severity::Corrupt), "{what}: {:#?}", report.findings);
            let saved = frames(&SessionReader::open(&out).expect("readable"), 0);
            let lost: Vec<_> = expected.difference(&saved).collect();
            assert!(lost.is_empty(), "{what}: whole frames were lost: {lost:?}");
        }
    }
}

#[test]
fn every_command_says_what_it_could_not_read() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let Some(disk) = disk(dir.path()) else { return };
    let session = disk.mount_point().join("walk").display().to_string();
    let path = |name: &str| dir.path().join(name).display().to_string();
    let pixels = &good()[1].regions[&Region::Pixels][0];
    let (from, to) = (pixels.start as u64, Some(pixels.start as u64 + 1));
    disk.set_unreadable(vec![ReadFault { path: segment(1), from, to }]);
    let run = |args: &[&str], code: i32| {
        let output = fourdbody(args);
        assert_eq!(output.status.code(), Some(code), "{args:?}: {}", text_of(&output));
        text_of(&output)
    };
    run(&["info", &session], 0);
    let said = run(&["verify", &session], 4);
    assert_contains(&said, &["segment 1", "cannot be read: Input/output error", "trigger"]);
    run(&["recover", &session, "--out", &path("saved")], 3);
    run(&["verify", &path("saved")], 3);
    run(&["report", &session, "--out", &path("page.html")], 0);
    let said = run(&["export", &session, "--to", "png", "--out", &path("pictures")], 4);
    assert_contains(&said, &["cannot be read: Input/output error", "1 damaged"]);

    // The whole second segment, as a disk that is dying.
    disk.set_unreadable(vec![ReadFault { path: segment(1), from: 0, to: None }]);
    assert_contains(&run(&["info", &session], 0), &["MISSING", "cannot be read: Input/output error"]);
    run(&["verify", &session], 4);
    run(&["recover", &session, "--out", &path("saved-2")], 3);
    run(&["report", &session, "--out", &path("page.html")], 0);
    let page = std::fs::read_to_string(path("page.html")).expect("a page");
    assert_contains(&page, &["cannot be read"]);
    let listed = catalogue::entry(disk.mount_point(), &"a".into(), "walk").expect("a recording");
    assert_eq!(listed.session_id.as_deref(), Some("5f0c"), "{listed:?}");
}

/// Somebody cuts a file that is being read: at every region, frames before the cut are read, those behind it are named.
#[test]
fn a_file_that_becomes_shorter_while_it_is_read_is_no_end() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let session = write(dir.path());
    for ranges in good()[1].regions.values() {
        let at = ranges[ranges.len() / 2].start;
        let readers = [
            SessionReader::open(&session).expect("good"),
            SessionReader::open_frames(&session).expect("good"),
        ];
        let path = dir.path().join(segment(1));
        std::fs::OpenOptions::new()
            .write(true)
            .open(&path)
            .and_then(|file| file.set_len(at as u64))
            .expect("cut");
        for reader in &readers {
            for (camera, trigger, message) in &good()[1].frames {
                let frame =
                    reader.recordings()[0].frame(*camera, fourdbody::base::ids::TriggerIndex(*trigger));
                match frame {
                    Ok(Ok(_)) => assert!(message.end <= at, "{at}: {message:?}"),
                    Ok(Err(cause)) => panic!("{at}: {message:?} is a gap: {cause}"),
                    Err(reason) => {
                        assert!(message.end > at, "{at}: {message:?}: {reason}");
                        assert!(reason.contains("has become shorter"), "{reason}");
                    }
                }
            }
        }
        std::fs::write(&path, &good()[1].bytes).expect("whole again");
    }
}

/// A segment's name on something that is no file, or that may not be opened.
#[test]
fn what_is_no_file_costs_that_segment() {
    type Make = fn(&Path);
    let kinds: [(&str, Make); 4] = [
        ("a pipe", |path| {
            let path = CString::new(path.to_str().expect("UTF-8")).expect("no zeros");
            // SAFETY: a C string that lives for the duration of the call.
            assert_eq!(unsafe { libc::mkfifo(path.as_ptr(), 0o600) }, 0);
        }),
        ("a directory", |path| std::fs::create_dir(path).expect("made")),
        ("a socket", |path| drop(UnixListener::bind(path).expect("bound"))),
        ("symbolic links", |path| std::os::unix::fs::symlink(path, path).expect("linked")),
    ];
    for (kind, make) in kinds {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let session = write(dir.path());
        let path = dir.path().join(segment(0));
        std::fs::remove_file(&path).expect("there");
        make(&path);
        let began = Instant::now();
        let report = verify(&session, &|_, _| ()).expect("the other segments");
        let said = |message: &str| message.contains("cannot be opened") && message.contains(kind);
        assert!(report.findings.iter().any(|f| said(&f.message)), "{kind}: {:#?}", report.findings);
        assert_eq!(report.worst, Some(Severity::Corrupt));
        let listed = catalogue::entry(dir.path(), &"a".into(), "walk").expect("a recording");
        assert_eq!(listed.session_id.as_deref(), Some("5f0c"), "{kind}: {listed:?}");
        fourdbody::record::interrupted(dir.path());
        let out = dir.path().join("out");
        let recovery = recover(&session, &out, &|_, _| ()).unwrap_or_else(|e| panic!("{kind}: {e}"));
        assert!(recovery.recordings[0].damage.iter().any(|d| said(&d.reason)), "{kind}: {recovery:#?}");
        let saved = frames(&SessionReader::open(&out).expect("readable"), 0);
        assert_eq!(saved, untouched(0, 0, usize::MAX), "{kind}: all of the other segments");
        assert!(began.elapsed() < Duration::from_secs(60), "{kind}: somebody waits for it");
        let info = fourdbody(&["info", &session.display().to_string()]);
        assert_eq!(info.status.code(), Some(0), "{kind}: {}", text_of(&info));
        assert_contains(&text_of(&info), &["cannot be opened", kind]);
    }
}
