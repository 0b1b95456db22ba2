// SPDX-License-Identifier: MIT OR Apache-2.0
//! The thread in place of the HSU: the unit's state machine, with action commands for wires.
//!
//! Its clock is this host's monotonic clock. Scheduled actions are sent some time before their trigger: the state
//! machine runs ahead by that time, and its reports are held back until the trigger's time has come. So no trigger is
//! reported before it is fired.

use super::ActionSetup;
use super::pipe::{PipeReader, PipeWriter, pipe};
use super::tally::request_id;
use crate::base::time::monotonic_ns;
use crate::host::realtime;
use crate::hsu::conversation::ACTION_PRODUCT;
use crate::network::{GVCP_PORT, action, action_reply};
use crate::record::ACTION_UNIT;
use hsu_firmware_proto::frame::{self, Decoder};
use hsu_firmware_proto::{
    HeadTiming, Identity, LinkId, MAX_MESSAGE, NodeName, State, TriggerRecord, Unit, UnitOutputs, UnitToHost,
};
use std::collections::VecDeque;
use std::io::{self, Write};
use std::net::{Ipv4Addr, SocketAddr, UdpSocket};
use std::time::{Duration, Instant};

/// Accuracy of sleeping: the last of a wait for a trigger is a busy wait of this length.
const SPIN: Duration = Duration::from_micros(100);
/// Longest sleep, after which answers of cameras are read.
const NAP: Duration = Duration::from_millis(10);

/// Starts the thread; it ends when the writer is dropped.
pub(super) fn start(setup: &ActionSetup) -> io::Result<(PipeReader, PipeWriter)> {
    let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?;
    socket.set_nonblocking(true)?;
    let (input, writer) = pipe();
    let (reader, output) = pipe();
    let lead = if setup.ptp.is_some() { setup.lead } else { Duration::ZERO };
    let wires =
        Wires { setup: setup.clone(), socket, output, reports: VecDeque::new(), now_ns: 0, last_ns: 0 };
    let lead_ns = u64::try_from(lead.as_nanos()).unwrap_or(0);
    let unit = Unit::new(identity());
    let engine = Engine { unit, wires, decoder: Decoder::new(), input, lead_ns, unit_ns: 0 };
    std::thread::Builder::new().name("actions".to_owned()).spawn(move || engine.run())?;
    Ok((reader, writer))
}

fn identity() -> Identity {
    let version =
        [env!("CARGO_PKG_VERSION_MAJOR"), env!("CARGO_PKG_VERSION_MINOR"), env!("CARGO_PKG_VERSION_PATCH")];
    let firmware = version.map(|number| number.parse().unwrap_or(0));
    Identity {
        name: NodeName::new(ACTION_PRODUCT).unwrap_or(NodeName::NONE),
        unique_id: ACTION_UNIT,
        firmware,
    }
}

/// The thread in place of the HSU. [`start`] makes it; it owns the unit, and ends when the host's end of the pipe is
/// dropped.
struct Engine {
    unit: Unit,
    wires: Wires,
    decoder: Decoder,
    input: PipeReader,
    /// Time by which triggers are fired ahead, ns.
    lead_ns: u64,
    /// The latest time given to the unit, because its clock must not run backwards.
    unit_ns: u64,
}

/// The unit's outputs: action commands and messages.
struct Wires {
    setup: ActionSetup,
    socket: UdpSocket,
    output: PipeWriter,
    /// Unasked messages of the unit, and the times at which they may be sent.
    reports: VecDeque<(u64, Vec<u8>)>,
    /// The current time of the unit's clock, ns.
    now_ns: u64,
    last_ns: u64,
}

impl UnitOutputs for Wires {
    fn send(&mut self, link: LinkId, message: &UnitToHost) -> bool {
        if link != LinkId::A {
            return false;
        }
        let mut bytes = [0; MAX_MESSAGE];
        let length = message.encode(&mut bytes);
        let mut framed = [0; frame::MAX_FRAME];
        let length = frame::encode(&bytes[..length], &mut framed);
        let framed = &framed[..length];
        if message.request_id().is_some() {
            return self.output.write_all(framed).is_ok();
        }
        self.last_ns = self.last_ns.max(self.now_ns);
        self.reports.push_back((self.last_ns, framed.to_vec()));
        true
    }

