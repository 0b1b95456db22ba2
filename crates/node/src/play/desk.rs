// SPDX-License-Identifier: MIT OR Apache-2.0
//! Makes frame sets of reconstructed sessions for players: one at a time, by one process at idle priority, and never
//! while the node is in a session (docs/design/api.md, "Playing").

use super::process::{self, Answer};
use super::sequence::Described;
use crate::base::ids::NodeId;
use crate::base::{Exit, Fault, json};
use crate::control::command::{Reply, SharedStatus};
use crate::host::idle_process;
use crate::record::catalogue;
use crate::worker::done::Done;
use crossbeam_channel::{Receiver, RecvTimeoutError, Sender, bounded};
use std::collections::VecDeque;
use std::io::Write;
use std::path::PathBuf;
use std::process::{Child, ChildStdin, Stdio};
use std::sync::{Arc, PoisonError};
use std::time::{Duration, Instant};

/// Most points of a frame set.
pub const POINTS_EACH: usize = 40_000;
/// Requests that may wait for the thread; a further one is refused.
const WAITING_MAX: usize = 16;
/// Bytes of answers that are kept for further requests.
const KEPT_BYTES: usize = 64 << 20;
/// Time that the process waits for the next request before it is ended.
const LINGER: Duration = Duration::from_secs(20);
/// Longest time that an answer of the process may take.
const PATIENCE: Duration = Duration::from_secs(60);
/// Settings of glibc's allocator: the process makes one cloud after the other of the same size, and keeping their
/// memory saves half of its time (measured).
const ALLOCATOR: [(&str, &str); 3] = [
    ("MALLOC_MMAP_THRESHOLD_", "33554432"),
    ("MALLOC_TRIM_THRESHOLD_", "1073741824"),
    ("MALLOC_ARENA_MAX", "1"),
];
/// Time between two looks whether a session has begun.
const POLL: Duration = Duration::from_millis(20);

/// The requested part of a session.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Wanted {
    /// What a player must know ([`Described`], JSON).
    Description,
    /// The frame set of this trigger, packed.
    FrameSet(u64),
}

/// The result of a request.
#[derive(Debug)]
pub enum Made {
    Bytes(Arc<Vec<u8>>),
    /// There is none, and there never will be.
    Nothing(String),
}

struct Ask {
    done: Done,
    wanted: Wanted,
    reply: Reply<Made>,
}

/// Takes requests; its thread, and the process that it has started, end with the last of these.
#[derive(Clone)]
pub struct Desk {
    asks: Sender<Ask>,
}

impl Desk {
    /// Starts the thread. `trigger_rate_hz` is that of sessions whose recording is not here.
    ///
    /// # Errors
    /// The system gives no thread.
    pub fn start(status: SharedStatus, trigger_rate_hz: f64) -> std::io::Result<Self> {
        let (asks, inbox) = bounded(WAITING_MAX);
        let (node, sessions_dir) = {
            let status = status.read().unwrap_or_else(PoisonError::into_inner);
            (status.node.clone(), status.sessions_dir.clone())
        };
        let work = Work { status, node, sessions_dir, trigger_rate_hz, maker: None, kept: Kept::default() };
        std::thread::Builder::new().name("play".to_owned()).spawn(move || work.run(&inbox))?;
        Ok(Self { asks })
    }

    /// Asks for a part of a session that a worker has done.
    ///
    /// # Errors
    /// Too many ask at the same time.
    pub fn ask(&self, done: Done, wanted: Wanted, reply: Reply<Made>) -> Result<(), Fault> {
        self.asks
            .try_send(Ask { done, wanted, reply })
            .map_err(|_| Fault::new(Exit::Device, "too many ask for frame sets at the same time; try again"))
    }
}

/// The process, for one session.
struct Maker {
    done: Done,
    _child: Ending,
    asked: ChildStdin,
    answers: Receiver<std::io::Result<Answer>>,
    /// The description of the session, as the process wrote it.
    description: Arc<Vec<u8>>,
    described: Described,
}

/// A process that is ended when this is dropped.
struct Ending(Child);

impl Drop for Ending {
    fn drop(&mut self) {
        idle_process::end(&mut self.0);
    }
}

/// The last answers, the newest last.
#[derive(Default)]
struct Kept {
    answers: VecDeque<(Done, Wanted, Arc<Vec<u8>>)>,
    bytes: usize,
}

impl Kept {
    fn get(&self, done: &Done, wanted: Wanted) -> Option<Arc<Vec<u8>>> {
        let found = self.answers.iter().find(|(of, what, _)| *what == wanted && of == done);
        found.map(|(_, _, bytes)| Arc::clone(bytes))
    }

    fn keep(&mut self, done: &Done, wanted: Wanted, bytes: &Arc<Vec<u8>>) {
        self.bytes += bytes.len();
        self.answers.push_back((done.clone(), wanted, Arc::clone(bytes)));
        while self.bytes > KEPT_BYTES
            && let Some((_, _, oldest)) = self.answers.pop_front()
        {
            self.bytes -= oldest.len();
        }
    }
}

struct Work {
    status: SharedStatus,
    node: NodeId,
    sessions_dir: PathBuf,
    trigger_rate_hz: f64,
    maker: Option<Maker>,
    kept: Kept,
}

impl Work {
    fn run(mut self, inbox: &Receiver<Ask>) {
        loop {
            match inbox.recv_timeout(LINGER) {
                // A client that has given up is not answered.
                Ok(ask) if ask.reply.is_closed() => {}
                Ok(ask) => {
                    let answer = self.answer(&ask);
                    if answer.is_err() {
                        self.maker = None;
                    }
                    drop(ask.reply.send(answer));
                }
                Err(RecvTimeoutError::Timeout) => self.maker = None,
                Err(RecvTimeoutError::Disconnected) => return,
            }
        }
    }

