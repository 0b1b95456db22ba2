// SPDX-License-Identifier: MIT OR Apache-2.0
//! What is usable in one segment: every frame checked, every small record under its chunk's checksum, and on
//! behind damage.
//!
//! Nothing is used that is not under a checksum. So a frame's camera and trigger are those of its envelope, and
//! small records are known by their fields: the container around them may be damaged.

use crate::belonging::{Label, SessionMark};
use crate::envelope::{Envelope, FRONT, parse_envelope, parse_envelope_of, pixels_crc};
use crate::layout::{
    ClockSample, Entries, GapRecord, HEADER_METADATA, KEY_END_TRIGGER, KEY_FIRST_TRIGGER, KEY_INDEX_LENGTH,
    KEY_JSON, KEY_RECORDS, NodeEvent, SEGMENT_METADATA, STATISTICS_METADATA, TriggerRecord, VERDICT_METADATA,
};
use crate::metadata::{StatedHeader, is_sound, parse_header, parse_index, place_of};
use crate::scan::{
    End, Event, Found, MAX_MESSAGE, MESSAGE_HEADER, Walker, budget, find, is_json, metadata_by_index,
};
use crate::segment_file::SegmentFile;
use crate::statistics::WriteStatistics;
use crate::verdict::Verdict;
use crc32fast::Hasher;
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::fmt;
use std::ops::Range;

/// Cost of examining one found record again, in bytes of the budget.
const FOUND_BYTES: usize = 64;
/// Why an index is not followed any further.
const INDEXED_OVER_AND_OVER: &str =
    "its indexes name the same bytes again and again: they are not followed any further";
/// Damaged places beyond this many are counted as the last one.
const MAX_DAMAGE: usize = 1000;

/// A place in a segment that is not as it was written.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Damage {
    pub segment: u32,
    /// First byte that is not as it was written.
    pub from: u64,
    /// Offset at which usable records go on; 0 when the segment as such is concerned.
    pub to: u64,
    /// What was expected and found.
    pub reason: String,
}

impl fmt::Display for Damage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.to {
            0 => write!(f, "segment {}: {}", self.segment, self.reason),
            to => write!(f, "segment {} bytes {} to {to}: {}", self.segment, self.from, self.reason),
        }
    }
}

/// A record with the mark of its session and its number.
pub struct Labelled<T> {
    pub label: Label,
    pub record: T,
}

/// A frame whose envelope and pixels are whole.
pub struct FoundFrame {
    /// Its camera, as a place in [`SegmentScan::cameras`].
    pub camera: usize,
    pub trigger: u64,
    pub session: Option<SessionMark>,
    /// Place of its message in the file.
    pub message: Range<usize>,
}

/// Everything usable in a segment.
#[derive(Default)]
pub struct SegmentScan {
    pub header: Option<StatedHeader>,
    /// Entries of a header that is not readable as a whole.
    pub header_entries: Entries,
    /// No frame of an earlier trigger belongs to it.
    pub first_trigger: Option<u64>,
    /// No frame from this trigger on belongs to it; not known in the last one.
    pub end_trigger: Option<u64>,
    /// The data section's checksum is right: what is outside of chunks is as it was written.
    pub proven: bool,
    /// It ends as a closed segment does.
    pub closed: bool,
    /// Name and size of the cameras, as the frames' envelopes have them.
    pub cameras: Vec<(String, u32, u32)>,
    /// In the order of the file.
    pub frames: Vec<FoundFrame>,
    /// Camera and trigger of frames whose envelope is whole and whose pixels are not.
    pub damaged_frames: Vec<(usize, u64, Option<SessionMark>)>,
    /// In the order of the file; then gap records that only the index has.
    pub records: Vec<Labelled<SmallRecord>>,
    pub verdict: Option<Labelled<Verdict>>,
    /// How many small records the recording has, as the verdict's metadata states it.
    pub stated_records: Option<u64>,
    /// Whether the verdict's own checksum is right.
    pub verdict_proven: bool,
    /// The stored statistics, if their own checksum is right.
    pub statistics: Option<Labelled<WriteStatistics>>,
    /// In the order of the file.
    pub damage: Vec<Damage>,
    /// Small records that were there, but under no checksum that is right.
    pub records_lost: u64,
}

/// A small record; the kinds are distinguished by their fields, which no two have in common.
#[derive(Deserialize)]
#[serde(untagged)]
pub enum SmallRecord {
    Gap(GapRecord),
    Trigger(TriggerRecord),
    Clock(ClockSample),
    Event(NodeEvent),
}

