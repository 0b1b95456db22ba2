// SPDX-License-Identifier: MIT OR Apache-2.0
//! The open chunk: small bytes in staging memory, pixels where the camera put them.
//!
//! This is what the `mcap` writer takes for its file. It accepts a seek to anything that has not left for the
//! disk, and so the chunk's placeholder is patched in memory. When the writer hands over a message whose pixels
//! were announced, at a place in the file where the disk can take them as they are, the window notes the place
//! instead of copying, and is given the block afterwards.
//!
//! Checksums of chunks and of the data section are put in here and not by the `mcap` writer, which would pass
//! over the pixels twice: the frame's own CRC-32 is known, and checksums of parts combine.

use super::direct_io::{AlignedBuffer, BLOCK, Store};
use super::disk_thread::{Batch, Command, Disk, Outcome, Reply, Run};
use crate::host::frame_memory::Block;
use crc32fast::Hasher;
use mcap::records::op;
use std::io::{self, Seek, SeekFrom, Write};
use std::ops::Range;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

/// Chunks handed to the disk and not written yet, at most: one that is written, one that waits.
pub(super) const QUEUE: usize = 2;
/// Bytes of an uncompressed chunk before its records: opcode, length, two times, size, checksum, compression, size.
pub(super) const CHUNK_HEADER: usize = 9 + 8 + 8 + 8 + 4 + 4 + 8;
/// Place of the records' checksum in those bytes.
const CHUNK_CRC: Range<usize> = 33..37;
/// Place of the checksum in the record that ends the data section.
const DATA_END_CRC: Range<usize> = 9..13;

/// How far the disk has come.
#[derive(Debug, Clone, Copy)]
pub(super) struct Milestone {
    /// Everything below this length of the file...
    pub end: u64,
    /// ...is on the medium; otherwise it is in the file.
    pub durable: bool,
    /// When the disk thread reported it.
    pub at: Instant,
}

/// Pixels that the next message ends with.
struct Offer {
    /// Their addresses, to be recognized by.
    addresses: Range<usize>,
    crc: u32,
}

/// The bytes of a segment that have not left for the disk.
///
/// A segment makes it and shares it with the `mcap` writer, which writes into it. It promises that what it hands to the
/// disk thread is a clean prefix of the file. It ends with [`Self::close`], or with [`Self::abandon`] after a failure.
pub(super) struct Window {
    disk: Disk,
    staging: AlignedBuffer,
    /// Offset in the file of the first staged byte; a multiple of [`BLOCK`].
    base: u64,
    filled: usize,
    /// Where the next byte is staged; less than `filled` while a placeholder is patched.
    cursor: usize,
    runs: Vec<Run>,
    offer: Option<Offer>,
    /// Header of a chunk that is being patched, and the checksum that belongs there.
    patching: Option<(usize, u32)>,
    /// Of the data section, up to the staged byte `hashed`.
    data_crc: Hasher,
    hashed: usize,
    /// Where the data section ends, once it does.
    data_end: Option<usize>,
    /// Length of the file with everything handed to the disk.
    sent: u64,
    writes_under_way: usize,
    syncs_under_way: usize,
    memory: Vec<(AlignedBuffer, Vec<Run>)>,
    /// What the disk has done since they were taken last.
    pub milestones: Vec<Milestone>,
    /// Length of the file after a failure.
    kept: Option<u64>,
    closed: bool,
    blocks_held: usize,
    blocks_under_way: std::collections::VecDeque<usize>,
    /// Blocks that the window held at the same time, at most.
    pub blocks_high_water: usize,
    /// Announced frames that were copied because they did not lie where the disk can take them.
    pub copied_frames: u64,
}

impl Window {
    /// An empty file behind `staging_bytes` of memory; more is taken where it does not suffice.
    pub fn new(store: Box<dyn Store>, staging_bytes: usize) -> io::Result<Self> {
        Ok(Self {
            disk: Disk::start(store)?,
            staging: AlignedBuffer::new(staging_bytes),
            base: 0,
            filled: 0,
            cursor: 0,
            runs: Vec::new(),
            offer: None,
            patching: None,
            data_crc: Hasher::new(),
            hashed: 0,
            data_end: None,
            sent: 0,
            writes_under_way: 0,
            syncs_under_way: 0,
            memory: (0..QUEUE).map(|_| (AlignedBuffer::new(staging_bytes), Vec::new())).collect(),
            milestones: Vec::new(),
            kept: None,
            closed: false,
            blocks_held: 0,
            blocks_under_way: std::collections::VecDeque::new(),
            blocks_high_water: 0,
            copied_frames: 0,
        })
    }

    /// Offset in the file of the next byte.
    pub fn position(&self) -> u64 {
        let held: usize = self.runs.iter().filter(|run| run.at <= self.cursor).map(|run| run.held).sum();
        self.base + (self.cursor + held) as u64
    }

    fn end(&self) -> u64 {
        let held: usize = self.runs.iter().map(|run| run.held).sum();
        self.base + (self.filled + held) as u64
    }

