// SPDX-License-Identifier: MIT OR Apache-2.0
//! Messages from the unit to a host.
//!
//! Layout: version (u8), kind (u8, from 0x80, so that a line which echoes is not mistaken for a unit), then
//! the fields of the kind; in answers the request id (u32) comes first. Telemetry ([`UnitToHost::Trigger`],
//! heartbeats, faults, the end of a train) is not acknowledged: triggers carry consecutive numbers, and every
//! [`Status`] repeats what the rest has said, so that a host notices each loss and can ask again.

use crate::codec::{DecodeError, Put, Take};
use crate::ids::{LinkId, NodeName, SessionId};
use crate::inputs::{Edge, Edges};
use crate::records::Records;
use crate::time_code::{TimeCodeFrame, TimeCodeFrames, put_input, take_input};
use crate::timing::{Timing, TimingError};
use crate::{MAX_MESSAGE, version};
use core::fmt;

pub use crate::refusal::Refusal;
pub use crate::status::{EndReason, State, Status};

/// Serial number and firmware of the unit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Identity {
    /// Product name; a host refuses to talk to another product.
    pub name: NodeName,
    /// Serial number of this unit.
    pub unique_id: [u8; 16],
    /// Firmware version: major, minor, patch.
    pub firmware: [u16; 3],
}

/// The unit's answer to a Hello.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Welcome {
    /// Serial number and firmware of the unit.
    pub identity: Identity,
    /// Oldest version that it speaks.
    pub min: u8,
    /// Newest version that it speaks.
    pub current: u8,
    /// The version of this conversation.
    pub agreed: u8,
    /// Which of its sockets the link is plugged into.
    pub link: LinkId,
}

/// What is special about a trigger: a set of bits.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct TriggerFlags(pub u8);

impl TriggerFlags {
    /// Before the train; its number is negative.
    pub const WARM_UP: Self = Self(1);
    /// The last of a train of known length.
    pub const LAST: Self = Self(2);
    /// Fired more than a sixteenth of a period after it was due.
    pub const LATE: Self = Self(4);

    /// Whether all bits of `other` are set.
    pub const fn contains(self, other: Self) -> bool {
        self.0 & other.0 == other.0
    }

    /// With the bits of `other`, if `condition`.
    pub const fn with_if(self, other: Self, condition: bool) -> Self {
        if condition { Self(self.0 | other.0) } else { self }
    }
}

/// One trigger as it happened.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct TriggerRecord {
    /// The trigger index; negative for warm-up triggers. Consecutive within a session.
    pub number: i64,
    /// When it was fired, unit's clock, ns.
    pub time_ns: u64,
    /// What is special about it.
    pub flags: TriggerFlags,
}

/// Triggers with consecutive numbers, as one message carries them.
pub type TriggerRecords = Records<TriggerRecord>;

/// Something is wrong that no request asked about.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fault {
    /// An armed link was not heard for longer than the silence limit.
    LinkSilent {
        /// The link that has the fault.
        link: LinkId,
    },
    /// A link took its arming back: its host greeted anew, or left.
    ArmWithdrawn {
        /// The link that has the fault.
        link: LinkId,
    },
    /// No frame sync of the projectors for more than a period and a half.
    FrameSyncMissing {
        /// Since the last one, ns.
        since_ns: u64,
    },
    /// The firmware's own supervision: power, wires, temperature. The firmware's manual has the codes.
    Hardware {
        /// A code that the firmware's own documents explain.
        code: u32,
    },
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::LinkSilent { link } => write!(f, "the host on link {link} fell silent"),
            Self::ArmWithdrawn { link } => write!(f, "the host on link {link} took its arming back"),
            Self::FrameSyncMissing { since_ns } => {
                write!(f, "no projector frame sync for {} us", since_ns / 1000)
            }
            Self::Hardware { code } => write!(f, "hardware fault {code:#x}"),
        }
    }
}

