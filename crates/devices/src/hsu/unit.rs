// SPDX-License-Identifier: MIT OR Apache-2.0
//! The unit as this node sees it: typed commands and a stream of events.

use super::conversation::Conversation;
use super::error::HsuError;
use super::event::{Feed, HsuEvent};
use super::link::{Answer, HsuTimeouts, Link, Patience};
use super::timing::{ArmRequest, HsuTiming, node_name};
use crate::base::ids::NodeId;
use crossbeam_channel::{Receiver, Sender, bounded};
use hsu_firmware_proto::{
    Edges, Hello, Identity, Request, SessionId, Slope, State, Status, TimeCodeFrames, TriggerRecord,
    UnitToHost, Welcome, version,
};
use std::io::{Read, Write};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Speed of the serial line in baud; USB and pty devices ignore it.
const BAUD: u32 = 921_600;
/// Longest wait of the reading thread before it checks whether to stop.
const READ_PAUSE: Duration = Duration::from_millis(20);
/// Time between two requests for the status in [`Hsu::wait_armed`].
const POLL: Duration = Duration::from_millis(20);

/// One reading of the unit's clock, which showed `time_ns` at some moment between the two instants.
#[derive(Debug, Clone, Copy)]
pub struct ClockSample {
    /// Just before the request was written.
    pub sent: Instant,
    /// Just after the answer was read.
    pub received: Instant,
    /// Time on the HSU's clock, ns.
    pub time_ns: u64,
}

/// Edges of the unit's input lines.
#[derive(Debug, Clone, Copy)]
pub struct InputEdges {
    /// Number of the next edge, which is still to come.
    pub next: u64,
    /// Levels of the lines after their last edges, one bit each.
    pub levels: u8,
    /// The requested edges, in order of their numbers.
    pub edges: Edges,
}

/// Time codes that the unit has decoded.
#[derive(Debug, Clone, Copy)]
pub struct HeardTimeCodes {
    /// The input that the unit decodes.
    pub input: Option<u8>,
    /// Number of the next code, which is still to come.
    pub next: u64,
    /// Number of damaged time-code frames since power-up.
    pub refused: u32,
    /// Number of the first of `codes`, which are consecutive.
    pub first: u64,
    /// The requested codes, in order of their numbers.
    pub codes: TimeCodeFrames,
}

/// A connected HSU, as this node sees it. [`TriggerUnit::connect`](super::TriggerUnit::connect) makes it, and the
/// node owns it. Each command is answered, refused or timed out; events come once and in order. Dropping it sends a
/// goodbye and closes the device.
#[derive(Debug)]
pub struct Hsu {
    conversation: Arc<Conversation>,
    welcome: Welcome,
    timing_digest: Mutex<u32>,
    wake: Sender<()>,
    keeper: Option<JoinHandle<()>>,
}

/// A session that an earlier connection has armed.
#[derive(Debug, Clone, Copy)]
pub struct UnderWay {
    pub session: SessionId,
    /// The first trigger that was not reported; those that were fired in the meantime are requested.
    pub next: i64,
}

impl Hsu {
    /// Opens the serial device and greets the unit as node `role`. From then on heartbeats are sent automatically.
    pub fn connect(device: &Path, role: &NodeId, timeouts: &HsuTimeouts) -> Result<Self, HsuError> {
        Self::open(device, role, timeouts, None)
    }

    /// As [`Self::connect`]; goes on with a session that an earlier connection has armed, if there is one.
    pub(super) fn open(
        device: &Path,
        role: &NodeId,
        timeouts: &HsuTimeouts,
        session: Option<UnderWay>,
    ) -> Result<Self, HsuError> {
        let name = device.display().to_string();
        let open = |error: serialport::Error| HsuError::Open {
            device: device.display().to_string(),
            cause: error.to_string(),
        };
        let writer = serialport::new(&name, BAUD).timeout(READ_PAUSE).open().map_err(open)?;
        // Discard bytes of an earlier connection in the driver.
        writer.clear(serialport::ClearBuffer::Input).map_err(open)?;
        let reader = writer.try_clone().map_err(open)?;
        Self::over(reader, writer, name, role, timeouts, session)
    }

