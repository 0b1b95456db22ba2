// SPDX-License-Identifier: MIT OR Apache-2.0
//! Writes one node's recording: segments, accounting, durability, and the verdict at the end.
//!
//! One thread calls it. It waits for the disk only when the queue of chunks is full; frames wait in their pool
//! meanwhile.

use super::belonging::{Belonging, Label, SessionMark};
use super::direct_io::{DirectFile, Store, sync_directory};
use super::envelope::{FrameMeta, marked, parse_envelope};
use super::layout::{
    CameraHeader, ClockSample, GapCause, GapRecord, MAX_TRIGGERS, NodeEvent, RecordingHeader, TriggerRecord,
    VERSION, segment_name,
};
use super::noted::{Noted, REFUSED};
use super::open_chunk::QUEUE;
use super::segment::{Closing, JsonChannel, Segment};
use super::statistics::{DiskProgress, WriteStatistics};
use super::verdict::{CameraTally, SessionEnd, TriggerSet, Verdict};
use crate::base::ids::{CameraId, TriggerIndex};
use crate::host::frame_memory::Block;
use serde::Serialize;
use std::collections::VecDeque;
use std::io;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Instant;

mod error;
mod failure;
mod options;
mod segments;
mod space;

pub use error::RecordError;
pub use options::WriterOptions;
use segments::{ClosingSegment, NextSegment, OpenSegment, Unwritten, prepare};
use space::check_space;

/// Frames of one chunk. A crash of the process costs at most three chunks: the open one, and those in the queue.
const BLOCKS_PER_CHUNK: usize = 4;
/// Blocks that the writer holds at most: the open chunk and the queue, of two segments around a split. A pool
/// needs as many beyond those that the cameras fill.
pub const BLOCKS_HELD: usize = 2 * (1 + QUEUE) * BLOCKS_PER_CHUNK;
/// A chunk ends after this many bytes of small records, too.
const CHUNK_BYTES: u64 = 1 << 20;
/// Records kept for the rescue segment when there is no segment to write them to.
const MAX_UNWRITTEN: usize = 1 << 20;

type OpenStore = Arc<dyn Fn(&Path) -> io::Result<Box<dyn Store>> + Send + Sync>;

/// Latencies of the disk, shared with those who watch the recording.
type Latencies = Arc<DiskProgress>;

/// The recording of one node while it is written.
///
/// The session's node thread creates it before any camera is started; the writer thread owns it from then on. It
/// promises that every camera ends with one outcome per trigger, that what is written is readable after a crash up to a
/// second before it, and that a failing disk costs frames, never the accounting. [`Self::finish`] ends it with the
/// verdict; without that it is interrupted, and `fourdbody recover` completes it.
pub struct Recording {
    dir: PathBuf,
    header: RecordingHeader,
    /// Version of the format, and the session's mark in it.
    belonging: Belonging,
    records: u64,
    options: WriterOptions,
    open_store: OpenStore,
    tallies: Vec<CameraTally>,
    /// Oldest first; two while cameras are on both sides of a split, none after a failure.
    segments: VecDeque<OpenSegment>,
    closing: Vec<ClosingSegment>,
    next: Option<NextSegment>,
    next_number: u32,
    unwritten: Vec<Unwritten>,
    stopped: Option<String>,
    rows: TriggerSet,
    noted: Noted,
    time_ns: u64,
    last_sync: Instant,
    unsynced: u64,
    /// Bytes written since the free space was checked.
    unchecked: u64,
    latencies: Latencies,
    /// Counts of segments that are no longer open.
    past: WriteStatistics,
    /// Statistics that the recording states instead of its own.
    stated_statistics: Option<Option<WriteStatistics>>,
}

impl Recording {
    /// Creates the directory `dir` with its first segment. The parent is created if needed.
    pub fn create(dir: &Path, header: RecordingHeader, options: WriterOptions) -> Result<Self, RecordError> {
        let bytes = header.expected_bytes().unwrap_or(0);
        Self::create_for(dir, header, options, bytes, VERSION, Self::disk())
    }

    /// Opens segments as files, past the page cache.
    pub(super) fn disk() -> OpenStore {
        Arc::new(|path| Ok(Box::new(DirectFile::create(path)?)))
    }

