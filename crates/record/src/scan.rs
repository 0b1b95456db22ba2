// SPDX-License-Identifier: MIT OR Apache-2.0
//! Walks the records of an MCAP file, as far as they are whole.
//!
//! Made for files that a crash has cut, for disks that fail, and for untrusted bytes: what is allocated by a length
//! found in the file is bounded, no record is assumed to fit, pixels are not read. A record that cannot be read is
//! passed over where its length is known. Record layouts: <https://mcap.dev/spec>.

mod compressed;
mod find;

use super::layout::Entries;
use super::segment_file::{BadRange, Pieces, SegmentFile};
use mcap::MAGIC;
use mcap::records::op;
use std::collections::BTreeMap;
use std::ops::Range;

pub use compressed::open_segment;
use compressed::{compressed_reason, is_compression};
pub use find::{Found, budget, find, is_json};

/// Metadata records, schemas and channels larger than this are refused: ours are far below.
const MAX_SMALL_RECORD: usize = 16 << 20;
/// Messages larger than this are refused: it bounds what is read into memory at once. No camera has as many pixels.
pub const MAX_MESSAGE: usize = 512 << 20;
/// Most metadata records that a summary may name: a segment of this program has four.
const MAX_METADATA: usize = 16;
/// Bytes of a record before its body: opcode and length.
pub const PREAMBLE: usize = 9;
/// A chunk's fields before its records: two times, size, checksum, the name of a compression, size.
const MAX_CHUNK_FIELDS: usize = 8 + 8 + 8 + 4 + 4 + 64 + 8;
/// A message's record without its payload: preamble, channel, sequence, two times.
pub const MESSAGE_HEADER: usize = PREAMBLE + 2 + 4 + 8 + 8;

/// Something found in the file, in file order.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Event {
    Metadata {
        name: String,
        entries: Entries,
    },
    Channel {
        id: u16,
        topic: String,
    },
    /// A chunk; its messages follow.
    Chunk {
        records: Range<usize>,
        /// CRC-32 of the records; 0 means none was computed.
        crc: u32,
        /// Whether all of it is there.
        whole: bool,
    },
    Message {
        channel: u16,
        /// For frames and gaps the trigger index (its low 32 bits).
        sequence: u32,
        data: Range<usize>,
    },
    /// The end of the data section: what follows repeats what came before.
    DataEnd {
        /// Offset of the record; the checksum covers all before it.
        offset: usize,
        /// CRC-32 of everything before; 0 means none was computed.
        crc: u32,
    },
    /// The footer, which is the last record.
    Footer {
        /// Bytes that its checksum covers: the summary, and the footer up to the checksum.
        covered: Range<usize>,
        /// CRC-32 of the summary; 0 means none was computed.
        crc: u32,
    },
}

/// How the walk through the records ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum End {
    /// At the file's closing magic.
    Closed,
    /// The file stops without being closed; everything before `at` was whole.
    Cut {
        /// Offset of the first byte that could not be used.
        at: usize,
    },
    /// The bytes at `at` are not what a recording has there.
    Damaged {
        at: usize,
        /// What was expected and found.
        reason: String,
    },
}

/// Walks through the records of a segment, in the order of the file.
///
/// Reader, verification and recovery each make one for a pass over a file. It borrows the file, promises to end for any
/// bytes whatever, and states in [`Self::end`] why it ended.
pub struct Walker<'a> {
    pieces: Pieces<'a>,
    /// Offset at which the walk ends at the latest.
    limit: usize,
    position: usize,
    /// End of the open chunk, which may lie beyond the file.
    chunk_end: Option<usize>,
    end: Option<End>,
    /// Behind the bytes that the walk stopped at because they cannot be read.
    unreadable_to: Option<usize>,
    /// Whether the walk goes on behind bytes that cannot be read.
    goes_on: bool,
    /// Bytes that may still be examined to find where to go on.
    budget: usize,
}