    /// The staged byte at an offset of the file; `None` where it is not staged.
    fn staged(&self, offset: u64) -> Option<usize> {
        let mut place = usize::try_from(offset.checked_sub(self.base)?).ok()?;
        for run in &self.runs {
            if place < run.at {
                break;
            }
            place = place.checked_sub(run.held).filter(|place| *place >= run.at)?;
        }
        (place <= self.filled).then_some(place)
    }

    fn check(&self) -> io::Result<()> {
        match self.kept {
            Some(_) => Err(io::Error::other("an earlier write to this segment failed")),
            None => Ok(()),
        }
    }

    /// What the next message ends with, so that the window recognizes it.
    pub fn announce(&mut self, pixels: &[u8], crc: u32) {
        let start = pixels.as_ptr() as usize;
        self.offer = Some(Offer { addresses: start..start + pixels.len(), crc });
    }

    /// Takes the memory of the message just written; it is free at once if everything was copied.
    pub fn deliver(&mut self, block: Block) {
        self.copied_frames += u64::from(self.offer.take().is_some());
        if let Some(run) = self.runs.last_mut().filter(|run| run.block.is_none()) {
            run.block = Some(block);
            self.blocks_held += 1;
            self.blocks_high_water = self.blocks_high_water.max(self.blocks_held);
        }
    }

    fn stage(&mut self, bytes: &[u8]) {
        let end = self.cursor + bytes.len();
        // One block more, for the padding of the last one.
        self.staging.reserve(end + BLOCK);
        self.staging.as_mut_slice()[self.cursor..end].copy_from_slice(bytes);
        self.cursor = end;
        self.filled = self.filled.max(end);
    }

    fn append(&mut self, bytes: &[u8]) {
        let end = bytes.as_ptr() as usize + bytes.len();
        let announced = |offer: &Offer| offer.addresses.end == end && offer.addresses.len() <= bytes.len();
        let Some(offer) = self.offer.take_if(|offer| announced(offer)) else { return self.stage(bytes) };
        let (envelope, pixels) = bytes.split_at(bytes.len() - offer.addresses.len());
        self.stage(envelope);
        let held = pixels.len() - pixels.len() % BLOCK;
        let aligned = self.filled.is_multiple_of(BLOCK) && self.cursor == self.filled;
        if aligned && held > 0 {
            let (at, pixels) = (self.filled, pixels.len());
            self.runs.push(Run { at, held, pixels, crc: offer.crc, block: None });
        } else {
            self.stage(&pixels[..held]);
            // Still there when the block is delivered: the frame was copied (small ones always are).
            self.offer = (held > 0).then_some(offer);
        }
        self.stage(&pixels[held..]);
    }

    /// CRC-32 of the file between two staged bytes, with the pixels in between.
    fn checksum(&self, from: usize, to: usize) -> Hasher {
        let bytes = self.staging.as_slice();
        let mut hasher = Hasher::new();
        let mut done = from;
        for run in self.runs.iter().filter(|run| run.at > from && run.at <= to) {
            hasher.update(&bytes[done..run.at]);
            hasher.combine(&Hasher::new_with_initial_len(run.crc, run.pixels as u64));
            done = run.at + run.pixels - run.held;
        }
        hasher.update(&bytes[done..to]);
        hasher
    }

    /// What comes next ends the data section: its checksum will be put in there.
    pub fn end_data(&mut self) {
        self.data_end = Some(self.filled);
    }

    /// Takes note of what the disk has done.
    pub fn poll(&mut self) -> io::Result<()> {
        while let Ok(reply) = self.disk.replies.try_recv() {
            self.note(reply)?;
        }
        self.check()
    }

    fn wait(&mut self) -> io::Result<()> {
        let gone = |_| io::Error::other("the disk thread is gone");
        let reply = self.disk.replies.recv().map_err(gone).inspect_err(|_| {
            self.kept.get_or_insert(self.sent);
        })?;
        self.note(reply)
    }

    fn note(&mut self, reply: Reply) -> io::Result<()> {
        let Reply { outcome, at, memory } = reply;
        if let Some(memory) = memory {
            self.blocks_held -= self.blocks_under_way.pop_front().unwrap_or(0);
            self.memory.push(memory);
        }
        match outcome {
            Outcome::Written(end) => {
                self.writes_under_way = self.writes_under_way.saturating_sub(1);
                self.milestones.push(Milestone { end, durable: false, at });
                Ok(())
            }
            Outcome::Durable(end) => {
                self.syncs_under_way = self.syncs_under_way.saturating_sub(1);
                self.milestones.push(Milestone { end, durable: true, at });
                Ok(())
            }
            Outcome::Failed { error, kept } => {
                self.kept.get_or_insert(kept);
                Err(error)
            }
        }
    }

    fn send(&mut self, command: Command) -> io::Result<()> {
        let gone = |_| io::Error::other("the disk thread is gone");
        self.disk.commands.send(command).map_err(gone).inspect_err(|_| {
            self.kept.get_or_insert(self.sent);
        })
    }

