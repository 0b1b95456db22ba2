// SPDX-License-Identifier: MIT OR Apache-2.0
//! The bytes of the segments: every checksum, every frame, and the frames' places in time.

use super::findings::{Notes, Severity};
use super::frame::{Seen, Times};
use crate::base::ids::TriggerIndex;
use crate::frame_check::check_frame;
use crate::layout::{GapRecord, SegmentIndex, TriggerRecord};
use crate::metadata::stated_index;
use crate::reader::{RecordingReader, SegmentReader};
use crate::scan::{End, Event, Walker, metadata_by_index};
use crate::segment_file::SegmentFile;
use crate::topic::{Topic, Topics};
use crc32fast::Hasher;
use rayon::prelude::*;
use std::ops::Range;

/// Checks all segments; returns what the frames show of their instants, by camera of the header.
pub fn check(recording: &RecordingReader, notes: &mut Notes, advance: &(dyn Fn(u64) + Sync)) -> Vec<Times> {
    let node = recording.header.node.as_str();
    let checked: Vec<(Notes, Vec<Times>)> = recording
        .segments
        .par_iter()
        .map(|segment| {
            let mut own = Notes::new(node);
            let times = check_segment(recording, segment, &mut own, advance);
            (own, times)
        })
        .collect();
    let mut times = vec![Times::new(); recording.header.cameras.len()];
    for (own, of_segment) in checked {
        notes.absorb(own);
        for (all, some) in times.iter_mut().zip(of_segment) {
            all.extend(some);
        }
    }
    times
}

fn check_segment(
    recording: &RecordingReader,
    segment: &SegmentReader,
    notes: &mut Notes,
    advance: &(dyn Fn(u64) + Sync),
) -> Vec<Times> {
    let mut times = vec![Times::new(); recording.header.cameras.len()];
    let Some(file) = &segment.file else {
        note_end(recording, segment, segment.end.clone(), false, notes);
        return times;
    };
    let number = Some(segment.number);
    let mut topics = Topics::of(&recording.header);
    let mut data_end = false;
    let mut index = SegmentIndex::default();
    let mut sums = Sums { file, number, passed: 0, data: Some(Hasher::new()), chunk: None, advance };
    let mut payload = Vec::new();
    let mut walker = Walker::new(file).over_holes();
    for event in walker.by_ref() {
        match event {
            Event::Channel { id, topic } => topics.announce(id, &topic),
            Event::Chunk { records, crc, whole } => sums.enter_chunk(&records, crc, whole, notes),
            Event::Message { channel, sequence, data } => {
                payload.resize(data.len(), 0);
                let read = file.read(data.start, &mut payload).map_err(|bad| bad.to_string());
                // One that is not readable has been noted when the recording was opened.
                match topics.carried_by(channel) {
                    Topic::Gaps => index.gaps.extend(serde_json::from_slice::<GapRecord>(&payload).ok()),
                    Topic::Triggers => {
                        let row = serde_json::from_slice::<TriggerRecord>(&payload).ok();
                        index.triggers.get_or_insert_default().extend(row.map(|row| row.row()));
                    }
                    Topic::Image(camera) => {
                        let (trigger, header) = (u64::from(sequence), &recording.header);
                        index.frames.push((camera as u32, trigger, data.start as u64, data.len() as u64));
                        let check = |()| {
                            check_frame(&payload, camera, TriggerIndex(trigger), header, &recording.belonging)
                        };
                        let checked = read.clone().and_then(check);
                        let (id, range) = (Some(&header.cameras[camera].id), Some((trigger, trigger)));
                        if let Err(reason) = &checked {
                            notes.add(Severity::Corrupt, number, id, range, reason);
                        }
                        let first = segment.first_trigger;
                        if trigger < first || segment.end_trigger.is_some_and(|end| trigger >= end) {
                            let end = segment.end_trigger.map_or("the end".to_owned(), |end| end.to_string());
                            let message =
                                format!("the frame lies outside of its segment's triggers, {first} to {end}");
                            notes.add(Severity::Corrupt, number, id, range, message);
                        }
                        if let Ok((meta, pixels)) = checked {
                            let (camera_ns, host_ns) = (meta.camera_time_ns, meta.host_time_ns);
                            times[camera].insert(trigger, Seen { block: meta.block.0, camera_ns, host_ns });
                            sums.message(&data, &payload[..pixels.start], Some(meta.pixels_crc), notes);
                            continue;
                        }
                    }
                    Topic::Clock | Topic::Events | Topic::Other => {}
                }
                if read.is_ok() {
                    sums.message(&data, &payload, None, notes);
                }
            }
            Event::DataEnd { offset, crc } => {
                data_end = true;
                sums.end_data(offset, crc, notes);
            }
            Event::Footer { covered, crc } => {
                if let Some(found) = file.checksum(covered) {
                    check_crc(notes, number, found, crc, "the summary fails its checksum");
                }
            }
            Event::Metadata { .. } => {}
        }
    }
    sums.finish(notes);
    for bad in file.bad_ranges() {
        notes.add(Severity::Corrupt, number, None, None, bad.to_string());
    }
    if walker.end() == End::Closed && file.bad_ranges().is_empty() {
        let stated = metadata_by_index(file).and_then(|metadata| stated_index(file, &metadata));
        // Older versions have no triggers in it.
        index.triggers = index.triggers.filter(|_| stated.as_ref().is_some_and(|x| x.triggers.is_some()));
        if stated != Some(index) {
            notes.add(Severity::Corrupt, number, None, None, "its index differs from its records");
        }
    }
    note_end(recording, segment, walker.end(), data_end, notes);
    times
}

