//! The unit as this node sees it: typed commands and a stream of events.

use super::link::{Answer, Link, LinkError, Patience};
use super::order::Order;
use super::timing::{ArmRequest, HsuTiming, node_name};
use super::{HsuError, trigger_index};
use crate::ids::{NodeId, TriggerIndex};
use crossbeam_channel::{Receiver, RecvTimeoutError, Sender, TrySendError, bounded};
use hsu_firmware_proto::{
    EndReason, Fault, Hello, Identity, MAX_RECORDS, Refusal, Request, SessionId, State, Status,
    TriggerRecord, UnitToHost, Welcome, version,
};
use std::io::{Read, Write};
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// The product name that an HSU of this project gives.
const PRODUCT: &str = "fourdbody-hsu";
/// The line's speed; a USB or pty device takes any.
const BAUD: u32 = 921_600;
/// How often the reading thread looks whether it is to stop.
const READ_PAUSE: Duration = Duration::from_millis(20);
/// Between two looks at the status in [`Hsu::wait_armed`].
const POLL: Duration = Duration::from_millis(20);
/// Events that nobody has taken yet: over a minute of triggers at 120 Hz. Then the oldest gives way.
const EVENTS: usize = 8192;

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

/// Something the unit, or the link, reports by itself.
#[derive(Debug, Clone, PartialEq)]
pub enum HsuEvent {
    /// The unit's status: four times a second and at every change of state.
    Heartbeat(Status),
    /// A trigger was fired. Within a session their numbers have no gap and no repetition.
    Trigger {
        /// The session.
        session: SessionId,
        /// Number (negative: warm-up), time on the HSU's clock in ns, flags.
        trigger: TriggerRecord,
    },
    /// Triggers that were fired, but whose times are lost for good.
    TriggersMissing {
        /// The session.
        session: SessionId,
        /// Number of the first.
        first: i64,
        /// How many.
        count: u64,
    },
    /// The train has ended; comes once, behind its last trigger.
    Done {
        /// The session.
        session: SessionId,
        /// Triggers fired, without warm-up.
        emitted: u64,
        /// Why it ended.
        reason: EndReason,
    },
    /// The unit found something wrong.
    Fault {
        /// The session that it is at.
        session: SessionId,
        /// What.
        fault: Fault,
    },
    /// The unit cannot be talked to.
    LinkLost(LinkLoss),
    /// It can again, after [`LinkLoss::Silent`].
    LinkBack,
}

impl HsuEvent {
    /// The trigger index, if the event is a trigger of the train itself.
    pub fn index(&self) -> Option<TriggerIndex> {
        match self {
            Self::Trigger { trigger, .. } => trigger_index(trigger),
            _ => None,
        }
    }
}

/// How a link was lost.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum LinkLoss {
    /// The unit does not answer; the link comes back by itself if it does.
    Silent,
    /// The unit was restarted and has forgotten everything: connect again.
    Restarted,
    /// The device is gone: connect again.
    Broken(String),
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

/// Where events go, in order.
#[derive(Debug)]
struct Feed {
    order: Mutex<Order>,
    sender: Sender<HsuEvent>,
    /// The consumer's end, to make room.
    receiver: Receiver<HsuEvent>,
    dropped: AtomicU64,
}

impl Feed {
    fn order(&self) -> MutexGuard<'_, Order> {
        self.order.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Bounded, and never blocks the reading thread: when full, the oldest event gives way and is counted.
    fn emit(&self, mut event: HsuEvent) {
        while let Err(TrySendError::Full(back)) = self.sender.try_send(event) {
            event = back;
            if self.receiver.try_recv().is_ok() {
                self.dropped.fetch_add(1, Ordering::Relaxed);
            }
        }
    }

    /// Whether there is a hole to be asked about.
    fn take(&self, event: HsuEvent) -> bool {
        let mut order = self.order();
        order.push(event, &mut |event| self.emit(event));
        order.hole().is_some()
    }
}

/// What commands and the keeper thread share.
#[derive(Debug)]
struct Shared {
    device: String,
    link: Link,
    timeouts: HsuTimeouts,
    feed: Arc<Feed>,
    stop: AtomicBool,
}

