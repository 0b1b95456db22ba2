// SPDX-License-Identifier: MIT OR Apache-2.0
//! A copy of a segment that has its indexes and chosen frames, and holes elsewhere: what a reader of frames needs of a
//! file that lies far away.

use super::layout::{KEY_INDEX_LENGTH, KEY_INDEX_OFFSET, SEGMENT_METADATA, segment_number};
use super::metadata::{read_header, stated_index};
use super::scan::{metadata_by_index, metadata_places, summary_start};
use super::segment_file::SegmentFile;
use crate::base::ids::CameraId;
use rayon::prelude::*;
use std::fs::File;
use std::ops::Range;
use std::os::unix::fs::FileExt;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};

/// Bytes that are fetched from both ends at first: they have the header, and most summaries.
const END: u64 = 1 << 20;
/// Bytes of a piece, in which a segment without an index is fetched whole.
const PIECE: u64 = 16 << 20;

/// Camera and trigger of a frame, and where its message is.
type FramePlace = (CameraId, u64, Range<u64>);

/// Reads bytes of the original.
pub type Read<'a> = &'a (dyn Fn(Range<u64>) -> Result<Vec<u8>, String> + Sync);

/// Whether a file of this name is a segment.
pub fn is_segment(name: &str) -> bool {
    segment_number(name).is_some()
}

/// Copies a segment of `size` bytes to `path`, of its frames only those that are wanted (by camera and trigger). A
/// segment that was not closed is copied whole. Returns the bytes read.
pub fn copy_frames(
    size: u64,
    read: Read<'_>,
    path: &Path,
    wanted: &(dyn Fn(&CameraId, u64) -> bool + Sync),
) -> Result<u64, String> {
    let failed = |e: std::io::Error| format!("{}: {e}", path.display());
    let file = File::create(path).map_err(failed)?;
    file.set_len(size).map_err(failed)?;
    if size == 0 {
        return Ok(0);
    }
    let copy = Copy { size, read, file: &file, read_bytes: AtomicU64::new(0) };
    let (head, tail) = (END.min(size), size.saturating_sub(END).max(END.min(size)));
    copy.fetch(0..head).and_then(|()| copy.fetch(tail..size)).map_err(failed)?;
    let there = SegmentFile::open(path).map_err(failed)?;
    let frames = match copy.index(&there, tail).map_err(failed)? {
        Some(index) => index.into_iter().filter(|(camera, trigger, _)| wanted(camera, *trigger)),
        None => {
            let pieces: Vec<u64> = (head..tail).step_by(PIECE as usize).collect();
            let piece = |start: u64| copy.fetch(start..(start + PIECE).min(tail));
            pieces.into_par_iter().try_for_each(piece).map_err(failed)?;
            return Ok(copy.read_bytes.into_inner());
        }
    };
    let frames: Vec<Range<u64>> = frames.map(|(_, _, range)| range).collect();
    frames.into_par_iter().try_for_each(|range| copy.fetch(range)).map_err(failed)?;
    Ok(copy.read_bytes.into_inner())
}

struct Copy<'a> {
    size: u64,
    read: Read<'a>,
    file: &'a File,
    read_bytes: AtomicU64,
}

impl Copy<'_> {
    fn fetch(&self, range: Range<u64>) -> std::io::Result<()> {
        // What the file states about itself is not trusted.
        let range = range.start.min(self.size)..range.end.min(self.size);
        if range.is_empty() {
            return Ok(());
        }
        let bytes = (self.read)(range.clone()).map_err(std::io::Error::other)?;
        self.read_bytes.fetch_add(bytes.len() as u64, Ordering::Relaxed);
        self.file.write_all_at(&bytes, range.start)
    }

    /// Camera, trigger and place of all frames; `None` when the segment has no index that can be relied on. `tail`:
    /// from here on everything is there.
    fn index(&self, there: &SegmentFile, tail: u64) -> std::io::Result<Option<Vec<FramePlace>>> {
        let Some(start) = summary_start(there) else { return Ok(None) };
        self.fetch(start as u64..tail)?;
        let Some(places) = metadata_places(there) else { return Ok(None) };
        places.into_iter().try_for_each(|place| self.fetch(place))?;
        let Some(metadata) = metadata_by_index(there) else { return Ok(None) };
        for (_, entries) in metadata.iter().filter(|(name, _)| *name == SEGMENT_METADATA) {
            let number = |key: &str| entries.get(key)?.parse::<u64>().ok();
            if let (Some(offset), Some(length)) = (number(KEY_INDEX_OFFSET), number(KEY_INDEX_LENGTH)) {
                self.fetch(offset..offset.saturating_add(length))?;
            }
        }
        let (Some(index), Ok(stated)) = (stated_index(there, &metadata), read_header(there)) else {
            return Ok(None);
        };
        let named = |(camera, trigger, offset, length): (u32, u64, u64, u64)| {
            let camera = stated.header.cameras.get(camera as usize)?;
            Some((camera.id.clone(), trigger, offset..offset.saturating_add(length)))
        };
        Ok(Some(index.frames.into_iter().filter_map(named).collect()))
    }
}

