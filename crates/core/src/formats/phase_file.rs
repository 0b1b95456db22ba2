// SPDX-License-Identifier: MIT OR Apache-2.0
//! Phase maps as files: all that a cloud follows from, given the calibration, in a twentieth of its bytes.
//! `docs/reference/phase-maps.md` specifies them for other readers, one of which `it::reference` runs.
//!
//! ```text
//! 8 bytes   "4dphase1"
//! u32       length of the statement
//! u32       length of the body
//!           statement: JSON, what is needed to make the very same cloud files again
//!           body
//! u32       CRC-32 of everything before
//! ```
//!
//! Numbers are little endian. The body holds, one after the other: the runs (LEB128: rows to the run before; columns
//! to its end, or in a new row the column itself; length); for each run its first phase less that of the run before
//! and, if it has two pixels, its first step less that of the run before (LEB128 of zigzag); the second differences
//! of the phase along the runs; the differences of the light, and of the uncertainty where there is one, from pixel
//! to pixel. The differences are zigzag numbers in blocks of 64: a byte states how many bits each has, then come 64
//! times as many bits, the first number in the lowest. The last block is filled up with zeros.
//!
//! Light and slope change slowly along a row, so that the differences are little more than the noise, which does not
//! compress further.

use crate::base::{FileError, json, regular};
use crate::data::{PhaseMap, Run};
use serde::{Deserialize, Serialize};
use std::io::{self, Write};
use std::path::Path;

/// The first bytes of a file of version 1.
const MAGIC: &[u8; 8] = b"4dphase1";

/// Bytes before the statement: magic and the two lengths.
const HEAD_BYTES: usize = 16;
/// Bytes after the body: the checksum.
const TAIL_BYTES: usize = 4;

/// The most bytes of a file: no camera has pixels for more.
const BYTES_MAX: u64 = 1 << 30;

/// Numbers that are packed as one block, all of the same width.
const BLOCK: usize = 64;

/// What a file states beside the phase map.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Statement {
    pub camera: String,
    pub trigger: u64,
    /// When it was, ns, where that is known.
    pub time_ns: Option<u64>,
    /// SHA-256 of the cameras, projectors and pattern that the clouds are made with.
    pub geometry_sha256: String,
    /// Corners of the volume of that calibration, m.
    pub volume_m: [[f64; 3]; 2],
    /// Points that the cloud has.
    pub points: usize,
    /// Comments of the directional cloud's file.
    pub comments: Vec<String>,
    /// Comments of the merged cloud's file.
    pub merged_comments: Vec<String>,
}

/// The statement of a file with the sizes that are needed to read its body.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Header {
    statement: Statement,
    frame: [u16; 2],
    runs: usize,
    pixels: usize,
    #[serde(rename = "doubt")]
    sigma_code: bool,
}

/// The bytes of a file.
pub fn encode(statement: &Statement, map: &PhaseMap) -> Result<Vec<u8>, String> {
    let header = Header {
        statement: statement.clone(),
        frame: map.frame,
        runs: map.runs.len(),
        pixels: map.phase.len(),
        sigma_code: !map.sigma_code.is_empty(),
    };
    let header = serde_json::to_vec(&header).map_err(|e| e.to_string())?;
    let mut out = Vec::with_capacity(HEAD_BYTES + header.len() + 2 * map.phase.len() + 8 * map.runs.len());
    out.extend_from_slice(MAGIC);
    out.extend_from_slice(&u32::try_from(header.len()).map_err(|e| e.to_string())?.to_le_bytes());
    out.extend_from_slice(&[0; 4]);
    out.extend_from_slice(&header);
    let body = out.len();
    write_runs(map, &mut out);
    write_phase(map, &mut out);
    pack(differences(&map.light), &mut out);
    pack(differences(&map.sigma_code), &mut out);
    let length = u32::try_from(out.len() - body).map_err(|e| e.to_string())?;
    out[12..16].copy_from_slice(&length.to_le_bytes());
    let sum = crc32fast::hash(&out);
    out.extend_from_slice(&sum.to_le_bytes());
    Ok(out)
}