/// A connected HSU. Dropping it says goodbye and closes the device.
#[derive(Debug)]
pub struct Hsu {
    shared: Arc<Shared>,
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
        let (sender, receiver) = bounded(EVENTS);
        let (order, dropped) = (Mutex::default(), AtomicU64::new(0));
        let feed = Arc::new(Feed { order, sender, receiver, dropped });
        let (wake, woken) = bounded(1);
        let for_link = (feed.clone(), wake.clone());
        let broken =
            |cause: std::io::Error| HsuError::Io { device: device.clone(), cause: cause.to_string() };
        let link = Link::start(reader, writer, move |message| {
            let (feed, wake) = &for_link;
            if event(message).is_some_and(|event| feed.take(event)) {
                // A keeper that is already woken looks at the hole anyway.
                let _ = wake.try_send(());
            }
        })
        .map_err(broken)?;
        let (timeouts, stop) = (*timeouts, AtomicBool::new(false));
        let shared = Arc::new(Shared { device: device.clone(), link, timeouts, feed, stop });
        let welcome = shared.greet(Hello { min: version::MIN, current: version::CURRENT, role })?;
        let for_keeper = shared.clone();
        let keeper = std::thread::Builder::new()
            .name("hsu-keep".into())
            .spawn(move || for_keeper.keep(&woken))
            .map_err(broken)?;
        Ok(Self { shared, welcome, timing_digest: Mutex::new(0), wake, keeper: Some(keeper) })
    }

    /// Who the unit is.
    pub fn identity(&self) -> &Identity {
        &self.welcome.identity
    }

    /// What the unit said of itself in the handshake.
    pub fn welcome(&self) -> &Welcome {
        &self.welcome
    }

    /// What the unit reports by itself. The channel holds 8192 events; if it is not read, the oldest give way.
    pub fn events(&self) -> &Receiver<HsuEvent> {
        &self.shared.feed.receiver
    }

    /// Events that gave way because nobody took them.
    pub fn dropped_events(&self) -> u64 {
        self.shared.feed.dropped.load(Ordering::Relaxed)
    }

    /// Broken frames and unreadable messages from the unit.
    pub fn bad_frames(&self) -> u32 {
        self.shared.link.bad_frames()
    }

    /// Sets the timing and checks the unit's echo of it. Needed on every node before [`Self::arm`].
    pub fn configure(&self, timing: &HsuTiming) -> Result<(), HsuError> {
        let wire = timing.to_wire()?;
        match self.shared.ask("the timing", Request::Configure(Ok(wire)))?.message {
            UnitToHost::Timing(_, echo) if echo == wire => {
                *self.timing_digest.lock().unwrap_or_else(PoisonError::into_inner) = wire.digest();
                Ok(())
            }
            other => Err(unexpected("the timing", "its echo", &other)),
        }
    }

    /// The timing in force.
    pub fn read_timing(&self) -> Result<HsuTiming, HsuError> {
        match self.shared.ask("a question for its timing", Request::ReadTiming)?.message {
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
        self.shared.feed.order().begin(wire.session, -i64::from(wire.warm_up));
        self.command("arming", Request::Arm(wire))
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
        match self.shared.ask("a question for its status", Request::ReadStatus)?.message {
            UnitToHost::Status(_, status) => Ok(status),
            other => Err(unexpected("a question for its status", "its status", &other)),
        }
    }

    /// Reads the unit's clock once. Take many, and trust those with the shortest way there and back.
    pub fn query_clock(&self) -> Result<ClockSample, HsuError> {
        const WHAT: &str = "a question for its time";
        let patience = Patience { attempts: 1, ..self.shared.timeouts.patience };
        let mut attempt = 1;
        loop {
            // Each attempt is a new request: an answer to an earlier one would be older than it looks.
            let token = u64::from(attempt);
            match self.shared.ask_with(WHAT, Request::ReadClock { token }, patience) {
                Ok(Answer { message: UnitToHost::Clock { token: back, time_ns, .. }, sent, received })
                    if back == token =>
                {
                    return Ok(ClockSample { sent, received, time_ns });
                }
                Ok(other) => return Err(unexpected(WHAT, "its time", &other.message)),
                Err(HsuError::NoAnswer { .. }) if attempt < self.shared.timeouts.patience.attempts => {
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
        self.shared.query_triggers(session, first, count)
    }

    fn command(&self, what: &'static str, request: Request) -> Result<(), HsuError> {
        match self.shared.ask(what, request)?.message {
            UnitToHost::Ack(_) => Ok(()),
            other => Err(unexpected(what, "an acknowledgement", &other)),
        }
    }
}

impl Drop for Hsu {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Relaxed);
        let _ = self.wake.try_send(());
        if let Some(keeper) = self.keeper.take() {
            // A panic in the keeper has already been printed; a drop must not add another.
            let _ = keeper.join();
        }
        // Whether it is heard makes no difference to us.
        let _ = self
            .shared
            .link
            .ask(Request::Goodbye, Patience { answer: Duration::from_millis(100), attempts: 1 });
    }
}

impl Shared {
    fn ask(&self, what: &'static str, request: Request) -> Result<Answer, HsuError> {
        self.ask_with(what, request, self.timeouts.patience)
    }

    fn ask_with(&self, what: &'static str, request: Request, patience: Patience) -> Result<Answer, HsuError> {
        match self.link.ask(request, patience) {
            Ok(Answer { message: UnitToHost::Refused(_, refusal), .. }) => {
                Err(HsuError::Refused { request: what, refusal })
            }
            Ok(answer) => Ok(answer),
            Err(LinkError::NoAnswer { attempts, waited }) => {
                Err(HsuError::NoAnswer { device: self.device.clone(), request: what, attempts, waited })
            }
            Err(LinkError::Broken(cause)) => Err(HsuError::Io { device: self.device.clone(), cause }),
        }
    }

    fn greet(&self, hello: Hello) -> Result<Welcome, HsuError> {
        const WHAT: &str = "the greeting";
        let welcome = match self.ask(WHAT, Request::Hello(hello)) {
            Ok(Answer { message: UnitToHost::Welcome(_, welcome), .. }) => welcome,
            Ok(other) => return Err(unexpected(WHAT, "its identity", &other.message)),
            Err(HsuError::Refused { refusal: Refusal::Version { min, current }, .. }) => {
                return Err(HsuError::WrongVersion {
                    device: self.device.clone(),
                    unit_min: min,
                    unit_current: current,
                });
            }
            Err(error) => return Err(error),
        };
        if welcome.identity.name.as_str() != PRODUCT {
            let found = welcome.identity.name.as_str().to_owned();
            return Err(HsuError::WrongDevice { device: self.device.clone(), found });
        }
        if !(version::MIN..=version::CURRENT).contains(&welcome.agreed) {
            return Err(HsuError::WrongVersion {
                device: self.device.clone(),
                unit_min: welcome.min,
                unit_current: welcome.current,
            });
        }
        Ok(welcome)
    }

    fn query_triggers(
        &self,
        session: SessionId,
        first: i64,
        count: u32,
    ) -> Result<Vec<TriggerRecord>, HsuError> {
        const WHAT: &str = "a question for past triggers";
        let end = first.saturating_add(i64::from(count));
        let mut next = first;
        let mut found = Vec::new();
        while next < end {
            let count = (end - next).min(MAX_RECORDS as i64) as u16;
            let records =
                match self.ask(WHAT, Request::QueryTriggers { session, first: next, count })?.message {
                    UnitToHost::Triggers(_, of, records) if of == session => records,
                    other => return Err(unexpected(WHAT, "triggers", &other)),
                };
            // An empty portion: forgotten, or not fired yet. The rest may still be there.
            found.extend(records.as_slice().iter().filter(|r| (next..end).contains(&r.number)));
            next += i64::from(count);
        }
        Ok(found)
    }

    /// The keeper thread: signs of life, and questions for lost telemetry.
    fn keep(&self, woken: &Receiver<()>) {
        let mut next_beat = Instant::now();
        let mut lost = false;
        while !self.stop.load(Ordering::Relaxed) {
            match woken.recv_deadline(next_beat) {
                Ok(()) => self.fill_holes(),
                Err(RecvTimeoutError::Timeout) => {
                    next_beat = Instant::now() + self.timeouts.heartbeat;
                    if !self.show_life(&mut lost) {
                        return;
                    }
                }
                Err(RecvTimeoutError::Disconnected) => return,
            }
        }
    }

    /// `false`: the conversation is over for good.
    fn show_life(&self, lost: &mut bool) -> bool {
        // Another request under way is a sign of life itself.
        let Some(result) = self.link.ask_if_idle(Request::Heartbeat, self.timeouts.patience) else {
            return true;
        };
        let loss = match result {
            Ok(Answer { message: UnitToHost::Refused(_, Refusal::HelloFirst), .. }) => LinkLoss::Restarted,
            Ok(_) => {
                if std::mem::take(lost) {
                    self.feed.emit(HsuEvent::LinkBack);
                }
                return true;
            }
            Err(LinkError::NoAnswer { .. }) => LinkLoss::Silent,
            Err(LinkError::Broken(cause)) => LinkLoss::Broken(cause),
        };
        let goes_on = loss == LinkLoss::Silent;
        if !(*lost && goes_on) {
            tracing::warn!(device = %self.device, ?loss, "lost the link to the HSU");
            self.feed.emit(HsuEvent::LinkLost(loss));
        }
        *lost = true;
        goes_on
    }

    fn fill_holes(&self) {
        while !self.stop.load(Ordering::Relaxed) {
            let Some(hole) = self.feed.order().hole() else { return };
            let (first, count) = hole.worth_asking();
            let records = self.query_triggers(hole.session, first, count).unwrap_or_else(|error| {
                tracing::warn!(device = %self.device, first, count, %error, "lost trigger telemetry for good");
                Vec::new()
            });
            let mut order = self.feed.order();
            // Meanwhile the hole may have been given up.
            if order.hole() == Some(hole) {
                order.fill(&records, &mut |event| self.feed.emit(event));
            }
        }
    }
}

/// The event that a message without request id is.
fn event(message: UnitToHost) -> Option<HsuEvent> {
    match message {
        UnitToHost::Heartbeat(status) => Some(HsuEvent::Heartbeat(status)),
        UnitToHost::Trigger(session, trigger) => Some(HsuEvent::Trigger { session, trigger }),
        UnitToHost::Done { session, emitted, reason } => Some(HsuEvent::Done { session, emitted, reason }),
        UnitToHost::Fault(session, fault) => Some(HsuEvent::Fault { session, fault }),
        _ => None,
    }
}

fn unexpected(request: &'static str, expected: &'static str, found: &UnitToHost) -> HsuError {
    HsuError::Unexpected { request, expected, found: format!("{found:?}") }
}