    /// Waits for everything under way.
    pub fn settle(&mut self) -> io::Result<()> {
        self.poll()?;
        while self.writes_under_way + self.syncs_under_way > 0 {
            self.wait()?;
        }
        Ok(())
    }

    /// Hands everything to the disk, as soon as the queue has a place; the last block is padded with zeros.
    pub fn commit(&mut self) -> io::Result<()> {
        self.poll()?;
        let end = self.end();
        if end == self.sent {
            return Ok(());
        }
        while self.writes_under_way >= QUEUE {
            self.wait()?;
        }
        self.data_crc.combine(&self.checksum(self.hashed, self.data_end.unwrap_or(self.filled)));
        if let Some(at) = self.data_end.take() {
            let crc = self.data_crc.clone().finalize().to_le_bytes();
            self.staging.as_mut_slice()[at + DATA_END_CRC.start..at + DATA_END_CRC.end].copy_from_slice(&crc);
        }
        let (filled, whole) = (self.filled, self.filled - self.filled % BLOCK);
        let staged = filled.next_multiple_of(BLOCK);
        self.staging.as_mut_slice()[filled..staged].fill(0);
        let (mut next, runs) = self.memory.pop().unwrap_or_else(|| (AlignedBuffer::new(BLOCK), Vec::new()));
        next.reserve(BLOCK);
        next.as_mut_slice()[..filled - whole].copy_from_slice(&self.staging.as_slice()[whole..filled]);
        let staging = std::mem::replace(&mut self.staging, next);
        let runs = std::mem::replace(&mut self.runs, runs);
        self.blocks_under_way.push_back(runs.len());
        self.send(Command::Write(Batch { staging, staged, runs, offset: self.base, end }))?;
        self.writes_under_way += 1;
        self.sent = end;
        self.base = end - (filled - whole) as u64;
        self.filled -= whole;
        (self.cursor, self.hashed) = (self.filled, self.filled);
        Ok(())
    }

    /// Asks for an `fdatasync` of everything handed over; waits for the one before, if that is not over.
    pub fn request_sync(&mut self) -> io::Result<()> {
        self.poll()?;
        while self.syncs_under_way > 0 {
            self.wait()?;
        }
        self.send(Command::Sync)?;
        self.syncs_under_way += 1;
        Ok(())
    }

    /// Commits, gives the file its true length, and returns when it is on the medium.
    pub fn close(&mut self) -> io::Result<()> {
        self.commit()?;
        self.closed = true;
        self.send(Command::Close)?;
        self.syncs_under_way += 1;
        self.settle()
    }

    /// Makes sure that nothing more is written; returns the length of what stays in the file.
    pub fn abandon(&mut self) -> u64 {
        self.offer = None;
        if self.kept.is_none() && self.send(Command::Abandon).is_ok() {
            // Ends at the latest with the answer to this command, which is never good.
            while self.kept.is_none() && self.wait().is_ok() {}
        }
        self.kept.unwrap_or(0)
    }
}

impl Drop for Window {
    fn drop(&mut self) {
        if !self.closed && self.kept.is_none() {
            // The segment was dropped before `finish`: what there is is kept. An error cannot be reported any more.
            let _ = self.close();
        }
    }
}

/// The window as the `mcap` writer holds it.
pub(super) struct Handle(pub Arc<Mutex<Window>>);

/// A panic in between leaves counts, not invariants, behind: the window stays usable.
pub(super) fn lock(window: &Mutex<Window>) -> MutexGuard<'_, Window> {
    window.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Write for Handle {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let mut window = lock(&self.0);
        window.check()?;
        window.append(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        lock(&self.0).commit()
    }
}

impl Seek for Handle {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        let mut window = lock(&self.0);
        let target = match to {
            SeekFrom::Start(offset) => Some(offset),
            SeekFrom::Current(by) => window.position().checked_add_signed(by),
            SeekFrom::End(by) => window.end().checked_add_signed(by),
        };
        let place = target.and_then(|target| Some((target, window.staged(target)?)));
        let (target, place) = place.ok_or_else(|| io::Error::other("seek to what has left the window"))?;
        let filled = window.filled;
        if place + CHUNK_HEADER <= filled && window.cursor == filled {
            // The chunk that begins there is complete and gets its header now.
            let crc = window.checksum(place + CHUNK_HEADER, filled).finalize();
            window.patching = Some((place, crc));
        } else if place == filled
            && let Some((header, crc)) = window.patching.take()
        {
            let header = &mut window.staging.as_mut_slice()[header..header + CHUNK_HEADER];
            if header[0] == op::CHUNK {
                header[CHUNK_CRC].copy_from_slice(&crc.to_le_bytes());
            }
        }
        window.cursor = place;
        Ok(target)
    }

    fn stream_position(&mut self) -> io::Result<u64> {
        Ok(lock(&self.0).position())
    }
}
