// SPDX-License-Identifier: MIT OR Apache-2.0
//! The thread that keeps the link to the HSU during a session: reads its clock, its input lines and its time code, and
//! connects anew when the link was lost, so that the train's triggers go on being reported from where they broke off.

use super::camera_keeper::Report;
use super::input_lines::InputLines;
use super::time_code::{LAST_FRAME, TimeCodeKeeper};
use crate::acquire::recorder::RecorderCommand;
use crate::base::ids::NodeId;
use crate::base::time::HostClock;
use crate::hsu::{Hsu, HsuTimeouts, SessionId, TriggerUnit, UnderWay};
use crate::record::{ClockSample, NodeEvent};
use crossbeam_channel::{Receiver as Inbox, RecvTimeoutError, Sender, bounded};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Everything that the keeper of the link works with.
pub struct LinkSetup {
    /// The link as it is at the start.
    pub hsu: Arc<Hsu>,
    /// The unit at the other end of the link.
    pub unit: TriggerUnit,
    pub node: NodeId,
    /// The session that is being recorded.
    pub session: SessionId,
    pub clock: HostClock,
    pub to_recorder: Sender<RecorderCommand>,
    pub reports: Sender<Report>,
    /// Receives a new link, once there is one.
    pub back: Sender<Arc<Hsu>>,
}

#[derive(Debug)]
enum Order {
    /// The link is lost; triggers from this number on are missing.
    Reconnect {
        next: i64,
    },
    Stop,
}

/// The running thread that keeps the link to the HSU during one session.
pub struct HsuKeeper {
    orders: Sender<Order>,
    thread: JoinHandle<()>,
}

/// Time between two readings of the HSU's clock. Reports bound it from one side a hundred times a second, the other
/// side has these alone: one reading a second leaves three times the error (docs/design/experiments.md).
const CLOCK_INTERVAL: Duration = Duration::from_millis(200);
/// Time without any time code after which the operator gets a notice.
const CODE_PATIENCE: Duration = Duration::from_secs(1);
/// Time between two attempts to connect.
const RETRY_INTERVAL: Duration = Duration::from_millis(200);

impl HsuKeeper {
    /// Starts the thread, with the link that the session begins with.
    pub fn start(setup: LinkSetup) -> std::io::Result<Self> {
        let (orders, inbox) = bounded(8);
        let thread =
            std::thread::Builder::new().name("hsu-clock".to_owned()).spawn(move || run(setup, &inbox))?;
        Ok(Self { orders, thread })
    }

    /// Orders it to connect anew; reports of the triggers from number `next` on are missing.
    pub fn reconnect(&self, next: i64) {
        drop(self.orders.try_send(Order::Reconnect { next }));
    }

    /// Records the last edges and time codes, and ends the thread.
    pub fn stop(self) {
        drop(self.orders.send(Order::Stop));
        if self.thread.join().is_err() {
            tracing::error!("the thread of the HSU's clock panicked");
        }
    }
}

fn run(setup: LinkSetup, inbox: &Inbox<Order>) {
    let LinkSetup { hsu, unit, node, session, clock, to_recorder, reports, back } = setup;
    let mut hsu = Some(hsu);
    let mut missing = None;
    let mut next_clock = Instant::now() + CLOCK_INTERVAL;
    let code_due = Instant::now() + CODE_PATIENCE;
    let mut shown = None;
    let mut inputs = InputLines::default();
    let mut time_code = TimeCodeKeeper::new(unit.time_code_input());
    let record = |events: Vec<NodeEvent>| {
        events.into_iter().for_each(|event| drop(to_recorder.send(RecorderCommand::Event(event))));
    };
    let mut look = |link: &Hsu, time_code: &mut TimeCodeKeeper| {
        // The time code first: once its input is known, its edges are not reported.
        record(time_code.look(link, clock.now()));
        record(inputs.look(|first| link.input_edges(first), clock.now()));
    };
    // Once for each change.
    let mut notice = |text: Option<String>| {
        if text != shown {
            shown.clone_from(&text);
            drop(reports.send(Report::Notice("time code", text)));
        }
    };
    if let Some(link) = &hsu {
        look(link, &mut time_code);
    }
    loop {
        let patience = match hsu {
            Some(_) => next_clock.saturating_duration_since(Instant::now()),
            None => RETRY_INTERVAL,
        };
        match inbox.recv_timeout(patience) {
            Ok(Order::Stop) | Err(RecvTimeoutError::Disconnected) => {
                // What came since the last look belongs to the session, too.
                if let Some(link) = &hsu {
                    if time_code.is_running() {
                        std::thread::sleep(LAST_FRAME);
                    }
                    look(link, &mut time_code);
                }
                record(time_code.finish(clock.now()));
                notice(time_code.absence(false));
                return;
            }
            Ok(Order::Reconnect { next }) => {
                // The old link must be closed before the device can be opened again.
                hsu = None;
                missing = Some(next);
            }
            Err(RecvTimeoutError::Timeout) => {}
        }
        match (&hsu, missing) {
            (Some(link), _) if Instant::now() >= next_clock => {
                next_clock = Instant::now() + CLOCK_INTERVAL;
                // A unit that does not answer with its time is not waited for twice.
                if let Ok(sample) = link.query_clock() {
                    drop(to_recorder.send(RecorderCommand::Clock(hsu_sample(&sample, &clock))));
                    look(link, &mut time_code);
                    if Instant::now() >= code_due {
                        notice(time_code.absence(true));
                    }
                }
            }
            (None, Some(next)) => {
                match unit.reconnect(&node, &HsuTimeouts::default(), UnderWay { session, next }) {
                    Ok(link) => {
                        time_code.reconnected();
                        let link = Arc::new(link);
                        hsu = Some(Arc::clone(&link));
                        missing = None;
                        drop(back.send(link));
                    }
                    Err(error) => tracing::debug!("HSU not back yet: {error}"),
                }
            }
            _ => {}
        }
    }
}

/// A reading of the HSU's clock, as the recording has it.
pub fn hsu_sample(sample: &crate::hsu::ClockSample, clock: &HostClock) -> ClockSample {
    ClockSample {
        camera: None,
        host_send_ns: clock.at(sample.sent),
        host_receive_ns: clock.at(sample.received),
        device_time_ns: sample.time_ns,
    }
}