impl SegmentScan {
    /// The rows of the trigger table.
    pub fn triggers(&self) -> impl Iterator<Item = &TriggerRecord> {
        self.records.iter().filter_map(|one| match &one.record {
            SmallRecord::Trigger(row) => Some(row),
            _ => None,
        })
    }
}

/// Scans a segment. `advance` is called with the bytes done.
pub fn scan(number: u32, file: &SegmentFile, advance: &dyn Fn(u64)) -> SegmentScan {
    let mut scanner = Scanner {
        number,
        file,
        advance,
        reported: 0,
        found: SegmentScan::default(),
        chunk: 0..0,
        trusted: false,
        checked: false,
        data: Hasher::new(),
        hashed: 0,
        indexed: false,
        budget: budget(file.len()),
    };
    scanner.run();
    (scanner.advance)((file.len() - scanner.reported) as u64);
    for bad in file.bad_ranges() {
        scanner.damage(bad.from..bad.to, format!("cannot be read: {}", bad.reason));
    }
    scanner.found
}

/// Where and why the walk along the records ended.
struct Break {
    at: usize,
    /// The damage there; `None` where the file may just be cut.
    reason: Option<String>,
}

struct Scanner<'a> {
    number: u32,
    file: &'a SegmentFile,
    advance: &'a dyn Fn(u64),
    reported: usize,
    found: SegmentScan,
    /// Records of the chunk that the walk is in, and whether they may be used.
    chunk: Range<usize>,
    trusted: bool,
    /// Whether a checksum proves everything in the chunk but pixels; a chunk that is cut has none.
    checked: bool,
    /// Checksum of the data section up to `hashed`.
    data: Hasher,
    hashed: usize,
    /// Whether an index has been named.
    indexed: bool,
    /// Bytes that may still be examined, see [`budget`].
    budget: usize,
}

impl<'a> Scanner<'a> {
    fn run(&mut self) {
        let mut walker = Walker::new(self.file);
        while let Some(stop) = self.walk(&mut walker) {
            self.report(stop.at);
            let next = find(self.file, stop.at + 1, &mut self.budget);
            if self.budget == 0 {
                let reason = "its records overlap again and again: nothing is searched from here on";
                self.damage(stop.at..self.file.len(), reason.to_owned());
                break;
            }
            let end = next.as_ref().map_or(self.file.len(), Found::start);
            match (stop.reason, &next) {
                (Some(reason), _) => self.damage(stop.at..end, reason),
                (None, Some(_)) => self.damage(stop.at..end, "no record begins here".to_owned()),
                // Cut: what is left is the beginning of a record.
                (None, None) => {}
            }
            self.chunk = 0..0;
            let goes_on = match next {
                None => break,
                Some(Found::Record(at)) => at,
                Some(Found::Frame(message)) => {
                    let end = message.end;
                    // Both checksums were right a moment ago; if not any more, nothing is taken.
                    let _ = self.frame(message);
                    end
                }
            };
            walker = Walker::resume(self.file, goes_on);
        }
        // A length that is damaged may have led past the record that names the index: the summary knows it, too.
        if !self.indexed && self.budget > 0 {
            for (_, entries) in
                metadata_by_index(self.file).iter().flatten().filter(|(name, _)| *name == SEGMENT_METADATA)
            {
                self.index(entries);
            }
        }
    }

    fn damage(&mut self, at: Range<usize>, reason: String) {
        let (from, to) = (at.start as u64, at.end as u64);
        if self.found.damage.len() < MAX_DAMAGE {
            self.found.damage.push(Damage { segment: self.number, from, to, reason });
        } else if let Some(last) = self.found.damage.last_mut() {
            last.to = last.to.max(to);
            last.reason = "more damage than is listed".to_owned();
        }
    }

    fn report(&mut self, position: usize) {
        let position = position.min(self.file.len());
        (self.advance)(position.saturating_sub(self.reported) as u64);
        self.reported = self.reported.max(position);
    }

    /// Takes the records up to the first that is damaged.
    fn walk(&mut self, walker: &mut Walker<'a>) -> Option<Break> {
        for event in walker.by_ref() {
            match event {
                Event::Chunk { records, crc, whole } => self.enter_chunk(records, crc, whole),
                Event::Message { data, .. } => {
                    if let Err(reason) = self.message(data.clone()) {
                        return Some(Break { at: data.start - MESSAGE_HEADER, reason: Some(reason) });
                    }
                }
                Event::Metadata { name, entries } => self.metadata(&name, &entries),
                Event::DataEnd { offset, crc } => {
                    let rest = Some(self.hashed..offset).filter(|rest| rest.start <= rest.end);
                    if let Some(rest) = rest.and_then(|rest| self.file.checksum(rest)) {
                        self.data.combine(&rest);
                        self.found.proven = self.data.clone().finalize() == crc;
                        if let Some(header) = self.found.header.as_mut().filter(|_| self.found.proven) {
                            header.proven = true;
                        }
                    }
                }
                Event::Channel { .. } | Event::Footer { .. } => {}
            }
        }
        match walker.end() {
            End::Closed => {
                self.found.closed = true;
                None
            }
            // Zeros up to the end are what a sync leaves.
            End::Cut { at } | End::Damaged { at, .. } if self.file.is_zero_from(at) => None,
            End::Cut { at } => Some(Break { at, reason: None }),
            End::Damaged { at, reason } => Some(Break { at, reason: Some(reason) }),
        }
    }

