//! Where to go on behind damage.

use super::{Fields, MAX_SMALL_RECORD, MESSAGE_HEADER, PREAMBLE, preamble, record_at};
use crate::record::envelope::{begins_like_envelope, parse_envelope_of, pixels_crc};
use mcap::records::op;
use std::ops::Range;

/// A chunk's fields before its records: two times, size, checksum, empty compression, size.
const CHUNK_FIELDS: u64 = 8 + 8 + 8 + 4 + 4 + 8;

/// What is usable behind damage.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Found {
    /// A record of ours begins here.
    Record(usize),
    /// A whole frame's message, whose record around it is damaged.
    Frame(Range<usize>),
}

impl Found {
    /// Its first byte.
    pub fn start(&self) -> usize {
        match self {
            Self::Record(at) => *at,
            Self::Frame(message) => message.start,
        }
    }
}

/// The next place from `from` on where something of ours is without doubt: a chunk whose three lengths agree, a
/// metadata record with one of our names, a message that `is_payload` knows, or a frame both of whose checksums are
/// right, whatever is around it.
pub fn find(bytes: &[u8], from: usize, is_payload: impl Fn(&[u8]) -> bool) -> Option<Found> {
    let candidates = bytes.get(from..)?.iter().enumerate();
    candidates.filter(|(_, byte)| matches!(**byte, op::MESSAGE | op::CHUNK | op::METADATA | b'\n')).find_map(
        |(at, byte)| {
            let at = from + at;
            match *byte {
                b'\n' => frame(bytes, at).map(Found::Frame),
                _ => is_record(bytes, at, &is_payload)?.then_some(Found::Record(at)),
            }
        },
    )
}

fn is_record(bytes: &[u8], at: usize, is_payload: &impl Fn(&[u8]) -> bool) -> Option<bool> {
    let (opcode, length) = preamble(&bytes[at..])?;
    Some(match opcode {
        // It may reach beyond the end of a file that was cut.
        op::CHUNK => {
            let mut fields = Fields { bytes: bytes.get(at + PREAMBLE..)?, position: 16 };
            let (uncompressed, _) = (fields.u64()?, fields.u32()?);
            let (compression, compressed) = (fields.u32()?, fields.u64()?);
            compression == 0
                && uncompressed == compressed
                && compressed.checked_add(CHUNK_FIELDS) == Some(length)
        }
        op::METADATA if length <= MAX_SMALL_RECORD as u64 => {
            let (_, body, _) = record_at(bytes, at)?;
            let mut fields = Fields { bytes: body, position: 0 };
            fields.text()?.starts_with("fourdbody.") && fields.text_map().is_some() && fields.used_up()
        }
        op::MESSAGE => {
            let (_, body, _) = record_at(bytes, at)?;
            is_payload(body.get(MESSAGE_HEADER - PREAMBLE..)?)
        }
        _ => false,
    })
}

/// The message of a whole frame that begins here, found by its own bytes alone.
fn frame(bytes: &[u8], at: usize) -> Option<Range<usize>> {
    let rest = bytes.get(at..).filter(|rest| begins_like_envelope(rest))?;
    let (envelope, length) = parse_envelope_of(rest).ok()?;
    let whole = pixels_crc(rest.get(envelope.pixels)?) == envelope.meta.pixels_crc;
    whole.then_some(at..at + length)
}
