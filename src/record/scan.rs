//! Walks the records of an MCAP file in memory, as far as they are whole.
//!
//! Made for files that a crash has cut and for bytes that nobody vouches for: nothing is allocated by a
//! length found in the file, no record is trusted to fit, pixels are not touched.
//! Record layouts: <https://mcap.dev/spec>.

mod find;

use mcap::MAGIC;
use mcap::records::op;
use std::collections::BTreeMap;
use std::ops::Range;

pub use find::{Found, find};

/// Metadata records, schemas and channels larger than this are refused: ours are far below.
const MAX_SMALL_RECORD: usize = 16 << 20;
/// Opcode and length.
const PREAMBLE: usize = 9;
/// A message's record without its payload: preamble, channel, sequence, two times.
pub const MESSAGE_HEADER: usize = PREAMBLE + 2 + 4 + 8 + 8;

/// Something found in the file, in file order.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Event<'a> {
    /// A metadata record.
    Metadata {
        /// Its name.
        name: &'a str,
        /// Its entries.
        entries: BTreeMap<&'a str, &'a str>,
    },
    /// A channel.
    Channel {
        /// Its number in messages.
        id: u16,
        /// Its topic.
        topic: &'a str,
    },
    /// A chunk; its messages follow.
    Chunk {
        /// Where its records are.
        records: Range<usize>,
        /// CRC-32 of the records; 0 means none was computed.
        crc: u32,
        /// Whether all of it is there.
        whole: bool,
    },
    /// A message.
    Message {
        /// Number of its channel.
        channel: u16,
        /// For frames and gaps the trigger index (its low 32 bits).
        sequence: u32,
        /// Where its payload is.
        data: Range<usize>,
    },
    /// The end of the data section: what follows repeats what came before.
    DataEnd {
        /// Where the record begins, which is what the checksum covers.
        offset: usize,
        /// CRC-32 of everything before; 0 means none was computed.
        crc: u32,
    },
    /// The last record.
    Footer {
        /// What its checksum covers: the summary, and the footer up to the checksum.
        covered: Range<usize>,
        /// CRC-32 of the summary; 0 means none was computed.
        crc: u32,
    },
}

/// How the walk ended.
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
        /// Offset.
        at: usize,
        /// What was expected and found.
        reason: String,
    },
}

/// The walk.
pub struct Walker<'a> {
    bytes: &'a [u8],
    position: usize,
    /// End of the open chunk, which may lie beyond the file.
    chunk_end: Option<usize>,
    end: Option<End>,
}

impl<'a> Walker<'a> {
    /// Begins at the file's magic.
    pub fn new(bytes: &'a [u8]) -> Self {
        let mut walker = Self { bytes, position: MAGIC.len(), chunk_end: None, end: None };
        if bytes.len() < MAGIC.len() && MAGIC.starts_with(bytes) {
            walker.end = Some(End::Cut { at: 0 });
        } else if !bytes.starts_with(MAGIC) {
            walker.damaged(0, "expected the magic of an MCAP file");
        }
        walker
    }

    /// Goes on behind damage, at a record outside of any chunk.
    pub fn resume(bytes: &'a [u8], at: usize) -> Self {
        Self { bytes, position: at, chunk_end: None, end: None }
    }

    /// How the walk ended; `Cut` at the current place before that.
    pub fn end(&self) -> End {
        self.end.clone().unwrap_or(End::Cut { at: self.position })
    }

    fn damaged(&mut self, at: usize, reason: impl Into<String>) {
        self.end.get_or_insert(End::Damaged { at, reason: reason.into() });
    }

    /// What is left after the last whole record: cut, or the zeros that a sync leaves behind.
    fn stop_at_rest(&mut self) {
        let at = self.position;
        self.end.get_or_insert(End::Cut { at });
    }

