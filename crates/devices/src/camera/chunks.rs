// SPDX-License-Identifier: MIT OR Apache-2.0
//! Chunks: a payload in pieces, each followed by its id and its length, so that they are found from the end.

/// Bytes of the id and the length behind a chunk.
const TAIL: usize = 8;
/// Most chunks that are followed; no camera appends as many.
const CHUNKS_MAX: usize = 256;

/// The length of the first chunk of a payload that consists of chunks from its first byte to its last. Numbers begin
/// with their upper byte (GigE Vision) or with their lower one (USB3 Vision).
pub fn first_chunk(payload: &[u8], upper_first: bool) -> Option<usize> {
    let mut end = payload.len();
    for _ in 0..CHUNKS_MAX {
        let length: [u8; 4] = payload.get(end.checked_sub(TAIL / 2)?..end)?.try_into().ok()?;
        let length = if upper_first { u32::from_be_bytes(length) } else { u32::from_le_bytes(length) };
        let length = usize::try_from(length).ok()?;
        end = end.checked_sub(TAIL)?.checked_sub(length)?;
        if end == 0 {
            return Some(length);
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::first_chunk;

    /// A payload of chunks with these lengths.
    fn payload(lengths: &[u32], upper_first: bool) -> Vec<u8> {
        let mut bytes = Vec::new();
        for (id, length) in (1u32..).zip(lengths) {
            bytes.extend(vec![0xff; *length as usize]);
            for number in [id, *length] {
                bytes.extend(if upper_first { number.to_be_bytes() } else { number.to_le_bytes() });
            }
        }
        bytes
    }

    #[test]
    fn the_first_chunk_is_found_where_chunks_are_all_that_there_is() {
        for upper_first in [true, false] {
            assert_eq!(first_chunk(&payload(&[100], upper_first), upper_first), Some(100));
            assert_eq!(first_chunk(&payload(&[64_000, 8, 0, 4], upper_first), upper_first), Some(64_000));
            let whole = payload(&[100, 8], upper_first);
            assert_eq!(first_chunk(&whole[4..], upper_first), None, "bytes are missing");
            assert_eq!(first_chunk(&whole, !upper_first), None);
        }
        assert_eq!(first_chunk(&[], true), None);
        assert_eq!(first_chunk(&[0xa5; 200], true), None);
        assert_eq!(first_chunk(&vec![0; 1 << 20], true), None, "and it is not looked for without end");
    }
}
