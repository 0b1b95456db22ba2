// SPDX-License-Identifier: MIT OR Apache-2.0
//! The bounded hand-off from the matching thread to the thread that owns the recording.
//!
//! Frames are admitted set by set: a set that does not fit as a whole is not admitted. Small records (triggers,
//! gaps, clock samples, events) have room of their own, so that what explains a full ring still gets through.

use super::commands::RecorderEvent;
use super::hold::{Hold, Passed};
use super::preview::Taps;
use super::progress::Progress;
use crate::base::ids::TriggerIndex;
use crate::base::{Exit, Fault};
use crate::host::frame_memory::Block;
use crate::record::{
    ClockSample, FrameMeta, GapCause, NodeEvent, RecordError, Recording, SessionEnd, TriggerRecord, Verdict,
};
use crossbeam_channel::{Receiver, RecvTimeoutError, Sender, bounded};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Room for small records beside the frames: several minutes of them at 120 Hz.
const SMALL_RECORDS: usize = 65_536;
/// Longest sleep of the writer's thread: then it keeps the recording's durability bound.
const TICK: Duration = Duration::from_millis(20);

/// A frame whose trigger is known.
#[derive(Debug)]
pub struct ReadyFrame {
    pub(super) camera: usize,
    pub(super) meta: FrameMeta,
    pub(super) block: Block,
    pub(super) taken: Instant,
    /// When its trigger was found, later when it entered the ring.
    pub(super) since: Instant,
}

/// A record for the recording, in order.
#[derive(Debug)]
pub enum ToWriter {
    Frame(ReadyFrame),
    Gap(usize, TriggerIndex, GapCause),
    Trigger(TriggerRecord),
    Clock(ClockSample),
    Event(NodeEvent),
    End(SessionEnd),
}

/// The destination of a session: a recording, a dry run, or a stand-in in tests.
pub trait Sink: Send + 'static {
    /// Writes one record, or accounts for a frame that cannot be written.
    fn write(&mut self, item: ToWriter) -> Result<(), RecordError>;
    /// Keeps the durability bound while nothing is written.
    fn tick(&mut self) -> Result<(), RecordError> {
        Ok(())
    }
    /// Closes the session, and gives its verdict.
    fn finish(self: Box<Self>, end: SessionEnd) -> Result<Verdict, RecordError>;
}

impl Sink for Recording {
    fn write(&mut self, item: ToWriter) -> Result<(), RecordError> {
        match item {
            ToWriter::Frame(frame) => self.frame_in_place(frame.camera, &frame.meta, frame.block),
            ToWriter::Gap(camera, trigger, cause) => self.gap(camera, trigger, cause),
            ToWriter::Trigger(record) => self.trigger(&record),
            ToWriter::Clock(sample) => self.clock_sample(&sample),
            ToWriter::Event(event) => self.event(&event),
            ToWriter::End(_) => Ok(()),
        }
    }

    fn tick(&mut self) -> Result<(), RecordError> {
        Self::tick(self)
    }

    fn finish(self: Box<Self>, end: SessionEnd) -> Result<Verdict, RecordError> {
        Self::finish(*self, end)
    }
}

/// The bounded queue to the writer's thread, as the matching thread owns it. It promises that frame sets enter whole
/// or not at all. It ends with [`Ring::close`], which waits for the writer's thread.
pub(super) struct Ring {
    items: Sender<ToWriter>,
    /// The frames that wait for Record; `None` where the recording begins with the train.
    hold: Option<Hold>,
    /// Samples of the frames, for previews and the live body.
    taps: [Arc<Taps>; 2],
    /// Counters, of which `ring` includes held frames.
    progress: Arc<Progress>,
    capacity: usize,
    /// Most items in the channel to the writer's thread while held ones follow.
    passed_on: usize,
    /// Small records that found no room; missing gaps are accounted for at the end.
    pub(super) refused: u64,
    writer: JoinHandle<()>,
}

impl Ring {
    /// Starts the writer's thread behind room for `capacity` frames, and for `held` more of the triggers before Record.
    pub(super) fn start(
        sink: Box<dyn Sink>,
        (capacity, held): (usize, usize),
        hold: Option<Hold>,
        taps: [Arc<Taps>; 2],
        progress: Arc<Progress>,
        events: Sender<RecorderEvent>,
    ) -> std::io::Result<Self> {
        let (items, inbox) = bounded(capacity + SMALL_RECORDS);
        progress.ring.store(0, Ordering::Relaxed);
        progress.held_room.store(held as u64, Ordering::Relaxed);
        let writer = Writer { sink, inbox, progress: Arc::clone(&progress), events, failed: false };
        let thread = std::thread::Builder::new().name("writer".to_owned()).spawn(move || {
            crate::host::realtime::enter_configured("writer");
            writer.run()
        })?;
        Ok(Self {
            items,
            hold,
            taps,
            progress,
            capacity: capacity + held,
            passed_on: capacity,
            refused: 0,
            writer: thread,
        })
    }

    /// Number of frames in the ring.
    pub(super) fn len(&self) -> usize {
        usize::try_from(self.progress.ring.load(Ordering::Relaxed)).unwrap_or(usize::MAX)
    }

    /// Whether this number of frames fits now. Only the matching thread adds frames, so the answer stays true.
    pub(super) fn has_room_for(&self, frames: usize) -> bool {
        self.len() + frames <= self.capacity
    }

    /// Adds a frame whose set was admitted.
    pub(super) fn frame(&mut self, frame: ReadyFrame) {
        self.progress.ring.fetch_add(1, Ordering::Relaxed);
        let pixels = frame.block.pixels();
        self.taps.iter().for_each(|taps| taps.offer(frame.camera, &frame.meta, pixels));
        self.small(ToWriter::Frame(frame));
    }