    /// The next record that matters.
    fn step(&mut self) -> Option<Event<'a>> {
        while self.end.is_none() {
            if self.chunk_end.is_some_and(|end| self.position >= end) {
                self.chunk_end = None;
            }
            let start = self.position;
            let limit = self.chunk_end.unwrap_or(usize::MAX).min(self.bytes.len());
            let Some((opcode, length)) = preamble(self.bytes.get(start..limit).unwrap_or_default()) else {
                self.stop_at_rest();
                break;
            };
            if opcode == 0 && self.bytes[start..].iter().all(|&byte| byte == 0) {
                self.stop_at_rest();
                break;
            }
            let body = start + PREAMBLE;
            let end = usize::try_from(length).ok().and_then(|length| body.checked_add(length));
            if opcode == op::CHUNK && self.chunk_end.is_none() {
                match self.chunk(start, body, end) {
                    Some(event) => return Some(event),
                    None => break,
                }
            }
            let inside = |end: &usize| *end <= self.bytes.len() && self.chunk_end.is_none_or(|c| *end <= c);
            let Some(end) = end.filter(inside) else {
                self.too_long(start, end);
                break;
            };
            self.position = end;
            if let Some(event) = self.record(opcode, start, body..end) {
                return Some(event);
            }
        }
        None
    }

    /// A record that leaves its chunk is damage; one that leaves the file is a cut, or damage to its length.
    fn too_long(&mut self, start: usize, end: Option<usize>) {
        match (end, self.chunk_end) {
            (Some(end), Some(chunk_end)) if end > chunk_end => {
                self.damaged(
                    start,
                    format!("a record reaches to byte {end}, but its chunk ends at {chunk_end}"),
                );
            }
            (None, _) => self.damaged(start, "a record's length exceeds any file's"),
            _ => self.stop_at_rest(),
        }
    }

    /// Enters a chunk. One that is cut is entered as well: the messages before the cut are whole.
    fn chunk(&mut self, start: usize, body: usize, end: Option<usize>) -> Option<Event<'a>> {
        let Some(end) = end else {
            self.damaged(start, "a chunk's length exceeds any file's");
            return None;
        };
        let mut fields = Fields { bytes: self.bytes.get(body..end.min(self.bytes.len()))?, position: 0 };
        let parsed = (|| {
            fields.u64()?;
            fields.u64()?;
            let uncompressed = fields.u64()?;
            let crc = fields.u32()?;
            let compression = fields.text()?;
            let compressed = fields.u64()?;
            Some((uncompressed, crc, compression, compressed))
        })();
        let Some((uncompressed, crc, compression, compressed)) = parsed else {
            if end > self.bytes.len() {
                self.stop_at_rest();
            } else {
                self.damaged(start, "a chunk without its header");
            }
            return None;
        };
        if !compression.is_empty() {
            let reason = format!("a chunk compressed with {compression:?}; recordings are not compressed");
            self.damaged(start, reason);
            return None;
        }
        let records = body + fields.position..end;
        let length = (end - records.start) as u64;
        if uncompressed != length || compressed != length {
            let reason = format!("a chunk of {length} bytes states {uncompressed} and {compressed}");
            self.damaged(start, reason);
            return None;
        }
        self.position = records.start;
        self.chunk_end = Some(end);
        Some(Event::Chunk { crc, whole: end <= self.bytes.len(), records })
    }

    fn record(&mut self, opcode: u8, start: usize, body: Range<usize>) -> Option<Event<'a>> {
        let bytes = &self.bytes[body.clone()];
        let mut fields = Fields { bytes, position: 0 };
        let event = match opcode {
            op::MESSAGE => (|| {
                let (channel, sequence) = (fields.u16()?, fields.u32()?);
                fields.u64()?;
                fields.u64()?;
                Some(Event::Message { channel, sequence, data: body.start + fields.position..body.end })
            })(),
            op::METADATA | op::CHANNEL if bytes.len() > MAX_SMALL_RECORD => None,
            op::METADATA => (|| {
                let name = fields.text()?;
                Some(Event::Metadata { name, entries: fields.text_map()? })
            })()
            .filter(|_| fields.used_up()),
            op::CHANNEL => (|| {
                let id = fields.u16()?;
                fields.u16()?;
                Some(Event::Channel { id, topic: fields.text()? })
            })(),
            op::DATA_END => {
                fields.u32().map(|crc| Event::DataEnd { offset: start, crc }).filter(|_| fields.used_up())
            }
            op::FOOTER if self.chunk_end.is_none() => {
                let event = (|| {
                    let (summary, _) = (fields.u64()?, fields.u64()?);
                    let first = if summary == 0 { start } else { usize::try_from(summary).ok()? };
                    let covered = first..body.start + fields.position;
                    self.bytes.get(covered.clone())?;
                    Some(Event::Footer { covered, crc: fields.u32()? })
                })();
                if event.is_some() {
                    self.footer(start, body.end);
                }
                event
            }
            op::HEADER | op::SCHEMA | op::MESSAGE_INDEX => return None,
            op::CHUNK_INDEX..=op::SUMMARY_OFFSET if self.chunk_end.is_none() => return None,
            // Private records and those of later versions of MCAP.
            128.. => return None,
            _ => {
                self.damaged(start, format!("no record has opcode {opcode:#04x} here"));
                return None;
            }
        };
        if event.is_none() {
            self.damaged(start, format!("the record with opcode {opcode:#04x} is not well-formed"));
        }
        event
    }

    fn footer(&mut self, start: usize, end: usize) {
        if self.bytes.get(end..) == Some(MAGIC) {
            self.end.get_or_insert(End::Closed);
        } else if MAGIC.starts_with(self.bytes.get(end..).unwrap_or_default()) {
            self.stop_at_rest();
        } else {
            self.damaged(start, "the footer is not followed by the closing magic");
        }
    }
}

