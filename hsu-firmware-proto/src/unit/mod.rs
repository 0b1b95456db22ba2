// SPDX-License-Identifier: MIT OR Apache-2.0
//! The unit's own behaviour, sans I/O: firmware and simulator run this same state machine.
//!
//! Inputs: messages ([`Unit::receive`]), time ([`Unit::tick`]), the projectors' frame sync
//! ([`Unit::frame_sync`]), edges of the input lines ([`Unit::input`]), the firmware's supervision
//! ([`Unit::hardware_fault`]). Outputs go through [`UnitOutputs`]. All times are nanoseconds of the unit's own clock, which must not run backwards.
//!
//! ```text
//! Idle --Arm--> Arming --Arm--> Armed --Start--> Running --count, Stop, Disarm--> Finished --Arm--> Arming
//! ```
//!
//! Armed means that every expected node has armed the same; Start is refused before. Hello and Goodbye take
//! the arming of their own link back, Disarm that of both. `docs/design/hsu-protocol.md` has the whole table.
//!
//! An armed link that falls silent disarms both before the start. Once triggers are being fired the train
//! goes on: the other node's frames are still good, and its host decides. Only a train without a count ends
//! when no host is heard any more, because nobody could end it.

mod inputs;
mod start;
mod train;

pub use train::PAUSE_BEFORE;

use crate::codec::DecodeError;
use crate::host_to_unit::{Arm, Hello, HostToUnit, Request, Unreadable};
use crate::ids::{LinkId, NodeName, SessionId};
use crate::inputs::{Edges, Inputs, Slope};
use crate::time_code::TimeCodes;
use crate::timing::{HeadTiming, Timing, TimingError};
use crate::unit_to_host::{
    EndReason, Fault, Identity, Refusal, State, Status, TriggerFlags, TriggerRecord, TriggerRecords,
    UnitToHost, Welcome,
};
use crate::{HEARTBEAT_NS, LINKS, MAX_RECORDS, MAX_WARM_UP, version};
use train::{History, Step, Train};

/// What the unit does to the world. All calls return at once.
pub trait UnitOutputs {
    /// Puts a message on a link; `false` if the line has no room for it.
    fn send(&mut self, link: LinkId, message: &UnitToHost) -> bool;

    /// Fires a trigger: with [`crate::Sync::Timer`] raises the projectors' sync line now; raises the camera
    /// line of head number h `heads[h].delay_ns` after `trigger.time_ns` and holds it for its exposure.
    fn fire(&mut self, trigger: &TriggerRecord, heads: &[HeadTiming]);

    /// Sets the output that other devices of the laboratory see: high from trigger 0 until the train has ended.
    fn session_output(&mut self, high: bool);
}

/// Silence limit until a timing is configured, ns.
const DEFAULT_SILENCE_NS: u64 = 2_000_000_000;

#[derive(Debug, Clone, Copy, Default)]
struct Link {
    role: Option<NodeName>,
    armed: bool,
    heard_ns: u64,
    silent: bool,
    /// The input that its host has named for time code.
    time_code: Option<u8>,
    answered: Option<(u32, UnitToHost)>,
    frames_bad: u32,
    unsent: u32,
}

#[derive(Debug, Clone, Copy)]
enum Phase {
    Idle,
    Armed,
    Running(Train),
    Finished { emitted: u64, next_number: i64, end: EndReason },
}

/// What must be told after the answer to the request that caused it.
#[derive(Debug, Clone, Copy, Default)]
struct News {
    fault: Option<Fault>,
    done: bool,
    state: bool,
}

/// The state machine of the unit, without any hardware.
#[derive(Debug, Clone)]
pub struct Unit {
    identity: Identity,
    timing: Option<Timing>,
    links: [Link; LINKS],
    /// What is, or was last, armed.
    arm: Option<Arm>,
    /// The last session that fired anything.
    spent: SessionId,
    phase: Phase,
    history: History,
    inputs: Inputs,
    time_codes: TimeCodes,
    /// The armed train starts at such an edge.
    start_at: Option<Slope>,
    /// Whether the level of [`UnitOutputs::session_output`] is high.
    output_high: bool,
    heartbeat_due_ns: u64,
    late: u32,
    faults: u32,
    news: News,
}

