// SPDX-License-Identifier: MIT OR Apache-2.0
//! The recording reader, on files that nobody vouches for.

use fourdbody::base::ids::TriggerIndex;
use fourdbody::data::FrameSource;
use fourdbody::record::SessionReader;
use fourdbody::record::verify::{Severity, verify};
use std::path::PathBuf;
use tempfile::TempDir;

/// Triggers that are read at each end of what the recording says it has.
const SOME: u64 = 64;

thread_local! {
    /// In memory where the system has such a place.
    static DIRECTORY: TempDir = tempfile::tempdir_in("/dev/shm")
        .or_else(|_| tempfile::tempdir())
        .expect("a directory for the segment");
}

/// Arbitrary bytes as the only segment of a recording: opened both ways, read and verified.
///
/// Holds: both ways of opening agree on the frames; where `verify` finds nothing corrupt, every frame that the
/// recording has can be read.
pub fn reader(data: &[u8]) {
    let directory: PathBuf = DIRECTORY.with(|dir| dir.path().to_owned());
    std::fs::write(directory.join("segment-000.mcap"), data).expect("the segment is written");
    let opened = SessionReader::open(&directory);
    let by_index = SessionReader::open_frames(&directory);
    let report = verify(&directory, &|_, _| {});
    let intact = report.is_ok_and(|report| report.worst != Some(Severity::Corrupt));
    let Ok(session) = opened else {
        assert!(!intact, "verified, but cannot be opened");
        return;
    };
    let range = session.triggers();
    let head = range.start..range.end.min(range.start.saturating_add(SOME));
    let tail = range.end.saturating_sub(SOME).max(head.end)..range.end;
    let cameras: Vec<_> = session.recordings()[0].header.cameras.iter().map(|c| c.id.clone()).collect();
    for camera in &cameras {
        for trigger in head.clone().chain(tail.clone()).map(TriggerIndex) {
            let frame = session.recorded_frame(camera, trigger);
            if intact {
                assert!(frame.is_ok(), "verified, but {camera} {trigger}: {:?}", frame.err());
                let indexed = by_index.as_ref().map(|s| s.recorded_frame(camera, trigger).is_ok());
                assert_eq!(indexed.ok(), Some(true), "{camera} {trigger} by the index");
            }
        }
    }
    let _ = session.rig();
}
