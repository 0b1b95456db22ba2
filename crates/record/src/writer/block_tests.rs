// SPDX-License-Identifier: MIT OR Apache-2.0
//! Frames from blocks: not copied, aligned in the file, and their blocks back when the disk has them; disks that
//! fail at any byte and any sync; splits that cost nothing.

use super::error::RecordError;
use super::options::WriterOptions;
use super::tests::{CAMERAS, end, header, options};
use super::{BLOCKS_HELD, Recording};
use crate::base::ids::{BlockId, TriggerIndex};
use crate::direct_io::{DirectFile, Store};
use crate::envelope::{FrameMeta, pixels_crc};
use crate::host::frame_memory::Block;
use crate::layout::{GapCause, NodeEvent, RecordingHeader};
use crate::session::SessionReader;
use crate::verdict::{SessionEnd, Verdict};
use crate::verify::{Severity, verify};
use crossbeam_channel::{Receiver, Sender, bounded, unbounded};
use proptest::prelude::*;
use std::fs::{File, OpenOptions};
use std::io::{self, IoSlice};
use std::os::unix::fs::{FileExt, MetadataExt};
use std::path::Path;
use std::sync::atomic::{AtomicI64, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

fn sized(width: u32, height: u32) -> RecordingHeader {
    let mut header = header(None);
    header.cameras.iter_mut().for_each(|camera| (camera.width, camera.height) = (width, height));
    header
}

fn block(camera: usize, trigger: u64, width: u32, height: u32) -> (FrameMeta, Block) {
    let mut block = Block::allocate((width * height) as usize);
    let seed = trigger * 7 + camera as u64;
    let pixels = &mut block.bytes_mut()[crate::host::frame_memory::ROOM_BYTES..];
    pixels.iter_mut().enumerate().for_each(|(i, pixel)| *pixel = (i as u64 * 31 + seed) as u8);
    let pixels_crc = pixels_crc(pixels);
    let (trigger, block_id) = (TriggerIndex(trigger), BlockId(trigger + 1));
    let (camera_time_ns, host_time_ns) = (trigger.0 * 1000, trigger.0 * 1000 + 5);
    let meta =
        FrameMeta { trigger, block: block_id, camera_time_ns, host_time_ns, width, height, pixels_crc };
    (meta, block)
}

fn event(text: &str) -> NodeEvent {
    let (kind, message) = ("test".to_owned(), text.to_owned());
    NodeEvent { host_time_ns: 1, kind, camera: None, trigger: None, message }
}

/// Readable, every checksum right, every outcome there.
fn check(dir: &Path, verdict: &Verdict, width: u32, height: u32) {
    let report = verify(dir, &|_, _| {}).expect("readable");
    let corrupt: Vec<_> = report.findings.iter().filter(|f| f.severity == Severity::Corrupt).collect();
    assert!(corrupt.is_empty(), "{corrupt:?}");
    let reader = SessionReader::open(dir).expect("readable");
    for (camera, counted) in verdict.cameras.iter().enumerate() {
        let mut frames = 0;
        for trigger in 0..verdict.triggers {
            let outcome = reader.recordings()[0].frame(camera, TriggerIndex(trigger)).expect("an outcome");
            let Ok(found) = outcome else { continue };
            assert_eq!(found.meta, block(camera, trigger, width, height).0);
            frames += 1;
        }
        assert_eq!(counted.frames, frames);
    }
}

/// Offsets in the file of all pixels that the closed segments' indexes name.
fn pixel_offsets(dir: &Path, pixels: u64) -> Vec<u64> {
    let reader = SessionReader::open_frames(dir).expect("readable");
    let frames = reader.recordings()[0].outcomes.iter().flat_map(|outcomes| outcomes.values());
    let offset = |outcome: &crate::reader::Outcome| match outcome {
        crate::reader::Outcome::Frame { offset, length, .. } => Some((offset + length) as u64 - pixels),
        crate::reader::Outcome::Gap(_) => None,
    };
    frames.filter_map(offset).collect()
}

fn record_sizes(parent: &Path, width: u32, height: u32, between: &[(u8, usize)]) {
    let dir = tempfile::tempdir_in(parent).expect("a temporary directory");
    let path = dir.path().join("node-a");
    let mut recording = Recording::create(&path, sized(width, height), options(200_000)).expect("created");
    let (home, returns) = unbounded();
    let triggers = between.len() as u64;
    for (trigger, (what, length)) in between.iter().enumerate() {
        for camera in 0..CAMERAS.len() {
            let (meta, mut block) = block(camera, trigger as u64, width, height);
            block.set_home(home.clone());
            recording.frame_in_place(camera, &meta, block).expect("recorded");
        }
        match what {
            0 => recording.event(&event(&"x".repeat(*length))).expect("recorded"),
            1 => recording.sync().expect("synced"),
            _ => {}
        }
    }
    let statistics = recording.statistics();
    assert_eq!(statistics.copied_frames, 0, "{width} x {height}");
    assert!(statistics.blocks_high_water <= BLOCKS_HELD, "{statistics:?}");
    let verdict = recording.finish(end(triggers)).expect("finished");
    assert_eq!(verdict.gaps(), 0);
    check(&path, &verdict, width, height);
    let pixels = u64::from(width * height);
    let offsets = pixel_offsets(&path, pixels);
    assert_eq!(offsets.len() as u64, 2 * triggers);
    assert!(pixels < 4096 || offsets.iter().all(|offset| offset % 4096 == 0), "{offsets:?}");
    assert_eq!(returns.try_iter().count() as u64, 2 * triggers, "every block is back");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    /// Sizes around whole blocks, smaller than one, and any; small records of any length in between.
    #[test]
    fn pixels_of_any_size_are_aligned_and_never_copied(
        width in prop_oneof![1u32..200, Just(64), Just(128)],
        height in prop_oneof![1u32..200, Just(64), Just(128)],
        between in prop::collection::vec((0u8..4, 0usize..5000), 1..14),
    ) {
        record_sizes(&std::env::temp_dir(), width, height, &between);
    }
}

/// Sizes whose tails leave less of a block than an envelope needs.
#[test]
fn pixels_that_end_just_before_a_block_are_aligned_all_the_same() {
    for short in 1..260 {
        record_sizes(&std::env::temp_dir(), 2 * 4096 - short, 1, &[(2, 0); 5]);
    }
}

#[test]
fn without_direct_writes_it_is_the_same() {
    let memory = Path::new("/dev/shm");
    if memory.is_dir() {
        for (width, height) in [(97, 131), (64, 64), (30, 30), (1920, 20)] {
            record_sizes(memory, width, height, &[(0, 77), (2, 0), (1, 0), (0, 4000), (2, 0)]);
        }
    }
}

/// Writes wait for the gate, where there is one, and are reported on the channel, where there is one.
struct GatedStore {
    file: DirectFile,
    gate: Option<Receiver<()>>,
    written: Option<Sender<()>>,
}

impl Store for GatedStore {
    fn write_at(&mut self, offset: u64, parts: &mut [IoSlice<'_>]) -> io::Result<()> {
        // Errors mean that the gate stays open, or that the test has dropped the channel.
        let _ = self.gate.as_ref().map(Receiver::recv);
        let _ = self.written.as_ref().map(|written| written.send(()));
        self.file.write_at(offset, parts)
    }

    fn set_len(&mut self, length: u64) -> io::Result<()> {
        self.file.set_len(length)
    }

    fn sync(&mut self) -> io::Result<()> {
        self.file.sync()
    }
}

#[test]
fn a_block_comes_back_when_the_disk_has_it_and_not_before() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("node-a");
    let (open_gate, gate) = unbounded();
    let open = move |path: &Path| -> io::Result<Box<dyn Store>> {
        Ok(Box::new(GatedStore { file: DirectFile::create(path)?, gate: Some(gate.clone()), written: None }))
    };
    open_gate.send(()).expect("the header may pass");
    let options = WriterOptions { sync_interval: Duration::from_secs(1), ..options(1 << 30) };
    let mut recording =
        Recording::create_with(&path, sized(80, 80), options, Arc::new(open)).expect("created");
    // One chunk is written, one waits, one is open: no call waits for the disk.
    recording.options.sync_interval = Duration::MAX;
    let (home, returns) = bounded(64);
    for trigger in 0..11 {
        let (meta, mut block) = block(0, trigger, 80, 80);
        block.set_home(home.clone());
        recording.frame_in_place(0, &meta, block).expect("recorded");
    }
    assert_eq!(returns.len(), 0);
    assert_eq!(recording.statistics().blocks_high_water, 11);
    drop(open_gate);
    recording.settle_all().expect("written");
    assert_eq!(returns.len(), 11);
    let verdict = recording.finish(end(11)).expect("finished");
    check(&path, &verdict, 80, 80);
    let stored = std::fs::read(path.join("segment-000.mcap")).expect("a segment");
    let name = crate::layout::STATISTICS_METADATA.as_bytes();
    assert!(stored.windows(name.len()).any(|bytes| bytes == name), "the statistics are in the file");
}

/// A disk thread that gets no turn while its segment is closed: what waits there, the open chunk and the queue of the
/// next one are all that a crash may cost, so a third segment has to wait.
#[test]
fn a_third_segment_waits_until_the_first_is_closed() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("node-a");
    let (open_gate, gate) = unbounded();
    let (written, third) = unbounded();
    let open = move |path: &Path| -> io::Result<Box<dyn Store>> {
        let is = |number: &str| path.to_string_lossy().contains(number);
        let (gate, written) = (is("-000").then(|| gate.clone()), is("-002").then(|| written.clone()));
        Ok(Box::new(GatedStore { file: DirectFile::create(path)?, gate, written }))
    };
    open_gate.send(()).expect("the first segment's header may pass");
    // Room for one chunk: the first segment is closed before its queue is full, and nothing but its end is waited for.
    let options = options(30_000);
    let mut recording =
        Recording::create_with(&path, sized(80, 80), options, Arc::new(open)).expect("created");
    recording.options.sync_interval = Duration::MAX;
    let opener = std::thread::spawn(move || {
        // No turn can be waited for that must not come; time only lets a wrong writer show itself.
        let early = third.recv_timeout(Duration::from_millis(500)).is_ok();
        drop(open_gate);
        early
    });
    for trigger in 0..30 {
        let (meta, block) = block(0, trigger, 80, 80);
        recording.frame_in_place(0, &meta, block).expect("recorded");
        recording.gap(1, TriggerIndex(trigger), GapCause::MissingPackets).expect("recorded");
    }
    assert!(
        !opener.join().expect("no panic"),
        "a third segment was written while the first had unwritten chunks"
    );
    let verdict = recording.finish(end(30)).expect("finished");
    assert_eq!(verdict.frames(), 30);
    assert!(path.join("segment-002.mcap").exists(), "three segments");
    check(&path, &verdict, 80, 80);
}