/// Checksums of the chunks and of the data section, each byte passed over once: a frame's pixels have just proven
/// theirs, and checksums of parts combine.
struct Sums<'a> {
    file: &'a SegmentFile,
    number: Option<u32>,
    /// Everything before is in `data`, or in the chunk.
    passed: usize,
    /// `None` behind what cannot be read.
    data: Option<Hasher>,
    chunk: Option<Chunk>,
    advance: &'a (dyn Fn(u64) + Sync),
}

struct Chunk {
    records: Range<usize>,
    stated: u32,
    sum: Hasher,
    /// Whether the checksum can be computed: not that of a chunk that is cut, or partly unreadable.
    known: bool,
}

impl Sums<'_> {
    fn enter_chunk(&mut self, records: &Range<usize>, stated: u32, whole: bool, notes: &mut Notes) {
        self.pass(records.start, notes);
        self.chunk = Some(Chunk { records: records.clone(), stated, sum: Hasher::new(), known: whole });
    }

    /// A message that was just read: its bytes, but for pixels whose checksum is right and is given.
    fn message(&mut self, data: &Range<usize>, bytes: &[u8], pixels_crc: Option<u32>, notes: &mut Notes) {
        self.pass(data.start, notes);
        let chunk_end = self.chunk.as_ref().map_or(data.end, |chunk| chunk.records.end);
        if self.passed != data.start || data.end > chunk_end {
            // Behind bytes that cannot be read it is not known whether records lie in their chunks.
            return;
        }
        let mut sum = Hasher::new();
        sum.update(bytes);
        if let Some(crc) = pixels_crc {
            sum.combine(&Hasher::new_with_initial_len(crc, (data.len() - bytes.len()) as u64));
        }
        self.add(data.end, Some(&sum), notes);
    }

    /// Takes everything up to here as it is in the file.
    fn pass(&mut self, to: usize, notes: &mut Notes) {
        while self.passed < to {
            let end = self.chunk.as_ref().map_or(to, |chunk| chunk.records.end.min(to)).max(self.passed + 1);
            let sum = self.file.checksum(self.passed..end);
            self.add(end, sum.as_ref(), notes);
        }
    }

    /// The next bytes, up to `end`; without a checksum where they cannot be read.
    fn add(&mut self, end: usize, sum: Option<&Hasher>, notes: &mut Notes) {
        (self.advance)((end - self.passed) as u64);
        self.passed = end;
        match (sum, &mut self.data) {
            (Some(sum), Some(data)) => data.combine(sum),
            _ => self.data = None,
        }
        let Some(chunk) = &mut self.chunk else { return };
        match sum {
            Some(sum) => chunk.sum.combine(sum),
            None => chunk.known = false,
        }
        if end >= chunk.records.end {
            if chunk.known {
                let Range { start, end } = chunk.records;
                let message = format!("the chunk at bytes {start} to {end} fails its checksum");
                check_crc(notes, self.number, chunk.sum.clone(), chunk.stated, &message);
            }
            self.chunk = None;
        }
    }

    fn end_data(&mut self, offset: usize, stated: u32, notes: &mut Notes) {
        self.pass(offset, notes);
        if let Some(data) = self.data.clone() {
            check_crc(notes, self.number, data, stated, "the data section fails its checksum");
        }
    }

    /// The chunk that the walk did not get through, and what is behind it.
    fn finish(&mut self, notes: &mut Notes) {
        let length = self.file.len();
        if let Some(chunk) = &self.chunk {
            self.pass(chunk.records.end.min(length), notes);
        }
        (self.advance)(length.saturating_sub(self.passed) as u64);
    }
}

/// A checksum of 0 means that none was computed; the writer always computes it.
fn check_crc(notes: &mut Notes, segment: Option<u32>, found: Hasher, stated: u32, message: &str) {
    let found = found.finalize();
    if found != stated {
        let message = format!("{message}: {found:#010x}, expected {stated:#010x}");
        notes.add(Severity::Corrupt, segment, None, None, message);
    }
}

fn note_end(
    recording: &RecordingReader,
    segment: &SegmentReader,
    end: End,
    data_end: bool,
    notes: &mut Notes,
) {
    let number = Some(segment.number);
    match end {
        End::Closed if data_end => {}
        End::Closed => {
            notes.add(Severity::Corrupt, number, None, None, "closed without an end of its data section");
        }
        End::Cut { at } => {
            // A segment that the disk refused stays open, and the accounting went on in a later one, which names it.
            // Any other one was cut, or has a length field that points beyond its end.
            let excused = recording.events.iter().any(|event| event.gives_up(segment.number));
            let is_last = recording.segments.last().is_some_and(|last| last.number == segment.number);
            let severity = if excused && !is_last { Severity::Loss } else { Severity::Corrupt };
            let message = format!("not closed, usable up to byte {at} of {}", segment.length());
            notes.add(severity, number, None, None, message);
        }
        End::Damaged { at, reason } => {
            notes.add(Severity::Corrupt, number, None, None, format!("damaged at byte {at}: {reason}"));
        }
    }
}