    /// As [`Self::create`], but for this many bytes, whatever the header expects, in this version of the format (a copy
    /// of records that do not prove their session must not prove it), and to these stores.
    pub(super) fn create_for(
        dir: &Path,
        header: RecordingHeader,
        options: WriterOptions,
        bytes: u64,
        version: u32,
        open_store: OpenStore,
    ) -> Result<Self, RecordError> {
        header.check().and_then(|()| options.check()).map_err(RecordError::Header)?;
        let disk = |source| RecordError::Disk { path: dir.to_owned(), source };
        let parent = dir.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let builder = |recursive| {
            let mut builder = std::fs::DirBuilder::new();
            builder.mode(0o750).recursive(recursive);
            builder
        };
        builder(true).create(parent).map_err(disk)?;
        check_space(parent, bytes, &options)?;
        builder(false).create(dir).map_err(|source| match source.kind() {
            io::ErrorKind::AlreadyExists => RecordError::Exists { path: dir.to_owned() },
            _ => disk(source),
        })?;
        let mut recording = Self {
            dir: dir.to_owned(),
            tallies: vec![CameraTally::default(); header.cameras.len()],
            time_ns: header.created_ns,
            belonging: Belonging::of(&header, version),
            records: 0,
            header,
            options,
            open_store,
            segments: VecDeque::new(),
            closing: Vec::new(),
            next: None,
            next_number: 0,
            unwritten: Vec::new(),
            stopped: None,
            rows: TriggerSet::default(),
            noted: Noted::default(),
            last_sync: Instant::now(),
            unsynced: 0,
            unchecked: 0,
            latencies: Latencies::default(),
            past: WriteStatistics::default(),
            stated_statistics: None,
        };
        let begun = recording.open_segment(0).map_err(disk).and_then(|()| recording.sync());
        let begun = begun.and_then(|()| recording.settle_all());
        match begun.and_then(|()| sync_directory(parent).map_err(disk)) {
            Ok(()) => Ok(recording),
            Err(error) => {
                drop(recording);
                // Nothing but what was just made is in it; a session that did not begin leaves nothing.
                if let Err(error) = std::fs::remove_dir_all(dir) {
                    tracing::warn!("{}: cannot be removed: {error}", dir.display());
                }
                Err(error)
            }
        }
    }

    /// The directory that the recording is written to.
    pub fn dir(&self) -> &Path {
        &self.dir
    }

    /// Records a frame: `message` is the envelope and the pixels in one slice, as
    /// [`super::envelope::write_envelope`] makes it.
    ///
    /// A second outcome for the same trigger is refused: noted as an event, and `Ok`. Unless the error is
    /// [`RecordError::Frame`], the trigger has its outcome afterwards, if need be a gap with cause
    /// `dropped_disk`: the caller adds nothing.
    pub fn frame(&mut self, camera: usize, meta: &FrameMeta, message: &[u8]) -> Result<(), RecordError> {
        let known = self.check_frame(camera, meta, message)?;
        match self.belonging.written().filter(|own| known != Some(*own)) {
            None => self.place_frame(camera, meta, |segment, _| segment.frame(camera, meta, message)),
            Some(own) => {
                let wrong = |reason: String| RecordError::Frame { camera, reason };
                if known.is_some() {
                    return Err(wrong("the message is of another session".to_owned()));
                }
                let message = marked(own, message).map_err(|e| wrong(e.to_string()))?;
                self.place_frame(camera, meta, |segment, _| segment.frame(camera, meta, &message))
            }
        }
    }

    /// Records a frame from the memory that the camera layer received it into: the envelope goes into the
    /// block's room, the pixels go to the disk from where they are, and the block goes back to its pool once the
    /// disk has it. Otherwise as [`Self::frame`]. `meta.pixels_crc` must be that of the pixels.
    pub fn frame_in_place(
        &mut self,
        camera: usize,
        meta: &FrameMeta,
        block: Block,
    ) -> Result<(), RecordError> {
        self.check_size(camera, meta)?;
        let expected = u64::from(meta.width) * u64::from(meta.height);
        if block.pixels().len() as u64 != expected {
            let found = block.pixels().len();
            let reason = format!("the block has {found} bytes of pixels, expected {expected}");
            return Err(RecordError::Frame { camera, reason });
        }
        self.place_frame(camera, meta, |segment, id| segment.frame_in_place(camera, id, meta, block))
    }

