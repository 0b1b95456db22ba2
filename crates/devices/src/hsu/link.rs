// SPDX-License-Identifier: MIT OR Apache-2.0
//! Requests and answers over a byte stream: framing, request ids, timeouts, retries.
//!
//! One request at a time is under way, because the unit remembers only the last answer of a link: a repeated
//! request is then answered again instead of being carried out twice. A thread reads; answers go to whoever
//! asked, everything else to a callback.

use crate::base::time::monotonic_ns;
use crossbeam_channel::{Receiver, RecvTimeoutError, Sender, bounded};
use hsu_firmware_proto::frame::{self, Decoder};
use hsu_firmware_proto::{HostToUnit, MAX_MESSAGE, Request, UnitToHost};
use std::hash::{BuildHasher, RandomState};
use std::io::{self, ErrorKind, Read, Write};
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Answers that nobody has collected; only stale ones ever queue up.
const ANSWERS: usize = 16;

/// How long to wait, and how often to ask.
#[derive(Debug, Clone, Copy)]
pub struct Patience {
    /// For one answer.
    pub answer: Duration,
    /// Of the same request.
    pub attempts: u32,
}

/// Why there is no answer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum LinkError {
    /// All attempts went unanswered.
    NoAnswer {
        /// How many.
        attempts: u32,
        /// For how long altogether.
        waited: Duration,
    },
    /// The stream broke.
    Broken(String),
}

/// An answer with the times that frame it.
#[derive(Debug, Clone, Copy)]
pub struct Answer {
    /// What the unit said.
    pub message: UnitToHost,
    /// Just before the request was written, for the last time.
    pub sent: Instant,
    /// Just after the answer's last byte was read.
    pub received: Instant,
}

#[derive(Debug, Default)]
struct Shared {
    stop: AtomicBool,
    /// Of frames and messages that could not be read.
    bad_frames: AtomicU32,
    /// When a message was last read, CLOCK_MONOTONIC, ns.
    heard_ns: AtomicU64,
    broken: Mutex<Option<String>>,
}

struct Asking {
    writer: Box<dyn Write + Send>,
    answers: Receiver<(UnitToHost, Instant)>,
    next_id: u32,
}

/// A link that is being read.
pub struct Link {
    asking: Mutex<Asking>,
    shared: Arc<Shared>,
    reader: Option<JoinHandle<()>>,
}

impl std::fmt::Debug for Link {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Link").field("shared", &self.shared).finish_non_exhaustive()
    }
}

impl Link {
    /// Starts reading. `reader` must return `TimedOut`, `WouldBlock` or `Interrupted` now and then when
    /// nothing comes, or the link cannot be closed. `on_message` gets every message that is not an answer,
    /// in order, on the reading thread; it must not ask anything itself.
    pub fn start(
        reader: impl Read + Send + 'static,
        writer: impl Write + Send + 'static,
        on_message: impl FnMut(UnitToHost) + Send + 'static,
    ) -> io::Result<Self> {
        let shared = Arc::new(Shared::default());
        let (to_asker, answers) = bounded(ANSWERS);
        shared.heard_ns.store(monotonic_ns(Instant::now()), Ordering::Relaxed);
        let for_thread = shared.clone();
        let reader = std::thread::Builder::new()
            .name("hsu-read".into())
            .spawn(move || read_all(reader, &for_thread, &to_asker, on_message))?;
        // Stale answers to an earlier process on the same device must not look like ours.
        let next_id = RandomState::new().hash_one(()) as u32;
        let asking = Mutex::new(Asking { writer: Box::new(writer), answers, next_id });
        Ok(Self { asking, shared, reader: Some(reader) })
    }

    /// Asks until there is an answer or patience ends.
    pub fn ask(&self, request: Request, patience: Patience) -> Result<Answer, LinkError> {
        self.exchange(self.asking.lock().unwrap_or_else(PoisonError::into_inner), request, patience)
    }

    /// Asks, unless another request is under way: then `None`.
    pub fn ask_if_idle(&self, request: Request, patience: Patience) -> Option<Result<Answer, LinkError>> {
        Some(self.exchange(self.asking.try_lock().ok()?, request, patience))
    }

