// SPDX-License-Identifier: MIT OR Apache-2.0
//! The writer against disks that fail and frames that come in any order.

use super::error::RecordError;
use super::options::WriterOptions;
use super::{OpenStore, Recording};
use crate::base::ids::{BlockId, CameraId, NodeId, SessionName, TriggerIndex};
use crate::direct_io::Store;
use crate::envelope::{ENVELOPE_CAPACITY, FrameMeta, pixels_crc, write_envelope};
use crate::layout::{CameraHeader, GapCause, RecordingHeader, VERSION};
use crate::session::SessionReader;
use crate::verdict::{SessionEnd, Status, Verdict};
use proptest::prelude::*;
use std::fs::{File, OpenOptions};
use std::io::{self, IoSlice};
use std::os::unix::fs::FileExt;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, AtomicU32, Ordering};
use std::time::Duration;

pub(super) const SIDE: u32 = 40;
pub(super) const CAMERAS: [&str; 2] = ["h0_up", "h0_low"];

/// The header of a recording of two small cameras.
pub(crate) fn header(expected_triggers: Option<u64>) -> RecordingHeader {
    let camera = |id: &str| CameraHeader {
        id: CameraId::from(id),
        width: SIDE,
        height: SIDE,
        device: String::new(),
        pixel_format: String::new(),
        settings: Vec::new(),
        state: std::collections::BTreeMap::new(),
    };
    RecordingHeader {
        session: SessionName::from("s"),
        session_id: "1".to_owned(),
        node: NodeId::from("a"),
        rig_text: String::new(),
        cameras: CAMERAS.map(camera).into(),
        hsu: None,
        expected_triggers,
        trigger_rate_hz: 120.0,
        host_clock: "test".to_owned(),
        created_ns: 1,
        software: "test".to_owned(),
        subject: None,
        note: None,
    }
}

impl Recording {
    pub(super) fn create_with(
        dir: &Path,
        header: RecordingHeader,
        options: WriterOptions,
        open_store: OpenStore,
    ) -> Result<Self, RecordError> {
        let bytes = header.expected_bytes().unwrap_or(0);
        Self::create_for(dir, header, options, bytes, VERSION, open_store)
    }
}

/// A frame of one of them, as it is handed to the writer.
pub(crate) fn frame(camera: usize, trigger: u64) -> (FrameMeta, Vec<u8>) {
    let pixels = vec![(trigger * 3 + camera as u64) as u8; (SIDE * SIDE) as usize];
    let (trigger, block) = (TriggerIndex(trigger), BlockId(trigger + 1));
    let (camera_time_ns, host_time_ns) = (trigger.0 * 1000, trigger.0 * 1000 + 5);
    let pixels_crc = pixels_crc(&pixels);
    let meta =
        FrameMeta { trigger, block, camera_time_ns, host_time_ns, width: SIDE, height: SIDE, pixels_crc };
    let mut buffer = vec![0; ENVELOPE_CAPACITY];
    buffer.extend_from_slice(&pixels);
    let length = write_envelope(&mut buffer[..ENVELOPE_CAPACITY], &CameraId::from(CAMERAS[camera]), &meta);
    (meta, buffer.split_off(ENVELOPE_CAPACITY - length.expect("room enough")))
}

pub(crate) fn end(triggers: u64) -> SessionEnd {
    SessionEnd { triggers_emitted: Some(triggers), aborted: None, absent: GapCause::Timeout, host_time_ns: 9 }
}

pub(crate) fn options(segment_bytes: u64) -> WriterOptions {
    WriterOptions { segment_bytes, reserve_bytes: 0, ..WriterOptions::default() }
}

/// Every trigger of every camera has exactly one outcome, frames are what was handed over, and the stored
/// verdict counts what is there.
fn check_books(dir: &Path, verdict: &Verdict) {
    let reader = SessionReader::open(dir).expect("readable");
    let recording = &reader.recordings()[0];
    assert_eq!(recording.problems, []);
    assert_eq!(recording.verdict.as_ref(), Some(verdict));
    for (camera, counted) in verdict.cameras.iter().enumerate() {
        let (mut frames, mut gaps) = (0, 0);
        for trigger in 0..verdict.triggers {
            match recording.frame(camera, TriggerIndex(trigger)).expect("an outcome") {
                Ok(found) => {
                    assert_eq!(found.meta, frame(camera, trigger).0);
                    frames += 1;
                }
                Err(_) => gaps += 1,
            }
        }
        assert_eq!((counted.frames, counted.gap_count()), (frames, gaps));
    }
}

