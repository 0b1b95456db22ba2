// SPDX-License-Identifier: MIT OR Apache-2.0
//! A segment as a file that may fail while it is read.
//!
//! Recordings are read with calls that return errors, never through a mapping: a bad sector, or a file that is cut
//! meanwhile, would end the program with a signal. What cannot be read is remembered and not tried again, because a
//! disk takes seconds for each attempt; everything else is used. `docs/design/recording.md`, "Reading", has the rules.

use crate::base::regular;
use crc32fast::Hasher;
use serde::Serialize;
use std::fs::File;
use std::io;
use std::ops::Range;
use std::os::unix::fs::FileExt;
use std::path::Path;
use std::sync::{Mutex, MutexGuard, PoisonError};

/// Smallest unit that is given up, bytes: disks and page cache fail in units of this size at least.
const BLOCK: usize = 4096;
/// Bytes in a row that cannot be read behind which only one block in each [`STRIDE`] is tried.
const PATIENCE: usize = 64 * BLOCK;
/// Bytes between the blocks that are tried behind [`PATIENCE`]: a large bad area takes seconds, not hours.
const STRIDE: usize = 1 << 20;
/// Most unreadable places of a file: behind the last one the file is given up.
const MAX_PLACES: usize = 1000;
/// Bytes that are read at once where a range is passed through.
const PIECE: usize = 1 << 20;
/// Bytes that are read at once behind a jump: the rest of a frame and the envelope of the next lie in two blocks.
const FIRST_READ: usize = 2 * BLOCK;

/// Bytes of a file that cannot be read.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, thiserror::Error)]
#[error("bytes {from} to {to} cannot be read: {reason}")]
pub struct BadRange {
    pub from: usize,
    pub to: usize,
    pub reason: String,
}

/// An opened regular file of the length that it had then.
#[derive(Debug)]
pub struct SegmentFile {
    file: File,
    length: usize,
    /// In order, apart from each other.
    bad: Mutex<Vec<BadRange>>,
    /// Bytes that were read: how much a file costs is counted, not timed.
    #[cfg(test)]
    pub read: std::sync::atomic::AtomicUsize,
}

impl SegmentFile {
    /// Opens a regular file, or a link to one. Never waits, as opening a pipe without a writer would.
    ///
    /// # Errors
    /// The error of the system, or what is there instead of a regular file.
    pub fn open(path: &Path) -> io::Result<Self> {
        let file = regular::open(path)?;
        let metadata = file.metadata()?;
        let length = usize::try_from(metadata.len()).map_err(io::Error::other)?;
        Ok(Self {
            file,
            length,
            bad: Mutex::new(Vec::new()),
            #[cfg(test)]
            read: Default::default(),
        })
    }

    /// Bytes that it had when it was opened.
    pub fn len(&self) -> usize {
        self.length
    }

    /// The bytes that could not be read so far.
    pub fn bad_ranges(&self) -> Vec<BadRange> {
        self.lock().clone()
    }

    fn lock(&self) -> MutexGuard<'_, Vec<BadRange>> {
        self.bad.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Reads `into` from `at` on, all of it. After an error what lies before the bad range has been read.
    pub fn read(&self, at: usize, into: &mut [u8]) -> Result<(), BadRange> {
        let there = into.len().min(self.length.saturating_sub(at));
        let end = at + there;
        let known = self.lock().iter().find(|bad| bad.from < end && bad.to > at).cloned();
        let readable = known.as_ref().map_or(there, |bad| bad.from.saturating_sub(at));
        self.ask(at, &mut into[..readable])?;
        match known {
            Some(known) => Err(known),
            None if there < into.len() => {
                let (from, to) = (end, at.saturating_add(into.len()));
                Err(BadRange { from, to, reason: format!("the file ends at byte {}", self.length) })
            }
            None => Ok(()),
        }
    }

    fn ask(&self, at: usize, into: &mut [u8]) -> Result<(), BadRange> {
        let (mut done, mut at_most) = (0, into.len());
        while done < into.len() {
            let offset = at + done;
            let end = into.len().min(done.saturating_add(at_most));
            match self.file.read_at(&mut into[done..end], offset as u64) {
                Ok(0) => {
                    let reason = format!(
                        "the file has become shorter since it was opened: it ends before byte {}",
                        offset + 1
                    );
                    return Err(self.give_up(BadRange { from: offset, to: self.length, reason }));
                }
                Ok(read) => {
                    #[cfg(test)]
                    self.read.fetch_add(read, std::sync::atomic::Ordering::Relaxed);
                    (done, at_most) = (done + read, into.len());
                }
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => {
                    let block = offset - offset % BLOCK;
                    let rest = block + BLOCK - offset;
                    if end - done > rest {
                        // The call fails as a whole for one bad block of many: the blocks are read one by one.
                        at_most = rest;
                        continue;
                    }
                    let to = (block + BLOCK).min(self.length);
                    return Err(self.give_up(BadRange { from: block, to, reason: error.to_string() }));
                }
            }
        }
        Ok(())
    }

