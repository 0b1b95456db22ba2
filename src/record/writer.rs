//! Writes one node's recording: segments, accounting, durability, and the verdict at the end.
//!
//! One thread calls it. It blocks while the disk writes; frames wait in their pool meanwhile.

use super::direct::{DirectFile, Store, free_bytes, sync_directory};
use super::envelope::{FrameMeta, parse_envelope, write_envelope};
use super::layout::{
    ClockSample, GapCause, GapRecord, MAX_TRIGGERS, NodeEvent, RecordingHeader, TriggerRecord, segment_name,
};
use super::segment::{JsonChannel, Segment};
use super::verdict::{CameraTally, SessionEnd, Status, Verdict};
use crate::acquire::pool::{Block, ROOM_BYTES};
use crate::ids::{CameraId, TriggerIndex};
use serde::Serialize;
use std::collections::VecDeque;
use std::io;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

mod error;

pub use error::RecordError;

const MIB: u64 = 1 << 20;
/// Frames of one chunk. A crash of the process costs at most two chunks: the open one, and the one under way.
const FRAMES_PER_CHUNK: usize = 4;
/// A chunk ends after this many bytes of small records, too.
const CHUNK_BYTES: u64 = 1 << 20;
/// What segments need beyond pixels (headers, indexes, gap records), for the space check.
const ACCOUNTING_BYTES: u64 = 16 << 20;
/// Records kept for the rescue segment when there is no segment to write them to.
const MAX_UNWRITTEN: usize = 1 << 20;

/// Kind of the events that stand for refused outcomes; `verify` counts them.
pub(crate) const REFUSED: &str = "refused";

/// Sizes and intervals.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WriterOptions {
    /// A segment is closed at the first trigger after this many bytes.
    pub segment_bytes: u64,
    /// Frames are no longer accepted when less than this is free; gap records and verdict still are.
    pub reserve_bytes: u64,
    /// `fdatasync` after this many bytes at the latest.
    pub sync_bytes: u64,
    /// `fdatasync` after this time at the latest; at most a second.
    pub sync_interval: Duration,
}

impl Default for WriterOptions {
    fn default() -> Self {
        Self {
            segment_bytes: 16 << 30,
            reserve_bytes: 1 << 30,
            sync_bytes: 512 << 20,
            sync_interval: Duration::from_millis(500),
        }
    }
}

type OpenStore = Box<dyn Fn(&Path) -> io::Result<Box<dyn Store>> + Send>;

/// A record that is not known to be on disk.
enum Unwritten {
    Frame { camera: usize, trigger: TriggerIndex },
    Json { channel: JsonChannel, sequence: u64, time_ns: u64, bytes: Vec<u8> },
}

/// A segment, and what its open chunk and the one under way to the disk hold.
struct OpenSegment {
    segment: Segment,
    under_way: Vec<Unwritten>,
    open: Vec<Unwritten>,
    open_frames: usize,
    open_since: u64,
}

/// A recording being written.
pub struct Recording {
    dir: PathBuf,
    header: RecordingHeader,
    options: WriterOptions,
    open_store: OpenStore,
    tallies: Vec<CameraTally>,
    /// Oldest first; two while cameras are on both sides of a split, none after a failure.
    segments: VecDeque<OpenSegment>,
    closing: Vec<JoinHandle<io::Result<()>>>,
    next_number: u32,
    unwritten: Vec<Unwritten>,
    stopped: Option<String>,
    triggers_end: u64,
    refused: u64,
    time_ns: u64,
    last_sync: Instant,
    unsynced: u64,
    /// A segment was created whose name is not durable yet.
    new_name: bool,
}

impl Recording {
    /// Creates the directory `dir` with its first segment. The parent is created if needed.
    pub fn create(dir: &Path, header: RecordingHeader, options: WriterOptions) -> Result<Self, RecordError> {
        let open = |path: &Path| -> io::Result<Box<dyn Store>> { Ok(Box::new(DirectFile::create(path)?)) };
        Self::create_with(dir, header, options, Box::new(open))
    }