impl Unit {
    /// The unit as it is at power-up.
    pub const fn new(identity: Identity) -> Self {
        const LINK: Link = Link {
            role: None,
            armed: false,
            heard_ns: 0,
            silent: false,
            time_code: None,
            answered: None,
            frames_bad: 0,
            unsent: 0,
        };
        Self {
            identity,
            timing: None,
            links: [LINK; LINKS],
            arm: None,
            spent: SessionId::NONE,
            phase: Phase::Idle,
            history: History::new(),
            inputs: Inputs::new(),
            time_codes: TimeCodes::new(),
            start_at: None,
            output_high: false,
            heartbeat_due_ns: 0,
            late: 0,
            faults: 0,
            news: News { fault: None, done: false, state: false },
        }
    }

    /// A board reads its serial number after power-up, and this state machine is too large to be made anew on its stack.
    pub fn identify(&mut self, identity: Identity) {
        self.identity = identity;
    }

    /// What the unit is doing.
    pub fn state(&self) -> State {
        match self.phase {
            Phase::Idle => State::Idle,
            Phase::Armed if self.all_armed() => State::Armed,
            Phase::Armed => State::Arming,
            Phase::Running(_) => State::Running,
            Phase::Finished { .. } => State::Finished,
        }
    }

    /// The timing in force; `None` before the first is set.
    pub fn timing(&self) -> Option<&Timing> {
        self.timing.as_ref()
    }

    /// The unit's clock reading at which [`Self::tick`] has something to do.
    pub fn next_due(&self) -> u64 {
        let train = match (&self.phase, &self.timing) {
            (Phase::Running(train), Some(timing)) => train.next_due(timing),
            _ => None,
        };
        train.map_or(self.heartbeat_due_ns, |due| due.min(self.heartbeat_due_ns))
    }

    /// Time has passed. Fires at most one trigger: call it again until [`Self::next_due`] lies ahead.
    pub fn tick(&mut self, now_ns: u64, out: &mut impl UnitOutputs) {
        if let (Phase::Running(train), Some(timing)) = (&mut self.phase, &self.timing) {
            match train.step(now_ns, timing) {
                Step::Wait => {}
                Step::Fire(record) => self.fired(record, out),
                Step::FrameSyncMissing { since_ns } => self.fault(Fault::FrameSyncMissing { since_ns }),
                Step::Ended(reason) => self.finish(reason),
            }
        }
        // One fault at a time: the next tick finds the rest.
        if self.news.fault.is_none() {
            self.check_silence(now_ns);
        }
        self.end_what_nobody_can_end();
        if now_ns >= self.heartbeat_due_ns {
            self.news.state = true;
        }
        self.tell_news(now_ns, out);
    }

    /// The projectors' frame sync has risen.
    pub fn frame_sync(&mut self, now_ns: u64, out: &mut impl UnitOutputs) {
        if let (Phase::Running(train), Some(timing)) = (&mut self.phase, &self.timing)
            && let Some(record) = train.frame_sync(now_ns, timing)
        {
            self.fired(record, out);
        }
    }

    /// The firmware's supervision found something; both hosts are told.
    pub fn hardware_fault(&mut self, code: u32, now_ns: u64, out: &mut impl UnitOutputs) {
        self.fault(Fault::Hardware { code });
        self.tell_news(now_ns, out);
    }

    /// The frame decoder of a link threw frames away.
    pub fn bad_frames(&mut self, link: LinkId, count: u32) {
        let bad = &mut self.links[link.index()].frames_bad;
        *bad = bad.saturating_add(count);
    }

    /// A message came in on a link. `now_ns` is the time of its last byte: it answers ReadClock.
    pub fn receive(&mut self, link: LinkId, now_ns: u64, message: &[u8], out: &mut impl UnitOutputs) {
        let answer = match HostToUnit::decode(message) {
            Ok(message) => self.answer(link, now_ns, message),
            // Without a request id there is nobody to answer.
            Err(Unreadable { request_id: None, .. }) => return self.bad_frames(link, 1),
            Err(Unreadable { request_id: Some(id), error }) => UnitToHost::Refused(
                id,
                match error {
                    DecodeError::Version { .. } => {
                        Refusal::Version { min: version::MIN, current: version::CURRENT }
                    }
                    DecodeError::Kind { found } => Refusal::UnknownRequest { kind: found },
                    DecodeError::Length | DecodeError::Value => Refusal::Malformed,
                },
            ),
        };
        let this = &mut self.links[link.index()];
        this.heard_ns = now_ns;
        this.silent = false;
        self.send(link, &answer, out);
        self.tell_news(now_ns, out);
    }