    fn enter_chunk(&mut self, records: Range<usize>, crc: u32, whole: bool) {
        let end = records.end.min(self.file.len());
        self.report(records.start);
        self.chunk = records.start..end;
        // One that the end of the file cuts cannot be checked: what is whole before the cut is used.
        (self.trusted, self.checked) = (true, false);
        if !whole || self.hashed > records.start {
            return;
        }
        self.spend(2 * records.len());
        // Zeros stand where nothing can be read: the checksum shows that, as any damage.
        self.file.pass(self.hashed..records.start, |bytes| self.data.update(bytes));
        let mut of_chunk = Hasher::new();
        self.file.pass(records.clone(), |bytes| of_chunk.update(bytes));
        self.trusted = of_chunk.clone().finalize() == crc;
        if !self.trusted {
            let as_written = self.but_for_pixels(&records);
            self.trusted = as_written.clone().finalize() == crc;
            if self.trusted {
                // What is outside of the pixels is proven, and so may be what is outside of the chunk.
                of_chunk = as_written;
            }
            self.damage(records, "the chunk fails its checksum".to_owned());
        }
        self.checked = self.trusted;
        self.data.combine(&of_chunk);
        self.hashed = end;
    }

    /// The checksum that a chunk's records would have with the pixels that their envelopes state. Nearly all bytes are
    /// pixels: if it is right, only pixels are damaged, and the small records between them may be used.
    fn but_for_pixels(&self, records: &Range<usize>) -> Hasher {
        let (mut whole, mut done) = (Hasher::new(), records.start);
        let mut front = Vec::new();
        for event in Walker::within(self.file, records.clone()) {
            let Event::Message { data, .. } = event else { continue };
            front.resize(data.len().min(FRONT), 0);
            self.file.read_with_holes(data.start, &mut front);
            let Ok((envelope, length)) = parse_envelope_of(&front) else { continue };
            if length != data.len() {
                continue;
            }
            let first = data.start + envelope.pixels.start;
            self.file.pass(done..first, |bytes| whole.update(bytes));
            let length = envelope.pixels.len() as u64;
            whole.combine(&Hasher::new_with_initial_len(envelope.meta.pixels_crc, length));
            done = data.end;
        }
        self.file.pass(done..records.end, |bytes| whole.update(bytes));
        whole
    }

    fn message(&mut self, data: Range<usize>) -> Result<(), String> {
        self.spend(data.len());
        if self.budget == 0 {
            return Err("there is more in its records than in the file".to_owned());
        }
        let payload = self.payload(&data);
        if payload.first() != Some(&b'{') {
            return self.frame_of(data, &payload);
        }
        let trusted = self.trusted && self.chunk.contains(&data.start);
        let label = Label::of(&payload);
        match serde_json::from_slice(&payload) {
            Ok(_) if !trusted => self.found.records_lost += 1,
            Ok(record) => self.found.records.push(Labelled { label, record }),
            // The index, and records of later versions.
            Err(_) if trusted => {}
            // Its length may be what is damaged.
            Err(_) if !is_json(&payload) => return Err("a small record is not readable".to_owned()),
            Err(_) => {}
        }
        Ok(())
    }

    fn spend(&mut self, bytes: usize) {
        self.budget = self.budget.saturating_sub(bytes);
    }

    /// A message's bytes, with zeros where nothing can be read: no checksum takes them for what was there.
    fn payload(&self, data: &Range<usize>) -> Vec<u8> {
        let mut payload = vec![0; data.len()];
        self.file.read_with_holes(data.start, &mut payload);
        payload
    }

    fn frame(&mut self, data: Range<usize>) -> Result<(), String> {
        let payload = self.payload(&data);
        self.frame_of(data, &payload)
    }