/// A message of the unit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UnitToHost {
    /// The answer to a `Hello`, with its request's number.
    Welcome(u32, Welcome),
    /// The request was carried out.
    Ack(u32),
    /// The request was not carried out.
    Refused(u32, Refusal),
    /// The timing in force: answer to Configure and ReadTiming.
    Timing(u32, Timing),
    /// The answer to a `ReadClock`, with the unit's time.
    Clock {
        /// The number of the request that this answers.
        request_id: u32,
        /// The number that the request carried.
        token: u64,
        /// Unit's clock at receipt, ns.
        time_ns: u64,
    },
    /// Answer to QueryTriggers: what the unit still has, from the first asked for on; may be empty.
    Triggers(u32, SessionId, TriggerRecords),
    /// The answer to a `ReadStatus`, with its request's number.
    Status(u32, Status),
    /// Sent by itself every [`crate::HEARTBEAT_NS`] and at every change of state.
    Heartbeat(Status),
    /// The unit has fired a trigger of this session.
    Trigger(SessionId, TriggerRecord),
    /// The train has ended and all its edges are out.
    Done {
        /// The session that has ended.
        session: SessionId,
        /// Triggers fired in it, without those of the warm-up.
        emitted: u64,
        /// Why the unit ended the session.
        reason: EndReason,
    },
    /// The unit has found a fault during this session.
    Fault(SessionId, Fault),
    /// Answer to QueryEdges: what the unit still has, from the first asked for on; may be empty.
    Edges {
        /// The number of the request that this answers.
        request_id: u32,
        /// Number of the edge that comes next.
        next: u64,
        /// A bit a line, as its last edge left it.
        levels: u8,
        /// The edges that the unit still keeps.
        edges: Edges,
    },
    /// Answer to QueryTimeCodes: what the unit still has, from the first asked for on; may be empty.
    TimeCodes {
        /// The number of the request that this answers.
        request_id: u32,
        /// The input that is decoded.
        input: Option<u8>,
        /// Number of the code that comes next.
        next: u64,
        /// Frames that were heard and were no good, since power-up.
        refused: u32,
        /// Number of the first of `codes`.
        first: u64,
        /// The time codes that the unit still keeps.
        codes: TimeCodeFrames,
    },
}

const WELCOME: u8 = 0x80;
const ACK: u8 = 0x81;
const REFUSED: u8 = 0x82;
const TIMING: u8 = 0x83;
const CLOCK: u8 = 0x84;
const TRIGGERS: u8 = 0x85;
const STATUS: u8 = 0x86;
const HEARTBEAT: u8 = 0x87;
const TRIGGER: u8 = 0x88;
const DONE: u8 = 0x89;
const FAULT: u8 = 0x8a;
const EDGES: u8 = 0x8b;
const TIME_CODES: u8 = 0x8c;

impl UnitToHost {
    /// The request that this answers, if it is an answer.
    pub fn request_id(&self) -> Option<u32> {
        match *self {
            Self::Welcome(id, _)
            | Self::Ack(id)
            | Self::Refused(id, _)
            | Self::Timing(id, _)
            | Self::Clock { request_id: id, .. }
            | Self::Triggers(id, ..)
            | Self::Edges { request_id: id, .. }
            | Self::TimeCodes { request_id: id, .. }
            | Self::Status(id, _) => Some(id),
            Self::Heartbeat(_) | Self::Trigger(..) | Self::Done { .. } | Self::Fault(..) => None,
        }
    }

    /// Writes the message; returns its length.
    pub fn encode(&self, out: &mut [u8; MAX_MESSAGE]) -> usize {
        let mut put = Put::new(out);
        put.u8(version::CURRENT);
        put.u8(self.kind());
        if let Some(id) = self.request_id() {
            put.u32(id);
        }
        match self {
            Self::Welcome(_, welcome) => put_welcome(&mut put, welcome),
            Self::Ack(_) => {}
            Self::Refused(_, refusal) => refusal.put(&mut put),
            Self::Timing(_, timing) => timing.put(&mut put),
            Self::Clock { token, time_ns, .. } => {
                put.u64(*token);
                put.u64(*time_ns);
            }
            Self::Triggers(_, session, records) => {
                put.bytes(&session.0);
                records.put(&mut put, put_record);
            }
            Self::Status(_, status) | Self::Heartbeat(status) => status.put(&mut put),
            Self::Trigger(session, record) => {
                put.bytes(&session.0);
                put_record(record, &mut put);
            }
            Self::Done { session, emitted, reason } => {
                put.bytes(&session.0);
                put.u64(*emitted);
                put.u8(*reason as u8);
            }
            Self::Fault(session, fault) => {
                put.bytes(&session.0);
                let (code, value) = match *fault {
                    Fault::LinkSilent { link } => (0, link.index() as u64),
                    Fault::ArmWithdrawn { link } => (1, link.index() as u64),
                    Fault::FrameSyncMissing { since_ns } => (2, since_ns),
                    Fault::Hardware { code } => (3, u64::from(code)),
                };
                put.u8(code);
                put.u64(value);
            }
            Self::Edges { next, levels, edges, .. } => {
                put.u64(*next);
                put.u8(*levels);
                edges.put(&mut put, Edge::put);
            }
            Self::TimeCodes { input, next, refused, first, codes, .. } => {
                put_input(*input, &mut put);
                put.u64(*next);
                put.u32(*refused);
                put.u64(*first);
                codes.put(&mut put, TimeCodeFrame::put);
            }
        }
        put.length()
    }