/// Reads the bytes of a file; an error states what is wrong with them.
pub fn decode(bytes: &[u8]) -> Result<(Statement, PhaseMap), String> {
    let (header, mut body) = open(bytes)?;
    let room = usize::from(header.frame[0]) * usize::from(header.frame[1]);
    // Every block has a byte at least: a false number claims no memory.
    if header.pixels > room.min(BLOCK * body.len()) || header.runs > header.pixels {
        return Err(format!("{} pixels in {} runs cannot be", header.pixels, header.runs));
    }
    let mut map = PhaseMap { frame: header.frame, ..PhaseMap::default() };
    let body = &mut body;
    read_runs(&header, body, &mut map)?;
    read_phase(&header, body, &mut map)?;
    let mut last = 0i32;
    unpack(body, header.pixels, |x| {
        last = last.wrapping_add(unzigzag(x));
        map.light.push(last as u16);
    })?;
    let mut last = 0i32;
    unpack(body, if header.sigma_code { header.pixels } else { 0 }, |x| {
        last = last.wrapping_add(unzigzag(x));
        map.sigma_code.push(last as u8);
    })?;
    if !body.is_empty() {
        return Err(format!("{} bytes are left over", body.len()));
    }
    Ok((header.statement, map))
}

/// Writes a file through a temporary neighbour, so that it is never half there.
pub fn save(path: &Path, statement: &Statement, map: &PhaseMap) -> io::Result<()> {
    let bytes = encode(statement, map).map_err(io::Error::other)?;
    crate::base::write_whole_cached(path, |file| file.write_all(&bytes))
}

/// Reads a file: what it states, and its map.
pub fn load(path: &Path) -> Result<(Statement, PhaseMap), FileError> {
    load_as(path, decode)
}

/// As [`load`], of a camera whose frame has these columns and rows: the map takes no memory for any other.
pub fn load_of_frame(path: &Path, frame: [usize; 2]) -> Result<(Statement, PhaseMap), FileError> {
    load_as(path, |bytes| match open(bytes)?.0.frame.map(usize::from) {
        found if found == frame => decode(bytes),
        found => Err(format!(
            "it is of a frame of {found:?} pixels, the calibration has {frame:?} for the camera of its name"
        )),
    })
}

/// Reads what a file states, after all of its bytes have been checked.
pub fn load_statement(path: &Path) -> Result<Statement, FileError> {
    load_as(path, |bytes| open(bytes).map(|(header, _)| header.statement))
}

fn load_as<T>(path: &Path, decode: impl FnOnce(&[u8]) -> Result<T, String>) -> Result<T, FileError> {
    let bytes = regular::read(path, BYTES_MAX).map_err(FileError::of(path))?;
    decode(&bytes).map_err(|reason| {
        let expected = "expected a phase map as `fourdbody reconstruct` writes it: make it again";
        FileError::of(path)(format!("{reason}; {expected}"))
    })
}

/// Checks lengths and checksum; the header, and the bytes of the body.
fn open(bytes: &[u8]) -> Result<(Header, &[u8]), String> {
    let number = |at: usize| {
        let found = bytes.get(at..at + 4).and_then(|x| x.as_array::<4>());
        found.map(|x| u32::from_le_bytes(*x)).ok_or_else(|| format!("it ends after {} bytes", bytes.len()))
    };
    if !bytes.starts_with(MAGIC) {
        return Err("it does not begin as phase maps of version 1 do".to_owned());
    }
    let (header, body) = (number(8)? as usize, number(12)? as usize);
    let sum_at = HEAD_BYTES + header + body;
    if bytes.len() != sum_at + TAIL_BYTES {
        return Err(format!("it states {} bytes and has {}", sum_at + TAIL_BYTES, bytes.len()));
    }
    let (stated, found) = (number(sum_at)?, crc32fast::hash(&bytes[..sum_at]));
    if stated != found {
        return Err(format!("its checksum is {found:08x}, it states {stated:08x}"));
    }
    let (header, body) = bytes[HEAD_BYTES..sum_at].split_at(header);
    let header = json::from_slice(header).map_err(|e| format!("its statement: {e}"))?;
    Ok((header, body))
}