/// Frames that a reader finds, whether or not the recording was closed in good order.
fn readable_frames(dir: &Path, triggers: u64) -> u64 {
    let reader = SessionReader::open(dir).expect("readable");
    let recording = &reader.recordings()[0];
    let frames = (0..CAMERAS.len()).flat_map(|camera| (0..triggers).map(move |trigger| (camera, trigger)));
    let found = |(camera, trigger): &(usize, u64)| {
        recording
            .frame(*camera, TriggerIndex(*trigger))
            .is_ok_and(|outcome| outcome.is_ok_and(|found| found.meta == frame(*camera, *trigger).0))
    };
    frames.filter(found).count() as u64
}

/// A file on a disk that takes `budget` bytes, all segments together; the write that exceeds it is half done.
struct FailingStore {
    file: File,
    budget: Arc<AtomicI64>,
}

impl Store for FailingStore {
    fn write_at(&mut self, offset: u64, parts: &mut [IoSlice<'_>]) -> io::Result<()> {
        let bytes: &[u8] = &parts.iter().flat_map(|part| part.to_vec()).collect::<Vec<u8>>();
        let left = self.budget.fetch_sub(bytes.len() as i64, Ordering::Relaxed);
        if left < bytes.len() as i64 {
            self.file.write_all_at(&bytes[..left.max(0) as usize], offset)?;
            return Err(io::Error::from_raw_os_error(libc::ENOSPC));
        }
        self.file.write_all_at(bytes, offset)
    }

    fn set_len(&mut self, length: u64) -> io::Result<()> {
        self.file.set_len(length)
    }

    fn sync(&mut self) -> io::Result<()> {
        Ok(())
    }
}

fn create_failing(dir: &Path, budget: &Arc<AtomicI64>) -> Result<Recording, RecordError> {
    let budget = Arc::clone(budget);
    let open = move |path: &Path| -> io::Result<Box<dyn Store>> {
        let file = OpenOptions::new().write(true).create_new(true).open(path)?;
        Ok(Box::new(FailingStore { file, budget: Arc::clone(&budget) }))
    };
    Recording::create_with(dir, header(None), options(60_000), Arc::new(open))
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// The disk fills at any byte and has a little room again for the accounting (the reserve): all that was
    /// flushed is readable, and every frame is either there or a gap.
    #[test]
    fn a_full_disk_keeps_the_books(budget in 20_000i64..400_000, triggers in 20u64..60) {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let path = dir.path().join("node-a");
        let left = Arc::new(AtomicI64::new(budget));
        let mut recording = create_failing(&path, &left).expect("room for the header");
        let mut failed_at = None;
        for trigger in 0..triggers {
            for camera in 0..CAMERAS.len() {
                let (meta, message) = frame(camera, trigger);
                let result = recording.frame(camera, &meta, &message);
                match (failed_at, result) {
                    (None, Err(RecordError::Disk { .. })) => {
                        failed_at = Some(trigger);
                        left.store(1 << 20, Ordering::Relaxed);
                    }
                    (None, result) => prop_assert!(result.is_ok()),
                    (Some(_), result) => {
                        let stopped = matches!(result, Err(RecordError::Stopped { .. }));
                        prop_assert!(stopped, "{result:?}");
                    }
                }
            }
        }
        // Whatever is still open must fit now; a failure from here on is a case of its own.
        left.store(1 << 20, Ordering::Relaxed);
        let verdict = match recording.finish(end(triggers)) {
            Ok(verdict) => verdict,
            // The disk was full just while a split segment got its index, behind its last frame: the caller gets
            // the error, and all frames that the accounting counts are readable.
            Err(RecordError::Unfinished { verdict, .. }) => {
                prop_assert_eq!(readable_frames(&path, triggers), verdict.frames());
                return Ok(());
            }
            Err(error) => panic!("unexpected: {error}"),
        };
        // The disk's thread may fail behind the last frame: then only `finish` learns of it.
        let complete = verdict.status == Status::Complete;
        prop_assert!(!complete || failed_at.is_none());
        prop_assert_eq!(complete, verdict.gaps() == 0);
        check_books(&path, &verdict);
        // At most three chunks of each of two segments were lost before the failure was noticed.
        let lost_after = failed_at.map_or(0, |trigger| 2 * (triggers - trigger - 1));
        let lost_before = verdict.gaps() - lost_after;
        prop_assert!(lost_before <= 26, "{} frames lost, noticed at {:?}", lost_before, failed_at);
    }

    /// Cameras run apart, repeat themselves, and skip: exactly one outcome per trigger all the same.
    #[test]
    fn any_order_is_accounted_for(
        steps in prop::collection::vec((0usize..2, 0u64..40, prop::option::of(Just(GapCause::Unplugged))), 0..200),
        segment_bytes in 1u64..50_000,
    ) {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let path = dir.path().join("node-a");
        let mut recording =
            Recording::create(&path, header(Some(40)), options(segment_bytes)).expect("a new recording");
        let mut first = std::collections::BTreeMap::new();
        let mut refused = 0;
        for (camera, trigger, gap) in steps {
            match gap {
                None => {
                    let (meta, message) = frame(camera, trigger);
                    recording.frame(camera, &meta, &message).expect("recorded or refused");
                }
                Some(cause) => recording.gap(camera, TriggerIndex(trigger), cause).expect("recorded or refused"),
            }
            match first.entry((camera, trigger)) {
                std::collections::btree_map::Entry::Vacant(entry) => {
                    entry.insert(gap);
                }
                std::collections::btree_map::Entry::Occupied(_) => refused += 1,
            }
        }
        let verdict = recording.finish(end(40)).expect("finished");
        prop_assert_eq!(verdict.refused, refused);
        prop_assert_eq!(verdict.frames(), first.values().filter(|gap| gap.is_none()).count() as u64);
        prop_assert_eq!(verdict.frames() + verdict.gaps(), 80);
        check_books(&path, &verdict);
        let reader = SessionReader::open(&path).expect("readable");
        for segment in &reader.recordings()[0].segments {
            let alone = SessionReader::open(&segment.path).expect("readable alone");
            let range = segment.first_trigger..segment.end_trigger.unwrap_or(u64::MAX);
            for outcomes in &alone.recordings()[0].outcomes {
                let frames = outcomes.iter().filter(|(_, o)| matches!(o, crate::reader::Outcome::Frame { .. }));
                for (trigger, _) in frames {
                    prop_assert!(range.contains(trigger), "frame {trigger} outside of {range:?}");
                }
            }
        }
    }
}

#[test]
fn a_disk_that_stays_full_still_gives_the_verdict() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("node-a");
    let left = Arc::new(AtomicI64::new(60_000));
    let mut recording = create_failing(&path, &left).expect("room for the header");
    let mut errors = 0;
    for trigger in 0..40 {
        let (meta, message) = frame(0, trigger);
        errors += usize::from(recording.frame(0, &meta, &message).is_err());
    }
    assert!(errors > 10);
    let error = recording.finish(end(40)).expect_err("nothing can be written");
    let RecordError::Unfinished { verdict, .. } = error else { panic!("unexpected {error}") };
    assert_eq!((verdict.status, verdict.frames() + verdict.gaps()), (Status::Incomplete, 80));
    let reader = SessionReader::open(&path).expect("the prefix is readable");
    let recording = &reader.recordings()[0];
    for trigger in 0..verdict.cameras[0].frames {
        recording.frame(0, TriggerIndex(trigger)).expect("an outcome").expect("flushed before the failure");
    }
}

