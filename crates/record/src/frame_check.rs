// SPDX-License-Identifier: MIT OR Apache-2.0
//! A frame's message against its own checksums, and against the identity under which it is recorded.

use super::belonging::Belonging;
use super::envelope::{FRONT, FrameMeta, parse_envelope_of, pixels_crc};
use super::layout::RecordingHeader;
use super::segment_file::SegmentFile;
use crate::base::ids::TriggerIndex;
use std::ops::Range;

/// The bytes of a message up to somewhere in its pixels.
pub(super) fn read_front(file: &SegmentFile, message: &Range<usize>) -> Result<Vec<u8>, String> {
    let mut front = vec![0; message.len().min(FRONT)];
    file.read(message.start, &mut front).map_err(|bad| bad.to_string())?;
    Ok(front)
}

/// Checks a frame's envelope against its own checksum and against the identity under which it is recorded; `front` is
/// the beginning of a message of `length` bytes. Returns the place of the pixels in the message.
pub(super) fn identify(
    front: &[u8],
    length: usize,
    (camera, trigger): (usize, TriggerIndex),
    header: &RecordingHeader,
    belonging: &Belonging,
) -> Result<(FrameMeta, Range<usize>), String> {
    let described = &header.cameras[camera];
    let (envelope, stated) = parse_envelope_of(front).map_err(|e| e.to_string())?;
    let meta = envelope.meta;
    belonging.check(envelope.session)?;
    if envelope.camera != described.id.as_str() || meta.trigger != trigger {
        return Err(format!("the frame states camera {} trigger {}", envelope.camera, meta.trigger));
    }
    let (width, height) = (described.width, described.height);
    if (meta.width, meta.height) != (width, height) {
        return Err(format!("the frame is {} x {}, expected {width} x {height}", meta.width, meta.height));
    }
    if stated != length {
        return Err(format!("the frame's message has {length} bytes, expected {stated}"));
    }
    Ok((meta, envelope.pixels))
}

/// Checks pixels against the checksum that their message states.
pub(super) fn check_pixels(pixels: &[u8], meta: &FrameMeta) -> Result<(), String> {
    let (found, stated) = (pixels_crc(pixels), meta.pixels_crc);
    if found != stated {
        return Err(format!("checksum of the pixels is {found:#010x}, expected {stated:#010x}: damaged"));
    }
    Ok(())
}

/// Checks a frame's message against its own checksums and against the identity under which it is recorded.
pub(crate) fn check_frame(
    message: &[u8],
    camera: usize,
    trigger: TriggerIndex,
    header: &RecordingHeader,
    belonging: &Belonging,
) -> Result<(FrameMeta, Range<usize>), String> {
    let (meta, pixels) = identify(message, message.len(), (camera, trigger), header, belonging)?;
    check_pixels(&message[pixels.clone()], &meta)?;
    Ok((meta, pixels))
}
