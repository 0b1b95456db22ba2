// SPDX-License-Identifier: MIT OR Apache-2.0
//! Open segments: what they hold that is not on the medium yet, the next one made ready beforehand, and the
//! older one closed aside.

use super::{BLOCKS_PER_CHUNK, CHUNK_BYTES, Latencies, OpenStore};
use crate::base::ids::TriggerIndex;
use crate::direct_io::{Store, rename_new};
use crate::layout::{next_segment_name, segment_name};
use crate::segment::{JsonChannel, Segment};
use std::collections::VecDeque;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::Instant;

/// A record that is not known to be on the medium.
pub(super) enum Unwritten {
    Frame { camera: usize, trigger: TriggerIndex, since: Instant },
    Json { channel: JsonChannel, sequence: u64, time_ns: u64, bytes: Vec<u8> },
}

/// The records of one commit.
struct Group {
    /// Length of the file with them.
    end: u64,
    written: bool,
    records: Vec<Unwritten>,
}

/// A segment, and the records in it that would be lost if the power went now.
pub(super) struct OpenSegment {
    pub segment: Segment,
    groups: VecDeque<Group>,
    open: Vec<Unwritten>,
    open_frames: usize,
    open_since: u64,
    /// Disk space set aside for it.
    preallocated: u64,
}

impl OpenSegment {
    pub fn new(segment: Segment, preallocated: u64) -> Self {
        let open_since = segment.bytes();
        let (groups, open) = (VecDeque::new(), Vec::new());
        Self { segment, groups, open, open_frames: 0, open_since, preallocated }
    }

    /// Space that was set aside and is not used yet.
    pub fn ahead(&self) -> u64 {
        self.preallocated.saturating_sub(self.segment.bytes())
    }

    /// Remembers a frame that goes to the open chunk next.
    pub fn frame(&mut self, camera: usize, trigger: TriggerIndex) {
        self.open.push(Unwritten::Frame { camera, trigger, since: Instant::now() });
        self.open_frames += 1;
    }

    pub fn write(&mut self, record: Unwritten) -> io::Result<()> {
        let result = match &record {
            Unwritten::Json { channel, sequence, time_ns, bytes } => {
                self.segment.json(*channel, *sequence, *time_ns, bytes)
            }
            Unwritten::Frame { .. } => Ok(()),
        };
        self.open.push(record);
        result
    }

    /// Whether the open chunk is full.
    pub fn is_due(&self) -> bool {
        let bytes = self.segment.bytes() - self.open_since;
        self.open_frames >= BLOCKS_PER_CHUNK || (self.open_frames == 0 && bytes >= CHUNK_BYTES)
    }

    /// Learns what the disk has done.
    pub fn poll(&mut self, latencies: &mut Latencies) -> io::Result<()> {
        let result = self.segment.window().poll();
        self.observe(latencies);
        result
    }

    /// Ends the open chunk and hands it to the disk.
    pub fn commit(&mut self, latencies: &mut Latencies) -> io::Result<()> {
        let end = self.segment.commit()?;
        if !self.open.is_empty() {
            let records = std::mem::take(&mut self.open);
            self.groups.push_back(Group { end, written: false, records });
        }
        self.open_frames = 0;
        self.open_since = end;
        self.observe(latencies);
        Ok(())
    }

    /// Commits, and returns when nothing is under way any more.
    pub fn settle(&mut self, latencies: &mut Latencies) -> io::Result<()> {
        self.commit(latencies)?;
        let result = self.segment.window().settle();
        self.observe(latencies);
        result
    }

    /// Commits, and asks for an `fdatasync`.
    pub fn request_sync(&mut self, latencies: &mut Latencies) -> io::Result<()> {
        self.commit(latencies)?;
        self.segment.window().request_sync()
    }