/// Counts syncs; the content does not matter.
struct CountingStore(Arc<AtomicU32>);

impl Store for CountingStore {
    fn write_at(&mut self, _: u64, _: &mut [IoSlice<'_>]) -> io::Result<()> {
        Ok(())
    }

    fn set_len(&mut self, _: u64) -> io::Result<()> {
        Ok(())
    }

    fn sync(&mut self) -> io::Result<()> {
        self.0.fetch_add(1, Ordering::Relaxed);
        Ok(())
    }
}

#[test]
fn syncs_come_by_bytes_and_by_time() {
    let frames = 64;
    let count = |sync_bytes, sync_interval, tick: bool| {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let syncs = Arc::new(AtomicU32::new(0));
        let counter = Arc::clone(&syncs);
        let open = move |_: &Path| -> io::Result<Box<dyn Store>> {
            Ok(Box::new(CountingStore(Arc::clone(&counter))))
        };
        let options = WriterOptions { sync_bytes, ..options(u64::MAX) };
        let path = dir.path().join("node-a");
        let mut recording =
            Recording::create_with(&path, header(None), options, Arc::new(open)).expect("created");
        recording.options.sync_interval = sync_interval;
        for trigger in 0..frames {
            if tick {
                recording.tick().expect("nothing to fail");
            } else {
                let (meta, message) = frame(0, trigger);
                recording.frame(0, &meta, &message).expect("recorded");
            }
        }
        recording.settle_all().expect("nothing to fail");
        // One of them was for the segment's header.
        syncs.load(Ordering::Relaxed) - 1
    };
    let (long, none) = (Duration::from_secs(3600), Duration::ZERO);
    assert_eq!(count(u64::MAX, long, false), 0);
    assert_eq!(count(1, long, false), frames as u32, "by bytes");
    assert_eq!(count(u64::MAX, none, false), frames as u32, "by time");
    assert_eq!(count(u64::MAX, none, true), frames as u32, "while idle");
}

#[test]
fn a_recording_is_never_overwritten_and_must_fit() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("walk-01").join("node-a");
    let recording = Recording::create(&path, header(Some(5)), options(1 << 30)).expect("a new recording");
    recording.finish(end(5)).expect("finished");
    let again = Recording::create(&path, header(Some(5)), options(1 << 30)).map(drop);
    assert!(matches!(again, Err(RecordError::Exists { .. })), "{again:?}");
    let mut large = header(Some(crate::layout::MAX_TRIGGERS));
    large.cameras.iter_mut().for_each(|camera| (camera.width, camera.height) = (65_536, 65_536));
    let path = dir.path().join("walk-02");
    let refused = Recording::create(&path, large, options(1 << 30)).map(drop);
    assert!(matches!(refused, Err(RecordError::NoSpace { .. })), "{refused:?}");
    assert!(!path.exists());
}