fn differences<T: Copy + Into<i32>>(numbers: &[T]) -> impl Iterator<Item = u32> {
    let mut last = 0;
    numbers.iter().map(move |&x| zigzag(x.into() - std::mem::replace(&mut last, x.into())))
}

fn write_runs(map: &PhaseMap, out: &mut Vec<u8>) {
    let (mut row, mut end) = (0, 0);
    for run in &map.runs {
        let rows = run.row - row;
        (row, end) = (run.row, if rows == 0 { end } else { 0 });
        for number in [usize::from(rows), usize::from(run.first) - end, usize::from(run.length)] {
            write_varint(number as u32, out);
        }
        end = run.end();
    }
}

fn read_runs(header: &Header, body: &mut &[u8], map: &mut PhaseMap) -> Result<(), String> {
    let [width, height] = header.frame.map(u32::from);
    let (mut row, mut end, mut pixels) = (0u32, 0u32, 0usize);
    for i in 0..header.runs {
        let rows = read_varint(body)?;
        end = if rows == 0 { end } else { 0 };
        let (gap, length) = (read_varint(body)?, read_varint(body)?);
        row = row.saturating_add(rows);
        let first = end.saturating_add(gap);
        end = first.saturating_add(length);
        let apart = rows > 0 || gap > 0 || i == 0;
        if row >= height || end > width || length == 0 || !apart {
            return Err(format!("run {i} leaves the frame or touches the one before"));
        }
        map.runs.push(Run { row: row as u16, first: first as u16, length: length as u16 });
        pixels += length as usize;
    }
    if pixels != header.pixels {
        return Err(format!("the runs have {pixels} pixels, {} are stated", header.pixels));
    }
    Ok(())
}

fn write_phase(map: &PhaseMap, out: &mut Vec<u8>) {
    let parts = || {
        let mut rest = map.phase.as_slice();
        map.runs.iter().map(move |run| {
            let (part, after) = rest.split_at(usize::from(run.length));
            rest = after;
            part
        })
    };
    let (mut first, mut step) = (0, 0);
    for part in parts() {
        write_varint(zigzag(part[0].wrapping_sub(first)), out);
        first = part[0];
        if let Some(second) = part.get(1) {
            let slope = second.wrapping_sub(first);
            write_varint(zigzag(slope.wrapping_sub(step)), out);
            step = slope;
        }
    }
    let bends = parts().flat_map(|part| {
        part.windows(3).map(|x| zigzag(x[2].wrapping_sub(x[1]).wrapping_sub(x[1].wrapping_sub(x[0]))))
    });
    pack(bends, out);
}

fn read_phase(header: &Header, body: &mut &[u8], map: &mut PhaseMap) -> Result<(), String> {
    let (mut first, mut step) = (0i32, 0i32);
    let mut starts = Vec::with_capacity(map.runs.len());
    for run in &map.runs {
        first = first.wrapping_add(unzigzag(read_varint(body)?));
        if run.length > 1 {
            step = step.wrapping_add(unzigzag(read_varint(body)?));
        }
        starts.push((first, step));
    }
    let lengths = map.runs.iter().map(|run| usize::from(run.length));
    let bends: usize = lengths.clone().map(|length| length.saturating_sub(2)).sum();
    let mut differences = Vec::with_capacity(bends);
    unpack(body, bends, |x| differences.push(unzigzag(x)))?;
    let mut rest = differences.as_slice();
    map.phase.reserve_exact(header.pixels);
    for ((first, mut step), length) in starts.into_iter().zip(lengths) {
        let (part, after) = rest.split_at(length.saturating_sub(2));
        rest = after;
        let mut phase = first;
        map.phase.push(phase);
        if length > 1 {
            phase = phase.wrapping_add(step);
            map.phase.push(phase);
        }
        map.phase.extend(part.iter().map(|bend| {
            step = step.wrapping_add(*bend);
            phase = phase.wrapping_add(step);
            phase
        }));
    }
    Ok(())
}