    /// Forgets what is on the medium, and notes how long it took.
    pub fn observe(&mut self, latencies: &mut Latencies) {
        let milestones: Vec<_> = self.segment.window().milestones.drain(..).collect();
        for milestone in milestones {
            let reached = self.groups.iter_mut().take_while(|group| group.end <= milestone.end);
            for group in reached.filter(|group| milestone.durable || !group.written) {
                for record in &group.records {
                    let Unwritten::Frame { since, .. } = record else { continue };
                    let time = milestone.at.saturating_duration_since(*since);
                    let histogram = if milestone.durable { &latencies.durable } else { &latencies.written };
                    histogram.record(time);
                }
                group.written = true;
            }
            while milestone.durable && self.groups.front().is_some_and(|group| group.end <= milestone.end) {
                self.groups.pop_front();
            }
        }
    }

    /// Gives the segment up; returns what it lost.
    pub fn abandon(self) -> Vec<Unwritten> {
        let kept = self.segment.window().abandon();
        let lost = self.groups.into_iter().filter(|group| group.end > kept);
        lost.flat_map(|group| group.records).chain(self.open).collect()
    }

    /// Ends the segment on a thread of its own.
    pub fn close_aside(mut self, end_trigger: Option<u64>) -> ClosingSegment {
        ClosingSegment(std::thread::spawn(move || {
            let result = self.segment.finish(end_trigger, None);
            (self, result)
        }))
    }
}

/// A segment that is being closed.
pub(super) struct ClosingSegment(JoinHandle<(OpenSegment, io::Result<()>)>);

impl ClosingSegment {
    /// Whether [`Self::join`] would return at once.
    pub fn is_done(&self) -> bool {
        self.0.is_finished()
    }

    /// Waits for it. One that the disk refused comes with the error.
    pub fn join(self, latencies: &mut Latencies) -> Result<(), (io::Error, Option<Box<OpenSegment>>)> {
        let Ok((mut segment, result)) = self.0.join() else {
            return Err((io::Error::other("closing a segment panicked"), None));
        };
        segment.observe(latencies);
        result.map_err(|error| (error, Some(Box::new(segment))))
    }
}

/// A store, and the space set aside for it.
pub(super) type Prepared = (Box<dyn Store>, u64);

/// The next segment's file, prepared on a thread of its own under a name that no reader takes for a segment.
pub(super) struct NextSegment {
    number: u32,
    path: PathBuf,
    /// Space set aside, once it is.
    ahead: Arc<AtomicU64>,
    thread: Option<JoinHandle<io::Result<Prepared>>>,
}

impl NextSegment {
    pub fn prepare(open: OpenStore, dir: &Path, number: u32, ahead: u64) -> Self {
        let path = dir.join(next_segment_name(number));
        let (own, done) = (path.clone(), Arc::new(AtomicU64::new(0)));
        let report = Arc::clone(&done);
        let thread = std::thread::spawn(move || {
            prepare(&open, &own, ahead).inspect(|(_, ahead)| report.store(*ahead, Ordering::Relaxed))
        });
        Self { number, path, ahead: done, thread: Some(thread) }
    }

    /// Space that is set aside.
    pub fn ahead(&self) -> u64 {
        self.ahead.load(Ordering::Relaxed)
    }

    /// Gives it the name of a segment.
    pub fn take(mut self) -> io::Result<Prepared> {
        let thread = self.thread.take().ok_or_else(|| io::Error::other("taken twice"))?;
        let prepared =
            thread.join().unwrap_or_else(|_| Err(io::Error::other("preparing a segment panicked")))?;
        let dir = self.path.parent().unwrap_or(Path::new("."));
        rename_new(&self.path, &dir.join(segment_name(self.number)))?;
        Ok(prepared)
    }
}

impl Drop for NextSegment {
    fn drop(&mut self) {
        if let Some(thread) = self.thread.take() {
            drop(thread.join());
            let _ = std::fs::remove_file(&self.path);
        }
    }
}

/// Opens a store and sets space aside where the file system can; a refusal costs nothing but the advantage.
pub(super) fn prepare(open: &OpenStore, path: &Path, ahead: u64) -> io::Result<Prepared> {
    let mut store = open(path)?;
    let ahead = if ahead == 0 { 0 } else { store.preallocate(ahead).unwrap_or(0) };
    Ok((store, ahead))
}