#[test]
fn a_message_that_is_not_the_frame_is_refused_without_an_outcome() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("node-a");
    let mut recording = Recording::create(&path, header(Some(2)), options(1 << 30)).expect("created");
    let (meta, message) = frame(0, 0);
    let (other, _) = frame(0, 1);
    for (camera, meta, message) in [
        (1, &meta, &message[..]),
        (0, &other, &message[..]),
        (0, &meta, &message[..99]),
        (7, &meta, &message[..]),
    ] {
        let result = recording.frame(camera, meta, message);
        assert!(matches!(result, Err(RecordError::Frame { .. })), "{result:?}");
    }
    let verdict = recording.finish(end(2)).expect("finished");
    assert_eq!((verdict.frames(), verdict.gaps()), (0, 4));
    check_books(&path, &verdict);
}

#[test]
fn dropped_without_finish_it_reads_as_far_as_it_came() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("node-a");
    let mut recording = Recording::create(&path, header(None), options(1 << 30)).expect("created");
    for trigger in 0..7 {
        let (meta, message) = frame(0, trigger);
        recording.frame(0, &meta, &message).expect("recorded");
    }
    drop(recording);
    let reader = SessionReader::open(&path).expect("readable");
    let recording = &reader.recordings()[0];
    assert_eq!(recording.verdict, None);
    assert!((0..7).all(|trigger| recording.frame(0, TriggerIndex(trigger)).is_ok_and(|f| f.is_ok())));
    let missing = recording.frame(1, TriggerIndex(0)).expect_err("camera 1 recorded nothing");
    assert!(missing.contains("neither a frame nor a gap record"), "{missing}");
}

