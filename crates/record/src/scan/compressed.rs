// SPDX-License-Identifier: MIT OR Apache-2.0
//! Segments that another program compressed: they are refused by name, so that none is taken for an empty one.

use super::{ChunkHeader, MAX_CHUNK_FIELDS, record_at};
use crate::segment_file::{Pieces, SegmentFile};
use mcap::MAGIC;
use mcap::records::op;
use std::path::Path;

/// Records before the first chunk that are looked through for its compression.
const MAX_BEFORE_CHUNK: usize = 1000;

/// Opens a segment for reading; an error where it cannot be opened, or another program compressed it.
pub fn open_segment(path: &Path) -> Result<SegmentFile, String> {
    let file = SegmentFile::open(path).map_err(|error| format!("cannot be opened: {error}"))?;
    match compression(&file) {
        Some(name) => Err(compressed_reason(&name)),
        None => Ok(file),
    }
}

/// Whether a chunk names a compression that MCAP defines; any other name is damage.
pub(super) fn is_compression(name: &str) -> bool {
    ["zstd", "lz4"].contains(&name)
}

/// The compression of the first chunk, if it has one.
fn compression(file: &SegmentFile) -> Option<String> {
    let mut pieces = Pieces::new(file);
    let mut position = MAGIC.len();
    // Ours has a header and a metadata record before its first chunk; other programs put schemas and channels there.
    for _ in 0..MAX_BEFORE_CHUNK {
        let (opcode, body) = record_at(&mut pieces, position)?;
        if opcode == op::CHUNK {
            let header = body.start..body.end.min(body.start + MAX_CHUNK_FIELDS);
            let compression = ChunkHeader::of(pieces.get(header).ok()?)?.compression;
            return Some(compression).filter(|name| is_compression(name));
        }
        position = body.end;
    }
    None
}

/// The message about such a segment, with what to do.
pub(super) fn compressed_reason(compression: &str) -> String {
    format!(
        "its chunks are compressed ({compression}), as `mcap compress`, `filter`, `merge` and `sort` write them; \
         decompress it first: `mcap decompress IN -o OUT`, then `fourdbody recover`"
    )
}
