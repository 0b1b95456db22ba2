// SPDX-License-Identifier: MIT OR Apache-2.0
//! The unit as this node sees it: typed commands and a stream of events.

use super::conversation::{Conversation, unexpected};
use super::error::HsuError;
use super::event::{Feed, HsuEvent};
use super::link::{Answer, Link, Patience};
use super::timing::{ArmRequest, HsuTiming, node_name};
use crate::base::ids::NodeId;
use crossbeam_channel::{Receiver, Sender, bounded};
use hsu_firmware_proto::{
    Edges, Hello, Identity, Request, SessionId, Slope, State, Status, TimeCodeFrames, TriggerRecord,
    UnitToHost, Welcome, version,
};
use std::io::{Read, Write};
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// The line's speed; a USB or pty device takes any.
const BAUD: u32 = 921_600;
/// How often the reading thread looks whether it is to stop.
const READ_PAUSE: Duration = Duration::from_millis(20);
/// Between two looks at the status in [`Hsu::wait_armed`].
const POLL: Duration = Duration::from_millis(20);
/// How patient the host is.
#[derive(Debug, Clone, Copy)]
pub struct HsuTimeouts {
    /// For one answer, and how often to ask.
    pub patience: Patience,
    /// Between two signs of life to the unit; well below [`HsuTiming::host_silence`].
    pub heartbeat: Duration,
}

impl Default for HsuTimeouts {
    fn default() -> Self {
        let patience = Patience { answer: Duration::from_millis(250), attempts: 4 };
        Self { patience, heartbeat: Duration::from_millis(400) }
    }
}

/// One reading of the unit's clock: it showed `time_ns` at some moment between the two instants.
#[derive(Debug, Clone, Copy)]
pub struct ClockSample {
    /// Just before the question was written.
    pub sent: Instant,
    /// Just after the answer was read.
    pub received: Instant,
    /// The HSU's clock, ns.
    pub time_ns: u64,
}

/// What the unit says of its input lines.
#[derive(Debug, Clone, Copy)]
pub struct InputEdges {
    /// Number of the edge that comes next.
    pub next: u64,
    /// A bit a line, as its last edge left it.
    pub levels: u8,
    /// The edges, in order.
    pub edges: Edges,
}

/// What the unit says of the time code.
#[derive(Debug, Clone, Copy)]
pub struct HeardTimeCodes {
    /// The input that it decodes.
    pub input: Option<u8>,
    /// Number of the code that comes next.
    pub next: u64,
    /// Frames that were no good, since it was switched on.
    pub refused: u32,
    /// Number of the first of `codes`; they are consecutive.
    pub first: u64,
    /// The codes, in order.
    pub codes: TimeCodeFrames,
}

/// A connected HSU. Dropping it says goodbye and closes the device.
#[derive(Debug)]
pub struct Hsu {
    conversation: Arc<Conversation>,
    welcome: Welcome,
    timing_digest: Mutex<u32>,
    wake: Sender<()>,
    keeper: Option<JoinHandle<()>>,
}

impl Hsu {
    /// Opens the serial device and greets the unit as node `role`. From then on signs of life are sent
    /// automatically.
    pub fn connect(device: &Path, role: &NodeId, timeouts: &HsuTimeouts) -> Result<Self, HsuError> {
        let name = device.display().to_string();
        let open = |error: serialport::Error| HsuError::Open {
            device: device.display().to_string(),
            cause: error.to_string(),
        };
        let writer = serialport::new(&name, BAUD).timeout(READ_PAUSE).open().map_err(open)?;
        // What an earlier conversation left in the driver.
        writer.clear(serialport::ClearBuffer::Input).map_err(open)?;
        let reader = writer.try_clone().map_err(open)?;
        Self::over(reader, writer, name, role, timeouts)
    }

    /// As [`Self::connect`], over any byte stream; see [`Link::start`] for what `reader` must do.
    pub fn over(
        reader: impl Read + Send + 'static,
        writer: impl Write + Send + 'static,
        device: String,
        role: &NodeId,
        timeouts: &HsuTimeouts,
    ) -> Result<Self, HsuError> {
        let role = node_name(role)?;
        let feed = Arc::new(Feed::new());
        let (wake, woken) = bounded(1);
        let for_link = (feed.clone(), wake.clone());
        let broken =
            |cause: std::io::Error| HsuError::Io { device: device.clone(), cause: cause.to_string() };
        let link = Link::start(reader, writer, move |message| {
            let (feed, wake) = &for_link;
            if feed.take(message) {
                // A keeper that is already woken looks at the hole anyway.
                let _ = wake.try_send(());
            }
        })
        .map_err(broken)?;
        let conversation = Arc::new(Conversation::new(device.clone(), link, *timeouts, feed));
        let welcome = conversation.greet(Hello { min: version::MIN, current: version::CURRENT, role })?;
        let for_keeper = conversation.clone();
        let keeper = std::thread::Builder::new()
            .name("hsu-keep".into())
            .spawn(move || for_keeper.keep(&woken))
            .map_err(broken)?;
        Ok(Self { conversation, welcome, timing_digest: Mutex::new(0), wake, keeper: Some(keeper) })
    }