    fn answer(&mut self, ask: &Ask) -> Result<Made, Fault> {
        if let Some(bytes) = self.kept.get(&ask.done, ask.wanted) {
            return Ok(Made::Bytes(bytes));
        }
        self.check_idle()?;
        if self.maker.as_ref().is_none_or(|maker| maker.done != ask.done) {
            // One at a time: the one before ends first.
            self.maker = None;
            self.maker = Some(self.start(&ask.done)?);
        }
        let Some(maker) = &mut self.maker else { return Err(failed("the process is gone")) };
        let bytes = match ask.wanted {
            Wanted::Description => Arc::clone(&maker.description),
            Wanted::FrameSet(trigger) if !maker.described.has(trigger) => {
                return Ok(Made::Nothing(format!(
                    "trigger {trigger} of session {} has no cloud",
                    ask.done.session
                )));
            }
            Wanted::FrameSet(trigger) => {
                writeln!(maker.asked, "{trigger}").map_err(failed)?;
                let answers = maker.answers.clone();
                // What is wrong with one frame set is no reason to end the process.
                match self.wait(&answers)? {
                    Ok(bytes) => Arc::new(bytes),
                    Err(reason) => return Ok(Made::Nothing(reason)),
                }
            }
        };
        self.kept.keep(&ask.done, ask.wanted, &bytes);
        Ok(Made::Bytes(bytes))
    }

    fn check_idle(&self) -> Result<(), Fault> {
        if self.status.read().unwrap_or_else(PoisonError::into_inner).is_free() {
            return Ok(());
        }
        let message = format!(
            "node {} is in a session; frame sets are made again when it has ended: recording comes first",
            self.node
        );
        Err(Fault::new(Exit::Usage, message))
    }

    fn start(&self, done: &Done) -> Result<Maker, Fault> {
        let recording = catalogue::entry(&self.sessions_dir, &self.node, &done.session)
            .filter(|entry| entry.session_id.as_ref() == Some(&done.session_id));
        let rate = recording.and_then(|entry| entry.trigger_rate_hz).unwrap_or(self.trigger_rate_hz);
        let mut child = idle_process::command(["frame-sets", "--points", &POINTS_EACH.to_string()])
            .and_then(|mut command| {
                let command = command.args(["--rate-hz", &rate.to_string(), "--"]).arg(&done.result);
                command.envs(ALLOCATOR).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn()
            })
            .map_err(|e| failed(idle_process::not_started(e)))?;
        let pipes = child.stdin.take().zip(child.stdout.take());
        let ending = Ending(child);
        let (asked, mut description) = pipes.ok_or_else(|| failed("the process has no pipes"))?;
        let (found, answers) = bounded(1);
        let read = move || {
            loop {
                let answer = process::read_answer(&mut description);
                let over = answer.is_err();
                if found.send(answer).is_err() || over {
                    return;
                }
            }
        };
        std::thread::Builder::new().name("play-answers".to_owned()).spawn(read).map_err(failed)?;
        let description = self.wait(&answers)?.map_err(|reason| Fault::new(Exit::Corrupt, reason))?;
        let described = json::from_slice(&description).map_err(failed)?;
        Ok(Maker {
            done: done.clone(),
            _child: ending,
            asked,
            answers,
            description: Arc::new(description),
            described,
        })
    }

    /// The next answer. An error is the end of the process.
    fn wait(&self, answers: &Receiver<std::io::Result<Answer>>) -> Result<Answer, Fault> {
        let begin = Instant::now();
        loop {
            match answers.recv_timeout(POLL) {
                Ok(answer) => {
                    return answer.map_err(|e| failed(format!("the process that makes frame sets: {e}")));
                }
                Err(RecvTimeoutError::Disconnected) => return Err(failed("the process has ended")),
                Err(RecvTimeoutError::Timeout) => self.check_idle()?,
            }
            if begin.elapsed() > PATIENCE {
                let message = format!("no frame set within {} s; try again", PATIENCE.as_secs());
                return Err(Fault::new(Exit::Device, message));
            }
        }
    }
}

fn failed(reason: impl ToString) -> Fault {
    Fault::new(Exit::Failure, reason)
}

#[cfg(test)]
mod tests {
    use super::{Done, KEPT_BYTES, Kept, Wanted};
    use std::sync::Arc;

    #[test]
    fn what_is_kept_is_bounded_and_of_one_result() {
        let done = |ended_ns| Done {
            session: "walk".to_owned(),
            session_id: "1".to_owned(),
            result: "/results/walk".into(),
            ended_ns,
        };
        let mut kept = Kept::default();
        let large = Arc::new(vec![0; KEPT_BYTES / 4]);
        (0..9).for_each(|trigger| kept.keep(&done(1), Wanted::FrameSet(trigger), &large));
        assert!(kept.bytes <= KEPT_BYTES && kept.answers.len() == 4, "{}", kept.bytes);
        assert!(kept.get(&done(1), Wanted::FrameSet(8)).is_some());
        assert!(kept.get(&done(1), Wanted::FrameSet(0)).is_none(), "the oldest goes first");
        assert!(kept.get(&done(2), Wanted::FrameSet(8)).is_none(), "made anew is another result");
        assert!(kept.get(&done(1), Wanted::Description).is_none());
    }
}