    /// Remembers what cannot be read.
    fn give_up(&self, mut new: BadRange) -> BadRange {
        let mut bad = self.lock();
        let place = bad.partition_point(|known| known.from < new.from);
        if let Some(known) = bad.get(place).filter(|known| known.from == new.from) {
            // Another thread has read it at the same time.
            return known.clone();
        }
        if bad.len() >= MAX_PLACES {
            new.to = self.length;
            new.reason = format!("{}; more is not tried behind {MAX_PLACES} such places", new.reason);
            bad.truncate(place);
        }
        let before = place.checked_sub(1).and_then(|place| bad.get_mut(place));
        match before.filter(|known| known.to >= new.from && known.reason == new.reason) {
            Some(known) => {
                known.to = known.to.max(new.to);
                if known.to - known.from > PATIENCE {
                    known.to = (known.to + STRIDE - BLOCK).min(self.length);
                }
                new.to = known.to;
            }
            None => bad.insert(place, new.clone()),
        }
        new
    }

    /// As [`Self::read`], with zeros where nothing can be read; returns whether everything was. For bytes that a
    /// checksum proves.
    pub fn read_with_holes(&self, at: usize, into: &mut [u8]) -> bool {
        let (mut done, mut whole) = (0, true);
        while done < into.len() {
            let Err(bad) = self.read(at + done, &mut into[done..]) else { break };
            let hole = bad.from.saturating_sub(at).max(done)..(bad.to - at).min(into.len());
            done = hole.end;
            into[hole].fill(0);
            whole = false;
        }
        whole
    }

    /// Hands the bytes of a range to `each`, piece by piece, with zeros where nothing can be read; returns whether
    /// everything was.
    pub fn pass(&self, range: Range<usize>, mut each: impl FnMut(&[u8])) -> bool {
        let mut piece = vec![0; PIECE.min(range.len())];
        let (mut at, mut whole) = (range.start, true);
        while at < range.end {
            let length = piece.len().min(range.end - at);
            whole &= self.read_with_holes(at, &mut piece[..length]);
            each(&piece[..length]);
            at += length;
        }
        whole
    }

    /// CRC-32 of a range; `None` where part of it cannot be read.
    pub fn checksum(&self, range: Range<usize>) -> Option<Hasher> {
        let mut hasher = Hasher::new();
        self.pass(range, |bytes| hasher.update(bytes)).then_some(hasher)
    }

    /// Whether everything from `at` on is there and zero: what a sync leaves behind the last record.
    pub fn is_zero_from(&self, at: usize) -> bool {
        let mut pieces = Pieces::new(self);
        let mut at = at;
        while at < self.length {
            let end = (at + pieces.ahead()).min(self.length);
            match pieces.get(at..end) {
                Ok(bytes) if bytes.iter().all(|byte| *byte == 0) => at = end,
                _ => return false,
            }
        }
        true
    }
}

/// A file's bytes, of which a piece is in memory: for reading small records one after the other.
#[derive(Debug)]
pub struct Pieces<'a> {
    file: &'a SegmentFile,
    /// Bytes of the file from `start` on.
    piece: Vec<u8>,
    start: usize,
    /// Bytes that the next read requests, as long as reads continue each other.
    ahead: usize,
}

impl<'a> Pieces<'a> {
    /// A reader of which nothing is in memory yet.
    pub fn new(file: &'a SegmentFile) -> Self {
        Self { file, piece: Vec::new(), start: 0, ahead: FIRST_READ }
    }

    /// The file that the pieces are of.
    pub fn file(&self) -> &'a SegmentFile {
        self.file
    }

    /// Bytes that are read at once, at least.
    pub fn ahead(&self) -> usize {
        self.ahead
    }

    /// The bytes of a range; those around it are read in the same call.
    pub fn get(&mut self, range: Range<usize>) -> Result<&[u8], BadRange> {
        let held = self.start..self.start + self.piece.len();
        if range.start < held.start || range.end > held.end {
            let continues = range.start >= held.start && range.start <= held.end && !self.piece.is_empty();
            self.ahead = if continues { (2 * self.ahead).min(PIECE) } else { FIRST_READ };
            self.load(&range)?;
        }
        let from = range.start - self.start;
        Ok(&self.piece[from..from + range.len()])
    }

    fn load(&mut self, range: &Range<usize>) -> Result<(), BadRange> {
        let rest = self.file.len().saturating_sub(range.start);
        let length = range.len().max(self.ahead.min(rest));
        self.start = range.start;
        self.piece.resize(length, 0);
        if let Err(bad) = self.file.read(self.start, &mut self.piece) {
            self.piece.truncate(bad.from.saturating_sub(self.start));
            if self.piece.len() < range.len() {
                return Err(bad);
            }
        }
        Ok(())
    }
}