    /// There is no output line without an HSU.
    fn session_output(&mut self, _: bool) {}

    fn fire(&mut self, trigger: &TriggerRecord, _: &[HeadTiming]) {
        let id = request_id(trigger.number);
        let at_ns = self.setup.ptp.as_ref().map(|ptp| ptp.at(trigger.time_ns));
        let datagram = match at_ns {
            None => Some(action(id, self.setup.keys, None)),
            // Without a synchronized clock no time can be given: nothing is sent, and the trigger becomes a gap.
            Some(at_ns) => at_ns.map(|at_ns| action(id, self.setup.keys, Some(at_ns))),
        };
        self.setup.tally.fires(trigger.number, trigger.time_ns);
        for (place, (_, address)) in self.setup.cameras.iter().enumerate() {
            let sent = datagram
                .as_ref()
                .is_some_and(|bytes| self.socket.send_to(bytes, (*address, GVCP_PORT)).is_ok());
            self.setup.tally.sent(place, trigger.number, sent);
        }
    }
}

impl Wires {
    /// Sends the reports whose time has come.
    fn send_reports(&mut self, now_ns: u64) {
        while let Some((_, framed)) = self.reports.pop_front_if(|(at_ns, _)| *at_ns <= now_ns) {
            // A host that does not read finds the hole by the trigger numbers.
            let _ = self.output.write_all(&framed);
        }
    }

    fn take_answers(&self) {
        let mut buffer = [0; 64];
        while let Ok((length, SocketAddr::V4(from))) = self.socket.recv_from(&mut buffer) {
            if let Some((id, status)) = action_reply(&buffer[..length]) {
                self.setup.tally.answered(*from.ip(), id, status);
            }
        }
    }
}

impl Engine {
    fn run(mut self) {
        realtime::enter_configured("actions");
        loop {
            self.keep_time();
            self.wires.take_answers();
            self.wires.send_reports(monotonic_ns(Instant::now()));
            let Some(bytes) = self.input.wait(self.nap()) else { return };
            let now_ns = monotonic_ns(Instant::now());
            self.wires.now_ns = now_ns;
            let Self { unit, wires, decoder, .. } = &mut self;
            let bad = decoder.errors().total();
            decoder.feed(&bytes, |message| unit.receive(LinkId::A, now_ns, message, wires));
            unit.bad_frames(LinkId::A, decoder.errors().total().saturating_sub(bad));
        }
    }

    /// Fires the triggers that are due. A trigger that is sent early enough has exactly its time; one for which this
    /// thread was too late is moved, and flagged as late.
    fn keep_time(&mut self) {
        let now_ns = monotonic_ns(Instant::now());
        let due_ns = self.unit.next_due();
        if due_ns > now_ns + self.lead_ns {
            return;
        }
        self.unit_ns = self.unit_ns.max(due_ns.max(now_ns + self.lead_ns / 4));
        self.wires.now_ns = self.unit_ns;
        self.unit.tick(self.unit_ns, &mut self.wires);
    }

    /// Time until something is due; the last of it before a trigger is a busy wait.
    fn nap(&self) -> Duration {
        let now_ns = monotonic_ns(Instant::now());
        let due_ns = self.unit.next_due().saturating_sub(self.lead_ns);
        let report_ns = self.wires.reports.front().map_or(u64::MAX, |(at_ns, _)| *at_ns);
        let left = Duration::from_nanos(due_ns.min(report_ns).saturating_sub(now_ns)).min(NAP);
        let exact = self.unit.state() == State::Running && self.lead_ns == 0 && due_ns < report_ns;
        if exact && left <= SPIN {
            while monotonic_ns(Instant::now()) < due_ns {
                std::hint::spin_loop();
            }
            return Duration::ZERO;
        }
        if exact { left - SPIN } else { left }
    }
}