impl<'a> Walker<'a> {
    /// Begins at the file's magic.
    pub fn new(file: &'a SegmentFile) -> Self {
        let mut walker = Self::resume(file, MAGIC.len());
        let length = file.len().min(MAGIC.len());
        match walker.pieces.get(0..length) {
            // The records behind the magic prove as much as the magic.
            Err(_) => {}
            Ok(bytes) if bytes == MAGIC => {}
            Ok(bytes) if MAGIC.starts_with(bytes) => walker.end = Some(End::Cut { at: 0 }),
            Ok(_) => walker.damaged(0, "expected the magic of an MCAP file").unwrap_or(()),
        }
        walker
    }

    /// Goes on behind damage, at a record outside of any chunk.
    pub fn resume(file: &'a SegmentFile, at: usize) -> Self {
        Self::within(file, at..file.len())
    }

    /// Walks the records of a range.
    pub fn within(file: &'a SegmentFile, range: Range<usize>) -> Self {
        let (limit, position) = (range.end.min(file.len()), range.start);
        let (pieces, budget) = (Pieces::new(file), budget(file.len()));
        let (goes_on, chunk_end, end, unreadable_to) = (false, None, None, None);
        Self { pieces, limit, position, chunk_end, end, unreadable_to, goes_on, budget }
    }

    /// Goes on behind bytes that cannot be read, at the next place that is a record without doubt.
    pub fn over_holes(self) -> Self {
        Self { goes_on: true, ..self }
    }

    /// How the walk ended; `Cut` at the current place before that.
    pub fn end(&self) -> End {
        self.end.clone().unwrap_or(End::Cut { at: self.position })
    }

    /// If the walk ended because bytes cannot be read: moves to the next record behind them; `false` where there is
    /// none.
    fn go_on(&mut self) -> bool {
        let to = self.unreadable_to.take().filter(|_| self.goes_on);
        let found = to.and_then(|to| find(self.pieces.file(), to, &mut self.budget));
        let Some(found) = found else { return false };
        self.position = match found {
            Found::Record(at) => at,
            // Its own record is what cannot be read: who walks by records goes on behind it.
            Found::Frame(message) => message.end,
        };
        (self.chunk_end, self.end) = (None, None);
        true
    }

    /// Ends the walk at damage.
    fn damaged<T>(&mut self, at: usize, reason: impl Into<String>) -> Option<T> {
        self.end.get_or_insert(End::Damaged { at, reason: reason.into() });
        None
    }

    /// Ends the walk at bytes that cannot be read.
    fn unreadable<T>(&mut self, at: usize, bad: &BadRange) -> Option<T> {
        self.unreadable_to = Some(bad.to);
        self.damaged(at, bad.to_string())
    }

    /// Ends the walk behind the last whole record: the rest is cut, or the zeros that a sync leaves behind.
    fn stop_at_rest<T>(&mut self) -> Option<T> {
        self.end.get_or_insert(End::Cut { at: self.position });
        None
    }

    /// Opcode and length of the record that begins here; `None` where the walk ends.
    fn preamble(&mut self, start: usize) -> Option<(u8, u64)> {
        let limit = self.chunk_end.unwrap_or(usize::MAX).min(self.limit);
        if limit.saturating_sub(start) < PREAMBLE {
            return self.stop_at_rest();
        }
        match self.pieces.get(start..start + PREAMBLE) {
            Ok(bytes) => preamble(bytes),
            Err(bad) => self.unreadable(start, &bad),
        }
    }