    fn create_with(
        dir: &Path,
        header: RecordingHeader,
        options: WriterOptions,
        open_store: OpenStore,
    ) -> Result<Self, RecordError> {
        header.check().map_err(RecordError::Header)?;
        let disk = |source| RecordError::Disk { path: dir.to_owned(), source };
        let parent = dir.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let builder = |recursive| {
            let mut builder = std::fs::DirBuilder::new();
            builder.mode(0o750).recursive(recursive);
            builder
        };
        builder(true).create(parent).map_err(disk)?;
        check_space(parent, &header, &options)?;
        builder(false).create(dir).map_err(|source| match source.kind() {
            io::ErrorKind::AlreadyExists => RecordError::Exists { path: dir.to_owned() },
            _ => disk(source),
        })?;
        let mut recording = Self {
            dir: dir.to_owned(),
            tallies: vec![CameraTally::default(); header.cameras.len()],
            time_ns: header.created_ns,
            header,
            options,
            open_store,
            segments: VecDeque::new(),
            closing: Vec::new(),
            next_number: 0,
            unwritten: Vec::new(),
            stopped: None,
            triggers_end: 0,
            refused: 0,
            last_sync: Instant::now(),
            unsynced: 0,
            new_name: false,
        };
        recording.open_segment(0).map_err(disk)?;
        sync_directory(parent).map_err(disk)?;
        Ok(recording)
    }

    /// The recording's directory.
    pub fn dir(&self) -> &Path {
        &self.dir
    }

    /// Records a frame: `message` is the envelope and the pixels in one slice, as
    /// [`super::write_envelope`] makes it.
    ///
    /// A second outcome for the same trigger is refused: noted as an event, and `Ok`. Unless the error is
    /// [`RecordError::Frame`], the trigger has its outcome afterwards, if need be a gap with cause
    /// `dropped_disk`: the caller adds nothing.
    pub fn frame(&mut self, camera: usize, meta: &FrameMeta, message: &[u8]) -> Result<(), RecordError> {
        self.check_frame(camera, meta, message)?;
        if self.stopped.is_some() || self.segments.is_empty() {
            let reason = self.stopped.clone().unwrap_or_default();
            self.gap(camera, meta.trigger, GapCause::DroppedDisk)?;
            return Err(RecordError::Stopped { reason });
        }
        self.time_ns = self.time_ns.max(meta.host_time_ns);
        if !self.accept(camera, meta.trigger, |tally| tally.frame(meta.trigger)) {
            return Ok(());
        }
        let place = self.place(meta.trigger);
        let entry = &mut self.segments[place];
        entry.open.push(Unwritten::Frame { camera, trigger: meta.trigger });
        entry.open_frames += 1;
        entry.segment.frame(camera, meta, message).or_else(|source| self.fail(source))?;
        self.unsynced += message.len() as u64;
        self.after_record(place)?;
        self.split_if_due()
    }

    /// Records a frame from the memory that the camera layer received it into: the envelope goes into the
    /// block's room, and the block goes back to its pool once the disk has it. Otherwise as [`Self::frame`].
    pub fn frame_in_place(
        &mut self,
        camera: usize,
        meta: &FrameMeta,
        mut block: Block,
    ) -> Result<(), RecordError> {
        let id = self.camera_id(camera).unwrap_or(CameraId(String::new()));
        let length = write_envelope(block.room_mut(), &id, meta)
            .map_err(|e| RecordError::Frame { camera, reason: e.to_string() })?;
        self.frame(camera, meta, &block.bytes()[ROOM_BYTES - length..])
    }