    fn answer(&mut self, link: LinkId, now_ns: u64, message: HostToUnit) -> UnitToHost {
        let HostToUnit { request_id: id, request } = message;
        let this = &self.links[link.index()];
        match (&request, this.answered) {
            (Request::Hello(_), _) => {}
            _ if this.role.is_none() => return UnitToHost::Refused(id, Refusal::HelloFirst),
            (_, Some((previous, answer))) if previous == id => return answer,
            _ => {}
        }
        let is_hello = matches!(request, Request::Hello(_));
        let answer = self.execute(link, now_ns, id, request).unwrap_or_else(|r| UnitToHost::Refused(id, r));
        // A host that greets may begin its request ids anywhere.
        self.links[link.index()].answered = (!is_hello).then_some((id, answer));
        answer
    }

    fn execute(
        &mut self,
        link: LinkId,
        now_ns: u64,
        id: u32,
        request: Request,
    ) -> Result<UnitToHost, Refusal> {
        match request {
            Request::Hello(hello) => return self.hello(link, hello).map(|w| UnitToHost::Welcome(id, w)),
            Request::Configure(timing) => {
                return self.configure(timing).map(|timing| UnitToHost::Timing(id, timing));
            }
            Request::ReadTiming => {
                return self.timing.map(|t| UnitToHost::Timing(id, t)).ok_or(Refusal::NotConfigured);
            }
            Request::ReadClock { token } => {
                return Ok(UnitToHost::Clock { request_id: id, token, time_ns: now_ns });
            }
            Request::ReadStatus => return Ok(UnitToHost::Status(id, self.status(link, now_ns))),
            Request::QueryTriggers { session, first, count } => {
                self.expect_session(session)?;
                let mut records = TriggerRecords::default();
                self.history.query(first, count.min(MAX_RECORDS as u16)).all(|r| records.push(r));
                return Ok(UnitToHost::Triggers(id, session, records));
            }
            Request::Arm(arm) => self.arm(link, arm)?,
            Request::Start(session) => {
                if self.may_start(session)? {
                    self.begin_train(now_ns);
                }
            }
            Request::StartAtEdge(session, slope) => {
                if self.time_codes.input() == Some(slope.line()) {
                    return Err(Refusal::InputIsTimeCode { input: slope.line() });
                }
                if self.may_start(session)? {
                    self.start_at = Some(slope);
                }
            }
            Request::QueryEdges { first } => {
                let mut edges = Edges::default();
                self.inputs.query(first).all(|edge| edges.push(edge));
                let (next, levels) = (self.inputs.next(), self.inputs.levels());
                return Ok(UnitToHost::Edges { request_id: id, next, levels, edges });
            }
            Request::SetTimeCode(input) => self.set_time_code(link, input)?,
            Request::QueryTimeCodes { first } => {
                let (input, next) = (self.time_codes.input(), self.time_codes.next());
                let (refused, (first, codes)) = (self.time_codes.refused(), self.time_codes.query(first));
                return Ok(UnitToHost::TimeCodes { request_id: id, input, next, refused, first, codes });
            }
            Request::Stop(session) => self.stop(session)?,
            Request::Disarm(session) => self.disarm(session)?,
            Request::Heartbeat => {}
            Request::Goodbye => {
                self.withdraw(link);
                self.forget_time_code(link);
                self.links[link.index()].role = None;
            }
        }
        Ok(UnitToHost::Ack(id))
    }

    fn hello(&mut self, link: LinkId, hello: Hello) -> Result<Welcome, Refusal> {
        let (min, current) = (version::MIN, version::CURRENT);
        let agreed = version::agree(hello.min, hello.current).ok_or(Refusal::Version { min, current })?;
        self.withdraw(link);
        self.forget_time_code(link);
        self.links[link.index()].role = Some(hello.role);
        self.news.state = true;
        Ok(Welcome { identity: self.identity, min, current, agreed, link })
    }

    fn configure(&mut self, timing: Result<Timing, TimingError>) -> Result<Timing, Refusal> {
        let timing = timing.map_err(Refusal::Timing)?;
        let busy = matches!(self.phase, Phase::Armed | Phase::Running(_));
        if busy && self.timing != Some(timing) {
            return Err(Refusal::Busy(self.state()));
        }
        self.timing = Some(timing);
        Ok(timing)
    }