    fn place_frame(
        &mut self,
        camera: usize,
        meta: &FrameMeta,
        write: impl FnOnce(&mut Segment, &CameraId) -> io::Result<()>,
    ) -> Result<(), RecordError> {
        if self.stopped.is_some() || self.segments.is_empty() {
            let reason = self.stopped.clone().unwrap_or_default();
            self.gap(camera, meta.trigger, GapCause::DroppedDisk)?;
            return Err(RecordError::Stopped { reason });
        }
        self.time_ns = self.time_ns.max(meta.host_time_ns);
        if !self.accept(camera, meta.trigger, |tally| tally.frame(meta.trigger)) {
            return Ok(());
        }
        self.past.frames += 1;
        let place = self.place(meta.trigger);
        let entry = &mut self.segments[place];
        entry.frame(camera, meta.trigger);
        let before = entry.segment.bytes();
        let result = write(&mut entry.segment, &self.header.cameras[camera].id);
        let more = entry.segment.bytes() - before;
        self.unsynced += more;
        self.unchecked += more;
        self.latencies.bytes.fetch_add(more, Ordering::Relaxed);
        result.or_else(|source| self.fail(source))?;
        self.after_record(place)?;
        self.split_if_due()
    }

    /// How the disk keeps up, for threads that watch the recording.
    pub fn progress(&self) -> Arc<DiskProgress> {
        Arc::clone(&self.latencies)
    }

    /// How the disk keeps up.
    pub fn statistics(&self) -> WriteStatistics {
        let mut statistics = self.past;
        statistics.written = self.latencies.written.summary();
        statistics.durable = self.latencies.durable.summary();
        let mut held = 0;
        for entry in &self.segments {
            let window = entry.segment.window();
            held += window.blocks_high_water;
            statistics.copied_frames += window.copied_frames;
            drop(window);
            statistics.bytes += entry.segment.bytes();
        }
        statistics.blocks_high_water = statistics.blocks_high_water.max(held);
        statistics
    }

    /// The message must be the frame that `meta` and the header describe: otherwise a reader would refuse it.
    /// Returns the mark in the message, if it has one.
    fn check_frame(
        &self,
        camera: usize,
        meta: &FrameMeta,
        message: &[u8],
    ) -> Result<Option<SessionMark>, RecordError> {
        let described = self.described(camera)?;
        let wrong = |reason: String| RecordError::Frame { camera, reason };
        let envelope = parse_envelope(message).map_err(|e| wrong(e.to_string()))?;
        if envelope.meta != *meta || envelope.camera != described.id.as_str() {
            return Err(wrong(format!(
                "the message is of camera {} and {:?}, expected camera {} and {meta:?}",
                envelope.camera, envelope.meta, described.id
            )));
        }
        self.check_size(camera, meta)?;
        Ok(envelope.session)
    }

    fn check_size(&self, camera: usize, meta: &FrameMeta) -> Result<(), RecordError> {
        let described = self.described(camera)?;
        if (meta.width, meta.height) != (described.width, described.height) {
            let reason = format!(
                "the frame is {} x {}, the header states {} x {}",
                meta.width, meta.height, described.width, described.height
            );
            return Err(RecordError::Frame { camera, reason });
        }
        Ok(())
    }

    fn described(&self, camera: usize) -> Result<&CameraHeader, RecordError> {
        self.header.cameras.get(camera).ok_or_else(|| {
            let reason = format!("the recording has {} cameras", self.header.cameras.len());
            RecordError::Frame { camera, reason }
        })
    }

    /// Records that `camera` has no frame for `trigger`. A second outcome is refused as in [`Self::frame`].
    pub fn gap(&mut self, camera: usize, trigger: TriggerIndex, cause: GapCause) -> Result<(), RecordError> {
        let id = self.described(camera)?.id.clone();
        if !self.accept(camera, trigger, |tally| tally.gap(trigger, cause)) {
            return Ok(());
        }
        let record = GapRecord { camera: id, trigger, cause };
        self.json(JsonChannel::Gaps, trigger, self.time_ns, &record)
    }

    /// Records a row of the HSU's trigger table.
    pub fn trigger(&mut self, record: &TriggerRecord) -> Result<(), RecordError> {
        // What cannot be written now is tried again.
        self.rows.insert(record.index.0);
        self.json(JsonChannel::Triggers, record.index, record.host_time_ns, record)
    }