impl<'a> Iterator for Walker<'a> {
    type Item = Event<'a>;

    fn next(&mut self) -> Option<Event<'a>> {
        self.step()
    }
}

/// Where the summary of a closed segment begins, by its footer.
pub fn summary_start(bytes: &[u8]) -> Option<usize> {
    const FOOTER_BODY: usize = 20;
    let footer = bytes.strip_suffix(MAGIC)?;
    let (_, footer) = footer.split_at_checked(footer.len().checked_sub(PREAMBLE + FOOTER_BODY)?)?;
    if preamble(footer)? != (op::FOOTER, FOOTER_BODY as u64) {
        return None;
    }
    let summary = Fields { bytes: footer, position: PREAMBLE }.u64()?;
    usize::try_from(summary).ok().filter(|start| *start > 0)
}

/// Where the metadata records of a closed segment are, by its summary.
pub fn metadata_places(bytes: &[u8]) -> Option<Vec<Range<u64>>> {
    let mut position = summary_start(bytes)?;
    let mut found = Vec::new();
    loop {
        let (opcode, body, next) = record_at(bytes, position)?;
        match opcode {
            op::METADATA_INDEX => {
                let mut fields = Fields { bytes: body, position: 0 };
                let (offset, length) = (fields.u64()?, fields.u64()?);
                found.push(offset..offset.checked_add(length)?);
            }
            op::FOOTER => return Some(found),
            _ => {}
        }
        position = next;
    }
}

/// The metadata records of a closed file, by way of its summary and without a walk; `None` when the file is
/// not closed or its summary does not lead there.
pub fn metadata_by_index(bytes: &[u8]) -> Option<Vec<(&str, BTreeMap<&str, &str>)>> {
    let mut found = Vec::new();
    for place in metadata_places(bytes)? {
        let (opcode, body, _) = record_at(bytes, usize::try_from(place.start).ok()?)?;
        let mut fields = Fields { bytes: body, position: 0 };
        if opcode != op::METADATA {
            return None;
        }
        found.push((fields.text()?, fields.text_map()?));
    }
    Some(found)
}

/// Opcode and body of the record at `position`, and where the next one begins.
fn record_at(bytes: &[u8], position: usize) -> Option<(u8, &[u8], usize)> {
    let (opcode, length) = preamble(bytes.get(position..)?)?;
    let body = position.checked_add(PREAMBLE)?;
    let end = body.checked_add(usize::try_from(length).ok()?)?;
    Some((opcode, bytes.get(body..end)?, end))
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

    fn text_map(&mut self) -> Option<BTreeMap<&'a str, &'a str>> {
        let length = self.u32()?;
        let mut inner = Fields { bytes: self.take(usize::try_from(length).ok()?)?, position: 0 };
        let mut map = BTreeMap::new();
        while inner.position < inner.bytes.len() {
            map.insert(inner.text()?, inner.text()?);
        }
        Some(map)
    }
}

#[cfg(test)]
mod tests {
    use super::{End, Walker};
    use mcap::MAGIC;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn any_bytes_end(mut bytes in prop::collection::vec(any::<u8>(), 0..400), magic: bool) {
            if magic {
                bytes.splice(0..0, MAGIC.iter().copied());
            }
            let mut walker = Walker::new(&bytes);
            prop_assert!(walker.by_ref().count() <= bytes.len());
            if !magic && !bytes.is_empty() && !MAGIC.starts_with(&bytes) && !bytes.starts_with(MAGIC) {
                prop_assert!(matches!(walker.end(), End::Damaged { at: 0, .. }), "a file without magic is not read");
            }
        }
    }
}
