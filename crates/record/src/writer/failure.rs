// SPDX-License-Identifier: MIT OR Apache-2.0
//! When the disk fails: what is in the file stays readable, what is not becomes gaps, and the accounting goes on in a
//! segment of its own.

use super::Recording;
use super::error::RecordError;
use super::segments::{ClosingSegment, OpenSegment, Unwritten};
use crate::layout::{GapCause, GapRecord, NodeEvent};
use crate::segment::JsonChannel;
use std::io;

impl Recording {
    /// After a failed write or sync: nothing more goes to the open segments, frames that are not in the file, or
    /// cannot be trusted to stay there, become gaps, and the accounting goes on in a segment of its own.
    pub(super) fn fail(&mut self, source: io::Error) -> Result<(), RecordError> {
        let error = RecordError::refused(self.dir.clone(), source);
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
        // Its space may be what the accounting needs.
        self.next = None;
        let earlier = std::mem::take(&mut self.unwritten);
        self.lose(earlier);
        for mut entry in std::mem::take(&mut self.segments) {
            if entry.settle(&mut self.latencies).is_ok() {
                self.closing.push(entry.close_aside(None));
            } else {
                self.give_up(entry);
            }
        }
    }

    /// What the segment lost waits for the rescue, with an event that the disk refused it: even where no frame is lost,
    /// the open segment must not be taken for a cut one.
    fn give_up(&mut self, entry: OpenSegment) {
        let event = NodeEvent::segment_given_up(entry.segment.number, self.time_ns);
        self.lose(entry.abandon());
        let (channel, sequence, time_ns) = (JsonChannel::Events, self.newest().0, self.time_ns);
        let written = self.small(&event).ok();
        self.unwritten.extend(written.map(|bytes| Unwritten::Json { channel, sequence, time_ns, bytes }));
    }

    fn lose(&mut self, lost: Vec<Unwritten>) {
        for record in lost {
            let record = self.account(record);
            self.unwritten.extend(record);
        }
    }

    /// Lets go of segments that have been closed: until then each holds its file and a thread. One that could not be
    /// closed is a failed disk like any other.
    pub(super) fn reap_closed(&mut self) -> Result<(), RecordError> {
        let (done, under_way) =
            std::mem::take(&mut self.closing).into_iter().partition(ClosingSegment::is_done);
        self.closing = under_way;
        let closed = self.join(done);
        closed.or_else(|source| self.fail(source))
    }

    /// Waits for the segments that are being closed; what one of them could not keep waits for the rescue.
    pub(super) fn join_closing(&mut self) -> io::Result<()> {
        let closing = std::mem::take(&mut self.closing);
        self.join(closing)
    }

    fn join(&mut self, segments: Vec<ClosingSegment>) -> io::Result<()> {
        let mut result = Ok(());
        for closing in segments {
            if let Err((error, refused)) = closing.join(&mut self.latencies) {
                if let Some(segment) = refused {
                    self.give_up(*segment);
                }
                // After an earlier failure broken segments are expected; their readable part is what counts.
                result = result.and(if self.stopped.is_some() { Ok(()) } else { Err(error) });
            }
        }
        result
    }

    /// A frame that did not reach the disk becomes a gap.
    fn account(&mut self, record: Unwritten) -> Option<Unwritten> {
        let Unwritten::Frame { camera, trigger, .. } = record else { return Some(record) };
        let tally = self.tallies.get_mut(camera)?;
        tally.forget_frame(trigger);
        tally.gap(trigger, GapCause::DroppedDisk);
        let gap = GapRecord { camera: self.camera_id(camera)?, trigger, cause: GapCause::DroppedDisk };
        let bytes = self.small(&gap).ok()?;
        let (channel, time_ns) = (JsonChannel::Gaps, self.time_ns);
        Some(Unwritten::Json { channel, sequence: trigger.0, time_ns, bytes })
    }

    /// Opens a segment for the accounting and moves there what waits for it.
    pub(super) fn rescue(&mut self) -> io::Result<()> {
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
        let result = result.and_then(|()| entry.request_sync(&mut self.latencies));
        let result = result.and_then(|()| entry.settle(&mut self.latencies));
        self.unwritten.extend(waiting);
        if result.is_err() {
            self.abandon_segments();
        }
        result
    }
}