    /// The message must be the frame that `meta` and the header describe: otherwise a reader would refuse it.
    fn check_frame(&self, camera: usize, meta: &FrameMeta, message: &[u8]) -> Result<(), RecordError> {
        let wrong = |reason: String| RecordError::Frame { camera, reason };
        let Some(described) = self.header.cameras.get(camera) else {
            return Err(wrong(format!("the recording has {} cameras", self.header.cameras.len())));
        };
        let envelope = parse_envelope(message).map_err(|e| wrong(e.to_string()))?;
        if envelope.meta != *meta || envelope.camera != described.id.as_str() {
            return Err(wrong(format!(
                "the message is of camera {} and {:?}, expected camera {} and {meta:?}",
                envelope.camera, envelope.meta, described.id
            )));
        }
        if (meta.width, meta.height) != (described.width, described.height) {
            return Err(wrong(format!(
                "the frame is {} x {}, the header says {} x {}",
                meta.width, meta.height, described.width, described.height
            )));
        }
        Ok(())
    }

    /// Records that `camera` has no frame for `trigger`. A second outcome is refused as in [`Self::frame`].
    pub fn gap(&mut self, camera: usize, trigger: TriggerIndex, cause: GapCause) -> Result<(), RecordError> {
        let Some(id) = self.camera_id(camera) else {
            let reason = format!("gap: the recording has {} cameras", self.tallies.len());
            return Err(RecordError::Frame { camera, reason });
        };
        if !self.accept(camera, trigger, |tally| tally.gap(trigger, cause)) {
            return Ok(());
        }
        let record = GapRecord { camera: id, trigger, cause };
        self.json(JsonChannel::Gaps, trigger, self.time_ns, &record)
    }

    /// Records a row of the HSU's trigger table.
    pub fn trigger(&mut self, record: &TriggerRecord) -> Result<(), RecordError> {
        self.json(JsonChannel::Triggers, record.index, record.host_time_ns, record)?;
        if record.index.0 < MAX_TRIGGERS {
            self.triggers_end = self.triggers_end.max(record.index.0 + 1);
        }
        Ok(())
    }

    /// Records a clock exchange.
    pub fn clock_sample(&mut self, sample: &ClockSample) -> Result<(), RecordError> {
        self.json(JsonChannel::Clock, self.newest(), sample.host_receive_ns, sample)
    }

    /// Records an event.
    pub fn event(&mut self, event: &NodeEvent) -> Result<(), RecordError> {
        self.json(JsonChannel::Events, self.newest(), event.host_time_ns, event)
    }

    /// Keeps the promise on durability while nothing is recorded: call it at least every sync interval.
    pub fn tick(&mut self) -> Result<(), RecordError> {
        if self.last_sync.elapsed() >= self.options.sync_interval && !self.segments.is_empty() {
            self.sync()?;
        }
        Ok(())
    }

    /// Ends the recording: a gap record for every outcome that is absent, the verdict, summaries, and
    /// everything on the medium.
    pub fn finish(mut self, end: SessionEnd) -> Result<Verdict, RecordError> {
        self.time_ns = self.time_ns.max(end.host_time_ns);
        let seen = self.tallies.iter().map(|tally| tally.seen().end()).max().unwrap_or(0);
        let triggers = seen.max(self.triggers_end).max(end.triggers_emitted.unwrap_or(0)).min(MAX_TRIGGERS);
        for camera in 0..self.tallies.len() {
            for range in self.tallies[camera].seen().absent(triggers) {
                for trigger in range {
                    // An error is remembered: what cannot be written now is tried again below.
                    let _ = self.gap(camera, TriggerIndex(trigger), end.absent);
                }
            }
        }
        // Outcomes that were lost with a failed segment have become gaps in the tallies by now.
        let _ = self.settle_all();
        let verdict = self.verdict(triggers, end);
        let result = self.close(&verdict);
        result.map_err(|source| RecordError::Unfinished {
            path: self.dir.clone(),
            source,
            verdict: Box::new(verdict.clone()),
        })?;
        Ok(verdict)
    }