    fn arm(&mut self, link: LinkId, arm: Arm) -> Result<(), Refusal> {
        let unit = self.timing.ok_or(Refusal::NotConfigured)?.digest();
        let role = self.links[link.index()].role.unwrap_or(NodeName::NONE);
        if matches!(self.phase, Phase::Running(_)) {
            return Err(Refusal::Busy(State::Running));
        }
        if arm.session == SessionId::NONE {
            return Err(Refusal::SessionMissing);
        }
        if arm.session == self.spent {
            return Err(Refusal::SessionSpent { emitted: self.emitted() });
        }
        if arm.timing_digest != unit {
            return Err(Refusal::TimingDiffers { unit, host: arm.timing_digest });
        }
        if arm.warm_up > MAX_WARM_UP {
            return Err(Refusal::WarmUpTooLong { found: arm.warm_up });
        }
        if i64::try_from(arm.trigger_count).is_err() {
            return Err(Refusal::Malformed);
        }
        if role.is_none() || !arm.expected.contains(&role) {
            return Err(Refusal::RoleNotExpected);
        }
        // Only while the other link is armed is there something to contradict.
        if let Some(armed) = self.arm.filter(|_| self.links[link.other().index()].armed) {
            if armed.session != arm.session {
                return Err(session_differs(armed.session, arm.session));
            }
            if armed != arm {
                return Err(Refusal::ArmDiffers { unit: armed.trigger_count, host: arm.trigger_count });
            }
        }
        self.links[link.index()].armed = true;
        self.start_at = None;
        self.arm = Some(arm);
        self.phase = Phase::Armed;
        self.news.state = true;
        Ok(())
    }

    fn stop(&mut self, session: SessionId) -> Result<(), Refusal> {
        let state = self.state();
        match &mut self.phase {
            Phase::Running(train) if self.arm.is_some_and(|arm| arm.session == session) => {
                train.stop();
                Ok(())
            }
            Phase::Running(_) | Phase::Finished { .. } => self.expect_session(session),
            // It waits for an edge: that is taken back, and the session ends without a trigger.
            Phase::Armed if self.start_at.is_some() => {
                self.expect_session(session)?;
                self.finish(EndReason::Stopped);
                Ok(())
            }
            Phase::Idle | Phase::Armed => Err(Refusal::NotRunning(state)),
        }
    }

    fn disarm(&mut self, session: SessionId) -> Result<(), Refusal> {
        match self.phase {
            Phase::Idle | Phase::Finished { .. } => Ok(()),
            Phase::Armed | Phase::Running(_) => {
                if session != SessionId::NONE {
                    self.expect_session(session)?;
                }
                self.finish(EndReason::Aborted);
                Ok(())
            }
        }
    }

    fn expect_session(&self, session: SessionId) -> Result<(), Refusal> {
        let own = self.session();
        if own == session { Ok(()) } else { Err(session_differs(own, session)) }
    }

    fn session(&self) -> SessionId {
        self.arm.map_or(SessionId::NONE, |arm| arm.session)
    }

    /// A host takes its own arming back; that of the other link stays.
    fn withdraw(&mut self, link: LinkId) {
        if !matches!(self.phase, Phase::Armed) || !self.links[link.index()].armed {
            return;
        }
        self.links[link.index()].armed = false;
        self.start_at = None;
        self.news.state = true;
        if self.armed_links() == 0 {
            self.phase = Phase::Idle;
        } else {
            self.fault(Fault::ArmWithdrawn { link });
        }
    }

    fn armed_links(&self) -> u8 {
        self.mask(|link| link.armed)
    }

    fn mask(&self, is_set: impl Fn(&Link) -> bool) -> u8 {
        self.links.iter().enumerate().fold(0, |mask, (i, link)| mask | (u8::from(is_set(link)) << i))
    }

    fn all_armed(&self) -> bool {
        let Some(arm) = &self.arm else { return false };
        let armed = |name: &NodeName| self.links.iter().any(|l| l.armed && l.role == Some(*name));
        arm.expected.iter().all(|name| name.is_none() || armed(name))
    }

    fn emitted(&self) -> u64 {
        match &self.phase {
            Phase::Running(train) => train.emitted(),
            Phase::Finished { emitted, .. } => *emitted,
            Phase::Idle | Phase::Armed => 0,
        }
    }

    fn next_number(&self) -> i64 {
        match &self.phase {
            Phase::Running(train) => train.number(),
            Phase::Finished { next_number, .. } => *next_number,
            Phase::Armed => self.arm.map_or(0, |arm| -i64::from(arm.warm_up)),
            Phase::Idle => 0,
        }
    }

    fn fired(&mut self, record: TriggerRecord, out: &mut impl UnitOutputs) {
        let Some(timing) = &self.timing else { return };
        out.fire(&record, timing.heads());
        if record.number == 0 {
            self.output_high = true;
            out.session_output(true);
        }
        self.spent = self.session();
        self.history.push(record);
        if record.flags.contains(TriggerFlags::LATE) {
            self.late = self.late.saturating_add(1);
        }
        self.send_all(&UnitToHost::Trigger(self.session(), record), out);
    }