/// Zigzag: numbers of either sign near 0 as small unsigned numbers.
fn zigzag(x: i32) -> u32 {
    ((x << 1) ^ (x >> 31)) as u32
}

fn unzigzag(x: u32) -> i32 {
    (x >> 1) as i32 ^ -((x & 1) as i32)
}

fn write_varint(mut x: u32, out: &mut Vec<u8>) {
    while x >= 0x80 {
        out.push(x as u8 | 0x80);
        x >>= 7;
    }
    out.push(x as u8);
}

fn read_varint(body: &mut &[u8]) -> Result<u32, String> {
    let mut x = 0u32;
    for shift in (0..32).step_by(7) {
        let (byte, rest) = body.split_first().ok_or("its body ends too soon")?;
        *body = rest;
        x |= u32::from(byte & 0x7f) << shift;
        if byte & 0x80 == 0 {
            return Ok(x);
        }
    }
    Err("a number is longer than 32 bits".to_owned())
}

/// Packs numbers in blocks, each as wide as its widest one.
fn pack(numbers: impl Iterator<Item = u32>, out: &mut Vec<u8>) {
    let mut block = [0u32; BLOCK];
    let mut filled = 0;
    for x in numbers {
        block[filled] = x;
        filled += 1;
        if filled == BLOCK {
            pack_block(&block, out);
            filled = 0;
        }
    }
    if filled > 0 {
        block[filled..].fill(0);
        pack_block(&block, out);
    }
}

fn pack_block(block: &[u32; BLOCK], out: &mut Vec<u8>) {
    let width = 32 - block.iter().fold(0, |all, x| all | x).leading_zeros();
    out.push(width as u8);
    let (mut word, mut bits) = (0u64, 0u32);
    for &x in block {
        word |= u64::from(x) << bits;
        bits += width;
        if bits >= 64 {
            out.extend_from_slice(&word.to_le_bytes());
            bits -= 64;
            // The upper bits, which did not fit into the word.
            word = u64::from(x).checked_shr(width - bits).unwrap_or(0);
        }
    }
}