    /// Records an exchange with a device's clock.
    pub fn clock_sample(&mut self, sample: &ClockSample) -> Result<(), RecordError> {
        self.json(JsonChannel::Clock, self.newest(), sample.host_receive_ns, sample)
    }

    /// Records an event. One of kind `refused` (recovery repeats those of its source) counts as in the verdict.
    pub fn event(&mut self, event: &NodeEvent) -> Result<(), RecordError> {
        self.noted.note(event);
        self.json(JsonChannel::Events, self.newest(), event.host_time_ns, event)
    }

    /// Lets the recording state these statistics, or none, instead of its own: a copy states how the original was made.
    pub(super) fn state_statistics(&mut self, statistics: Option<WriteStatistics>) {
        self.stated_statistics = Some(statistics);
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
        let triggers = Verdict::triggers(&self.tallies, self.rows.end(), &end);
        for camera in 0..self.tallies.len() {
            for range in self.tallies[camera].seen().absent(triggers) {
                for trigger in range {
                    // An error is remembered: what cannot be written now is tried again below.
                    let _ = self.gap(camera, TriggerIndex(trigger), end.absent);
                }
            }
        }
        // Outcomes that are lost with a failing segment become gaps in the tallies now, not after the verdict.
        let _ = self.sync();
        let _ = self.settle_all();
        let closed = self.join_closing();
        let verdict = Verdict::of(&self.header, &self.tallies, &self.rows, triggers, self.noted.clone(), end);
        let result = closed.and(self.close(&verdict));
        result.map_err(|source| RecordError::Unfinished {
            path: self.dir.clone(),
            source,
            verdict: Box::new(verdict.clone()),
        })?;
        Ok(verdict)
    }

    fn close(&mut self, verdict: &Verdict) -> io::Result<()> {
        if self.segments.is_empty() || !self.unwritten.is_empty() {
            self.rescue()?;
        }
        self.next = None;
        let own = self.statistics();
        let stated = self.stated_statistics;
        let statistics = stated.as_ref().map_or(Some(&own), Option::as_ref);
        let mut last = self.segments.pop_back();
        let mut result = Ok(());
        while let Some(mut entry) = self.segments.pop_front() {
            let end = last.as_ref().map(|last| last.segment.first_trigger);
            result = result.and(entry.segment.finish(end, None));
        }
        if let Some(last) = &mut last {
            let closing = Closing { verdict, records: self.records, statistics };
            result = result.and(last.segment.finish(None, Some(closing)));
        }
        result.and(sync_directory(&self.dir))
    }

    fn camera_id(&self, camera: usize) -> Option<CameraId> {
        self.header.cameras.get(camera).map(|camera| camera.id.clone())
    }

    fn newest(&self) -> TriggerIndex {
        TriggerIndex(self.tallies.iter().map(|tally| tally.seen().end()).max().unwrap_or(0))
    }

    /// Enters an outcome into the accounting, or refuses it and notes that.
    fn accept(
        &mut self,
        camera: usize,
        trigger: TriggerIndex,
        enter: impl FnOnce(&mut CameraTally) -> bool,
    ) -> bool {
        if enter(&mut self.tallies[camera]) {
            return true;
        }
        let message = if trigger.0 >= MAX_TRIGGERS {
            format!("trigger {trigger} lies beyond the {MAX_TRIGGERS} that a session can have")
        } else {
            format!("trigger {trigger} has an outcome already; the second one is not recorded")
        };
        let (camera, trigger) = (self.camera_id(camera), Some(trigger));
        let event = NodeEvent { camera, trigger, ..NodeEvent::new(REFUSED, self.time_ns, message) };
        // A failure here shows again at the next record.
        let _ = self.event(&event);
        false
    }

    /// The segment of a trigger: the newest that begins at or before it.
    fn place(&self, trigger: TriggerIndex) -> usize {
        self.segments.iter().rposition(|entry| entry.segment.first_trigger <= trigger.0).unwrap_or(0)
    }

    /// A small record's bytes, with the session's mark and its number.
    fn small(&mut self, record: &impl Serialize) -> serde_json::Result<Vec<u8>> {
        let mut bytes = serde_json::to_vec(record)?;
        if let Some(session) = self.belonging.written() {
            Label { session: Some(session), number: Some(self.records) }.attach(&mut bytes);
            self.records += 1;
        }
        Ok(bytes)
    }