    /// As [`Self::connect`], over any byte stream; see [`Link::start`] for what `reader` must do.
    pub fn over(
        reader: impl Read + Send + 'static,
        writer: impl Write + Send + 'static,
        device: String,
        role: &NodeId,
        timeouts: &HsuTimeouts,
        session: Option<UnderWay>,
    ) -> Result<Self, HsuError> {
        let role = node_name(role)?;
        let feed = Arc::new(Feed::new());
        // Before the first byte: a trigger of a session that is not known begins it, and nothing before would be requested.
        if let Some(UnderWay { session, next }) = session {
            feed.begin(session, next);
        }
        let (wake, woken) = bounded(1);
        let for_link = (feed.clone(), wake.clone());
        let broken =
            |cause: std::io::Error| HsuError::Io { device: device.clone(), cause: cause.to_string() };
        let link = Link::start(&device, reader, writer, move |message| {
            let (feed, wake) = &for_link;
            if feed.take(message) {
                // A keeper thread that is already woken fills the hole anyway.
                let _ = wake.try_send(());
            }
        })
        .map_err(broken)?;
        let stop = AtomicBool::new(false);
        let conversation = Arc::new(Conversation { link, timeouts: *timeouts, feed, stop });
        let welcome = conversation.greet(Hello { min: version::MIN, current: version::CURRENT, role })?;
        let for_keeper = conversation.clone();
        let keeper = std::thread::Builder::new()
            .name("hsu-keep".into())
            .spawn(move || for_keeper.keep(&woken))
            .map_err(broken)?;
        Ok(Self { conversation, welcome, timing_digest: Mutex::new(0), wake, keeper: Some(keeper) })
    }

    /// Product name, unique id and firmware of the unit.
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

    /// The unit's answer to the greeting.
    pub fn welcome(&self) -> &Welcome {
        &self.welcome
    }

    /// The unit's events. The channel holds 8192; if it is not read, the oldest are discarded.
    pub fn events(&self) -> &Receiver<HsuEvent> {
        &self.conversation.feed.receiver
    }

    /// Number of events that were discarded because the channel was full.
    pub fn dropped_events(&self) -> u64 {
        self.conversation.feed.dropped.load(Ordering::Relaxed)
    }

    /// Number of damaged frames and unreadable messages from the unit.
    pub fn bad_frames(&self) -> u32 {
        self.conversation.link.bad_frames()
    }

    /// Sets the timing, and checks that the unit repeats it. Required on every node before [`Self::arm`].
    pub fn configure(&self, timing: &HsuTiming) -> Result<(), HsuError> {
        let wire = timing.to_wire()?;
        match self.conversation.ask("the timing", Request::Configure(Ok(wire)))? {
            UnitToHost::Timing(_, echo) if echo == wire => {
                *self.timing_digest.lock().unwrap_or_else(PoisonError::into_inner) = wire.digest();
                Ok(())
            }
            other => Err(HsuError::unexpected("the timing", "its echo", &other)),
        }
    }

    /// Arms this node's link. The unit is armed when all nodes of the request have sent the same request.
    pub fn arm(&self, request: &ArmRequest) -> Result<(), HsuError> {
        let digest = *self.timing_digest.lock().unwrap_or_else(PoisonError::into_inner);
        let wire = request.to_wire(digest)?;
        self.conversation.feed.begin(wire.session, -i64::from(wire.warm_up));
        self.command("arming", Request::Arm(wire))
    }

    /// Waits until all nodes have armed the session, or it is already running or finished.
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

    /// Starts the train; any one node may do so. The first trigger comes a period later.
    pub fn start(&self, session: SessionId) -> Result<(), HsuError> {
        self.command("the start", Request::Start(session))
    }

    /// Starts the train at the next edge of this slope on an input; any one node may do so. [`Self::stop`] cancels it.
    pub fn start_at_edge(&self, session: SessionId, slope: Slope) -> Result<(), HsuError> {
        self.command("the start at an input", Request::StartAtEdge(session, slope))
    }

