//! What is usable in one segment: every frame checked, every small record under its chunk's checksum, and on
//! behind damage.
//!
//! Nothing is believed that is not under a checksum. So a frame's camera and trigger are those of its envelope, and
//! small records are known by their fields: what the container says around them may be what is damaged.

use super::Damage;
use crate::record::envelope::{Envelope, parse_envelope, pixels_crc};
use crate::record::layout::{
    ClockSample, GapRecord, HEADER_METADATA, KEY_END_TRIGGER, KEY_FIRST_TRIGGER, KEY_JSON, NodeEvent,
    RecordingHeader, SEGMENT_METADATA, TriggerRecord, VERDICT_METADATA,
};
use crate::record::reader::{parse_header, parse_index};
use crate::record::scan::{End, Event, MESSAGE_HEADER, Walker, find_record};
use crate::record::verdict::Verdict;
use crc32fast::Hasher;
use serde::Deserialize;
use std::collections::BTreeMap;
use std::ops::Range;

/// Damaged places beyond this many are counted as the last one.
const MAX_DAMAGE: usize = 1000;

/// A frame whose envelope and pixels are whole.
pub struct FoundFrame {
    /// Its camera, as a place in [`SegmentScan::cameras`].
    pub camera: usize,
    /// Its trigger.
    pub trigger: u64,
    /// Where its message is in the file.
    pub message: Range<usize>,
}

/// Everything usable in a segment.
#[derive(Default)]
pub struct SegmentScan {
    /// Its header, if readable.
    pub header: Option<RecordingHeader>,
    /// Entries of a header that is not readable as a whole.
    pub header_entries: BTreeMap<String, String>,
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
    pub damaged_frames: Vec<(usize, u64)>,
    /// In the order of the file; then those that only the index has.
    pub gaps: Vec<GapRecord>,
    /// In the order of the file.
    pub triggers: Vec<TriggerRecord>,
    /// In the order of the file.
    pub clock_samples: Vec<ClockSample>,
    /// In the order of the file.
    pub events: Vec<NodeEvent>,
    /// As stored.
    pub verdict: Option<Verdict>,
    /// In the order of the file.
    pub damage: Vec<Damage>,
    /// Small records that were there, but under no checksum that is right.
    pub records_lost: u64,
}

/// The small records, told apart by their fields, of which no two kinds have the same.
#[derive(Deserialize)]
#[serde(untagged)]
enum SmallRecord {
    Gap(GapRecord),
    Trigger(TriggerRecord),
    Clock(ClockSample),
    Event(NodeEvent),
}

/// Scans a segment. `advance` is told the bytes done.
pub fn scan(number: u32, bytes: &[u8], advance: &dyn Fn(u64)) -> SegmentScan {
    let mut scanner = Scanner {
        number,
        bytes,
        advance,
        reported: 0,
        found: SegmentScan::default(),
        chunk: 0..0,
        trusted: false,
        data: Hasher::new(),
        hashed: 0,
    };
    scanner.run();
    (scanner.advance)((bytes.len() - scanner.reported) as u64);
    scanner.found
}

/// Why the walk does not go on as the records say.
struct Break {
    at: usize,
    /// What is wrong there; `None` where the file may just be cut.
    reason: Option<String>,
}

struct Scanner<'a> {
    number: u32,
    bytes: &'a [u8],
    advance: &'a dyn Fn(u64),
    reported: usize,
    found: SegmentScan,
    /// Records of the chunk that the walk is in, and whether they may be believed.
    chunk: Range<usize>,
    trusted: bool,
    /// Of the data section so far.
    data: Hasher,
    hashed: usize,
}