    /// Who the unit is.
    pub fn identity(&self) -> &Identity {
        &self.welcome.identity
    }

    /// Product, serial number and firmware in one line, for people.
    pub fn identity_text(&self) -> String {
        let Identity { name, firmware: [major, minor, patch], .. } = self.identity();
        format!("{name} {} firmware {major}.{minor}.{patch}", self.unique_id())
    }

    /// The unit's serial number: as text where it is printable ASCII, in hexadecimal otherwise.
    pub fn unique_id(&self) -> String {
        let id = self.identity().unique_id;
        match std::str::from_utf8(&id) {
            Ok(text) if text.chars().all(|c| c.is_ascii_graphic()) => text.to_owned(),
            _ => id.iter().map(|byte| format!("{byte:02x}")).collect(),
        }
    }

    /// What the unit said of itself in the handshake.
    pub fn welcome(&self) -> &Welcome {
        &self.welcome
    }

    /// What the unit reports by itself. The channel holds 8192 events; if it is not read, the oldest give way.
    pub fn events(&self) -> &Receiver<HsuEvent> {
        self.conversation.feed().events()
    }

    /// Events that gave way because nobody took them.
    pub fn dropped_events(&self) -> u64 {
        self.conversation.feed().dropped()
    }

    /// Broken frames and unreadable messages from the unit.
    pub fn bad_frames(&self) -> u32 {
        self.conversation.link().bad_frames()
    }

    /// Sets the timing and checks the unit's echo of it. Needed on every node before [`Self::arm`].
    pub fn configure(&self, timing: &HsuTiming) -> Result<(), HsuError> {
        let wire = timing.to_wire()?;
        match self.conversation.ask("the timing", Request::Configure(Ok(wire)))?.message {
            UnitToHost::Timing(_, echo) if echo == wire => {
                *self.timing_digest.lock().unwrap_or_else(PoisonError::into_inner) = wire.digest();
                Ok(())
            }
            other => Err(unexpected("the timing", "its echo", &other)),
        }
    }

    /// The timing in force.
    pub fn read_timing(&self) -> Result<HsuTiming, HsuError> {
        match self.conversation.ask("a question for its timing", Request::ReadTiming)?.message {
            UnitToHost::Timing(_, timing) => Ok(HsuTiming {
                period_ns: timing.period_ns,
                sync: timing.sync,
                host_silence: Duration::from_nanos(timing.host_silence_ns),
                heads: timing.heads().to_vec(),
            }),
            other => Err(unexpected("a question for its timing", "its timing", &other)),
        }
    }

    /// Arms this node's link. The unit is armed when all nodes in the request have asked for the same.
    pub fn arm(&self, request: &ArmRequest) -> Result<(), HsuError> {
        let digest = *self.timing_digest.lock().unwrap_or_else(PoisonError::into_inner);
        let wire = request.to_wire(digest)?;
        self.conversation.feed().begin(wire.session, -i64::from(wire.warm_up));
        self.command("arming", Request::Arm(wire))
    }

    /// Takes up the triggers of a session that another connection has armed, from number `next` on: those fired
    /// meanwhile are asked for.
    pub fn resume(&self, session: SessionId, next: i64) {
        self.conversation.feed().begin(session, next);
    }

    /// Waits until all nodes have armed the session (or it has gone on from there).
    pub fn wait_armed(&self, session: SessionId, patience: Duration) -> Result<Status, HsuError> {
        let begun = Instant::now();
        loop {
            let status = self.status()?;
            let reached = matches!(status.state, State::Armed | State::Running | State::Finished);
            if status.session == session && reached {
                return Ok(status);
            }
            if begun.elapsed() >= patience {
                let links = status.armed_links.count_ones();
                let found =
                    format!("{}, with {links} links armed for session {}", status.state, status.session);
                return Err(HsuError::Late { expected: "armed", found, waited: patience });
            }
            std::thread::sleep(POLL);
        }
    }

    /// Starts the train; any one node may. The first trigger comes a period later.
    pub fn start(&self, session: SessionId) -> Result<(), HsuError> {
        self.command("the start", Request::Start(session))
    }