#[cfg(test)]
mod tests {
    use super::copy_frames;
    use crate::base::ids::{CameraId, TriggerIndex};
    use crate::session::SessionReader;
    use crate::writer::Recording;
    use crate::writer::tests::{end, frame, header, options};
    use std::path::{Path, PathBuf};

    const TRIGGERS: u64 = 3000;

    fn record(dir: &Path) -> PathBuf {
        let mut recording = Recording::create(dir, header(None), options(1 << 30)).expect("a recording");
        for trigger in 0..TRIGGERS {
            for camera in [0, 1] {
                let (meta, message) = frame(camera, trigger);
                recording.frame(camera, &meta, &message).expect("recorded");
            }
        }
        recording.finish(end(TRIGGERS)).expect("finished");
        dir.join("segment-000.mcap")
    }

    fn copy(bytes: &[u8], to: &Path, wanted: impl Fn(&CameraId, u64) -> bool + Sync) -> Result<u64, String> {
        std::fs::create_dir_all(to).expect("writable");
        let read = |range: std::ops::Range<u64>| {
            bytes.get(range.start as usize..range.end as usize).map(<[u8]>::to_vec).ok_or("away".to_owned())
        };
        copy_frames(bytes.len() as u64, &read, &to.join("segment-000.mcap"), &wanted)
    }

    #[test]
    fn a_copy_has_the_frames_that_are_wanted_and_reads_little_else() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let bytes = std::fs::read(record(&dir.path().join("whole"))).expect("readable");
        assert!(bytes.len() > 4 << 20, "{} bytes: the ends must not be everything", bytes.len());
        let part = dir.path().join("part");
        let wanted = |camera: &CameraId, trigger| camera.as_str() == "h0_low" && trigger % 50 == 7;
        let read = copy(&bytes, &part, wanted).expect("copied");
        assert!(read < (2 << 20) + (600 << 10), "{read} of {} bytes were read", bytes.len());
        let reader = SessionReader::open_frames(&part).expect("readable");
        assert_eq!(reader.recordings()[0].triggers_end(), TRIGGERS);
        for trigger in (7..TRIGGERS).step_by(50) {
            let found = reader.recordings()[0].frame(1, TriggerIndex(trigger)).expect("intact");
            assert_eq!(found.expect("a frame").meta, frame(1, trigger).0);
        }
        let middle = |camera| reader.recordings()[0].frame(camera, TriggerIndex(TRIGGERS / 2 + 7));
        assert!(middle(0).is_err() && middle(1).is_ok(), "a hole is no frame");

        // Not closed: all of it is copied.
        let cut = &bytes[..bytes.len() - 9];
        let whole = dir.path().join("cut");
        assert_eq!(copy(cut, &whole, wanted), Ok(cut.len() as u64));
        assert!(std::fs::read(whole.join("segment-000.mcap")).expect("readable") == cut);
        assert_eq!(copy(&[], &dir.path().join("empty"), wanted), Ok(0));
    }

    #[test]
    fn what_the_bytes_state_about_themselves_is_not_trusted() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let bytes = std::fs::read(record(&dir.path().join("whole"))).expect("readable");
        let mut state = 5u64;
        for round in 0..50 {
            let mut damaged = bytes.clone();
            for _ in 0..40 {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                // In the index and the summary, at the end.
                let at = bytes.len() - 1 - (state >> 33) as usize % 200_000;
                damaged[at] ^= 1 << (state >> 20 & 7);
            }
            // Whatever is fetched lies within the file.
            copy(&damaged, &dir.path().join("damaged"), |_, trigger| trigger % 100 == 0)
                .unwrap_or_else(|reason| panic!("round {round}: {reason}"));
        }
    }
}