    /// Edges of the input lines from number `first` on, up to eleven of those that the unit still has (the last 96).
    pub fn input_edges(&self, first: u64) -> Result<InputEdges, HsuError> {
        const WHAT: &str = "the request for its inputs";
        match self.conversation.ask(WHAT, Request::QueryEdges { first })? {
            UnitToHost::Edges { next, levels, edges, .. } => Ok(InputEdges { next, levels, edges }),
            other => Err(HsuError::unexpected(WHAT, "edges", &other)),
        }
    }

    /// Selects the input that carries linear time code, until this link ends. Its edges are not reported any more.
    pub fn set_time_code(&self, input: Option<u8>) -> Result<(), HsuError> {
        self.command("the input of the time code", Request::SetTimeCode(input))
    }

    /// Time codes from number `first` on, up to twelve of those that the unit still has (the last 64).
    pub fn time_codes(&self, first: u64) -> Result<HeardTimeCodes, HsuError> {
        const WHAT: &str = "the request for time code";
        match self.conversation.ask(WHAT, Request::QueryTimeCodes { first })? {
            UnitToHost::TimeCodes { input, next, refused, first, codes, .. } => {
                Ok(HeardTimeCodes { input, next, refused, first, codes })
            }
            other => Err(HsuError::unexpected(WHAT, "time codes", &other)),
        }
    }

    /// Ends the train after the current trigger; [`HsuEvent::Done`] follows.
    pub fn stop(&self, session: SessionId) -> Result<(), HsuError> {
        self.command("the stop", Request::Stop(session))
    }

    /// Ends the train at once, or disarms all nodes; [`HsuEvent::Done`] follows.
    /// [`SessionId::NONE`]: whichever session it is.
    pub fn disarm(&self, session: SessionId) -> Result<(), HsuError> {
        self.command("disarming", Request::Disarm(session))
    }

    /// Requests the unit's current status.
    pub fn status(&self) -> Result<Status, HsuError> {
        match self.conversation.ask("the request for its status", Request::ReadStatus)? {
            UnitToHost::Status(_, status) => Ok(status),
            other => Err(HsuError::unexpected("the request for its status", "its status", &other)),
        }
    }

    /// Reads the unit's clock once. Callers read it many times, and trust the readings with the shortest round trip.
    pub fn query_clock(&self) -> Result<ClockSample, HsuError> {
        const WHAT: &str = "the request for its time";
        let Patience { answer, attempts } = self.conversation.timeouts.patience;
        let once = Patience { answer, attempts: 1 };
        let mut attempt = 1;
        loop {
            // Each attempt is a new request: the answer to an earlier one would be older than it looks.
            let token = u64::from(attempt);
            match self.conversation.link.ask(WHAT, Request::ReadClock { token }, once) {
                Ok(Answer { message: UnitToHost::Clock { token: back, time_ns, .. }, sent, received })
                    if back == token =>
                {
                    return Ok(ClockSample { sent, received, time_ns });
                }
                Ok(other) => return Err(HsuError::unexpected(WHAT, "its time", &other.message)),
                Err(HsuError::NoAnswer { .. }) if attempt < attempts => attempt += 1,
                Err(error) => return Err(error),
            }
        }
    }

    /// Requests past triggers again: those of `count` from `first` on that the unit still has (the last 512).
    pub fn query_triggers(
        &self,
        session: SessionId,
        first: i64,
        count: u32,
    ) -> Result<Vec<TriggerRecord>, HsuError> {
        self.conversation.query_triggers(session, first, count)
    }

    fn command(&self, what: &'static str, request: Request) -> Result<(), HsuError> {
        match self.conversation.ask(what, request)? {
            UnitToHost::Ack(_) => Ok(()),
            other => Err(HsuError::unexpected(what, "an acknowledgement", &other)),
        }
    }
}

impl Drop for Hsu {
    fn drop(&mut self) {
        self.conversation.stop.store(true, Ordering::Relaxed);
        let _ = self.wake.try_send(());
        if let Some(keeper) = self.keeper.take() {
            // A panic in the keeper has already been printed; a drop must not add another.
            let _ = keeper.join();
        }
        // A lost goodbye does no harm: the unit notices the silence.
        let patience = Patience { answer: Duration::from_millis(100), attempts: 1 };
        let _ = self.conversation.link.ask("the goodbye", Request::Goodbye, patience);
    }
}