    /// Starts the train at the next such edge of an input; any one node may. [`Self::stop`] takes it back.
    pub fn start_at_edge(&self, session: SessionId, slope: Slope) -> Result<(), HsuError> {
        self.command("the start at an input", Request::StartAtEdge(session, slope))
    }

    /// Edges of the input lines from number `first` on, up to eleven of those that the unit still has (the last 96).
    pub fn input_edges(&self, first: u64) -> Result<InputEdges, HsuError> {
        const WHAT: &str = "a question for its inputs";
        match self.conversation.ask(WHAT, Request::QueryEdges { first })?.message {
            UnitToHost::Edges { next, levels, edges, .. } => Ok(InputEdges { next, levels, edges }),
            other => Err(unexpected(WHAT, "edges", &other)),
        }
    }

    /// Says which input carries linear time code, until this link ends. Its edges are not told any more.
    pub fn set_time_code(&self, input: Option<u8>) -> Result<(), HsuError> {
        self.command("the input of the time code", Request::SetTimeCode(input))
    }

    /// Time codes from number `first` on, up to twelve of those that the unit still has (the last 64).
    pub fn time_codes(&self, first: u64) -> Result<HeardTimeCodes, HsuError> {
        const WHAT: &str = "a question for time code";
        match self.conversation.ask(WHAT, Request::QueryTimeCodes { first })?.message {
            UnitToHost::TimeCodes { input, next, refused, first, codes, .. } => {
                Ok(HeardTimeCodes { input, next, refused, first, codes })
            }
            other => Err(unexpected(WHAT, "time codes", &other)),
        }
    }

    /// Ends the train after the current trigger; [`HsuEvent::Done`] follows.
    pub fn stop(&self, session: SessionId) -> Result<(), HsuError> {
        self.command("the stop", Request::Stop(session))
    }

    /// Ends the train at once, or takes the arming of all nodes back; [`HsuEvent::Done`] follows.
    /// [`SessionId::NONE`]: whichever session it is.
    pub fn disarm(&self, session: SessionId) -> Result<(), HsuError> {
        self.command("disarming", Request::Disarm(session))
    }

    /// The unit's status.
    pub fn status(&self) -> Result<Status, HsuError> {
        match self.conversation.ask("a question for its status", Request::ReadStatus)?.message {
            UnitToHost::Status(_, status) => Ok(status),
            other => Err(unexpected("a question for its status", "its status", &other)),
        }
    }

    /// Reads the unit's clock once. Take many, and trust those with the shortest way there and back.
    pub fn query_clock(&self) -> Result<ClockSample, HsuError> {
        const WHAT: &str = "a question for its time";
        let patience = Patience { attempts: 1, ..self.conversation.timeouts().patience };
        let mut attempt = 1;
        loop {
            // Each attempt is a new request: an answer to an earlier one would be older than it looks.
            let token = u64::from(attempt);
            match self.conversation.ask_with(WHAT, Request::ReadClock { token }, patience) {
                Ok(Answer { message: UnitToHost::Clock { token: back, time_ns, .. }, sent, received })
                    if back == token =>
                {
                    return Ok(ClockSample { sent, received, time_ns });
                }
                Ok(other) => return Err(unexpected(WHAT, "its time", &other.message)),
                Err(HsuError::NoAnswer { .. })
                    if attempt < self.conversation.timeouts().patience.attempts =>
                {
                    attempt += 1;
                }
                Err(error) => return Err(error),
            }
        }
    }

    /// Asks for past triggers again: those of `count` from `first` on that the unit still has (the last 512).
    pub fn query_triggers(
        &self,
        session: SessionId,
        first: i64,
        count: u32,
    ) -> Result<Vec<TriggerRecord>, HsuError> {
        self.conversation.query_triggers(session, first, count)
    }

    fn command(&self, what: &'static str, request: Request) -> Result<(), HsuError> {
        match self.conversation.ask(what, request)?.message {
            UnitToHost::Ack(_) => Ok(()),
            other => Err(unexpected(what, "an acknowledgement", &other)),
        }
    }
}

impl Drop for Hsu {
    fn drop(&mut self) {
        self.conversation.stop();
        let _ = self.wake.try_send(());
        if let Some(keeper) = self.keeper.take() {
            // A panic in the keeper has already been printed; a drop must not add another.
            let _ = keeper.join();
        }
        // Whether it is heard makes no difference to us.
        let _ = self
            .conversation
            .link()
            .ask(Request::Goodbye, Patience { answer: Duration::from_millis(100), attempts: 1 });
    }
}
