// SPDX-License-Identifier: MIT OR Apache-2.0
//! A byte stream within the process, in place of the serial line.

use crossbeam_channel::{Receiver, RecvTimeoutError, Sender, TrySendError, bounded};
use std::io::{self, ErrorKind, Read, Write};
use std::time::Duration;

/// Room for messages: over a second of triggers at any rate.
const MESSAGES: usize = 4096;
/// Longest wait of a reader before it checks whether to stop.
const READ_PAUSE: Duration = Duration::from_millis(20);

/// The end of a pipe where bytes come out.
pub(super) struct PipeReader {
    messages: Receiver<Vec<u8>>,
    rest: Vec<u8>,
}

/// The end of a pipe where bytes go in.
#[derive(Clone)]
pub(super) struct PipeWriter(Sender<Vec<u8>>);

/// Makes a pipe, and gives its two ends.
pub(super) fn pipe() -> (PipeReader, PipeWriter) {
    let (writer, messages) = bounded(MESSAGES);
    (PipeReader { messages, rest: Vec::new() }, PipeWriter(writer))
}

impl PipeReader {
    /// The next bytes, empty after this time; `None`: the other end was dropped.
    pub(super) fn wait(&self, patience: Duration) -> Option<Vec<u8>> {
        match self.messages.recv_timeout(patience) {
            Ok(bytes) => Some(bytes),
            Err(RecvTimeoutError::Timeout) => Some(Vec::new()),
            Err(RecvTimeoutError::Disconnected) => None,
        }
    }
}

impl Read for PipeReader {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        if self.rest.is_empty() {
            match self.wait(READ_PAUSE) {
                Some(bytes) if bytes.is_empty() => return Err(ErrorKind::TimedOut.into()),
                Some(bytes) => self.rest = bytes,
                None => return Ok(0),
            }
        }
        let length = self.rest.len().min(buffer.len());
        buffer[..length].copy_from_slice(&self.rest[..length]);
        self.rest.drain(..length);
        Ok(length)
    }
}

impl Write for PipeWriter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match self.0.try_send(bytes.to_vec()) {
            Ok(()) => Ok(bytes.len()),
            Err(TrySendError::Full(_)) => Err(ErrorKind::WouldBlock.into()),
            Err(TrySendError::Disconnected(_)) => Err(ErrorKind::BrokenPipe.into()),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