    /// Adds a small record: anything but a frame.
    pub(super) fn small(&mut self, item: ToWriter) {
        let Some(hold) = &mut self.hold else { return self.send(item) };
        match hold.take(item) {
            Passed::On(item) => self.send(item),
            Passed::Held(gone) => {
                self.progress.ring.fetch_sub(gone as u64, Ordering::Relaxed);
            }
        }
        self.publish_held();
        self.go_on();
    }

    /// Record was pressed: the recording begins with trigger `first` of the train. Triggers of it that are not held
    /// any more become gap records.
    pub(super) fn keep(&mut self, first: u64, cameras: usize) {
        let Some(hold) = &mut self.hold else { return };
        let (older, lost) = hold.keep(first);
        self.progress.ring.fetch_sub(older as u64, Ordering::Relaxed);
        for trigger in lost {
            for camera in 0..cameras {
                self.small(ToWriter::Gap(camera, TriggerIndex(trigger), GapCause::DroppedRingFull));
            }
        }
        self.publish_held();
        self.go_on();
    }

    /// The trigger of the train that the recording begins with: 0, or `None` before Record.
    pub(super) fn first(&self) -> Option<u64> {
        self.hold.as_ref().map_or(Some(0), Hold::first)
    }

    fn publish_held(&self) {
        if let Some(hold) = &self.hold {
            let (oldest, end) = hold.held();
            self.progress.held_from.store(oldest, Ordering::Relaxed);
            self.progress.held_to.store(end, Ordering::Relaxed);
        }
    }

    /// Passes held items on while the writer keeps up.
    pub(super) fn go_on(&mut self) {
        while self.items.len() < self.passed_on
            && let Some(item) = self.hold.as_mut().and_then(Hold::next)
        {
            self.send(item);
        }
    }

    /// Counts a gap record that goes to the recording.
    fn count(&self, item: &ToWriter) {
        if let ToWriter::Gap(camera, _, cause) = item {
            self.progress.gap(*camera, *cause);
        }
    }

    fn send(&mut self, item: ToWriter) {
        self.count(&item);
        if let Err(error) = self.items.try_send(item) {
            self.refused += 1;
            if let ToWriter::Frame(_) = error.into_inner() {
                self.progress.ring.fetch_sub(1, Ordering::Relaxed);
            }
        }
    }

    /// Writes everything and closes the recording; without `end`, closes it without a verdict.
    pub(super) fn close(mut self, end: Option<SessionEnd>) {
        if let Some(mut end) = end {
            while let Some(item) = self.hold.as_mut().and_then(Hold::next) {
                self.count(&item);
                // A writer that has ended has reported why.
                drop(self.items.send(item));
            }
            // Before Record, no trigger belongs to the recording.
            end.triggers_emitted = match self.first() {
                Some(first) => end.triggers_emitted.map(|emitted| emitted.saturating_sub(first)),
                None => Some(0),
            };
            drop(self.items.send(ToWriter::End(end)));
        }
        drop(self.items);
        if self.writer.join().is_err() {
            tracing::error!("the writer panicked");
        }
    }
}

/// The writer's thread, which [`Ring::start`] starts. It owns the recording, and writes what the queue brings in
/// order. It reports its first failure, and still accounts for all that follows. It ends with the end of the session,
/// whose verdict it reports, or when the queue is dropped.
struct Writer {
    sink: Box<dyn Sink>,
    inbox: Receiver<ToWriter>,
    progress: Arc<Progress>,
    events: Sender<RecorderEvent>,
    failed: bool,
}

impl Writer {
    fn run(mut self) {
        loop {
            self.progress.writer_turns.fetch_add(1, Ordering::Relaxed);
            match self.inbox.recv_timeout(TICK) {
                Ok(ToWriter::End(end)) => {
                    let verdict = self.sink.finish(end).map_err(|e| Fault::new(Exit::DataLoss, e));
                    drop(self.events.send(RecorderEvent::Closed(verdict)));
                    return;
                }
                Ok(ToWriter::Frame(frame)) => self.frame(frame),
                Ok(item) => {
                    let written = self.sink.write(item);
                    self.judge(written);
                }
                Err(RecvTimeoutError::Timeout) => {
                    let kept = self.sink.tick();
                    self.judge(kept);
                }
                Err(RecvTimeoutError::Disconnected) => return,
            }
        }
    }

    fn frame(&mut self, frame: ReadyFrame) {
        let (camera, taken, entered) = (frame.camera, frame.taken, frame.since);
        let written = self.sink.write(ToWriter::Frame(frame));
        match self.progress.frames.get(camera).filter(|_| written.is_ok()) {
            Some(frames) => {
                frames.fetch_add(1, Ordering::Relaxed);
            }
            // The recording itself has written the gap record for a frame that it could not write.
            None => self.progress.gap(camera, GapCause::DroppedDisk),
        }
        self.progress.ring.fetch_sub(1, Ordering::Relaxed);
        self.progress.latencies.written.record(entered.elapsed());
        self.progress.latencies.total.record(taken.elapsed());
        self.judge(written);
    }

    /// Reports the first failure of the recording to the node.
    fn judge(&mut self, written: Result<(), RecordError>) {
        let Err(error) = written else { return };
        if !std::mem::replace(&mut self.failed, true) {
            tracing::error!("recording failed: {error}");
            drop(self.events.send(RecorderEvent::Failed(Fault::new(Exit::Failure, error))));
        }
    }
}