    fn verdict(&self, triggers: u64, end: SessionEnd) -> Verdict {
        let named = self.header.cameras.iter().zip(&self.tallies);
        let mut verdict = Verdict {
            status: Status::Incomplete,
            triggers,
            triggers_expected: self.header.expected_triggers,
            triggers_emitted: end.triggers_emitted,
            cameras: named.map(|(camera, tally)| tally.verdict(&camera.id)).collect(),
            refused: self.refused,
            aborted: end.aborted,
        };
        verdict.status = verdict.judge();
        verdict
    }

    fn close(&mut self, verdict: &Verdict) -> io::Result<()> {
        if self.segments.is_empty() || !self.unwritten.is_empty() {
            self.rescue()?;
        }
        let mut last = self.segments.pop_back();
        let mut result = Ok(());
        while let Some(entry) = self.segments.pop_front() {
            let end = last.as_ref().map(|last| last.segment.first_trigger());
            result = result.and(entry.segment.finish(end, None));
        }
        for thread in self.closing.drain(..) {
            let closed =
                thread.join().unwrap_or_else(|_| Err(io::Error::other("closing a segment panicked")));
            // After a failure the broken segments are known to be; their readable part is what counts.
            result = result.and(if self.stopped.is_some() { Ok(()) } else { closed });
        }
        if let Some(last) = last.take() {
            result = result.and(last.segment.finish(None, Some(verdict)));
        }
        result.and(sync_directory(&self.dir))
    }

    fn camera_id(&self, camera: usize) -> Option<CameraId> {
        self.header.cameras.get(camera).map(|camera| camera.id.clone())
    }

    fn newest(&self) -> TriggerIndex {
        TriggerIndex(self.tallies.iter().map(|tally| tally.seen().end()).max().unwrap_or(0))
    }

    /// Enters an outcome into the books, or refuses it and notes that.
    fn accept(
        &mut self,
        camera: usize,
        trigger: TriggerIndex,
        enter: impl FnOnce(&mut CameraTally) -> bool,
    ) -> bool {
        if enter(&mut self.tallies[camera]) {
            return true;
        }
        self.refused += 1;
        let message = if trigger.0 >= MAX_TRIGGERS {
            format!("trigger {trigger} lies beyond the {MAX_TRIGGERS} that a session can have")
        } else {
            format!("trigger {trigger} has an outcome already; the second one is not recorded")
        };
        let (host_time_ns, kind) = (self.time_ns, REFUSED.to_owned());
        let camera = self.camera_id(camera);
        let event = NodeEvent { host_time_ns, kind, camera, trigger: Some(trigger), message };
        // A failure here shows again at the next record.
        let _ = self.event(&event);
        false
    }

    /// The segment of a trigger: the newest that begins at or before it.
    fn place(&self, trigger: TriggerIndex) -> usize {
        self.segments.iter().rposition(|entry| entry.segment.first_trigger() <= trigger.0).unwrap_or(0)
    }

    fn json(
        &mut self,
        channel: JsonChannel,
        trigger: TriggerIndex,
        time_ns: u64,
        record: &impl Serialize,
    ) -> Result<(), RecordError> {
        self.time_ns = self.time_ns.max(time_ns);
        let bytes = serde_json::to_vec(record)
            .map_err(|e| RecordError::Disk { path: self.dir.clone(), source: e.into() })?;
        let record = Unwritten::Json { channel, sequence: trigger.0, time_ns, bytes };
        let place = self.place(trigger);
        let Some(entry) = self.segments.get_mut(place) else {
            if self.unwritten.len() < MAX_UNWRITTEN {
                self.unwritten.push(record);
            }
            return Ok(());
        };
        let result = entry.write(record);
        result.or_else(|source| self.fail(source))?;
        self.after_record(place)
    }