    /// The next record that matters.
    fn step(&mut self) -> Option<Event> {
        while self.end.is_none() {
            if self.chunk_end.is_some_and(|end| self.position >= end) {
                self.chunk_end = None;
            }
            let start = self.position;
            let (opcode, length) = self.preamble(start)?;
            if opcode == 0 && self.limit == self.pieces.file().len() && self.pieces.file().is_zero_from(start)
            {
                return self.stop_at_rest();
            }
            let body = start + PREAMBLE;
            let end = usize::try_from(length).ok().and_then(|length| body.checked_add(length));
            if opcode == op::CHUNK && self.chunk_end.is_none() {
                return self.chunk(start, body, end);
            }
            let inside = |end: &usize| *end <= self.limit && self.chunk_end.is_none_or(|c| *end <= c);
            let Some(end) = end.filter(inside) else { return self.too_long(start, end) };
            self.position = end;
            if let Some(event) = self.record(opcode, start, body..end) {
                return Some(event);
            }
        }
        None
    }

    /// A record that leaves its chunk is damage; one that leaves the file is a cut, or damage to its length.
    fn too_long(&mut self, start: usize, end: Option<usize>) -> Option<Event> {
        match (end, self.chunk_end) {
            (Some(end), Some(chunk_end)) if end > chunk_end => {
                let reason = format!("a record reaches to byte {end}, but its chunk ends at {chunk_end}");
                self.damaged(start, reason)
            }
            (None, _) => self.damaged(start, "a record's length exceeds any file's"),
            _ => self.stop_at_rest(),
        }
    }

    /// Enters a chunk. One that is cut is entered as well: the messages before the cut are whole.
    fn chunk(&mut self, start: usize, body: usize, end: Option<usize>) -> Option<Event> {
        let Some(end) = end else { return self.damaged(start, "a chunk's length exceeds any file's") };
        let there = end.min(self.limit);
        let header = match self.pieces.get(body..there.min(body + MAX_CHUNK_FIELDS)) {
            Ok(bytes) => bytes,
            Err(bad) => return self.unreadable(start, &bad),
        };
        let Some(ChunkHeader { uncompressed, crc, compression, compressed, length }) =
            ChunkHeader::of(header)
        else {
            return match end > self.limit {
                true => self.stop_at_rest(),
                false => self.damaged(start, "a chunk without its header"),
            };
        };
        if !compression.is_empty() {
            let reason = match is_compression(&compression) {
                true => compressed_reason(&compression),
                false => format!("a chunk compressed with {compression:?}; recordings are not compressed"),
            };
            return self.damaged(start, reason);
        }
        let records = body + length..end;
        let length = (end - records.start) as u64;
        if uncompressed != length || compressed != length {
            let reason = format!("a chunk of {length} bytes states {uncompressed} and {compressed}");
            return self.damaged(start, reason);
        }
        self.position = records.start;
        self.chunk_end = Some(end);
        Some(Event::Chunk { crc, whole: end <= self.limit, records })
    }

    fn record(&mut self, opcode: u8, start: usize, body: Range<usize>) -> Option<Event> {
        let known = match opcode {
            op::MESSAGE | op::METADATA | op::CHANNEL | op::DATA_END => true,
            op::FOOTER => self.chunk_end.is_none(),
            op::MESSAGE_INDEX => return self.message_index(start, &body),
            op::HEADER | op::SCHEMA => return None,
            op::CHUNK_INDEX..=op::SUMMARY_OFFSET if self.chunk_end.is_none() => return None,
            // Private records and those of later versions of MCAP.
            128.. => return None,
            _ => false,
        };
        if !known {
            return self.damaged(start, format!("no record has opcode {opcode:#04x} here"));
        }
        let needed = match opcode {
            op::MESSAGE if body.len() > MAX_MESSAGE => None,
            op::MESSAGE => Some(body.len().min(MESSAGE_HEADER - PREAMBLE)),
            _ => Some(body.len()).filter(|length| *length <= MAX_SMALL_RECORD),
        };
        let event = match needed.map(|length| self.pieces.get(body.start..body.start + length)) {
            // The walk knows where it goes on; who counts what cannot be read asks the file.
            Some(Err(_)) => return None,
            Some(Ok(bytes)) => event(opcode, bytes, start, &body),
            None => None,
        };
        let event = event.filter(|event| match event {
            Event::Footer { covered, .. } => covered.end <= self.limit && covered.start <= covered.end,
            _ => true,
        });
        let Some(event) = event else {
            return self.damaged(start, format!("the record with opcode {opcode:#04x} is not well-formed"));
        };
        if opcode == op::FOOTER {
            self.footer(start, body.end);
        }
        Some(event)
    }