/// Hands out `count` packed numbers.
fn unpack(body: &mut &[u8], count: usize, mut take: impl FnMut(u32)) -> Result<(), String> {
    for first in (0..count).step_by(BLOCK) {
        let (&width, rest) = body.split_first().ok_or("its body ends too soon")?;
        let width = u32::from(width);
        if width > 32 || rest.len() < 8 * width as usize {
            return Err("its body ends too soon".to_owned());
        }
        let (bytes, rest) = rest.split_at(8 * width as usize);
        *body = rest;
        // One word more than a block has: the upper part of its last number is read from there.
        let mut words = [0u64; 33];
        for (word, bytes) in words.iter_mut().zip(bytes.as_chunks::<8>().0) {
            *word = u64::from_le_bytes(*bytes);
        }
        let mask = (1u64 << width) - 1;
        for i in 0..BLOCK.min(count - first) as u32 {
            let (word, bit) = ((i * width / 64) as usize, i * width % 64);
            let above = (words[word + 1] << 1) << (63 - bit);
            take((((words[word] >> bit) | above) & mask) as u32);
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::{Statement, decode, encode};
    use crate::data::{PhaseMap, Run};
    use proptest::collection::vec;
    use proptest::prelude::{Strategy, any, prop_assert, prop_assert_eq, proptest};

    fn statement() -> Statement {
        Statement {
            camera: "h0_up".to_owned(),
            trigger: 7,
            time_ns: Some(u64::MAX),
            geometry_sha256: "ab".repeat(32),
            volume_m: [[-0.75, -0.75, 0.0], [0.75, 0.75, 2.0]],
            points: 3,
            comments: vec!["camera h0_up".to_owned()],
            merged_comments: Vec::new(),
        }
    }

    /// Maps of random masks; smooth phases with some that are anything.
    fn maps() -> impl Strategy<Value = PhaseMap> {
        let row = vec((0u16..40, 1u16..90), 0..5);
        (vec(row, 0..12), any::<bool>(), any::<u64>()).prop_map(|(rows, sigma_code, seed)| {
            let mut map = PhaseMap { frame: [1920, 1200], ..PhaseMap::default() };
            let mut state = seed | 1;
            let mut next = move || {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                (state >> 33) as u32
            };
            for (row, runs) in rows.into_iter().enumerate() {
                let mut end = 0;
                for (i, (gap, length)) in runs.into_iter().enumerate() {
                    let first = end + gap + u16::from(i > 0);
                    map.runs.push(Run { row: (row * 7) as u16, first, length });
                    for u in first..first + length {
                        let smooth = 400_000 + 700 * i32::from(u) + (next() % 64) as i32;
                        map.phase.push(if next() % 50 == 0 { next().wrapping_mul(3) as i32 } else { smooth });
                        map.light.push((next() % 1021) as u16);
                        if sigma_code {
                            map.sigma_code.push(next() as u8);
                        }
                    }
                    end = first + length;
                }
            }
            map
        })
    }

    proptest! {
        #[test]
        fn maps_survive(map in maps()) {
            let bytes = encode(&statement(), &map).expect("encodes");
            let (stated, back) = decode(&bytes).expect("intact");
            prop_assert_eq!(stated, statement());
            prop_assert_eq!(back, map);
        }

        #[test]
        fn flipped_bits_and_cut_files_are_refused(map in maps(), at in any::<usize>(), bit in 0u8..8) {
            let bytes = encode(&statement(), &map).expect("encodes");
            let mut flipped = bytes.clone();
            flipped[at % bytes.len()] ^= 1 << bit;
            prop_assert!(decode(&flipped).is_err());
            prop_assert!(decode(&bytes[..at % bytes.len()]).is_err());
        }

        /// A body that is anything, with a checksum that is right: never a panic.
        #[test]
        fn any_body_is_an_error_or_a_map_within_the_frame(
            map in maps(), noise in vec((any::<usize>(), any::<u8>()), 1..20),
        ) {
            let mut bytes = encode(&statement(), &map).expect("encodes");
            let header = u32::from_le_bytes([bytes[8], bytes[9], bytes[10], bytes[11]]) as usize;
            let (body, sum) = (16 + header, bytes.len() - 4);
            for (at, value) in noise {
                if sum > body {
                    bytes[body + at % (sum - body)] = value;
                }
            }
            let found = crc32fast::hash(&bytes[..sum]);
            bytes[sum..].copy_from_slice(&found.to_le_bytes());
            if let Ok((_, map)) = decode(&bytes) {
                prop_assert!(map.runs.iter().all(|run| run.end() <= 1920 && run.row < 1200));
                prop_assert_eq!(map.phase.len(), map.light.len());
            }
        }
    }

    #[test]
    fn the_bytes_of_a_small_map_are_these() {
        let map = PhaseMap {
            frame: [16, 8],
            runs: vec![Run { row: 2, first: 3, length: 3 }, Run { row: 2, first: 9, length: 1 }],
            phase: vec![100, 110, 121, 90],
            light: vec![4, 5, 5, 3],
            sigma_code: Vec::new(),
        };
        let bytes = encode(&statement(), &map).expect("encodes");
        let header = u32::from_le_bytes([bytes[8], bytes[9], bytes[10], bytes[11]]) as usize;
        let body = &bytes[16 + header..bytes.len() - 4];
        let mut expected = vec![2, 3, 3, 0, 3, 1];
        // 100 -> 200; a step of 10 -> 20; 90 - 100 -> 19.
        expected.extend([0xc8, 1, 20, 19]);
        // One bend of 1 -> 2: 64 numbers of two bits.
        expected.extend([2, 2, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]);
        // Light: 4 -> 8, 1 -> 2, 0, -2 -> 3: 64 numbers of four bits.
        expected.extend([4, 0x28, 0x30]);
        expected.extend([0; 30]);
        assert_eq!(body, expected);
    }
}
