// SPDX-License-Identifier: MIT OR Apache-2.0
//! The recorder: the thread that keeps the accounting.
//!
//! One thread matches frames to triggers and accounts for them, and never waits for the disk; behind a bounded ring
//! a second thread owns the recording.

use super::accounting::Accounting;
use super::commands::TICK;
pub use super::commands::{LaneSetup, RecorderCommand, RecorderEvent, RecorderOptions};
use super::hold::Hold;
use super::preview::Taps;
pub use super::progress::Progress;
use super::receiver::Arrival;
use super::writer_queue::Ring;
pub use super::writer_queue::Sink;
use crossbeam_channel::{Receiver, Sender, after, select};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread::JoinHandle;

/// The recorder of one session: the thread that matches frames to triggers and accounts for them. The node starts it
/// when the cameras are armed. It owns the accounting, and the writer's thread behind it owns the recording. It
/// promises that every trigger of every camera ends with a frame or a gap record. It ends with
/// [`RecorderCommand::Close`] or [`RecorderCommand::Discard`], or when all senders of commands are gone.
pub struct Recorder {
    accounting: Accounting,
    progress: Arc<Progress>,
    arrivals: Receiver<Arrival>,
    commands: Receiver<RecorderCommand>,
}

/// The channels of a recorder: frames of the receivers, commands of the node, and events for the node.
#[derive(Debug)]
pub struct Channels {
    pub arrivals: Receiver<Arrival>,
    pub commands: Receiver<RecorderCommand>,
    pub events: Sender<RecorderEvent>,
}

impl Recorder {
    /// Starts the threads, which write to `sink`: a recording, or a dry run. The handle is that of the matching thread,
    /// which waits for the writer's. Previews and the live body take samples of the frames through `taps`.
    pub fn start(
        sink: Box<dyn Sink>,
        taps: [Arc<Taps>; 2],
        lanes: Vec<LaneSetup>,
        options: RecorderOptions,
        progress: Arc<Progress>,
        Channels { arrivals, commands, events }: Channels,
    ) -> std::io::Result<JoinHandle<()>> {
        let cameras = lanes.len().max(1);
        let room = (options.ring_sets() * cameras, options.held_sets * cameras);
        let hold = (options.held_sets > 0).then(|| Hold::new(options.held_sets as u64));
        let ring = Ring::start(sink, room, hold, taps, Arc::clone(&progress), events.clone())?;
        let accounting = Accounting::new(lanes, options, Arc::clone(&progress), ring, events);
        let recorder = Self { accounting, progress, arrivals, commands };
        std::thread::Builder::new().name("recorder".to_owned()).spawn(move || {
            crate::host::realtime::enter_configured("recorder");
            recorder.run()
        })
    }

    fn run(mut self) {
        loop {
            let waiting = self.arrivals.len();
            self.accounting.begin_turn();
            self.progress.recorder_turns.fetch_add(1, Ordering::Relaxed);
            select! {
                recv(self.arrivals) -> arrival => match arrival {
                    Ok(arrival) => {
                        // Commands that were sent before the frame arrived come first: reports, clocks, a fresh stream.
                        let last = self.handle_all();
                        self.accounting.frame_arrived(arrival, waiting);
                        if let Some(last) = last {
                            return self.end(last);
                        }
                    }
                    // The receivers have ended; the last command is still to come.
                    Err(_) => self.arrivals = crossbeam_channel::never(),
                },
                recv(self.commands) -> command => match command {
                    Ok(command) if command.is_last() => return self.end(command),
                    Ok(command) => self.accounting.handle(command),
                    Err(_) => return self.accounting.discard(),
                },
                recv(after(TICK)) -> _ => self.accounting.advance_all(),
            }
            self.accounting.check_drained(self.arrivals.is_empty());
        }
    }

    /// Handles all commands that wait; returns the last command of the session if it is among them.
    fn handle_all(&mut self) -> Option<RecorderCommand> {
        while let Ok(command) = self.commands.try_recv() {
            if command.is_last() {
                return Some(command);
            }
            self.accounting.handle(command);
        }
        None
    }

    fn end(mut self, last: RecorderCommand) {
        let RecorderCommand::Close { aborted } = last else { return self.accounting.discard() };
        while let Ok(arrival) = self.arrivals.try_recv() {
            self.accounting.frame_arrived(arrival, 0);
        }
        self.accounting.close(aborted);
    }
}

#[cfg(test)]
mod tests;