    fn finish(&mut self, end: EndReason) {
        let next_number = self.next_number();
        self.phase = Phase::Finished { emitted: self.emitted(), next_number, end };
        self.links.iter_mut().for_each(|link| link.armed = false);
        self.news.done = true;
        self.news.state = true;
    }

    fn fault(&mut self, fault: Fault) {
        self.faults = self.faults.saturating_add(1);
        self.news.fault = Some(fault);
    }

    fn check_silence(&mut self, now_ns: u64) {
        let limit_ns = self.timing.map_or(DEFAULT_SILENCE_NS, |timing| timing.host_silence_ns);
        for id in LinkId::ALL {
            let link = &mut self.links[id.index()];
            let quiet = now_ns.saturating_sub(link.heard_ns) > limit_ns;
            if link.role.is_none() || link.silent || !quiet {
                continue;
            }
            link.silent = true;
            if !link.armed {
                continue;
            }
            self.fault(Fault::LinkSilent { link: id });
            if matches!(self.phase, Phase::Armed) {
                self.finish(EndReason::LinkSilent);
            }
            return;
        }
    }

    fn end_what_nobody_can_end(&mut self) {
        let nobody = LinkId::ALL.iter().all(|&link| !self.is_listening(link));
        if nobody && matches!(&self.phase, Phase::Running(train) if !train.is_counted()) {
            self.finish(EndReason::LinkSilent);
        }
    }

    fn status(&self, link: LinkId, now_ns: u64) -> Status {
        let this = &self.links[link.index()];
        Status {
            state: self.state(),
            session: self.session(),
            time_ns: now_ns,
            next_number: self.next_number(),
            emitted: self.emitted(),
            end: match self.phase {
                Phase::Finished { end, .. } => end,
                _ => EndReason::None,
            },
            armed_links: self.armed_links(),
            heard_links: self.mask(|link| link.role.is_some() && !link.silent),
            timing_digest: self.timing.map_or(0, |timing| timing.digest()),
            late: self.late,
            faults: self.faults,
            frames_bad: this.frames_bad,
            unsent: this.unsent,
        }
    }

    /// What happened, in this order: what is wrong, that the train is over, the state now.
    fn tell_news(&mut self, now_ns: u64, out: &mut impl UnitOutputs) {
        let news = core::mem::take(&mut self.news);
        if news.done && core::mem::take(&mut self.output_high) {
            out.session_output(false);
        }
        if let Some(fault) = news.fault {
            self.send_known(&UnitToHost::Fault(self.session(), fault), out);
        }
        if let (true, Phase::Finished { emitted, end, .. }) = (news.done, self.phase) {
            let done = UnitToHost::Done { session: self.session(), emitted, reason: end };
            self.send_known(&done, out);
        }
        if news.state {
            self.heartbeat_due_ns = now_ns.saturating_add(HEARTBEAT_NS);
            for link in LinkId::ALL {
                let status = self.status(link, now_ns);
                if self.is_listening(link) {
                    self.send(link, &UnitToHost::Heartbeat(status), out);
                }
            }
        }
    }

    /// A link without a live host would only fill its line with what nobody reads.
    fn is_listening(&self, link: LinkId) -> bool {
        let link = &self.links[link.index()];
        link.role.is_some() && !link.silent
    }

    fn send_all(&mut self, message: &UnitToHost, out: &mut impl UnitOutputs) {
        for link in LinkId::ALL {
            if self.is_listening(link) {
                self.send(link, message, out);
            }
        }
    }

    /// Also to a host that is silent: perhaps only its own direction is broken.
    fn send_known(&mut self, message: &UnitToHost, out: &mut impl UnitOutputs) {
        for link in LinkId::ALL {
            if self.links[link.index()].role.is_some() {
                self.send(link, message, out);
            }
        }
    }

    fn send(&mut self, link: LinkId, message: &UnitToHost, out: &mut impl UnitOutputs) {
        if !out.send(link, message) {
            let unsent = &mut self.links[link.index()].unsent;
            *unsent = unsent.saturating_add(1);
        }
    }
}

fn session_differs(unit: SessionId, host: SessionId) -> Refusal {
    let short = |id: SessionId| id.0.first_chunk().map_or(0, |bytes| u64::from_le_bytes(*bytes));
    Refusal::SessionDiffers { unit: short(unit), host: short(host) }
}