    /// Commits and syncs where it is due; closes the older segment when all cameras are past it.
    fn after_record(&mut self, place: usize) -> Result<(), RecordError> {
        let entry = &mut self.segments[place];
        let open_bytes = entry.segment.bytes() - entry.open_since;
        if entry.open_frames >= FRAMES_PER_CHUNK || (entry.open_frames == 0 && open_bytes >= CHUNK_BYTES) {
            let result = entry.commit();
            result.or_else(|source| self.fail(source))?;
        }
        let due = self.unsynced >= self.options.sync_bytes
            || self.last_sync.elapsed() >= self.options.sync_interval;
        if due {
            self.sync()?;
        }
        if self.segments.len() > 1 {
            self.close_older()?;
        }
        Ok(())
    }

    fn settle_all(&mut self) -> Result<(), RecordError> {
        let result = self.segments.iter_mut().try_for_each(OpenSegment::settle);
        result.or_else(|source| self.fail(source))
    }

    fn sync(&mut self) -> Result<(), RecordError> {
        self.settle_all()?;
        let mut result = self.segments.iter_mut().try_for_each(|entry| entry.segment.sync());
        if self.new_name {
            result = result.and_then(|()| sync_directory(&self.dir));
        }
        result.or_else(|source| self.fail(source))?;
        self.new_name = false;
        self.last_sync = Instant::now();
        self.unsynced = 0;
        let free = free_bytes(&self.dir).unwrap_or(u64::MAX);
        if free < self.options.reserve_bytes && self.stopped.is_none() {
            let (path, reserve_mib) = (self.dir.clone(), self.options.reserve_bytes / MIB);
            let error = RecordError::ReserveReached { path, free_mib: free / MIB, reserve_mib };
            self.stopped = Some(error.to_string());
            return Err(error);
        }
        Ok(())
    }

    fn open_segment(&mut self, first_trigger: u64) -> io::Result<()> {
        let path = self.dir.join(segment_name(self.next_number));
        let store = (self.open_store)(&path)?;
        let largest = self.header.cameras.iter().map(|c| c.width as usize * c.height as usize).max();
        let window = (largest.unwrap_or(0) + 4096) * FRAMES_PER_CHUNK + 2 * CHUNK_BYTES as usize;
        let segment = Segment::create(store, window, self.next_number, first_trigger, &self.header)?;
        self.new_name = true;
        self.next_number += 1;
        let open_since = segment.bytes();
        self.segments.push_back(OpenSegment {
            segment,
            under_way: Vec::new(),
            open: Vec::new(),
            open_frames: 0,
            open_since,
        });
        Ok(())
    }

    /// Begins the next segment. It waits while the last split is not over, so that no frame is ever late
    /// for its segment.
    fn split_if_due(&mut self) -> Result<(), RecordError> {
        let [entry] = self.segments.make_contiguous() else { return Ok(()) };
        if entry.segment.bytes() < self.options.segment_bytes {
            return Ok(());
        }
        let boundary = self.newest().0;
        self.open_segment(boundary).or_else(|source| self.fail(source))?;
        self.close_older()
    }

    /// Closes the older of two segments, on a thread of its own, once every camera is past it.
    fn close_older(&mut self) -> Result<(), RecordError> {
        let Some(boundary) = self.segments.get(1).map(|entry| entry.segment.first_trigger()) else {
            return Ok(());
        };
        if !self.tallies.iter().all(|tally| tally.seen().covers(boundary)) {
            return Ok(());
        }
        let Some(mut older) = self.segments.pop_front() else { return Ok(()) };
        if let Err(source) = older.settle() {
            self.segments.push_front(older);
            return self.fail(source);
        }
        self.closing.push(std::thread::spawn(move || older.segment.finish(Some(boundary), None)));
        Ok(())
    }

    /// After a failed write: nothing more goes to the open segments, frames of their open chunks become
    /// gaps, and the books go on in a segment of their own.
    fn fail(&mut self, source: io::Error) -> Result<(), RecordError> {
        let error = RecordError::Disk { path: self.dir.clone(), source };
        tracing::error!("{error}");
        self.stopped.get_or_insert_with(|| error.to_string());
        self.abandon_segments();
        if let Err(error) = self.rescue() {
            tracing::error!("{}: no segment for the accounting yet ({error})", self.dir.display());
        }
        Err(error)
    }