    fn exchange(
        &self,
        mut asking: MutexGuard<'_, Asking>,
        request: Request,
        patience: Patience,
    ) -> Result<Answer, LinkError> {
        let request_id = asking.next_id;
        asking.next_id = request_id.wrapping_add(1);
        let mut message = [0; MAX_MESSAGE];
        let length = HostToUnit { request_id, request }.encode(&mut message);
        let mut framed = [0; frame::MAX_FRAME];
        let length = frame::encode(&message[..length], &mut framed);
        // What is still there answers an earlier request that has been given up.
        while asking.answers.try_recv().is_ok() {}
        let begun = Instant::now();
        for _ in 0..patience.attempts {
            let sent = Instant::now();
            match asking.writer.write_all(&framed[..length]) {
                // The line takes nothing: the other end does not read. That is a silent device.
                Err(error) if is_pause(&error) => {}
                Err(error) => return Err(LinkError::Broken(error.to_string())),
                Ok(()) => {}
            }
            let deadline = sent + patience.answer;
            loop {
                match asking.answers.recv_deadline(deadline) {
                    Ok((message, received)) if message.request_id() == Some(request_id) => {
                        return Ok(Answer { message, sent, received });
                    }
                    Ok(_) => {}
                    Err(RecvTimeoutError::Timeout) => break,
                    Err(RecvTimeoutError::Disconnected) => return Err(self.broken()),
                }
            }
        }
        Err(LinkError::NoAnswer { attempts: patience.attempts, waited: begun.elapsed() })
    }

    fn broken(&self) -> LinkError {
        let cause = self.shared.broken.lock().unwrap_or_else(PoisonError::into_inner).clone();
        LinkError::Broken(cause.unwrap_or_else(|| "the reading thread ended".into()))
    }

    /// How long no message has come, of whatever kind.
    pub fn quiet_for(&self) -> Duration {
        let heard = self.shared.heard_ns.load(Ordering::Relaxed);
        Duration::from_nanos(monotonic_ns(Instant::now()).saturating_sub(heard))
    }

    /// Frames and messages from the unit that could not be read.
    pub fn bad_frames(&self) -> u32 {
        self.shared.bad_frames.load(Ordering::Relaxed)
    }
}

impl Drop for Link {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Relaxed);
        if let Some(reader) = self.reader.take() {
            // A panic in the reader has already been printed; a drop must not add another.
            let _ = reader.join();
        }
    }
}

fn is_pause(error: &io::Error) -> bool {
    matches!(error.kind(), ErrorKind::TimedOut | ErrorKind::WouldBlock | ErrorKind::Interrupted)
}

fn read_all(
    mut reader: impl Read,
    shared: &Shared,
    answers: &Sender<(UnitToHost, Instant)>,
    mut on_message: impl FnMut(UnitToHost),
) {
    let mut decoder = Decoder::new();
    let mut unreadable = 0u32;
    let mut buffer = [0; 4096];
    while !shared.stop.load(Ordering::Relaxed) {
        let bytes = match reader.read(&mut buffer) {
            Ok(0) => return set_broken(shared, "the device was closed at the other end"),
            Ok(length) => &buffer[..length],
            Err(error) if is_pause(&error) => continue,
            Err(error) => return set_broken(shared, &error.to_string()),
        };
        let received = Instant::now();
        decoder.feed(bytes, |message| {
            let Ok(message) = UnitToHost::decode(message) else {
                unreadable = unreadable.saturating_add(1);
                return;
            };
            shared.heard_ns.store(monotonic_ns(received), Ordering::Relaxed);
            match message.request_id() {
                // A full queue holds stale answers only; the asker will ask again.
                Some(_) => drop(answers.try_send((message, received))),
                None => on_message(message),
            }
        });
        shared.bad_frames.store(decoder.errors().total().saturating_add(unreadable), Ordering::Relaxed);
    }
}

fn set_broken(shared: &Shared, cause: &str) {
    *shared.broken.lock().unwrap_or_else(PoisonError::into_inner) = Some(cause.to_owned());
}