#[cfg(test)]
pub fn of_bytes(bytes: &[u8]) -> SegmentFile {
    let file = tempfile::tempfile().expect("a temporary file");
    file.write_all_at(bytes, 0).expect("written");
    SegmentFile { file, length: bytes.len(), bad: Mutex::new(Vec::new()), read: Default::default() }
}

#[cfg(test)]
mod tests {
    use super::{BLOCK, BadRange, Pieces, SegmentFile, of_bytes};
    use proptest::prelude::*;
    use std::os::unix::net::UnixListener;

    #[test]
    fn only_regular_files_are_opened_and_nothing_is_waited_for() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let path = |name: &str| dir.path().join(name);
        let pipe = std::ffi::CString::new(path("pipe").to_str().expect("UTF-8")).expect("no zeros");
        // SAFETY: a C string that lives for the duration of the call.
        assert_eq!(unsafe { libc::mkfifo(pipe.as_ptr(), 0o600) }, 0);
        let _socket = UnixListener::bind(path("socket")).expect("a socket");
        std::os::unix::fs::symlink(path("loop"), path("loop")).expect("a link");
        std::fs::write(path("file"), b"four").expect("written");
        std::os::unix::fs::symlink(path("file"), path("link")).expect("a link");
        for (name, expected) in [
            ("pipe", "found a pipe"),
            ("socket", "found a socket"),
            (".", "found a directory"),
            ("loop", "symbolic links"),
            ("nothing", "No such file"),
        ] {
            let error = SegmentFile::open(&path(name)).expect_err(name).to_string();
            assert!(error.contains(expected), "{name}: {error}");
        }
        let error = SegmentFile::open("/dev/null".as_ref()).expect_err("a device").to_string();
        assert!(error.contains("found a device"), "{error}");
        assert_eq!(SegmentFile::open(&path("link")).expect("a link to a file").len(), 4);
    }

    #[test]
    fn a_file_that_becomes_shorter_is_read_as_far_as_it_goes() {
        let file = of_bytes(&[7; 3 * BLOCK]);
        file.file.set_len(BLOCK as u64 + 10).expect("cut");
        let mut bytes = vec![1; 2 * BLOCK];
        assert!(!file.read_with_holes(0, &mut bytes));
        assert!(bytes[..BLOCK + 10].iter().all(|b| *b == 7) && bytes[BLOCK + 10..].iter().all(|b| *b == 0));
        let bad = file.bad_ranges();
        assert_eq!(bad.iter().map(|bad| (bad.from, bad.to)).collect::<Vec<_>>(), [(BLOCK + 10, 3 * BLOCK)]);
        assert!(bad[0].to_string().contains("has become shorter"), "{}", bad[0]);
        let mut pieces = Pieces::new(&file);
        assert_eq!(pieces.get(5..BLOCK).expect("there").len(), BLOCK - 5);
        assert_eq!(pieces.get(BLOCK..BLOCK + 11).expect_err("gone"), bad[0]);
        assert!(file.checksum(0..BLOCK).is_some() && file.checksum(0..2 * BLOCK).is_none());
    }

    #[test]
    fn what_is_bad_is_bounded() {
        let file = of_bytes(&vec![7; 5000 * BLOCK]);
        let note = |block: usize| {
            let (from, reason) = (block * BLOCK, "broken".to_owned());
            file.give_up(BadRange { from, to: from + BLOCK, reason })
        };
        // A long run is tried less and less often.
        let mut tries = 0;
        let mut at = 0;
        while at < 2000 {
            at = note(at).to / BLOCK;
            tries += 1;
        }
        assert!((64..80).contains(&tries), "{tries}");
        assert_eq!(file.bad_ranges().len(), 1);
        (0..1000).for_each(|n| drop(note(at + 1 + 2 * n)));
        let bad = file.bad_ranges();
        assert!(bad.len() <= 1001, "{}", bad.len());
        assert_eq!(bad.last().map(|bad| bad.to), Some(5000 * BLOCK));
        assert!(bad.windows(2).all(|pair| pair[0].to <= pair[1].from), "in order and apart");
    }

    proptest! {
        #[test]
        fn pieces_are_the_file(ranges in prop::collection::vec((0usize..40_000, 0usize..20_000), 1..40)) {
            let bytes: Vec<u8> = (0..40_000u32).map(|n| (n % 251) as u8).collect();
            let file = of_bytes(&bytes);
            let mut pieces = Pieces::new(&file);
            for (start, length) in ranges {
                let range = start..start + length;
                prop_assert_eq!(pieces.get(range.clone()).ok(), bytes.get(range));
            }
        }
    }
}