/// A disk that fails for good at the `syncs`-th sync or the byte after `bytes`, at which the write stops short;
/// it has room again after `heal`.
struct FaultyStore {
    file: File,
    bytes: Arc<AtomicI64>,
    syncs: Arc<AtomicI64>,
}

impl Store for FaultyStore {
    fn write_at(&mut self, mut offset: u64, parts: &mut [IoSlice<'_>]) -> io::Result<()> {
        for part in parts.iter() {
            let left = self.bytes.fetch_sub(part.len() as i64, Ordering::Relaxed);
            let fits = left.clamp(0, part.len() as i64) as usize;
            self.file.write_all_at(&part[..fits], offset)?;
            if fits < part.len() {
                return Err(io::Error::from_raw_os_error(libc::EIO));
            }
            offset += part.len() as u64;
        }
        Ok(())
    }

    fn set_len(&mut self, length: u64) -> io::Result<()> {
        self.file.set_len(length)
    }

    fn sync(&mut self) -> io::Result<()> {
        if self.syncs.fetch_sub(1, Ordering::Relaxed) == 0 {
            return Err(io::Error::from_raw_os_error(libc::EIO));
        }
        Ok(())
    }
}

/// Records 40 triggers on a disk that fails at the byte after `bytes` and at the `syncs`-th sync: all frames that the
/// accounting counts are readable, no other frame is, and the accounting is complete.
fn keeps_the_books(bytes: i64, syncs: i64, segment_bytes: u64) {
    let triggers = 40;
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("node-a");
    let (left, syncs) = (Arc::new(AtomicI64::new(bytes)), Arc::new(AtomicI64::new(syncs)));
    let (budget, count) = (Arc::clone(&left), Arc::clone(&syncs));
    let open = move |path: &Path| -> io::Result<Box<dyn Store>> {
        let file = OpenOptions::new().write(true).create_new(true).open(path)?;
        Ok(Box::new(FaultyStore { file, bytes: Arc::clone(&budget), syncs: Arc::clone(&count) }))
    };
    let options = WriterOptions { sync_bytes: 60_000, ..options(segment_bytes) };
    let mut recording =
        Recording::create_with(&path, sized(90, 90), options, Arc::new(open)).expect("created");
    let (home, returns) = unbounded();
    for trigger in 0..triggers {
        for camera in 0..CAMERAS.len() {
            let (meta, mut block) = block(camera, trigger, 90, 90);
            block.set_home(home.clone());
            match recording.frame_in_place(camera, &meta, block) {
                Ok(()) => {}
                Err(RecordError::Disk { .. } | RecordError::Stopped { .. }) => {
                    left.store(1 << 22, Ordering::Relaxed);
                }
                Err(error) => panic!("unexpected: {error}"),
            }
        }
    }
    left.store(1 << 22, Ordering::Relaxed);
    let verdict = match recording.finish(end(triggers)) {
        Ok(verdict) => {
            check(&path, &verdict, 90, 90);
            verdict
        }
        Err(RecordError::Unfinished { verdict, .. }) => *verdict,
        Err(error) => panic!("unexpected: {error}"),
    };
    assert_eq!(verdict.frames() + verdict.gaps(), 2 * triggers);
    // The thread of a segment that failed lets go of what it had not written after the segment was given up.
    let back = (0..2 * triggers).take_while(|_| returns.recv_timeout(Duration::from_secs(60)).is_ok());
    assert_eq!(back.count() as u64, 2 * triggers, "every block is back");
    assert!(returns.is_empty(), "and none twice");
    let reader = SessionReader::open(&path).expect("readable");
    let recording = &reader.recordings()[0];
    let found =
        |camera: usize, trigger| recording.frame(camera, TriggerIndex(trigger)).is_ok_and(|o| o.is_ok());
    let readable = (0..triggers).map(|t| u64::from(found(0, t)) + u64::from(found(1, t))).sum::<u64>();
    assert_eq!(readable, verdict.frames(), "neither fewer nor more than counted");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(96))]

    #[test]
    fn a_disk_that_fails_anywhere_keeps_the_books(
        bytes in prop_oneof![Just(i64::MAX), 20_000i64..900_000],
        syncs in prop_oneof![Just(i64::MAX), 2i64..24],
        segment_bytes in prop_oneof![Just(150_000u64), Just(u64::MAX)],
    ) {
        keeps_the_books(bytes, syncs, segment_bytes);
    }
}