    fn json(
        &mut self,
        channel: JsonChannel,
        trigger: TriggerIndex,
        time_ns: u64,
        record: &impl Serialize,
    ) -> Result<(), RecordError> {
        self.time_ns = self.time_ns.max(time_ns);
        let bytes =
            self.small(record).map_err(|e| RecordError::Disk { path: self.dir.clone(), source: e.into() })?;
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
        let latencies = &mut self.latencies;
        let result = if entry.is_due() { entry.commit(latencies) } else { entry.poll(latencies) };
        result.or_else(|source| self.fail(source))?;
        let due = self.unsynced >= self.options.sync_bytes
            || self.last_sync.elapsed() >= self.options.sync_interval;
        if due {
            self.sync()?;
        } else if self.is_check_due() {
            self.check_free_space()?;
        }
        if self.segments.len() > 1 {
            self.close_older()?;
        }
        Ok(())
    }

    fn settle_all(&mut self) -> Result<(), RecordError> {
        let latencies = &mut self.latencies;
        let result = self.segments.iter_mut().try_for_each(|entry| entry.settle(latencies));
        result.or_else(|source| self.fail(source))
    }

    /// Requests that everything is made durable, and checks the space that is left.
    fn sync(&mut self) -> Result<(), RecordError> {
        let latencies = &mut self.latencies;
        let result = self.segments.iter_mut().try_for_each(|entry| entry.request_sync(latencies));
        result.or_else(|source| self.fail(source))?;
        self.last_sync = Instant::now();
        self.unsynced = 0;
        self.check_free_space()
    }

    fn open_segment(&mut self, first_trigger: u64) -> io::Result<()> {
        let (store, ahead) = match self.next.take() {
            Some(next) => next.take()?,
            None => {
                let ahead = self.ahead(0);
                prepare(&self.open_store, &self.dir.join(segment_name(self.next_number)), ahead)?
            }
        };
        self.past.access = Some(store.access());
        let segment =
            Segment::create(store, self.next_number, first_trigger, &self.header, self.belonging.version)?;
        self.next_number += 1;
        self.segments.push_back(OpenSegment::new(segment, ahead));
        Ok(())
    }

    /// Begins the next segment, which was made ready when half of this one was written. It waits while the last
    /// split is not over: no frame is ever late for its segment, and never do more than two segments have chunks that
    /// are not in their files.
    fn split_if_due(&mut self) -> Result<(), RecordError> {
        if !self.closing.is_empty() {
            self.reap_closed()?;
        }
        let [entry] = self.segments.make_contiguous() else { return Ok(()) };
        let bytes = entry.segment.bytes();
        if self.next.is_none() && bytes >= self.options.segment_bytes / 2 {
            let ahead = self.ahead(self.past.bytes + self.options.segment_bytes);
            let open = Arc::clone(&self.open_store);
            self.next = Some(NextSegment::prepare(open, &self.dir, self.next_number, ahead));
        }
        if bytes < self.options.segment_bytes {
            return Ok(());
        }
        self.join_closing().or_else(|source| self.fail(source))?;
        let boundary = self.newest().0;
        self.open_segment(boundary).or_else(|source| self.fail(source))?;
        self.close_older()
    }

    /// Closes the older of two segments, on a thread of its own, once every camera is past it.
    fn close_older(&mut self) -> Result<(), RecordError> {
        let Some(boundary) = self.segments.get(1).map(|entry| entry.segment.first_trigger) else {
            return Ok(());
        };
        if !self.tallies.iter().all(|tally| tally.seen().covers(boundary)) {
            return Ok(());
        }
        let statistics = self.statistics();
        let Some(mut older) = self.segments.pop_front() else { return Ok(()) };
        if let Err(source) = older.commit(&mut self.latencies) {
            self.segments.push_front(older);
            return self.fail(source);
        }
        self.past.blocks_high_water = statistics.blocks_high_water;
        self.past.copied_frames += older.segment.window().copied_frames;
        self.past.bytes += older.segment.bytes();
        self.closing.push(older.close_aside(Some(boundary)));
        Ok(())
    }
}

#[cfg(test)]
mod block_tests;
#[cfg(test)]
pub(crate) mod tests;