    /// It is passed over, but by its own length only where that agrees with the one inside: a wrong one would swallow
    /// the chunk behind it.
    fn message_index(&mut self, start: usize, body: &Range<usize>) -> Option<Event> {
        const FIELDS: usize = 2 + 4;
        let bytes = self.pieces.get(body.start..body.end.min(body.start + FIELDS)).ok()?;
        let stated = Fields { bytes, position: 2 }.u32().and_then(|entries| usize::try_from(entries).ok());
        if stated.and_then(|entries| entries.checked_add(FIELDS)) != Some(body.len()) {
            return self.damaged(start, "the lengths of a message index disagree");
        }
        None
    }

    /// Ends the walk at the footer, as it should.
    fn footer(&mut self, start: usize, end: usize) -> Option<Event> {
        let rest = end..self.limit.max(end);
        match self.pieces.get(rest.start..rest.end.min(end + MAGIC.len() + 1)) {
            Ok(bytes) if bytes == MAGIC => {
                self.end.get_or_insert(End::Closed);
                None
            }
            Ok(bytes) if MAGIC.starts_with(bytes) => self.stop_at_rest(),
            Ok(_) => self.damaged(start, "the footer is not followed by the closing magic"),
            Err(bad) => self.damaged(start, bad.to_string()),
        }
    }
}

impl Iterator for Walker<'_> {
    type Item = Event;

    fn next(&mut self) -> Option<Event> {
        self.step().or_else(|| if self.go_on() { self.next() } else { None })
    }
}

/// A chunk's fields before its records.
struct ChunkHeader {
    uncompressed: u64,
    crc: u32,
    compression: String,
    compressed: u64,
    length: usize,
}

impl ChunkHeader {
    fn of(bytes: &[u8]) -> Option<Self> {
        let mut fields = Fields { bytes, position: 8 + 8 };
        let (uncompressed, crc, compression) = (fields.u64()?, fields.u32()?, fields.text()?.to_owned());
        let compressed = fields.u64()?;
        Some(Self { uncompressed, crc, compression, compressed, length: fields.position })
    }
}

/// The event of a record of one of our kinds; of a message, `bytes` are its header.
fn event(opcode: u8, bytes: &[u8], start: usize, body: &Range<usize>) -> Option<Event> {
    let mut fields = Fields { bytes, position: 0 };
    match opcode {
        op::MESSAGE => {
            let (channel, sequence) = (fields.u16()?, fields.u32()?);
            fields.u64()?;
            fields.u64()?;
            Some(Event::Message { channel, sequence, data: body.start + fields.position..body.end })
        }
        op::METADATA => {
            let name = fields.text()?.to_owned();
            let entries = fields.text_map()?;
            fields.used_up().then_some(Event::Metadata { name, entries })
        }
        op::CHANNEL => {
            let id = fields.u16()?;
            fields.u16()?;
            Some(Event::Channel { id, topic: fields.text()?.to_owned() })
        }
        op::DATA_END => {
            let crc = fields.u32()?;
            fields.used_up().then_some(Event::DataEnd { offset: start, crc })
        }
        op::FOOTER => {
            let (summary, _) = (fields.u64()?, fields.u64()?);
            let first = if summary == 0 { start } else { usize::try_from(summary).ok()? };
            let covered = first..body.start + fields.position;
            Some(Event::Footer { covered, crc: fields.u32()? })
        }
        _ => None,
    }
}