/// Which sync is the last one of a segment depends on the threads: so each one fails, several times.
#[test]
fn each_sync_may_fail() {
    for syncs in (2..32).chain(2..32).chain(2..32) {
        keeps_the_books(i64::MAX, syncs, 150_000);
    }
}

/// Who opened stores, and how often space was set aside.
#[derive(Default)]
struct Openings {
    threads: Mutex<Vec<std::thread::ThreadId>>,
    set_aside: AtomicU64,
}

struct WatchedStore(DirectFile, Arc<Openings>);

impl Store for WatchedStore {
    fn write_at(&mut self, offset: u64, parts: &mut [IoSlice<'_>]) -> io::Result<()> {
        self.0.write_at(offset, parts)
    }

    fn set_len(&mut self, length: u64) -> io::Result<()> {
        self.0.set_len(length)
    }

    fn sync(&mut self) -> io::Result<()> {
        self.0.sync()
    }

    fn preallocate(&mut self, bytes: u64) -> io::Result<u64> {
        self.1.set_aside.fetch_add(1, Ordering::Relaxed);
        self.0.preallocate(bytes)
    }
}

#[test]
fn segments_are_made_ready_elsewhere_and_leave_nothing_behind() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("node-a");
    let openings = Arc::new(Openings::default());
    let watched = Arc::clone(&openings);
    let open = move |path: &Path| -> io::Result<Box<dyn Store>> {
        watched.threads.lock().expect("not poisoned").push(std::thread::current().id());
        Ok(Box::new(WatchedStore(DirectFile::create(path)?, Arc::clone(&watched))))
    };
    let mut recording =
        Recording::create_with(&path, sized(90, 90), options(500_000), Arc::new(open)).expect("created");
    for trigger in 0..100 {
        for camera in 0..CAMERAS.len() {
            let (meta, block) = block(camera, trigger, 90, 90);
            recording.frame_in_place(camera, &meta, block).expect("recorded");
        }
    }
    let verdict = recording.finish(end(100)).expect("finished");
    check(&path, &verdict, 90, 90);
    let threads = openings.threads.lock().expect("not poisoned");
    let here = threads.iter().filter(|id| **id == std::thread::current().id()).count();
    assert!(threads.len() > 3 && here == 1, "{here} of {} stores were opened by the recorder", threads.len());
    assert_eq!(openings.set_aside.load(Ordering::Relaxed), threads.len() as u64);
    for entry in std::fs::read_dir(&path).expect("a directory") {
        let entry = entry.expect("an entry");
        let name = entry.file_name().into_string().expect("a name");
        assert!(name.starts_with("segment-"), "{name} was left behind");
        let metadata = entry.metadata().expect("a file");
        let (used, length) = (metadata.blocks() * 512, metadata.len());
        assert!(used <= length + 65_536, "{name}: {used} bytes are set aside for {length}");
    }
}

/// What a crash leaves of a segment that was made ready: readers do not see it.
#[test]
fn a_segment_that_was_only_made_ready_is_no_puzzle() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("node-a");
    let recording = Recording::create(&path, sized(9, 9), options(1 << 30)).expect("created");
    let gaps = SessionEnd { absent: GapCause::Timeout, ..end(3) };
    let verdict = recording.finish(gaps).expect("finished");
    File::create(path.join(crate::layout::next_segment_name(1))).expect("a file");
    check(&path, &verdict, 9, 9);
}