    /// Decodes one message from its bytes.
    pub fn decode(message: &[u8]) -> Result<Self, DecodeError> {
        let mut take = Take::new(message);
        let found = take.u8()?;
        let kind = take.u8()?;
        // These two are the same in all versions: they are how a mismatch is told.
        let fixed = matches!(kind, WELCOME | REFUSED);
        if !fixed && !(version::MIN..=version::CURRENT).contains(&found) {
            return Err(DecodeError::Version { found });
        }
        let message = Self::take(kind, &mut take)?;
        take.end()?;
        Ok(message)
    }

    fn kind(&self) -> u8 {
        match self {
            Self::Welcome(..) => WELCOME,
            Self::Ack(_) => ACK,
            Self::Refused(..) => REFUSED,
            Self::Timing(..) => TIMING,
            Self::Clock { .. } => CLOCK,
            Self::Triggers(..) => TRIGGERS,
            Self::Status(..) => STATUS,
            Self::Heartbeat(_) => HEARTBEAT,
            Self::Trigger(..) => TRIGGER,
            Self::Done { .. } => DONE,
            Self::Fault(..) => FAULT,
            Self::Edges { .. } => EDGES,
            Self::TimeCodes { .. } => TIME_CODES,
        }
    }

    fn take(kind: u8, take: &mut Take<'_>) -> Result<Self, DecodeError> {
        Ok(match kind {
            WELCOME => Self::Welcome(take.u32()?, take_welcome(take)?),
            ACK => Self::Ack(take.u32()?),
            REFUSED => Self::Refused(take.u32()?, Refusal::take(take)?),
            TIMING => {
                let id = take.u32()?;
                Self::Timing(id, Timing::take(take)?.map_err(|_: TimingError| DecodeError::Value)?)
            }
            CLOCK => Self::Clock { request_id: take.u32()?, token: take.u64()?, time_ns: take.u64()? },
            TRIGGERS => {
                let (id, session) = (take.u32()?, SessionId(take.array()?));
                let records = Records::take(take, take_record)?;
                Self::Triggers(id, session, records)
            }
            STATUS => Self::Status(take.u32()?, Status::take(take)?),
            HEARTBEAT => Self::Heartbeat(Status::take(take)?),
            TRIGGER => Self::Trigger(SessionId(take.array()?), take_record(take)?),
            DONE => Self::Done {
                session: SessionId(take.array()?),
                emitted: take.u64()?,
                reason: EndReason::from_code(take.u8()?).ok_or(DecodeError::Value)?,
            },
            FAULT => Self::Fault(SessionId(take.array()?), take_fault(take)?),
            EDGES => Self::Edges {
                request_id: take.u32()?,
                next: take.u64()?,
                levels: take.u8()?,
                edges: Records::take(take, Edge::take)?,
            },
            TIME_CODES => Self::TimeCodes {
                request_id: take.u32()?,
                input: take_input(take)?,
                next: take.u64()?,
                refused: take.u32()?,
                first: take.u64()?,
                codes: Records::take(take, TimeCodeFrame::take)?,
            },
            found => return Err(DecodeError::Kind { found }),
        })
    }
}

fn put_welcome(put: &mut Put<'_>, welcome: &Welcome) {
    put.bytes(&welcome.identity.name.0);
    put.bytes(&welcome.identity.unique_id);
    welcome.identity.firmware.iter().for_each(|&part| put.u16(part));
    put.u8(welcome.min);
    put.u8(welcome.current);
    put.u8(welcome.agreed);
    put.u8(welcome.link.index() as u8);
}

fn take_welcome(take: &mut Take<'_>) -> Result<Welcome, DecodeError> {
    let identity = Identity {
        name: NodeName(take.array()?),
        unique_id: take.array()?,
        firmware: [take.u16()?, take.u16()?, take.u16()?],
    };
    Ok(Welcome {
        identity,
        min: take.u8()?,
        current: take.u8()?,
        agreed: take.u8()?,
        link: LinkId::from_index(take.u8()?).ok_or(DecodeError::Value)?,
    })
}

fn put_record(record: &TriggerRecord, put: &mut Put<'_>) {
    put.i64(record.number);
    put.u64(record.time_ns);
    put.u8(record.flags.0);
}

fn take_record(take: &mut Take<'_>) -> Result<TriggerRecord, DecodeError> {
    Ok(TriggerRecord { number: take.i64()?, time_ns: take.u64()?, flags: TriggerFlags(take.u8()?) })
}

fn take_fault(take: &mut Take<'_>) -> Result<Fault, DecodeError> {
    let (code, value) = (take.u8()?, take.u64()?);
    let link = || u8::try_from(value).ok().and_then(LinkId::from_index).ok_or(DecodeError::Value);
    Ok(match code {
        0 => Fault::LinkSilent { link: link()? },
        1 => Fault::ArmWithdrawn { link: link()? },
        2 => Fault::FrameSyncMissing { since_ns: value },
        3 => Fault::Hardware { code: u32::try_from(value).map_err(|_| DecodeError::Value)? },
        _ => return Err(DecodeError::Value),
    })
}