/// What a killed process leaves: whole chunks, zeros up to the end of the block, no summary.
#[test]
fn killed_it_reads_up_to_the_last_chunk() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("node-a");
    let mut recording = Recording::create(&path, header(None), options(1 << 30)).expect("created");
    for trigger in 0..11 {
        let (meta, message) = frame(0, trigger);
        recording.frame(0, &meta, &message).expect("recorded");
    }
    // The second chunk is under way; wait for it, as a kernel would finish it.
    recording.segments[0].segment.window().settle().expect("written");
    std::mem::forget(recording);
    let length = std::fs::metadata(path.join("segment-000.mcap")).expect("a segment").len();
    assert_eq!(length % 4096, 0, "whole blocks");
    for reader in [SessionReader::open(&path), SessionReader::open_frames(&path)] {
        let reader = reader.expect("readable");
        let recording = &reader.recordings()[0];
        assert_eq!((recording.triggers_end(), recording.problems.len()), (8, 0));
        for trigger in 0..8 {
            let found = recording.frame(0, TriggerIndex(trigger)).expect("an outcome").expect("a frame");
            assert_eq!(found.meta, frame(0, trigger).0);
        }
    }
}

#[test]
fn options_that_break_a_promise_are_refused() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("node-a");
    for options in [
        WriterOptions { sync_interval: Duration::from_millis(1001), ..options(1) },
        WriterOptions { sync_bytes: 0, ..options(1) },
        options(0),
    ] {
        let refused = Recording::create(&path, header(None), options).map(drop);
        assert!(matches!(refused, Err(RecordError::Header(_))), "{refused:?}");
        assert!(!path.exists());
    }
}

#[test]
fn it_can_move_to_the_writer_thread() {
    fn is_send<T: Send>() {}
    is_send::<Recording>();
}

#[test]
fn the_reserve_stops_frames_and_nothing_else() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("node-a");
    let mut recording = Recording::create(&path, header(None), options(1 << 30)).expect("created");
    // No disk has this much: the next look at the free space finds the reserve reached.
    recording.options.reserve_bytes = u64::MAX;
    recording.options.sync_bytes = 1;
    let (meta, message) = frame(0, 0);
    let reached = recording.frame(0, &meta, &message);
    assert!(matches!(reached, Err(RecordError::ReserveReached { .. })), "{reached:?}");
    let (meta, message) = frame(0, 1);
    let stopped = recording.frame(0, &meta, &message);
    assert!(matches!(stopped, Err(RecordError::Stopped { .. })), "{stopped:?}");
    let verdict = recording.finish(end(2)).expect("finished");
    assert_eq!(verdict.cameras[0].frames, 1, "the frame that met the reserve is on disk");
    assert_eq!(verdict.cameras[0].gaps.get(&GapCause::DroppedDisk), Some(&1));
    check_books(&path, &verdict);
}

/// A session of a whole day has a thousand segments.
#[test]
fn closed_segments_are_let_go() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("node-a");
    let mut recording = Recording::create(&path, header(None), options(20_000)).expect("created");
    let open_files = || {
        let files = std::fs::read_dir("/proc/self/fd").expect("this process");
        let targets = files.flatten().filter_map(|file| std::fs::read_link(file.path()).ok());
        targets.filter(|target| target.starts_with(&path)).count()
    };
    for trigger in 0..100 {
        for camera in 0..CAMERAS.len() {
            while !recording.closing.iter().all(super::segments::ClosingSegment::is_done) {
                std::thread::yield_now();
            }
            let (meta, message) = frame(camera, trigger);
            recording.frame(camera, &meta, &message).expect("recorded");
            // The open one, the one made ready, an older one that a camera still needs, and one just closed.
            assert!(open_files() <= 4, "{} at trigger {trigger}", open_files());
        }
    }
    let verdict = recording.finish(end(100)).expect("finished");
    assert!(std::fs::read_dir(&path).expect("listed").count() > 10, "many segments");
    check_books(&path, &verdict);
}