    /// Closes the open segments that still can be written; what the others lose waits for the rescue.
    fn abandon_segments(&mut self) {
        let mut lost = std::mem::take(&mut self.unwritten);
        for mut entry in std::mem::take(&mut self.segments) {
            if entry.settle().is_ok() {
                self.closing.push(std::thread::spawn(move || entry.segment.finish(None, None)));
            } else {
                entry.segment.abandon();
                lost.extend(entry.under_way);
                lost.extend(entry.open);
            }
        }
        for record in lost {
            let record = self.account(record);
            self.unwritten.extend(record);
        }
    }

    /// A frame that did not reach the disk becomes a gap.
    fn account(&mut self, record: Unwritten) -> Option<Unwritten> {
        let Unwritten::Frame { camera, trigger } = record else { return Some(record) };
        let tally = self.tallies.get_mut(camera)?;
        tally.forget_frame(trigger);
        tally.gap(trigger, GapCause::DroppedDisk);
        let gap = GapRecord { camera: self.camera_id(camera)?, trigger, cause: GapCause::DroppedDisk };
        let bytes = serde_json::to_vec(&gap).ok()?;
        let (channel, time_ns) = (JsonChannel::Gaps, self.time_ns);
        Some(Unwritten::Json { channel, sequence: trigger.0, time_ns, bytes })
    }

    /// Opens a segment for the accounting and moves there what waits for it.
    fn rescue(&mut self) -> io::Result<()> {
        if self.segments.is_empty() {
            let opened = self.open_segment(self.newest().0);
            if opened.is_err() {
                // The name may be taken by half a file: the next attempt takes the next one.
                self.next_number += 1;
            }
            opened?;
        }
        let Some(entry) = self.segments.back_mut() else { return Ok(()) };
        let mut waiting = std::mem::take(&mut self.unwritten).into_iter();
        let result = waiting.by_ref().try_for_each(|record| entry.write(record));
        let result = result.and_then(|()| entry.settle()).and_then(|()| entry.segment.sync());
        self.unwritten.extend(waiting);
        if result.is_err() {
            self.abandon_segments();
        }
        result
    }
}

impl OpenSegment {
    fn write(&mut self, record: Unwritten) -> io::Result<()> {
        let result = match &record {
            Unwritten::Json { channel, sequence, time_ns, bytes } => {
                self.segment.json(*channel, *sequence, *time_ns, bytes)
            }
            Unwritten::Frame { .. } => Ok(()),
        };
        self.open.push(record);
        result
    }

    fn commit(&mut self) -> io::Result<()> {
        self.segment.commit()?;
        self.under_way.clear();
        std::mem::swap(&mut self.under_way, &mut self.open);
        self.open_frames = 0;
        self.open_since = self.segment.bytes();
        Ok(())
    }

    /// Commits, and returns when nothing is under way any more.
    fn settle(&mut self) -> io::Result<()> {
        self.commit()?;
        self.segment.settle()?;
        self.under_way.clear();
        Ok(())
    }
}

fn check_space(dir: &Path, header: &RecordingHeader, options: &WriterOptions) -> Result<(), RecordError> {
    let free = free_bytes(dir).map_err(|source| RecordError::Disk { path: dir.to_owned(), source })?;
    let needed = header.expected_bytes().unwrap_or(0).saturating_add(ACCOUNTING_BYTES);
    if needed.saturating_add(options.reserve_bytes) > free {
        return Err(RecordError::NoSpace {
            path: dir.to_owned(),
            needed_mib: needed.div_ceil(MIB),
            reserve_mib: options.reserve_bytes / MIB,
            free_mib: free / MIB,
        });
    }
    Ok(())
}

#[cfg(test)]
mod tests;