impl<'a> Scanner<'a> {
    fn run(&mut self) {
        let mut walker = Walker::new(self.bytes);
        while let Some(stop) = self.walk(&mut walker) {
            self.report(stop.at);
            let next = find_record(self.bytes, stop.at + 1, is_payload);
            let end = next.unwrap_or(self.bytes.len());
            match (stop.reason, next) {
                (Some(reason), _) => self.damage(stop.at..end, reason),
                (None, Some(_)) => self.damage(stop.at..end, "no record begins here".to_owned()),
                // Cut: what is left is the beginning of a record.
                (None, None) => {}
            }
            let Some(next) = next else { break };
            walker = Walker::resume(self.bytes, next);
            self.chunk = 0..0;
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
        let position = position.min(self.bytes.len());
        (self.advance)(position.saturating_sub(self.reported) as u64);
        self.reported = self.reported.max(position);
    }

    /// Takes what the records say, up to the first that is not as it should be.
    fn walk(&mut self, walker: &mut Walker<'a>) -> Option<Break> {
        for event in walker.by_ref() {
            match event {
                Event::Chunk { records, crc, whole } => self.enter_chunk(records, crc, whole),
                Event::Message { data, .. } => {
                    if let Err(reason) = self.message(data.clone()) {
                        return Some(Break { at: data.start - MESSAGE_HEADER, reason: Some(reason) });
                    }
                }
                Event::Metadata { name, entries } => self.metadata(name, &entries),
                Event::DataEnd { offset, crc } => {
                    if let Some(rest) = self.bytes.get(self.hashed..offset) {
                        self.data.update(rest);
                        self.found.proven = self.data.clone().finalize() == crc;
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
            End::Cut { at } | End::Damaged { at, .. } if self.bytes[at..].iter().all(|byte| *byte == 0) => {
                None
            }
            End::Cut { at } => Some(Break { at, reason: None }),
            End::Damaged { at, reason } => Some(Break { at, reason: Some(reason) }),
        }
    }

    fn enter_chunk(&mut self, records: Range<usize>, crc: u32, whole: bool) {
        let end = records.end.min(self.bytes.len());
        self.report(records.start);
        self.chunk = records.start..end;
        // One that the end of the file cuts cannot be checked: what is whole before the cut is used.
        self.trusted = true;
        let Some(before) = self.bytes.get(self.hashed..records.start).filter(|_| whole) else { return };
        let mut of_chunk = Hasher::new();
        of_chunk.update(&self.bytes[records.clone()]);
        self.data.update(before);
        self.data.combine(&of_chunk);
        self.hashed = end;
        self.trusted = of_chunk.finalize() == crc;
        if !self.trusted {
            self.damage(records, "the chunk fails its checksum".to_owned());
        }
    }

    fn message(&mut self, data: Range<usize>) -> Result<(), String> {
        let payload = &self.bytes[data.clone()];
        if !is_json(payload) {
            return self.frame(data);
        }
        let trusted = self.trusted && self.chunk.contains(&data.start);
        match serde_json::from_slice(payload) {
            Ok(_) if !trusted => self.found.records_lost += 1,
            Ok(SmallRecord::Gap(gap)) => self.found.gaps.push(gap),
            Ok(SmallRecord::Trigger(row)) => self.found.triggers.push(row),
            Ok(SmallRecord::Clock(sample)) => self.found.clock_samples.push(sample),
            Ok(SmallRecord::Event(event)) => self.found.events.push(event),
            // The index, and records of later versions.
            Err(_) if trusted => {}
            // Its length may be what is damaged.
            Err(_) if !is_payload(payload) => return Err("a small record is not readable".to_owned()),
            Err(_) => {}
        }
        Ok(())
    }

    fn frame(&mut self, data: Range<usize>) -> Result<(), String> {
        let payload = &self.bytes[data.clone()];
        let envelope = parse_envelope(payload).map_err(|e| e.to_string())?;
        let camera = self.camera(&envelope);
        let (trigger, stated) = (envelope.meta.trigger.0, envelope.meta.pixels_crc);
        let found = pixels_crc(&payload[envelope.pixels]);
        if found != stated {
            self.found.damaged_frames.push((camera, trigger));
            let name = &self.found.cameras[camera].0;
            return Err(format!(
                "frame of camera {name} trigger {trigger}: checksum of the pixels is {found:#010x}, expected {stated:#010x}"
            ));
        }
        self.found.frames.push(FoundFrame { camera, trigger, message: data });
        Ok(())
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

    fn metadata(&mut self, name: &str, entries: &BTreeMap<&str, &str>) {
        let number = |key| entries.get(key).and_then(|text: &&str| text.parse::<u64>().ok());
        match name {
            HEADER_METADATA => {
                self.found.first_trigger = number(KEY_FIRST_TRIGGER);
                match parse_header(entries) {
                    Ok((header, _)) => self.found.header = Some(header),
                    Err(reason) => {
                        self.damage(0..0, reason);
                        let owned = |(key, text): (&&str, &&str)| ((*key).to_owned(), (*text).to_owned());
                        self.found.header_entries = entries.iter().map(owned).collect();
                    }
                }
            }
            SEGMENT_METADATA => {
                self.found.end_trigger = number(KEY_END_TRIGGER);
                self.index(entries);
            }
            VERDICT_METADATA => {
                let json = entries.get(KEY_JSON).copied().unwrap_or_default();
                self.found.verdict = serde_json::from_str(json).ok();
            }
            _ => {}
        }
    }

    /// The index knows the gap records, and frames whose way from record to record is damaged.
    fn index(&mut self, entries: &BTreeMap<&str, &str>) {
        let Some(index) = parse_index(self.bytes, entries) else { return };
        let known: std::collections::BTreeSet<usize> =
            self.found.frames.iter().map(|frame| frame.message.start).collect();
        for (_, _, offset, length) in index.frames {
            let (Ok(offset), Ok(length)) = (usize::try_from(offset), usize::try_from(length)) else {
                continue;
            };
            let Some(end) = offset.checked_add(length).filter(|end| *end <= self.bytes.len()) else {
                continue;
            };
            if !known.contains(&offset) {
                // What is wrong with it has been noted on the way, if it is not whole.
                let _ = self.frame(offset..end);
            }
        }
        let known: std::collections::BTreeSet<_> =
            self.found.gaps.iter().map(|gap| (gap.camera.clone(), gap.trigger)).collect();
        let more = index.gaps.into_iter().filter(|gap| !known.contains(&(gap.camera.clone(), gap.trigger)));
        self.found.gaps.extend(more);
    }
}

fn is_json(payload: &[u8]) -> bool {
    payload.first() == Some(&b'{')
}

/// Whether these bytes are, without doubt, the payload of a message of ours.
fn is_payload(payload: &[u8]) -> bool {
    if is_json(payload) {
        payload.last() == Some(&b'}') && serde_json::from_slice::<serde::de::IgnoredAny>(payload).is_ok()
    } else {
        parse_envelope(payload).is_ok()
    }
}