/// Offset of the summary of a closed segment, by its footer.
pub fn summary_start(file: &SegmentFile) -> Option<usize> {
    summary_of(&mut Pieces::new(file))
}

fn summary_of(pieces: &mut Pieces<'_>) -> Option<usize> {
    const FOOTER_BODY: usize = 20;
    let length = pieces.file().len();
    let start = length.checked_sub(PREAMBLE + FOOTER_BODY + MAGIC.len())?;
    let footer = pieces.get(start..length).ok()?.strip_suffix(MAGIC)?;
    if preamble(footer)? != (op::FOOTER, FOOTER_BODY as u64) {
        return None;
    }
    let summary = Fields { bytes: footer, position: PREAMBLE }.u64()?;
    usize::try_from(summary).ok().filter(|start| *start > 0)
}

/// Places of the metadata records of a closed segment, by its summary.
pub fn metadata_places(file: &SegmentFile) -> Option<Vec<Range<u64>>> {
    let mut pieces = Pieces::new(file);
    let mut position = summary_of(&mut pieces)?;
    let mut found = Vec::new();
    loop {
        let (opcode, body) = record_at(&mut pieces, position)?;
        position = body.end;
        match opcode {
            op::METADATA_INDEX => {
                let mut fields = Fields { bytes: small_body(&mut pieces, body)?, position: 0 };
                let (offset, length) = (fields.u64()?, fields.u64()?);
                // Entries may all lead to one record, which would be read and held for each of them.
                if found.len() == MAX_METADATA {
                    return None;
                }
                found.push(offset..offset.checked_add(length)?);
            }
            op::FOOTER => return Some(found),
            _ => {}
        }
    }
}

/// The metadata records of a closed file, by way of its summary and without a walk; `None` when the file is
/// not closed or its summary does not lead there.
pub fn metadata_by_index(file: &SegmentFile) -> Option<Vec<(String, Entries)>> {
    let mut pieces = Pieces::new(file);
    let mut found = Vec::new();
    // Records lie apart from each other: together they are no longer than the file.
    let mut left = file.len();
    for place in metadata_places(file)? {
        let (opcode, body) = record_at(&mut pieces, usize::try_from(place.start).ok()?)?;
        if opcode != op::METADATA {
            return None;
        }
        left = left.checked_sub(body.len())?;
        let mut fields = Fields { bytes: small_body(&mut pieces, body)?, position: 0 };
        found.push((fields.text()?.to_owned(), fields.text_map()?));
    }
    Some(found)
}

/// Opcode of the record at `position`, and where its body is: inside of the file.
fn record_at(pieces: &mut Pieces<'_>, position: usize) -> Option<(u8, Range<usize>)> {
    let body = position.checked_add(PREAMBLE).filter(|body| *body <= pieces.file().len())?;
    let (opcode, length) = preamble(pieces.get(position..body).ok()?)?;
    let end = body.checked_add(usize::try_from(length).ok()?)?;
    (end <= pieces.file().len()).then_some((opcode, body..end))
}

/// The body of a small record.
fn small_body<'p>(pieces: &'p mut Pieces<'_>, body: Range<usize>) -> Option<&'p [u8]> {
    if body.len() > MAX_SMALL_RECORD {
        return None;
    }
    pieces.get(body).ok()
}

fn preamble(bytes: &[u8]) -> Option<(u8, u64)> {
    let (&opcode, rest) = bytes.split_first()?;
    Some((opcode, u64::from_le_bytes(*rest.first_chunk()?)))
}

/// Little-endian fields of a record.
struct Fields<'a> {
    bytes: &'a [u8],
    position: usize,
}

