// SPDX-License-Identifier: MIT OR Apache-2.0
//! Where to go on behind damage.

use super::{
    ChunkHeader, Fields, MAX_MESSAGE, MAX_SMALL_RECORD, MESSAGE_HEADER, PREAMBLE, preamble, record_at,
    small_body,
};
use crate::envelope::{FRONT, begins_like_envelope, parse_envelope_of};
use crate::segment_file::{Pieces, SegmentFile};
use mcap::records::op;
use std::ops::Range;

/// A chunk's fields before its records: two times, size, checksum, empty compression, size.
const CHUNK_FIELDS: usize = 8 + 8 + 8 + 4 + 4 + 8;
/// Bytes that are searched at once.
const PIECE: usize = 64 << 10;

/// Bytes that may be examined in a pass over a file: a multiple of its length, and a floor for short ones. A file that
/// is not crafted to cost time needs four times its length: chunk, pixels, and both once more where something is
/// damaged.
pub fn budget(length: usize) -> usize {
    const LOOKS: usize = 8;
    const FLOOR: usize = 16 << 20;
    length.saturating_mul(LOOKS).saturating_add(FLOOR)
}

/// Takes what a look costs off the budget; `None`, and nothing is left, where it is not enough.
fn spend(budget: &mut usize, bytes: usize) -> Option<()> {
    let left = budget.checked_sub(bytes);
    *budget = left.unwrap_or(0);
    left.map(|_| ())
}

/// Something usable that was found behind damage.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Found {
    /// A record of ours begins here.
    Record(usize),
    /// A whole frame's message, whose record around it is damaged.
    Frame(Range<usize>),
}

impl Found {
    /// Offset of its first byte in the file.
    pub fn start(&self) -> usize {
        match self {
            Self::Record(at) => *at,
            Self::Frame(message) => message.start,
        }
    }
}

/// The next place from `from` on where something of ours is without doubt: a chunk whose three lengths agree, a
/// metadata record with one of our names, a message of JSON or with an envelope whose checksum is right, or a frame
/// both of whose checksums are right, whatever is around it. Bytes of candidates are taken off `budget`; what exceeds
/// it is no candidate.
pub fn find(file: &SegmentFile, from: usize, budget: &mut usize) -> Option<Found> {
    // Candidates are read through a piece of their own.
    let (mut passed, mut candidates) = (Pieces::new(file), Pieces::new(file));
    let mut at = from;
    while at < file.len() {
        let mut end = (at + PIECE).min(file.len());
        if let Err(bad) = passed.get(at..end) {
            if bad.from <= at {
                at = bad.to;
                continue;
            }
            end = bad.from;
        }
        let bytes = passed.get(at..end).ok()?.iter().zip(at..);
        let begins = |byte: u8| matches!(byte, op::MESSAGE | op::CHUNK | op::METADATA | b'\n');
        let found = bytes.filter(|(byte, _)| begins(**byte)).find_map(|(byte, at)| match *byte {
            b'\n' => frame(&mut candidates, at, budget).map(Found::Frame),
            _ => is_record(&mut candidates, at, budget)?.then_some(Found::Record(at)),
        });
        if found.is_some() {
            return found;
        }
        at = end;
    }
    None
}

fn is_record(pieces: &mut Pieces<'_>, at: usize, budget: &mut usize) -> Option<bool> {
    let (opcode, length) = preamble(pieces.get(at..at + PREAMBLE).ok()?)?;
    Some(match opcode {
        // It may reach beyond the end of a file that was cut.
        op::CHUNK => {
            let body = at + PREAMBLE;
            let chunk = ChunkHeader::of(pieces.get(body..body + CHUNK_FIELDS).ok()?)?;
            chunk.compression.is_empty()
                && chunk.uncompressed == chunk.compressed
                && chunk.compressed.checked_add(CHUNK_FIELDS as u64) == Some(length)
        }
        op::METADATA if length <= MAX_SMALL_RECORD as u64 => {
            let (_, body) = record_at(pieces, at)?;
            let mut fields = Fields { bytes: small_body(pieces, body)?, position: 0 };
            fields.text()?.starts_with("fourdbody.") && fields.text_map().is_some() && fields.used_up()
        }
        op::MESSAGE => {
            let (_, body) = record_at(pieces, at)?;
            is_payload(pieces, body.start.checked_add(MESSAGE_HEADER - PREAMBLE)?..body.end, budget)?
        }
        _ => false,
    })
}

/// Whether this is, without doubt, the payload of a message of ours.
fn is_payload(pieces: &mut Pieces<'_>, payload: Range<usize>, budget: &mut usize) -> Option<bool> {
    if payload.is_empty() || payload.len() > MAX_MESSAGE {
        return Some(false);
    }
    let front = pieces.get(payload.start..payload.end.min(payload.start + FRONT)).ok()?;
    if front.first() == Some(&b'{') {
        spend(budget, payload.len())?;
        return Some(is_json(pieces.get(payload).ok()?));
    }
    let (_, length) = parse_envelope_of(front).ok()?;
    Some(length == payload.len())
}

/// Whether a payload is a small record, whole.
pub fn is_json(payload: &[u8]) -> bool {
    payload.first() == Some(&b'{')
        && payload.last() == Some(&b'}')
        && serde_json::from_slice::<serde::de::IgnoredAny>(payload).is_ok()
}

/// The message of a whole frame that begins here, found by its own bytes alone.
fn frame(pieces: &mut Pieces<'_>, at: usize, budget: &mut usize) -> Option<Range<usize>> {
    let file = pieces.file();
    let few = pieces.get(at..file.len().min(at + 32)).ok()?;
    if !begins_like_envelope(few) {
        return None;
    }
    // The piece ends in front of the first bytes that cannot be read.
    let end = file.len().min(at + FRONT);
    let front = match pieces.get(at..end) {
        Ok(_) => pieces.get(at..end).ok()?,
        Err(bad) => pieces.get(at..bad.from.max(at)).ok()?,
    };
    let (envelope, length) = parse_envelope_of(front).ok()?;
    let (pixels, stated) = (envelope.pixels, envelope.meta.pixels_crc);
    let end = at.checked_add(length).filter(|end| length <= MAX_MESSAGE && *end <= file.len())?;
    spend(budget, length)?;
    let whole = file.checksum(at + pixels.start..end)?.finalize() == stated;
    whole.then_some(at..end)
}
