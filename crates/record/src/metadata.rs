// SPDX-License-Identifier: MIT OR Apache-2.0
//! The metadata records of a segment: their checksum, the header that they state, and the index that they lead to.

use super::layout::{
    Entries, FORMAT, HEADER_METADATA, KEY_CRC, KEY_INDEX_CRC, KEY_INDEX_LENGTH, KEY_INDEX_OFFSET, KEY_JSON,
    KEY_RIG, KEY_SEGMENT, RecordingHeader, SEGMENT_METADATA, SegmentIndex, VERSION,
};
use super::scan::{End, Event, MAX_MESSAGE, Walker};
use super::segment_file::SegmentFile;
use crate::base::ids::printable;
use std::ops::Range;

/// CRC-32 of a metadata record's entries, in the order of their keys: key, zero, value, zero. Its own entry is left
/// out.
pub(super) fn checksum<'a>(entries: impl IntoIterator<Item = (&'a str, &'a str)>) -> u32 {
    let mut crc = crc32fast::Hasher::new();
    for (key, value) in entries.into_iter().filter(|(key, _)| *key != KEY_CRC) {
        for part in [key, value] {
            crc.update(part.as_bytes());
            crc.update(&[0]);
        }
    }
    crc.finalize()
}

/// Whether the entries are those that were written; `None` where no checksum is stated, as in older recordings.
pub(super) fn is_sound(entries: &Entries) -> Option<bool> {
    let stated = entries.get(KEY_CRC)?;
    let found = checksum(entries.iter().map(|(key, value)| (key.as_str(), value.as_str())));
    Some(stated.parse() == Ok(found))
}

/// A segment's header, as it states it.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct StatedHeader {
    pub header: RecordingHeader,
    pub number: u32,
    pub version: u32,
    /// Whether its own checksum is right.
    pub proven: bool,
}

impl StatedHeader {
    /// Whether it is of another recording than `own`. All segments of a recording were created with the same header;
    /// one that no checksum proves has to differ twice, because one difference may be damage.
    pub fn is_foreign(&self, own: &RecordingHeader) -> bool {
        let differs = self.header.session_id != own.session_id || self.header.node != own.node;
        differs && (self.proven || self.header.created_ns != own.created_ns)
    }
}

/// The message about a segment of another recording.
pub(super) fn foreign_reason(header: &RecordingHeader) -> String {
    format!(
        "it belongs to session {} ({}) of node {}, not to this recording: it is left out",
        header.session, header.session_id, header.node
    )
}

/// The header of most segments, the first one of equals: what the others are measured by.
pub(super) fn of_most(headers: &[&StatedHeader]) -> Option<RecordingHeader> {
    let alike = |one: &StatedHeader| headers.iter().filter(|other| !other.is_foreign(&one.header)).count();
    // `max_by_key` takes the last one of equals.
    let chosen = headers.iter().rev().max_by_key(|one| (alike(one), one.proven))?;
    Some(chosen.header.clone())
}

/// The header of a segment, from the first metadata record.
pub(super) fn read_header(file: &SegmentFile) -> Result<StatedHeader, String> {
    let mut walker = Walker::new(file);
    for event in walker.by_ref().take(8) {
        match event {
            Event::Metadata { name, entries } if name == HEADER_METADATA => return parse_header(&entries),
            _ => {}
        }
    }
    if let Some(bad) = file.bad_ranges().first() {
        return Err(format!("its header is not readable: {bad}"));
    }
    match walker.end() {
        End::Damaged { at, reason } => Err(format!("not a recording: at byte {at}: {reason}")),
        _ => Err(format!("not a recording: no metadata record {HEADER_METADATA:?} at its start")),
    }
}

/// Parses the entries of the header's metadata record.
pub(super) fn parse_header(entries: &Entries) -> Result<StatedHeader, String> {
    let get =
        |key: &str| entries.get(key).map(String::as_str).ok_or_else(|| format!("the header has no {key:?}"));
    let (format, version) = (get("format")?, get("version")?);
    let stated: Option<u32> = version.parse().ok().filter(|version| *version <= VERSION);
    if format != FORMAT || stated.is_none() {
        return Err(format!(
            "format {format:?} version {version}, this program reads {FORMAT:?} up to version {VERSION}"
        ));
    }
    let mut header: RecordingHeader =
        serde_json::from_str(get(KEY_JSON)?).map_err(|e| format!("the header is not readable: {e}"))?;
    header.rig_text = get(KEY_RIG)?.to_owned();
    header.check()?;
    // Whoever made the recording: what is printed of it shall not steer a terminal.
    header.subject = header.subject.map(|text| printable(&text));
    header.note = header.note.map(|text| printable(&text));
    let of_hsu = header.hsu.iter_mut().flat_map(|hsu| [&mut hsu.uid, &mut hsu.firmware]);
    let of_cameras = header.cameras.iter_mut().map(|camera| &mut camera.device);
    let own = [&mut header.session_id, &mut header.software, &mut header.host_clock];
    own.into_iter().chain(of_hsu).chain(of_cameras).for_each(|text| *text = printable(text));
    let segment = get(KEY_SEGMENT)?;
    let number = segment.parse().map_err(|_| format!("segment number {segment:?} is not a number"))?;
    let version = stated.unwrap_or(VERSION);
    Ok(StatedHeader { header, number, version, proven: is_sound(entries) == Some(true) })
}

/// The place of a message in the file, from the offset and length in an index.
pub(super) fn place_of(offset: u64, length: u64) -> Option<Range<usize>> {
    let (start, end) = (usize::try_from(offset).ok()?, usize::try_from(offset.checked_add(length)?).ok()?);
    Some(start..end)
}

/// The index that a closed segment states, if it is intact.
pub(super) fn stated_index(file: &SegmentFile, metadata: &[(String, Entries)]) -> Option<SegmentIndex> {
    let mut own = metadata.iter().filter(|(name, _)| *name == SEGMENT_METADATA);
    own.find_map(|(_, entries)| parse_index(file, entries))
}

/// The index that the entries of the segment's metadata record lead to, if it is intact.
pub(super) fn parse_index(file: &SegmentFile, entries: &Entries) -> Option<SegmentIndex> {
    let number = |key: &str| entries.get(key)?.parse::<usize>().ok();
    let (offset, length) = (number(KEY_INDEX_OFFSET)?, number(KEY_INDEX_LENGTH)?);
    if length > MAX_MESSAGE || offset.checked_add(length)? > file.len() {
        return None;
    }
    let mut index = vec![0; length];
    file.read(offset, &mut index).ok()?;
    let intact = number(KEY_INDEX_CRC)? == crc32fast::hash(&index) as usize;
    intact.then(|| serde_json::from_slice(&index).ok()).flatten()
}
