// SPDX-License-Identifier: MIT OR Apache-2.0
//! The thread that writes one segment, so that the recorder never waits for the disk unless the queue is full.
//!
//! Commands are carried out in order, one at a time: a chunk is several megabytes in one `pwritev`, which the
//! kernel cuts into requests that are in flight together, so the device is busy all the while; and the next
//! chunk already waits in the queue. Order is what keeps the file a clean prefix.

use super::direct_io::{AlignedBuffer, Store};
use crate::host::frame_memory::Block;
use crossbeam_channel::{Receiver, Sender, unbounded};
use std::io::{self, IoSlice};
use std::time::Instant;

/// Pixels that go to the disk from the frame's own memory.
pub(super) struct Run {
    /// They come before this byte of the staging memory; a multiple of [`super::direct_io::BLOCK`].
    pub at: usize,
    /// How many of them; a multiple of [`super::direct_io::BLOCK`]. The rest is staged, from `at` on.
    pub held: usize,
    /// How many pixels the frame has.
    pub pixels: usize,
    /// CRC-32 of all its pixels.
    pub crc: u32,
    /// The block that has them; `None` only until the window has been given it.
    pub block: Option<Block>,
}

/// Complete records on their way to the disk.
pub(super) struct Batch {
    pub staging: AlignedBuffer,
    /// Bytes of `staging`, the padding of the last block included.
    pub staged: usize,
    pub runs: Vec<Run>,
    /// Offset in the file; a multiple of the block size.
    pub offset: u64,
    /// Length of the file with it, without the padding.
    pub end: u64,
}

/// A command to the thread; they are carried out in order.
pub(super) enum Command {
    Write(Batch),
    Sync,
    /// True length, and everything on the medium.
    Close,
    /// Nothing more will come: keep what was written.
    Abandon,
}

/// The result of a command.
pub(super) enum Outcome {
    /// Everything below is in the file.
    Written(u64),
    /// Everything below is on the medium.
    Durable(u64),
    /// This command and all after it are not carried out. The file was cut to `kept` bytes.
    Failed { error: io::Error, kept: u64 },
}

/// The answer to one command, in order.
pub(super) struct Reply {
    pub outcome: Outcome,
    pub at: Instant,
    /// Memory of a batch, for the next one.
    pub memory: Option<(AlignedBuffer, Vec<Run>)>,
}

/// The channels to the thread of a segment, which its window holds. The thread ends when they are dropped.
pub(super) struct Disk {
    pub commands: Sender<Command>,
    pub replies: Receiver<Reply>,
}

impl Disk {
    /// Starts the thread. The channels have no bound of their own: the window counts what is under way.
    pub fn start(store: Box<dyn Store>) -> io::Result<Self> {
        let (commands, orders) = unbounded::<Command>();
        let (answers, replies) = unbounded::<Reply>();
        let mut worker = Worker { store, written: 0, durable: 0, kept: None };
        std::thread::Builder::new().name("segment-disk".to_owned()).spawn(move || {
            crate::host::realtime::enter_configured("disk");
            for command in orders {
                if answers.send(worker.carry_out(command)).is_err() {
                    break;
                }
            }
        })?;
        Ok(Self { commands, replies })
    }
}

struct Worker {
    store: Box<dyn Store>,
    /// True length of what the file holds.
    written: u64,
    /// And of what survives a power cut.
    durable: u64,
    /// Set by the first failure.
    kept: Option<u64>,
}

impl Worker {
    fn carry_out(&mut self, command: Command) -> Reply {
        let mut memory = None;
        let result = match command {
            _ if self.kept.is_some() => Err(io::Error::other("an earlier write to this segment failed")),
            Command::Write(mut batch) => {
                let result = self.write(&batch);
                // From here on the pool may give the blocks to the cameras again.
                batch.runs.clear();
                memory = Some((batch.staging, batch.runs));
                result.map(|()| self.written = batch.end).map(|()| Outcome::Written(self.written))
            }
            Command::Sync => self.sync(),
            Command::Close => self.store.set_len(self.written).and_then(|()| self.sync()),
            Command::Abandon => Err(io::Error::other("the segment is abandoned")),
        };
        let outcome = result.unwrap_or_else(|error| Outcome::Failed { error, kept: self.cut() });
        Reply { outcome, at: Instant::now(), memory }
    }

    fn write(&mut self, batch: &Batch) -> io::Result<()> {
        let staging = batch.staging.as_slice();
        let mut parts = Vec::with_capacity(2 * batch.runs.len() + 1);
        let mut done = 0;
        for run in &batch.runs {
            let block = run.block.as_ref().ok_or_else(|| io::Error::other("a frame without its memory"))?;
            parts.push(IoSlice::new(&staging[done..run.at]));
            parts.push(IoSlice::new(&block.pixels()[..run.held]));
            done = run.at;
        }
        parts.push(IoSlice::new(&staging[done..batch.staged]));
        parts.retain(|part| !part.is_empty());
        self.store.write_at(batch.offset, &mut parts)
    }

    /// After a failed `fdatasync` the kernel reports the error once and may forget the pages: what was written
    /// since the last good one may be there, or not. So it counts as lost (see [`Self::cut`]).
    fn sync(&mut self) -> io::Result<Outcome> {
        if let Err(error) = self.store.sync() {
            self.written = self.durable;
            return Err(error);
        }
        self.durable = self.written;
        Ok(Outcome::Durable(self.durable))
    }

    /// After a failure: the file ends with what can be trusted, because the frames behind that are reported
    /// lost and must not reappear. If this fails as well, nothing more can be done.
    fn cut(&mut self) -> u64 {
        if let Some(kept) = self.kept {
            return kept;
        }
        let written = self.written;
        if self.store.set_len(written).and_then(|()| self.store.sync()).is_ok() {
            self.durable = written;
        } else if self.durable < written {
            let _ = self.store.set_len(self.durable);
        }
        self.kept = Some(self.durable);
        self.durable
    }
}