impl<'a> Fields<'a> {
    fn take(&mut self, count: usize) -> Option<&'a [u8]> {
        let end = self.position.checked_add(count)?;
        let taken = self.bytes.get(self.position..end)?;
        self.position = end;
        Some(taken)
    }

    /// A later MCAP may append fields, but what we read was written by us: more bytes are a wrong length.
    fn used_up(&self) -> bool {
        self.position == self.bytes.len()
    }

    fn u16(&mut self) -> Option<u16> {
        Some(u16::from_le_bytes(self.take(2)?.try_into().ok()?))
    }

    fn u32(&mut self) -> Option<u32> {
        Some(u32::from_le_bytes(self.take(4)?.try_into().ok()?))
    }

    fn u64(&mut self) -> Option<u64> {
        Some(u64::from_le_bytes(self.take(8)?.try_into().ok()?))
    }

    fn text(&mut self) -> Option<&'a str> {
        let length = self.u32()?;
        std::str::from_utf8(self.take(usize::try_from(length).ok()?)?).ok()
    }

    fn text_map(&mut self) -> Option<Entries> {
        let length = self.u32()?;
        let mut inner = Fields { bytes: self.take(usize::try_from(length).ok()?)?, position: 0 };
        let mut map = BTreeMap::new();
        while inner.position < inner.bytes.len() {
            map.insert(inner.text()?.to_owned(), inner.text()?.to_owned());
        }
        Some(map)
    }
}

#[cfg(test)]
mod tests {
    use super::{End, Walker, metadata_by_index};
    use crate::segment_file::of_bytes;
    use mcap::MAGIC;
    use mcap::records::op;
    use proptest::prelude::*;

    /// A metadata record of `bytes`, and a summary with `entries` entries that all lead to it.
    fn all_to_one_place(bytes: usize, entries: usize) -> Vec<u8> {
        let record =
            |opcode: u8, body: &[u8]| [&[opcode][..], &(body.len() as u64).to_le_bytes(), body].concat();
        let text = |text: &[u8]| [&(text.len() as u32).to_le_bytes()[..], text].concat();
        let map = text(&[text(b"key"), text(&vec![b'x'; bytes])].concat());
        let metadata = record(op::METADATA, &[text(b"name"), map].concat());
        let (at, length) = (MAGIC.len() as u64, metadata.len() as u64);
        let entry = [&at.to_le_bytes()[..], &length.to_le_bytes(), &text(b"name")].concat();
        let summary = (MAGIC.len() + metadata.len()) as u64;
        let footer = [&summary.to_le_bytes()[..], &[0; 12]].concat();
        let entries = record(op::METADATA_INDEX, &entry).repeat(entries);
        [MAGIC, &metadata, &entries, &record(op::FOOTER, &footer), MAGIC].concat()
    }

    #[test]
    fn entries_that_lead_to_one_record_cost_no_more_than_the_file() {
        let one = of_bytes(&all_to_one_place(1000, 1));
        assert_eq!(metadata_by_index(&one).map(|found| found.len()), Some(1));
        for (bytes, entries) in [(100_000, 10), (100_000, 10_000), (1_000_000, 100_000)] {
            let file = of_bytes(&all_to_one_place(bytes, entries));
            assert_eq!(metadata_by_index(&file), None, "{entries} entries");
            let read = file.read.load(std::sync::atomic::Ordering::Relaxed);
            assert!(read < 3 * file.len(), "{read} bytes were read of a file of {}", file.len());
        }
    }

    proptest! {
        #[test]
        fn any_bytes_end(mut bytes in prop::collection::vec(any::<u8>(), 0..400), magic: bool) {
            if magic {
                bytes.splice(0..0, MAGIC.iter().copied());
            }
            let file = of_bytes(&bytes);
            let mut walker = Walker::new(&file);
            prop_assert!(walker.by_ref().count() <= bytes.len());
            if !magic && !bytes.is_empty() && !MAGIC.starts_with(&bytes) && !bytes.starts_with(MAGIC) {
                prop_assert!(matches!(walker.end(), End::Damaged { at: 0, .. }), "a file without magic is not read");
            }
        }
    }
}
