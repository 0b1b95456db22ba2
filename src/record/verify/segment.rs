//! The bytes of the segments: every checksum, every frame, and the frames' places in time.

use super::instants::{self, Times};
use super::{Notes, Severity};
use crate::ids::TriggerIndex;
use crate::record::layout::{GapRecord, SegmentIndex, image_topic};
use crate::record::metadata::stated_index;
use crate::record::reader::{RecordingReader, SegmentReader, Topic, check_frame};
use crate::record::scan::{End, Event, Walker, metadata_by_index};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Checks all segments, then what only shows across them.
pub fn check(recording: &RecordingReader, notes: &mut Notes, advance: &(dyn Fn(u64) + Sync)) {
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
    for (camera, times) in times.iter().enumerate() {
        instants::check_steps(recording, camera, times, notes);
        instants::check_offset(recording, camera, times, notes);
    }
}

fn check_segment(
    recording: &RecordingReader,
    segment: &SegmentReader,
    notes: &mut Notes,
    advance: &(dyn Fn(u64) + Sync),
) -> Vec<Times> {
    let (bytes, number) = (segment.bytes(), Some(segment.number));
    let topics: Vec<String> = recording.header.cameras.iter().map(|c| image_topic(&c.id)).collect();
    let mut channels = BTreeMap::new();
    let mut times = vec![Times::new(); recording.header.cameras.len()];
    let (mut data_end, mut reported) = (false, 0);
    let mut index = SegmentIndex::default();
    let mut walker = Walker::new(bytes);
    for event in walker.by_ref() {
        match event {
            Event::Channel { id, topic } => {
                channels.insert(id, Topic::of(topic, &topics));
            }
            Event::Chunk { records, crc, whole } => {
                if whole {
                    let message =
                        format!("the chunk at bytes {} to {} fails its checksum", records.start, records.end);
                    check_crc(notes, number, &bytes[records.clone()], crc, message);
                }
                let position = records.end.min(bytes.len()) as u64;
                advance(position - reported);
                reported = position;
            }
            Event::Message { channel, sequence, data } => {
                if channels.get(&channel) == Some(&Topic::Gaps) {
                    // One that is not readable has been noted when the recording was opened.
                    index.gaps.extend(serde_json::from_slice::<GapRecord>(&bytes[data]).ok());
                } else if let Some(Topic::Image(camera)) = channels.get(&channel) {
                    let trigger = u64::from(sequence);
                    index.frames.push((*camera as u32, trigger, data.start as u64, data.len() as u64));
                    let checked =
                        check_frame(&bytes[data], *camera, TriggerIndex(trigger), &recording.header);
                    note_frame(recording, segment, *camera, trigger, checked.as_ref().err(), notes);
                    if let Ok(frame) = checked {
                        times[*camera].insert(trigger, frame.meta.camera_time_ns);
                    }
                }
            }
            Event::DataEnd { offset, crc } => {
                data_end = true;
                check_crc(notes, number, &bytes[..offset], crc, "the data section fails its checksum".into());
            }
            Event::Footer { covered, crc } => {
                check_crc(notes, number, &bytes[covered], crc, "the summary fails its checksum".into());
            }
            Event::Metadata { .. } => {}
        }
    }
    advance(bytes.len() as u64 - reported);
    if walker.end() == End::Closed {
        let stated = metadata_by_index(bytes).and_then(|metadata| stated_index(bytes, &metadata));
        if stated != Some(index) {
            notes.add(Severity::Corrupt, number, None, None, "its index is not what its records say");
        }
    }
    note_end(recording, segment, walker.end(), data_end, notes);
    times
}

/// A checksum of 0 means that none was computed; the writer always computes it.
fn check_crc(notes: &mut Notes, segment: Option<u32>, bytes: &[u8], stated: u32, message: String) {
    let found = crc32fast::hash(bytes);
    if found != stated {
        let message = format!("{message}: {found:#010x}, expected {stated:#010x}");
        notes.add(Severity::Corrupt, segment, None, None, message);
    }
}

fn note_frame(
    recording: &RecordingReader,
    segment: &SegmentReader,
    camera: usize,
    trigger: u64,
    wrong: Option<&String>,
    notes: &mut Notes,
) {
    let id = recording.header.cameras.get(camera).map(|camera| &camera.id);
    let mut add = |message: String| {
        notes.add(Severity::Corrupt, Some(segment.number), id, Some((trigger, trigger)), message);
    };
    if let Some(reason) = wrong {
        add(reason.clone());
    }
    if trigger < segment.first_trigger || segment.end_trigger.is_some_and(|end| trigger >= end) {
        let end = segment.end_trigger.map_or("the end".to_owned(), |end| end.to_string());
        add(format!("the frame lies outside of its segment's triggers, {} to {end}", segment.first_trigger));
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
            // A segment that the disk refused stays open, and the books went on in a later one, which says so. Any
            // other one was cut, or has a length field that points beyond its end.
            let excused = recording.events.iter().any(|event| event.gives_up(segment.number));
            let is_last = recording.segments.last().is_some_and(|last| last.number == segment.number);
            let severity = if excused && !is_last { Severity::Loss } else { Severity::Corrupt };
            let message = format!("was not closed: usable up to byte {at} of {}", segment.bytes().len());
            notes.add(severity, number, None, None, message);
        }
        End::Damaged { at, reason } => {
            notes.add(Severity::Corrupt, number, None, None, format!("damaged at byte {at}: {reason}"));
        }
    }
}
