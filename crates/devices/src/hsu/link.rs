// SPDX-License-Identifier: MIT OR Apache-2.0
//! Requests and answers over a byte stream: framing, request ids, timeouts, retries.
//!
//! One request at a time is under way, because the unit remembers only the last answer of a link: a repeated
//! request is then answered again instead of being carried out twice. A thread reads; answers go to the thread that
//! sent the request, everything else to a callback.

use super::error::HsuError;
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

/// Room for answers; only late answers to earlier requests ever queue up.
const ANSWERS: usize = 16;

/// How long a request waits for its answer, and how often it is sent.
#[derive(Debug, Clone, Copy)]
pub struct Patience {
    /// Longest wait for the answer to one attempt.
    pub answer: Duration,
    /// How often the same request is sent.
    pub attempts: u32,
}

/// Timeouts of the host towards the unit.
#[derive(Debug, Clone, Copy)]
pub struct HsuTimeouts {
    /// Longest wait for an answer, and the number of attempts.
    pub patience: Patience,
    /// Time between two heartbeats to the unit; well below [`HsuTiming::host_silence`](super::HsuTiming::host_silence).
    pub heartbeat: Duration,
}

impl Default for HsuTimeouts {
    fn default() -> Self {
        let patience = Patience { answer: Duration::from_millis(250), attempts: 4 };
        Self { patience, heartbeat: Duration::from_millis(400) }
    }
}

/// An answer with the times before and after it.
#[derive(Debug, Clone, Copy)]
pub struct Answer {
    /// The message of the unit.
    pub message: UnitToHost,
    /// Just before the request was written for the last time.
    pub sent: Instant,
    /// Just after the answer's last byte was read.
    pub received: Instant,
}

#[derive(Debug, Default)]
struct Shared {
    stop: AtomicBool,
    /// Number of frames and messages that could not be read.
    bad_frames: AtomicU32,
    /// When the first request was sent since which no message has been read, CLOCK_MONOTONIC, ns; 0: none is owed.
    owed_since_ns: AtomicU64,
    broken: Mutex<Option<String>>,
}

struct Asking {
    writer: Box<dyn Write + Send>,
    answers: Receiver<(UnitToHost, Instant)>,
    next_id: u32,
}

/// A link to the unit over a byte stream. [`Hsu`](super::Hsu) makes and owns it. One request at a time is under way,
/// and each is answered or fails within its patience. Dropping the link ends the reading thread.
pub struct Link {
    device: String,
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
    /// Starts reading. `device` names the stream in errors. `reader` must return `TimedOut`, `WouldBlock` or
    /// `Interrupted` now and then when nothing comes, or the link cannot be closed. `on_message` gets every message
    /// that is not an answer, in order, on the reading thread; it must not send requests itself.
    pub fn start(
        device: &str,
        reader: impl Read + Send + 'static,
        writer: impl Write + Send + 'static,
        on_message: impl FnMut(UnitToHost) + Send + 'static,
    ) -> io::Result<Self> {
        let shared = Arc::new(Shared::default());
        let (to_asker, answers) = bounded(ANSWERS);
        let for_thread = shared.clone();
        let reader = std::thread::Builder::new()
            .name("hsu-read".into())
            .spawn(move || read_all(reader, &for_thread, &to_asker, on_message))?;
        // A random first id: late answers to an earlier process on the same device must not match.
        let next_id = RandomState::new().hash_one(()) as u32;
        let asking = Mutex::new(Asking { writer: Box::new(writer), answers, next_id });
        Ok(Self { device: device.to_owned(), asking, shared, reader: Some(reader) })
    }

    /// Sends a request until it is answered or patience ends. `what` names it in errors.
    ///
    /// # Errors
    /// [`HsuError::Refused`], [`HsuError::NoAnswer`] or [`HsuError::Io`].
    pub fn ask(&self, what: &'static str, request: Request, patience: Patience) -> Result<Answer, HsuError> {
        self.exchange(lock(&self.asking), what, request, patience)
    }

    /// As [`Self::ask`], or `None` where another request is under way.
    pub fn ask_if_idle(
        &self,
        what: &'static str,
        request: Request,
        patience: Patience,
    ) -> Option<Result<Answer, HsuError>> {
        Some(self.exchange(self.asking.try_lock().ok()?, what, request, patience))
    }

    fn exchange(
        &self,
        mut asking: MutexGuard<'_, Asking>,
        what: &'static str,
        request: Request,
        Patience { answer, attempts }: Patience,
    ) -> Result<Answer, HsuError> {
        let request_id = asking.next_id;
        asking.next_id = request_id.wrapping_add(1);
        let mut message = [0; MAX_MESSAGE];
        let length = HostToUnit { request_id, request }.encode(&mut message);
        let mut framed = [0; frame::MAX_FRAME];
        let length = frame::encode(&message[..length], &mut framed);
        // Late answers to earlier requests.
        while asking.answers.try_recv().is_ok() {}
        let begun = Instant::now();
        for _ in 0..attempts {
            let sent = Instant::now();
            let owed = &self.shared.owed_since_ns;
            let _ = owed.compare_exchange(0, monotonic_ns(sent), Ordering::Relaxed, Ordering::Relaxed);
            match asking.writer.write_all(&framed[..length]) {
                // The line accepts nothing because the other end does not read: that is a silent device.
                Err(error) if is_pause(&error) => {}
                Err(error) => return Err(self.broken(error.to_string())),
                Ok(()) => {}
            }
            loop {
                match asking.answers.recv_deadline(sent + answer) {
                    Ok((UnitToHost::Refused(id, refusal), _)) if id == request_id => {
                        return Err(HsuError::Refused { request: what, refusal });
                    }
                    Ok((message, received)) if message.request_id() == Some(request_id) => {
                        return Ok(Answer { message, sent, received });
                    }
                    Ok(_) => {}
                    Err(RecvTimeoutError::Timeout) => break,
                    Err(RecvTimeoutError::Disconnected) => {
                        let cause = lock(&self.shared.broken).clone();
                        return Err(self.broken(cause.unwrap_or_else(|| "the reading thread ended".into())));
                    }
                }
            }
        }
        let (device, waited) = (self.device.clone(), begun.elapsed());
        Err(HsuError::NoAnswer { device, request: what, attempts, waited })
    }

    fn broken(&self, cause: String) -> HsuError {
        HsuError::Io { device: self.device.clone(), cause }
    }

    /// Name of the serial device, or of what stands in for it.
    pub fn device(&self) -> &str {
        &self.device
    }

    /// For how long requests have gone out without any message coming in; 0 where nothing is owed. That no message came
    /// says nothing where nobody asked: a host that stands still does not ask.
    pub fn unanswered_for(&self) -> Duration {
        match self.shared.owed_since_ns.load(Ordering::Relaxed) {
            0 => Duration::ZERO,
            since => Duration::from_nanos(monotonic_ns(Instant::now()).saturating_sub(since)),
        }
    }

    /// Number of frames and messages from the unit that could not be read.
    pub fn bad_frames(&self) -> u32 {
        self.shared.bad_frames.load(Ordering::Relaxed)
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
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
            shared.owed_since_ns.store(0, Ordering::Relaxed);
            match message.request_id() {
                // A full queue holds late answers only; the request will be repeated.
                Some(_) => drop(answers.try_send((message, received))),
                None => on_message(message),
            }
        });
        shared.bad_frames.store(decoder.errors().total().saturating_add(unreadable), Ordering::Relaxed);
    }
}

fn set_broken(shared: &Shared, cause: &str) {
    *lock(&shared.broken) = Some(cause.to_owned());
}