    fn frame_of(&mut self, data: Range<usize>, payload: &[u8]) -> Result<(), String> {
        let envelope = parse_envelope(payload).map_err(|e| e.to_string())?;
        let camera = self.camera(&envelope);
        let (trigger, session) = (envelope.meta.trigger.0, envelope.session);
        let stated = envelope.meta.pixels_crc;
        let found = pixels_crc(&payload[envelope.pixels]);
        if found == stated {
            self.found.frames.push(FoundFrame { camera, trigger, session, message: data });
            return Ok(());
        }
        self.found.damaged_frames.push((camera, trigger, session));
        let name = &self.found.cameras[camera].0;
        let reason = format!(
            "frame of camera {name} trigger {trigger}: checksum of the pixels is {found:#010x}, expected {stated:#010x}"
        );
        if self.checked && self.chunk.contains(&data.start) {
            // The records around it are proven: the walk goes on behind it.
            self.damage(data, reason);
            return Ok(());
        }
        Err(reason)
    }

    fn camera(&mut self, envelope: &Envelope<'_>) -> usize {
        let (name, width, height) = (envelope.camera, envelope.meta.width, envelope.meta.height);
        let known = &mut self.found.cameras;
        let place = known.iter().position(|(n, w, h)| (n.as_str(), *w, *h) == (name, width, height));
        place.unwrap_or_else(|| {
            known.push((name.to_owned(), width, height));
            known.len() - 1
        })
    }

    fn metadata(&mut self, name: &str, entries: &Entries) {
        let number = |key| entries.get(key).and_then(|text: &String| text.parse::<u64>().ok());
        let label = Label::of_entries(entries);
        match name {
            HEADER_METADATA => {
                self.found.first_trigger = number(KEY_FIRST_TRIGGER);
                match parse_header(entries) {
                    Ok(stated) => {
                        if is_sound(entries) == Some(false) {
                            self.damage(0..0, "the header fails its checksum".to_owned());
                        }
                        self.found.header = Some(stated);
                    }
                    Err(reason) => {
                        self.damage(0..0, reason);
                        self.found.header_entries.clone_from(entries);
                    }
                }
            }
            SEGMENT_METADATA => {
                self.found.end_trigger = number(KEY_END_TRIGGER);
                self.index(entries);
            }
            VERDICT_METADATA => {
                let json = entries.get(KEY_JSON).map(String::as_str).unwrap_or_default();
                self.found.verdict = serde_json::from_str(json).ok().map(|record| Labelled { label, record });
                self.found.stated_records = number(KEY_RECORDS);
                self.found.verdict_proven = is_sound(entries) == Some(true);
            }
            STATISTICS_METADATA if is_sound(entries) == Some(true) => {
                let json = entries.get(KEY_JSON).map(String::as_str).unwrap_or_default();
                self.found.statistics =
                    serde_json::from_str(json).ok().map(|record| Labelled { label, record });
            }
            _ => {}
        }
    }

    /// The index knows the gap records, and frames whose way from record to record is damaged.
    fn index(&mut self, entries: &Entries) {
        self.indexed = true;
        // A segment has one index. A file may name one over and over, and frames in it that lie over each other.
        let length = entries.get(KEY_INDEX_LENGTH).and_then(|text| text.parse().ok()).unwrap_or(0);
        self.spend(self.file.len().min(length));
        self.spend(FOUND_BYTES * (self.found.frames.len() + self.found.records.len()));
        if self.budget == 0 {
            return self.damage(0..0, INDEXED_OVER_AND_OVER.to_owned());
        }
        let Some(index) = parse_index(self.file, entries) else { return };
        let known: BTreeSet<usize> = self.found.frames.iter().map(|frame| frame.message.start).collect();
        for message in index.frames.iter().filter_map(|(_, _, offset, length)| place_of(*offset, *length)) {
            let possible = message.end <= self.file.len() && message.len() <= MAX_MESSAGE;
            if possible && !known.contains(&message.start) {
                self.spend(message.len().max(FOUND_BYTES));
                if self.budget == 0 {
                    return self.damage(0..0, INDEXED_OVER_AND_OVER.to_owned());
                }
                // What is wrong with it has been noted on the way, if it is not whole.
                self.checked = false;
                let _ = self.frame(message);
            }
        }
        let known: BTreeSet<_> = self
            .found
            .records
            .iter()
            .filter_map(|one| match &one.record {
                SmallRecord::Gap(gap) => Some((gap.camera.clone(), gap.trigger)),
                _ => None,
            })
            .collect();
        let more = index.gaps.into_iter().filter(|gap| !known.contains(&(gap.camera.clone(), gap.trigger)));
        let label = Label::of_entries(entries);
        self.found.records.extend(more.map(|gap| Labelled { label, record: SmallRecord::Gap(gap) }));
    }
}
